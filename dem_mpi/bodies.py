"""Bodies as a structure of arrays, the impulses they remember, and their form on the wire.

`FIELDS` is the one list of what a body is: allocation, row selection, messages and checkpoints
all follow it, so a field is added in one line.

Symbols: n bodies, m remembered contacts; quaternions scalar first; world frame unless said.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgpack
import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from dem_mpi import shapes
from dem_mpi.errors import DataError


class Field(NamedTuple):
    """One array of a structure of arrays: element type, shape of a row, SI unit, meaning."""

    dtype: DTypeLike
    row_shape: tuple[int, ...]
    unit: str
    meaning: str


FIELDS: Mapping[str, Field] = {
    "gid": Field(np.int64, (), "1", "name for life, >= 0"),
    "material": Field(np.int32, (), "1", "row of the material table"),
    "shape": Field(np.int8, (), "1", "place in scene_bodies.SHAPES"),
    "radius": Field(np.float64, (), "m", "radius, of caps or of the equator"),
    "half_length": Field(np.float64, (), "m", "half the core or polar semi-axis; of spheres 0"),
    "mass": Field(np.float64, (), "kg", "mass"),
    "inertia": Field(np.float64, (), "kg m^2", "moment of inertia across the symmetry axis"),
    "axial_inertia": Field(np.float64, (), "kg m^2", "moment of inertia about the symmetry axis"),
    "position": Field(np.float64, (3,), "m", "centre of mass"),
    "orientation": Field(np.float64, (4,), "1", "unit quaternion, body to world"),
    "velocity": Field(np.float64, (3,), "m/s", "velocity of the centre of mass"),
    "angular_velocity": Field(np.float64, (3,), "rad/s", "angular velocity"),
}

_MEMORY_FIELDS: Mapping[str, Field] = {
    "count": Field(np.int64, (), "1", "contacts remembered by each body"),
    "other": Field(np.int64, (), "1", "partner of each contact"),
    "impulse": Field(np.float64, (3,), "N s", "impulse of each contact"),
}


@dataclass
class Bodies:
    """The bodies a rank owns, one row each. The arrays are mutable and contiguous.

    `FIELDS` gives the type, row shape and unit of every array. The symmetry axis is the z axis
    of the body; `shapes` says what radius and half_length are. After a migration rows are in
    order of (Morton key, gid).
    """

    gid: NDArray[np.int64]
    material: NDArray[np.int32]
    shape: NDArray[np.int8]
    radius: NDArray[np.float64]
    half_length: NDArray[np.float64]
    mass: NDArray[np.float64]
    inertia: NDArray[np.float64]
    axial_inertia: NDArray[np.float64]
    position: NDArray[np.float64]
    orientation: NDArray[np.float64]
    velocity: NDArray[np.float64]
    angular_velocity: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Convert every array to its field's type; ValueError where a shape does not fit."""
        rows = len(self.gid)
        for name, field in FIELDS.items():
            setattr(self, name, _as_field(name, getattr(self, name), field, rows))

    def __len__(self) -> int:
        return len(self.gid)

    @classmethod
    def empty(cls, count: int = 0) -> Bodies:
        """`count` bodies of gid -1 with everything zero, in the identity orientation."""
        arrays = {
            name: np.zeros((count, *field.row_shape), dtype=field.dtype)
            for name, field in FIELDS.items()
        }
        arrays["gid"][:] = -1
        arrays["orientation"][:, 0] = 1.0
        return cls(**arrays)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, ArrayLike], density: ArrayLike) -> Bodies:
        """Make homogeneous bodies from what a placement gives.

        `arrays` must hold gid, material, radius and position and may hold shape (sphere
        otherwise) with half_length (needed by other shapes), orientation (identity otherwise),
        velocity and angular_velocity (zero otherwise); `density` (materials,) [kg/m³] is indexed
        by material. Mass and inertia follow from them. ValueError names a missing or an unknown
        array.
        """
        for name in ("gid", "material", "radius", "position"):
            if name not in arrays:
                raise ValueError(f"bodies need {name}")
        for name in arrays:
            if name not in FIELDS:
                raise ValueError(f"bodies have no field {name!r}")
        count = len(np.asarray(arrays["gid"]))
        values = {**cls.empty(count).arrays(), **arrays}
        form = [
            _as_field(n, values[n], FIELDS[n], count) for n in ("shape", "radius", "half_length")
        ]
        if np.any((form[0] != shapes.SPHERE) & ~(form[2] > 0.0)):
            raise ValueError("bodies that are not spheres need half_length")
        material = np.asarray(arrays["material"], dtype=np.int32)
        mass = np.asarray(density, dtype=np.float64)[material] * shapes.volume(*form)
        transverse, axial = shapes.inertia(form[0], mass, *form[1:])
        return cls(**{**values, "mass": mass, "inertia": transverse, "axial_inertia": axial})

    @classmethod
    def concatenate(cls, parts: Sequence[Bodies]) -> Bodies:
        """All rows of `parts`, in their order."""
        if not parts:
            return cls.empty()
        return cls(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in FIELDS})

    def arrays(self) -> dict[str, NDArray]:
        """Every array by name, not copied: what a checkpoint writes; `Bodies(**arrays)` reads."""
        return {name: getattr(self, name) for name in FIELDS}

    @property
    def bounding_radius(self) -> NDArray[np.float64]:
        """Radius (n,) [m] of the sphere about the position that contains the body."""
        return shapes.bounding_radius(self.shape, self.radius, self.half_length)

    @property
    def smallest_size(self) -> NDArray[np.float64]:
        """Radius (n,) [m] of the largest sphere about the position inside the body."""
        return shapes.smallest_size(self.shape, self.radius, self.half_length)

    def take(self, index: ArrayLike) -> Bodies:
        """Copy the rows `index` (k,), in that order."""
        return self.take_from([self], index)

    @classmethod
    def take_from(cls, parts: Sequence[Bodies], index: ArrayLike) -> Bodies:
        """Copy the rows `index` (k,) of all `parts`, one behind the other, in that order.

        Apart from the result no more than one array is copied at a time.
        """
        rows = _row_index(index)
        return cls(**{n: _laid_end_to_end([getattr(p, n) for p in parts])[rows] for n in FIELDS})

    def pack(self, index: ArrayLike) -> bytes:
        """Write the rows `index` (k,) as a message that `unpack` restores bit for bit."""
        return _pack("bodies", self.take(index).arrays())

    @classmethod
    def unpack(cls, data: bytes) -> Bodies:
        """Read what `pack` wrote. DataError where `data` is damaged or anything else."""
        arrays = _unpack("bodies", FIELDS, data)
        rows = {len(array) for array in arrays.values()}
        if len(rows) != 1:
            raise DataError("message of bodies: arrays of different lengths")
        return cls(**arrays)


@dataclass
class ImpulseMemory:
    """Contact impulses of the last step, kept with the body that owns the contact.

    Body i's contacts are rows offsets[i]:offsets[i + 1].

    offsets : (n + 1,) int64
    other   : (m,) int64       gid of the other body, or the negative id of a wall
    impulse : (m, 3) float64   impulse on the other one, world frame [N s]
    """

    offsets: NDArray[np.int64]
    other: NDArray[np.int64]
    impulse: NDArray[np.float64]

    def __post_init__(self) -> None:
        """Convert every array to its type; ValueError where shapes or offsets do not fit."""
        self.offsets = np.ascontiguousarray(self.offsets, dtype=np.int64)
        contacts = len(self.other)
        for name in ("other", "impulse"):
            field = _MEMORY_FIELDS[name]
            setattr(self, name, _as_field(name, getattr(self, name), field, contacts))
        ends = self.offsets[[0, -1]] if self.offsets.size else np.array([-1, -1])
        if ends[0] != 0 or ends[1] != contacts or np.any(np.diff(self.offsets) < 0):
            raise ValueError(f"offsets must rise from 0 to the number of contacts, {contacts}")

    def __len__(self) -> int:
        return len(self.offsets) - 1

    @classmethod
    def empty(cls, count: int = 0) -> ImpulseMemory:
        """The memory of `count` bodies that touched nothing."""
        return cls(np.zeros(count + 1, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))

    @classmethod
    def concatenate(cls, parts: Sequence[ImpulseMemory]) -> ImpulseMemory:
        """The memories of all bodies of `parts`, in their order."""
        if not parts:
            return cls.empty()
        return cls(
            _offsets(np.concatenate([np.diff(p.offsets) for p in parts])),
            np.concatenate([p.other for p in parts]),
            np.concatenate([p.impulse for p in parts]),
        )

    def take(self, index: ArrayLike) -> ImpulseMemory:
        """Copy the memories of the bodies `index` (k,), in that order."""
        return self.take_from([self], index)

    @classmethod
    def take_from(cls, parts: Sequence[ImpulseMemory], index: ArrayLike) -> ImpulseMemory:
        """Copy the memories of the bodies `index` (k,) of all `parts`, as `Bodies.take_from`."""
        rows = _row_index(index)
        every = _laid_end_to_end([np.diff(p.offsets) for p in parts])
        count = every[rows]
        offsets = _offsets(count)
        # Row j of the copy, of body b, comes from row j + (old start of b - new start of b).
        contact = np.repeat(_offsets(every)[rows] - offsets[:-1], count)
        contact += np.arange(offsets[-1])
        return cls(
            offsets,
            _laid_end_to_end([p.other for p in parts])[contact],
            _laid_end_to_end([p.impulse for p in parts])[contact],
        )

    def pack(self, index: ArrayLike) -> bytes:
        """Write the memories of the bodies `index` (k,) as a message for `unpack`."""
        part = self.take(index)
        arrays = {"count": np.diff(part.offsets), "other": part.other, "impulse": part.impulse}
        return _pack("impulse memory", arrays)

    @classmethod
    def unpack(cls, data: bytes) -> ImpulseMemory:
        """Read what `pack` wrote. DataError where `data` is damaged or anything else."""
        arrays = _unpack("impulse memory", _MEMORY_FIELDS, data)
        if np.any(arrays["count"] < 0):
            raise DataError("message of impulse memory: a negative count")
        try:
            return cls(_offsets(arrays["count"]), arrays["other"], arrays["impulse"])
        except ValueError as error:
            raise DataError(f"message of impulse memory: {error}") from None


# ---- messages ------------------------------------------------------------------------------

_FORMAT_VERSION = 1


def pack_rows(bodies: Bodies, memory: ImpulseMemory, index: ArrayLike) -> bytes:
    """Write the rows `index` (k,) of bodies together with their memories as one message."""
    return msgpack.packb((bodies.pack(index), memory.pack(index)))


def unpack_rows(data: bytes) -> tuple[Bodies, ImpulseMemory]:
    """Read what `pack_rows` wrote. DataError where `data` is damaged or anything else."""
    parts = _decode("migrating bodies", data)
    if not isinstance(parts, list) or [type(part) for part in parts] != [bytes, bytes]:
        raise DataError("message of migrating bodies: damaged or of another program")
    bodies, memory = Bodies.unpack(parts[0]), ImpulseMemory.unpack(parts[1])
    if len(bodies) != len(memory):
        raise DataError("message of migrating bodies: bodies and memories differ in number")
    return bodies, memory


def _pack(kind: str, arrays: Mapping[str, NDArray]) -> bytes:
    """Write [kind, version, checksum, {name: little-endian bytes}]."""
    raw = {
        name: np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        for name, array in arrays.items()
    }
    return msgpack.packb([kind, _FORMAT_VERSION, _checksum(raw), raw])


def _unpack(kind: str, fields: Mapping[str, Field], data: bytes) -> dict[str, NDArray]:
    """Return the arrays of `fields` written by `_pack`, as writable copies."""
    message = _decode(kind, data)
    if not isinstance(message, list) or len(message) != 4 or message[0] != kind:
        raise DataError(f"message of {kind}: damaged or of another program")
    _, version, checksum, raw = message
    if version != _FORMAT_VERSION:
        raise DataError(f"message of {kind}: version {version!r}, expected {_FORMAT_VERSION}")
    if not isinstance(raw, dict) or list(raw) != list(fields):
        raise DataError(f"message of {kind}: its arrays are not {', '.join(fields)}")
    if not all(isinstance(buffer, bytes) for buffer in raw.values()):
        raise DataError(f"message of {kind}: an array is not binary")
    if checksum != _checksum(raw):
        raise DataError(f"message of {kind}: checksum does not match")
    return {name: _from_bytes(kind, name, raw[name], field) for name, field in fields.items()}


def _decode(kind: str, data: bytes) -> Any:
    """Return the msgpack value of `data`, its parts no larger than it; DataError otherwise."""
    try:
        return msgpack.unpackb(
            data,
            max_bin_len=len(data),
            max_str_len=64,
            max_array_len=16,
            max_map_len=len(FIELDS) + len(_MEMORY_FIELDS),
            max_ext_len=0,
        )
    except (ValueError, TypeError, RecursionError, msgpack.exceptions.UnpackException) as error:
        raise DataError(f"message of {kind}: not readable ({error})") from None


def _from_bytes(kind: str, name: str, raw: bytes, field: Field) -> NDArray:
    dtype = np.dtype(field.dtype)
    row_bytes = dtype.itemsize * int(np.prod(field.row_shape, dtype=np.int64))
    if len(raw) % row_bytes:
        raise DataError(f"message of {kind}: {name} does not hold whole rows")
    array = np.frombuffer(raw, dtype=dtype.newbyteorder("<")).astype(dtype)
    return array.reshape(-1, *field.row_shape)


def _checksum(raw: Mapping[str, bytes]) -> int:
    value = 0
    for buffer in raw.values():
        value = zlib.crc32(buffer, value)
    return value


# ---- arrays --------------------------------------------------------------------------------


def _as_field(name: str, value: ArrayLike, field: Field, rows: int) -> NDArray:
    array = np.ascontiguousarray(value, dtype=field.dtype)
    if array.shape != (rows, *field.row_shape):
        raise ValueError(f"{name}: shape {array.shape}, expected {(rows, *field.row_shape)}")
    return array


def _laid_end_to_end(arrays: Sequence[NDArray]) -> NDArray:
    """All rows; one array alone is not copied."""
    return arrays[0] if len(arrays) == 1 else np.concatenate(arrays)


def _offsets(count: NDArray) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(count, dtype=np.int64)))


def _row_index(index: ArrayLike) -> NDArray[np.intp]:
    """Row numbers of an integer index or a mask. (n + 1 offsets leave no room for a bare mask.)"""
    rows = np.asarray(index)
    if rows.dtype == np.bool_:
        return np.flatnonzero(rows)
    return rows.astype(np.intp, copy=False)


# ---- quaternions ---------------------------------------------------------------------------


def quaternion_multiply(left: NDArray, right: NDArray) -> NDArray:
    """Hamilton product (n, 4) of (n, 4) and (n, 4): the rotation `right`, then `left`."""
    a, u = left[..., :1], left[..., 1:]
    b, v = right[..., :1], right[..., 1:]
    # (a, u)(b, v) = (ab - u·v, av + bu + u×v)
    scalar = a * b - np.sum(u * v, axis=-1, keepdims=True)
    return np.concatenate((scalar, a * v + b * u + np.cross(u, v)), axis=-1)


def quaternion_from_rotation_vector(rotation: NDArray) -> NDArray:
    """Unit quaternions (n, 4) of rotations by |θ| about θ, `rotation` (n, 3) [rad]."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    # q = (cos θ/2, θ/|θ| sin θ/2);  sin(θ/2)/θ = sinc(θ/2π)/2 is exact at 0
    return np.concatenate(
        (np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * rotation), axis=-1
    )


def quaternion_normalise(quaternion: NDArray) -> NDArray:
    """Scale (n, 4) to unit length."""
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
