"""Contacts of spherocylinders, spheres among them, with each other and with walls.

Every contact is that of two spheres on the cores, or of one with the wall; which spheres, is the
question answered here. Rows of contacts and of walls as in `_kernels_shapes`.

Symbols: D = x_b - x_a; d unit axis, l half length of a core, r radius; s, t abscissas on the
cores of a and b (on walls s is the abscissa on the core, except in meridian coordinates (s, rho)).
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi._kernels_vectors import (
    EPS,
    MERGE,
    TIE,
    along,
    clamp,
    cross,
    dot,
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
    on_frustum,
    on_rectangle,
)

_GENERIC = (0.6030226891555273, 0.5222329678670935, 0.6030226891555273)  # decides ties


# ---- two cores -----------------------------------------------------------------------------


@jit
def _segment_distance(D, da, s, db, t):
    """Return the vector from abscissa s of core a to abscissa t of core b, and its length."""
    v = along(along(D, t, db), -s, da)
    return v, norm(v)


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
        t = clamp(s * dot(da, db) - dot(D, db), -lb, lb)
        distance = _segment_distance(D, da, s, db, t)[1]
        if distance < best:
            best_s, best_t, best = s, t, distance
    for end in (-1.0, 1.0):
        t = end * lb
        s = clamp(t * dot(da, db) + dot(D, da), -la, la)
        distance = _segment_distance(D, da, s, db, t)[1]
        if distance < best:
            best_s, best_t, best = s, t, distance
    c = cross(da, db)
    c2 = dot(c, c)
    if c2 > 0.0:
        s = dot(cross(D, db), c) / c2
        t = dot(cross(D, da), c) / c2
        distance = abs(dot(D, c)) / np.sqrt(c2)
        if abs(s) < la and abs(t) < lb and distance < best - 0.1 * TIE * (la + lb):
            return s, t, distance, True
    return best_s, best_t, best, False


@jit
def _core_normal(D, v, distance, da, la, db, lb, crossing):
    """Return the unit normal from core a to core b, and whether it had to be invented.

    Where the cores touch or cross it is the common perpendicular, on the side of b's centre;
    of collinear ones e_z.
    """
    if distance > EPS * (la + lb) and not crossing:
        return (v[0] / distance, v[1] / distance, v[2] / distance), 0
    c = cross(da, db)
    if la > 0.0 and lb > 0.0 and dot(c, c) > 0.0:
        n = unit(c)
        return (neg(n) if dot(n, D) < 0.0 else n), 0
    return (0.0, 0.0, 1.0), 1


@jit
def _overlap_end(D, da, la, db, lb, reference):
    """Return (found, s, t) at the end of the overlap of two segments farther from `reference`.

    The overlap is taken along the bisector m of the axes, which favours neither; an end of it is
    an end of one segment, beside the closest point of the other. Ties go to the smaller
    distance, then to a fixed direction of space, never to the order of a and b.
    """
    sign = 1.0 if dot(da, db) >= 0.0 else -1.0
    m = unit(along(da, sign, db))
    centre = dot(D, m)
    half_a, half_b = la * abs(dot(da, m)), lb * abs(dot(db, m))
    low, high = max(-half_a, centre - half_b), min(half_a, centre + half_b)
    best_s, best_t, best_reach, best_distance, best_rank = 0.0, 0.0, -1.0, np.inf, -np.inf
    if not low <= high:
        return False, best_s, best_t
    tie = TIE * (la + lb)
    for k in range(4):
        end = -1.0 if k % 2 == 0 else 1.0
        bound = low if end < 0.0 else high
        if k < 2:
            if abs(end * half_a - bound) > tie:
                continue
            s = end * la if dot(da, m) >= 0.0 else -end * la
            t = clamp(s * dot(da, db) - dot(D, db), -lb, lb)
        else:
            if abs(centre + end * half_b - bound) > tie:
                continue
            t = end * lb if dot(db, m) >= 0.0 else -end * lb
            s = clamp(t * dot(da, db) + dot(D, da), -la, la)
        v, distance = _segment_distance(D, da, s, db, t)
        middle = along(scaled(s, da), 0.5, v)
        reach = norm(sub(middle, reference))
        rank = dot(along(middle, -0.5, D), _GENERIC)
        better = reach > best_reach + tie
        if abs(reach - best_reach) <= tie:
            better = distance < best_distance - tie
            if abs(distance - best_distance) <= tie:
                better = rank > best_rank
        if better:
            best_s, best_t, best_reach, best_distance, best_rank = s, t, reach, distance, rank
    return best_reach >= 0.0, best_s, best_t


@jit
def rod_pair(D, da, ra, la, db, rb, lb, limit, out):
    """Contacts of two spherocylinders, spheres among them; see `pair_contacts`."""
    s, t, distance, crossing = closest_segments(D, da, la, db, lb)
    gap = distance - (ra + rb)
    if not gap <= limit:
        return 0, 0
    v, _ = _segment_distance(D, da, s, db, t)
    n, coincident = _core_normal(D, v, distance, da, la, db, lb, crossing)
    first = along(scaled(s, da), ra + 0.5 * gap, n)
    put(out, 0, n, gap, first)
    if la == 0.0 or lb == 0.0:
        return 1, coincident
    # The reference is the middle between the cores: unlike the contact it does not depend on n.
    found, s, t = _overlap_end(D, da, la, db, lb, along(scaled(s, da), 0.5, v))
    if not found:
        return 1, coincident
    v, distance = _segment_distance(D, da, s, db, t)
    gap = distance - (ra + rb)
    if distance > EPS * (la + lb):
        n = (v[0] / distance, v[1] / distance, v[2] / distance)
    second = along(scaled(s, da), ra + 0.5 * gap, n)
    if not gap <= limit or norm(sub(second, first)) <= MERGE * min(ra, rb):
        return 1, coincident
    put(out, 1, n, gap, second)
    sort_along(out, da)
    return 2, coincident


# ---- walls ---------------------------------------------------------------------------------


@jit
def rod_plane(x, d, r, l, g, limit, out):  # noqa: E741
    """Both ends against a half space; at most two contacts."""
    m = vec(g[3:6])
    middle, tilt = dot(sub(x, vec(g[0:3])), m), l * dot(d, m)
    count = 0
    nearer = -1.0 if tilt >= 0.0 else 1.0
    for end in (nearer, -nearer):
        gap = middle + end * tilt - r
        if gap <= limit:
            point = along(scaled(end * l, d), -(r + 0.5 * gap), m)
            if count == 1 and norm(sub(point, vec(out[0, 4:7]))) <= MERGE * r:
                break
            put(out, count, neg(m), gap, point)
            count += 1
    if count == 2:
        sort_along(out, d)
    return count


@jit
def _rod_pierces(x, d, l, g):  # noqa: E741
    """Whether the core passes through the inside of a rectangle."""
    m, e1, e2 = vec(g[3:6]), vec(g[6:9]), vec(g[9:12])
    X = sub(x, vec(g[0:3]))
    height, slope = dot(X, m), dot(d, m)
    if not abs(height) < l * abs(slope):
        return False
    Y = along(X, -height / slope, d)
    return abs(dot(Y, e1)) <= dot(e1, e1) and abs(dot(Y, e2)) <= dot(e2, e2)


@jit
def _rod_rectangle_candidates(x, d, l, g):  # noqa: E741
    """Abscissas where a core may touch a plate: ends, nearest to each edge, beside each corner."""
    centre, e1, e2 = vec(g[0:3]), vec(g[6:9]), vec(g[9:12])
    D = sub(centre, x)
    l1, l2 = norm(e1), norm(e2)
    u1, u2 = scaled(1.0 / l1, e1), scaled(1.0 / l2, e2)
    return (
        -l,
        l,
        closest_segments(along(D, 1.0, e2), d, l, u1, l1)[0],
        closest_segments(along(D, -1.0, e2), d, l, u1, l1)[0],
        closest_segments(along(D, 1.0, e1), d, l, u2, l2)[0],
        closest_segments(along(D, -1.0, e1), d, l, u2, l2)[0],
        clamp(dot(along(along(D, 1.0, e1), 1.0, e2), d), -l, l),
        clamp(dot(along(along(D, 1.0, e1), -1.0, e2), d), -l, l),
        clamp(dot(along(along(D, -1.0, e1), 1.0, e2), d), -l, l),
        clamp(dot(along(along(D, -1.0, e1), -1.0, e2), d), -l, l),
    )


@jit
def _corner(k, g):
    """Return corner k - 6 of a rectangle, in the order of the candidates."""
    first, second = (1.0 if k < 8 else -1.0), (1.0 if k % 2 == 0 else -1.0)
    return along(along(vec(g[0:3]), first, vec(g[6:9])), second, vec(g[9:12]))


@jit
def rod_rectangle(x, d, r, l, g, limit, out):  # noqa: E741
    """Spherocylinder and thin plate: the nearest place, and the end of the stretch beside it.

    Every contact is that of a sphere of the rod with the plate, so none can be wrong; the second
    is the farthest of those where the overlap ends: an end of the rod above the face, the
    crossing of an edge, the place beside a corner. A rod that has pierced the plate is pushed
    back to the side of its centre by both ends.
    """
    m = vec(g[3:6])
    if _rod_pierces(x, d, l, g):
        height = dot(sub(x, vec(g[0:3])), m)
        side = -1.0 if height < 0.0 else 1.0
        count = 0
        for end in (-1.0, 1.0):
            gap = side * (height + end * l * dot(d, m)) - r
            if gap <= limit:
                point = along(scaled(end * l, d), -side * (r + 0.5 * gap), m)
                put(out, count, scaled(-side, m), gap, point)
                count += 1
        return count
    candidates = _rod_rectangle_candidates(x, d, l, g)
    best, first = np.inf, 0.0
    for s in candidates:
        distance = on_rectangle(along(x, s, d), g)[0]
        if distance < best:
            best, first = distance, s
    if not best - r <= limit:
        return 0
    rod_contact(on_rectangle(along(x, first, d), g)[1], best - r, first, d, r, out, 0)
    reach, second = 0.0, 0.0
    for k in range(10):
        s = candidates[k]
        distance, n, clamped = on_rectangle(along(x, s, d), g)
        if not distance - r <= limit or (k < 2 and clamped) or abs(s - first) <= reach:
            continue
        if k >= 6:
            q = along(along(x, s, d), distance, n)
            if not clamped or norm(sub(q, _corner(k, g))) > MERGE * r:
                continue
        reach, second = abs(s - first), s
    if reach == 0.0:
        return 1
    distance, n, _ = on_rectangle(along(x, second, d), g)
    return _second_rod_contact(n, distance - r, second, d, r, out)


@jit
def rod_contact(n, gap, s, d, r, out, row):
    """Write the contact of the sphere at abscissa s of a rod."""
    put(out, row, n, gap, along(scaled(s, d), r + 0.5 * gap, n))


@jit
def _second_rod_contact(n, gap, s, d, r, out):
    """Write a second contact unless it is too near the first; return how many there are."""
    rod_contact(n, gap, s, d, r, out, 1)
    if norm(sub(vec(out[1, 4:7]), vec(out[0, 4:7]))) <= MERGE * r:
        return 1
    sort_along(out, d)
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
        if abs(new - t) <= EPS * (abs(t) + rim_r):
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
    sx, ds = dot(X, k), dot(d, k)
    ex, ed = along(X, -sx, k), along(d, -ds, k)
    v2 = dot(ed, ed)
    v = np.sqrt(v2)
    if v <= TIE:
        t = (rim_s - sx) * ds
        return (t if abs(t) < l else np.nan), np.nan
    t1 = -dot(ex, ed) / v2
    w = max(norm(along(ex, t1, ed)), 1e-14 * (rim_r + l))  # keeps rho positive
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
    sx, ds = dot(X, k), dot(d, k)
    ex, ed = along(X, -sx, k), along(d, -ds, k)
    v2 = dot(ed, ed)
    v = np.sqrt(v2)
    if v <= TIE or not abs(sin * ds) < cos * v:
        return np.nan
    ratio = sin * ds / (cos * v)
    t1 = -dot(ex, ed) / v2
    w = norm(along(ex, t1, ed))
    t = t1 + w * ratio / (np.sqrt((1.0 - ratio) * (1.0 + ratio)) * v)
    return t if abs(t) < l else np.nan


@jit
def _rod_on_frustum(x, d, s, g, hidden):
    """`on_frustum` for the point at abscissa s, without what is hidden behind the surface."""
    distance, n, clamped, height = on_frustum(along(x, s, d), g)
    if hidden and not clamped and height < 0.0:
        distance = np.inf
    return distance, n, clamped


@jit
def rod_frustum(x, d, r, l, g, limit, hidden, out):  # noqa: E741
    """Spherocylinder and frustum: ends, the waist on a convex face, and the rims.

    Inside, the surface is concave and the ends are extreme on it. As with a plate every contact
    is that of a sphere of the rod.
    """
    X, k = sub(x, vec(g[0:3])), vec(g[3:6])
    L, _, _, _, cos, sin = frustum_frame(g)
    crosses, pierces = crossings(along(x, -l, d), along(x, l, d), g, 0.0)
    if crosses:  # what reached the back round a rim has not gone through the surface
        hidden = not pierces
    waist = _rod_face(X, d, l, k, cos, sin) if g[9] < 0.0 and L > 0.0 else np.nan
    base1, base2 = _rod_rim(X, d, l, k, 0.0, g[7])
    top1, top2 = _rod_rim(X, d, l, k, L, g[8])
    candidates = (-l, l, waist, base1, base2, top1, top2)
    best, first = np.inf, 0.0
    for s in candidates:
        if np.isnan(s):
            continue
        distance = _rod_on_frustum(x, d, s, g, hidden)[0]
        if distance < best:
            best, first = distance, s
    if not best - r <= limit:
        return 0
    rod_contact(_rod_on_frustum(x, d, first, g, hidden)[1], best - r, first, d, r, out, 0)
    reach, second = 0.0, 0.0
    for i in range(7):
        s = candidates[i]
        if np.isnan(s) or abs(s - first) <= reach:
            continue
        distance, _, clamped = _rod_on_frustum(x, d, s, g, hidden)
        if distance - r <= limit and not (i < 2 and clamped):
            reach, second = abs(s - first), s
    if reach == 0.0:
        return 1
    distance, n, _ = _rod_on_frustum(x, d, second, g, hidden)
    return _second_rod_contact(n, distance - r, second, d, r, out)
