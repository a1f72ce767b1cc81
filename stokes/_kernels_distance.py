"""Distances of points from bodies of revolution, and of such bodies from each other.

A curve comes as piecewise Chebyshev series (`Curve.polynomials`) with samples (s, r, z) between
which the nearest point is sought. A body comes as a row of centre, rotation, scale and curve.

Symbols: x point, n outward normal, t tangent, delta signed distance, negative inside, k principal
curvatures along and across the meridian; indices A, B of two bodies.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

_NEWTON_STEPS = 60
_RINGS, _AZIMUTHS = 16, 12  # grid on the first body from which a least distance is sought
_STARTS = 6


@jit
def _series(coefficients, x):
    """Clenshaw's sum of a Chebyshev series."""
    b1, b2 = 0.0, 0.0
    for k in range(len(coefficients) - 1, 0, -1):
        b1, b2 = 2.0 * x * b1 - b2 + coefficients[k], b1
    return x * b1 - b2 + coefficients[0]


@jit
def curve_point(edges, series, s):
    """Return r, z, r', z', r'', z'' at one parameter."""
    k = min(max(np.searchsorted(edges, s) - 1, 0), len(edges) - 2)
    x = (2.0 * s - edges[k] - edges[k + 1]) / (edges[k + 1] - edges[k])
    c = series[k]
    return (
        _series(c[0, 0], x),
        _series(c[0, 1], x),
        _series(c[1, 0], x),
        _series(c[1, 1], x),
        _series(c[2, 0], x),
        _series(c[2, 1], x),
    )


@jit
def _foot_between(edges, series, low, high, s, r, z):
    """Return s of the zero of (gamma - x).gamma' in [low, high]: Newton kept in the bracket."""
    for _ in range(_NEWTON_STEPS):
        gr, gz, dr, dz, d2r, d2z = curve_point(edges, series, s)
        f = (gr - r) * dr + (gz - z) * dz
        slope = dr * dr + dz * dz + (gr - r) * d2r + (gz - z) * d2z
        if f > 0.0:
            high = s
        else:
            low = s
        new = s - f / slope if slope > 0.0 else low - 1.0
        if not (low <= new <= high):
            new = 0.5 * (low + high)
        if abs(new - s) < 1e-15:
            break
        s = new
    return s


@jit
def nearest(edges, series, samples, r, z):
    """Return (delta, s): signed distance of (r, z), r >= 0, from a curve, and the nearest point.

    samples : (3, n) parameters, r and z, from pole to pole; every local minimum among them that
    could still become the least distance is refined.
    """
    n = samples.shape[1]
    best, best_s, best_delta = np.inf, 0.0, 0.0
    before, here = np.inf, _squared(samples, 0, r, z)
    for j in range(n):
        low, high = max(j - 1, 0), min(j + 1, n - 1)
        after = _squared(samples, high, r, z) if high > j else np.inf
        if here <= before and here <= after:
            step = np.hypot(samples[1, high] - samples[1, low], samples[2, high] - samples[2, low])
            if np.sqrt(here) <= best + step:
                s = _foot_between(
                    edges, series, samples[0, low], samples[0, high], samples[0, j], r, z
                )
                gr, gz, dr, dz, _, _ = curve_point(edges, series, s)
                distance = np.hypot(r - gr, z - gz)
                if distance < best:
                    best, best_s = distance, s
                    # Along the normal: a small error of s enters squared.
                    best_delta = ((gr - r) * dz + (z - gz) * dr) / np.hypot(dr, dz)
        before, here = here, after
    return best_delta, best_s


@jit
def _squared(samples, j, r, z):
    return (samples[1, j] - r) ** 2 + (samples[2, j] - z) ** 2


@jit
def nearest_points(edges, series, samples, r, z, delta, s):
    """Fill delta, s : (n,) for points r, z : (n,)."""
    for i in range(len(r)):
        delta[i], s[i] = nearest(edges, series, samples, r[i], z[i])


@jit
def _surface(edges, series, s, cosine, sine):
    """Return x, n, t (meridian), e (azimuth), k1, k2 at a surface point of the unit shape."""
    r, z, dr, dz, d2r, d2z = curve_point(edges, series, s)
    speed = np.hypot(dr, dz)
    n_r, n_z = -dz / speed, dr / speed
    k1 = (dz * d2r - dr * d2z) / speed**3
    k2 = n_r / r if r > 1e-9 * speed else k1
    x = np.array((r * cosine, r * sine, z))
    n = np.array((n_r * cosine, n_r * sine, n_z))
    t = np.array((n_z * cosine, n_z * sine, -n_r))
    e = np.array((-sine, cosine, 0.0))
    return x, n, t, e, k1, k2


@jit
def _turn(R, v):
    out = np.empty(3)
    for i in range(3):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@jit
def _turn_back(R, v):
    out = np.empty(3)
    for i in range(3):
        out[i] = R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2]
    return out


@jit
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _foot(edges, series, samples, centre, R, scale, x):
    """Return delta, s, cos and sin of the azimuth of the point of a body nearest to world x."""
    y = _turn_back(R, (x - centre) / scale)
    rho = np.hypot(y[0], y[1])
    delta, s = nearest(edges, series, samples, rho, y[2])
    cosine, sine = (y[0] / rho, y[1] / rho) if rho > 0.0 else (1.0, 0.0)
    return scale * delta, s, cosine, sine


@jit
def _newton_step(g1, g2, h11, h12, h22, longest):
    """Return -|H|^-1 g, |H| with the moduli of H's eigenvalues, no longer than `longest`."""
    mean, half = 0.5 * (h11 + h22), 0.5 * (h11 - h22)
    radius = np.hypot(half, h12)
    angle = 0.5 * np.arctan2(h12, half)
    c, s = np.cos(angle), np.sin(angle)
    floor = 1e-6 / longest
    first = -(c * g1 + s * g2) / max(abs(mean + radius), floor)
    second = -(c * g2 - s * g1) / max(abs(mean - radius), floor)
    shrink = min(1.0, longest / max(np.hypot(first, second), 1e-300))
    return shrink * (c * first - s * second), shrink * (s * first + c * second)


@jit
def _least_from(table_a, body_a, table_b, body_b, s, cosine, sine):
    """Newton's method for the least signed distance to B over the surface of A.

    In the tangent plane of A at x, with n_B the normal at the foot on B: gradient t_i.n_B, Hessian
    t_i.(sum_k k_B/(1 + k_B delta) e_k e_k).t_j - k_A (n_A.n_B); a step is laid back on A by its
    nearest point, so that poles need no care. Returns delta, s_A, s_B, x_A, x_B.
    """
    edges_a, series_a, samples_a = table_a
    edges_b, series_b, samples_b = table_b
    centre_a, R_a, scale_a = body_a
    centre_b, R_b, scale_b = body_b
    x, n, t, e, k1, k2 = _surface(edges_a, series_a, s, cosine, sine)
    x = centre_a + scale_a * _turn(R_a, x)
    delta, s_b, c_b, i_b = _foot(edges_b, series_b, samples_b, centre_b, R_b, scale_b, x)
    size = scale_a * np.abs(samples_a[1:]).max()
    longest = 0.3 * size
    for _ in range(_NEWTON_STEPS):
        n, t, e = _turn(R_a, n), _turn(R_a, t), _turn(R_a, e)
        _, n_b, t_b, e_b, q1, q2 = _surface(edges_b, series_b, s_b, c_b, i_b)
        n_b, t_b, e_b = _turn(R_b, n_b), _turn(R_b, t_b), _turn(R_b, e_b)
        q1, q2 = q1 / (scale_b + q1 * delta), q2 / (scale_b + q2 * delta)
        facing = _dot(n, n_b)
        h11 = q1 * _dot(t, t_b) ** 2 + q2 * _dot(t, e_b) ** 2 - k1 / scale_a * facing
        h22 = q1 * _dot(e, t_b) ** 2 + q2 * _dot(e, e_b) ** 2 - k2 / scale_a * facing
        h12 = q1 * _dot(t, t_b) * _dot(e, t_b) + q2 * _dot(t, e_b) * _dot(e, e_b)
        d1, d2 = _newton_step(_dot(t, n_b), _dot(e, n_b), h11, h12, h22, longest)
        if np.hypot(d1, d2) < 1e-11 * size:
            break
        moved = False
        for _ in range(40):
            _, s_new, cosine, sine = _foot(
                edges_a, series_a, samples_a, centre_a, R_a, scale_a, x + d1 * t + d2 * e
            )
            x_new, n_new, t_new, e_new, k1_new, k2_new = _surface(
                edges_a, series_a, s_new, cosine, sine
            )
            x_new = centre_a + scale_a * _turn(R_a, x_new)
            delta_new, s_b_new, c_b_new, i_b_new = _foot(
                edges_b, series_b, samples_b, centre_b, R_b, scale_b, x_new
            )
            if delta_new < delta:
                moved = True
                break
            d1, d2 = 0.5 * d1, 0.5 * d2
            if np.hypot(d1, d2) < 1e-11 * size:
                break
        if not moved:
            break
        x, n, t, e, k1, k2, s = x_new, n_new, t_new, e_new, k1_new, k2_new, s_new
        delta, s_b, c_b, i_b = delta_new, s_b_new, c_b_new, i_b_new
    x_b = centre_b + scale_b * _turn(R_b, _surface(edges_b, series_b, s_b, c_b, i_b)[0])
    return delta, s, s_b, x, x_b


@jit
def _least_distance(table_a, body_a, table_b, body_b):
    """Return the best of Newton's methods from the lowest local minima of a grid on A."""
    edges_a, series_a, samples_a = table_a
    edges_b, series_b, samples_b = table_b
    centre_a, R_a, scale_a = body_a
    centre_b, R_b, scale_b = body_b
    towards = _turn_back(R_a, centre_b - centre_a)
    first = np.arctan2(towards[1], towards[0])
    grid = np.empty((_RINGS, _AZIMUTHS))
    n = samples_a.shape[1]
    for i in range(_RINGS):
        s = samples_a[0, i * (n - 1) // (_RINGS - 1)]
        for k in range(_AZIMUTHS):
            phi = first + 2.0 * np.pi * k / _AZIMUTHS
            x = _surface(edges_a, series_a, s, np.cos(phi), np.sin(phi))[0]
            x = centre_a + scale_a * _turn(R_a, x)
            grid[i, k] = _foot(edges_b, series_b, samples_b, centre_b, R_b, scale_b, x)[0]
    starts = np.full((_RINGS, _AZIMUTHS), np.inf)
    for i in range(_RINGS):
        for k in range(_AZIMUTHS):
            lowest = np.inf
            for j in range(max(i - 1, 0), min(i + 2, _RINGS)):
                for m in range(k - 1, k + 2):
                    lowest = min(lowest, grid[j, m % _AZIMUTHS])
            if grid[i, k] <= lowest:
                starts[i, k] = grid[i, k]
    # No point of A is farther than this from the grid, nor its distance lower by more.
    cell = scale_a * (_widest_ring(samples_a) + np.pi / _AZIMUTHS * samples_a[1].max())
    best = (np.inf, 0.0, 0.0, centre_a, centre_b)
    for _ in range(_STARTS):
        flat = np.argmin(starts)
        i, k = flat // _AZIMUTHS, flat % _AZIMUTHS
        if starts[i, k] == np.inf or starts[i, k] > best[0] + cell:
            break
        starts[i, k] = np.inf
        phi = first + 2.0 * np.pi * k / _AZIMUTHS
        s = samples_a[0, i * (n - 1) // (_RINGS - 1)]
        found = _least_from(table_a, body_a, table_b, body_b, s, np.cos(phi), np.sin(phi))
        if found[0] < best[0]:
            best = found
    return best


@jit
def _widest_ring(samples):
    """Greatest distance along the meridian of a point from the nearest of the grid's rings."""
    n = samples.shape[1]
    widest = 0.0
    for i in range(_RINGS - 1):
        length = 0.0
        for j in range(i * (n - 1) // (_RINGS - 1), (i + 1) * (n - 1) // (_RINGS - 1)):
            length += np.hypot(samples[1, j + 1] - samples[1, j], samples[2, j + 1] - samples[2, j])
        widest = max(widest, length)
    return 0.5 * widest


@jit
def least_distances(
    pairs, centres, rotations, scales, curves, spheres, table_starts, edges, series, sample_starts,
    samples, delta, s, points,
):  # fmt: skip
    """Fill delta (m,), s (m, 2), points (m, 2, 3) of the pairs (m, 2) of bodies.

    curves : curve of each body; spheres : radius of curves that are spheres, else 0. Curve c owns
    panels table_starts[c] .. table_starts[c + 1], edges from table_starts[c] + c on, and samples
    sample_starts[c] .. of `samples` (3, n).
    """
    for m in range(len(pairs)):
        a, b = pairs[m]
        flipped = spheres[curves[b]] > 0.0
        if flipped:
            a, b = b, a
        c, d = curves[a], curves[b]
        table_b = (
            edges[table_starts[d] + d : table_starts[d + 1] + d + 1],
            series[table_starts[d] : table_starts[d + 1]],
            samples[:, sample_starts[d] : sample_starts[d + 1]],
        )
        if spheres[c] > 0.0:
            found = _sphere_distance(
                scales[a] * spheres[c], centres[a], rotations[a], table_b, centres[b], rotations[b],
                scales[b], spheres[d],
            )  # fmt: skip
        else:
            table_a = (
                edges[table_starts[c] + c : table_starts[c + 1] + c + 1],
                series[table_starts[c] : table_starts[c + 1]],
                samples[:, sample_starts[c] : sample_starts[c + 1]],
            )
            found = _least_distance(
                table_a,
                (centres[a], rotations[a], scales[a]),
                table_b,
                (centres[b], rotations[b], scales[b]),
            )
        first, second = (1, 0) if flipped else (0, 1)
        delta[m] = found[0]
        s[m, first], s[m, second] = found[1], found[2]
        points[m, first], points[m, second] = found[3], found[4]


@jit
def _sphere_distance(radius, centre, R, table_b, centre_b, R_b, scale_b, sphere_b):
    """Least distance of a sphere from a body: along the normal through its centre."""
    edges, series, samples = table_b
    if sphere_b > 0.0:
        between = centre - centre_b
        distance = np.sqrt(_dot(between, between))
        delta = distance - scale_b * sphere_b
        n = between / distance if distance > 0.0 else R_b[:, 2].copy()
        s_b = _polar_parameter(_turn_back(R_b, n))
    else:
        delta, s_b, c_b, i_b = _foot(edges, series, samples, centre_b, R_b, scale_b, centre)
        n = _turn(R_b, _surface(edges, series, s_b, c_b, i_b)[1])
    return (
        delta - radius,
        _polar_parameter(_turn_back(R, -n)),
        s_b,
        centre - radius * n,
        centre - delta * n,
    )


@jit
def _polar_parameter(direction):
    """Parameter of a sphere's point in a direction: its polar angle over pi."""
    return np.arctan2(np.hypot(direction[0], direction[1]), direction[2]) / np.pi
