"""What the command line of `dem-mpi flow` asks for, checked before anything is read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from dem_mpi.errors import InputError
from dem_mpi.handoff import Selection, parse_gids

if TYPE_CHECKING:
    from stokes.background import BackgroundFlow

Problem = Literal["resistance", "mobility"]
Formulation = Literal["single", "combined"]
Box = tuple[float, float, float, float, float, float]
Vector = tuple[float, float, float]

WATER_DENSITY = 1000.0  # [kg/m^3]
WATER_VISCOSITY = 1e-3  # [Pa s]
_MOST_POINTS = 10**9


@dataclass(frozen=True)
class FlowOptions:
    """What to compute of which bodies in which fluid.

    factor       : of the bodies' lengths; None leaves the least gap that has a solution
    gravity      : [m/s^2] for mobility; None takes the run's
    grid, box    : points of a grid along x, y, z, and its corners (x0, x1, y0, y1, z0, z1) [m];
                   None stands around the bodies
    points       : file of points in place of a grid
    out, force   : file to write, and whether it may be replaced
    picture      : file to draw; plane: axis it is across, and where [m], None: through most bodies
    """

    frame: str = "last"
    selection: Selection = field(default_factory=Selection)
    factor: float | None = None
    viscosity: float = WATER_VISCOSITY
    background: BackgroundFlow | None = None
    problem: Problem = "resistance"
    gravity: Vector | None = None
    fluid_density: float = WATER_DENSITY
    tolerance: float = 1e-4
    formulation: Formulation = "single"
    max_iterations: int = 300
    grid: tuple[int, int, int] | None = None
    box: Box | None = None
    points: Path | None = None
    out: Path | None = None
    force: bool = False
    picture: Path | None = None
    plane: tuple[int, float | None] = (1, None)
    dry_run: bool = False
    threads: int = 1

    def __post_init__(self) -> None:
        """Check what one value alone, or two together, can violate. InputError names the flag."""
        _positive("--viscosity", self.viscosity)
        _finite("--gravity", self.gravity or ())
        if not (math.isfinite(self.fluid_density) and self.fluid_density >= 0.0):
            raise InputError(f"--fluid-density {self.fluid_density:g}: must be >= 0 and finite")
        if not 1e-12 <= self.tolerance <= 0.1:
            raise InputError(f"--tolerance {self.tolerance:g}: must be between 1e-12 and 0.1")
        _one_of("--problem", self.problem, get_args(Problem))
        _one_of("--formulation", self.formulation, get_args(Formulation))
        if self.factor is not None and not 0.0 < self.factor <= 1.0:
            raise InputError(
                f"--hydrodynamic-radius {self.factor:g}: must be auto, or a factor of the run's "
                "radii, > 0 and <= 1"
            )
        _check_box("--region", self.selection.region)
        _check_box("--grid-box", self.box)
        if self.grid is not None and self.points is not None:
            raise InputError("--grid and --points: give one of them")
        if self.box is not None and self.grid is None:
            raise InputError("--grid-box: says where the points of --grid are, give that too")


def parse_options(
    *,
    bodies: str | None = None,
    region: Box | None = None,
    hydrodynamic_radius: str = "auto",
    background: Sequence[str] = (),
    grid: str | None = None,
    plane: str = "y",
    **others: object,
) -> FlowOptions:
    """Options from the texts of a command line. Raises InputError for what breaks a rule."""
    return FlowOptions(
        selection=Selection(None if bodies is None else parse_gids(bodies), region),
        factor=None if hydrodynamic_radius == "auto" else _factor(hydrodynamic_radius),
        background=_background(background),
        grid=None if grid is None else _grid(grid),
        plane=_plane(plane),
        **others,
    )


def _factor(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(
            f"--hydrodynamic-radius {text}: must be auto, or a factor of the run's radii"
        ) from None


def _background(texts: Sequence[str]) -> BackgroundFlow | None:
    if not texts:
        return None
    from stokes.background import parse_background

    try:
        return parse_background(" ".join(texts))
    except ValueError as error:
        raise InputError(f"--background {error}") from None


def _grid(text: str) -> tuple[int, int, int]:
    parts = text.replace("x", ",").split(",")
    if len(parts) != 3 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise InputError(f"--grid {text}: must be three numbers of points, NX,NY,NZ")
    if math.prod(int(part) for part in parts) > _MOST_POINTS:
        raise InputError(f"--grid {text}: has more than {_MOST_POINTS:,} points")
    nx, ny, nz = (int(part) for part in parts)
    return nx, ny, nz


def _plane(text: str) -> tuple[int, float | None]:
    axis, equals, place = text.partition("=")
    try:
        if axis not in ("x", "y", "z") or (equals and not math.isfinite(float(place))):
            raise ValueError
    except ValueError:
        raise InputError(f"--slice {text}: must be x, y or z, or a place such as y=0.05") from None
    return "xyz".index(axis), float(place) if equals else None


def _positive(flag: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{flag} {value:g}: must be > 0 and finite")


def _finite(flag: str, values: Sequence[float]) -> None:
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"{flag} {' '.join(f'{v:g}' for v in values)}: must be finite")


def _one_of(flag: str, value: str, known: Sequence[str]) -> None:
    if value not in known:
        raise InputError(f"{flag} {value}: must be one of {', '.join(known)}")


def _check_box(flag: str, box: Box | None) -> None:
    if box is None:
        return
    _finite(flag, box)
    for axis, low, high in zip("xyz", box[::2], box[1::2], strict=True):
        if low > high:
            raise InputError(f"{flag}: {axis} from {low:g} to {high:g}: must rise")
