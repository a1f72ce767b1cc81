"""Where panels must be divided so that a rule integrates a kernel's singularity.

With W(s) = r(s) + i z(s) a kernel's modes, functions of d2 = (r - r')^2 + (z - z')^2 and of
s2 = (r + r')^2 + (z - z')^2, are singular in s' where d2 or s2 vanishes: at the complex roots of
W(s') = r + i z and W(s') = -r + i z and at their conjugates. Near a panel they are found from the
second-order expansion about its nodes.

Symbols: a, b ends of an interval; zeta a root in the coordinate -1 .. 1 of an interval; rho the
parameter of the Bernstein ellipse through it: n Gauss nodes err like rho^(-2n).
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

LOG_AT_START, PLAIN, LOG_AT_END = -1, 0, 1
_FAR = complex(0.0, 1e3)
_SMALLEST = 1e-13  # of the parameter range: pieces shorter than this are not divided


@jit
def _bernstein(root, a, b):
    """Return rho of the ellipse with foci a, b through a complex root."""
    zeta = (root - 0.5 * (a + b)) / (0.5 * (b - a))
    rho = abs(zeta + np.sqrt(zeta * zeta - 1.0))
    return max(rho, 1.0 / rho)


@jit
def _root_near(W, dW, d2W, value):
    """Return delta, the nearer root of W + dW delta + d2W delta^2/2 = value."""
    F = W - value
    q = np.sqrt(dW * dW - 2.0 * F * d2W)
    plus, minus = dW + q, dW - q
    return -2.0 * F / (plus if abs(plus) >= abs(minus) else minus)


@jit
def _roots(s, W, dW, d2W, value):
    """Return the roots of W(s') = value as each node sees its nearest."""
    roots = np.empty(len(s), np.complex128)
    for j in range(len(s)):
        roots[j] = s[j] + _root_near(W[j], dW[j], d2W[j], value)
    return roots


@jit
def _least_rho(s, roots, a, b):
    """Return the least rho of [a, b] over the roots seen by nodes in it and by one on each side.

    Nodes farther away see roots near [a, b] less sharply than these.
    """
    n = len(s)
    low = max(np.searchsorted(s, a) - 1, 0)
    high = min(np.searchsorted(s, b) + 1, n)
    rho = np.inf
    for j in range(low, high):
        rho = min(rho, _bernstein(roots[j], a, b))
    return rho


@jit
def divide_panels(targets, target_s, pairs, edges, s, W, dW, d2W, rho_panel, rho_piece, rho_log):
    """Divide the panels of pairs (target, panel) that their own Gauss rule does not integrate.

    targets : (n,) complex, r + i z. target_s : (n,) their parameters. pairs : (m, 2). edges :
    panels. s, W, dW, d2W : (panels, nodes). rho_... : least rho of panels with their own rule, of
    pieces with a Gauss rule, of pieces with the logarithmic rule.
    Returns pair, start, end, kind of the pieces, kept in the order of pairs and of s.
    """
    capacity = 64 + 8 * len(pairs)
    owner, kind = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    start, end = np.empty(capacity), np.empty(capacity)
    stack = np.empty((256, 2))
    count = 0
    for m in range(len(pairs)):
        i, k = pairs[m]
        left, right, t = edges[k], edges[k + 1], target_s[i]
        w = targets[i]
        touches = left <= t <= right
        mirrored = _roots(s[k], W[k], dW[k], d2W[k], complex(-w.real, w.imag))
        if touches and w.real == 0.0:
            # At a pole the two roots meet, and r' times the kernel is analytic.
            mirrored[:] = _FAR
        if touches:
            direct = mirrored
        else:
            direct = _roots(s[k], W[k], dW[k], d2W[k], w)
        if not touches:
            rho = min(
                _least_rho(s[k], direct, left, right), _least_rho(s[k], mirrored, left, right)
            )
            if min(rho, _bernstein(complex(t), left, right)) >= rho_panel:
                continue
        depth = 1
        stack[0] = left, right
        if left < t < right:
            stack[0] = t, right
            stack[1] = left, t
            depth = 2
        while depth > 0:
            depth -= 1
            a, b = stack[depth]
            at_end = t in (a, b)
            rho = min(_least_rho(s[k], direct, a, b), _least_rho(s[k], mirrored, a, b))
            if not at_end:
                rho = min(rho, _bernstein(complex(t), a, b))
            if rho < (rho_log if at_end else rho_piece) and b - a > _SMALLEST:
                middle = 0.5 * (a + b)
                stack[depth] = middle, b
                stack[depth + 1] = a, middle
                depth += 2
                continue
            if count == capacity:
                capacity *= 2
                owner, kind = _grown(owner, capacity), _grown(kind, capacity)
                start, end = _grown(start, capacity), _grown(end, capacity)
            owner[count], start[count], end[count] = m, a, b
            kind[count] = LOG_AT_START if t == a else (LOG_AT_END if t == b else PLAIN)
            count += 1
    return owner[:count], start[:count], end[:count], kind[:count]


@jit
def _grown(values, capacity):
    more = np.empty(capacity, values.dtype)
    more[: len(values)] = values
    return more
