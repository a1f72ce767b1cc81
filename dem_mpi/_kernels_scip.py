r"""Compiled loops of the interior point method: algebra of the second-order cone by contacts.

Plain arrays in and out. With T = diag(1, 1/mu, 1/mu) of a contact, x = T gamma [N s] and
y = T^-1 g [m/s] both belong to K = {x_n >= |x_t|}, and x.y = gamma.g. T differs from diag(mu, 1, 1)
by a factor for each contact, which changes nothing, but stays finite on the side that is needed:
T^-1 = diag(1, mu, mu) at mu = 0 leaves the half-line x_n >= 0 with x_t = y_t = 0, and the algebra
below, fed with zeros, is that of the half-line. The same holds for problems of one column.

Symbols: x o y = (x.y, x_n y_t + y_n x_t) Jordan product; det x = x_n^2 - |x_t|^2; e = (1, 0, 0);
J = diag(1, -1, -1). W = eta [w_n, w_t^T; w_t, 1 + w_t w_t^T/(1 + w_n)] with det w = 1 is the
scaling of Nesterov and Todd, lambda = W x = W^-1 y the scaled point; P = W^2 = eta^2 (2 w w^T - J).
A direction is (u, v) = (W dx, W^-1 dy) in the scaled space and fulfils u + v = c - lambda, where
lambda o c is what x o y shall become, to first order; z = lambda \ a solves lambda o z = a.
The last four loops serve Newton's method on the natural map, see `solvers/semismooth.py`.
Sums run over chunks of fixed length, so the number of threads changes no bit.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit, jit_threads, prange
from dem_mpi._kernels_solver import CHUNK, _project


@jit
def _row(a, i):
    """Components of row i; a missing tangent is zero."""
    if a.shape[1] == 1:
        return a[i, 0], 0.0, 0.0
    return a[i, 0], a[i, 1], a[i, 2]


@jit
def _put(a, i, n, t1, t2):
    """Write row i, without the tangents where the array has none."""
    a[i, 0] = n
    if a.shape[1] == 3:
        a[i, 1] = t1
        a[i, 2] = t2


@jit
def _larger(x, y):
    """The larger of two numbers; NaN if either is."""
    return y if y > x or y != y else x


@jit
def _scaled(eta, wn, w1, w2, n, t1, t2):
    """W (n, t)."""
    along = w1 * t1 + w2 * t2
    share = n + along / (1.0 + wn)
    return eta * (wn * n + along), eta * (t1 + share * w1), eta * (t2 + share * w2)


@jit
def _quotient(ln, l1, l2, det, n, t1, t2):
    r"""lambda \ (n, t): the z with lambda o z = (n, t)."""
    along = l1 * t1 + l2 * t2
    zn = (ln * n - along) / det
    return zn, (t1 - zn * l1) / ln, (t2 - zn * l2) / ln


@jit
def _blocking(ln, l1, l2, det, n, t1, t2):
    """1/alpha of the largest step alpha with lambda + alpha (n, t) in K; negative: no limit.

    The rotation that takes lambda/sqrt(det) to e takes the direction to rho, and e + alpha rho
    leaves K where alpha (|rho_t| - rho_n) = 1: no difference of large numbers.
    """
    root = np.sqrt(det)
    an, a1, a2 = ln / root, l1 / root, l2 / root
    rn = an * n - a1 * t1 - a2 * t2
    share = (rn + n) / (1.0 + an)
    r1, r2 = t1 - share * a1, t2 - share * a2
    return (np.sqrt(r1 * r1 + r2 * r2) - rn) / root


@jit
def _row_of_dy(g, dg, y, f, i):
    """Row i of dy = T^-1 (g + dg) - y."""
    gn, g1, g2 = _row(g, i)
    dn, d1, d2 = _row(dg, i)
    yn, y1, y2 = _row(y, i)
    return (gn - yn) + dn, (f * g1 - y1) + f * d1, (f * g2 - y2) + f * d2


@jit
def _determinant(n, t1, t2):
    """n^2 - |t|^2, with the digits of n - |t|."""
    t = np.sqrt(t1 * t1 + t2 * t2)
    return (n - t) * (n + t)


@jit_threads
def distance(gamma, g, mu, stiffness, partial):
    """Sum over contacts of max(0, mu |g_t| - g_n)^2/stiffness + |gamma.g| [J]: 0 at a solution.

    stiffness : (m,) [1/kg]; partial : (chunks,) scratch.
    """
    m = gamma.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        total = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            pn, p1, p2 = _row(gamma, i)
            gn, g1, g2 = _row(g, i)
            short = mu[i] * np.sqrt(g1 * g1 + g2 * g2) - gn
            if short > 0.0:
                total += short * short / stiffness[i]
            total += abs(pn * gn + p1 * g1 + p2 * g2)
        partial[chunk] = total
    total = 0.0
    for chunk in range(chunks):
        total += partial[chunk]
    return total


@jit_threads
def centred_start(gamma, g, mu, stiffness, target, x, y):
    """The central pair x o y = target e with x - y/stiffness = T gamma - T^-1 g/stiffness = z.

    x = (z + sqrt(z^2 + 4 target/stiffness e))/2 in the algebra of K (the smoothing of Chen, Harker,
    Kanzow and Smale); each eigenvalue by the formula that does not cancel.
    stiffness : (m,) [1/kg]; target [J].
    """
    for i in prange(gamma.shape[0]):
        k, f = stiffness[i], mu[i]
        pn, p1, p2 = _row(gamma, i)
        gn, g1, g2 = _row(g, i)
        inverse = 1.0 / f if f > 0.0 else 0.0
        zn = pn - gn / k
        z1 = p1 * inverse - f * g1 / k
        z2 = p2 * inverse - f * g2 / k
        t = np.sqrt(z1 * z1 + z2 * z2)
        four = 4.0 * target / k
        half = 0.25 * four
        a, b = zn - t, zn + t
        ra, rb = np.sqrt(a * a + four), np.sqrt(b * b + four)
        # Eigenvalues of x and of y/stiffness; their products are target/stiffness.
        xa = 0.5 * (a + ra) if a > 0.0 else 2.0 * half / (ra - a)
        xb = 0.5 * (b + rb) if b > 0.0 else 2.0 * half / (rb - b)
        ya, yb = half / xa, half / xb
        u1 = z1 / t if t > 0.0 else 0.0
        u2 = z2 / t if t > 0.0 else 0.0
        s = 0.5 * (xb - xa)
        _put(x, i, 0.5 * (xa + xb), s * u1, s * u2)
        s = 0.5 * k * (yb - ya)
        _put(y, i, 0.5 * k * (ya + yb), s * u1, s * u2)


@jit_threads
def impulse(x, mu, gamma):
    """gamma = T^-1 x."""
    for i in prange(x.shape[0]):
        n, t1, t2 = _row(x, i)
        _put(gamma, i, n, mu[i] * t1, mu[i] * t2)


@jit_threads
def scaling(x, y, mu, g, eta, w, lam, partial):
    """Nesterov-Todd scaling and scaled point; returns (x.y, -least eigenvalue^2 of lambda, |r|).

    |r| = max |T^-1 g - y| [m/s]. A point outside K gives NaN for the second.
    partial : (chunks, 3) scratch.
    """
    m = x.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        gap, least, worst = 0.0, -np.inf, 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            xn, x1, x2 = _row(x, i)
            yn, y1, y2 = _row(y, i)
            gn, g1, g2 = _row(g, i)
            rn, r1, r2 = gn - yn, mu[i] * g1 - y1, mu[i] * g2 - y2
            worst = _larger(worst, np.sqrt(rn * rn + r1 * r1 + r2 * r2))
            work = xn * yn + x1 * y1 + x2 * y2
            gap += work
            rx = np.sqrt(_determinant(xn, x1, x2))
            ry = np.sqrt(_determinant(yn, y1, y2))
            # In units of determinant 1: w = (y + J x)/(2 c), c^2 = (1 + x.y)/2.
            xn, x1, x2 = xn / rx, x1 / rx, x2 / rx
            yn, y1, y2 = yn / ry, y1 / ry, y2 / ry
            c = np.sqrt(0.5 * (1.0 + work / (rx * ry)))
            wt1, wt2 = (y1 - x1) / (2.0 * c), (y2 - x2) / (2.0 * c)
            eta[i] = np.sqrt(ry / rx)
            _put(w, i, np.sqrt(1.0 + wt1 * wt1 + wt2 * wt2), wt1, wt2)
            root = np.sqrt(rx * ry)
            share = root / (xn + yn + 2.0 * c)
            l1 = share * ((c + yn) * x1 + (c + xn) * y1)
            l2 = share * ((c + yn) * x2 + (c + xn) * y2)
            # det lambda = sqrt(det x det y) whatever the rounding of its parts.
            det = rx * ry
            t = np.sqrt(l1 * l1 + l2 * l2)
            ln = np.sqrt(det + t * t)
            _put(lam, i, ln, l1, l2)
            small = det / (ln + t)
            least = _larger(least, -small * small)
        partial[chunk, 0], partial[chunk, 1], partial[chunk, 2] = gap, least, worst
    gap, least, worst = 0.0, -np.inf, 0.0
    for chunk in range(chunks):
        gap += partial[chunk, 0]
        least = _larger(least, partial[chunk, 1])
        worst = _larger(worst, partial[chunk, 2])
    return gap, least, worst


@jit_threads
def blocks(eta, w, mu, Q, R, root):
    """R = T P T [m/s per N s], Q = T^-1 P^-1 T^-1 and its root T^-1 W^-1, all (m, c, c).

    Q = root root^T. Tangents of R are 0 at mu = 0.
    """
    rows = w.shape[1]
    for i in prange(w.shape[0]):
        wn, w1, w2 = _row(w, i)
        scale = eta[i] * eta[i]
        f = mu[i]
        R[i, 0, 0] = scale * (2.0 * wn * wn - 1.0)
        Q[i, 0, 0] = (2.0 * wn * wn - 1.0) / scale
        root[i, 0, 0] = wn / eta[i]
        if rows == 3:
            inverse = 1.0 / f if f > 0.0 else 0.0
            v = (w1, w2)
            for a in range(2):
                R[i, 0, a + 1] = R[i, a + 1, 0] = scale * inverse * 2.0 * wn * v[a]
                Q[i, 0, a + 1] = Q[i, a + 1, 0] = -f * 2.0 * wn * v[a] / scale
                root[i, 0, a + 1] = -v[a] / eta[i]
                root[i, a + 1, 0] = -f * v[a] / eta[i]
                for b in range(2):
                    part = 2.0 * v[a] * v[b] + (1.0 if a == b else 0.0)
                    R[i, a + 1, b + 1] = scale * (inverse * inverse) * part
                    Q[i, a + 1, b + 1] = f * f * part / scale
                    part = v[a] * v[b] / (1.0 + wn) + (1.0 if a == b else 0.0)
                    root[i, a + 1, b + 1] = f * part / eta[i]


@jit_threads
def soften(soft, mu, Q, R, root):
    """R += soft, Q = (R + soft)^-1 and its root, in place; tangents of mu = 0 stay as they are.

    With Q = L L^T and C C^T = 1 + soft L^T L the new root is L C^-T: nothing large is inverted.
    soft : (m,) [1/kg].
    """
    columns = root.shape[1]
    for i in prange(root.shape[0]):
        a = soft[i]
        R[i, 0, 0] += a
        if columns == 1:
            root[i, 0, 0] /= np.sqrt(1.0 + a * root[i, 0, 0] * root[i, 0, 0])
            Q[i, 0, 0] = root[i, 0, 0] * root[i, 0, 0]
            continue
        if mu[i] > 0.0:
            R[i, 1, 1] += a
            R[i, 2, 2] += a
        C = np.zeros((3, 3))
        for j in range(3):
            for k in range(j + 1):
                total = 1.0 if j == k else 0.0
                for r in range(3):
                    total += a * root[i, r, j] * root[i, r, k]
                for r in range(k):
                    total -= C[j, r] * C[k, r]
                C[j, k] = np.sqrt(total) if j == k else total / C[k, k]
        for r in range(3):
            for j in range(3):
                total = root[i, r, j]
                for k in range(j):
                    total -= root[i, r, k] * C[j, k]
                root[i, r, j] = total / C[j, j]
        for r in range(3):
            for j in range(3):
                total = 0.0
                for k in range(3):
                    total += root[i, r, k] * root[i, j, k]
                Q[i, r, j] = total


@jit_threads
def right_side(g, eta, w, mu, c, s):
    """s = T (W (c - lambda) - (T^-1 g - y)) = T W c - g, without tangents where mu = 0."""
    for i in prange(g.shape[0]):
        n, t1, t2 = _row(c, i)
        gn, g1, g2 = _row(g, i)
        wn, w1, w2 = _row(w, i)
        n, t1, t2 = _scaled(eta[i], wn, w1, w2, n, t1, t2)
        f = mu[i]
        if f > 0.0:
            _put(s, i, n - gn, t1 / f - g1, t2 / f - g2)
        else:
            _put(s, i, n - gn, 0.0, 0.0)


@jit_threads
def direction(dgamma, dg, g, y, eta, w, lam, mu, u, v, partial):
    """Scaled directions u = W dx, v = W^-1 dy; returns 1/alpha of the largest steps in x and in y.

    dg = N dgamma. dy = T^-1 (g + dg) - y is what a full step makes of T^-1 g - y = 0. By W (c -
    lambda - u) it would be the same but for rounding, which W, of condition 1/target, makes large.
    partial : (chunks, 2) scratch.
    """
    m = lam.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        primal = dual = -np.inf
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            f = mu[i]
            inverse = 1.0 / f if f > 0.0 else 0.0
            ln, l1, l2 = _row(lam, i)
            det = _determinant(ln, l1, l2)
            wn, w1, w2 = _row(w, i)
            n, t1, t2 = _row(dgamma, i)
            n, t1, t2 = _scaled(eta[i], wn, w1, w2, n, inverse * t1, inverse * t2)
            _put(u, i, n, t1, t2)
            primal = _larger(primal, _blocking(ln, l1, l2, det, n, t1, t2))
            n, t1, t2 = _row_of_dy(g, dg, y, f, i)
            n, t1, t2 = _scaled(1.0 / eta[i], wn, -w1, -w2, n, t1, t2)
            _put(v, i, n, t1, t2)
            dual = _larger(dual, _blocking(ln, l1, l2, det, n, t1, t2))
        partial[chunk, 0], partial[chunk, 1] = primal, dual
    primal = dual = -np.inf
    for chunk in range(chunks):
        primal = _larger(primal, partial[chunk, 0])
        dual = _larger(dual, partial[chunk, 1])
    return primal, dual


@jit_threads
def misfit(lam, u, v, eta, w, mu, c, s, partial):
    """s = T W e, e = c - lambda - u - v: what a Newton step leaves of its own equation.

    Without the cancellation of s - (N + R) dgamma. Returns max |e|. partial : (chunks,) scratch.
    """
    m = lam.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        worst = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            f = mu[i]
            inverse = 1.0 / f if f > 0.0 else 0.0
            n, t1, t2 = _row(c, i)
            ln, l1, l2 = _row(lam, i)
            un, u1, u2 = _row(u, i)
            vn, v1, v2 = _row(v, i)
            wn, w1, w2 = _row(w, i)
            n, t1, t2 = n - ln - un - vn, t1 - l1 - u1 - v1, t2 - l2 - u2 - v2
            worst = _larger(worst, np.sqrt(n * n + t1 * t1 + t2 * t2))
            n, t1, t2 = _scaled(eta[i], wn, w1, w2, n, t1, t2)
            _put(s, i, n, inverse * t1, inverse * t2)
        partial[chunk] = worst
    worst = 0.0
    for chunk in range(chunks):
        worst = _larger(worst, partial[chunk])
    return worst


@jit_threads
def gap_at(lam, u, v, step_x, step_y, partial):
    """(lambda + step_x u).(lambda + step_y v) = x.y after these steps; partial : (chunks,)."""
    m = lam.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        gap = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            for j in range(lam.shape[1]):
                gap += (lam[i, j] + step_x * u[i, j]) * (lam[i, j] + step_y * v[i, j])
        partial[chunk] = gap
    gap = 0.0
    for chunk in range(chunks):
        gap += partial[chunk]
    return gap


@jit_threads
def second_order(lam, u, v, target, c):
    r"""c = lambda \ (target e - u o v): aims at the central path, with the predictor's error."""
    for i in prange(lam.shape[0]):
        ln, l1, l2 = _row(lam, i)
        un, u1, u2 = _row(u, i)
        vn, v1, v2 = _row(v, i)
        det = _determinant(ln, l1, l2)
        n, t1, t2 = _quotient(
            ln, l1, l2, det,
            target - (un * vn + u1 * v1 + u2 * v2), -(un * v1 + vn * u1), -(un * v2 + vn * u2),
        )  # fmt: skip
        _put(c, i, n, t1, t2)


@jit
def _band(value, low, high):
    """What brings an eigenvalue into [low, high], at most by -high downwards."""
    if value < low:
        return low - value
    if value > high:
        return max(high - value, -high)
    return 0.0


@jit_threads
def centrality(lam, u, v, step, low, high, c):
    """Add to c what brings the products at a trial step into [low, high] (J. Gondzio, 1996).

    The eigenvalues of (lambda + step u) o (lambda + step v) are moved, by no more than `high` down.
    """
    for i in prange(lam.shape[0]):
        ln, l1, l2 = _row(lam, i)
        un, u1, u2 = _row(u, i)
        vn, v1, v2 = _row(v, i)
        det = _determinant(ln, l1, l2)
        un, u1, u2 = ln + step * un, l1 + step * u1, l2 + step * u2
        vn, v1, v2 = ln + step * vn, l1 + step * v1, l2 + step * v2
        pn = un * vn + u1 * v1 + u2 * v2
        p1, p2 = un * v1 + vn * u1, un * v2 + vn * u2
        t = np.sqrt(p1 * p1 + p2 * p2)
        a, b = _band(pn - t, low, high), _band(pn + t, low, high)
        if a == 0.0 and b == 0.0:
            continue
        half = 0.5 * (b - a)
        d1 = half * p1 / t if t > 0.0 else 0.0
        d2 = half * p2 / t if t > 0.0 else 0.0
        n, t1, t2 = _quotient(ln, l1, l2, det, 0.5 * (a + b), d1, d2)
        cn, c1, c2 = _row(c, i)
        _put(c, i, cn + n, c1 + t1, c2 + t2)


@jit_threads
def advance(x, y, dgamma, dg, g, mu, step_x, step_y):
    """x += step_x T dgamma, y += step_y (T^-1 (g + dg) - y)."""
    for i in prange(x.shape[0]):
        f = mu[i]
        xn, x1, x2 = _row(x, i)
        n, t1, t2 = _row(dgamma, i)
        inverse = step_x / f if f > 0.0 else 0.0
        _put(x, i, xn + step_x * n, x1 + inverse * t1, x2 + inverse * t2)
        yn, y1, y2 = _row(y, i)
        n, t1, t2 = _row_of_dy(g, dg, y, f, i)
        _put(y, i, yn + step_y * n, y1 + step_y * t1, y2 + step_y * t2)


@jit_threads
def decompose(gamma, g, mu, unit, p, y):
    """gamma - g/unit = p - y/unit with p in the cone, y in its dual, p.y = 0 (J.-J. Moreau).

    Exactly, y = 0 where the contact sticks and p = 0 where it opens. unit : (m,) [1/kg].
    """
    for i in prange(gamma.shape[0]):
        n, t1, t2 = _row(gamma, i)
        gn, g1, g2 = _row(g, i)
        n -= gn / unit[i]
        t1 -= g1 / unit[i]
        t2 -= g2 / unit[i]
        if mu[i] == 0.0:
            t1 = t2 = 0.0
        pn, p1, p2 = _project(n, t1, t2, mu[i])
        _put(p, i, pn, p1, p2)
        _put(y, i, unit[i] * (pn - n), unit[i] * (p1 - t1), unit[i] * (p2 - t2))


@jit_threads
def mismatch(y, g, mu, s, partial):
    """s = y - g, without tangents where mu = 0; returns max |s|. partial : (chunks,) scratch."""
    m = y.shape[0]
    chunks = partial.shape[0]
    for chunk in prange(chunks):
        worst = 0.0
        for i in range(chunk * CHUNK, min(m, (chunk + 1) * CHUNK)):
            yn, y1, y2 = _row(y, i)
            gn, g1, g2 = _row(g, i)
            n, t1, t2 = yn - gn, y1 - g1, y2 - g2
            if mu[i] == 0.0:
                t1 = t2 = 0.0
            _put(s, i, n, t1, t2)
            worst = _larger(worst, np.sqrt(n * n + t1 * t1 + t2 * t2))
        partial[chunk] = worst
    worst = 0.0
    for chunk in range(chunks):
        worst = _larger(worst, partial[chunk])
    return worst


@jit
def _add_direction(i, r, e, Q, R):
    """R += r e e^T and Q += e e^T / r."""
    for a in range(3):
        for b in range(3):
            R[i, a, b] += r * e[a] * e[b]
            Q[i, a, b] += e[a] * e[b] / r


@jit_threads
def slopes(p, y, mu, unit, soft, stiff, Q, R, root):
    """R with dy = -R dp for the pairs (p, y) of `decompose`, Q = R^-1 and its root, (m, c, c).

    A sticking contact has R = 0, one that opens R infinite. One that slides may change its impulse
    along the edge of the cone (R = 0), turns it at |y_t|/|p_t|, and cannot leave the edge.
    All are kept between soft and stiff times unit. Tangents of mu = 0 get zeros.
    """
    columns = p.shape[1]
    for i in prange(p.shape[0]):
        low, high = soft * unit[i], stiff * unit[i]
        _, p1, p2 = _row(p, i)
        yn, y1, y2 = _row(y, i)
        sticks = yn == 0.0 and y1 == 0.0 and y2 == 0.0
        if columns == 1:
            R[i, 0, 0] = low if sticks else high
            Q[i, 0, 0] = 1.0 / R[i, 0, 0]
            root[i, 0, 0] = np.sqrt(Q[i, 0, 0])
            continue
        for a in range(3):
            for b in range(3):
                Q[i, a, b] = R[i, a, b] = root[i, a, b] = 0.0
        t = np.sqrt(p1 * p1 + p2 * p2)
        if sticks or t == 0.0:
            r = low if sticks else high
            for a in range(3 if mu[i] > 0.0 else 1):
                R[i, a, a] = r
                Q[i, a, a] = 1.0 / r
                root[i, a, a] = np.sqrt(1.0 / r)
            continue
        f = mu[i]
        q = 1.0 / np.sqrt(1.0 + f * f)
        c1, c2 = p1 / t, p2 / t
        turn = np.sqrt(y1 * y1 + y2 * y2) / t
        turn = min(turn + low, high)
        edge = (q, q * f * c1, q * f * c2)
        across = (q * f, -q * c1, -q * c2)
        lateral = (0.0, -c2, c1)
        _add_direction(i, low, edge, Q, R)
        _add_direction(i, high, across, Q, R)
        _add_direction(i, turn, lateral, Q, R)
        for a in range(3):
            root[i, a, 0] = edge[a] / np.sqrt(low)
            root[i, a, 1] = across[a] / np.sqrt(high)
            root[i, a, 2] = lateral[a] / np.sqrt(turn)
