"""What a user may ask of a suspension, and what it says about itself."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Literal, get_args

from stokes.fmm import FmmOptions, FmmReport
from stokes.resolution import Resolution

FormulationName = Literal["single", "combined"]
PreconditionerName = Literal["auto", "body", "neighbours"]

# Parts of the tolerance that each source of error is given, together less than one.
_RESIDUAL, _FMM, _NEAR, _RESOLUTION = 0.3, 0.2, 0.1, 0.2
_LEAST = 2e-14  # no sum of thousands of terms is more accurate
# Gap below which residuals stall at the errors of sums: at 0.002 10 iterations became 31, at 0.01
# 11 became 14.
_SMALL_GAP = 0.03


@dataclass(frozen=True)
class SuspensionOptions:
    """Overrides of what `Suspension` would choose from the tolerance.

    preconditioner : "body" inverts every body alone; "neighbours" inverts also what close bodies
                     on one line do to one another; "auto" takes that for gaps below a tenth of the
                     radius. Around both the forces between all bodies, if motions are given
    resolution     : of every body, in place of the one chosen from tolerance and neighbours
    turn_spheres   : lay the axis of a sphere's grid through its nearest neighbour, where few
                     azimuthal modes resolve what happens in the gap
    least_gap      : smallest gap allowed, over the smaller bounding radius of both bodies
    max_iterations : of GMRES; restart: iterations between restarts, each of which keeps a vector
    residual_tolerance, fmm_tolerance, near_tolerance, resolution_tolerance : the parts of the
                     tolerance given to GMRES, the fast sums, near corrections and the grids
    fmm            : of the fast sums
    threads        : of this rank
    memory         : most bytes on a rank; what would take more is refused before any work
    """

    preconditioner: PreconditionerName = "auto"
    resolution: Resolution | None = None
    turn_spheres: bool = True
    least_gap: float = 1e-3
    max_iterations: int = 300
    restart: int = 100
    residual_tolerance: float | None = None
    fmm_tolerance: float | None = None
    near_tolerance: float | None = None
    resolution_tolerance: float | None = None
    fmm: FmmOptions = field(default_factory=FmmOptions)
    threads: int = 1
    memory: float | None = None

    def __post_init__(self) -> None:
        """Raise ValueError, with the option's name, for a value outside its rule."""
        if self.preconditioner not in get_args(PreconditionerName):
            allowed = get_args(PreconditionerName)
            raise ValueError(f"preconditioner = {self.preconditioner!r}: must be one of {allowed}")
        for name in ("max_iterations", "restart", "threads"):
            value = getattr(self, name)
            if not (isinstance(value, Integral) and value >= 1):
                raise ValueError(f"{name} = {value!r}: must be an integer >= 1")
        for name in ("residual", "fmm", "near", "resolution"):
            value = getattr(self, f"{name}_tolerance")
            if value is not None:
                check_tolerance(f"{name}_tolerance", value)
        if not (isinstance(self.least_gap, Real) and self.least_gap > 0.0):
            raise ValueError(f"least_gap = {self.least_gap!r}: must be a number > 0")
        if self.memory is not None and not (isinstance(self.memory, Real) and self.memory > 0.0):
            raise ValueError(f"memory = {self.memory!r}: must be a number of bytes > 0")


def check_tolerance(name: str, value: float) -> None:
    """ValueError unless it is a number between 0 and 1."""
    if not (isinstance(value, Real) and 0.0 < value < 1.0):
        raise ValueError(f"{name} = {value!r}: must be a number between 0 and 1")


@dataclass(frozen=True)
class Tolerances:
    """The parts of one tolerance: relative errors of velocities on the surfaces."""

    residual: float
    fmm: float
    near: float
    resolution: float

    @classmethod
    def of(cls, tolerance: float, options: SuspensionOptions) -> Tolerances:
        """Shares of the tolerance, but what the options give."""
        parts = {
            "residual": (_RESIDUAL, options.residual_tolerance),
            "fmm": (_FMM, options.fmm_tolerance),
            "near": (_NEAR, options.near_tolerance),
            "resolution": (_RESOLUTION, options.resolution_tolerance),
        }
        return cls(
            **{
                name: max(_LEAST, share * tolerance) if given is None else float(given)
                for name, (share, given) in parts.items()
            }
        )

    def for_gap(self, gap: float, options: SuspensionOptions) -> Tolerances:
        """The same with smaller ones for what is large in gaps. Given tolerances are kept.

        gap : least gap, over the radius. Tractions in it grow like 1/gap^2 of the velocities, over
        an area in proportion to it, and cancel in sums. A residual is a mean over all surfaces: one
        that concentrates in that area is some 1/sqrt(gap) as large there, and if the bodies seem to
        approach, the fluid between them flows off 1/sqrt(gap) as fast again. In the smallest gaps
        errors of sums are amplified until GMRES iterates on them: fifty times at 0.002.
        """
        share = min(1.0, gap)
        sums = math.sqrt(share) if gap > _SMALL_GAP else 0.5 * share
        scaled = {"residual": min(1.0, 3.0 * gap), "fmm": sums, "near": share}
        return replace(
            self,
            **{
                name: max(_LEAST, factor * getattr(self, name))
                for name, factor in scaled.items()
                if getattr(options, f"{name}_tolerance") is None
            },
        )


@dataclass(frozen=True)
class Level:
    """A curve at a resolution, and on how many bodies of all ranks it stands."""

    curve: str
    resolution: Resolution
    bodies: int


@dataclass(frozen=True)
class SuspensionReport:
    """What a suspension is made of, of all ranks together unless said otherwise.

    levels       : curves and resolutions in use
    least_gap    : between any two bodies, over the smaller bounding radius; inf without close ones
    applications : of the operator, so far
    seconds      : wall clock of this rank by phase, so far: "geometry", "kernels",
                   "factorisation", "near plan", "fmm plan", "fmm", "near", "self",
                   "preconditioner" (with its making), "krylov" (all else of GMRES)
    memory       : bytes of this rank by part
    near_pairs   : of a node and a panel of this rank's that the plain rule cannot join
    fmm          : the plan of the fast sums; None before the first solution
    """

    bodies: int
    nodes: int
    levels: tuple[Level, ...]
    least_gap: float
    tolerances: Tolerances
    applications: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    memory: Mapping[str, int] = field(default_factory=dict)
    near_pairs: int = 0
    fmm: FmmReport | None = None


@dataclass(frozen=True)
class SuspensionEstimate:
    """What a solution would take, counted without work on the bodies' surfaces.

    nodes          : of all ranks; unknowns three times as many
    levels         : curves and resolutions
    tolerances     : what they and the sums are made for
    matrix_bytes   : of the operators of shapes, on the rank that has most
    vector_bytes   : of GMRES's vectors, on the rank that has most
    near_bytes     : of the near corrections, roughly, on the rank that has most
    fmm_bytes      : of the fast sums, roughly, on the rank that has most
    factorisation_flops : of all shapes of the rank that has most
    """

    bodies: int
    nodes: int
    levels: tuple[Level, ...]
    tolerances: Tolerances
    matrix_bytes: int
    vector_bytes: int
    near_bytes: int
    fmm_bytes: int
    factorisation_flops: float

    @property
    def bytes(self) -> int:
        """Memory of the rank that has most."""
        return self.matrix_bytes + self.vector_bytes + self.near_bytes + self.fmm_bytes
