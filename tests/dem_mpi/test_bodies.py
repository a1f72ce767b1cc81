"""Bodies, their impulse memory, their messages, and quaternions."""

from __future__ import annotations

import json
import pickle
import zlib

import msgpack
import numpy as np
import pytest

from dem_mpi import _kernels_shapes, shapes
from dem_mpi.bodies import (
    FIELDS,
    Bodies,
    ImpulseMemory,
    pack_rows,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    quaternion_normalise,
    unpack_rows,
)
from dem_mpi.errors import DataError


def some_bodies(count: int, seed: int = 0) -> Bodies:
    """Bodies whose every array holds arbitrary bit patterns: NaN, -0.0, denormals included."""
    rng = np.random.default_rng(seed)
    arrays = {}
    for name, field in FIELDS.items():
        dtype = np.dtype(field.dtype)
        size = count * int(np.prod(field.row_shape)) * dtype.itemsize
        arrays[name] = np.frombuffer(rng.bytes(size), dtype).reshape(-1, *field.row_shape).copy()
    arrays["velocity"][:1] = [np.nan, -0.0, 5e-324]
    return Bodies(**arrays)


def some_memory(count: int, seed: int = 0) -> ImpulseMemory:
    rng = np.random.default_rng(seed)
    offsets = np.concatenate(([0], np.cumsum(rng.integers(0, 4, count))))
    return ImpulseMemory(
        offsets, rng.integers(-6, 2**62, offsets[-1]), rng.normal(size=(offsets[-1], 3))
    )


def bits(bodies: Bodies) -> list[bytes]:
    return [array.tobytes() for array in bodies.arrays().values()]


def memory_bits(memory: ImpulseMemory) -> list[bytes]:
    return [memory.offsets.tobytes(), memory.other.tobytes(), memory.impulse.tobytes()]


def test_mass_and_inertia_of_homogeneous_spheres():
    bodies = Bodies.from_arrays(
        {"gid": [4, 7], "material": [1, 0], "radius": [0.01, 2.0], "position": np.ones((2, 3))},
        density=[1000.0, 2500.0],
    )
    mass = [2500.0 * 4 / 3 * np.pi * 1e-6, 1000.0 * 4 / 3 * np.pi * 8.0]
    assert bodies.mass == pytest.approx(mass, rel=1e-15)
    assert bodies.inertia == pytest.approx([0.4 * mass[0] * 1e-4, 0.4 * mass[1] * 4.0], rel=1e-15)
    assert np.array_equal(bodies.orientation, [[1, 0, 0, 0]] * 2)
    assert not bodies.velocity.any() and not bodies.angular_velocity.any()


def inside(shape: int, radius: float, half_length: float, points: np.ndarray) -> np.ndarray:
    """Which points (k, 3) lie in a body about the origin, by the definition of its shape."""
    rho2, z = points[:, 0] ** 2 + points[:, 1] ** 2, points[:, 2]
    if shape == shapes.SPHEROID:
        return rho2 / radius**2 + z**2 / half_length**2 <= 1.0
    beyond = np.maximum(np.abs(z) - (half_length if shape == shapes.SPHEROCYLINDER else 0.0), 0.0)
    return rho2 + beyond**2 <= radius**2


@pytest.mark.parametrize(
    ("shape", "radius", "half_length"),
    [
        (shapes.SPHERE, 0.3, 0.0),
        (shapes.SPHEROCYLINDER, 0.3, 0.05),
        (shapes.SPHEROCYLINDER, 0.2, 1.1),
        (shapes.SPHEROID, 0.2, 0.9),
        (shapes.SPHEROID, 0.7, 0.1),
    ],
)
def test_mass_properties_equal_integrals_over_the_shape(shape, radius, half_length):
    """The midpoint rule over 120 x 120 x 240 cells: a jump at the surface leaves about 1e-3."""
    bodies = Bodies.from_arrays(
        {
            "gid": [0],
            "material": [0],
            "shape": [shape],
            "radius": [radius],
            "half_length": [half_length],
            "position": np.zeros((1, 3)),
        },
        density=[1234.0],
    )
    reach = bodies.bounding_radius[0]
    sides = (radius, radius, reach)
    axes = [
        s * ((np.arange(n) + 0.5) / n * 2 - 1) for s, n in zip(sides, (120, 120, 240), strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cell = 8.0 * np.prod(sides) / len(points)
    points = points[inside(shape, radius, half_length, points)]
    x2, y2, z2 = (points**2).sum(axis=0) * cell * 1234.0
    assert bodies.mass[0] == pytest.approx(len(points) * cell * 1234.0, rel=2e-3)
    assert bodies.inertia[0] == pytest.approx(0.5 * (x2 + y2) + z2, rel=2e-3)
    assert bodies.axial_inertia[0] == pytest.approx(x2 + y2, rel=2e-3)
    distance = np.linalg.norm(points, axis=1)
    assert distance.max() == pytest.approx(reach, rel=0.02)
    smallest = min(radius, half_length) if shape == shapes.SPHEROID else radius
    assert bodies.smallest_size[0] == smallest


def test_slender_and_round_limits_of_the_mass_properties():
    """A spheroid of equal axes is a sphere, and so is a spherocylinder of no core, to rounding.

    A long thin rod of length 2l has m l^2 / 3 across its axis.
    """
    arrays = {
        "gid": np.arange(4),
        "material": np.zeros(4, int),
        "shape": [0, 1, 2, 1],
        "radius": [0.3, 0.3, 0.3, 1e-6],
        "half_length": [0.0, 1e-300, 0.3, 1.0],
        "position": np.zeros((4, 3)),
    }
    bodies = Bodies.from_arrays(arrays, density=[1000.0])
    for name in ("mass", "inertia", "axial_inertia"):
        assert getattr(bodies, name)[:3] == pytest.approx(getattr(bodies, name)[0], rel=1e-15)
    assert bodies.inertia[3] == pytest.approx(bodies.mass[3] / 3.0, rel=5e-6)
    assert (bodies.bounding_radius == [0.3, 0.3, 0.3, 1.0 + 1e-6]).all()


def test_shapes_are_numbered_alike_in_scenes_and_kernels():
    kernels = (_kernels_shapes.SPHERE, _kernels_shapes.SPHEROCYLINDER, _kernels_shapes.SPHEROID)
    assert kernels == (shapes.SPHERE, shapes.SPHEROCYLINDER, shapes.SPHEROID) == (0, 1, 2)


def test_a_rod_without_a_length_is_refused():
    given = {"gid": [0], "material": [0], "radius": [1.0], "position": [[1, 2, 3]], "shape": [1]}
    with pytest.raises(ValueError, match="half_length"):
        Bodies.from_arrays(given, density=[1.0])


def test_placement_arrays_override_the_state_at_rest():
    given = {"gid": [0], "material": [0], "radius": [1.0], "position": [[1, 2, 3]]}
    bodies = Bodies.from_arrays({**given, "velocity": [[1, 0, -1]]}, density=[1.0])
    assert bodies.velocity.tolist() == [[1.0, 0.0, -1.0]]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"velocty": [[0, 0, 0]]}, "velocty"),
        ({"position": [[0, 0]]}, "position"),
        ({"radius": [1.0, 2.0]}, "radius"),
    ],
)
def test_wrong_placement_array_is_named(change, word):
    given = {"gid": [0], "material": [0], "radius": [1.0], "position": [[1, 2, 3]]}
    with pytest.raises(ValueError, match=word):
        Bodies.from_arrays({**given, **change}, density=[1.0])
    del given["radius"]
    with pytest.raises(ValueError, match="radius"):
        Bodies.from_arrays(given, density=[1.0])


def test_rows_taken_apart_and_put_together_are_the_same_bits():
    bodies, memory = some_bodies(20), some_memory(20)
    order = np.random.default_rng(1).permutation(20)
    back = np.argsort(order)
    parts = np.split(order, [0, 7, 7, 15])
    assert bits(Bodies.concatenate([bodies.take(p) for p in parts]).take(back)) == bits(bodies)
    joined = ImpulseMemory.concatenate([memory.take(p) for p in parts])
    assert memory_bits(joined.take(back)) == memory_bits(memory)
    assert len(Bodies.concatenate([])) == len(ImpulseMemory.concatenate([])) == 0


def test_mask_and_index_select_the_same_rows():
    bodies, memory = some_bodies(9), some_memory(9)
    mask = np.arange(9) % 3 == 1
    assert bits(bodies.take(mask)) == bits(bodies.take([1, 4, 7]))
    assert memory_bits(memory.take(mask)) == memory_bits(memory.take([1, 4, 7]))


def test_taken_rows_are_copies():
    bodies = some_bodies(3)
    bodies.take([0, 1, 2]).position[:] = 0.0
    assert bits(bodies) == bits(some_bodies(3))


@pytest.mark.parametrize("count", [0, 1, 50])
def test_message_restores_bodies_and_memory_bit_for_bit(count):
    bodies, memory = some_bodies(count), some_memory(count)
    rows = np.random.default_rng(2).permutation(count)[: max(1, count // 2)]
    restored, remembered = unpack_rows(pack_rows(bodies, memory, rows))
    assert bits(restored) == bits(bodies.take(rows))
    assert memory_bits(remembered) == memory_bits(memory.take(rows))
    assert bits(Bodies.unpack(bodies.pack(rows))) == bits(bodies.take(rows))
    restored.position[:] = 0.0  # writable


def test_every_flipped_bit_is_refused():
    message = pack_rows(some_bodies(1), some_memory(1, seed=1), [0])
    for place in range(len(message)):
        for bit in range(8):
            damaged = bytearray(message)
            damaged[place] ^= 1 << bit
            with pytest.raises(DataError):
                unpack_rows(bytes(damaged))


def test_every_truncation_is_refused():
    message = pack_rows(some_bodies(2), some_memory(2), [0, 1])
    for length in range(len(message)):
        with pytest.raises(DataError):
            unpack_rows(message[:length])


class Malicious:
    """Unpickling it would show that code ran."""

    def __reduce__(self):
        return (pytest.fail, ("unpacking executed code",))


FOREIGN = {
    "nothing": b"",
    "text": b"x,y,z\n0,0,0\n",
    "json": json.dumps({"position": [[0, 0, 0]]}).encode(),
    "pickle": pickle.dumps(Malicious()),
    "other msgpack": msgpack.packb({"bodies": [1, 2, 3]}),
    "extension type": msgpack.packb([msgpack.ExtType(5, b"abc")] * 2),
    "deep nesting": b"\x91" * 100_000,
    "claims 4 GiB": b"\x92\xc6\xff\xff\xff\xff",
    "claims 4 billion entries": b"\xdd\xff\xff\xff\xff",
    "memory where bodies belong": some_memory(1).pack([0]),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_data_is_refused(name):
    for unpack in (unpack_rows, Bodies.unpack):
        with pytest.raises(DataError, match="message of"):
            unpack(FOREIGN[name])


def forged(kind: str, arrays: dict[str, bytes]) -> bytes:
    """A message with a right checksum, whatever it holds."""
    checksum = 0
    for buffer in arrays.values():
        checksum = zlib.crc32(buffer, checksum)
    return msgpack.packb([kind, 1, checksum, arrays])


def test_inconsistent_arrays_are_refused_though_the_checksum_fits():
    arrays = {name: array.tobytes() for name, array in some_bodies(2).arrays().items()}
    assert len(Bodies.unpack(forged("bodies", arrays))) == 2
    with pytest.raises(DataError, match="lengths"):
        Bodies.unpack(forged("bodies", {**arrays, "mass": b"\0" * 8}))
    with pytest.raises(DataError, match="whole rows"):
        Bodies.unpack(forged("bodies", {**arrays, "position": b"\0" * 47}))
    one, two = np.int64(1).tobytes(), np.int64(2).tobytes()
    for count in (np.int64(-1).tobytes(), two):
        memory = {"count": count, "other": one, "impulse": b"\0" * 24}
        with pytest.raises(DataError):
            ImpulseMemory.unpack(forged("impulse memory", memory))


def test_bodies_and_memories_of_different_number_are_refused():
    message = msgpack.packb([some_bodies(2).pack([0, 1]), some_memory(2).pack([0])])
    with pytest.raises(DataError, match="differ in number"):
        unpack_rows(message)


@pytest.mark.parametrize("offsets", [[], [1, 2], [0, 3, 2], [0, 1]])
def test_memory_with_impossible_offsets_is_refused(offsets):
    with pytest.raises(ValueError, match="offsets"):
        ImpulseMemory(np.array(offsets), np.zeros(2), np.zeros((2, 3)))


# ---- quaternions ---------------------------------------------------------------------------


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_quarter_turn_about_z_takes_x_to_y():
    q = quaternion_from_rotation_vector(np.array([[0.0, 0.0, np.pi / 2]]))
    assert rotation_matrix(q[0]) @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-15)


def test_product_is_the_composition_of_rotations():
    rotation = np.random.default_rng(5).normal(size=(2, 50, 3))
    left, right = map(quaternion_from_rotation_vector, rotation)
    product = quaternion_multiply(left, right)
    for a, b, c in zip(left, right, product, strict=True):
        np.testing.assert_allclose(
            rotation_matrix(c), rotation_matrix(a) @ rotation_matrix(b), atol=1e-14
        )


@pytest.mark.parametrize("angle", [0.0, 5e-324, 1e-200, 1e-8, 1.0, 3.0, 1e4])
def test_rotation_vector_gives_a_unit_quaternion_of_half_its_angle(angle):
    q = quaternion_from_rotation_vector(np.array([[0.0, angle, 0.0]]))[0]
    assert q == pytest.approx([np.cos(angle / 2), 0, np.sin(angle / 2), 0], rel=1e-12, abs=1e-15)
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-15 + 1e-16 * angle)


def test_small_rotation_keeps_its_relative_accuracy():
    q = quaternion_from_rotation_vector(np.array([[1e-12, -2e-12, 3e-12]]))[0]
    assert q[1:] == pytest.approx([0.5e-12, -1e-12, 1.5e-12], rel=1e-15)


def test_normalised_quaternion_has_unit_length():
    q = np.random.default_rng(6).normal(size=(100, 4)) * 1e3
    unit = quaternion_normalise(q)
    assert np.linalg.norm(unit, axis=1) == pytest.approx(np.ones(100), abs=1e-15)
    np.testing.assert_allclose(unit * np.linalg.norm(q, axis=1, keepdims=True), q, rtol=1e-15)
