"""From a trajectory to the later stages: the bodies of a frame, as `stokes` takes them.

The only place where rows of a trajectory become bodies of a fluid; `stokes` is imported when these
are asked for. What a scene has besides bodies, walls and periodic copies, is not handed over.

Bodies that touch have no boundary-integral solution: the film between them would be of no
thickness. They are handed over smaller, all by one factor, each about its own centre.

Symbols: n bodies of a frame that are handed over, in order of gid.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np
from numpy.typing import NDArray

from dem_mpi import shapes
from dem_mpi.bodies import FIELDS
from dem_mpi.errors import DataError, InputError
from dem_mpi.h5files import checksum, open_checked, read_attributes, row_blocks
from dem_mpi.parallel import Parallel
from dem_mpi.scene_bodies import SHAPES
from dem_mpi.trajectory import (
    Field,
    FrameIndex,
    expected_checksums,
    raise_on_mismatch,
    read_fields,
    read_index,
)

if TYPE_CHECKING:
    from stokes.geometry import Body, Curve

_REQUIRED = ("position", "gid", "radius")
_OF_OTHER_SHAPES = ("shape", "half_length", "orientation")
_MOTION = ("velocity", "angular_velocity")

# Gaps are counted in radii of the smaller body: of a rod's caps, of a spheroid's equator.
LEAST_GAP = 1e-2  # that `auto` leaves between bodies
SMALLEST_GAP = 1e-3  # that there is a solution for
_SMALLEST_FACTOR = 0.1  # bodies that overlap so deeply are no bodies of a packing
_FACTOR_ERROR = 1e-9  # of a factor found by bisection
_ROUND_OFF = 1e-9  # of a gap between places that are numbers
_RATIO_DIGITS = 12  # bodies whose aspect ratios agree so far have one curve
_SMOOTHING = 0.2  # of the curvature where caps of rods begin, in radii


@dataclass(frozen=True)
class Selection:
    """Which bodies of a frame to take: both conditions hold where both are given.

    gids   : (k, 2) first and last gid of ranges, or None for all
    region : (x0, x1, y0, y1, z0, z1) [m] that holds the centre, or None for everywhere
    """

    gids: tuple[tuple[int, int], ...] | None = None
    region: tuple[float, float, float, float, float, float] | None = None

    def holds(self, gid: NDArray, position: NDArray) -> NDArray:
        """Whether (n,) bodies of gid (n,) at position (n, 3) [m] are taken."""
        chosen = np.ones(len(gid), dtype=bool)
        if self.gids is not None:
            first, last = np.array(self.gids, dtype=np.int64).T
            # Ranges are sorted and apart: the last that begins at or before a gid may hold it.
            k = np.searchsorted(first, gid, side="right") - 1
            chosen &= (k >= 0) & (gid <= last[k])
        if self.region is not None:
            low, high = np.reshape(self.region, (3, 2)).T
            chosen &= ((position >= low) & (position <= high)).all(axis=1)
        return chosen


@dataclass(frozen=True)
class SceneFacts:
    """What a trajectory says of its scene: None or empty where it says nothing.

    only_spheres : whether all bodies are; gravity : (3,) [m/s^2]; density : (materials,) [kg/m^3];
    periodic : axes; walls : their number
    """

    name: str = ""
    only_spheres: bool | None = None
    gravity: tuple[float, float, float] | None = None
    density: tuple[float, ...] = ()
    periodic: tuple[str, ...] = ()
    walls: int = 0


@dataclass(frozen=True)
class FrameBodies:
    """Bodies of one frame in order of gid, sizes and motion as in `bodies.Bodies`.

    frame, frames, step, time [s] : which frame, of how many; total : bodies that it holds in all
    density : (n,) [kg/m^3], None where the file does not tell
    assumed : what the file does not hold and was taken to be, one sentence each
    """

    path: Path
    frame: int
    frames: int
    step: int
    time: float
    total: int
    scene: SceneFacts
    gid: NDArray[np.int64]
    shape: NDArray[np.int8]
    radius: NDArray[np.float64]
    half_length: NDArray[np.float64]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]
    velocity: NDArray[np.float64] | None
    angular_velocity: NDArray[np.float64] | None
    density: NDArray[np.float64] | None
    assumed: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.gid)

    def take(self, rows: NDArray) -> FrameBodies:
        """These rows alone, of every column."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(
            self, **{k: v[rows] for k, v in columns.items() if isinstance(v, np.ndarray)}
        )

    @property
    def volume(self) -> NDArray:
        """(n,) [m^3] of the bodies as they are in the run."""
        return shapes.volume(self.shape, self.radius, self.half_length)

    @property
    def counts(self) -> dict[str, int]:
        """How many of each shape there are, of those that there are."""
        number = np.bincount(self.shape, minlength=len(SHAPES))
        return {name: int(n) for name, n in zip(SHAPES, number, strict=True) if n}


# ---- what to take --------------------------------------------------------------------------


def parse_gids(text: str) -> tuple[tuple[int, int], ...]:
    """Ranges (first, last) of gids, sorted and apart, from a text such as "3 7-12, 40".

    Raises InputError for what is no gid or range.
    """
    ranges = []
    for word in text.replace(",", " ").split():
        first, dash, last = word.partition("-")
        if not (first.isdecimal() and (last.isdecimal() if dash else not last)):
            raise InputError(f"--bodies {word}: must be a gid such as 7 or a range such as 7-12")
        pair = (int(first), int(last or first))
        if pair[0] > pair[1]:
            raise InputError(f"--bodies {word}: a range goes from the lower gid to the higher")
        if pair[1] >= 2**63:
            raise InputError(f"--bodies {word}: no gid is that large")
        ranges.append(pair)
    if not ranges:
        raise InputError("--bodies '': must name at least one gid")
    joined = [min(ranges)]
    for first, last in sorted(ranges):
        if first <= joined[-1][1] + 1:
            joined[-1] = (joined[-1][0], max(joined[-1][1], last))
        else:
            joined.append((first, last))
    return tuple(joined)


def find_frame(index: FrameIndex, frame: str, path: Path) -> int:
    """The number of a frame: of "last", of a number from 0, or nearest to a time such as 0.5.

    A whole number is a frame, one with a point, an exponent or an s behind it a time [s].
    Raises InputError where there is no such frame, DataError where there is none at all.
    """
    if not len(index):
        raise DataError(f"{path}: holds no complete frame")
    if frame == "last":
        return len(index) - 1
    if frame.isdecimal():
        if int(frame) >= len(index):
            raise InputError(f"--frame {frame}: {path} holds {len(index)}, numbered from 0")
        return int(frame)
    try:
        time = float(frame.removesuffix("s"))
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise InputError(f"--frame {frame}: must be last, a number from 0, or a time such as 0.5s")
    if not index.time[0] <= time <= index.time[-1]:
        raise InputError(
            f"--frame {frame}: {path} goes from t = {index.time[0]:g} s to {index.time[-1]:g} s"
        )
    return int(np.argmin(np.abs(index.time - time)))


# ---- reading -------------------------------------------------------------------------------


def load_bodies(
    parallel: Parallel, path: Path, frame: str, selection: Selection, moving: bool
) -> FrameBodies:
    """Collective. The bodies of a frame that are selected, the same on every rank.

    frame : see `find_frame`; moving : whether their velocities are needed. Rank 0 reads, a block
    of rows at a time. Raises InputError (64) where the frame, a body or a column is missing,
    DataError (65) for a damaged file.
    """
    found, error = None, None
    if parallel.rank == 0:
        try:
            found = read_bodies(path, frame, selection, moving)
        except (InputError, DataError) as caught:
            error = caught
    parallel.raise_together(error)
    return parallel.broadcast(found)


def read_bodies(path: Path, frame: str, selection: Selection, moving: bool) -> FrameBodies:
    """As `load_bodies`, on one rank."""
    path = Path(path)
    with open_checked(path) as file:
        index = read_index(path, file)
        k = find_frame(index, frame, path)
        scene = _scene_facts(path, file)
        wanted = _fields_to_read(path, read_fields(path, file), scene, moving)
        columns = _selected_rows(path, file, wanted, index, k, selection)
    columns = {name: rows[np.argsort(columns["gid"])] for name, rows in columns.items()}
    _check_selection(path, k, selection, columns["gid"])
    _check_columns(path, columns)
    assumed = []
    if moving and "angular_velocity" not in columns:
        columns["angular_velocity"] = np.zeros((len(columns["gid"]), 3))
        assumed.append(
            f"{path.name} holds no angular_velocity: the bodies are taken not to turn "
            "(output.fields of the scene)"
        )
    n = len(columns["gid"])
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return FrameBodies(
        path=path,
        frame=k,
        frames=len(index),
        step=int(index.step[k]),
        time=float(index.time[k]),
        total=int(index.count[k]),
        scene=scene,
        gid=columns["gid"],
        shape=columns.get("shape", np.zeros(n, np.int8)),
        radius=columns["radius"],
        half_length=columns.get("half_length", np.zeros(n)),
        position=columns["position"],
        orientation=columns.get("orientation", identity),
        velocity=columns.get("velocity"),
        angular_velocity=columns.get("angular_velocity"),
        density=_density(scene, columns),
        assumed=tuple(assumed),
    )


def _scene_facts(path: Path, file: h5py.File) -> SceneFacts:
    text = read_attributes(file).get("scene")
    if text is None:
        return SceneFacts()
    try:
        scene = json.loads(text)
        gravity = scene.get("gravity")
        return SceneFacts(
            name=str(scene.get("name", "")),
            only_spheres=all(g.get("shape", "sphere") == "sphere" for g in scene["bodies"]),
            gravity=None if gravity is None else tuple(float(x) for x in gravity),
            density=tuple(float(m["density"]) for m in scene.get("materials", {}).values()),
            periodic=tuple(scene.get("domain", {}).get("periodic", ())),
            walls=len(scene.get("walls", ())),
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        raise DataError(f"{path}: attribute 'scene' is no scene") from None


def _fields_to_read(
    path: Path, fields: Sequence[Field], scene: SceneFacts, moving: bool
) -> tuple[Field, ...]:
    """The columns that are needed and those that help. InputError names one that is missing."""
    known = {f.name: f for f in fields}
    only_spheres = "shape" not in known if scene.only_spheres is None else scene.only_spheres
    needed = [*_REQUIRED, *(["velocity"] if moving else [])]
    needed += [] if only_spheres else _OF_OTHER_SHAPES
    missing = [name for name in needed if name not in known]
    if missing:
        raise InputError(
            f"{path}: holds no {', '.join(missing)}: list {'them' if len(missing) > 1 else 'it'} "
            "in output.fields of the scene and run it again"
        )
    wanted = [*needed, *_OF_OTHER_SHAPES, "material", *(_MOTION if moving else ())]
    chosen = [known[name] for name in dict.fromkeys(wanted) if name in known]
    for f in chosen:
        width = FIELDS[f.name].row_shape[0] if FIELDS[f.name].row_shape else 1
        if f.width != width or np.dtype(f.dtype) != np.dtype(FIELDS[f.name].dtype):
            raise DataError(f"{path}: '{f.name}' is {f.dtype} of width {f.width}, not as written")
    return tuple(chosen)


def _selected_rows(
    path: Path,
    file: h5py.File,
    fields: Sequence[Field],
    index: FrameIndex,
    k: int,
    selection: Selection,
) -> dict[str, NDArray]:
    """The selected rows of frame k, read once in blocks and held against the checksums."""
    start, count = int(index.offset[k]), int(index.count[k])
    sums = [0] * len(fields)
    parts: list[dict[str, NDArray]] = []
    for first, last in row_blocks(0, count, sum(f.row_bytes for f in fields)):
        block = {f.name: file[f.place][start + first : start + last] for f in fields}
        for i, f in enumerate(fields):
            sums[i] = (sums[i] + checksum(block[f.name], first)) % 2**64
        chosen = selection.holds(block["gid"], block["position"])
        parts.append({name: rows[chosen] for name, rows in block.items()})
    expected = expected_checksums(file, fields, range(k, k + 1))
    actual = np.array([sums], dtype=np.uint64)
    raise_on_mismatch(path, fields, index, range(k, k + 1), actual, expected)
    return {
        f.name: np.concatenate([np.zeros(f.shape(0), f.dtype), *(part[f.name] for part in parts)])
        for f in fields
    }


def _check_columns(path: Path, columns: dict[str, NDArray]) -> None:
    """Raise DataError if a row is no body; make quaternions of length 1. There are some rows."""
    gid = columns["gid"]
    good = {name: np.isfinite(rows) for name, rows in columns.items() if rows.dtype.kind == "f"}
    good["radius"] &= columns["radius"] > 0.0
    if "shape" in columns:
        shape = columns["shape"]
        good["shape"] = (shape >= 0) & (shape < len(SHAPES))
        if "half_length" in columns:
            good["half_length"] &= (shape == shapes.SPHERE) | (columns["half_length"] > 0.0)
    if "orientation" in columns:
        length = np.linalg.norm(columns["orientation"], axis=1, keepdims=True)
        good["orientation"] &= np.abs(length - 1.0) < 1e-6
    good["gid"] = np.append(True, np.diff(gid) > 0)
    for name, rows in good.items():
        wrong = ~rows.reshape(len(gid), -1).all(axis=1)
        if wrong.any():
            i = int(np.argmax(wrong))
            raise DataError(f"{path}: body {gid[i]}: {name} = {columns[name][i]} is not possible")
    if "orientation" in columns:
        columns["orientation"] = columns["orientation"] / length


def _check_selection(path: Path, k: int, selection: Selection, gid: NDArray) -> None:
    """Raise InputError where nothing is selected, or a body that is asked for is not there."""
    if selection.region is None:
        for first, last in selection.gids or ():
            # A range may have gaps, for bodies can have been taken out of the run.
            found = np.searchsorted(gid, first) < np.searchsorted(gid, last, side="right")
            if not found:
                name = f"{first}" if first == last else f"{first}-{last}"
                raise InputError(f"--bodies {name}: no such body in frame {k} of {path}")
    if not len(gid):
        named = " and ".join(
            name
            for name, value in (("--bodies", selection.gids), ("--region", selection.region))
            if value is not None
        )
        raise InputError(f"{named or path}: no body in frame {k}")


def _density(scene: SceneFacts, columns: dict[str, NDArray]) -> NDArray | None:
    """Density (n,) [kg/m^3] of the bodies, where the file tells it."""
    n, known = len(columns["gid"]), np.array(scene.density)
    if "material" in columns and len(known) > columns["material"].max(initial=-1):
        return known[columns["material"]]
    return np.full(n, known[0]) if len(known) and (known == known[0]).all() else None


# ---- room between bodies -------------------------------------------------------------------


@dataclass(frozen=True)
class Shrinkage:
    """By what factor the bodies are smaller than in the run, and what decides it.

    factor : of all lengths, about each body's own centre
    gap    : least gap at that factor, in radii of the smaller body of that pair; infinite where
             no bodies are nearer than a radius of the largest
    pair   : gids of the bodies that have it, empty where there are none
    """

    factor: float
    gap: float = math.inf
    pair: tuple[int, ...] = ()


def shrinkage(bodies: FrameBodies, factor: float | None = None) -> Shrinkage:
    """The largest factor <= 1 that leaves `LEAST_GAP` between all bodies, or the one that is given.

    Exact for spheres; for other bodies by bisection with `stokes.distance`, to 1e-9 and from
    below. Raises InputError where bodies are nearer than `SMALLEST_GAP` at the factor that is
    given, or overlap so much that next to nothing would be left of them.
    """
    pairs = _near_pairs(bodies)
    if factor is not None:
        found = _least(bodies, pairs, factor)
        if found.gap < (1.0 - _ROUND_OFF) * SMALLEST_GAP:
            near = f"are {found.gap:.2g} radii apart" if found.gap > 0.0 else "touch or overlap"
            raise InputError(
                f"--hydrodynamic-radius {factor:g}: bodies {found.pair[0]} and {found.pair[1]} "
                f"{near}, at least {SMALLEST_GAP:g} is needed; auto takes "
                f"{shrinkage(bodies).factor:.6g}"
            )
        return found
    if not bodies.shape.any():
        best = _sphere_factor(bodies, pairs)
    else:
        best = _bisected_factor(bodies, pairs)
    found = _least(bodies, pairs, best)
    if found.factor < _SMALLEST_FACTOR:
        raise InputError(
            f"--hydrodynamic-radius auto: bodies {found.pair[0]} and {found.pair[1]} overlap so "
            f"far that {found.factor:.3g} of their size would be left; leave one out with --bodies"
        )
    return found


def _least(bodies: FrameBodies, pairs: NDArray, factor: float) -> Shrinkage:
    if not len(pairs):
        return Shrinkage(factor)
    gap = _relative_gaps(bodies, pairs, factor)
    k = int(np.argmin(gap))
    return Shrinkage(factor, float(gap[k]), tuple(bodies.gid[pairs[k]].tolist()))


def _near_pairs(bodies: FrameBodies) -> NDArray:
    """Rows (k, 2) of all pairs whose bounding spheres are nearer than the largest radius."""
    from stokes.distance import close_pairs

    return close_pairs(stokes_bodies(bodies), float(bodies.radius.max()))


def _pair_size(bodies: FrameBodies, pairs: NDArray) -> NDArray:
    """What a gap is counted in, (k,) [m]: the lesser radius of the two bodies."""
    return bodies.radius[pairs].min(axis=1)


def _distance(bodies: FrameBodies, pairs: NDArray) -> NDArray:
    """(k,) [m] between the centres."""
    return np.linalg.norm(np.diff(bodies.position[pairs], axis=1)[:, 0], axis=1)


def _sphere_factor(bodies: FrameBodies, pairs: NDArray) -> float:
    """d - f (r_a + r_b) = LEAST_GAP f min(r_a, r_b), solved for f."""
    reach = bodies.radius[pairs].sum(axis=1) + LEAST_GAP * _pair_size(bodies, pairs)
    return float(np.min(_distance(bodies, pairs) / reach, initial=1.0))


def _bisected_factor(bodies: FrameBodies, pairs: NDArray) -> float:
    """The same for any shapes: gaps fall as the factor rises, for bodies are convex."""
    pairs = pairs[_relative_gaps(bodies, pairs, 1.0) < LEAST_GAP]
    if not len(pairs):
        return 1.0
    reach = shapes.bounding_radius(bodies.shape, bodies.radius, bodies.half_length)
    # Bounding spheres that far apart leave room enough.
    room = reach[pairs].sum(axis=1) + LEAST_GAP * _pair_size(bodies, pairs)
    low, high = float(np.min(_distance(bodies, pairs) / room)), 1.0
    while high - low > _FACTOR_ERROR * high:
        middle = 0.5 * (low + high)
        tight = _relative_gaps(bodies, pairs, middle) < LEAST_GAP
        if tight.any():
            # The others have room at `middle`, and so at every factor below it.
            high, pairs = middle, pairs[tight]
        else:
            low = middle
    return low


def _relative_gaps(bodies: FrameBodies, pairs: NDArray, factor: float) -> NDArray:
    """Gaps (k,) of pairs of bodies, in radii of the smaller one; negative where they overlap."""
    size = factor * _pair_size(bodies, pairs)
    if not bodies.shape.any():
        return (_distance(bodies, pairs) - factor * bodies.radius[pairs].sum(axis=1)) / size
    from stokes.distance import gaps_of_pairs

    rows, among = np.unique(pairs, return_inverse=True)
    return gaps_of_pairs(stokes_bodies(bodies.take(rows), factor), among).distance / size


# ---- what is handed over -------------------------------------------------------------------


def stokes_bodies(bodies: FrameBodies, factor: float = 1.0) -> list[Body]:
    """The bodies as `stokes` takes them, all lengths times `factor`, in the same order.

    The curve of a body is that of radius (equatorial semi-axis) 1, so that all bodies of one
    aspect ratio share theirs. Edges where the caps of a rod begin are rounded, see
    `stokes.geometry.spherocylinder`.
    """
    from stokes.geometry import Body

    digits = 10.0**_RATIO_DIGITS
    ratio = np.rint(digits * bodies.half_length / bodies.radius) / digits
    kinds, number = np.unique(np.stack([bodies.shape, ratio], axis=1), axis=0, return_inverse=True)
    curves = [_unit_curve(int(shape), float(long)) for shape, long in kinds]
    scale = factor * bodies.radius
    return [
        Body(curve, scale, centre, quaternion)
        for curve, scale, centre, quaternion in zip(
            (curves[k] for k in number.ravel()),
            scale.tolist(),
            map(tuple, bodies.position.tolist()),
            map(tuple, bodies.orientation.tolist()),
            strict=True,
        )
    ]


def _unit_curve(shape: int, ratio: float) -> Curve:
    from stokes.geometry import sphere, spherocylinder, spheroid

    if shape == shapes.SPHERE:
        return sphere()
    if shape == shapes.SPHEROID:
        return spheroid(1.0, ratio)
    # A short rod has less of a cylinder on which its curvature can go to zero.
    return spherocylinder(1.0, ratio, min(_SMOOTHING, 0.5 * ratio))


def buoyant_weight(bodies: FrameBodies, gravity: Sequence[float], fluid_density: float) -> NDArray:
    """(density - fluid density) volume gravity, (n, 3) [N], of the bodies as large as in the run.

    Raises InputError where the file does not tell the density of every body.
    """
    if bodies.density is None:
        raise InputError(
            f"{bodies.path}: does not tell the densities of the bodies: list material in "
            "output.fields of the scene, or give --problem resistance"
        )
    mass = (bodies.density - fluid_density) * bodies.volume
    return mass[:, None] * np.asarray(gravity, dtype=np.float64)
