"""The scene as one frozen, checked model.

What one key alone, or one section alone, can violate is checked in the models (here, and in
`scene_bodies` and `scene_walls`); `scene_checks` holds the rules that join sections.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import ValidationInfo, field_validator

from dem_mpi.scene_base import (
    Model,
    Name,
    NonNegative,
    Positive,
    Region,
    Switch,
    Vec3,
    Whole,
    note,
    quantity,
)
from dem_mpi.scene_bodies import BodyGroup, Removal
from dem_mpi.scene_compress import Compress
from dem_mpi.scene_walls import Wall

BodyField = Literal[
    "position",
    "velocity",
    "angular_velocity",
    "orientation",
    "radius",
    "half_length",
    "shape",
    "gid",
    "material",
]


class Domain(Region):
    """The open region the simulation looks after; bodies may leave it."""

    on_leave: Literal["keep", "remove"] = note(
        "What happens to a body whose centre leaves the domain; either way it is counted",
        default="keep",
    )
    periodic: tuple[Literal["x", "y", "z"], ...] = note(
        "Axes along which the domain repeats: a body that leaves on one side comes in on the other",
        default=(),
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


class Scip(Model):
    """The interior point method, used by `solver: scip` and `solver: auto`."""

    max_iterations: Whole = quantity(
        "1", "Newton iterations per cone problem at most", default=60, ge=1
    )
    form: Literal["auto", "velocity", "contact"] = note(
        "Unknowns of the Newton systems: velocities of bodies, smaller in dense beds, or impulses "
        "of contacts, smaller in loose ones; auto: by their counts",
        default="auto",
    )
    linear: Literal["mumps", "cg"] = note(
        "Newton systems by factors of MUMPS, or in less memory by conjugate gradients",
        default="mumps",
    )
    preconditioner: Literal["icc", "block_jacobi", "low_rank"] = note(
        "Of conjugate gradients: incomplete Cholesky factors, one a rank; the 6 x 6 blocks of the "
        "bodies; or Cholesky factors with far blocks of low rank, less memory than full ones",
        default="icc",
    )
    ordering: Literal["auto", "amd", "metis", "scotch", "pord"] = note(
        "Order of elimination, which memory and time of a factorisation depend on; auto: MUMPS's "
        "choice. Tiny or nearly full matrices take amd",
        default="auto",
    )
    workspace: Whole = quantity(
        "1",
        "Extra working space of a factorisation, in percent of MUMPS's estimate",
        default=35,
        ge=1,
        le=1000,
    )
    memory: Positive | None = quantity(
        "MB",
        "Memory a rank may use for factors: scip ends with a message where it needs more, auto "
        "goes on with gradients; null: no limit, for auto what the machine has",
        default=None,
    )

    @field_validator("linear")
    @classmethod
    def _form_fits(cls, linear: str, info: ValidationInfo) -> str:
        if linear == "cg" and info.data.get("form") == "contact":
            raise ValueError("cg solves for velocities of bodies: set form: velocity or auto")
        return linear


class Contact(Model):
    """The contact solve of each step and its tolerance."""

    solver: Literal["apgd", "scip", "auto"] = note(
        "Method for the contact problem of a step. apgd: gradients, many cheap iterations, any "
        "size; scip: interior point, few iterations with a sparse factorisation each, for tight "
        "tolerances; auto: apgd, then scip where counts promise less work",
        default="apgd",
    )
    law: Literal["ccp", "coulomb"] = note(
        "Law of friction. ccp: convex, contacts that slide hover at a gap of h mu |v_t|; coulomb: "
        "they stay closed, for several such problems a step; not for tight tolerances in beds",
        default="ccp",
    )
    tolerance: Positive = quantity(
        "m/s",
        "Largest residual, which times h is the overlap a step adds; a pure number for the other "
        "kinds than absolute",
        default=1e-4,
    )
    complementarity: Positive = quantity(
        "1",
        "Largest |impulse . velocity| of a contact at which a solve may stop, as a fraction of"
        " v_ref gamma_ref (for a contact lighter than most, of its own gamma_ref); unused by"
        " tolerance_kind thesis",
        default=1e-4,
    )
    tolerance_kind: Literal["absolute", "scaled", "thesis"] = note(
        "absolute: dual residual in m/s; scaled: divided by the step's reference speed; "
        "thesis: measure (2.37) of S. De, PhD thesis, University of Michigan 2021",
        default="absolute",
    )
    max_iterations: Whole = quantity(
        "1", "Iterations of apgd per cone problem at most, under auto too", default=5000, ge=1
    )
    max_outer: Whole = quantity(
        "1", "Cone problems of a step at most, under law coulomb", default=100, ge=1
    )
    scip: Scip = note("Interior point method", default=Scip())
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
        "1",
        "The run stops when a residual, of velocities or of complementarity, exceeds its tolerance "
        "this many times",
        default=100.0,
        ge=1,
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
    walls: tuple[Wall, ...] = note("Surfaces that hold the bodies, at rest or driven", default=())
    removal: tuple[Removal, ...] = note("Regions in which bodies are taken out", default=())
    time: Time = note("Time step and end")
    contact: Contact = note("Contact solve", default=Contact())
    threads: Whole = quantity("1", "Threads per rank", default=1, ge=1, le=1024)
    output: Output = note("Trajectory", default=Output())
    checkpoint: Checkpoint = note("Checkpoints", default=Checkpoint())
    compress: Compress | None = note(
        "Compressed archive of the frames, by default none", default=None
    )

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


def only_spheres(scenario: Scenario) -> bool:
    """Whether every body that the scene has or will have is a sphere."""
    return all(group.shape == "sphere" for group in scenario.bodies)
