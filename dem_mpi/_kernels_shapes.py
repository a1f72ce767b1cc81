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
               at the other end, side g[9]: +1 bodies towards the axis (on a flat ring, length 0
               and g[7] < g[8]: towards +axis), -1 on the other side

A contact is a row (n, gap, point): unit normal n from a to b (from the body into the wall), gap
negative where they overlap, and the point in the middle of the gap relative to the centre of a.
Both arms must end in one point, or a tangential impulse would leave a torque.
"""

from __future__ import annotations

from dem_mpi._jit import jit
from dem_mpi._kernels_rods import (
    rod_contact,
    rod_frustum,
    rod_pair,
    rod_plane,
    rod_rectangle,
)
from dem_mpi._kernels_spheroids import (
    spheroid_frustum,
    spheroid_pair,
    spheroid_plane,
    spheroid_rectangle,
    spheroid_rod,
)
from dem_mpi._kernels_vectors import (
    along,
    dot,
    neg,
    put,
    sub,
    vec,
)
from dem_mpi._kernels_wall_points import (
    behind,
    on_far_side,
    on_frustum,
    on_rectangle,
)
from dem_mpi.wall_kinds import PLANE, RECTANGLE

SPHERE, SPHEROCYLINDER, SPHEROID = 0, 1, 2


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
    da, db = vec(da), vec(db)
    D = sub(vec(xb), vec(xa))
    if kind_a != SPHEROID and kind_b != SPHEROID:
        la = la if kind_a == SPHEROCYLINDER else 0.0
        lb = lb if kind_b == SPHEROCYLINDER else 0.0
        return rod_pair(D, da, ra, la, db, rb, lb, limit, out)
    coincident = 1 if dot(D, D) == 0.0 else 0
    if kind_a == SPHEROID and kind_b == SPHEROID:
        gap, n, point = spheroid_pair(D, da, ra, la, db, rb, lb, limit)
    elif kind_a == SPHEROID:
        lb = lb if kind_b == SPHEROCYLINDER else 0.0
        gap, n, point = spheroid_rod(D, da, ra, la, db, rb, lb, limit)
    else:
        la = la if kind_a == SPHEROCYLINDER else 0.0
        gap, n, point = spheroid_rod(neg(D), db, rb, lb, da, ra, la, limit)
        n, point = neg(n), along(point, 1.0, D)
    if not gap <= limit:
        return 0, 0
    put(out, 0, n, gap, point)
    return 1, coincident


# ---- walls ---------------------------------------------------------------------------------


@jit
def wall_contacts(wall_kind, g, kind, x, d, r, l, limit, out):  # noqa: E741
    """Write the contacts of a body and a wall with gap <= limit; return how many (at most two).

    out : (2, 7) float64, rows (n from the body into the wall, gap [m], point - x [m]), two of
    them ordered along the axis of the body; of a sphere the nearer first.
    """
    x, d = vec(x), vec(d)
    half = l if kind == SPHEROCYLINDER else 0.0
    if wall_kind == PLANE:
        if kind != SPHEROID:
            return rod_plane(x, d, r, half, g, limit, out)
        m = vec(g[3:6])
        gap, point = spheroid_plane(sub(x, vec(g[0:3])), d, r, l, m)
        if not gap <= limit:
            return 0
        put(out, 0, neg(m), gap, point)
        return 1
    reach = bounding_radius(kind, r, l)
    if wall_kind == RECTANGLE:
        distance, n, clamped = on_rectangle(x, g)
        height = distance
    else:
        distance, n, clamped, height = on_frustum(x, g)
    if distance - reach > limit or distance < -reach:
        return 0
    if half == 0.0 and kind != SPHEROID:
        rod_contact(n, distance - r, 0.0, d, r, out, 0)
        if wall_kind == RECTANGLE:
            return 1
        distance, n = on_far_side(x, g)
        if distance < -r or not distance - r <= limit:
            return 1
        rod_contact(n, distance - r, 0.0, d, r, out, 1)
        return 2
    hidden = behind(clamped, height, smallest_size(kind, r, l))
    if wall_kind == RECTANGLE:
        if kind == SPHEROID:
            return spheroid_rectangle(x, d, r, l, g, limit, out)
        return rod_rectangle(x, d, r, half, g, limit, out)
    if kind == SPHEROID:
        return spheroid_frustum(x, d, r, l, g, limit, hidden, out)
    return rod_frustum(x, d, r, half, g, limit, hidden, out)
