"""Rules for integrals along a meridian whose kernels are singular or nearly so.

A kernel's modes are A log|s - s'| + B next to a target on the curve, A and B analytic, and analytic
in s' otherwise, with singularities where the ring of the target or its mirror image in the axis
meets the complexified curve. Panels that their own Gauss rule cannot integrate are divided towards
these points until every piece is well inside its Bernstein ellipse; pieces that end in the target
get a rule exact for polynomials and polynomials times log. Densities are interpolated from the
panel's nodes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stokes import _log_rule
from stokes._kernels_quadrature import LOG_AT_END, PLAIN, divide_panels
from stokes.geometry import Meridian

Array = NDArray[np.float64]

_PIECE_NODES = 16
_TOLERANCE = 1e-15


@dataclass(frozen=True)
class PanelRule:
    """Rules of many pairs (target, panel), one after the other; q nodes in all.

    int K(target, s') f(s') |gamma'| ds' over the panels of `pairs` is the sum over nodes of
    weights K (interpolation @ f at the panel's nodes); all other panels take the meridian's own
    nodes and weights.
    """

    pairs: NDArray[np.int64]  # (m, 2) target, panel; sorted by target, then panel
    starts: NDArray[np.int64]  # (m + 1,) first node of each pair
    s: Array  # (q,) parameters of the nodes
    weights: Array  # (q,) with |gamma'|
    interpolation: Array  # (q, nodes of a panel)
    points: Array  # (q, 4) r, z and normal r, z at the nodes
    difference: Array  # (q, 2) target minus node: r, z
    offsets: Array  # (q, 2) nu(target), nu(node) . difference

    @property
    def target(self) -> NDArray[np.int64]:
        """Target of each node."""
        return np.repeat(self.pairs[:, 0], np.diff(self.starts))

    @property
    def panel(self) -> NDArray[np.int64]:
        """Panel of each node."""
        return np.repeat(self.pairs[:, 1], np.diff(self.starts))


def gauss_legendre(n: int) -> tuple[Array, Array]:
    """Return nodes and weights on (0, 1)."""
    x, w = np.polynomial.legendre.leggauss(n)
    return 0.5 * (1 + x), 0.5 * w


def log_rule() -> tuple[Array, Array]:
    """Return the rule on (0, 1) exact for x^k and x^k log x, k < 32."""
    return np.array(_log_rule.NODES), np.array(_log_rule.WEIGHTS)


def interpolation_matrix(nodes: int, x: ArrayLike) -> Array:
    """Return (n, nodes): values at points x : (n,) of [0, 1] from those at the Gauss nodes."""
    points, gauss = gauss_legendre(nodes)
    # Barycentric weights of Legendre nodes.
    barycentric = (-1.0) ** np.arange(nodes) * np.sqrt(points * (1 - points) * gauss)
    gaps = np.asarray(x, float)[:, None] - points
    hit = gaps == 0
    rows = barycentric / np.where(hit, 1.0, gaps)
    rows = np.where(hit.any(axis=1, keepdims=True), hit, rows)
    return rows / rows.sum(axis=1, keepdims=True)


def self_rule(meridian: Meridian, s: ArrayLike | None = None) -> PanelRule:
    """Return the rules for targets on the curve, at parameters s; by default at the nodes.

    Pairs are those panels that hold the target or that their own rule misses by more than 1e-15,
    relative to the integral of the kernel's size.
    """
    s = meridian.s if s is None else np.asarray(s, float)
    points = meridian.curve.evaluate(s)
    rule = _assembled(meridian, *_divided(meridian, points.r, points.z, s))
    target = rule.target
    difference = np.column_stack(meridian.curve.differences(s[target], rule.s))
    offsets = np.column_stack(meridian.curve.normal_offsets(s[target], rule.s))
    return replace(rule, difference=difference, offsets=offsets)


def _divided(meridian: Meridian, r: Array, z: Array, s: Array) -> tuple[NDArray[np.int64], ...]:
    """Return pairs and, for their pieces, pair, start, end and kind."""
    panels, nodes = meridian.resolution.panels, meridian.resolution.nodes
    pairs = np.column_stack(
        [np.repeat(np.arange(len(r)), panels), np.tile(np.arange(panels), len(r))]
    )
    points = meridian.points
    W, dW, d2W = (
        (a + 1j * b).reshape(panels, nodes)
        for a, b in ((points.r, points.z), (points.dr, points.dz), (points.d2r, points.d2z))
    )
    pieces = divide_panels(
        r + 1j * z,
        s,
        pairs,
        np.array(meridian.resolution.breaks),
        meridian.s.reshape(panels, nodes),
        W,
        dW,
        d2W,
        _TOLERANCE ** (-0.5 / nodes),
        _TOLERANCE ** (-0.5 / _PIECE_NODES),
        _TOLERANCE ** (-1.0 / len(_log_rule.NODES)),
    )
    kept, owner = np.unique(pieces[0], return_inverse=True)
    return pairs[kept], owner, *pieces[1:]


def _assembled(
    meridian: Meridian,
    pairs: NDArray[np.int64],
    owner: NDArray[np.int64],
    start: Array,
    end: Array,
    kind: NDArray[np.int64],
) -> PanelRule:
    """Lay the rule of each piece on it; differences are left to the caller."""
    gauss, logarithmic = gauss_legendre(_PIECE_NODES), log_rule()
    sizes = np.where(kind == PLAIN, _PIECE_NODES, len(logarithmic[0]))
    first = np.concatenate([[0], np.cumsum(sizes)])
    s, weights = np.empty(first[-1]), np.empty(first[-1])
    for chosen, (x, w) in ((kind == PLAIN, gauss), (kind != PLAIN, logarithmic)):
        where = first[:-1][chosen][:, None] + np.arange(len(x))
        length = (end - start)[chosen][:, None]
        from_end = (kind == LOG_AT_END)[chosen][:, None]
        nodes = np.where(
            from_end, end[chosen][:, None] - length * x, start[chosen][:, None] + length * x
        )
        s[where], weights[where] = nodes, length * w
    counts = np.bincount(owner, weights=sizes, minlength=len(pairs)).astype(np.int64)
    panel = np.repeat(pairs[:, 1], counts)
    edges = np.array(meridian.resolution.breaks)
    local = (s - edges[panel]) / np.diff(edges)[panel]
    points = meridian.curve.evaluate(s)
    return PanelRule(
        pairs,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        s,
        weights * points.speed,
        interpolation_matrix(meridian.resolution.nodes, local),
        np.column_stack([points.r, points.z, points.normal_r, points.normal_z]),
        difference=np.empty((0, 2)),
        offsets=np.empty((0, 2)),
    )
