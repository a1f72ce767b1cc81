"""Contacts of spheroids with points, segments, each other and walls.

Rows of contacts and of walls as in `_kernels_shapes`.

Symbols: a, c equatorial and polar semi-axis; d unit axis; Q matrix of a spheroid, h = sqrt(n'Qn)
support function and p = Qn / h support point of direction n; delta signed distance, negative
inside; (s, rho) meridian coordinates along and across an axis; D = x_b - x_a; X centre relative
to a wall; phi azimuth about the axis k of a frustum.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi._kernels_vectors import (
    EPS,
    MERGE,
    across,
    along,
    clamp,
    cross,
    dot,
    meridian,
    neg,
    norm,
    put,
    scaled,
    sort_along,
    sub,
    unit,
    vec,
)
from dem_mpi._kernels_wall_points import (
    crossings,
    frustum_frame,
)

_ARCS = 32  # arcs of a circle searched for one extremum each


# ---- spheroid and point --------------------------------------------------------------------


@jit
def _support(n, d, a, c):
    """Return h(n) = sqrt(n'Qn) and p(n) = Qn / h of a spheroid, for a unit vector n."""
    s = dot(n, d)
    e = along(n, -s, d)
    h = np.sqrt(a * a * dot(e, e) + c * c * s * s)
    return h, along(scaled(a * a / h, e), c * c * s / h, d)


@jit
def meridian_foot(s, rho, a, c):
    """Return (foot_s, foot_rho, n_s, n_rho, delta): the closest point of an ellipse to (s, rho).

    With semi-axes e0 >= e1, coordinates y0, y1 >= 0 and E = e0^2 - e1^2 the closest point is
    x_i = e_i w_i, w1 = e1 y1 / u, w0 = e0 y0 / (u + E), where q(u) = |w| = 1. As for the secular
    equation of a trust region, 1/q is nearly linear in u: Newton on it rises to the root from
    any u with q >= 1, in about four steps. Counting u from the pole next to the root keeps its
    digits where y1 is tiny.
    """
    axial = abs(s)
    prolate = c >= a
    e0, e1 = (c, a) if prolate else (a, c)
    y0, y1 = (axial, rho) if prolate else (rho, axial)
    E = (e0 - e1) * (e0 + e1)
    w0, w1 = 0.0, 1.0
    u = max(e1 * y1, e0 * y0 - E)
    if u > 0.0:
        for _ in range(60):
            w1 = e1 * y1 / u
            w0 = e0 * y0 / (u + E)
            q2 = w0 * w0 + w1 * w1
            q = np.sqrt(q2)
            w0 /= q
            w1 /= q
            if q - 1.0 <= 4.0 * EPS:
                break
            u += (q - 1.0) / (w1 * w1 / u + w0 * w0 / (u + E))
    elif E > 0.0:  # on the major axis, between the centres of curvature
        w0 = min(e0 * y0 / E, 1.0)
        w1 = np.sqrt((1.0 - w0) * (1.0 + w0))
    f0, f1 = e0 * w0, e1 * w1
    n0, n1 = w0 / e0, w1 / e1
    length = np.sqrt(n0 * n0 + n1 * n1)
    n0 /= length
    n1 /= length
    delta = n0 * (y0 - f0) + n1 * (y1 - f1)
    foot_s, foot_rho = (f0, f1) if prolate else (f1, f0)
    n_s, n_rho = (n0, n1) if prolate else (n1, n0)
    if s < 0.0:
        foot_s, n_s = -foot_s, -n_s
    return foot_s, foot_rho, n_s, n_rho, delta


@jit
def spheroid_foot(y, d, a, c):
    """Return (delta, n, foot): signed distance of a point y from a spheroid centred at 0.

    delta < 0 inside; n is the outward normal at the closest point `foot` of the surface. Where
    several are closest one is taken: the upper on the equatorial plane, any around the axis.
    """
    s, rho, radial = meridian(y, d)
    foot_s, foot_rho, n_s, n_rho, delta = meridian_foot(s, rho, a, c)
    n = along(scaled(n_s, d), n_rho, radial)
    return delta, n, along(scaled(foot_s, d), foot_rho, radial)


@jit
def _distance_curvature(n, delta, d, a, c, v):
    """Return v . Hess delta . v, Hess delta = 1 / (R + delta) in the principal directions.

    The radii of curvature are R = a^2 c^2 / h^3 along the meridian and a^2 / h across it.
    """
    ns = dot(n, d)
    e = along(d, -ns, n)
    w2 = dot(e, e)
    h2 = a * a * w2 + c * c * ns * ns
    h = np.sqrt(h2)
    meridional = 0.0 if w2 == 0.0 else dot(v, e) ** 2 / w2
    vn = dot(v, n)
    azimuthal = max(dot(v, v) - vn * vn - meridional, 0.0)
    return meridional / (a * a * c * c / (h * h2) + delta) + azimuthal / (a * a / h + delta)


@jit
def spheroid_segment(y, e, l, d, a, c):  # noqa: E741
    """Return (t, delta, n, foot): where the segment y + t e, |t| <= l, is nearest to a spheroid.

    The spheroid is centred at 0. delta is convex along the segment, for the spheroid is convex:
    the root of delta' = n.e lies between the ends or the nearest point is one of them. Newton
    with the exact delta'', bisection where it leaves the bracket or delta' jumps (deep inside,
    where the closest point of the surface is not unique).
    """
    es, ys = dot(e, d), dot(y, d)
    ee, ye = 1.0 - es * es, dot(y, e) - ys * es
    t = -(ye / (a * a) + ys * es / (c * c)) / (ee / (a * a) + es * es / (c * c))
    t = clamp(t, -l, l)
    low, high = -l, l
    low_known, high_known = False, False
    delta, n, foot = spheroid_foot(along(y, t, e), d, a, c)
    for step in range(120):
        slope = dot(n, e)
        if abs(slope) <= 2.0 * EPS or l == 0.0:
            break
        if slope > 0.0:
            if t == -l:
                break
            high, high_known = t, True
        else:
            if t == l:
                break
            low, low_known = t, True
        new = t - slope / _distance_curvature(n, delta, d, a, c, e)
        if step > 8 and step % 2 == 0 and low_known and high_known:
            new = 0.5 * (low + high)
        if not new > low:
            new = 0.5 * (low + high) if low_known else low
        elif not new < high:
            new = 0.5 * (low + high) if high_known else high
        if abs(new - t) <= EPS * (l + a + c):
            break
        t = new
        delta, n, foot = spheroid_foot(along(y, t, e), d, a, c)
    return t, delta, n, foot


@jit
def spheroid_rod(D, da, a, c, db, rb, lb, limit):
    """Return (gap, n, point) of spheroid a and spherocylinder b, the point relative to a."""
    _, delta, n, foot = spheroid_segment(D, db, lb, da, a, c)
    gap = delta - rb
    return gap, n, along(foot, 0.5 * gap, n)


# ---- two spheroids -------------------------------------------------------------------------


@jit
def separation(n, D, da, a_a, c_a, db, a_b, c_b):
    """Return f(n) = n.D - h_a(n) - h_b(n): how far direction n keeps two spheroids apart."""
    return dot(n, D) - _support(n, da, a_a, c_a)[0] - _support(n, db, a_b, c_b)[0]


@jit
def _support_hessian(n, d, a, c, h, t1, t2):
    """Hess h on the tangent plane (t1, t2) of n: (a^2/h) (1 - (a^2 - c^2)/h^2 dd')."""
    u1, u2 = dot(d, t1), dot(d, t2)
    scale = a * a / h
    k = (a - c) * (a + c) / (h * h)
    return scale * (1.0 - k * u1 * u1), -scale * k * u1 * u2, scale * (1.0 - k * u2 * u2)


@jit
def newton_direction(n, D, da, a_a, c_a, db, a_b, c_b):
    """Return (f, g, xi): the value of `separation`, its gradient on the sphere, the Newton step.

    g = P (D - p_a - p_b) with P the projector on the tangent plane of n, and
    (H_a + H_b + f 1) xi = g. Where that matrix is not safely definite (f below minus the sum of
    curvature radii: deep overlap) f in it is raised until it is, so xi always ascends.
    """
    h_a, p_a = _support(n, da, a_a, c_a)
    h_b, p_b = _support(n, db, a_b, c_b)
    G = sub(sub(D, p_a), p_b)
    f = dot(n, D) - h_a - h_b
    t1 = across(n)
    t2 = cross(n, t1)
    xx, xy, yy = _support_hessian(n, da, a_a, c_a, h_a, t1, t2)
    bxx, bxy, byy = _support_hessian(n, db, a_b, c_b, h_b, t1, t2)
    xx, xy, yy = xx + bxx, xy + bxy, yy + byy
    half_trace = 0.5 * (xx + yy)
    # the smaller eigenvalue, as det over the larger: no cancellation at high aspect ratios
    smallest = (xx * yy - xy * xy) / (half_trace + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy))
    shift = max(f, -0.9 * smallest)
    xx, yy = xx + shift, yy + shift
    g1, g2 = dot(G, t1), dot(G, t2)
    det = xx * yy - xy * xy
    x1, x2 = (yy * g1 - xy * g2) / det, (xx * g2 - xy * g1) / det
    g = along(scaled(g1, t1), g2, t2)
    return f, g, along(scaled(x1, t1), x2, t2)


@jit
def _ascend(n, D, da, a_a, c_a, db, a_b, c_b, size, limit):
    """Climb `separation` from n by Newton steps with backtracking; return (n, f).

    Stops as soon as f > limit: f(n) never exceeds the gap, so there is no contact.
    """
    last = np.inf
    f = -np.inf
    for _ in range(100):
        f, g, xi = newton_direction(n, D, da, a_a, c_a, db, a_b, c_b)
        slope = norm(g)
        if f > limit or slope <= 2.0 * EPS * size:
            break
        if slope <= 1e-10 * size and slope >= 0.5 * last:  # round-off
            break
        last = slope
        length = norm(xi)
        alpha = min(1.0, 1.0 / length)
        gain = 1e-4 * dot(g, xi)
        moved = False
        for _ in range(40):
            trial = unit(along(n, alpha, xi))
            value = separation(trial, D, da, a_a, c_a, db, a_b, c_b)
            if value >= f + alpha * gain - 8.0 * EPS * size:
                moved = True
                break
            alpha *= 0.5
        if not moved:
            break
        n = trial
    return n, f


@jit
def _start(k, D, da, a_a, c_a, db, a_b, c_b):
    """Return the k-th of seven directions to start from, each with n.D >= 0."""
    n = D
    if k == 1:  # the normal of a where D pierces it
        n = along(D, (a_a * a_a / (c_a * c_a) - 1.0) * dot(D, da), da)
    elif k == 2:
        n = along(D, (a_b * a_b / (c_b * c_b) - 1.0) * dot(D, db), db)
    elif k == 3:
        n = da
    elif k == 4:
        n = db
    elif k == 5:
        n = along(D, -dot(D, da), da)
    elif k == 6:
        n = along(D, -dot(D, db), db)
    n = unit(n)
    return neg(n) if dot(n, D) < 0.0 else n


@jit
def spheroid_pair(D, da, a_a, c_a, db, a_b, c_b, limit):
    """Return (gap, n, point) of two spheroids: gap = max f(n) over unit n, or > limit.

    Stationary: D - p_a(n) - p_b(n) = f n. f is concave in n, and so is f + R with R the sum of the
    smallest radii of curvature, as long as it is positive: a stationary n with f > -R is the one
    maximum. Only deeper overlaps need further starts.
    """
    size = max(a_a, c_a) + max(a_b, c_b)
    n = _start(0, D, da, a_a, c_a, db, a_b, c_b)
    best = separation(n, D, da, a_a, c_a, db, a_b, c_b)
    for k in range(1, 3):
        trial = _start(k, D, da, a_a, c_a, db, a_b, c_b)
        value = separation(trial, D, da, a_a, c_a, db, a_b, c_b)
        if value > best:
            n, best = trial, value
    if best > limit:
        return best, n, n
    n, f = _ascend(n, D, da, a_a, c_a, db, a_b, c_b, size, limit)
    radii = min(a_a, c_a) ** 2 / max(a_a, c_a) + min(a_b, c_b) ** 2 / max(a_b, c_b)
    if f <= -radii:
        for k in range(7):
            trial = _start(k, D, da, a_a, c_a, db, a_b, c_b)
            trial, value = _ascend(trial, D, da, a_a, c_a, db, a_b, c_b, size, limit)
            if value > f + 4.0 * EPS * size:
                n, f = trial, value
    p_a = _support(n, da, a_a, c_a)[1]
    p_b = _support(n, db, a_b, c_b)[1]
    return f, n, scaled(0.5, sub(along(p_a, 1.0, D), p_b))


# ---- walls ---------------------------------------------------------------------------------


@jit
def spheroid_plane(X, d, a, c, m):
    """Return (gap, point) of a spheroid at X and the half space below m.x = 0."""
    h, p = _support(m, d, a, c)
    gap = dot(X, m) - h
    return gap, along(neg(p), -0.5 * gap, m)


@jit
def _over_face(Y, e1, e2, margin):
    """Whether Y, relative to the centre of a rectangle, projects into it."""
    return abs(dot(Y, e1)) <= dot(e1, e1) + margin * norm(e1) and abs(dot(Y, e2)) <= (
        dot(e2, e2) + margin * norm(e2)
    )


@jit
def _passes_edge(X, foot, gap, a, c, m, e1, e2):
    """Whether the lowest point of a body is under the plate by way of an edge, not of the face.

    So it is if the line to it from the centre crosses the plane outside the rectangle.
    """
    if gap >= 0.0:
        return False
    height = dot(X, m)
    lowest = along(foot, 0.5 * gap, m)
    Y = along(X, height / (height - gap), sub(lowest, X))
    return not _over_face(Y, e1, e2, MERGE * min(a, c))


@jit
def spheroid_rectangle(x, d, a, c, g, limit, out):
    """The face where the lowest point stands above it, else the nearest of the four edges.

    The signed distance to the spheroid is convex over the plate: its minimum is the lowest
    point's foot if that is inside, and on the boundary otherwise.
    """
    m, e1, e2 = vec(g[3:6]), vec(g[6:9]), vec(g[9:12])
    X = sub(x, vec(g[0:3]))
    if dot(X, m) < 0.0:
        m = neg(m)
    gap, point = spheroid_plane(X, d, a, c, m)
    foot = along(X, 1.0, point)
    n = neg(m)
    if not _over_face(foot, e1, e2, 0.0) or _passes_edge(X, foot, gap, a, c, m, e1, e2):
        gap = np.inf
        l1, l2 = norm(e1), norm(e2)
        u1, u2 = scaled(1.0 / l1, e1), scaled(1.0 / l2, e2)
        for k in range(4):
            sign = 1.0 if k % 2 == 0 else -1.0
            if k < 2:
                Y = sub(scaled(sign, e2), X)
                _, delta, normal, surface = spheroid_segment(Y, u1, l1, d, a, c)
            else:
                Y = sub(scaled(sign, e1), X)
                _, delta, normal, surface = spheroid_segment(Y, u2, l2, d, a, c)
            if delta < gap:
                gap, n, point = delta, normal, along(surface, 0.5 * delta, normal)
    if not gap <= limit:
        return 0
    put(out, 0, n, gap, point)
    return 1


@jit
def _face_slope(phi, X, d, a, c, k, e1, e2, cos, sin, side):
    """Return (psi, psi', psi'') of psi(phi) = n.X + side h(n), n(phi) the cone's outward normal.

    The gap is side (cos r0 - psi): from inside the least over phi of what separates the body from
    the tangent planes, from outside the largest.
    """
    radial = along(scaled(np.cos(phi), e1), np.sin(phi), e2)
    turned = along(scaled(-np.sin(phi), e1), np.cos(phi), e2)
    n = along(scaled(cos, radial), -sin, k)
    h, p = _support(n, d, a, c)
    Y = along(X, side, p)
    k2 = (a - c) * (a + c) / (h * h)
    bend = cos * cos * a * a / h * (1.0 - k2 * dot(d, turned) ** 2)
    return (
        dot(n, X) + side * h,
        cos * dot(turned, Y),
        side * bend - cos * dot(radial, Y),
    )


@jit
def _rim_delta(phi, X, d, a, c, k, e1, e2, rim_s, rim_r):
    """Return (delta, delta', delta'') along a rim, the distance from a spheroid at X, negated.

    Negated, so that maxima are sought here too.
    """
    radial = along(scaled(np.cos(phi), e1), np.sin(phi), e2)
    turned = along(scaled(-rim_r * np.sin(phi), e1), rim_r * np.cos(phi), e2)
    q = sub(along(scaled(rim_s, k), rim_r, radial), X)
    delta, n, _ = spheroid_foot(q, d, a, c)
    bend = _distance_curvature(n, delta, d, a, c, turned) - rim_r * dot(n, radial)
    return -delta, -dot(n, turned), -bend


@jit
def _climb(rim, low, high, X, d, a, c, k, e1, e2, p, q, side):
    """Return the azimuth of the maximum between low (rising) and high (falling).

    Newton with bisection as its safeguard, on `_rim_delta` with (p, q) = (rim_s, rim_r) if `rim`,
    else on `_face_slope` with (p, q) = (cos, sin).
    """
    phi = 0.5 * (low + high)
    for step in range(120):
        if rim:
            _, slope, bend = _rim_delta(phi, X, d, a, c, k, e1, e2, p, q)
        else:
            _, slope, bend = _face_slope(phi, X, d, a, c, k, e1, e2, p, q, side)
        if slope == 0.0:
            break
        if slope > 0.0:
            low = phi
        else:
            high = phi
        new = phi - slope / bend
        if not low < new < high or (step > 8 and step % 2 == 0):
            new = 0.5 * (low + high)
        if abs(new - phi) <= 4.0 * EPS:
            break
        phi = new
    return phi


@jit
def _peaks(rim, window, X, d, a, c, k, e1, e2, p, q, side, peak):
    """Fill `peak` with azimuths of local maxima within +-window of e1; return how many.

    One is found in each arc over which the slope turns from rising to falling; those of a full
    circle begin beside the directions of symmetry, where the slope's sign would be round-off. A
    function that is constant (a body on the axis) is given two opposite azimuths.
    """
    count = 0
    tolerance = 1e-13 * (q if rim else p * (a + c + norm(X)))
    shift = 0.37 * window / _ARCS if window == np.pi else 0.0
    steepest = 0.0
    previous = 0.0
    for i in range(_ARCS + 1):
        phi = shift + window * (2.0 * i / _ARCS - 1.0)
        if rim:
            slope = _rim_delta(phi, X, d, a, c, k, e1, e2, p, q)[1]
        else:
            slope = _face_slope(phi, X, d, a, c, k, e1, e2, p, q, side)[1]
        steepest = max(steepest, abs(slope))
        if i > 0 and previous > 0.0 and slope <= 0.0 and count < peak.shape[0]:
            low = shift + window * (2.0 * (i - 1) / _ARCS - 1.0)
            peak[count] = _climb(rim, low, phi, X, d, a, c, k, e1, e2, p, q, side)
            count += 1
        previous = slope
    if steepest <= tolerance:
        peak[0], peak[1] = 0.0, np.pi
        count = 2
    return count


@jit
def _through_face(X, surface, gap, a, c, g):
    """Whether a point of a body reached the back of a frustum, if so, through it: not round a rim.

    X and the point are relative to the base and to the centre of the body.
    """
    if gap >= 0.0:
        return True
    x = along(vec(g[0:3]), 1.0, X)
    crosses, pierces = crossings(x, along(x, 1.0, surface), g, MERGE * min(a, c))
    return pierces or not crosses


@jit
def _spheroid_face(X, d, a, c, g, k, e1, e2, limit, peak, found, count):
    """Append the contacts with the surface of a frustum between its rims; return their number."""
    L, slant, us, ur, cos, sin = frustum_frame(g)
    side, r0 = g[9], g[7]
    if L == 0.0:
        m = scaled(side * sin, k)
        gap, point = spheroid_plane(X, d, a, c, m)
        surface = along(point, 0.5 * gap, m)
        f = ur * (meridian(along(X, 1.0, surface), k)[1] - r0)
        if gap <= limit and 0.0 <= f <= slant and _through_face(X, surface, gap, a, c, g):
            put(found, count, neg(m), gap, point)
            count += 1
        return count
    peaks = _peaks(False, np.pi, X, d, a, c, k, e1, e2, cos, sin, side, peak)
    best = -np.inf
    if side < 0.0:  # convex: only the highest of the maxima is a distance
        for i in range(peaks):
            best = max(best, _face_slope(peak[i], X, d, a, c, k, e1, e2, cos, sin, side)[0])
    for i in range(peaks):
        psi = _face_slope(peak[i], X, d, a, c, k, e1, e2, cos, sin, side)[0]
        gap = side * (cos * r0 - psi)
        if psi < best or not gap <= limit:
            continue
        radial = along(scaled(np.cos(peak[i]), e1), np.sin(peak[i]), e2)
        n = along(scaled(side * cos, radial), -side * sin, k)
        surface = _support(n, d, a, c)[1]
        Y = along(X, 1.0, surface)
        f = us * dot(Y, k) + ur * (dot(Y, radial) - r0)
        if 0.0 <= f <= slant and _through_face(X, surface, gap, a, c, g):
            put(found, count, n, gap, along(surface, 0.5 * gap, n))
            count += 1
        if side < 0.0:
            break
    return count


@jit
def _spheroid_rim(top, alone, X, d, a, c, g, k, e1, e2, limit, peak, found, count):
    """Append the contacts with one rim of a frustum; return their number.

    A rim ends the surface: it is touched from the outside of the meridian segment only, the
    inside belongs to the face. An overlapping rim without a contact on the face counts anyhow:
    deep in a thin body its nearest way out may point either way.
    """
    L, _, us, ur, _, _ = frustum_frame(g)
    rim_s, rim_r = (L, g[8]) if top else (0.0, g[7])
    s, rho, _ = meridian(X, k)
    reach = max(a, c) + max(limit, 0.0)
    if (s - rim_s) ** 2 + (rho - rim_r) ** 2 > reach * reach:
        return count
    window, peaks = np.pi, 1
    if rim_r > 0.0:
        if rho > 0.0:
            cosine = ((s - rim_s) ** 2 + rho * rho + rim_r * rim_r - reach * reach) / (
                2.0 * rho * rim_r
            )
            window = np.arccos(clamp(cosine, -1.0, 1.0))
        peaks = _peaks(True, window, X, d, a, c, k, e1, e2, rim_s, rim_r, 1.0, peak)
    else:
        peak[0] = 0.0
    outward = 1.0 if top else -1.0
    for i in range(peaks):
        radial = along(scaled(np.cos(peak[i]), e1), np.sin(peak[i]), e2)
        q = sub(along(scaled(rim_s, k), rim_r, radial), X)
        delta, n, surface = spheroid_foot(q, d, a, c)
        inward = outward * (us * dot(n, k) + ur * dot(n, radial))
        if delta <= limit and (inward <= 1e-9 or (alone and delta < 0.0)):
            put(found, count, n, delta, along(surface, 0.5 * delta, n))
            count += 1
    return count


@jit
def spheroid_frustum(x, d, a, c, g, limit, hidden, out):
    """Spheroid and frustum: the deepest contact and the one farthest from it."""
    X, k = sub(x, vec(g[0:3])), vec(g[3:6])
    _, rho, e1 = meridian(X, k)
    if rho <= EPS * max(a, c):  # on the axis: start from the body's own axis
        side_d = along(d, -dot(d, k), k)
        e1 = unit(side_d) if norm(side_d) > 1e-8 else across(k)
    e2 = cross(k, e1)
    found = np.empty((3 * _ARCS, 7))
    peak = np.empty(_ARCS)
    count = 0
    if not hidden:
        count = _spheroid_face(X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    alone = count == 0
    count = _spheroid_rim(False, alone, X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    count = _spheroid_rim(True, alone, X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    if count == 0:
        return 0
    first = 0
    for i in range(1, count):
        if found[i, 3] < found[first, 3]:
            first = i
    out[0] = found[first]
    reach, second = MERGE * min(a, c), -1
    for i in range(count):
        distance = norm(sub(vec(found[i, 4:7]), vec(found[first, 4:7])))
        if distance > reach:
            reach, second = distance, i
    if second < 0:
        return 1
    out[1] = found[second]
    sort_along(out, d)
    return 2
