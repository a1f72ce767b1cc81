"""The scene as frozen, checked models, and the plain arrays that the simulation takes from it.

SI units throughout. Every model refuses unknown keys and silent conversions: a quoted "1" is
text, `true` is no number, and neither NaN nor infinity is a value. What one key alone, or one
section alone, can violate is checked here; `scene_checks` holds the rules that join sections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    Strict,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Vec3 = tuple[Number, Number, Number]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$", max_length=64)]
Face = Literal["x_min", "x_max", "y_min", "y_max", "z_min", "z_max"]
FACES: tuple[Face, ...] = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
BodyField = Literal[
    "position", "velocity", "angular_velocity", "orientation", "radius", "gid", "material"
]

ZERO: Vec3 = (0.0, 0.0, 0.0)


def quantity(unit: str, text: str, **rules: Any) -> Any:
    """A numeric field whose unit stands in the schema; `unit` "1" means dimensionless."""
    return Field(description=f"{text} [{unit}]", json_schema_extra={"unit": unit}, **rules)


def note(text: str, **rules: Any) -> Any:
    """A field that has no unit: a name, a choice, a switch or a section."""
    return Field(description=text, **rules)


class Model(BaseModel):
    """Base of every part of a scene: immutable, no unknown keys, numbers of moderate size."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*")
    @classmethod
    def _moderate(cls, value: Any) -> Any:
        """Refuse sizes whose squares and cubes would leave the range of float64."""
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and number != 0 and not 1e-30 <= abs(number) <= 1e30:
                raise ValueError("must be 0 or between 1e-30 and 1e30 in size")
        return value


class Region(Model):
    """An axis-aligned region with min below max on every axis."""

    min: Vec3 = quantity("m", "Lower corner x, y, z")
    max: Vec3 = quantity("m", "Upper corner x, y, z")

    @field_validator("max")
    @classmethod
    def _above_min(cls, upper: Vec3, info: ValidationInfo) -> Vec3:
        for axis, low, high in zip("xyz", info.data.get("min", upper), upper, strict=True):
            if "min" in info.data and not low < high:
                raise ValueError(f"must be above min on every axis ({axis}: {low:g} and {high:g})")
        return upper


class Domain(Region):
    """The open region the simulation looks after; bodies may leave it."""

    on_leave: Literal["keep", "remove"] = note(
        "What happens to a body whose centre leaves the domain; either way it is counted",
        default="keep",
    )


class Material(Model):
    """What a body is made of."""

    density: Positive = quantity("kg/m^3", "Mass density")


class FrictionPair(Model):
    """The friction coefficient of two materials in contact."""

    between: tuple[Name, Name] = note("The two material names, in either order")
    mu: NonNegative = quantity("1", "Coulomb friction coefficient")


class Friction(Model):
    """Coulomb friction, per pair of materials."""

    default: NonNegative = quantity(
        "1", "Friction coefficient of every pair not listed", default=0.0
    )
    pairs: tuple[FrictionPair, ...] = note("Pairs with their own coefficient", default=())


class UniformRadius(Model):
    """Radii drawn from a uniform distribution."""

    uniform: tuple[Positive, Positive] = quantity("m", "Smallest and largest radius")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.uniform[0] < self.uniform[1]:
            raise ValueError("the smallest radius must come first and be below the largest")
        return self


def _radius_form(value: Any) -> str:
    if isinstance(value, (dict, UniformRadius)):
        return "<uniform>"
    return "<list>" if isinstance(value, (list, tuple)) else "<number>"


Radius = Annotated[
    Annotated[Positive, Tag("<number>")]
    | Annotated[tuple[Positive, ...], Field(min_length=1), Tag("<list>")]
    | Annotated[UniformRadius, Tag("<uniform>")],
    Discriminator(_radius_form),
]


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


class Placement(Model):
    """Where the bodies start: a grid, or a file of positions."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": ["jittered_grid"]}, {"required": ["file"]}]}
    )

    jittered_grid: JitteredGrid | None = note(
        "A region filled in whole layers from the lowest z upwards; no body reaches out of it",
        default=None,
    )
    file: str | None = note(
        "CSV (header x,y,z[,radius][,vx,vy,vz][,wx,wy,wz]) or HDF5 file (.h5, .hdf5) relative to "
        "the scene; what it states replaces the group's radius and velocities",
        default=None,
        min_length=1,
        max_length=4096,
    )
    dataset: str | None = note(
        "HDF5 group holding position (n,3)[, radius (n), velocity (n,3), angular_velocity (n,3)]; "
        "by default the file's root",
        default=None,
        min_length=1,
        max_length=1024,
    )
    _directory: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _exactly_one(self, info: ValidationInfo) -> Self:
        if (self.jittered_grid is None) == (self.file is None):
            raise ValueError("give exactly one of jittered_grid and file")
        if self.dataset is not None and not (self.file or "").endswith((".h5", ".hdf5")):
            raise ValueError("dataset goes with an HDF5 file only")
        if self.file is not None and not self.file.endswith((".csv", ".h5", ".hdf5")):
            raise ValueError("file must end in .csv, .h5 or .hdf5")
        self._directory = (info.context or {}).get("directory", Path())
        return self

    @property
    def path(self) -> Path:
        """The file of positions, seen from the process; only where `file` is given."""
        return self._directory / (self.file or "")


class BodyGroup(Model):
    """Bodies that share a shape, a material and a placement."""

    shape: Literal["sphere"] = note("Shape of the bodies", default="sphere")
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
        "One radius, a list dealt out in turn, or {uniform: [smallest, largest]}",
        default=None,
    )
    placement: Placement = note("Initial positions")
    velocity: Vec3 = quantity("m/s", "Initial velocity x, y, z", default=ZERO)
    angular_velocity: Vec3 = quantity("rad/s", "Initial angular velocity x, y, z", default=ZERO)
    velocity_jitter: NonNegative = quantity(
        "m/s", "Each velocity component is shifted uniformly within +- this", default=0.0
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.placement.file is None:
            for key in ("count", "radius"):
                if getattr(self, key) is None:
                    raise ValueError(f"{key} is required with placement.jittered_grid")
        return self


class Oscillation(Model):
    """A sinusoidal shift of a wall."""

    amplitude: Vec3 = quantity("m", "Largest shift along x, y, z")
    frequency: Positive = quantity("Hz", "Cycles per second")
    phase: Number = quantity("rad", "Phase at time 0", default=0.0)


class Motion(Model):
    """How a wall moves: u(t) = velocity t + amplitude (sin(2 pi f t + phase) - sin(phase))."""

    velocity: Vec3 = quantity("m/s", "Steady velocity x, y, z", default=ZERO)
    oscillation: Oscillation | None = note("Sinusoidal shift on top", default=None)


class PlaneWall(Model):
    """An infinite plane."""

    shape: Literal["plane"] = note("An infinite plane")
    name: Name | None = note("Name in reports; by default wall<number>", default=None)
    material: Name = note("Name of one of the materials")
    point: Vec3 = quantity("m", "Any point of the plane")
    normal: Vec3 = quantity("1", "Direction, of any length, to the side the bodies are on")
    motion: Motion | None = note("Motion; by default at rest", default=None)

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not 1e-150 < math.hypot(*self.normal) < 1e150:
            raise ValueError("normal must have a direction, for instance [0, 0, 1]")
        return self


class BoxWall(Region):
    """The inside of a box: up to six planes that face inwards."""

    shape: Literal["box"] = note("The inside of an axis-aligned box")
    name: Name | None = note("Name in reports; by default wall<number>", default=None)
    material: Name = note("Name of one of the materials")
    open: tuple[Face, ...] = note("Faces that are left out", default=())
    motion: Motion | None = note("Motion; by default at rest", default=None)


Wall = Annotated[PlaneWall | BoxWall, Field(discriminator="shape")]


class Rest(Model):
    """When the bodies count as being at rest: both limits kept for a number of steps."""

    max_speed: Positive = quantity("m/s", "Largest speed of any body", default=0.01)
    kinetic_speed: Positive = quantity(
        "m/s", "Mean translational energy per body stays below m/2 times this squared", default=1e-3
    )
    steps: Whole = quantity("1", "Steps in a row", default=50, ge=1)


class Time(Model):
    """Time step and end."""

    step: Positive = quantity("s", "Time step h")
    end: Positive = quantity("s", "Simulated time, a whole number of steps")
    stop_at_rest: Rest | None = note(
        "End early when the bodies rest; {} for defaults", default=None
    )


class Contact(Model):
    """The contact solve of each step and its tolerance."""

    solver: Literal["apgd"] = note("Method for the cone complementarity problem", default="apgd")
    tolerance: Positive = quantity(
        "m/s",
        "Largest residual, which times h is the overlap a step adds; a pure number for the other "
        "kinds than absolute",
        default=1e-4,
    )
    complementarity: Positive = quantity(
        "1",
        "Largest |impulse . velocity| of a contact at which a solve may stop, as a fraction of"
        " v_ref gamma_ref; unused by tolerance_kind thesis",
        default=1e-4,
    )
    tolerance_kind: Literal["absolute", "scaled", "thesis"] = note(
        "absolute: dual residual in m/s; scaled: divided by the step's reference speed; "
        "thesis: measure (2.37) of S. De, PhD thesis, University of Michigan 2021",
        default="absolute",
    )
    max_iterations: Whole = quantity("1", "Iterations per step at most", default=5000, ge=1)
    warm_start: Switch = note("Start from the impulses of the last step", default=True)
    recovery_speed: Positive | None = quantity(
        "m/s", "Largest speed at which overlap is pushed out; null: no bound", default=0.2
    )
    margin: Positive = quantity(
        "1", "Gap below which a pair is a contact, in smaller radii", default=0.02
    )
    skin: NonNegative = quantity(
        "1", "Extra gap kept in pair lists, in smallest radii", default=0.2
    )
    operator: Literal["matrix_free", "assembled"] = note(
        "How the Delassus operator is applied", default="matrix_free"
    )
    on_failure: Literal["continue_and_flag", "shrink_step", "stop"] = note(
        "What a step does that misses its tolerance", default="continue_and_flag"
    )
    stop_factor: Positive = quantity(
        "1", "The run stops when the residual exceeds this many tolerances", default=100.0, ge=1
    )


class Output(Model):
    """The trajectory file."""

    path: str = note(
        "File name of the trajectory in the output directory",
        default="run.h5",
        pattern=r"^[^/\\\x00-\x1f]+\.h5$",
        max_length=200,
    )
    interval: Positive | None = quantity(
        "s", "Time between frames; by default a hundredth of the run", default=None
    )
    fields: tuple[BodyField, ...] = note(
        "What a frame holds; position and gid always", default=("position", "velocity", "radius")
    )
    compression: Literal["none", "gzip"] = note("Compression of the frames", default="none")


class Checkpoint(Model):
    """Files from which a stopped run goes on."""

    interval: Positive | None = quantity(
        "s", "Time between checkpoints; by default a twentieth of the run", default=None
    )
    keep: Whole = quantity("1", "Number of newest checkpoints kept", default=2, ge=1)


class Scenario(Model):
    """A whole scene. `steps`, `output_every` and `checkpoint_every` count time steps."""

    name: str = note("Short name of the scene", default="", max_length=200)
    description: str = note("What the scene shows", default="", max_length=4000)
    seed: Whole = quantity("1", "Seed of every random number", default=0, ge=0, lt=2**63)
    domain: Domain = note("Region of interest")
    gravity: Vec3 = quantity("m/s^2", "Acceleration of gravity x, y, z", default=(0.0, 0.0, -9.81))
    materials: dict[Name, Material] = note("Materials by name", min_length=1)
    friction: Friction = note("Friction between materials", default=Friction())
    bodies: tuple[BodyGroup, ...] = note("Groups of bodies", min_length=1)
    walls: tuple[Wall, ...] = note("Planes and boxes, at rest or driven", default=())
    time: Time = note("Time step and end")
    contact: Contact = note("Contact solve", default=Contact())
    threads: Whole = quantity("1", "Threads per rank", default=1, ge=1, le=1024)
    output: Output = note("Trajectory", default=Output())
    checkpoint: Checkpoint = note("Checkpoints", default=Checkpoint())

    @property
    def steps(self) -> int:
        """Number of time steps of the whole run."""
        return round(self.time.end / self.time.step)

    @property
    def output_every(self) -> int:
        """Steps between frames."""
        return self._every(self.output.interval, parts=100)

    @property
    def checkpoint_every(self) -> int:
        """Steps between checkpoints."""
        return self._every(self.checkpoint.interval, parts=20)

    def _every(self, interval: float | None, parts: int) -> int:
        if interval is None:
            return max(1, round(self.steps / parts))
        return max(1, round(interval / self.time.step))


@dataclass(frozen=True)
class WallFaces:
    """All wall faces as arrays; face k is the kinematic body with id -(k + 1).

    name: w strings such as "box.z_min"; point, normal, velocity, amplitude: (w, 3) float64 in
    m, 1 (unit length), m/s, m; material: (w,) int32; frequency, phase: (w,) float64 in Hz, rad.
    Displacement at time t: velocity t + amplitude (sin(2 pi frequency t + phase) - sin(phase)).
    """

    name: tuple[str, ...]
    point: np.ndarray
    normal: np.ndarray
    material: np.ndarray
    velocity: np.ndarray
    amplitude: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray


def wall_name(wall: PlaneWall | BoxWall, index: int) -> str:
    """The wall's name in reports."""
    return wall.name or f"wall{index}"


def wall_faces(scenario: Scenario) -> WallFaces:
    """The faces of all walls, in the order of the scene; a box gives one per closed face."""
    materials = list(scenario.materials)
    names: list[str] = []
    planes: list[tuple[Vec3, Vec3]] = []
    owners: list[PlaneWall | BoxWall] = []
    for index, wall in enumerate(scenario.walls):
        for suffix, point, normal in _planes(wall):
            names.append(wall_name(wall, index) + suffix)
            planes.append((point, normal))
            owners.append(wall)
    motions = [wall.motion or Motion() for wall in owners]
    swings = [m.oscillation or Oscillation(amplitude=ZERO, frequency=1.0) for m in motions]
    normal = _rows([normal for _, normal in planes])
    return WallFaces(
        name=tuple(names),
        point=_rows([point for point, _ in planes]),
        normal=normal / np.linalg.norm(normal, axis=1, keepdims=True),
        material=np.array([materials.index(wall.material) for wall in owners], dtype=np.int32),
        velocity=_rows([motion.velocity for motion in motions]),
        amplitude=_rows([swing.amplitude for swing in swings]),
        frequency=np.array([swing.frequency for swing in swings], dtype=np.float64),
        phase=np.array([swing.phase for swing in swings], dtype=np.float64),
    )


def _planes(wall: PlaneWall | BoxWall) -> list[tuple[str, Vec3, Vec3]]:
    """(name suffix, point, inward normal) of each face."""
    if isinstance(wall, PlaneWall):
        return [("", wall.point, wall.normal)]
    faces = []
    for index, face in enumerate(FACES):
        if face in wall.open:
            continue
        axis, upper = divmod(index, 2)
        normal = [0.0, 0.0, 0.0]
        normal[axis] = -1.0 if upper else 1.0
        faces.append((f".{face}", wall.max if upper else wall.min, tuple(normal)))
    return faces


def _rows(vectors: list[Vec3]) -> np.ndarray:
    return np.array(vectors, dtype=np.float64).reshape(-1, 3)


def friction_table(scenario: Scenario) -> tuple[list[str], np.ndarray]:
    """Material names in the order of the scene and their symmetric (k, k) friction matrix."""
    names = list(scenario.materials)
    table = np.full((len(names), len(names)), scenario.friction.default)
    for pair in scenario.friction.pairs:
        a, b = (names.index(name) for name in pair.between)
        table[a, b] = table[b, a] = pair.mu
    return names, table


def frictional(scenario: Scenario) -> bool:
    """Whether any pair that can touch (body-body, body-wall) has friction."""
    names, table = friction_table(scenario)
    bodies = [names.index(group.material) for group in scenario.bodies]
    walls = [names.index(wall.material) for wall in scenario.walls]
    return bool((table[np.ix_(bodies, bodies + walls)] > 0).any())
