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
- For the use of single precision no literal may promote: `constant(3.0, x) * x` for `3.0 * x`.

Symbols: r2 = |r|^2, `inverse` = 1/|r|. Constants such as 1/(8 pi viscosity) are left to the
caller; the Stokes kernels share the one prefactor 1/(8 pi viscosity).
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numba
import numpy as np
from numba import types
from numba.extending import overload, register_jitable
from numpy.typing import ArrayLike, NDArray

from stokes.fmm import _intrinsics
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
        return KERNELS[self.transpose].scaled(self.length, self.factor)

    def scaled(self, length: float, factor: float) -> Kernel:
        """The kernel with another length and factor, and its base so that it stays its gradient."""
        base = self.base
        if base is not None:
            stretched = length / self.length
            base = base.scaled(
                base.length * stretched, base.factor * stretched * factor / self.factor
            )
        return replace(self, length=length, factor=factor, base=base)


@functools.cache
def digest(apply: Callable) -> str:
    """Fingerprint of the sources that define a kernel: its own file and what it is written with.

    The loops over pairs carry it as a constant, so that their disk cache knows edited kernels.
    """
    try:
        text = Path(inspect.getsourcefile(apply) or "").read_bytes()
    except (OSError, TypeError):  # typed in at a prompt
        text = apply.__code__.co_code + repr(apply.__code__.co_consts).encode()
    common = Path(__file__).read_bytes() + Path(_intrinsics.__file__).read_bytes()
    return hashlib.sha256(text + common).hexdigest()


@functools.cache
def _matrix(apply: Callable, n_in: int, n_out: int, digest: str) -> Callable:
    zero = (0.0,) * n_in

    @numba.njit(cache=True, nogil=True, error_model="numpy")
    def evaluate(points: NDArray, identity: NDArray, out: NDArray) -> None:
        _ = digest  # a cell of this closure: part of the key of the disk cache
        for k in range(len(points)):
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            for j in range(n_in):
                column = apply(x, y, z, load_components(identity, j, zero))
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
    return 0.0 if r2 == 0.0 else 1.0 / math.sqrt(r2)


@overload(inverse_distance)
def _inverse_distance(r2):
    if r2 == types.float32:

        def single(r2):
            y = from_bits(np.int32(0x5F3759DF - (bits(r2) >> 1)))
            e = np.float32(1.0) - r2 * y * y
            y += y * e * (np.float32(0.5) + e * np.float32(0.375))
            e = np.float32(1.0) - r2 * y * y
            y += y * e * np.float32(0.5)
            return np.float32(0.0) if r2 == np.float32(0.0) else y

        return single

    def double(r2):
        y = from_bits(np.int64(0x5FE6EB50C7B537A9) - (bits(r2) >> 1))
        e = 1.0 - r2 * y * y
        y += y * e * (0.5 + e * (0.375 + e * 0.3125))
        e = 1.0 - r2 * y * y
        y += y * e * (0.5 + e * (0.375 + e * 0.3125))
        return 0.0 if r2 == 0.0 else y

    return double


def constant(value: float, like: float) -> float:
    """The number in the precision of `like`; for compiled kernels."""
    return value


@overload(constant)
def _constant(value, like):
    if like == types.float32:
        return lambda value, like: np.float32(value)
    return lambda value, like: value


def decay(t: float) -> float:
    """exp(-t) for t >= 0 within 4 units in the last place while t < 30; for compiled kernels.

    exp(-t) = 2^-n exp(-f) with |f| <= log(2)/2 and Taylor's sum for the second factor: unlike a
    call of the library this is vectorised. Beyond, the relative error grows by 2e-17 t; 0 where
    the result would not be a normal number.
    """
    return math.exp(-t)


@overload(decay)
def _decay(t):
    if t == types.float32:

        def single(t):
            n = np.int32(t * np.float32(_LOG2_E) + np.float32(0.5))
            f = t - np.float32(n) * np.float32(_LOG_2)
            p = np.float32(1 / 720) - f * np.float32(1 / 5040)
            p = np.float32(1 / 24) - f * (np.float32(1 / 120) - f * p)
            p = np.float32(1 / 2) - f * (np.float32(1 / 6) - f * p)
            p = np.float32(1) - f * (np.float32(1) - f * p)
            value = p * from_bits(np.int32((127 - n) << 23))
            return np.float32(0.0) if t > np.float32(87.0) else value

        return single

    def double(t):
        n = np.int64(t * _LOG2_E + 0.5)
        f = t - n * _LOG_2
        p = 1 / 479001600 - f * (1 / 6227020800)
        p = 1 / 3628800 - f * (1 / 39916800 - f * p)
        p = 1 / 40320 - f * (1 / 362880 - f * p)
        p = 1 / 720 - f * (1 / 5040 - f * p)
        p = 1 / 24 - f * (1 / 120 - f * p)
        p = 1 / 2 - f * (1 / 6 - f * p)
        p = 1.0 - f * (1.0 - f * p)
        value = p * from_bits((1023 - n) << 52)
        return 0.0 if t > 708.0 else value

    return double


_LOG2_E, _LOG_2 = 1.0 / math.log(2.0), math.log(2.0)


@register_jitable
def _r2(x, y, z):
    return x * x + y * y + z * z


@register_jitable
def _form(x, y, z, w):
    """r.W r of a symmetric tensor; w its diagonal, then twice 12, 02, 01."""
    return x * (x * w[0] + y * w[5]) + y * (y * w[1] + z * w[3]) + z * (z * w[2] + x * w[4])


# --- scalar kernels ----------------------------------------------------------------------------


@register_jitable
def _laplace(x, y, z, w):
    return (w[0] * inverse_distance(_r2(x, y, z)),)


@register_jitable
def _inverse_square(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    return (w[0] * (inverse * inverse),)


@register_jitable
def _inverse_fourth(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    return (w[0] * (inverse2 * inverse2),)


@register_jitable
def _gaussian(x, y, z, w):
    return (w[0] * decay(_r2(x, y, z)),)


@register_jitable
def _exponential(x, y, z, w):
    r2 = _r2(x, y, z)
    return (w[0] * decay(r2 * inverse_distance(r2)),)


@register_jitable
def _matern52(x, y, z, w):
    r2 = _r2(x, y, z)
    s = constant(math.sqrt(5.0), r2) * (r2 * inverse_distance(r2))
    return (w[0] * decay(s) * (constant(1.0, s) + s * (constant(1.0, s) + s * constant(1 / 3, s))),)


laplace = Kernel("laplace", _laplace, 1, 1, degree=-1.0, parity=1, single=True, transpose="laplace")
"""1/r."""

inverse_square = replace(
    laplace, name="inverse_square", apply=_inverse_square, degree=-2.0, transpose="inverse_square"
)
"""1/r^2."""

inverse_fourth = replace(
    laplace, name="inverse_fourth", apply=_inverse_fourth, degree=-4.0, transpose="inverse_fourth"
)
"""1/r^4."""


def _covariance(name: str, apply: Callable, length: float, smooth: bool) -> Kernel:
    return Kernel(
        *(name, apply, 1, 1), parity=1, smooth=smooth, length=length, single=True, transpose=name
    )


def gaussian(length: float = 1.0) -> Kernel:
    """exp(-r^2/length^2)."""
    return _covariance("gaussian", _gaussian, length, smooth=True)


def exponential(length: float = 1.0) -> Kernel:
    """exp(-r/length); finite at the origin, but not smooth."""
    return _covariance("exponential", _exponential, length, smooth=False)


def matern52(length: float = 1.0) -> Kernel:
    """(1 + s + s^2/3) exp(-s), s = sqrt(5) r/length; four times differentiable at the origin."""
    return _covariance("matern52", _matern52, length, smooth=False)


# --- derivatives of 1/r ------------------------------------------------------------------------


@register_jitable
def _laplace_gradient(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    s = -w[0] * (inverse * inverse * inverse)
    return (x * s, y * s, z * s)


@register_jitable
def _laplace_dipole(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    return ((x * w[0] + y * w[1] + z * w[2]) * (inverse * inverse * inverse),)


@register_jitable
def _laplace_dipole_gradient(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    s = constant(-3.0, x) * (x * w[0] + y * w[1] + z * w[2]) * inverse2
    inverse3 = inverse2 * inverse
    return ((w[0] + x * s) * inverse3, (w[1] + y * s) * inverse3, (w[2] + z * s) * inverse3)


@register_jitable
def _laplace_quadrupole(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    s = constant(3.0, x) * _form(x, y, z, w) * inverse2
    return ((s - (w[0] + w[1] + w[2])) * (inverse2 * inverse),)


@register_jitable
def _laplace_hessian(x, y, z, w):
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    trace = -w[0] * (inverse2 * inverse)
    s = constant(-3.0, x) * trace * inverse2
    return (
        x * x * s + trace,
        y * y * s + trace,
        z * z * s + trace,
        y * z * s,
        x * z * s,
        x * y * s,
    )


laplace_gradient = Kernel(
    "laplace_gradient",
    *(_laplace_gradient, 1, 3),
    degree=-2.0,
    parity=-1,
    single=True,
    transpose="laplace_dipole",
    base=laplace,
    derivative="target",
)
"""d/dx_i 1/r = -r_i/r^3."""

laplace_dipole = Kernel(
    "laplace_dipole",
    *(_laplace_dipole, 3, 1),
    degree=-2.0,
    parity=-1,
    single=True,
    transpose="laplace_gradient",
    base=laplace,
    derivative="source",
)
"""d/dy_k 1/r = r_k/r^3: the double layer, with the weights w_k = density times normal."""

laplace_dipole_gradient = Kernel(
    "laplace_dipole_gradient",
    *(_laplace_dipole_gradient, 3, 3),
    degree=-3.0,
    parity=1,
    entry=_entries(VECTOR, VECTOR, _sorted),
    single=True,
    transpose="laplace_dipole_gradient",
    base=laplace_dipole,
    derivative="target",
)
"""d/dx_i d/dy_k 1/r = delta_ik/r^3 - 3 r_i r_k/r^5."""

laplace_quadrupole = Kernel(
    "laplace_quadrupole",
    *(_laplace_quadrupole, 6, 1),
    degree=-3.0,
    parity=1,
    single=True,
    transpose="laplace_hessian",
)
"""(3 r_j r_k/r^5 - delta_jk/r^3) S_jk; the six weights as for `stresslet`."""

laplace_hessian = Kernel(
    "laplace_hessian",
    *(_laplace_hessian, 1, 6),
    degree=-3.0,
    parity=1,
    single=True,
    transpose="laplace_quadrupole",
)
"""d/dx_i d/dx_j 1/r = 3 r_i r_j/r^5 - delta_ij/r^3 in the order 00, 11, 22, 12, 02, 01."""


# --- Stokes flow -------------------------------------------------------------------------------
# Common prefactor 1/(8 pi viscosity) (pressures and stresses: 1/(8 pi)).


@register_jitable
def _stokeslet(x, y, z, w):
    # u_i = w_i/r + r_i (r.w)/r^3
    inverse = inverse_distance(_r2(x, y, z))
    s = (x * w[0] + y * w[1] + z * w[2]) * (inverse * inverse)
    return ((w[0] + x * s) * inverse, (w[1] + y * s) * inverse, (w[2] + z * s) * inverse)


@register_jitable
def _stokeslet_gradient(x, y, z, w):
    # du_i/dx_k = (-w_i r_k + r_i w_k + delta_ik r.w)/r^3 - 3 r_i r_k (r.w)/r^5
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    inverse3 = inverse2 * inverse
    a, b, c = w[0] * inverse3, w[1] * inverse3, w[2] * inverse3
    dot = x * a + y * b + z * c
    s = constant(-3.0, x) * dot * inverse2
    xy, xz, yz = x * y * s, x * z * s, y * z * s
    p, q, t = x * b - y * a, x * c - z * a, y * c - z * b
    return (
        *(x * x * s + dot, xy + p, xz + q),
        *(xy - p, y * y * s + dot, yz + t),
        *(xz - q, yz - t, z * z * s + dot),
    )


@register_jitable
def _stresslet(x, y, z, w):
    # u_i = 6 r_i r_j r_k S_jk / r^5
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    s = constant(6.0, x) * _form(x, y, z, w) * (inverse2 * inverse2 * inverse)
    return (x * s, y * s, z * s)


@register_jitable
def _stokes_stress(x, y, z, w):
    # sigma_ij = -6 r_i r_j (r.w) / r^5
    inverse = inverse_distance(_r2(x, y, z))
    inverse2 = inverse * inverse
    dot = x * w[0] + y * w[1] + z * w[2]
    s = constant(-6.0, x) * dot * (inverse2 * inverse2 * inverse)
    xs, ys, zs = x * s, y * s, z * s
    return (x * xs, y * ys, z * zs, y * zs, x * zs, x * ys)


stokeslet = Kernel(
    "stokeslet",
    *(_stokeslet, 3, 3),
    degree=-1.0,
    parity=1,
    entry=_entries(VECTOR, VECTOR, _sorted),
    single=True,
    transpose="stokeslet",
)
"""delta_ij/r + r_i r_j/r^3: velocity of forces (single layer)."""

stokeslet_pressure = replace(
    laplace_dipole, name="stokeslet_pressure", factor=2.0, base=replace(laplace, factor=2.0)
)
"""2 r_j/r^3: pressure of the flow of `stokeslet`."""


def _gradient_key(index: Indices) -> Indices:
    """Of G_ij,k at (i, k, j): symmetric in i and j, in all three where they all differ."""
    i, k, j = index
    return _sorted(index) if len(set(index)) == 3 else (*_sorted((i, j)), k)


stokeslet_gradient = Kernel(
    "stokeslet_gradient",
    *(_stokeslet_gradient, 3, 9),
    degree=-2.0,
    parity=-1,
    outputs=TENSOR,
    entry=_entries(TENSOR, VECTOR, _gradient_key),
    single=True,
    base=stokeslet,
    derivative="target",
)
"""du_i/dx_k of the flow of `stokeslet`, output 3 i + k."""

stresslet = Kernel(
    "stresslet",
    *(_stresslet, 6, 3),
    degree=-2.0,
    parity=-1,
    entry=_entries(VECTOR, SYMMETRIC, _sorted),
    single=True,
    transpose="stokes_stress",
)
"""6 r_i r_j r_k/r^5: velocity of the double layer, -8 pi inside a closed surface of density 1.

Contracted with density q_j times outward normal n_k: the weights are the six sums of
`stresslet_weights`, q_0 n_0, q_1 n_1, q_2 n_2, q_1 n_2 + q_2 n_1, q_0 n_2 + q_2 n_0,
q_0 n_1 + q_1 n_0.
"""

stresslet_pressure = replace(laplace_quadrupole, name="stresslet_pressure", factor=4.0)
"""4 (3 r_j r_k/r^5 - delta_jk/r^3): pressure of the flow of `stresslet`."""

stokes_stress = Kernel(
    "stokes_stress",
    *(_stokes_stress, 3, 6),
    degree=-2.0,
    parity=-1,
    entry=_entries(SYMMETRIC, VECTOR, _sorted),
    single=True,
    transpose="stresslet",
)
"""-6 r_i r_j r_k/r^5: stress of the flow of `stokeslet` in the order 00, 11, 22, 12, 02, 01."""


def stresslet_weights(density: ArrayLike, normals: ArrayLike) -> NDArray:
    """Weights (n, 6) of `stresslet` for a double layer: density (n, 3), outward normals (n, 3).

    Raises ValueError for other shapes, and unlike numbers of rows.
    """
    q, n = _rows(density=(density, 3), normals=(normals, 3))
    product = np.einsum("nj,nk->njk", q, n)
    both = product + product.transpose(0, 2, 1)
    return np.stack([(product if j == k else both)[:, j, k] for j, k in SYMMETRIC], axis=1)


def traction(stress: ArrayLike, normals: ArrayLike) -> NDArray:
    """sigma n (n, 3) of stresses (n, 6) in the order 00, 11, 22, 12, 02, 01 and normals (n, 3).

    Raises ValueError for other shapes, and unlike numbers of rows.
    """
    s, n = _rows(stress=(stress, 6), normals=(normals, 3))
    row = [[SYMMETRIC.index(_sorted((i, j))) for j in range(3)] for i in range(3)]
    return np.einsum("nij,nj->ni", s[:, row], n)


def _rows(**given: tuple[ArrayLike, int]) -> list[NDArray]:
    """The arrays (n, width) of name=(array, width); ValueError for others and unequal n."""
    arrays = [np.asarray(array) for array, _ in given.values()]
    for name, array, (_, width) in zip(given, arrays, given.values(), strict=True):
        if array.ndim != 2 or array.shape[1] != width:
            raise ValueError(f"{name} of shape {array.shape}: must be (n, {width})")
    if len({len(array) for array in arrays}) > 1:
        counts = " and ".join(str(len(array)) for array in arrays)
        raise ValueError(f"{', '.join(given)}: {counts} rows, must be as many of each")
    return arrays


# --- softened distance r_a = sqrt(r^2 + a^2) ---------------------------------------------------
# The functions see r/a, so that a is 1 in them.


@register_jitable
def _softened(x, y, z, w):
    return (w[0] * inverse_distance(_r2(x, y, z) + constant(1.0, x)),)


@register_jitable
def _softened_gradient(x, y, z, w):
    s = w[0] * inverse_distance(_r2(x, y, z) + constant(1.0, x))
    return (x * s, y * s, z * s)


@register_jitable
def _softened_hessian(x, y, z, w):
    # delta_ij/r_a - r_i r_j/r_a^3
    inverse = inverse_distance(_r2(x, y, z) + constant(1.0, x))
    t = w[0] * inverse
    s = -t * (inverse * inverse)
    return (x * x * s + t, y * y * s + t, z * z * s + t, y * z * s, x * z * s, x * y * s)


@register_jitable
def _softened_third(x, y, z, w):
    # -(delta_ij r_k + delta_jk r_i + delta_ki r_j)/r_a^3 + 3 r_i r_j r_k/r_a^5
    inverse = inverse_distance(_r2(x, y, z) + constant(1.0, x))
    inverse2 = inverse * inverse
    t = -w[0] * (inverse2 * inverse)
    s = constant(-3.0, x) * t * inverse2
    xx, yy, zz = x * x * s + t, y * y * s + t, z * z * s + t
    two = t + t
    return (
        *(x * (xx + two), y * (yy + two), z * (zz + two), y * xx, z * xx),
        *(x * yy, z * yy, x * zz, y * zz, x * y * z * s),
    )


def softened(length: float = 1.0) -> Kernel:
    """1/r_a with a = length."""
    return Kernel(
        "softened",
        *(_softened, 1, 1),
        parity=1,
        smooth=True,
        length=length,
        factor=1.0 / length,
        single=True,
        transpose="softened",
    )


def softened_distance_gradient(length: float = 1.0) -> Kernel:
    """dr_a/dx_i with a = length."""
    return _of_softened_distance("gradient", _softened_gradient, 1, length)


def softened_distance_hessian(length: float = 1.0) -> Kernel:
    """d2 r_a/dx_i dx_j with a = length, in the order 00, 11, 22, 12, 02, 01."""
    return _of_softened_distance("hessian", _softened_hessian, 2, length)


def softened_distance_third(length: float = 1.0) -> Kernel:
    """d3 r_a/dx_i dx_j dx_k with a = length, in the order of `SYMMETRIC_THIRD`."""
    return _of_softened_distance("third", _softened_third, 3, length)


def _of_softened_distance(name: str, apply: Callable, order: int, length: float) -> Kernel:
    outputs = (VECTOR, SYMMETRIC, SYMMETRIC_THIRD)[order - 1]
    return Kernel(
        f"softened_distance_{name}",
        *(apply, 1, len(outputs)),
        parity=(-1) ** order,
        smooth=True,
        length=length,
        factor=length ** (1 - order),
        single=True,
    )


_EVERY = (
    *(laplace, inverse_square, inverse_fourth, gaussian(), exponential(), matern52()),
    *(laplace_gradient, laplace_dipole, laplace_dipole_gradient),
    *(laplace_quadrupole, laplace_hessian),
    *(stokeslet, stokeslet_pressure, stokeslet_gradient),
    *(stresslet, stresslet_pressure, stokes_stress),
    *(softened(), softened_distance_gradient()),
    *(softened_distance_hessian(), softened_distance_third()),
)
KERNELS: Mapping[str, Kernel] = MappingProxyType({kernel.name: kernel for kernel in _EVERY})
"""All kernels by name; those with a length at length 1."""
