"""Narrow phase of axisymmetric bodies: contacts of one pair, or of one body with one wall.

Plain scalars, triples and small caller-owned arrays in and out, so that loops over pairs stay
free of allocation. A body is (kind, x, d, r, l): centre x, unit symmetry axis d in the world,
and by kind

    SPHERE          r radius
    SPHEROCYLINDER  r radius of the caps, l half length of the core segment x - l d .. x + l d
    SPHEROID        r equatorial semi-axis, l polar semi-axis (prolate l > r, oblate l < r)

A wall is (kind, g) with a row g of twelve numbers:

    PLANE      point g[0:3], unit normal g[3:6] towards the bodies
    RECTANGLE  centre g[0:3], unit normal g[3:6], orthogonal half edges g[6:9] and g[9:12]; a plate
               of no thickness that is touched from both sides
    FRUSTUM    base centre g[0:3], unit axis g[3:6], length g[6], radii g[7] at the base and g[8]
               at the other end, side g[9]: +1 bodies towards the axis (on a flat ring, length 0:
               towards +axis), -1 on the other side

A contact is a row (n, gap, point): unit normal n from a to b (from the body into the wall), gap
negative where they overlap, and the point in the middle of the gap relative to the centre of a.
Both arms must end in one point, or a tangential impulse would leave a torque.

Symbols: D = x_b - x_a; s, t abscissas on the cores of a and b; a, c equatorial and polar semi-axis
of a spheroid; h support function; p support point; Q the matrix of a spheroid, h = sqrt(n'Qn);
(s, rho) meridian coordinates along and across an axis; phi azimuth; delta signed distance.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit

SPHERE, SPHEROCYLINDER, SPHEROID = 0, 1, 2
PLANE, RECTANGLE, FRUSTUM = 0, 1, 2

# (body kind, wall kind, side) without exact contacts, for scenes to refuse: every one has them.
UNSUPPORTED: frozenset[tuple[int, int, int]] = frozenset()

_EPS = 2.220446049250313e-16
_MERGE = 0.1  # contacts closer together than this part of the smallest size are one
_TIE = 1e-12  # relative to size: two candidates this close are equally good
_GENERIC = (0.6030226891555273, 0.5222329678670935, 0.6030226891555273)  # decides ties
_ARCS = 32  # arcs of a circle searched for one extremum each


# ---- triples -------------------------------------------------------------------------------


@jit
def _vec(x):
    return (x[0], x[1], x[2])


@jit
def _neg(u):
    return (-u[0], -u[1], -u[2])


@jit
def _sub(u, v):
    return (u[0] - v[0], u[1] - v[1], u[2] - v[2])


@jit
def _scaled(t, u):
    return (t * u[0], t * u[1], t * u[2])


@jit
def _along(u, t, v):
    """Return u + t v."""
    return (u[0] + t * v[0], u[1] + t * v[1], u[2] + t * v[2])


@jit
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@jit
def _cross(u, v):
    return (
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    )


@jit
def _norm(u):
    return np.sqrt(_dot(u, u))


@jit
def _unit(u):
    """Return u / |u|, or e_z for a zero u."""
    length = _norm(u)
    if length > 0.0:
        return (u[0] / length, u[1] / length, u[2] / length)
    return (0.0, 0.0, 1.0)


@jit
def _clamp(t, low, high):
    return min(max(t, low), high)


@jit
def _across(d):
    """Return a unit vector perpendicular to the unit vector d."""
    if abs(d[0]) < 0.6:
        return _unit(_cross(d, (1.0, 0.0, 0.0)))
    return _unit(_cross(d, (0.0, 1.0, 0.0)))


@jit
def _put(out, row, n, gap, point):
    out[row, 0], out[row, 1], out[row, 2] = n
    out[row, 3] = gap
    out[row, 4], out[row, 5], out[row, 6] = point


@jit
def _sort_along(out, d):
    """Order two contacts along the axis d of body a, so that impulses find theirs again."""
    if _dot(_vec(out[0, 4:7]), d) > _dot(_vec(out[1, 4:7]), d):
        for k in range(7):
            out[0, k], out[1, k] = out[1, k], out[0, k]


# ---- sizes ---------------------------------------------------------------------------------


@jit
def bounding_radius(kind, r, l):  # noqa: E741
    """Return the radius [m] of the sphere about the centre that contains the body."""
    if kind == SPHEROCYLINDER:
        return r + l
    if kind == SPHEROID:
        return max(r, l)
    return r


@jit
def smallest_size(kind, r, l):  # noqa: E741
    """Return the radius [m] of the largest sphere about the centre inside the body."""
    if kind == SPHEROID:
        return min(r, l)
    return r


# ---- two cores -----------------------------------------------------------------------------


@jit
def _segment_distance(D, da, s, db, t):
    """Return the vector from abscissa s of core a to abscissa t of core b, and its length."""
    v = _along(_along(D, t, db), -s, da)
    return v, _norm(v)


@jit
def closest_segments(D, da, la, db, lb):
    """Return (s, t, distance, crossing) of the closest points of two segments.

    Either an end of one segment and its projection on the other, or, `crossing`, the common
    perpendicular of the two lines. The latter counts only where it is closer beyond round-off:
    nearly parallel segments thus meet at an end of their overlap, never at a random place on it.
    Its abscissas divide by |da x db|^2, which keeps its digits where 1 - (da.db)^2 has lost them.
    """
    best_s, best_t, best = 0.0, 0.0, np.inf
    for end in (-1.0, 1.0):
        s = end * la
        t = _clamp(s * _dot(da, db) - _dot(D, db), -lb, lb)
        distance = _segment_distance(D, da, s, db, t)[1]
        if distance < best:
            best_s, best_t, best = s, t, distance
    for end in (-1.0, 1.0):
        t = end * lb
        s = _clamp(t * _dot(da, db) + _dot(D, da), -la, la)
        distance = _segment_distance(D, da, s, db, t)[1]
        if distance < best:
            best_s, best_t, best = s, t, distance
    c = _cross(da, db)
    c2 = _dot(c, c)
    if c2 > 0.0:
        s = _dot(_cross(D, db), c) / c2
        t = _dot(_cross(D, da), c) / c2
        distance = abs(_dot(D, c)) / np.sqrt(c2)
        if abs(s) < la and abs(t) < lb and distance < best - 0.1 * _TIE * (la + lb):
            return s, t, distance, True
    return best_s, best_t, best, False


@jit
def _core_normal(D, v, distance, da, la, db, lb, crossing):
    """Return the unit normal from core a to core b, and whether it had to be invented.

    Where the cores touch or cross it is the common perpendicular, on the side of b's centre;
    of collinear ones e_z.
    """
    if distance > _EPS * (la + lb) and not crossing:
        return (v[0] / distance, v[1] / distance, v[2] / distance), 0
    c = _cross(da, db)
    if la > 0.0 and lb > 0.0 and _dot(c, c) > 0.0:
        n = _unit(c)
        return (_neg(n) if _dot(n, D) < 0.0 else n), 0
    return (0.0, 0.0, 1.0), 1


@jit
def _overlap_end(D, da, la, db, lb, reference):
    """Return (found, s, t) at the end of the overlap of two segments farther from `reference`.

    The overlap is taken along the bisector m of the axes, which favours neither; an end of it is
    an end of one segment, beside the closest point of the other. Ties go to the smaller
    distance, then to a fixed direction of space, never to the order of a and b.
    """
    sign = 1.0 if _dot(da, db) >= 0.0 else -1.0
    m = _unit(_along(da, sign, db))
    centre = _dot(D, m)
    half_a, half_b = la * abs(_dot(da, m)), lb * abs(_dot(db, m))
    low, high = max(-half_a, centre - half_b), min(half_a, centre + half_b)
    best_s, best_t, best_reach, best_distance, best_rank = 0.0, 0.0, -1.0, np.inf, -np.inf
    if not low <= high:
        return False, best_s, best_t
    tie = _TIE * (la + lb)
    for k in range(4):
        end = -1.0 if k % 2 == 0 else 1.0
        bound = low if end < 0.0 else high
        if k < 2:
            if abs(end * half_a - bound) > tie:
                continue
            s = end * la if _dot(da, m) >= 0.0 else -end * la
            t = _clamp(s * _dot(da, db) - _dot(D, db), -lb, lb)
        else:
            if abs(centre + end * half_b - bound) > tie:
                continue
            t = end * lb if _dot(db, m) >= 0.0 else -end * lb
            s = _clamp(t * _dot(da, db) + _dot(D, da), -la, la)
        v, distance = _segment_distance(D, da, s, db, t)
        middle = _along(_scaled(s, da), 0.5, v)
        reach = _norm(_sub(middle, reference))
        rank = _dot(_along(middle, -0.5, D), _GENERIC)
        better = reach > best_reach + tie
        if abs(reach - best_reach) <= tie:
            better = distance < best_distance - tie
            if abs(distance - best_distance) <= tie:
                better = rank > best_rank
        if better:
            best_s, best_t, best_reach, best_distance, best_rank = s, t, reach, distance, rank
    return best_reach >= 0.0, best_s, best_t


@jit
def _rod_pair(D, da, ra, la, db, rb, lb, limit, out):
    """Contacts of two spherocylinders, spheres among them; see `pair_contacts`."""
    s, t, distance, crossing = closest_segments(D, da, la, db, lb)
    gap = distance - (ra + rb)
    if not gap <= limit:
        return 0, 0
    v, _ = _segment_distance(D, da, s, db, t)
    n, coincident = _core_normal(D, v, distance, da, la, db, lb, crossing)
    first = _along(_scaled(s, da), ra + 0.5 * gap, n)
    _put(out, 0, n, gap, first)
    if la == 0.0 or lb == 0.0:
        return 1, coincident
    # The reference is the middle between the cores: unlike the contact it does not depend on n.
    found, s, t = _overlap_end(D, da, la, db, lb, _along(_scaled(s, da), 0.5, v))
    if not found:
        return 1, coincident
    v, distance = _segment_distance(D, da, s, db, t)
    gap = distance - (ra + rb)
    if distance > _EPS * (la + lb):
        n = (v[0] / distance, v[1] / distance, v[2] / distance)
    second = _along(_scaled(s, da), ra + 0.5 * gap, n)
    if not gap <= limit or _norm(_sub(second, first)) <= _MERGE * min(ra, rb):
        return 1, coincident
    _put(out, 1, n, gap, second)
    _sort_along(out, da)
    return 2, coincident


# ---- spheroid and point --------------------------------------------------------------------


@jit
def _support(n, d, a, c):
    """Return h(n) = sqrt(n'Qn) and p(n) = Qn / h of a spheroid, for a unit vector n."""
    s = _dot(n, d)
    e = _along(n, -s, d)
    h = np.sqrt(a * a * _dot(e, e) + c * c * s * s)
    return h, _along(_scaled(a * a / h, e), c * c * s / h, d)


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
            if q - 1.0 <= 4.0 * _EPS:
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
    s = _dot(y, d)
    e = _along(y, -s, d)
    rho = _norm(e)
    radial = _scaled(1.0 / rho, e) if rho > 0.0 else _across(d)
    foot_s, foot_rho, n_s, n_rho, delta = meridian_foot(s, rho, a, c)
    n = _along(_scaled(n_s, d), n_rho, radial)
    return delta, n, _along(_scaled(foot_s, d), foot_rho, radial)


@jit
def _distance_curvature(n, delta, d, a, c, v):
    """Return v . Hess delta . v, Hess delta = 1 / (R + delta) in the principal directions.

    The radii of curvature are R = a^2 c^2 / h^3 along the meridian and a^2 / h across it.
    """
    ns = _dot(n, d)
    e = _along(d, -ns, n)
    w2 = _dot(e, e)
    h2 = a * a * w2 + c * c * ns * ns
    h = np.sqrt(h2)
    along = 0.0 if w2 == 0.0 else _dot(v, e) ** 2 / w2
    vn = _dot(v, n)
    across = max(_dot(v, v) - vn * vn - along, 0.0)
    return along / (a * a * c * c / (h * h2) + delta) + across / (a * a / h + delta)


@jit
def spheroid_segment(y, e, l, d, a, c):  # noqa: E741
    """Return (t, delta, n, foot): where the segment y + t e, |t| <= l, is nearest to a spheroid.

    The spheroid is centred at 0. delta is convex along the segment, for the spheroid is convex:
    the root of delta' = n.e lies between the ends or the nearest point is one of them. Newton
    with the exact delta'', bisection where it leaves the bracket or delta' jumps (deep inside,
    where the closest point of the surface is not unique).
    """
    es, ys = _dot(e, d), _dot(y, d)
    ee, ye = 1.0 - es * es, _dot(y, e) - ys * es
    t = -(ye / (a * a) + ys * es / (c * c)) / (ee / (a * a) + es * es / (c * c))
    t = _clamp(t, -l, l)
    low, high = -l, l
    low_known, high_known = False, False
    delta, n, foot = spheroid_foot(_along(y, t, e), d, a, c)
    for step in range(120):
        slope = _dot(n, e)
        if abs(slope) <= 2.0 * _EPS or l == 0.0:
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
        if abs(new - t) <= _EPS * (l + a + c):
            break
        t = new
        delta, n, foot = spheroid_foot(_along(y, t, e), d, a, c)
    return t, delta, n, foot


@jit
def _spheroid_rod(D, da, a, c, db, rb, lb, limit):
    """Return (gap, n, point) of spheroid a and spherocylinder b, the point relative to a."""
    _, delta, n, foot = spheroid_segment(D, db, lb, da, a, c)
    gap = delta - rb
    return gap, n, _along(foot, 0.5 * gap, n)


# ---- two spheroids -------------------------------------------------------------------------


@jit
def separation(n, D, da, a_a, c_a, db, a_b, c_b):
    """Return f(n) = n.D - h_a(n) - h_b(n): how far direction n keeps two spheroids apart."""
    return _dot(n, D) - _support(n, da, a_a, c_a)[0] - _support(n, db, a_b, c_b)[0]


@jit
def _support_hessian(n, d, a, c, h, t1, t2):
    """Hess h on the tangent plane (t1, t2) of n: (a^2/h) (1 - (a^2 - c^2)/h^2 dd')."""
    u1, u2 = _dot(d, t1), _dot(d, t2)
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
    G = _sub(_sub(D, p_a), p_b)
    f = _dot(n, D) - h_a - h_b
    t1 = _across(n)
    t2 = _cross(n, t1)
    xx, xy, yy = _support_hessian(n, da, a_a, c_a, h_a, t1, t2)
    bxx, bxy, byy = _support_hessian(n, db, a_b, c_b, h_b, t1, t2)
    xx, xy, yy = xx + bxx, xy + bxy, yy + byy
    half_trace = 0.5 * (xx + yy)
    # the smaller eigenvalue, as det over the larger: no cancellation at high aspect ratios
    smallest = (xx * yy - xy * xy) / (half_trace + np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy))
    shift = max(f, -0.9 * smallest)
    xx, yy = xx + shift, yy + shift
    g1, g2 = _dot(G, t1), _dot(G, t2)
    det = xx * yy - xy * xy
    x1, x2 = (yy * g1 - xy * g2) / det, (xx * g2 - xy * g1) / det
    g = _along(_scaled(g1, t1), g2, t2)
    return f, g, _along(_scaled(x1, t1), x2, t2)


@jit
def _ascend(n, D, da, a_a, c_a, db, a_b, c_b, size, limit):
    """Climb `separation` from n by Newton steps with backtracking; return (n, f).

    Stops as soon as f > limit: f(n) never exceeds the gap, so there is no contact.
    """
    last = np.inf
    f = -np.inf
    for _ in range(100):
        f, g, xi = newton_direction(n, D, da, a_a, c_a, db, a_b, c_b)
        slope = _norm(g)
        if f > limit or slope <= 2.0 * _EPS * size:
            break
        if slope <= 1e-10 * size and slope >= 0.5 * last:  # round-off
            break
        last = slope
        length = _norm(xi)
        alpha = min(1.0, 1.0 / length)
        gain = 1e-4 * _dot(g, xi)
        moved = False
        for _ in range(40):
            trial = _unit(_along(n, alpha, xi))
            value = separation(trial, D, da, a_a, c_a, db, a_b, c_b)
            if value >= f + alpha * gain - 8.0 * _EPS * size:
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
        n = _along(D, (a_a * a_a / (c_a * c_a) - 1.0) * _dot(D, da), da)
    elif k == 2:
        n = _along(D, (a_b * a_b / (c_b * c_b) - 1.0) * _dot(D, db), db)
    elif k == 3:
        n = da
    elif k == 4:
        n = db
    elif k == 5:
        n = _along(D, -_dot(D, da), da)
    elif k == 6:
        n = _along(D, -_dot(D, db), db)
    n = _unit(n)
    return _neg(n) if _dot(n, D) < 0.0 else n


@jit
def _spheroid_pair(D, da, a_a, c_a, db, a_b, c_b, limit):
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
            if value > f + 4.0 * _EPS * size:
                n, f = trial, value
    p_a = _support(n, da, a_a, c_a)[1]
    p_b = _support(n, db, a_b, c_b)[1]
    return f, n, _scaled(0.5, _sub(_along(p_a, 1.0, D), p_b))


# ---- pairs ---------------------------------------------------------------------------------


@jit
def pair_contacts(kind_a, xa, da, ra, la, kind_b, xb, db, rb, lb, limit, out):
    """Write the contacts of bodies a and b with gap <= limit; return (count, coincident).

    Spheres and spherocylinders: the closest points of the cores and, where the cores run side by
    side, the end of their overlap farther away; ordered along the axis of a. Anything with a
    spheroid: one contact. `coincident` is 1 where the bodies are so placed that any normal would
    do (e_z is then taken between cores).

    out : (2, 7) float64, rows (n from a to b, gap [m], point - xa [m]).
    """
    da, db = _vec(da), _vec(db)
    D = _sub(_vec(xb), _vec(xa))
    if kind_a != SPHEROID and kind_b != SPHEROID:
        la = la if kind_a == SPHEROCYLINDER else 0.0
        lb = lb if kind_b == SPHEROCYLINDER else 0.0
        return _rod_pair(D, da, ra, la, db, rb, lb, limit, out)
    coincident = 1 if _dot(D, D) == 0.0 else 0
    if kind_a == SPHEROID and kind_b == SPHEROID:
        gap, n, point = _spheroid_pair(D, da, ra, la, db, rb, lb, limit)
    elif kind_a == SPHEROID:
        lb = lb if kind_b == SPHEROCYLINDER else 0.0
        gap, n, point = _spheroid_rod(D, da, ra, la, db, rb, lb, limit)
    else:
        la = la if kind_a == SPHEROCYLINDER else 0.0
        gap, n, point = _spheroid_rod(_neg(D), db, rb, lb, da, ra, la, limit)
        n, point = _neg(n), _along(point, 1.0, D)
    if not gap <= limit:
        return 0, 0
    _put(out, 0, n, gap, point)
    return 1, coincident


# ---- points and walls ----------------------------------------------------------------------


@jit
def _on_rectangle(P, g):
    """Return (distance, n, clamped) from a point P to a rectangle, n towards the rectangle.

    `clamped`: the foot lies on an edge or a corner. A point in the plate counts as above it.
    """
    m, e1, e2 = _vec(g[3:6]), _vec(g[6:9]), _vec(g[9:12])
    X = _sub(P, _vec(g[0:3]))
    height = _dot(X, m)
    u1, u2 = _dot(X, e1) / _dot(e1, e1), _dot(X, e2) / _dot(e2, e2)
    if abs(u1) <= 1.0 and abs(u2) <= 1.0:
        return abs(height), (m if height < 0.0 else _neg(m)), False
    u1, u2 = _clamp(u1, -1.0, 1.0), _clamp(u2, -1.0, 1.0)
    v = _along(_along(_neg(X), u1, e1), u2, e2)
    distance = _norm(v)
    return distance, _unit(v), True


@jit
def _frustum_frame(g):
    """Return (length, slant, us, ur, cos, sin): the meridian segment of a frustum.

    (us, ur) is its unit direction from the base and (-sin, cos) its normal away from the axis
    (on a flat ring: along -axis), both as (s, rho).
    """
    L, rise = g[6], g[8] - g[7]
    slant = np.sqrt(L * L + rise * rise)
    if L == 0.0:
        return L, slant, 0.0, (1.0 if rise >= 0.0 else -1.0), 0.0, 1.0
    return L, slant, L / slant, rise / slant, L / slant, rise / slant


@jit
def _meridian(X, k):
    """Return (s, rho, radial) of X about the unit axis k through 0."""
    s = _dot(X, k)
    e = _along(X, -s, k)
    rho = _norm(e)
    return s, rho, (_scaled(1.0 / rho, e) if rho > 0.0 else _across(k))


@jit
def _on_frustum(P, g):
    """Return (distance, n, clamped, height) from a point P to a frustum, n towards it.

    Foot within the surface: the distance is signed, positive on the bodies' side, and n is the
    normal of that side even behind the surface. Foot on a rim (`clamped`): unsigned. `height` is
    the signed distance from the surface continued beyond its rims.
    """
    k, side = _vec(g[3:6]), g[9]
    _, slant, us, ur, cos, sin = _frustum_frame(g)
    s, rho, radial = _meridian(_sub(P, _vec(g[0:3])), k)
    away = _along(_scaled(side * cos, radial), -side * sin, k)
    height = -side * (cos * (rho - g[7]) - sin * s)
    f = us * s + ur * (rho - g[7])
    if 0.0 <= f <= slant and slant > 0.0:
        return height, away, False, height
    f = 0.0 if f < 0.0 else slant
    vs, vr = us * f - s, g[7] + ur * f - rho
    distance = np.sqrt(vs * vs + vr * vr)
    if distance == 0.0:
        return 0.0, away, True, height
    return distance, _along(_scaled(vr / distance, radial), vs / distance, k), True, height


@jit
def _behind(clamped, height, reach):
    """Whether a body whose centre stands so has the surface of a frustum behind it, untouched.

    Next to the surface a centre is behind when deeper than the body's own reach; beyond a rim,
    where a body may well pass to the other side, as soon as it is on the wrong side.
    """
    return height < (0.0 if clamped else -reach)


# ---- spherocylinder and wall ---------------------------------------------------------------


@jit
def _rod_plane(x, d, r, l, g, limit, out):  # noqa: E741
    """Both ends against a half space; at most two contacts."""
    m = _vec(g[3:6])
    middle, tilt = _dot(_sub(x, _vec(g[0:3])), m), l * _dot(d, m)
    count = 0
    nearer = -1.0 if tilt >= 0.0 else 1.0
    for end in (nearer, -nearer):
        gap = middle + end * tilt - r
        if gap <= limit:
            point = _along(_scaled(end * l, d), -(r + 0.5 * gap), m)
            if count == 1 and _norm(_sub(point, _vec(out[0, 4:7]))) <= _MERGE * r:
                break
            _put(out, count, _neg(m), gap, point)
            count += 1
    if count == 2:
        _sort_along(out, d)
    return count


@jit
def _rod_pierces(x, d, l, g):  # noqa: E741
    """Whether the core passes through the inside of a rectangle."""
    m, e1, e2 = _vec(g[3:6]), _vec(g[6:9]), _vec(g[9:12])
    X = _sub(x, _vec(g[0:3]))
    height, slope = _dot(X, m), _dot(d, m)
    if not abs(height) < l * abs(slope):
        return False
    Y = _along(X, -height / slope, d)
    return abs(_dot(Y, e1)) <= _dot(e1, e1) and abs(_dot(Y, e2)) <= _dot(e2, e2)


@jit
def _rod_rectangle_candidates(x, d, l, g):  # noqa: E741
    """Abscissas where a core may touch a plate: ends, nearest to each edge, beside each corner."""
    centre, e1, e2 = _vec(g[0:3]), _vec(g[6:9]), _vec(g[9:12])
    D = _sub(centre, x)
    l1, l2 = _norm(e1), _norm(e2)
    u1, u2 = _scaled(1.0 / l1, e1), _scaled(1.0 / l2, e2)
    return (
        -l,
        l,
        closest_segments(_along(D, 1.0, e2), d, l, u1, l1)[0],
        closest_segments(_along(D, -1.0, e2), d, l, u1, l1)[0],
        closest_segments(_along(D, 1.0, e1), d, l, u2, l2)[0],
        closest_segments(_along(D, -1.0, e1), d, l, u2, l2)[0],
        _clamp(_dot(_along(_along(D, 1.0, e1), 1.0, e2), d), -l, l),
        _clamp(_dot(_along(_along(D, 1.0, e1), -1.0, e2), d), -l, l),
        _clamp(_dot(_along(_along(D, -1.0, e1), 1.0, e2), d), -l, l),
        _clamp(_dot(_along(_along(D, -1.0, e1), -1.0, e2), d), -l, l),
    )


@jit
def _corner(k, g):
    """Return corner k - 6 of a rectangle, in the order of the candidates."""
    first, second = (1.0 if k < 8 else -1.0), (1.0 if k % 2 == 0 else -1.0)
    return _along(_along(_vec(g[0:3]), first, _vec(g[6:9])), second, _vec(g[9:12]))


@jit
def _rod_rectangle(x, d, r, l, g, limit, out):  # noqa: E741
    """Spherocylinder and thin plate: the nearest place, and the end of the stretch beside it.

    Every contact is that of a sphere of the rod with the plate, so none can be wrong; the second
    is the farthest of those where the overlap ends: an end of the rod above the face, the
    crossing of an edge, the place beside a corner. A rod that has pierced the plate is pushed
    back to the side of its centre by both ends.
    """
    m = _vec(g[3:6])
    if _rod_pierces(x, d, l, g):
        height = _dot(_sub(x, _vec(g[0:3])), m)
        side = -1.0 if height < 0.0 else 1.0
        count = 0
        for end in (-1.0, 1.0):
            gap = side * (height + end * l * _dot(d, m)) - r
            if gap <= limit:
                point = _along(_scaled(end * l, d), -side * (r + 0.5 * gap), m)
                _put(out, count, _scaled(-side, m), gap, point)
                count += 1
        return count
    candidates = _rod_rectangle_candidates(x, d, l, g)
    best, first = np.inf, 0.0
    for s in candidates:
        distance = _on_rectangle(_along(x, s, d), g)[0]
        if distance < best:
            best, first = distance, s
    if not best - r <= limit:
        return 0
    _rod_contact(_on_rectangle(_along(x, first, d), g)[1], best - r, first, d, r, out, 0)
    reach, second = 0.0, 0.0
    for k in range(10):
        s = candidates[k]
        distance, n, clamped = _on_rectangle(_along(x, s, d), g)
        if not distance - r <= limit or (k < 2 and clamped) or abs(s - first) <= reach:
            continue
        if k >= 6:
            q = _along(_along(x, s, d), distance, n)
            if not clamped or _norm(_sub(q, _corner(k, g))) > _MERGE * r:
                continue
        reach, second = abs(s - first), s
    if reach == 0.0:
        return 1
    distance, n, _ = _on_rectangle(_along(x, second, d), g)
    return _second_rod_contact(n, distance - r, second, d, r, out)


@jit
def _rod_contact(n, gap, s, d, r, out, row):
    """Write the contact of the sphere at abscissa s of a rod."""
    _put(out, row, n, gap, _along(_scaled(s, d), r + 0.5 * gap, n))


@jit
def _second_rod_contact(n, gap, s, d, r, out):
    """Write a second contact unless it is too near the first; return how many there are."""
    _rod_contact(n, gap, s, d, r, out, 1)
    if _norm(_sub(_vec(out[1, 4:7]), _vec(out[0, 4:7]))) <= _MERGE * r:
        return 1
    _sort_along(out, d)
    return 2


@jit
def _rim_slope(t, sx, ds, t1, v, w, rim_s, rim_r):
    """Return half of F' and of F'' of F(t), the squared distance from a line to a circle."""
    tau = v * (t - t1)
    rho = np.sqrt(w * w + tau * tau)
    slope = ds * (sx + t * ds - rim_s) + v * tau * (1.0 - rim_r / rho)
    return slope, 1.0 - rim_r * (v * w) ** 2 / rho**3


@jit
def _rim_root(low, high, sx, ds, t1, v, w, rim_s, rim_r):
    """Return the root of F' on [low, high], where it increases; nan if there is none."""
    if not low < high:
        return np.nan
    if _rim_slope(low, sx, ds, t1, v, w, rim_s, rim_r)[0] >= 0.0:
        return np.nan
    if _rim_slope(high, sx, ds, t1, v, w, rim_s, rim_r)[0] <= 0.0:
        return np.nan
    t = 0.5 * (low + high)
    for step in range(120):
        slope, curvature = _rim_slope(t, sx, ds, t1, v, w, rim_s, rim_r)
        if slope == 0.0:
            break
        if slope > 0.0:
            high = t
        else:
            low = t
        new = t - slope / curvature
        if not low < new < high or (step > 8 and step % 2 == 0):
            new = 0.5 * (low + high)
        if abs(new - t) <= _EPS * (abs(t) + rim_r):
            break
        t = new
    return t


@jit
def _rod_rim(X, d, l, k, rim_s, rim_r):  # noqa: E741
    """Return the (at most two) abscissas inside a core that are nearest to a rim; nan for none.

    On the line s = sx + t ds, rho^2 = w^2 + v^2 (t - t1)^2. F' = 0 cuts a straight line with a
    sigmoid: F' increases outside rho^3 = rim_r v^2 w^2 and decreases inside, so that each outer
    side holds at most one minimum.
    """
    sx, ds = _dot(X, k), _dot(d, k)
    ex, ed = _along(X, -sx, k), _along(d, -ds, k)
    v2 = _dot(ed, ed)
    v = np.sqrt(v2)
    if v <= _TIE:
        t = (rim_s - sx) * ds
        return (t if abs(t) < l else np.nan), np.nan
    t1 = -_dot(ex, ed) / v2
    w = max(_norm(_along(ex, t1, ed)), 1e-14 * (rim_r + l))  # keeps rho positive
    turn = np.cbrt(rim_r * (v * w) ** 2)
    if not turn > w:
        return _rim_root(-l, l, sx, ds, t1, v, w, rim_s, rim_r), np.nan
    half = np.sqrt((turn - w) * (turn + w)) / v
    return (
        _rim_root(-l, min(l, t1 - half), sx, ds, t1, v, w, rim_s, rim_r),
        _rim_root(max(-l, t1 + half), l, sx, ds, t1, v, w, rim_s, rim_r),
    )


@jit
def _rod_face(X, d, l, k, cos, sin):  # noqa: E741
    """Return the abscissa of a core nearest to the axis, in the metric of a cone; nan if an end.

    Minimises cos rho(t) - sin s(t), which is convex.
    """
    sx, ds = _dot(X, k), _dot(d, k)
    ex, ed = _along(X, -sx, k), _along(d, -ds, k)
    v2 = _dot(ed, ed)
    v = np.sqrt(v2)
    if v <= _TIE or not abs(sin * ds) < cos * v:
        return np.nan
    ratio = sin * ds / (cos * v)
    t1 = -_dot(ex, ed) / v2
    w = _norm(_along(ex, t1, ed))
    t = t1 + w * ratio / (np.sqrt((1.0 - ratio) * (1.0 + ratio)) * v)
    return t if abs(t) < l else np.nan


@jit
def _rod_on_frustum(x, d, s, g, behind):
    """`_on_frustum` for the point at abscissa s, without what lies behind a body out of reach."""
    distance, n, clamped, height = _on_frustum(_along(x, s, d), g)
    if behind and not clamped and height < 0.0:
        distance = np.inf
    return distance, n, clamped


@jit
def _rod_frustum(x, d, r, l, g, limit, behind, out):  # noqa: E741
    """Spherocylinder and frustum: ends, the waist on a convex face, and the rims.

    Inside, the surface is concave and the ends are extreme on it. As with a plate every contact
    is that of a sphere of the rod.
    """
    X, k = _sub(x, _vec(g[0:3])), _vec(g[3:6])
    L, _, _, _, cos, sin = _frustum_frame(g)
    waist = _rod_face(X, d, l, k, cos, sin) if g[9] < 0.0 and L > 0.0 else np.nan
    base1, base2 = _rod_rim(X, d, l, k, 0.0, g[7])
    top1, top2 = _rod_rim(X, d, l, k, L, g[8])
    candidates = (-l, l, waist, base1, base2, top1, top2)
    best, first = np.inf, 0.0
    for s in candidates:
        if np.isnan(s):
            continue
        distance = _rod_on_frustum(x, d, s, g, behind)[0]
        if distance < best:
            best, first = distance, s
    if not best - r <= limit:
        return 0
    _rod_contact(_rod_on_frustum(x, d, first, g, behind)[1], best - r, first, d, r, out, 0)
    reach, second = 0.0, 0.0
    for i in range(7):
        s = candidates[i]
        if np.isnan(s) or abs(s - first) <= reach:
            continue
        distance, _, clamped = _rod_on_frustum(x, d, s, g, behind)
        if distance - r <= limit and not (i < 2 and clamped):
            reach, second = abs(s - first), s
    if reach == 0.0:
        return 1
    distance, n, _ = _rod_on_frustum(x, d, second, g, behind)
    return _second_rod_contact(n, distance - r, second, d, r, out)


# ---- spheroid and wall ---------------------------------------------------------------------


@jit
def _spheroid_plane(X, d, a, c, m):
    """Return (gap, point) of a spheroid at X and the half space below m.x = 0."""
    h, p = _support(m, d, a, c)
    gap = _dot(X, m) - h
    return gap, _along(_neg(p), -0.5 * gap, m)


@jit
def _spheroid_rectangle(x, d, a, c, g, limit, out):
    """The face where the lowest point stands above it, else the nearest of the four edges.

    The signed distance to the spheroid is convex over the plate: its minimum is the lowest
    point's foot if that is inside, and on the boundary otherwise.
    """
    m, e1, e2 = _vec(g[3:6]), _vec(g[6:9]), _vec(g[9:12])
    X = _sub(x, _vec(g[0:3]))
    if _dot(X, m) < 0.0:
        m = _neg(m)
    gap, point = _spheroid_plane(X, d, a, c, m)
    foot = _along(X, 1.0, point)
    n = _neg(m)
    if abs(_dot(foot, e1)) > _dot(e1, e1) or abs(_dot(foot, e2)) > _dot(e2, e2):
        gap = np.inf
        l1, l2 = _norm(e1), _norm(e2)
        u1, u2 = _scaled(1.0 / l1, e1), _scaled(1.0 / l2, e2)
        for k in range(4):
            sign = 1.0 if k % 2 == 0 else -1.0
            if k < 2:
                Y = _sub(_scaled(sign, e2), X)
                _, delta, normal, surface = spheroid_segment(Y, u1, l1, d, a, c)
            else:
                Y = _sub(_scaled(sign, e1), X)
                _, delta, normal, surface = spheroid_segment(Y, u2, l2, d, a, c)
            if delta < gap:
                gap, n, point = delta, normal, _along(surface, 0.5 * delta, normal)
    if not gap <= limit:
        return 0
    _put(out, 0, n, gap, point)
    return 1


@jit
def _face_slope(phi, X, d, a, c, k, e1, e2, cos, sin, side):
    """Return (psi, psi', psi'') of psi(phi) = n.X + side h(n), n(phi) the cone's outward normal.

    The gap is side (cos r0 - psi): from inside the least over phi of what separates the body from
    the tangent planes, from outside the largest.
    """
    radial = _along(_scaled(np.cos(phi), e1), np.sin(phi), e2)
    turned = _along(_scaled(-np.sin(phi), e1), np.cos(phi), e2)
    n = _along(_scaled(cos, radial), -sin, k)
    h, p = _support(n, d, a, c)
    Y = _along(X, side, p)
    k2 = (a - c) * (a + c) / (h * h)
    bend = cos * cos * a * a / h * (1.0 - k2 * _dot(d, turned) ** 2)
    return (
        _dot(n, X) + side * h,
        cos * _dot(turned, Y),
        side * bend - cos * _dot(radial, Y),
    )


@jit
def _rim_delta(phi, X, d, a, c, k, e1, e2, rim_s, rim_r):
    """Return (delta, delta', delta'') along a rim, the distance from a spheroid at X, negated.

    Negated, so that maxima are sought here too.
    """
    radial = _along(_scaled(np.cos(phi), e1), np.sin(phi), e2)
    turned = _along(_scaled(-rim_r * np.sin(phi), e1), rim_r * np.cos(phi), e2)
    q = _sub(_along(_scaled(rim_s, k), rim_r, radial), X)
    delta, n, _ = spheroid_foot(q, d, a, c)
    bend = _distance_curvature(n, delta, d, a, c, turned) - rim_r * _dot(n, radial)
    return -delta, -_dot(n, turned), -bend


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
        if abs(new - phi) <= 4.0 * _EPS:
            break
        phi = new
    return phi


@jit
def _peaks(rim, window, X, d, a, c, k, e1, e2, p, q, side, peak):
    """Fill `peak` with azimuths of local maxima within +-window of e1; return how many.

    One is found in each arc over which the slope turns from rising to falling. A function that is
    constant (a body on the axis) is given two opposite azimuths.
    """
    count = 0
    tolerance = 1e-13 * (q if rim else p * (a + c + _norm(X)))
    steepest = 0.0
    previous = 0.0
    for i in range(_ARCS + 1):
        phi = window * (2.0 * i / _ARCS - 1.0)
        if rim:
            slope = _rim_delta(phi, X, d, a, c, k, e1, e2, p, q)[1]
        else:
            slope = _face_slope(phi, X, d, a, c, k, e1, e2, p, q, side)[1]
        steepest = max(steepest, abs(slope))
        if i > 0 and previous > 0.0 and slope <= 0.0 and count < peak.shape[0]:
            low = window * (2.0 * (i - 1) / _ARCS - 1.0)
            peak[count] = _climb(rim, low, phi, X, d, a, c, k, e1, e2, p, q, side)
            count += 1
        previous = slope
    if steepest <= tolerance:
        peak[0], peak[1] = 0.0, np.pi
        count = 2
    return count


@jit
def _spheroid_face(X, d, a, c, g, k, e1, e2, limit, peak, found, count):
    """Append the contacts with the surface of a frustum between its rims; return their number."""
    L, slant, us, ur, cos, sin = _frustum_frame(g)
    side, r0 = g[9], g[7]
    if L == 0.0:
        m = _scaled(side, k)
        gap, point = _spheroid_plane(X, d, a, c, m)
        f = ur * (_meridian(_along(X, 1.0, point), k)[1] - r0)
        if gap <= limit and 0.0 <= f <= slant:
            _put(found, count, _neg(m), gap, point)
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
        radial = _along(_scaled(np.cos(peak[i]), e1), np.sin(peak[i]), e2)
        n = _along(_scaled(side * cos, radial), -side * sin, k)
        surface = _support(n, d, a, c)[1]
        Y = _along(X, 1.0, surface)
        f = us * _dot(Y, k) + ur * (_dot(Y, radial) - r0)
        if 0.0 <= f <= slant:
            _put(found, count, n, gap, _along(surface, 0.5 * gap, n))
            count += 1
        if side < 0.0:
            break
    return count


@jit
def _spheroid_rim(top, X, d, a, c, g, k, e1, e2, limit, peak, found, count):
    """Append the contacts with one rim of a frustum; return their number.

    A rim ends the surface: it is touched from the outside of the meridian segment only, the
    inside belongs to the face.
    """
    L, _, us, ur, _, _ = _frustum_frame(g)
    rim_s, rim_r = (L, g[8]) if top else (0.0, g[7])
    s, rho, _ = _meridian(X, k)
    reach = max(a, c) + max(limit, 0.0)
    if (s - rim_s) ** 2 + (rho - rim_r) ** 2 > reach * reach:
        return count
    window, peaks = np.pi, 1
    if rim_r > 0.0:
        if rho > 0.0:
            cosine = ((s - rim_s) ** 2 + rho * rho + rim_r * rim_r - reach * reach) / (
                2.0 * rho * rim_r
            )
            window = np.arccos(_clamp(cosine, -1.0, 1.0))
        peaks = _peaks(True, window, X, d, a, c, k, e1, e2, rim_s, rim_r, 1.0, peak)
    else:
        peak[0] = 0.0
    outward = 1.0 if top else -1.0
    for i in range(peaks):
        radial = _along(_scaled(np.cos(peak[i]), e1), np.sin(peak[i]), e2)
        q = _sub(_along(_scaled(rim_s, k), rim_r, radial), X)
        delta, n, surface = spheroid_foot(q, d, a, c)
        inward = outward * (us * _dot(n, k) + ur * _dot(n, radial))
        if delta <= limit and inward <= 1e-9:
            _put(found, count, n, delta, _along(surface, 0.5 * delta, n))
            count += 1
    return count


@jit
def _spheroid_frustum(x, d, a, c, g, limit, behind, out):
    """Spheroid and frustum: the deepest contact and the one farthest from it."""
    X, k = _sub(x, _vec(g[0:3])), _vec(g[3:6])
    _, rho, e1 = _meridian(X, k)
    if rho <= _EPS * max(a, c):  # on the axis: start from the body's own axis
        side_d = _along(d, -_dot(d, k), k)
        e1 = _unit(side_d) if _norm(side_d) > 1e-8 else _across(k)
    e2 = _cross(k, e1)
    found = np.empty((3 * _ARCS, 7))
    peak = np.empty(_ARCS)
    count = 0
    if not behind:
        count = _spheroid_face(X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    count = _spheroid_rim(False, X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    count = _spheroid_rim(True, X, d, a, c, g, k, e1, e2, limit, peak, found, count)
    if count == 0:
        return 0
    first = 0
    for i in range(1, count):
        if found[i, 3] < found[first, 3]:
            first = i
    out[0] = found[first]
    reach, second = _MERGE * min(a, c), -1
    for i in range(count):
        distance = _norm(_sub(_vec(found[i, 4:7]), _vec(found[first, 4:7])))
        if distance > reach:
            reach, second = distance, i
    if second < 0:
        return 1
    out[1] = found[second]
    _sort_along(out, d)
    return 2


# ---- walls ---------------------------------------------------------------------------------


@jit
def wall_contacts(wall_kind, g, kind, x, d, r, l, limit, out):  # noqa: E741
    """Write the contacts of a body and a wall with gap <= limit; return how many (at most two).

    out : (2, 7) float64, rows (n from the body into the wall, gap [m], point - x [m]), two of
    them ordered along the axis of the body.
    """
    x, d = _vec(x), _vec(d)
    half = l if kind == SPHEROCYLINDER else 0.0
    if wall_kind == PLANE:
        if kind != SPHEROID:
            return _rod_plane(x, d, r, half, g, limit, out)
        m = _vec(g[3:6])
        gap, point = _spheroid_plane(_sub(x, _vec(g[0:3])), d, r, l, m)
        if not gap <= limit:
            return 0
        _put(out, 0, _neg(m), gap, point)
        return 1
    reach = bounding_radius(kind, r, l)
    if wall_kind == RECTANGLE:
        distance, n, clamped = _on_rectangle(x, g)
        height = distance
    else:
        distance, n, clamped, height = _on_frustum(x, g)
    if distance - reach > limit or distance < -reach:
        return 0
    if half == 0.0 and kind != SPHEROID:
        _rod_contact(n, distance - r, 0.0, d, r, out, 0)
        return 1
    behind = _behind(clamped, height, reach)
    if wall_kind == RECTANGLE:
        if kind == SPHEROID:
            return _spheroid_rectangle(x, d, r, l, g, limit, out)
        return _rod_rectangle(x, d, r, half, g, limit, out)
    if kind == SPHEROID:
        return _spheroid_frustum(x, d, r, l, g, limit, behind, out)
    return _rod_frustum(x, d, r, half, g, limit, behind, out)
