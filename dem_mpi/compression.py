"""Compression while a run goes on: ranks buffer frames and code their bodies, rank 0 writes.

Frames wait until a chunk is full. Then each rank codes the bodies that it had at the chunk's
beginning as one block, and rank 0 appends the bytes of all blocks to the archive.

A checkpoint keeps the frames that wait, rather than closing their chunk: checkpoints are often
closer to each other than chunks are long, and short chunks compress badly; and a run that was
stopped leaves the archive that it would have left uninterrupted. On a stop the frames that wait
are archived besides, so that the archive has all frames there are; a resumed run drops that chunk
again, with all others that came after its checkpoint, and goes on from the frames kept there.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compress.archive import (
    Archive,
    ArchiveWriter,
    Block,
    CodedChunk,
    Encoder,
    FieldSpec,
    Settings,
)
from compress.bounds import Bound, Errors
from compress.coding import Memory
from compress.effort import EFFORTS
from dem_mpi.bodies import FIELDS
from dem_mpi.errors import DataError, DemError, InputError
from dem_mpi.frame_buffer import FrameBuffer, PendingFrames, Track
from dem_mpi.h5files import agree, readable_size
from dem_mpi.parallel import Parallel
from dem_mpi.scene_compress import Compress

_TRIAL_EVERY = 8  # chunks of a run between trials of all coders
# What velocities, integrated over time, predict.
_GUIDES = {"position": "velocity"}


def field_specs(bounds: Mapping[str, tuple[str, float]]) -> dict[str, FieldSpec]:
    """Columns of bodies as an archive takes them, from kinds and values of their bounds."""
    specs = {}
    for name, (kind, value) in bounds.items():
        field = FIELDS[name]
        specs[name] = FieldSpec(
            bound=Bound(kind, value),
            dtype=np.dtype(field.dtype).str.lstrip("<=|"),
            width=field.row_shape[0] if field.row_shape else 1,
            unit=field.unit,
            guide=guide_of(name, bounds),
        )
    return specs


def guide_of(name: str, fields: Container[str]) -> str | None:
    """The archived field whose integral over time predicts this one, None if there is none."""
    guide = _GUIDES.get(name)
    return guide if guide is not None and guide in fields else None


@dataclass(frozen=True)
class ArchiveFacts:
    """What an archive came to: bytes [B] of the file and of the values that it stands for."""

    path: Path
    frames: int
    chunks: int
    coded: int
    raw: int
    fields: Mapping[str, FieldSpec]
    errors: Mapping[str, Errors]
    coders: Mapping[str, int]

    @classmethod
    def of(cls, path: Path | str) -> ArchiveFacts:
        """Of an archive on disk. DataError where it is damaged."""
        path = Path(path)
        with Archive(path) as archive:
            errors = {name: archive.errors(name) for name in archive.fields}
            size = {name: np.dtype(spec.dtype).itemsize for name, spec in archive.fields.items()}
            return cls(
                path=path,
                frames=len(archive.steps),
                chunks=len(archive.chunks),
                coded=path.stat().st_size,
                raw=sum(errors[name].count * size[name] for name in errors),
                fields=dict(archive.fields),
                errors=errors,
                coders=archive.bytes_by_coder(),
            )

    @property
    def ratio(self) -> float:
        """How many times smaller the file is than the values."""
        return self.raw / self.coded if self.coded else 0.0

    @property
    def comparison(self) -> str:
        """The file beside the values, in words."""
        if self.ratio >= 1.0:
            return f"{self.ratio:.3g} times smaller"
        return f"{self.coded / self.raw:.3g} times larger" if self.raw else "larger"

    def lines(self) -> list[str]:
        """What to tell of it, one fact a line."""
        chunks = f"{self.chunks:,} chunk{'s' * (self.chunks != 1)}"
        lines = [
            f"{self.frames:,} frames in {chunks} in {self.path}: {readable_size(self.coded)} for "
            f"{readable_size(self.raw)}, {self.comparison}"
        ]
        return lines + [f"  {line}" for line in self.field_lines()]

    def field_lines(self) -> list[str]:
        """Fields with the errors that were measured, one a line."""
        return [f"{n}: {error_text(self.errors[n], spec)}" for n, spec in self.fields.items()]

    def coder_line(self) -> str:
        """Bytes by coder, the largest first."""
        order = sorted(self.coders.items(), key=lambda item: -item[1])
        order.append(("all else", self.coded - sum(self.coders.values())))
        return "bytes by coder: " + ", ".join(f"{name} {size:,}" for name, size in order)


def error_text(errors: Errors, spec: FieldSpec) -> str:
    """The measured errors of a field beside the bound that it has."""
    if spec.bound.kind == "exact":
        return "exact"
    unit = "" if spec.unit == "1" else f" {spec.unit}"
    return (
        f"error {errors.relative:.2e} relative, {errors.rmse:.2e}{unit} rms, "
        f"{errors.maximum:.2e}{unit} at most (bound: {bound_text(spec)})"
    )


def bound_text(spec: FieldSpec) -> str:
    """A bound in words: "relative 0.01", "pointwise 0.0001 m"."""
    bound = spec.bound
    if bound.kind == "exact":
        return "exact"
    unit = "" if bound.kind == "relative" or spec.unit == "1" else f" {spec.unit}"
    return f"{bound.kind} {bound.value:g}{unit}"


class ChunkWriter:
    """An archive that all ranks code for and rank 0 writes. All methods are collective."""

    def __init__(
        self,
        parallel: Parallel,
        path: Path,
        writer: ArchiveWriter | None,
        fields: Mapping[str, FieldSpec],
        settings: Settings,
        memories: Sequence[Memory | None],
    ) -> None:
        """`writer` stands on rank 0 alone; `memories` are those of this rank's blocks."""
        self.path = path
        self._parallel, self._writer = parallel, writer
        self._encoders = [Encoder(fields, settings, memory) for memory in memories]

    @classmethod
    def create(
        cls,
        parallel: Parallel,
        path: Path,
        fields: Mapping[str, FieldSpec],
        settings: Settings,
        provenance: Mapping[str, Any],
        blocks: int = 1,
    ) -> ChunkWriter:
        """Begin an archive, replacing a file of that name, of so many blocks on this rank."""
        writer = None
        with agree(parallel, path, "write"):
            if parallel.rank == 0:
                path.parent.mkdir(parents=True, exist_ok=True)
                writer = ArchiveWriter(
                    path, fields, settings=settings, provenance=provenance, force=True
                )
        return cls(parallel, path, writer, fields, settings, [None] * blocks)

    @classmethod
    def resume(
        cls,
        parallel: Parallel,
        path: Path,
        fields: Mapping[str, FieldSpec],
        settings: Settings,
        origin: Mapping[str, Any],
        last_step: int | None,
        blocks: int = 1,
    ) -> tuple[ChunkWriter, int]:
        """Go on with an archive behind `last_step`, None: behind its last chunk.

        Returns it with the last step that it holds now, -1 for none. Raises DataError where it is
        damaged or of other fields or bounds, InputError where it was begun with other settings or
        its provenance is not `origin` in what that holds, OutputError where it cannot be written.
        """
        first = parallel.exclusive_sum(blocks)
        total = parallel.sum(blocks)
        writer, found = None, None
        with agree(parallel, path, "resume", DataError):
            if parallel.rank == 0:
                _refuse_another(path, fields, settings, origin)
                writer = ArchiveWriter.resume(path, last_step)
                reached = -1 if writer.last_step is None else writer.last_step
                found = reached, [writer.memory(k) for k in range(total)]
        reached, memories = parallel.broadcast(found)
        mine = memories[first : first + blocks]
        return cls(parallel, path, writer, fields, settings, mine), reached

    def append(self, steps: Sequence[int], times: Sequence[float], blocks: Sequence[Block]) -> None:
        """Code this rank's blocks of a chunk, and append those of all ranks."""
        parallel = self._parallel
        numbers, instants = np.array(steps, dtype=np.int64), np.array(times, dtype=np.float64)
        pairs = list(zip(self._encoders, blocks, strict=True))
        parts = parallel.gather([encoder.scales(block) for encoder, block in pairs])
        scales = [one for part in parallel.broadcast(parts) for one in part]
        coded, error = [], None
        try:
            coded = [encoder.encode(block, instants, scales, numbers) for encoder, block in pairs]
        except DemError as caught:
            error = caught
        parallel.raise_together(error)
        gathered = parallel.gather(coded)
        with agree(parallel, self.path, "write"):
            if self._writer is not None:
                everyone = tuple(block for part in gathered for block in part)
                self._writer.append_coded(CodedChunk(numbers, instants, everyone))

    def close(self) -> None:
        """Mark the archive as complete; a second call does nothing."""
        writer, self._writer = self._writer, None
        with agree(self._parallel, self.path, "write"):
            if writer is not None:
                writer.close()

    def abandon(self) -> None:
        """Leave the archive as one that is to be gone on with."""
        writer, self._writer = self._writer, None
        with agree(self._parallel, self.path, "write"):
            if writer is not None:
                writer.abandon()


def _refuse_another(
    path: Path, fields: Mapping[str, FieldSpec], settings: Settings, origin: Mapping[str, Any]
) -> None:
    with Archive(path) as archive:
        stored = dict(archive.fields)
        found = first_difference(archive, settings, origin)
    if stored != dict(fields):
        raise DataError(f"{path}: has other fields or bounds: {fields_text(stored)}")
    if found is not None:
        name, had, asked = found
        raise InputError(f"{path}: was begun with {name} {had}, not {asked}")


def first_difference(
    archive: Archive, settings: Settings, origin: Mapping[str, Any]
) -> tuple[str, Any, Any] | None:
    """What keeps an archive from being gone on with: a name, what it has, what is asked for.

    `origin` is the part of the provenance that has to agree. Efforts may differ, chunk by chunk.
    """
    had = archive.settings
    if had.floor != settings.floor:
        return "floor", had.floor, settings.floor
    known = had.step_size and settings.step_size
    # A mean over the frames there are so far: it may differ in the last digits.
    if known and not math.isclose(had.step_size, settings.step_size):
        return "step size", had.step_size, settings.step_size
    for name, asked in origin.items():
        if archive.provenance.get(name) != asked:
            return name, archive.provenance.get(name), asked
    return None


def fields_text(fields: Mapping[str, FieldSpec]) -> str:
    """Fields with their bounds: "velocity (relative 0.01), radius (exact)"."""
    return ", ".join(f"{name} ({bound_text(spec)})" for name, spec in fields.items())


def block_of(track: Track, gids: tuple[int, int] | None = None) -> Block:
    """Bodies over a chunk as `compress` takes them: all, or those of gids [low, high)."""
    low, high = (0, len(track.gid)) if gids is None else np.searchsorted(track.gid, gids)
    frames = len(next(iter(track.fields.values())))
    first, stop = track.first[low:high], track.stop[low:high]
    always = not first.any() and (stop == frames).all()
    fields = {name: np.ascontiguousarray(v[:, low:high]) for name, v in track.fields.items()}
    return Block(
        gid=track.gid[low:high],
        fields={name: v if v.ndim == 3 else v[:, :, None] for name, v in fields.items()},
        first=None if always else first,
        stop=None if always else stop,
    )


# ---- in situ -------------------------------------------------------------------------------


class InSitu:
    """The archive of a run that goes on. All methods but `pending` are collective."""

    def __init__(
        self,
        parallel: Parallel,
        writer: ChunkWriter,
        buffer: FrameBuffer,
        chunk: int,
        archived: int,
    ) -> None:
        """Not for callers: `create` and `resume` make one."""
        self.path = writer.path
        self._parallel, self._writer, self._buffer = parallel, writer, buffer
        self._chunk, self._archived = chunk, archived

    @classmethod
    def create(
        cls,
        parallel: Parallel,
        path: Path,
        section: Compress,
        step_size: float,
        provenance: Mapping[str, Any],
    ) -> InSitu:
        """Begin an archive, replacing a file of that name; step_size [s] is the run's."""
        fields, settings = _of_section(section, step_size)
        writer = ChunkWriter.create(parallel, path, fields, settings, provenance)
        return cls(parallel, writer, FrameBuffer(list(fields)), section.chunk, -1)

    @classmethod
    def resume(
        cls,
        parallel: Parallel,
        path: Path,
        section: Compress,
        step_size: float,
        provenance: Mapping[str, Any],
        pending: PendingFrames | None,
    ) -> tuple[InSitu, str]:
        """Go on from what a checkpoint kept, None where it knew of no archive.

        An archive that cannot be gone on with, as one of another seed, is kept under another name
        and a new one begun; the text that is returned tells the user, "" where there is nothing to
        tell. OutputError where it cannot be written now, as while another process writes it: it
        stays as it is.
        """
        fields, settings = _of_section(section, step_size)
        buffer = FrameBuffer(list(fields))
        try:
            expected = -1 if pending is None else pending.archived
            if pending is None:
                raise DataError(f"{path}: the checkpoint knows of no archive")
            # The rest of the scene was compared with the checkpoint's, and may have been changed.
            origin = {"seed": provenance["seed"]}
            writer, archived = ChunkWriter.resume(
                parallel, path, fields, settings, origin, expected
            )
            if archived != expected:
                writer.abandon()
                raise DataError(
                    f"{path}: ends with step {archived}, the checkpoint expects {expected}"
                )
            message = ""
        except (DataError, InputError) as error:
            archived, message = -1, _put_aside(parallel, path, error)
            writer = ChunkWriter.create(parallel, path, fields, settings, provenance)
        if pending is not None and len(pending.step):
            if set(fields) <= pending.rows.keys():
                buffer.refill(pending)
            else:
                lost = f"steps {pending.step[0]} to {pending.step[-1]}"
                message += f"; {lost} are not archived, for other fields were asked for then"
        return cls(parallel, writer, buffer, section.chunk, archived), message.removeprefix("; ")

    def record(self, step: int, time: float, columns: Mapping[str, NDArray]) -> None:
        """Buffer this rank's rows of a frame; code the chunk when it is full."""
        self._buffer.add(step, time, columns)
        if len(self._buffer) >= self._chunk:
            self.flush()

    def flush(self) -> None:
        """Archive the frames that wait, as a chunk that is shorter than others."""
        if not len(self._buffer):
            return
        block = block_of(self._buffer.gather(self._parallel))
        self._writer.append(self._buffer.steps, self._buffer.times, [block])
        self._archived = self._buffer.steps[-1]
        self._buffer.clear()

    @property
    def pending(self) -> PendingFrames:
        """What a checkpoint has to keep."""
        return self._buffer.pending(self._archived)

    def close(self) -> None:
        """Archive what waits and mark the archive as complete."""
        self.flush()
        self._writer.close()

    def abandon(self) -> None:
        """Leave the archive as it is, for a later `resume`."""
        self._writer.abandon()

    def facts(self) -> list[str]:
        """What the archive came to, one fact a line; the same on all ranks."""
        lines = None
        with agree(self._parallel, self.path, "read", DataError):
            if self._parallel.rank == 0:
                lines = ArchiveFacts.of(self.path).lines()
        return self._parallel.broadcast(lines)


def _of_section(section: Compress, step_size: float) -> tuple[dict[str, FieldSpec], Settings]:
    settings = Settings(section.floor, _TRIAL_EVERY, step_size, effort="fast")
    return field_specs(section.fields.bounds), settings


def _put_aside(parallel: Parallel, path: Path, error: DemError) -> str:
    """Collective. Rename an archive that cannot be continued; return what to tell the user."""
    message = ""
    with agree(parallel, path, "rename"):
        if parallel.rank == 0:
            if not path.exists():
                message = f"{path} is missing: the archive begins here in a new file"
            else:
                k = 1
                while (kept := path.with_name(f"{path.name}.damaged-{k}")).exists():
                    k += 1
                path.rename(kept)
                message = (
                    f"{error}; it is kept as {kept.name} and the archive begins here in a new file"
                )
    return parallel.broadcast(message)


# ---- compilation ---------------------------------------------------------------------------


def compile_kernels(parallel: Parallel) -> None:
    """Collective. Compile the kernels of all coders on rank 0, then load them on the others.

    Ranks that compiled at the same time would race for numba's cache on disk.
    """
    for turn in (True, False):
        error = None
        if (parallel.rank == 0) == turn:
            try:
                _code_a_few_bodies()
            except Exception as caught:
                error = caught
        parallel.raise_together(error)


def _code_a_few_bodies() -> None:
    """Try all coders on bodies that fly and shake, to a mean and to a largest error."""
    frames, n = 8, 64
    times = 1e-3 * np.arange(frames)
    velocity = np.random.default_rng(0).standard_normal((frames, n, 3))
    position = np.cumsum(1e-3 * velocity, axis=0)
    block = Block(np.arange(n), {"velocity": velocity, "position": position})
    for kind in ("relative", "pointwise"):
        bounds = {"velocity": (kind, 1e-2), "position": (kind, 1e-4)}
        for effort in EFFORTS:
            encoder = Encoder(field_specs(bounds), Settings(effort=effort))
            for _ in range(2):  # a first chunk, and one with another before it
                encoder.encode(block, times)
