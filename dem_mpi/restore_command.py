"""`dem-mpi restore`, `slice` and `compare`: what is in an archive, as much as is asked for."""

from __future__ import annotations

import contextlib
import csv
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compress.archive import Archive, Restored
from compress.compare import ArchiveValues, Difference, Values, compare
from dem_mpi import __version__
from dem_mpi.array_source import ArraySource, is_array, require_data_set
from dem_mpi.compress_command import refuse_place
from dem_mpi.compress_options import ALL, CompressOptions, Range, Selection, choose, range_text
from dem_mpi.errors import DataError, InputError
from dem_mpi.h5files import agree, read_attributes, readable_size
from dem_mpi.output import Field, Trajectory
from dem_mpi.parallel import Parallel
from dem_mpi.trajectory_chunks import TrajectoryChunks

_MOST_ROWS = 10_000  # that are printed


# ---- what is asked for ---------------------------------------------------------------------


def frames_of(archive: Archive, steps: Range) -> slice:
    """The frames whose step numbers lie in [a, b). InputError where there are none."""
    low = 0 if steps[0] is None else int(np.searchsorted(archive.steps, steps[0]))
    high = len(archive.steps) if steps[1] is None else int(np.searchsorted(archive.steps, steps[1]))
    if not len(archive.steps):
        raise DataError(f"{archive.path}: holds no complete chunk")
    if low >= high:
        raise InputError(
            f"--steps {range_text(steps)}: {archive.path} holds {len(archive.steps):,} frames of "
            f"steps {archive.steps[0]} to {archive.steps[-1]}, none of these"
        )
    return slice(low, high)


def bodies_of(bodies: Range) -> slice | None:
    """Gids in [a, b), None for all."""
    return None if bodies == ALL else slice(*bodies)


def _names(archive: Archive, selection: Selection) -> tuple[str, ...]:
    wanted = tuple(archive.fields) if selection.fields is None else selection.fields
    return choose("--fields", wanted, archive.fields, archive.path)


def _bodies_there(archive: Archive, frames: slice, selection: Selection) -> tuple[NDArray, int]:
    """Gids of the chunks selected, and rows: a body in a frame each. Decodes no field.

    InputError where bodies are asked for and there are none of them.
    """
    gid, rows = np.zeros(0, np.int64), 0
    for part in archive.iterate([], frames, bodies_of(selection.bodies)):
        gid = np.union1d(gid, part.gid)
        rows += int(part.present.sum())
    if selection.bodies != ALL and not len(gid):
        held = archive.gid
        text = f"gids {held[0]} to {held[-1]}" if len(held) else "no bodies"
        raise InputError(
            f"--bodies {range_text(selection.bodies)}: {archive.path} holds {text}, none of these "
            "in these steps"
        )
    return gid, rows


def _is_array(archive: Archive) -> bool:
    """Whether it was made of an array. One of a single dimension has steps of shape ()."""
    shaped = any(spec.shape for spec in archive.fields.values())
    return shaped or is_array(str(archive.provenance.get("source", "")))


# ---- restore -------------------------------------------------------------------------------


def warn(text: str) -> None:
    """Say on stderr what does not end the program."""
    print(f"dem-mpi: warning: {text}", file=sys.stderr, flush=True)


def restore_file(
    path: Path, selection: Selection, out: Path | None, force: bool, say: Callable[[str], None]
) -> None:
    """Decode what is selected into a trajectory (.h5), or arrays (.npz, .npy)."""
    with Archive(path) as archive:
        names, frames = _names(archive, selection), frames_of(archive, selection.steps)
        out = _place(archive, names, out, force)
        gid, _ = _bodies_there(archive, frames, selection)
        with _whole_file(out) as part:
            rows = _WRITERS[out.suffix](archive, names, frames, gid, selection, part)
        if not archive.complete:
            warn(f"{path}: archive is not complete, it ends with step {archive.steps[-1]}")
    size = readable_size(out.stat().st_size)
    count = frames.stop - frames.start
    say(f"wrote {out}: {count:,} frames, {rows:,} bodies, {', '.join(names)}; {size}")
    if out.suffix == ".npz":
        for name, member in _members(names).items():
            if name != member:
                say(f"note: field {name} is {member} in {out}")


@contextlib.contextmanager
def _whole_file(out: Path) -> Iterator[Path]:
    """A file to write, which takes its name when it is whole: damage may show half-way."""
    part = out.with_name(f"{out.name}.part")
    try:
        yield part
        with agree(Parallel.alone(), out, "write"):
            part.replace(out)
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _refuse_place(archive: Archive, out: Path, force: bool) -> None:
    refuse_place("--output", out, force)
    if out.exists() and out.samefile(archive.path):
        raise InputError(f"--output {out}: is the archive itself")


def _place(archive: Archive, names: tuple[str, ...], out: Path | None, force: bool) -> Path:
    """Where to write. InputError for a file that cannot hold the fields, or may not be written."""
    path = archive.path
    placed = "position" in names and not _is_array(archive)
    if out is None:
        out = path.with_name(f"{path.name.split('.')[0]}.restored{'.h5' if placed else '.npz'}")
    if out.suffix not in _WRITERS:
        raise InputError(f"--output {out}: must end in {', '.join(_WRITERS)}")
    _refuse_place(archive, out, force)
    if out.suffix == ".h5" and not placed:
        why = "is not in --fields" if "position" in archive.fields else "is not archived"
        raise InputError(
            f"--output {out}: a trajectory needs position, which {why}; write .npz or .npy"
        )
    if out.suffix == ".npy" and len(names) != 1:
        raise InputError(
            f"--output {out}: holds one field, choose it with --fields: {', '.join(names)}"
        )
    return out


def _write_trajectory(
    archive: Archive,
    names: tuple[str, ...],
    frames: slice,
    gid: NDArray,
    selection: Selection,
    out: Path,
) -> int:
    """A file that the run itself could have written, but for the errors; a chunk at a time."""
    fields = [
        Field(name, np.dtype(spec.dtype).str.lstrip("<=|"), spec.width, spec.unit)
        for name, spec in archive.fields.items()
        if name in names
    ]
    attributes = {
        **{k: v for k, v in archive.provenance.items() if isinstance(v, (str, int, float))},
        "version": __version__,
        "restored_from": str(archive.path),
    }
    most = 0
    trajectory = Trajectory.create(Parallel.alone(), out, fields, attributes, bodies=len(gid))
    try:
        for part in archive.iterate(names, frames, bodies_of(selection.bodies)):
            for k, step in enumerate(part.steps.tolist()):
                there = part.present[k]
                rows = {name: values[k, there] for name, values in part.fields.items()}
                rows["gid"] = part.gid[there]
                most = max(most, len(rows["gid"]))
                trajectory.write_frame(step, float(part.times[k]), rows)
        trajectory.seal()
    finally:
        trajectory.close()
    return most


def _write_array(
    archive: Archive,
    names: tuple[str, ...],
    frames: slice,
    gid: NDArray,
    selection: Selection,
    out: Path,
) -> int:
    """An array (T, m, w), or of the shape it had, chunk by chunk; NaN where a body is not there."""
    (name,) = names
    spec = archive.fields[name]
    whole = _is_array(archive) and selection.bodies == ALL
    tail = spec.shape if whole else (len(gid), *([spec.width] * (spec.width > 1)))
    with agree(Parallel.alone(), out, "write"):
        array = np.lib.format.open_memmap(
            out, "w+", np.dtype(spec.dtype), (frames.stop - frames.start, *tail)
        )
        done = 0
        for part in archive.iterate([name], frames, bodies_of(selection.bodies)):
            rows = np.zeros((len(part.steps), len(gid), spec.width), spec.dtype)
            if rows.dtype.kind == "f":
                rows[:] = np.nan
            rows[:, np.searchsorted(gid, part.gid)] = part.fields[name]
            array[done : done + len(rows)] = rows.reshape(len(rows), *tail)
            done += len(rows)
        array.flush()
    return len(gid)


def _write_arrays(
    archive: Archive,
    names: tuple[str, ...],
    frames: slice,
    gid: NDArray,
    selection: Selection,
    out: Path,
) -> int:
    """All in one file of arrays: step, time, gid, present, and the fields."""
    found = archive.read(names, frames, bodies_of(selection.bodies))
    whole = _is_array(archive) and selection.bodies == ALL
    arrays = dict(
        zip(_OF_FRAMES, (found.steps, found.times, found.gid, found.present), strict=True)
    )
    for name, member in _members(names).items():
        spec, values = archive.fields[name], found.fields[name]
        tail = spec.shape if whole else values.shape[1 : 2 + (spec.width > 1)]
        arrays[member] = values.reshape(len(values), *tail)
    # numpy's own function for this has parameters that fields may be called like.
    with agree(Parallel.alone(), out, "write"), zipfile.ZipFile(out, "w") as file:
        for member, values in arrays.items():
            with file.open(f"{member}.npy", "w", force_zip64=True) as place:
                np.lib.format.write_array(place, values, allow_pickle=False)
    return len(gid)


_OF_FRAMES = ("step", "time", "gid", "present")


def _members(names: tuple[str, ...]) -> dict[str, str]:
    """What fields are called in a file of arrays, where some names are taken."""
    members: dict[str, str] = {}
    for name in names:
        member = name
        while member in _OF_FRAMES or member in members.values():
            member = f"field_{member}"
        members[name] = member
    return members


_WRITERS = {".h5": _write_trajectory, ".npz": _write_arrays, ".npy": _write_array}


# ---- slice ---------------------------------------------------------------------------------


def slice_file(
    path: Path, selection: Selection, out: Path | None, force: bool, say: Callable[[str], None]
) -> None:
    """Print a few values, a row for each body and step, or write them as CSV."""
    with Archive(path) as archive:
        names, frames = _names(archive, selection), frames_of(archive, selection.steps)
        if out is not None:
            _refuse_place(archive, out, force)
        _, count = _bodies_there(archive, frames, selection)
        if out is None and count > _MOST_ROWS:
            raise InputError(
                f"{count:,} rows are too many to print: ask for fewer with --steps and --bodies, "
                "or give --output FILE.csv, or use dem-mpi restore"
            )
        titles = ["step", "time", "gid"]
        for name in names:
            w = archive.fields[name].width
            titles += (
                [name] if w == 1 else [f"{name}_{'xyz'[k] if w == 3 else k}" for k in range(w)]
            )
        parts = archive.iterate(names, frames, bodies_of(selection.bodies))
        rows = (row for part in parts for row in _rows(part, names))
        if out is None:
            for row in (titles, *rows):
                say("  ".join(row))
            return
        with (
            _whole_file(out) as whole,
            agree(Parallel.alone(), out, "write"),
            whole.open("w", newline="") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(titles)
            writer.writerows(rows)
    say(f"wrote {out}: {count:,} rows")


def _rows(found: Restored, names: tuple[str, ...]) -> Iterator[list[str]]:
    for k, b in np.argwhere(found.present).tolist():
        values = [x for name in names for x in found.fields[name][k, b].tolist()]
        head = [str(int(found.steps[k])), f"{found.times[k]:.9g}", str(int(found.gid[b]))]
        yield head + [f"{x:.9g}" if isinstance(x, float) else str(int(x)) for x in values]


# ---- compare -------------------------------------------------------------------------------


def compare_files(first: Path | str, second: Path | str, fields: Selection) -> list[str]:
    """Errors of each field that both have, of `second` against `first`, one field a line.

    Each is an archive, a trajectory or an array. Steps and bodies that both have are compared.
    """
    with contextlib.ExitStack() as stack:
        a, b = (_open_values(str(path), stack) for path in (first, second))
        pairs = [(name, name) for name in a.names if name in b.names]
        if len(a.names) == len(b.names) == 1:  # arrays, whatever they are called
            pairs = [(a.names[0], b.names[0])]
        if fields.fields is not None and pairs:
            known = dict.fromkeys(name for pair in pairs for name in pair)
            wanted = choose("--fields", fields.fields, known, f"both {first} and {second}")
            pairs = [pair for pair in pairs if not {*pair}.isdisjoint(wanted)]
        found = compare(a, b, pairs)
    lines = [f"{found.steps:,} steps that both have, {second} against {first}"]
    lines += [_comparison(x if x == y else f"{x} and {y}", e) for (x, y), e in found.fields.items()]
    if found.alone:
        lines.append(f"note: {found.alone:,} rows are in one of them only")
    return lines


def _comparison(name: str, errors: Difference) -> str:
    if errors.equal:
        return f"  {name}: equal, {errors.count:,} numbers"
    unlike = f"; {errors.unlike:,} are NaN or infinite in one only" if errors.unlike else ""
    if not errors.maximum:
        return f"  {name}: {errors.count:,} numbers are equal{unlike}"
    return (
        f"  {name}: relative {errors.relative:.4e}, rms {errors.rmse:.4e}, of the range "
        f"{errors.nrmse:.4e}, at most {errors.maximum:.4e}; {errors.count:,} numbers{unlike}"
    )


def _open_values(path: str, stack: contextlib.ExitStack) -> Values:
    """Open what is to be compared, until the stack is left."""
    if is_array(path):
        return stack.enter_context(_ArrayValues(path))
    require_data_set(path)
    from dem_mpi.h5files import open_checked
    from dem_mpi.trajectory import FORMAT

    with open_checked(path) as file:
        trajectory = read_attributes(file).get("format") == FORMAT
    if trajectory:
        return stack.enter_context(_TrajectoryValues(path))
    return ArchiveValues(stack.enter_context(Archive(path)))


class _TrajectoryValues:
    """A trajectory as `compare` reads it."""

    chunk = 16

    def __init__(self, path: str) -> None:
        self._file = TrajectoryChunks(path)
        self.path = path
        self.names = [name for name in self._file.fields if name != "gid"]
        self.steps = self._file.index.step

    def __enter__(self) -> _TrajectoryValues:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, steps: NDArray, names: Sequence[str]) -> Restored:
        """Fields of these steps."""
        k = np.searchsorted(self.steps, steps)
        frames = range(int(k[0]), int(k[-1]) + 1)
        (everything,) = self._file.blocks(1)
        track = self._file.read(frames, names, everything, verify=frames)
        number = np.arange(len(frames))[:, None]
        there = (number >= track.first) & (number < track.stop)
        keep = np.isin(self.steps[frames.start : frames.stop], steps)
        fields = {n: v.reshape(*v.shape[:2], -1)[keep] for n, v in track.fields.items()}
        return Restored(steps, self._file.index.time[k], track.gid, there[keep], fields)


class _ArrayValues:
    """An array as `compare` reads it."""

    chunk = 16

    def __init__(self, path: str) -> None:
        self._source = ArraySource(CompressOptions(path))
        self.path = path
        self.names = list(self._source.specs)
        self.steps = self._source.steps

    def __enter__(self) -> _ArrayValues:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()

    def read(self, steps: NDArray, names: Sequence[str]) -> Restored:
        """The array of these steps."""
        frames = range(int(steps[0]), int(steps[-1]) + 1)
        (everything,) = self._source.blocks(1)
        block = self._source.read(frames, everything, [])
        keep = steps - frames.start
        fields = {name: values[keep] for name, values in block.fields.items()}
        there = np.ones((len(steps), len(block.gid)), bool)
        return Restored(steps, steps.astype(np.float64), block.gid, there, fields)
