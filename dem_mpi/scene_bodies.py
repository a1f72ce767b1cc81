"""The body sections of a scene: shapes, sizes, and where bodies start, come in and go out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dem_mpi.scene_base import (
    ZERO,
    Model,
    Name,
    NonNegative,
    Number,
    Positive,
    Region,
    Vec3,
    Whole,
    note,
    quantity,
)

Shape = Literal["sphere", "spherocylinder", "spheroid"]
SHAPES: tuple[Shape, ...] = ("sphere", "spherocylinder", "spheroid")


# ---- sizes ---------------------------------------------------------------------------------


class UniformRadius(Model):
    """Radii drawn from a uniform distribution."""

    uniform: tuple[Positive, Positive] = quantity("m", "Smallest and largest radius")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.uniform[0] < self.uniform[1]:
            raise ValueError("the smallest radius must come first and be below the largest")
        return self


class Lognormal(Model):
    """The parameters of a lognormal distribution by number, cut off at both ends."""

    median: Positive = quantity("m", "Median radius before the cuts")
    sigma: Positive = quantity("1", "Standard deviation of the logarithm of the radius", le=5)
    min: Positive = quantity("m", "Smallest radius")
    max: Positive = quantity("m", "Largest radius")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.min < self.max:
            raise ValueError("min must be below max")
        return self


class LognormalRadius(Model):
    """Radii drawn from a truncated lognormal distribution."""

    lognormal: Lognormal = note("Parameters of the distribution")


class Weighted(Model):
    """Sizes and their shares of the bodies."""

    radii: tuple[Positive, ...] = quantity("m", "Radii", min_length=1, max_length=10**6)
    weights: tuple[NonNegative, ...] = quantity("1", "Share of each radius, of any sum")
    by: Literal["number", "volume"] = note(
        "Whether the shares count bodies or their volume", default="number"
    )

    @model_validator(mode="after")
    def _one_each(self) -> Self:
        if len(self.radii) != len(self.weights):
            raise ValueError("radii and weights must have as many entries")
        if not sum(self.weights) > 0.0:
            raise ValueError("at least one of the weights must be above 0")
        return self


class WeightedRadius(Model):
    """Radii drawn from a list with weights."""

    weighted: Weighted = note("Radii and weights")


class Mix(Model):
    """Two sizes."""

    small: Positive = quantity("m", "Radius of the small bodies")
    large: Positive = quantity("m", "Radius of the large bodies")
    large_share: Number = quantity("1", "Share of the large bodies", ge=0, le=1)
    by: Literal["number", "volume"] = note(
        "Whether the share counts bodies or their volume", default="volume"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.small < self.large:
            raise ValueError("small must be below large")
        return self


class MixRadius(Model):
    """Radii of a mix of two sizes, drawn at random."""

    mix: Mix = note("The two sizes and their shares")


_DISTRIBUTIONS = {
    "uniform": UniformRadius,
    "lognormal": LognormalRadius,
    "weighted": WeightedRadius,
    "mix": MixRadius,
}


def _radius_form(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "<list>"
    for key, model in _DISTRIBUTIONS.items():
        if isinstance(value, model) or (isinstance(value, dict) and key in value):
            return f"<{key}>"
    return "<uniform>" if isinstance(value, dict) else "<number>"


Radius = Annotated[
    Annotated[Positive, Tag("<number>")]
    | Annotated[tuple[Positive, ...], Field(min_length=1), Tag("<list>")]
    | Annotated[UniformRadius, Tag("<uniform>")]
    | Annotated[LognormalRadius, Tag("<lognormal>")]
    | Annotated[WeightedRadius, Tag("<weighted>")]
    | Annotated[MixRadius, Tag("<mix>")],
    Discriminator(_radius_form),
]


# ---- places --------------------------------------------------------------------------------


class JitteredGrid(Region):
    """Cells filling a region, one body in each, shifted at random within its cell."""

    jitter: NonNegative = quantity(
        "1",
        "Random shift as a fraction of the free play in a cell; 1 still cannot make bodies overlap",
        default=0.0,
        le=1,
    )
    spacing: Positive | None = quantity(
        "m", "Cell size; by default the largest that holds all bodies", default=None
    )


class RandomPlacement(Region):
    """Bodies one after another at random in a region, none closer to another than a gap.

    Bodies that are not spheres keep the gap between their bounding spheres.
    """

    gap: NonNegative = quantity("m", "Smallest distance of two surfaces", default=0.0)


class Insertion(Region):
    """Bodies that come in while the run goes on, at random free places of a region."""

    rate: Positive = quantity("1/s", "Bodies a second, until the group's count is reached")
    start: NonNegative = quantity("s", "Time of the first body", default=0.0)


class Placement(Model):
    """Where the bodies start: a grid, random places, a file of positions, or an inlet."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": [key]} for key in ("jittered_grid", "random", "file", "insertion")
            ]
        }
    )

    jittered_grid: JitteredGrid | None = note(
        "A region filled in whole layers from the lowest z upwards; no body reaches out of it",
        default=None,
    )
    random: RandomPlacement | None = note(
        "A region filled at random without overlap; no body reaches out of it", default=None
    )
    insertion: Insertion | None = note(
        "A region where bodies come in during the run; no new body reaches out of it", default=None
    )
    file: str | None = note(
        "CSV (header x,y,z[,radius][,vx,vy,vz][,wx,wy,wz][,qw,qx,qy,qz]) or HDF5 file (.h5, .hdf5) "
        "relative to the scene; what it states replaces the group's radius, velocities and axis. "
        "Of the run.h5 of another run, all bodies of the last frame",
        default=None,
        min_length=1,
        max_length=4096,
    )
    dataset: str | None = note(
        "HDF5 group holding position (n,3)[, radius (n), velocity (n,3), angular_velocity (n,3), "
        "orientation (n,4) body to world, scalar first]; by default the file's root",
        default=None,
        min_length=1,
        max_length=1024,
    )
    _directory: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _exactly_one(self, info: ValidationInfo) -> Self:
        ways = (self.jittered_grid, self.random, self.insertion, self.file)
        if sum(way is not None for way in ways) != 1:
            raise ValueError("give exactly one of jittered_grid, random, insertion and file")
        if self.dataset is not None and not (self.file or "").endswith((".h5", ".hdf5")):
            raise ValueError("dataset goes with an HDF5 file only")
        if self.file is not None and not self.file.endswith((".csv", ".h5", ".hdf5")):
            raise ValueError("file must end in .csv, .h5 or .hdf5")
        self._directory = (info.context or {}).get("directory", Path())
        return self

    @property
    def stands_at_start(self) -> bool:
        """Whether the scene itself says where each body starts."""
        return self.jittered_grid is not None or self.file is not None

    @property
    def path(self) -> Path:
        """The file of positions, seen from the process; only where `file` is given."""
        return self._directory / (self.file or "")


class BodyGroup(Model):
    """Bodies that share a shape, a material and a placement."""

    shape: Shape = note("Shape, axisymmetric about the body's own z axis", default="sphere")
    material: Name = note("Name of one of the materials")
    count: Whole | None = quantity(
        "1",
        "Number of bodies; with placement.file all rows by default",
        default=None,
        ge=1,
        le=2**48,
    )
    radius: Radius | None = quantity(
        "m",
        "One radius, a list dealt out in turn, or a distribution: uniform, lognormal, weighted, "
        "mix; the equatorial radius of a spheroid, the cap radius of a spherocylinder",
        default=None,
    )
    aspect_ratio: Positive | None = quantity(
        "1",
        "Length along the axis over width; above 1 for a spherocylinder. For spheres left out",
        default=None,
        le=1000,
    )
    axis: Literal["random"] | Vec3 = quantity(
        "1", "Direction of the symmetry axis at the start, or random", default=(0.0, 0.0, 1.0)
    )
    placement: Placement = note("Initial positions")
    velocity: Vec3 = quantity("m/s", "Initial velocity x, y, z", default=ZERO)
    angular_velocity: Vec3 = quantity("rad/s", "Initial angular velocity x, y, z", default=ZERO)
    velocity_jitter: NonNegative = quantity(
        "m/s", "Each velocity component is shifted uniformly within +- this", default=0.0
    )

    @field_validator("axis")
    @classmethod
    def _has_direction(cls, axis: Literal["random"] | Vec3) -> Literal["random"] | Vec3:
        if axis != "random" and not 1e-150 < math.hypot(*axis) < 1e150:
            raise ValueError("must have a direction, for instance [0, 0, 1], or be random")
        return axis

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.placement.file is None:
            for key in ("count", "radius"):
                if getattr(self, key) is None:
                    raise ValueError(f"{key} is required unless placement.file is given")
        if self.shape == "sphere" and self.aspect_ratio is not None:
            raise ValueError("aspect_ratio is for bodies that are not spheres")
        if self.shape != "sphere" and self.aspect_ratio is None:
            raise ValueError(f"aspect_ratio is required for a {self.shape}")
        if self.shape == "spherocylinder" and not self.aspect_ratio > 1.0:
            raise ValueError("aspect_ratio of a spherocylinder must be above 1")
        return self


class Removal(Region):
    """A region in which bodies are taken out of the run as soon as their centre is there."""

    name: Name | None = note("Name in reports; by default removal<number>", default=None)


def removal_name(region: Removal, index: int) -> str:
    """The region's name in reports."""
    return region.name or f"removal{index}"
