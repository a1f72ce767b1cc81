"""Flows that bodies are put into: solutions of the Stokes equations in all of space.

Every flow is u(x) [m/s] with div u = 0 and viscosity * Laplacian u = grad p. None of them has
walls: a Poiseuille flow goes on, as the same polynomial, beyond the tube whose profile it has.

Written as text, for command lines and files, a flow is `kind:numbers[,axes][@origin]`:

    uniform:ux,uy,uz            u = (ux, uy, uz)
    shear:rate[,xz]             u_x = rate z: along the first axis, growing along the second
    extension:rate[,z]          u_z = rate z, u_x = -rate x / 2, u_y = -rate y / 2
    extension:rate,xz           u_x = rate x, u_z = -rate z
    linear:g11,g12,...,g33      u_i = sum over j of g_ij x_j
    poiseuille:speed,a[,x]      u_x = speed (1 - (y^2 + z^2) / a^2): a tube of radius a along x
    poiseuille:speed,a,xz       u_x = speed (1 - z^2 / a^2): between planes 2 a apart

x, y, z are counted from the origin given behind `@`, or from that of the coordinates. Several
texts with blanks between are the sum of their flows.

Symbols: n points; d = x - origin; G_ij = du_i/dx_j [1/s]; p pressure [Pa], zero at the origin.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = tuple[float, float, float]
_AXES = "xyz"
_ORIGIN: Vector = (0.0, 0.0, 0.0)


class BackgroundFlow(ABC):
    """A flow without bodies; immutable and hashable."""

    @abstractmethod
    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) [m/s] at points (n, 3) [m]."""

    @abstractmethod
    def velocity_gradient(self, points: NDArray) -> NDArray:
        """G_ij = du_i/dx_j, (n, 3, 3) [1/s], at points (n, 3) [m]."""

    def pressure(self, points: NDArray, viscosity: float = 1.0) -> NDArray:
        """p (n,) [Pa] at points (n, 3) [m] of a fluid of this viscosity [Pa s]."""
        return np.zeros(len(_rows(points)))

    def stress(self, points: NDArray, viscosity: float = 1.0) -> NDArray:
        """-p delta_ij + viscosity (G_ij + G_ji), (n, 3, 3) [Pa], at points (n, 3) [m]."""
        gradient = self.velocity_gradient(points)
        stress = viscosity * (gradient + np.swapaxes(gradient, 1, 2))
        stress[:, range(3), range(3)] -= self.pressure(points, viscosity)[:, None]
        return stress

    @property
    @abstractmethod
    def text(self) -> str:
        """The flow as `parse_background` reads it, to the last digit."""


@dataclass(frozen=True)
class UniformFlow(BackgroundFlow):
    """The same velocity [m/s] everywhere."""

    flow: Vector = _ORIGIN

    def __post_init__(self) -> None:
        """Check the velocity. ValueError unless it is three finite numbers."""
        object.__setattr__(self, "flow", _vector(self.flow, "velocity"))

    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) [m/s]."""
        return np.tile(self.flow, (len(_rows(points)), 1))

    def velocity_gradient(self, points: NDArray) -> NDArray:
        """Zero, (n, 3, 3)."""
        return np.zeros((len(_rows(points)), 3, 3))

    @property
    def text(self) -> str:
        """As `parse_background` reads it."""
        return f"uniform:{_numbers(self.flow)}"


@dataclass(frozen=True)
class LinearFlow(BackgroundFlow):
    """u = G (x - origin), gradient G_ij = du_i/dx_j [1/s] of trace zero, origin [m]."""

    gradient: tuple[Vector, Vector, Vector]
    origin: Vector = _ORIGIN

    def __post_init__(self) -> None:
        """Check gradient and origin. ValueError unless they are finite, the trace zero."""
        G = np.asarray(self.gradient, dtype=np.float64)
        if G.shape != (3, 3) or not np.isfinite(G).all():
            raise ValueError(f"velocity gradient {self.gradient}: must be 3 x 3 finite numbers")
        if abs(np.trace(G)) > 1e-14 * np.abs(np.diag(G)).sum():
            raise ValueError(
                f"velocity gradient of trace {np.trace(G):g}: must be 0, the fluid keeps its volume"
            )
        object.__setattr__(self, "gradient", tuple(tuple(row) for row in G.tolist()))
        object.__setattr__(self, "origin", _vector(self.origin, "origin"))

    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) [m/s]."""
        return (_rows(points) - self.origin) @ np.array(self.gradient).T

    def velocity_gradient(self, points: NDArray) -> NDArray:
        """G, (n, 3, 3) [1/s], the same everywhere."""
        return np.tile(np.array(self.gradient), (len(_rows(points)), 1, 1))

    @property
    def text(self) -> str:
        """As `parse_background` reads it."""
        return f"linear:{_numbers(sum(self.gradient, ()))}{_at(self.origin)}"


@dataclass(frozen=True)
class PoiseuilleFlow(BackgroundFlow):
    """The parabola of a tube or of two planes: speed [m/s] on the axis, zero half_width [m] away.

    axes : one letter, the direction of flow, for a tube; two for planes, the second their normal
    """

    speed: float
    half_width: float
    axes: str = "x"
    origin: Vector = _ORIGIN

    def __post_init__(self) -> None:
        """Check the numbers and axes. ValueError says which breaks what rule."""
        if not math.isfinite(self.speed):
            raise ValueError(f"speed {self.speed:g}: must be finite")
        if not (math.isfinite(self.half_width) and self.half_width > 0.0):
            raise ValueError(f"half width {self.half_width:g}: must be > 0 and finite")
        _check_axes(self.axes, (1, 2))
        object.__setattr__(self, "origin", _vector(self.origin, "origin"))

    @property
    def _profile(self) -> tuple[NDArray, NDArray]:
        """Direction of flow (3,), and (3,) of 1 for the axes that speed depends on, else 0."""
        direction = _unit(self.axes[0])
        across = 1.0 - direction if len(self.axes) == 1 else _unit(self.axes[1])
        return direction, across

    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) [m/s]."""
        direction, across = self._profile
        distance = (_rows(points) - self.origin) / self.half_width
        return (self.speed * (1.0 - distance**2 @ across))[:, None] * direction

    def velocity_gradient(self, points: NDArray) -> NDArray:
        """G, (n, 3, 3) [1/s]."""
        direction, across = self._profile
        slope = -2.0 * self.speed / self.half_width**2 * (_rows(points) - self.origin) * across
        return direction[None, :, None] * slope[:, None, :]

    def pressure(self, points: NDArray, viscosity: float = 1.0) -> NDArray:
        """p = viscosity * Laplacian u . d, (n,) [Pa]."""
        direction, across = self._profile
        slope = -2.0 * across.sum() * viscosity * self.speed / self.half_width**2
        return slope * ((_rows(points) - self.origin) @ direction)

    @property
    def text(self) -> str:
        """As `parse_background` reads it."""
        numbers = _numbers((self.speed, self.half_width))
        return f"poiseuille:{numbers},{self.axes}{_at(self.origin)}"


@dataclass(frozen=True)
class SumOfFlows(BackgroundFlow):
    """Several flows at once."""

    flows: tuple[BackgroundFlow, ...]

    def velocity(self, points: NDArray) -> NDArray:
        """u (n, 3) [m/s]."""
        return sum((f.velocity(points) for f in self.flows), np.zeros_like(_rows(points)))

    def velocity_gradient(self, points: NDArray) -> NDArray:
        """G, (n, 3, 3) [1/s]."""
        zero = np.zeros((len(_rows(points)), 3, 3))
        return sum((f.velocity_gradient(points) for f in self.flows), zero)

    def pressure(self, points: NDArray, viscosity: float = 1.0) -> NDArray:
        """p (n,) [Pa]."""
        zero = np.zeros(len(_rows(points)))
        return sum((f.pressure(points, viscosity) for f in self.flows), zero)

    @property
    def text(self) -> str:
        """As `parse_background` reads it."""
        return " ".join(f.text for f in self.flows)


def shear_flow(rate: float, axes: str = "xz", origin: Sequence[float] = _ORIGIN) -> LinearFlow:
    """Simple shear at `rate` [1/s]: along the first of two axes, growing along the second."""
    _check_axes(axes, (2,))
    G = np.outer(_unit(axes[0]), rate * _unit(axes[1]))
    return LinearFlow(G, tuple(origin))


def extensional_flow(rate: float, axes: str = "z", origin: Sequence[float] = _ORIGIN) -> LinearFlow:
    """Stretching at `rate` [1/s] along one axis, alike across it, or in the plane of two."""
    _check_axes(axes, (1, 2))
    along = _unit(axes[0])
    across = 0.5 * (1.0 - along) if len(axes) == 1 else _unit(axes[1])
    return LinearFlow(rate * np.diag(along - across), tuple(origin))


def parse_background(text: str) -> BackgroundFlow:
    """The flow of a text, see the head of this module; no text is a fluid at rest.

    Raises ValueError with what is wrong, the rule and the forms there are.
    """
    flows = tuple(_parse_one(word) for word in text.split())
    if not flows:
        return UniformFlow()
    return flows[0] if len(flows) == 1 else SumOfFlows(flows)


# ---- text ----------------------------------------------------------------------------------

# Numbers that each kind takes, and how many axes may follow.
_FORMS = {
    "uniform": (3, (), "uniform:ux,uy,uz"),
    "shear": (1, (2,), "shear:rate[,xz]"),
    "extension": (1, (1, 2), "extension:rate[,z]"),
    "linear": (9, (), "linear:g11,g12,...,g33"),
    "poiseuille": (2, (1, 2), "poiseuille:speed,half_width[,x]"),
}


def _parse_one(word: str) -> BackgroundFlow:
    kind, _, rest = word.partition(":")
    if kind not in _FORMS:
        raise ValueError(f"'{word}': must be one of {', '.join(f[2] for f in _FORMS.values())}")
    count, lengths, form = _FORMS[kind]
    values, at, place = rest.partition("@")
    items = values.split(",")
    axes = items.pop() if lengths and items[-1].isalpha() and items[-1] not in _NO_AXES else ""
    try:
        numbers = [float(item) for item in items]
        origin = tuple(float(item) for item in place.split(",")) if at else _ORIGIN
        if len(numbers) != count or len(origin) != 3 or (at and kind == "uniform"):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"'{word}': must be {form}{'' if kind == 'uniform' else '[@x,y,z]'}"
        ) from None
    try:
        return _make(kind, numbers, (axes,) if axes else (), origin)
    except ValueError as error:
        raise ValueError(f"'{word}': {error}") from None


_NO_AXES = ("nan", "inf")  # words that are numbers


def _make(
    kind: str, numbers: Sequence[float], axes: tuple[str, ...], origin: Vector
) -> BackgroundFlow:
    if kind == "uniform":
        return UniformFlow(tuple(numbers))
    if kind == "shear":
        return shear_flow(*numbers, *axes, origin=origin)
    if kind == "extension":
        return extensional_flow(*numbers, *axes, origin=origin)
    if kind == "linear":
        return LinearFlow(np.reshape(numbers, (3, 3)), origin)
    return PoiseuilleFlow(*numbers, *axes, origin=origin)


def _check_axes(axes: str, lengths: tuple[int, ...]) -> None:
    if len(axes) not in lengths or len(set(axes)) != len(axes) or not set(axes) <= set(_AXES):
        examples = " or ".join({1: "one such as x", 2: "two such as xz"}[k] for k in lengths)
        raise ValueError(f"axes '{axes}': must be {examples}")


def _unit(axis: str) -> NDArray:
    return np.eye(3)[_AXES.index(axis)]


def _vector(value: ArrayLike, name: str) -> Vector:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name} {value}: must be three finite numbers")
    return tuple(array.tolist())


def _rows(points: ArrayLike) -> NDArray:
    return np.asarray(points, dtype=np.float64).reshape(-1, 3)


def _numbers(values: Sequence[float]) -> str:
    return ",".join(repr(float(value)).removesuffix(".0") for value in values)


def _at(origin: Vector) -> str:
    return "" if origin == _ORIGIN else f"@{_numbers(origin)}"
