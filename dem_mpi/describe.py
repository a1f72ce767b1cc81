"""What is in a file of this program and whether it is whole, for `dem-mpi info`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from dem_mpi import checkpoint
from dem_mpi.errors import DataError
from dem_mpi.h5files import (
    HDF5_ERRORS,
    attributes_checksum,
    dataset_checksum,
    lock_holder,
    open_checked,
    read_attribute,
    read_attributes,
    readable_size,
    reason,
    row_blocks,
)
from dem_mpi.seal import check_seal
from dem_mpi.trajectory import (
    FORMAT,
    TOPOLOGIES,
    Field,
    FrameIndex,
    Series,
    check_series,
    expected_checksums,
    raise_on_mismatch,
    read_fields,
    read_index,
    read_series,
    root_attributes,
)

_FLOW = "stokes flow"  # the format that `stokes.flow_file` writes
_ARCHIVE = "tensor archive"  # the format that `compress.archive` writes


@dataclass(frozen=True)
class Description:
    """What a file holds, for people: `exit_code` is 0 if it is valid and 65 if it is not."""

    path: Path
    kind: str  # "trajectory", "checkpoint", "archive", "flow" or "unknown"
    valid: bool
    reason: str  # why it is not valid, "" if it is
    size: int  # [B]
    complete: bool = False  # a trajectory that was sealed, a checkpoint that is valid
    writer: str = ""  # the process that writes it now
    frames: int = 0
    bodies: tuple[int, int] = (0, 0)  # fewest and most in a frame
    steps: tuple[int, int] = (0, 0)  # first and last
    times: tuple[float, float] = (0.0, 0.0)  # [s]
    fields: tuple[Field, ...] = ()
    series: tuple[Series, ...] = ()
    ranks: int = 0  # that wrote a checkpoint
    version: str = ""
    scene: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # of an archive or a flow

    @property
    def exit_code(self) -> int:
        """0 for a valid file, 65 for another."""
        return 0 if self.valid else DataError.exit_code

    def lines(self) -> list[str]:
        """What there is to say, one fact a line."""
        verdict = "valid" if self.valid else f"not valid: {self.reason}"
        lines = [f"{self.path}: {self.kind}, {readable_size(self.size)}, {verdict}"]
        if self.writer:
            lines.append(f"  being written by {self.writer}")
        if self.kind in ("archive", "flow", "unknown") or not (self.frames or self.fields):
            return lines + [f"  {note}" for note in self.notes]
        if self.scene or self.version:
            lines.append(f"  scene {self.scene or '(no name)'}, by dem-mpi {self.version}")
        fewest, most = self.bodies
        bodies = f"{most:,}" if fewest == most else f"{fewest:,} to {most:,}"
        if self.kind == "checkpoint":
            ranks = f", saved by {self.ranks} ranks" if self.ranks else ""
            lines.append(f"  step {self.steps[0]}, t = {self.times[0]:.6g} s{ranks}")
            return [*lines, f"  {bodies} bodies"]
        state = "complete" if self.complete else "not complete: the run goes on or was ended"
        lines.append(f"  {self.frames:,} frames, {state}")
        if self.frames:
            (first, last), (start, end) = self.steps, self.times
            lines.append(f"  steps {first} to {last}, t = {start:.6g} to {end:.6g} s")
            lines.append(f"  {bodies} bodies")
        lines += [f"  {f.name} ({f.dtype}, {f.width}) [{f.unit}]" for f in self.fields]
        return lines + [f"  {s.name} {s.row_shape} a frame [{s.unit}]" for s in self.series]


def describe(path: Path | str, *, verify: bool = True) -> Description:
    """What a trajectory or checkpoint holds and whether it is valid; reads all of it to `verify`.

    Raises InputError (64) if there is no such file. A file that is being written can be read.
    """
    path = Path(path)
    size = path.stat().st_size if path.is_file() else 0
    found = Description(path, "unknown", False, "", size, writer=lock_holder(path))
    try:
        if path.is_file():
            check_seal(path)
        with open_checked(path) as file:
            kind = read_attributes(file).get("format")
            if kind == FORMAT:
                found = replace(found, kind="trajectory")
                return _describe_trajectory(path, file, found, verify)
            if kind == _FLOW:
                return _describe_flow(path, replace(found, kind="flow"))
            if kind == _ARCHIVE:
                return _describe_archive(path, replace(found, kind="archive"), verify)
            if kind != checkpoint.FORMAT:
                raise DataError(
                    f"{path}: neither a trajectory nor a checkpoint nor an archive nor a flow of "
                    "dem-mpi"
                )
        found = replace(found, kind="checkpoint")
        return _describe_checkpoint(path, found)
    except DataError as error:
        return replace(found, reason=str(error).removeprefix(f"{path}: "))
    except HDF5_ERRORS as error:
        return replace(found, reason=f"damaged: {reason(error)}")


def _describe_trajectory(
    path: Path, file: h5py.File, found: Description, verify: bool
) -> Description:
    attributes = read_attributes(file)
    fields = read_fields(path, file)
    index = read_index(path, file)
    series = read_series(path, file)
    found = replace(
        found,
        complete=bool(attributes.get("complete", 0)),
        frames=len(index),
        fields=fields,
        series=series,
        version=str(attributes.get("version", "")),
        scene=_scene_name(attributes),
        attributes=attributes,
    )
    if len(index):
        found = replace(
            found,
            bodies=(int(index.count.min()), int(index.count.max())),
            steps=(int(index.step[0]), int(index.step[-1])),
            times=(float(index.time[0]), float(index.time[-1])),
        )
    try:
        if verify:
            _verify_frames(path, file, fields, index)
            check_series(path, file, series, index)
            _verify_layout(path, file, index)
            if attributes_checksum(root_attributes(file)) != attributes.get("checksum"):
                raise DataError(f"{path}: checksum of the attributes does not match")
    except DataError as error:
        return replace(found, reason=str(error).removeprefix(f"{path}: "))
    return replace(found, valid=True)


def _verify_frames(path: Path, file: h5py.File, fields: Sequence[Field], index: FrameIndex) -> None:
    """Compare every checksum; a frame at a time, so that the memory is that of a block."""
    expected = expected_checksums(file, fields, range(len(index)))
    for k in range(len(index)):
        start, stop = int(index.offset[k]), int(index.offset[k] + index.count[k])
        sums = np.array(
            [[dataset_checksum(file[f.place], start, stop) for f in fields]], dtype=np.uint64
        )
        raise_on_mismatch(path, fields, index, range(k, k + 1), sums, expected[k : k + 1])


def _verify_layout(path: Path, file: h5py.File, index: FrameIndex) -> None:
    """Compare what only VTK reads with what it must be."""
    n = len(index)
    cells = (index.count > 0).astype(np.int64)
    zeros, first_cell = np.zeros(n, dtype=np.int64), np.cumsum(cells) - cells
    steps, vertices = "VTKHDF/Steps", "VTKHDF/Vertices"
    offsets = np.zeros(int(cells.sum()) + n, dtype=np.int64)
    offsets[(first_cell + np.arange(n) + 1)[cells > 0]] = index.count[cells > 0]
    expected = {
        f"{steps}/PartOffsets": np.arange(n),
        f"{steps}/NumberOfParts": zeros + 1,
        f"{steps}/CellOffsets": np.stack([first_cell, zeros, zeros, zeros], axis=1),
        f"{steps}/ConnectivityIdOffsets": np.zeros((n, 4)),
        f"{vertices}/NumberOfCells": cells,
        f"{vertices}/NumberOfConnectivityIds": index.count,
        f"{vertices}/Offsets": offsets,
    }
    for name in TOPOLOGIES[1:]:
        for part in ("NumberOfCells", "NumberOfConnectivityIds", "Offsets"):
            expected[f"VTKHDF/{name}/{part}"] = zeros
    for name, values in expected.items():
        if not np.array_equal(file[name][: len(values)], values):
            raise DataError(f"{path}: '{name}' contradicts 'frames/count'")
    connectivity = file[f"{vertices}/Connectivity"]
    for start, stop in row_blocks(0, int(index.count.max(initial=0)), 8):
        if not np.array_equal(connectivity[start:stop], np.arange(start, stop)):
            raise DataError(f"{path}: '{connectivity.name}' is not 0, 1, 2, …")


def _describe_checkpoint(path: Path, found: Description) -> Description:
    problem = checkpoint.find_damage(path)
    if problem:
        return replace(found, reason=problem)
    with open_checked(path) as file:
        attributes = checkpoint.read_attributes_of(file)
        step, ranks = int(read_attribute(file, "step")), int(read_attribute(file, "ranks"))
        time = float(attributes.get("time", 0.0))
        bodies = int(file["rows/bodies"][:].sum()) if "rows/bodies" in file else 0
    return replace(
        found,
        valid=True,
        complete=True,
        frames=1,
        bodies=(bodies, bodies),
        steps=(step, step),
        times=(time, time),
        ranks=ranks,
        version=str(attributes.get("version", "")),
        scene=_scene_name(attributes),
        attributes=attributes,
    )


def _describe_flow(path: Path, found: Description) -> Description:
    """What is in a file of `dem-mpi flow`, all of it read, for its data sets check themselves."""
    from stokes.flow_file import read_flow

    try:
        flow = read_flow(path)
    except ValueError as error:
        return replace(found, reason=str(error).removeprefix(f"{path}: "))
    get = flow.attributes.get
    points = 0 if flow.field is None else len(flow.field.velocity)
    solved = "converged" if get("converged") else f"NOT CONVERGED, {get('reason', '')}"
    notes = [f"{len(flow.bodies['position']):,} bodies, {len(flow.surfaces.position):,} nodes"]
    notes[0] += f", {points:,} points of the field" if points else ""
    if "source" in flow.attributes:
        notes.append(f"of {get('source')}, frame {get('frame')}, t = {get('time'):.6g} s")
    if "problem" in flow.attributes:
        notes.append(
            f"{get('problem')}, {solved}: {get('iterations')} iterations, residual "
            f"{get('residual'):.2e}, tolerance {get('tolerance'):g}"
        )
    return replace(found, valid=True, complete=True, notes=tuple(notes), attributes=flow.attributes)


def _describe_archive(path: Path, found: Description, verify: bool) -> Description:
    """What is in an archive; all checksums are compared to `verify`, nothing is decoded."""
    from compress.archive import Archive
    from dem_mpi.compression import ArchiveFacts

    with Archive(path) as archive:
        if verify:
            archive.verify()
        steps, times, provenance = archive.steps, archive.times, archive.provenance
        complete, bodies = archive.complete, len(archive.gid)
        settings = archive.settings
    facts = ArchiveFacts.of(path)
    state = "complete" if complete else "not complete: it is being written or was interrupted"
    notes = []
    if "source" in provenance:
        notes.append(f"of {provenance['source']}")
    elif "version" in provenance:
        name = _scene_name(provenance) or "(no name)"
        notes.append(f"of a run of scene {name}, by dem-mpi {provenance['version']}")
    notes.append(f"{len(steps):,} frames in {facts.chunks:,} chunks, {state}")
    if len(steps):
        notes.append(f"steps {steps[0]} to {steps[-1]}, t = {times[0]:.6g} to {times[-1]:.6g} s")
    notes.append(f"{bodies:,} bodies")
    notes += facts.field_lines()
    if settings.floor:
        notes.append(f"floor {settings.floor:g}")
    if facts.raw:
        size = f"{readable_size(facts.coded)} for {readable_size(facts.raw)}"
        notes += [f"{size}, {facts.comparison}", facts.coder_line()]
    return replace(
        found,
        valid=True,
        complete=complete,
        frames=len(steps),
        bodies=(bodies, bodies),
        steps=(int(steps[0]), int(steps[-1])) if len(steps) else (0, 0),
        times=(float(times[0]), float(times[-1])) if len(steps) else (0.0, 0.0),
        notes=tuple(notes),
        attributes=provenance,
    )


def _scene_name(attributes: Mapping[str, Any]) -> str:
    """The name in the effective scene, which is stored as JSON."""
    try:
        scene = json.loads(attributes.get("scene", "{}"))
        return str(scene.get("name", ""))
    except (ValueError, TypeError, AttributeError, RecursionError):
        return ""
