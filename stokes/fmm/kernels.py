"""Kernels k(r) of the sums phi_i = sum_j k(x_i - y_j) w_j, each defined by one compiled function.

The argument is always r = target - source = (x, y, z). A kernel maps the n_in components of a
source's weight to n_out components at the target. A kernel of one's own is one function

    @register_jitable
    def yukawa_apply(x, y, z, w):
        r2 = x * x + y * y + z * z
        inverse = inverse_distance(r2)
        return (w[0] * inverse * decay(r2 * inverse),)

    yukawa = Kernel("yukawa", yukawa_apply, 1, 1, parity=1)

at the top level of a module (numba's disk cache refers to it by its name; a kernel whose file has
been edited is compiled anew, but functions it takes from third files are not watched). Rules:

- A singular kernel vanishes at r = 0, which leaves out the term of a source on itself. Written in
  powers of `inverse_distance` it does so without a branch, and the loop over sources vectorises.
- For the use of single precision no literal may promote: `times(3.0, x)` instead of `3.0 * x`.

Symbols: r2 = |r|^2, `inverse` = 1/|r|. Constants such as 1/(8 pi viscosity) are left to the
caller; the Stokes kernels share the one prefactor 1/(8 pi viscosity).
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
from numba import types
from numba.extending import overload, register_jitable
from numpy.typing import ArrayLike, NDArray

from stokes.fmm._intrinsics import bits, from_bits, load_components

Indices = tuple[int, ...]

SCALAR: tuple[Indices, ...] = ((),)
VECTOR: tuple[Indices, ...] = ((0,), (1,), (2,))
TENSOR: tuple[Indices, ...] = tuple(itertools.product(range(3), repeat=2))
SYMMETRIC: tuple[Indices, ...] = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
SYMMETRIC_THIRD: tuple[Indices, ...] = (
    *((0, 0, 0), (1, 1, 1), (2, 2, 2), (0, 0, 1), (0, 0, 2)),
    *((0, 1, 1), (1, 1, 2), (0, 2, 2), (1, 2, 2), (0, 1, 2)),
)


@dataclass(frozen=True)
class Kernel:
    """A kernel: its function and what the fast methods may know of it.

    apply       compiled on use; apply(x, y, z, w) -> tuple of n_out numbers, w a tuple of n_in
    degree      k(s r) = s^degree k(r) for s > 0; None if the kernel is not homogeneous
    parity      k(-r) = parity k(r) in all entries; 0 if neither even nor odd
    inputs, outputs   tensor indices of each component, from which follows how it changes under
                rotations: scalars ((),), vectors ((0,), (1,), (2,)), ...; default: by number
    entry       (n_out, n_in) number of the distinct component in each entry; default: all differ
    smooth      infinitely smooth at the origin (no near field is needed where boxes touch)
    length      apply sees r / length
    factor      the result is multiplied by it
    single      apply computes in single precision when its arguments are single
    transpose   name in `KERNELS` of the kernel k(-r)^T
    base, derivative  this kernel is the gradient of `base` in the target ("target", the last
                index of an output) or in the source ("source", the last index of an input)
    """

    name: str
    apply: Callable
    n_in: int
    n_out: int
    degree: float | None = None
    parity: int = 0
    inputs: tuple[Indices, ...] = ()
    outputs: tuple[Indices, ...] = ()
    entry: tuple[Indices, ...] = ()
    smooth: bool = False
    length: float = 1.0
    factor: float = 1.0
    single: bool = False
    transpose: str | None = None
    base: Kernel | None = None
    derivative: str | None = None

    def __post_init__(self) -> None:
        if not self.inputs:
            object.__setattr__(self, "inputs", _components(self.n_in))
        if not self.outputs:
            object.__setattr__(self, "outputs", _components(self.n_out))
        if not self.entry:
            object.__setattr__(self, "entry", _all_distinct(self.n_out, self.n_in))
        self._check()

    def _check(self) -> None:
        shape = (self.n_out, self.n_in)
        if (len(self.outputs), len(self.inputs)) != shape:
            raise ValueError(f"kernel {self.name}: {shape} components need as many tensor indices")
        if np.shape(self.entry) != shape:
            raise ValueError(f"kernel {self.name}: entry must have the shape {shape}")
        if set(itertools.chain(*self.entry)) != set(range(self.n_unique)):
            raise ValueError(f"kernel {self.name}: entry must number the components from 0")
        if not (self.length > 0.0 and math.isfinite(self.length)):
            raise ValueError(f"kernel {self.name}: length = {self.length}: must be > 0")
        if self.parity not in (-1, 0, 1):
            raise ValueError(f"kernel {self.name}: parity = {self.parity}: must be -1, 0 or 1")

    @property
    def n_unique(self) -> int:
        """Number of distinct components of the (n_out, n_in) matrix."""
        return 1 + max(itertools.chain(*self.entry))

    @property
    def homogeneous(self) -> bool:
        """Whether k(s r) = s^degree k(r)."""
        return self.degree is not None

    def matrix(self, r: ArrayLike) -> NDArray:
        """k(r) for points r (k, 3): array (k, n_out, n_in) float64."""
        points = np.ascontiguousarray(np.atleast_2d(np.asarray(r, np.float64)) / self.length)
        out = np.empty((len(points), self.n_out, self.n_in))
        _matrix(self.apply, self.n_in, self.n_out, digest(self.apply))(
            points, np.eye(self.n_in), out
        )
        return self.factor * out

    def unique(self, r: ArrayLike) -> NDArray:
        """The distinct components of k(r) for points r (k, 3): array (k, n_unique) float64."""
        first = np.unique(np.ravel(self.entry), return_index=True)[1]
        matrix = self.matrix(r)
        return np.ascontiguousarray(matrix.reshape(len(matrix), -1)[:, first])

    def rotate(self, rotation: ArrayLike) -> tuple[NDArray, NDArray]:
        """Signed permutations (R_out, R_in) with k(Q r) = R_out k(r) R_in^T.

        rotation: (3, 3), one of the 48 signed permutations Q that map the cube on itself.
        """
        q = np.asarray(rotation, np.float64)
        return _rotate_components(self.outputs, q), _rotate_components(self.inputs, q)

    def transposed(self) -> Kernel:
        """The kernel k(-r)^T of the transposed sum: <u, K v> = <K^T u, v>."""
        if self.transpose is None:
            raise ValueError(f"kernel {self.name}: no kernel is known for its transpose")
        if self.transpose == self.name:
            return self
        return replace(KERNELS[self.transpose], length=self.length, factor=self.factor)


def digest(apply: Callable) -> str:
    """Fingerprint of the sources that define a kernel: its file's and this file's.

    The loops over pairs carry it as a constant, so that their disk cache knows edited kernels.
    """
    try:
        text = Path(inspect.getsourcefile(apply) or "").read_bytes()
    except (OSError, TypeError):  # typed in at a prompt
        text = apply.__code__.co_code + repr(apply.__code__.co_consts).encode()
    return hashlib.sha256(text + Path(__file__).read_bytes()).hexdigest()


@functools.cache
def _matrix(apply: Callable, n_in: int, n_out: int, digest: str) -> Callable:
    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def evaluate(points: NDArray, identity: NDArray, out: NDArray) -> None:
        _ = digest  # a cell of this closure: part of the key of the disk cache
        for k in range(len(points)):
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            for j in range(n_in):
                column = apply(x, y, z, load_components(identity, j, n_in))
                for i in range(n_out):
                    out[k, i, j] = column[i]

    return evaluate


def _components(number: int) -> tuple[Indices, ...]:
    """Tensor indices by number of components: scalar, vector, symmetric, general, third rank."""
    known = {len(c): c for c in (SCALAR, VECTOR, SYMMETRIC, TENSOR, SYMMETRIC_THIRD)}
    if number not in known:
        raise ValueError(f"{number} components: name their tensor indices (inputs, outputs)")
    return known[number]


def _all_distinct(n_out: int, n_in: int) -> tuple[Indices, ...]:
    return tuple(tuple(range(i * n_in, (i + 1) * n_in)) for i in range(n_out))


def _entries(
    outputs: tuple[Indices, ...], inputs: tuple[Indices, ...], key: Callable[[Indices], Indices]
) -> tuple[Indices, ...]:
    """Number the entries so that equal keys of the joint index (output, input) share a number."""
    number: dict[Indices, int] = {}
    return tuple(tuple(number.setdefault(key(o + i), len(number)) for i in inputs) for o in outputs)


def _sorted(indices: Iterable[int]) -> Indices:
    return tuple(sorted(indices))


def _rotate_components(components: tuple[Indices, ...], q: NDArray) -> NDArray:
    axis, sign = np.argmax(np.abs(q), axis=0), q.sum(axis=0)  # Q e_a = sign_a e_axis_a
    number = {p: c for c, index in enumerate(components) for p in itertools.permutations(index)}
    number.update({index: c for c, index in enumerate(components)})
    result = np.zeros((len(components), len(components)))
    for c, index in enumerate(components):
        target = number[tuple(int(axis[a]) for a in index)]
        result[target, c] = math.prod(sign[a] for a in index)
    return result


# --- what kernels are written with -------------------------------------------------------------


def inverse_distance(r2: float) -> float:
    """1/sqrt(r2) within 2 units in the last place, 0 at r2 = 0; for compiled kernels.

    Two steps of fourth order from a guess by the exponent: multiplications only, where square
    root and division would take most of the time of a pair. r2 must be a normal number or 0.
    """
    return 1.0 / math.sqrt(r2) if r2 > 0.0 else 0.0


@overload(inverse_distance)
def _inverse_distance(r2):  # noqa: ANN001, ANN202
    if r2 == types.float32:

        def single(r2):
            y = from_bits(np.int32(0x5F3759DF - (bits(r2) >> 1)))
            e = np.float32(1.0) - r2 * y * y
            y += y * e * (np.float32(0.5) + e * np.float32(0.375))
            e = np.float32(1.0) - r2 * y * y
            y += y * e * (np.float32(0.5) + e * np.float32(0.375))
            return y if r2 > np.float32(0.0) else np.float32(0.0)

        return single

    def double(r2):
        y = from_bits(np.int64(0x5FE6EB50C7B537A9) - (bits(r2) >> 1))
        e = 1.0 - r2 * y * y
        y += y * e * (0.5 + e * (0.375 + e * 0.3125))
        e = 1.0 - r2 * y * y
        y += y * e * (0.5 + e * (0.375 + e * 0.3125))
        return y if r2 > 0.0 else 0.0

    return double


def times(constant: float, value: float) -> float:
    """constant * value in the precision of value; for compiled kernels."""
    return constant * value


@overload(times)
def _times(constant, value):  # noqa: ANN001, ANN202
    if value == types.float32:
        return lambda constant, value: np.float32(constant) * value
    return lambda constant, value: constant * value


# --- scalar kernels ----------------------------------------------------------------------------


@register_jitable
def _laplace(x, y, z, w):
    return (w[0] * inverse_distance(x * x + y * y + z * z),)


@register_jitable
def _gaussian(x, y, z, w):
    return (w[0] * math.exp(-(x * x + y * y + z * z)),)


@register_jitable
def _stokeslet(x, y, z, w):
    # u_i = w_i/r + r_i (r.w)/r^3
    inverse = inverse_distance(x * x + y * y + z * z)
    s = (x * w[0] + y * w[1] + z * w[2]) * (inverse * inverse)
    return ((w[0] + x * s) * inverse, (w[1] + y * s) * inverse, (w[2] + z * s) * inverse)


laplace = Kernel("laplace", _laplace, 1, 1, degree=-1.0, parity=1, single=True, transpose="laplace")
stokeslet = Kernel(
    "stokeslet",
    _stokeslet,
    3,
    3,
    degree=-1.0,
    parity=1,
    entry=_entries(VECTOR, VECTOR, _sorted),
    single=True,
    transpose="stokeslet",
)


def gaussian(length: float = 1.0) -> Kernel:
    """exp(-|r|^2 / length^2)."""
    return Kernel(
        "gaussian", _gaussian, 1, 1, parity=1, smooth=True, length=length, transpose="gaussian"
    )


KERNELS: dict[str, Kernel] = {k.name: k for k in (laplace, stokeslet, gaussian())}
