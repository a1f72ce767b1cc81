"""The wall sections of a scene: surfaces, and how they move."""

from __future__ import annotations

import itertools
import math
from typing import Annotated, Literal, Self

from pydantic import Field, field_validator, model_validator

from dem_mpi.scene_base import (
    ZERO,
    Face,
    Model,
    Name,
    NonNegative,
    Number,
    Positive,
    Region,
    Vec3,
    note,
    quantity,
)

_SQUARE = 1e-9  # cosine of the angle between the edges of a rectangle


def _has_direction(vector: Vec3) -> Vec3:
    if not 1e-150 < math.hypot(*vector) < 1e150:
        raise ValueError("must have a direction, for instance [0, 0, 1]")
    return vector


def _ascends(times: tuple[float, ...]) -> tuple[float, ...]:
    if any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("times must ascend")
    return times


class Oscillation(Model):
    """A sinusoidal shift of a wall."""

    amplitude: Vec3 = quantity("m", "Largest shift along x, y, z")
    frequency: Positive = quantity("Hz", "Cycles per second")
    phase: Number = quantity("rad", "Phase at time 0", default=0.0)


class VelocityTable(Model):
    """A prescribed velocity, linear between the times and constant outside them."""

    time: tuple[Number, ...] = quantity("s", "Times, ascending", min_length=1, max_length=10**6)
    velocity: tuple[Vec3, ...] = quantity("m/s", "Velocity x, y, z at each time")

    _times = field_validator("time")(_ascends)

    @model_validator(mode="after")
    def _one_each(self) -> Self:
        if len(self.time) != len(self.velocity):
            raise ValueError("time and velocity must have as many entries")
        return self


class RateTable(Model):
    """A prescribed rate of rotation, linear between the times and constant outside them."""

    time: tuple[Number, ...] = quantity("s", "Times, ascending", min_length=1, max_length=10**6)
    rate: tuple[Number, ...] = quantity("rad/s", "Rate of rotation at each time")

    _times = field_validator("time")(_ascends)

    @model_validator(mode="after")
    def _one_each(self) -> Self:
        if len(self.time) != len(self.rate):
            raise ValueError("time and rate must have as many entries")
        return self


class Rotation(Model):
    """A rotation of a wall about an axis, right-handed; the axis moves with the wall."""

    centre: Vec3 = quantity("m", "Any point of the axis at time 0")
    axis: Vec3 = quantity("1", "Direction of the axis, of any length")
    rate: Number = quantity("rad/s", "Steady rate", default=0.0)
    table: RateTable | None = note("Prescribed rate on top", default=None)

    _direction = field_validator("axis")(_has_direction)


class Motion(Model):
    """How a wall moves: the sum of what is given here, starting from its stated place at time 0."""

    velocity: Vec3 = quantity("m/s", "Steady velocity x, y, z", default=ZERO)
    oscillation: Oscillation | None = note(
        "Shift amplitude (sin(2 pi f t + phase) - sin(phase))", default=None
    )
    table: VelocityTable | None = note("Prescribed velocity on top", default=None)
    rotation: Rotation | None = note("Rotation about an axis", default=None)


class _Wall(Model):
    """What every wall has."""

    name: Name | None = note("Name in reports; by default wall<number>", default=None)
    material: Name = note("Name of one of the materials")
    motion: Motion | None = note("Motion; by default at rest", default=None)
    until: NonNegative | None = quantity(
        "s", "Time at which the wall vanishes; by default never", default=None
    )


class PlaneWall(_Wall):
    """An infinite plane."""

    shape: Literal["plane"] = note("An infinite plane")
    point: Vec3 = quantity("m", "Any point of the plane")
    normal: Vec3 = quantity("1", "Direction, of any length, to the side the bodies are on")

    _direction = field_validator("normal")(_has_direction)


class BoxWall(Region, _Wall):
    """The inside of a box: up to six planes that face inwards."""

    shape: Literal["box"] = note("The inside of an axis-aligned box")
    open: tuple[Face, ...] = note("Faces that are left out", default=())


class RectangleWall(_Wall):
    """A thin flat plate that holds bodies on both sides, at its edges and at its corners."""

    shape: Literal["rectangle"] = note("A thin rectangular plate")
    corner: Vec3 = quantity("m", "One corner")
    edges: tuple[Vec3, Vec3] = quantity("m", "The two edges that leave it, at right angles")

    @field_validator("edges")
    @classmethod
    def _square(cls, edges: tuple[Vec3, Vec3]) -> tuple[Vec3, Vec3]:
        first, second = (math.hypot(*_has_direction(edge)) for edge in edges)
        if abs(sum(a * b for a, b in zip(*edges, strict=True))) > _SQUARE * first * second:
            raise ValueError("must be at right angles")
        return edges


class _Axial(_Wall):
    """What walls of revolution have: an axis from start to end, and a side."""

    start: Vec3 = quantity("m", "Point of the axis where the wall begins")
    end: Vec3 = quantity("m", "Point of the axis where the wall ends")
    side: Literal["inside", "outside"] = note("Side that the bodies are on", default="inside")

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if not math.dist(self.start, self.end) > 0.0:
            raise ValueError("start and end must differ")
        return self


class CylinderWall(_Axial):
    """The mantle of a circular cylinder, without lids; it holds the bodies on one side."""

    shape: Literal["cylinder"] = note("The mantle of a cylinder")
    radius: Positive = quantity("m", "Radius")


class ConeWall(_Axial):
    """The mantle of a circular cone or frustum, without lids; it holds the bodies on one side."""

    shape: Literal["cone"] = note("The mantle of a cone or frustum")
    radii: tuple[NonNegative, NonNegative] = quantity("m", "Radius at start and at end")

    @field_validator("radii")
    @classmethod
    def _somewhere_wide(cls, radii: tuple[float, float]) -> tuple[float, float]:
        if max(radii) == 0.0:
            raise ValueError("at least one of the radii must be above 0")
        return radii


class RingWall(_Wall):
    """A flat disc, or a ring around a round hole; it holds the bodies on one side."""

    shape: Literal["ring"] = note("A flat disc, or a ring around a round hole")
    centre: Vec3 = quantity("m", "Centre")
    normal: Vec3 = quantity("1", "Direction, of any length, to the side the bodies are on")
    radii: tuple[NonNegative, Positive] = quantity("m", "Radius of the hole, and outer radius")

    _direction = field_validator("normal")(_has_direction)

    @field_validator("radii")
    @classmethod
    def _ordered(cls, radii: tuple[float, float]) -> tuple[float, float]:
        if not radii[0] < radii[1]:
            raise ValueError("the hole must be smaller than the ring")
        return radii


Wall = Annotated[
    PlaneWall | BoxWall | RectangleWall | CylinderWall | ConeWall | RingWall,
    Field(discriminator="shape"),
]


def wall_name(wall: Wall, index: int) -> str:
    """The wall's name in reports."""
    return wall.name or f"wall{index}"
