"""`dem-mpi restore`, `slice` and `compare`: what is in an archive, as much as is asked for."""

from __future__ import annotations

import contextlib
import csv
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compress.archive import Archive, Restored
from compress.bounds import Errors, measure
from dem_mpi import __version__
from dem_mpi.array_source import ArraySource, is_array
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


def _require_bodies(archive: Archive, selection: Selection, found: Restored) -> None:
    if not len(found.gid):
        gid = archive.gid
        held = f"gids {gid[0]} to {gid[-1]}" if len(gid) else "no bodies"
        raise InputError(
            f"--bodies {range_text(selection.bodies)}: {archive.path} holds {held}, none of these "
            "in these steps"
        )


# ---- restore -------------------------------------------------------------------------------


def restore_file(
    path: Path, selection: Selection, out: Path | None, force: bool, say: Callable[[str], None]
) -> None:
    """Decode what is selected into a trajectory (.h5), or arrays (.npz, .npy)."""
    with Archive(path) as archive:
        names, frames = _names(archive, selection), frames_of(archive, selection.steps)
        out = _place(archive, names, out, force)
        # It takes its name when it is whole: damage may show half-way.
        part = out.with_name(f"{out.name}.part")
        try:
            rows = _WRITERS[out.suffix](archive, names, frames, selection, part)
            with agree(Parallel.alone(), out, "write"):
                part.replace(out)
        finally:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
    size = readable_size(out.stat().st_size)
    count = frames.stop - frames.start
    say(f"wrote {out}: {count:,} frames, {rows:,} bodies, {', '.join(names)}; {size}")


def _place(archive: Archive, names: tuple[str, ...], out: Path | None, force: bool) -> Path:
    """Where to write. InputError for a file that cannot hold the fields, or may not be written."""
    path = archive.path
    placed = "position" in names and not archive.fields["position"].shape
    if out is None:
        out = path.with_name(f"{path.name.split('.')[0]}.restored{'.h5' if placed else '.npz'}")
    if out.suffix not in _WRITERS:
        raise InputError(f"--output {out}: must end in {', '.join(_WRITERS)}")
    refuse_place("--output", out, force)
    if out.exists() and out.samefile(path):
        raise InputError(f"--output {out}: is the archive itself")
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
    archive: Archive, names: tuple[str, ...], frames: slice, selection: Selection, out: Path
) -> int:
    """A file that the run itself could have written, but for the errors; a chunk at a time."""
    parallel = Parallel.alone()
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
    trajectory, most = None, 0
    try:
        for part in archive.iterate(names, frames, bodies_of(selection.bodies)):
            if trajectory is None:
                _require_bodies(archive, selection, part)
                trajectory = Trajectory.create(
                    parallel, out, fields, attributes, bodies=len(part.gid)
                )
            for k, step in enumerate(part.steps.tolist()):
                there = part.present[k]
                rows = {name: values[k, there] for name, values in part.fields.items()}
                rows["gid"] = part.gid[there]
                most = max(most, len(rows["gid"]))
                trajectory.write_frame(step, float(part.times[k]), rows)
        assert trajectory is not None
        trajectory.seal()
    finally:
        if trajectory is not None:
            trajectory.close()
    return most


def _write_array(
    archive: Archive, names: tuple[str, ...], frames: slice, selection: Selection, out: Path
) -> int:
    """An array (T, m, w), or of the shape it had, chunk by chunk; NaN where a body is not there."""
    (name,) = names
    spec = archive.fields[name]
    whole = bool(spec.shape) and selection.bodies == ALL
    with agree(Parallel.alone(), out, "write"):
        gid, array, done = None, None, 0
        bodies = bodies_of(selection.bodies)
        for part in archive.iterate([name], frames, bodies):
            if array is None:
                gid = _all_gids(archive, bodies)
                _require_bodies(archive, selection, part)
                tail = spec.shape if whole else (len(gid), *([spec.width] * (spec.width > 1)))
                array = np.lib.format.open_memmap(
                    out, "w+", np.dtype(spec.dtype), (frames.stop - frames.start, *tail)
                )
            assert gid is not None
            rows = np.zeros((len(part.steps), len(gid), spec.width), spec.dtype)
            if rows.dtype.kind == "f":
                rows[:] = np.nan
            rows[:, np.searchsorted(gid, part.gid)] = part.fields[name]
            array[done : done + len(rows)] = rows.reshape(len(rows), *array.shape[1:])
            done += len(rows)
        array.flush()
    return len(gid)


def _all_gids(archive: Archive, bodies: slice | None) -> NDArray:
    """Gids of all bodies of the archive that lie in a range."""
    gid = archive.gid
    if bodies is not None:
        low = 0 if bodies.start is None else bodies.start
        high = np.iinfo(np.int64).max if bodies.stop is None else bodies.stop
        gid = gid[(gid >= low) & (gid < high)]
    return gid


def _write_arrays(
    archive: Archive, names: tuple[str, ...], frames: slice, selection: Selection, out: Path
) -> int:
    """All in one file of arrays: step, time, gid, present, and the fields."""
    found = archive.read(names, frames, bodies_of(selection.bodies))
    _require_bodies(archive, selection, found)
    arrays = {"step": found.steps, "time": found.times, "gid": found.gid, "present": found.present}
    for name, values in found.fields.items():
        spec = archive.fields[name]
        if spec.shape and selection.bodies == ALL:
            arrays[name] = values.reshape(len(values), *spec.shape)
        else:
            arrays[name] = values[:, :, 0] if spec.width == 1 else values
    # Given its name numpy would write to one with another ending.
    with agree(Parallel.alone(), out, "write"), out.open("wb") as file:
        np.savez(file, **arrays)
    return len(found.gid)


_WRITERS = {".h5": _write_trajectory, ".npz": _write_arrays, ".npy": _write_array}


# ---- slice ---------------------------------------------------------------------------------


def slice_file(
    path: Path, selection: Selection, out: Path | None, force: bool, say: Callable[[str], None]
) -> None:
    """Print a few values, a row for each body and step, or write them as CSV."""
    with Archive(path) as archive:
        names, frames = _names(archive, selection), frames_of(archive, selection.steps)
        if out is not None:
            refuse_place("--output", out, force)
        found = archive.read(names, frames, bodies_of(selection.bodies))
        _require_bodies(archive, selection, found)
        specs = archive.fields
    rows = int(found.present.sum())
    if out is None and rows > _MOST_ROWS:
        raise InputError(
            f"{rows:,} rows are too many to print: ask for fewer with --steps and --bodies, or "
            "give --output FILE.csv, or use dem-mpi restore"
        )
    titles = ["step", "time", "gid"]
    for name in names:
        w = specs[name].width
        titles += [name] if w == 1 else [f"{name}_{'xyz'[k] if w == 3 else k}" for k in range(w)]
    if out is None:
        say("  ".join(titles))
        for row in _rows(found, names):
            say("  ".join(row))
        return
    with agree(Parallel.alone(), out, "write"), out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(titles)
        writer.writerows(_rows(found, names))
    say(f"wrote {out}: {rows:,} rows")


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
    with _open_values(str(first)) as a, _open_values(str(second)) as b:
        names = [name for name in a.names if name in b.names]
        if len(a.names) == len(b.names) == 1:  # arrays, whatever they are called
            pairs = [(a.names[0], b.names[0])]
        else:
            if fields.fields is not None:
                choose("--fields", fields.fields, names, f"both {first} and {second}")
                names = [name for name in names if name in fields.fields]
            pairs = [(name, name) for name in names]
        if not pairs:
            raise InputError(
                f"{second}: has no field of {first}: {', '.join(b.names)} and {', '.join(a.names)}"
            )
        steps = np.intersect1d(a.steps, b.steps)
        if not len(steps):
            raise InputError(f"{second}: has no step of {first}")
        total = {pair: Errors() for pair in pairs}
        alone = 0
        for k in range(0, len(steps), a.chunk):
            some = steps[k : k + a.chunk]
            left, right = a.read(some, [x for x, _ in pairs]), b.read(some, [y for _, y in pairs])
            _, i, j = np.intersect1d(left.gid, right.gid, return_indices=True)
            both = left.present[:, i] & right.present[:, j]
            alone += int(left.present.sum() + right.present.sum() - 2 * both.sum())
            for x, y in pairs:
                one, other = left.fields[x][:, i][both], right.fields[y][:, j][both]
                if one.shape != other.shape:
                    raise InputError(f"{second}: {y} has another width than in {first}")
                total[x, y] = total[x, y] + measure(one, other)
    lines = [f"{len(steps):,} steps that both have, {second} against {first}"]
    lines += [_comparison(x if x == y else f"{x} and {y}", e) for (x, y), e in total.items()]
    if alone:
        lines.append(f"note: {alone:,} rows are in one of them only")
    return lines


def _comparison(name: str, errors: Errors) -> str:
    if errors.frobenius == 0.0:
        return f"  {name}: equal, {errors.count:,} numbers"
    return (
        f"  {name}: relative {errors.relative:.4e}, rms {errors.rmse:.4e}, of the range "
        f"{errors.nrmse:.4e}, at most {errors.maximum:.4e}; {errors.count:,} numbers"
    )


def _open_values(path: str) -> _ArchiveValues | _TrajectoryValues | _ArrayValues:
    if is_array(path):
        return _ArrayValues(path)
    from dem_mpi.h5files import open_checked
    from dem_mpi.trajectory import FORMAT

    with open_checked(path) as file:
        trajectory = read_attributes(file).get("format") == FORMAT
    return _TrajectoryValues(path) if trajectory else _ArchiveValues(path)


class _ArchiveValues:
    """An archive as `compare_files` reads it."""

    def __init__(self, path: str) -> None:
        self._archive = Archive(path)
        self.names = list(self._archive.fields)
        self.steps = self._archive.steps
        self.chunk = max((c.stop - c.start for c in self._archive.chunks), default=1)

    def __enter__(self) -> _ArchiveValues:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def read(self, steps: NDArray, names: list[str]) -> Restored:
        """Fields of these steps."""
        k = np.searchsorted(self.steps, steps)
        found = self._archive.read(names, slice(int(k[0]), int(k[-1]) + 1))
        if len(found.steps) == len(steps):
            return found
        keep = np.isin(found.steps, steps)
        fields = {name: values[keep] for name, values in found.fields.items()}
        return Restored(
            found.steps[keep], found.times[keep], found.gid, found.present[keep], fields
        )


class _TrajectoryValues:
    """A trajectory as `compare_files` reads it."""

    chunk = 16

    def __init__(self, path: str) -> None:
        self._file = TrajectoryChunks(path)
        self.names = [name for name in self._file.fields if name != "gid"]
        self.steps = self._file.index.step

    def __enter__(self) -> _TrajectoryValues:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, steps: NDArray, names: list[str]) -> Restored:
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
    """An array as `compare_files` reads it."""

    chunk = 16

    def __init__(self, path: str) -> None:
        self._source = ArraySource(CompressOptions(path))
        self.names = list(self._source.specs)
        self.steps = self._source.steps

    def __enter__(self) -> _ArrayValues:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()

    def read(self, steps: NDArray, names: list[str]) -> Restored:
        """The array of these steps."""
        frames = range(int(steps[0]), int(steps[-1]) + 1)
        (everything,) = self._source.blocks(1)
        block = self._source.read(frames, everything, [])
        keep = steps - frames.start
        fields = {name: values[keep] for name, values in block.fields.items()}
        there = np.ones((len(steps), len(block.gid)), bool)
        return Restored(steps, steps.astype(np.float64), block.gid, there, fields)
