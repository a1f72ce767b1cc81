"""Radius distributions: the radius of each body from one random number, and what bounds them.

Radii are drawn by number through the inverse of the cumulative distribution, so that body i's
radius is a function of body i's random number alone. Shares by volume are turned into shares by
number: p_k ~ w_k / r_k^3.

A group's `radius` is that of a sphere, the cap radius of a spherocylinder or the equatorial radius
of a spheroid; `reach` is the radius of the bounding sphere about the body's centre.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import special

from dem_mpi.scene_bodies import (
    BodyGroup,
    Lognormal,
    LognormalRadius,
    Mix,
    MixRadius,
    UniformRadius,
    Weighted,
    WeightedRadius,
)

_BALL = 4.0 / 3.0 * math.pi


def radii(group: BodyGroup, index: NDArray, random: NDArray) -> NDArray[np.float64]:
    """Radii (n,) [m] of the bodies `index` (n,) of a group, from `random` (n,) in [0, 1).

    Zeros where the radii come from the group's file.
    """
    radius = group.radius
    if radius is None:
        return np.zeros(len(index))
    if isinstance(radius, UniformRadius):
        low, high = radius.uniform
        return low + (high - low) * random
    if isinstance(radius, LognormalRadius):
        return _lognormal_quantile(radius.lognormal, random)
    if isinstance(radius, (WeightedRadius, MixRadius)):
        values, share = _classes(radius)
        # The last class takes what rounding leaves of the sum.
        return values[np.searchsorted(np.cumsum(share)[:-1], random, side="right")]
    values = np.atleast_1d(np.array(radius, dtype=np.float64))
    return values[np.asarray(index, dtype=np.int64) % len(values)]


def is_drawn(group: BodyGroup) -> bool:
    """Whether a group's radii depend on random numbers."""
    return isinstance(group.radius, (UniformRadius, LognormalRadius, WeightedRadius, MixRadius))


def smallest_radius(group: BodyGroup) -> float:
    """The smallest radius [m] that a body of the group can have."""
    return _bounds(group)[0]


def largest_radius(group: BodyGroup) -> float:
    """The largest radius [m] that a body of the group can have."""
    return _bounds(group)[1]


def largest_reach(group: BodyGroup) -> float:
    """The largest radius [m] of a bounding sphere of the group."""
    return reach_factor(group) * largest_radius(group)


def thinnest_half(group: BodyGroup) -> float:
    """The smallest half width [m] of any body of the group."""
    flat = min(1.0, group.aspect_ratio or 1.0) if group.shape == "spheroid" else 1.0
    return flat * smallest_radius(group)


def reach_factor(group: BodyGroup) -> float:
    """Radius of the bounding sphere over the body's radius."""
    return max(1.0, group.aspect_ratio or 1.0)


def half_length_factor(group: BodyGroup) -> float:
    """Half the core segment of a spherocylinder, or a spheroid's polar semi-axis, over radius."""
    if group.shape == "sphere":
        return 0.0
    assert group.aspect_ratio is not None
    return group.aspect_ratio - (1.0 if group.shape == "spherocylinder" else 0.0)


def mean_volume(group: BodyGroup) -> float:
    """The expected volume [m^3] of a body of the group."""
    if group.shape == "spherocylinder":
        # 4/3 pi r^3 + pi r^2 (2 half_length)
        factor = 1.0 + 1.5 * half_length_factor(group)
    else:
        factor = group.aspect_ratio or 1.0
    return _BALL * factor * _moment(group, 3)


def mean_bounding_volume(group: BodyGroup, gap: float = 0.0) -> float:
    """The expected volume [m^3] of a bounding sphere enlarged by half a `gap` [m] all around."""
    f, e = reach_factor(group), 0.5 * gap
    first, second, third = (_moment(group, k) for k in (1, 2, 3))
    return _BALL * (f**3 * third + 3.0 * f**2 * second * e + 3.0 * f * first * e**2 + e**3)


def mean_radius(group: BodyGroup) -> float:
    """The expected radius [m]."""
    return _moment(group, 1)


def _moment(group: BodyGroup, k: int) -> float:
    """E[r^k] [m^k]."""
    radius = group.radius
    assert radius is not None, "a group without radii takes them from its file"
    if isinstance(radius, UniformRadius):
        low, high = radius.uniform
        # (high^(k+1) - low^(k+1)) / ((k+1) (high - low)) without the cancellation
        return sum(low**i * high ** (k - i) for i in range(k + 1)) / (k + 1)
    if isinstance(radius, LognormalRadius):
        return _lognormal_moment(radius.lognormal, k)
    values, share = _classes(radius)
    return float(np.dot(share, values**k))


def _bounds(group: BodyGroup) -> tuple[float, float]:
    radius = group.radius
    assert radius is not None, "a group without radii takes them from its file"
    if isinstance(radius, UniformRadius):
        return radius.uniform
    if isinstance(radius, LognormalRadius):
        return radius.lognormal.min, radius.lognormal.max
    values, share = _classes(radius)
    present = values[share > 0.0]
    return float(present.min()), float(present.max())


# ---- sizes to choose from ------------------------------------------------------------------


def _classes(
    radius: float | tuple[float, ...] | WeightedRadius | MixRadius,
) -> tuple[NDArray, NDArray]:
    """Radii (k,) [m] and their shares (k,) by number, which add up to 1."""
    if isinstance(radius, WeightedRadius):
        return _by_number(radius.weighted, radius.weighted.radii, radius.weighted.weights)
    if isinstance(radius, MixRadius):
        mix = radius.mix
        weights = (1.0 - mix.large_share, mix.large_share)
        return _by_number(mix, (mix.small, mix.large), weights)
    values = np.atleast_1d(np.array(radius, dtype=np.float64))
    return values, np.full(len(values), 1.0 / len(values))


def _by_number(
    stated: Weighted | Mix, sizes: tuple[float, ...], weights: tuple[float, ...]
) -> tuple[NDArray, NDArray]:
    values, share = np.array(sizes), np.array(weights)
    share = share / share.max()
    if stated.by == "volume":
        share = share * (values.min() / values) ** 3
    return values, share / share.sum()


# ---- lognormal -----------------------------------------------------------------------------


def _lognormal_quantile(law: Lognormal, random: NDArray) -> NDArray:
    """Radii whose truncated cumulative distribution is `random`.

    Phi(z) = (1 - u) Phi(a) + u Phi(b) is solved in logarithms, and in the mirror image where the
    interval lies above the median: cuts far out in a tail then lose no digits.
    """
    low, high = _standard_cuts(law)
    mirror = low + high > 0.0
    u = random
    if mirror:
        low, high, u = -high, -low, 1.0 - random
    with np.errstate(divide="ignore"):
        z = special.ndtri_exp(
            np.logaddexp(np.log1p(-u) + special.log_ndtr(low), np.log(u) + special.log_ndtr(high))
        )
    radius = law.median * np.exp(law.sigma * (-z if mirror else z))
    return np.clip(radius, law.min, law.max)


def _lognormal_moment(law: Lognormal, k: int) -> float:
    """E[r^k] = m^k exp(k^2 s^2 / 2) P(a - k s < Z < b - k s) / P(a < Z < b)."""
    low, high = _standard_cuts(law)
    shift = k * law.sigma
    log_ratio = _log_probability(low - shift, high - shift) - _log_probability(low, high)
    moment = math.exp(k * math.log(law.median) + 0.5 * shift**2 + log_ratio)
    return min(max(moment, law.min**k), law.max**k)


def _standard_cuts(law: Lognormal) -> tuple[float, float]:
    return tuple(math.log(cut / law.median) / law.sigma for cut in (law.min, law.max))


def _log_probability(low: float, high: float) -> float:
    """log P(low < Z < high) of the standard normal distribution."""
    if low + high > 0.0:
        low, high = -high, -low
    upper = float(special.log_ndtr(high))
    return upper + math.log(-math.expm1(float(special.log_ndtr(low)) - upper))
