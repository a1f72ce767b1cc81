"""`dem-mpi compress`: from a trajectory, or an array, to an archive, on any number of ranks.

Bodies are split into blocks by ranges of gid, at least one a rank. Chunk after chunk of frames is
read, coded by all ranks, and appended: a rank holds its bodies over one chunk, and of an array all
bodies while it reads. A stop between chunks leaves an archive that --resume goes on with.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compress.archive import Archive, Block, FieldSpec, Settings
from compress.bounds import Bound
from dem_mpi import __version__
from dem_mpi.array_source import ArraySource, is_array, require_data_set
from dem_mpi.compress_options import CompressOptions, choose
from dem_mpi.compression import (
    ArchiveFacts,
    ChunkWriter,
    block_of,
    compile_kernels,
    fields_text,
    first_difference,
    guide_of,
)
from dem_mpi.errors import DemError, InputError, StoppedError
from dem_mpi.h5files import readable_size
from dem_mpi.metrics import duration, on_terminal
from dem_mpi.parallel import Parallel
from dem_mpi.signals import StopRequest
from dem_mpi.trajectory_chunks import TrajectoryChunks

_BLOCK_BYTES = 1 << 28  # [B] of values that a block has in one chunk, about, at most
_TRIAL_EVERY = 1
_SAMPLED = 4096  # bodies, at most, that an explanation looks at
_SECONDS_BETWEEN_LINES = 10.0
# Provenance that has to agree to go on with an archive, and how it is called.
_ORIGIN = {
    "source": "source",
    "digest": "source, or one that has changed",
    "scene": "scene",
    "seed": "seed",
    "chunk": "chunk",
}
# What bodies keep for life.
_CONSTANT = ("radius", "half_length", "shape", "material")


def compress_file(
    parallel: Parallel, options: CompressOptions, stop: StopRequest, say: Callable[[str], None]
) -> None:
    """Collective. Make the archive. StoppedError (75) after a signal: --resume goes on then."""
    source = _together(parallel, lambda: open_source(options))
    with source:
        specs = source.specs
        for line in source.lines():
            say(line)
        if options.explain:
            for line in explain_lines(parallel, source, options):
                say(line)
            return
        _refuse_output(parallel, options, source)
        blocks = _together(parallel, lambda: _blocks_of_rank(parallel, source, options.chunk))
        if parallel.size > 1:
            compile_kernels(parallel)
        writer, done = _open_writer(parallel, options, source, len(blocks))
        say(f"{fields_text(specs)}; {options.chunk} frames a chunk")
        try:
            _compress_chunks(parallel, source, writer, blocks, done, options, stop, say)
        except DemError:
            writer.abandon()
            raise
        writer.close()
    facts = _on_root(parallel, lambda: ArchiveFacts.of(options.path))
    for line in [*facts.lines(), facts.coder_line()]:
        say(line)


def _together(parallel: Parallel, make: Callable[[], Any]) -> Any:
    """Collective. What `make` returns on this rank; the first rank's error on all."""
    made, error = None, None
    try:
        made = make()
    except DemError as caught:
        error = caught
    parallel.raise_together(error)
    return made


def _on_root(parallel: Parallel, make: Callable[[], Any]) -> Any:
    """Collective. What `make` returns on rank 0, on all ranks."""
    return parallel.broadcast(_together(parallel, lambda: make() if parallel.rank == 0 else None))


# ---- sources -------------------------------------------------------------------------------


def open_source(options: CompressOptions) -> Source:
    """What is to be compressed. InputError (64) or DataError (65) where it cannot be."""
    if is_array(options.source):
        return ArraySource(options)
    require_data_set(options.source)
    return TrajectorySource(options)


class TrajectorySource:
    """A run's frames as blocks of bodies."""

    def __init__(self, options: CompressOptions) -> None:
        self._file = TrajectoryChunks(options.source)
        try:
            self.specs = _specs(self._file, options)
        except BaseException:
            self._file.close()
            raise
        self.steps = self._file.index.step
        self.times = self._file.index.time

    def __enter__(self) -> TrajectorySource:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def frame_bytes(self) -> int:
        """Bytes [B] of the values of a frame with most bodies."""
        size = sum(np.dtype(spec.dtype).itemsize * spec.width for spec in self.specs.values())
        return self._file.bodies * size

    def blocks(self, number: int) -> list[tuple[int, int]]:
        """Ranges [low, high) of gids, for `read_blocks`."""
        return self._file.blocks(number)

    def read_blocks(
        self, frames: range, blocks: Sequence[tuple[int, int]], verify: Sequence[int]
    ) -> list[Block]:
        """Blocks, neighbours in order, of these frames, which are read once.

        Checksums are compared of the frames `verify`.
        """
        whole = blocks[0][0], blocks[-1][1]
        track = self._file.read(frames, list(self.specs), whole, verify)
        return [block_of(track, gids) for gids in blocks]

    def reader(self) -> Callable[[str, int, int], NDArray]:
        """Values (stop - first, n, w) of a field, of bodies that are there all the time."""
        gid = self._file.lasting(_SAMPLED)
        gids = int(gid[0]), int(gid[-1]) + 1

        def read(name: str, first: int, stop: int) -> NDArray:
            track = self._file.read(range(first, stop), [name], gids)
            values = track.fields[name][:, np.searchsorted(track.gid, gid)]
            return values if values.ndim == 3 else values[:, :, None]

        return read

    def provenance(self) -> dict[str, Any]:
        """Where the values come from; `digest` tells trajectories apart by how they begin."""
        known = ("name", "scene", "seed", "units")
        kept = {
            name: self._file.attributes[name] for name in known if name in self._file.attributes
        }
        return {**kept, "source": str(self._file.path), "digest": self._file.digest()}

    def lines(self) -> list[str]:
        """What there is, one fact a line."""
        index, (start, end) = self._file.index, (self.times[0], self.times[-1])
        raw = int(index.count.sum()) * self.frame_bytes // max(self._file.bodies, 1)
        return [
            f"{self._file.path}: {len(index):,} frames, t = {start:g} to {end:g} s, of at most "
            f"{self._file.bodies:,} bodies: {readable_size(raw)} of {', '.join(self.specs)}"
        ]


Source = TrajectorySource | ArraySource


def _specs(file: TrajectoryChunks, options: CompressOptions) -> dict[str, FieldSpec]:
    """The columns to archive with their bounds."""
    present = [name for name in file.fields if name != "gid"]
    if options.bounds is None:
        bounds = dict.fromkeys(present)
        bounds |= {name: ("exact", 0.0) for name in _CONSTANT if name in present}
    else:
        if "gid" in options.bounds:
            raise InputError("--field gid: gids are always kept, exactly")
        choose("--field", options.bounds, present, file.path)
        bounds = dict(options.bounds)
    specs = {}
    for name, bound in bounds.items():
        column = file.fields[name]
        kind, value = bound or ("relative", options.tolerance)
        if np.dtype(column.dtype).kind != "f" and kind != "exact":
            if bound is not None:
                raise InputError(f"--field {name}: is whole numbers, of which exact is possible")
            kind, value = "exact", 0.0
        specs[name] = FieldSpec(
            bound=Bound(kind, value),
            dtype=column.dtype,
            width=column.width,
            unit=column.unit,
            guide=guide_of(name, bounds),
        )
    return specs


# ---- the work ------------------------------------------------------------------------------


def _blocks_of_rank(parallel: Parallel, source: Source, chunk: int) -> list[tuple[int, int]]:
    """Blocks of this rank: at least one a rank, of about a limit at most, in order of gid."""
    wanted = -(-min(chunk, len(source.steps)) * source.frame_bytes // _BLOCK_BYTES)
    each = max(1, -(-wanted // parallel.size))
    blocks = source.blocks(each * parallel.size)
    return blocks[each * parallel.rank : each * (parallel.rank + 1)]


def _open_writer(
    parallel: Parallel, options: CompressOptions, source: Source, blocks: int
) -> tuple[ChunkWriter, int]:
    """Collective. The archive to append to, and how many frames of the source it has."""
    path, settings = options.path, Settings(options.floor, _TRIAL_EVERY, _step_size(source))
    provenance = _together(parallel, source.provenance)
    provenance |= {"chunk": options.chunk, "version": __version__}
    if options.resume and _on_root(parallel, path.exists):
        origin = {name: provenance.get(name) for name in _ORIGIN}
        _on_root(parallel, lambda: _refuse_another(path, settings, origin))
        writer, last = ChunkWriter.resume(
            parallel, path, source.specs, settings, origin, None, blocks
        )
        done = int(np.searchsorted(source.steps, last, side="right"))
        error = None
        if parallel.rank == 0:
            with Archive(path) as archive:
                if not np.array_equal(archive.steps, source.steps[:done]):
                    error = InputError(f"--resume: {path} holds other frames than {options.source}")
        try:
            parallel.raise_together(error)
        except DemError:
            writer.abandon()
            raise
        return writer, done
    return ChunkWriter.create(parallel, path, source.specs, settings, provenance, blocks), 0


def _refuse_another(path: Path, settings: Settings, origin: dict[str, Any]) -> None:
    """Raise InputError for an archive of another source, or made in another way."""
    with Archive(path) as archive:
        found = first_difference(archive, settings, origin)
    if found is None:
        return
    name, had, asked = found
    remedy = "--force instead of --resume replaces it"
    if name in ("floor", "chunk"):
        begun = "without it" if had is None else f"with --{name} {had:g}"
        raise InputError(f"--{name} {asked:g}: {path} was begun {begun}; {remedy}")
    values = f" ({had}, not {asked})" if name in ("source", "seed", "step size") else ""
    another = f"{_ORIGIN.get(name, name)}{values}"
    raise InputError(f"--resume: {path} was begun with another {another}; {remedy}")


def _step_size(source: Source) -> float:
    steps, times = source.steps, source.times
    if len(steps) < 2:
        return 0.0
    return float((times[-1] - times[0]) / (steps[-1] - steps[0]))


def _compress_chunks(
    parallel: Parallel,
    source: Source,
    writer: ChunkWriter,
    blocks: list[tuple[int, int]],
    done: int,
    options: CompressOptions,
    stop: StopRequest,
    say: Callable[[str], None],
) -> None:
    total = len(source.steps)
    progress = _Progress(parallel, done, total, say)
    if done:
        say(f"{done:,} frames are in {options.path} already")
    while done < total:
        if parallel.any(stop.requested):
            progress.finish()
            name = parallel.broadcast(next(filter(None, parallel.gather(stop.name) or [""]), ""))
            raise StoppedError(
                f"stopped by {name or 'a signal'} after frame {done} of {total}; {options.path} "
                "holds these: run the same command with --resume"
            )
        frames = range(done, min(done + options.chunk, total))
        # Each frame's checksums are compared once, by one of the ranks that read it.
        verify = list(frames[parallel.rank :: parallel.size])
        data = _together(
            parallel,
            lambda frames=frames, verify=verify: source.read_blocks(frames, blocks, verify),
        )
        writer.append(
            source.steps[frames.start : frames.stop], source.times[frames.start : frames.stop], data
        )
        done = frames.stop
        progress.show(done)
    progress.finish()


class _Progress:
    """One live line on a terminal, a plain line now and then elsewhere; rank 0 only."""

    def __init__(
        self, parallel: Parallel, first: int, total: int, say: Callable[[str], None]
    ) -> None:
        self._quiet, self._live, self._say = parallel.rank != 0, on_terminal(), say
        self._first, self._total = first, total
        self._started = self._last = perf_counter()
        self._estimated = self._shown = False

    def show(self, done: int) -> None:
        """Say how far it is; after the first chunk always, for its estimate."""
        now = perf_counter()
        interval = 0.2 if self._live else _SECONDS_BETWEEN_LINES
        if self._quiet or (self._estimated and now - self._last < interval):
            return
        self._estimated, self._last = True, now
        left = (now - self._started) / (done - self._first) * (self._total - done)
        text = f"frame {done:,} of {self._total:,}, remaining {duration(left)}"
        if self._live:
            self._shown = True
            sys.stdout.write("\r" + text.ljust(60))
            sys.stdout.flush()
        else:
            self._say(text)

    def finish(self) -> None:
        """Leave the live line."""
        if self._shown:
            sys.stdout.write("\n")
            self._shown = False


def _refuse_output(parallel: Parallel, options: CompressOptions, source: Source) -> None:
    """Collective. Raise InputError for a file that may not be written, OutputError for no space."""
    out = options.path
    error: DemError | None = None
    if parallel.rank == 0:
        try:
            refuse_place("--output", out, options.force or options.resume, resume=True)
            _refuse_source(out, options.source)
        except DemError as caught:
            error = caught
    parallel.raise_together(error)


def _refuse_source(out: Path, source: str) -> None:
    for name in (source, source.partition(":")[0]):
        if Path(name).exists() and out.exists() and out.samefile(name):
            raise InputError(f"--output {out}: is the source itself")


def refuse_place(flag: str, out: Path, force: bool, resume: bool = False) -> None:
    """Raise InputError unless a file may be written there."""
    if out.is_dir():
        raise InputError(f"{flag} {out}: is a directory, name a file")
    if not out.absolute().parent.is_dir():
        raise InputError(f"{flag} {out}: there is no directory {out.absolute().parent}")
    if out.exists() and not force:
        more = "--resume goes on with it, " if resume else ""
        raise InputError(f"{flag} {out}: exists; {more}--force replaces it")


# ---- what to expect ------------------------------------------------------------------------


def explain_lines(parallel: Parallel, source: Source, options: CompressOptions) -> list[str]:
    """Collective. What a sample of the values promises, one fact a line; nothing is written."""
    from compress.explain import explain

    # Coders know where bodies are only where positions are archived with the rest.
    spec = source.specs.get("position")
    positions = "position" if spec is not None and spec.width == 3 else None

    def work() -> list[str]:
        read, times = source.reader(), source.times
        try:
            found = explain(read, source.specs, times, chunk=options.chunk, positions=positions)
        except ValueError as error:
            raise InputError(f"{options.source}: {error}") from None
        return list(found.lines)

    return _on_root(parallel, work)
