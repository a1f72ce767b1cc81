"""Layer potentials: which, of which densities, and the sums that give velocity, pressure, stress.

The stress of a double layer, rows in the order 00, 11, 22, 12, 02, 01, with W the symmetric
matrix of the weights of `stresslet` (off the diagonal: density times normal in both orders):
    sigma = 4 delta tr(W)/r^3 + 6 (r (W r)^T + (W r) r^T)/r^5 - 60 r r^T (r.W r)/(2 r^7),
W_ii twice the weight; its trace is -3 times the pressure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from numba.extending import register_jitable
from numpy.typing import ArrayLike

from stokes.fmm.kernels import (
    Kernel,
    constant,
    inverse_distance,
    stokes_stress,
    stokeslet,
    stokeslet_pressure,
    stresslet,
    stresslet_pressure,
)

Quantity = Literal["velocity", "pressure", "stress"]


@register_jitable
def _stresslet_stress(x, y, z, w):
    two, six, sixty = constant(2.0, x), constant(6.0, x), constant(60.0, x)
    inverse = inverse_distance(x * x + y * y + z * z)
    inverse2 = inverse * inverse
    inverse3 = inverse2 * inverse
    inverse5 = six * (inverse3 * inverse2)
    # v = W r, and r.W r = 2 (the form of the weights)
    a = two * x * w[0] + y * w[5] + z * w[4]
    b = x * w[5] + two * y * w[1] + z * w[3]
    c = x * w[4] + y * w[3] + two * z * w[2]
    form = constant(0.5, x) * (x * a + y * b + z * c)
    trace = constant(4.0, x) * (w[0] + w[1] + w[2]) * inverse3
    s = -sixty * form * (inverse3 * inverse2 * inverse2)
    return (
        trace + two * inverse5 * x * a + s * x * x,
        trace + two * inverse5 * y * b + s * y * y,
        trace + two * inverse5 * z * c + s * z * z,
        inverse5 * (y * c + z * b) + s * y * z,
        inverse5 * (x * c + z * a) + s * x * z,
        inverse5 * (x * b + y * a) + s * x * y,
    )


# Both sides are symmetric tensors, and the kernel is symmetric between them.
_PAIRS = tuple(tuple((min(i, j), max(i, j)) for j in range(6)) for i in range(6))
_NUMBER = {pair: n for n, pair in enumerate(sorted(set(sum(_PAIRS, ()))))}

stresslet_stress = Kernel(
    *("stresslet_stress", _stresslet_stress, 6, 6),
    degree=-3.0,
    parity=1,
    entry=tuple(tuple(_NUMBER[pair] for pair in row) for row in _PAIRS),
)

#: (single layer's kernel, double layer's kernel) of every quantity.
LAYER_KERNELS = {
    "velocity": (stokeslet, stresslet),
    "pressure": (stokeslet_pressure, stresslet_pressure),
    "stress": (stokes_stress, stresslet_stress),
}

# Powers of 1/r in each quantity's kernels, above the first: single layer, double layer.
_ORDER = {"velocity": (0, 1), "pressure": (1, 2), "stress": (1, 2)}
_ROWS = {"velocity": 3, "pressure": 1, "stress": 6}


@dataclass(frozen=True)
class Layers:
    """Potential whose near part is wanted: a (single layer) + b (double layer) of each body.

    single, double : a and b, one number for all bodies or one for each (`stokes.sources`); None
                     leaves a layer out
    """

    single: ArrayLike | None = 1.0
    double: ArrayLike | None = None
    quantity: Quantity = "velocity"

    def __post_init__(self) -> None:
        if self.single is None and self.double is None:
            raise ValueError("Layers: a single or a double layer must be given")
        if self.quantity not in LAYER_KERNELS:
            raise ValueError(f"quantity {self.quantity!r}: must be one of {tuple(LAYER_KERNELS)}")

    @property
    def order(self) -> int:
        """Order of the strongest kernel: 0 for 1/r, 1 for 1/r^2, 2 for 1/r^3."""
        single, double = _ORDER[self.quantity]
        return single if self.double is None else double

    @property
    def kernels(self) -> tuple[Kernel | None, Kernel | None]:
        """The kernels of the sums over sources; None for a layer that is left out."""
        single, double = LAYER_KERNELS[self.quantity]
        return (
            None if self.single is None else single,
            None if self.double is None else double,
        )

    @property
    def rows(self) -> int:
        """Components of the quantity: 3, 1 or 6."""
        return _ROWS[self.quantity]
