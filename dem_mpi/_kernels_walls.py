"""Narrow phase of spheres and walls: where a sphere touches one surface, scalars in and out.

A face is a row of `Walls.rows`: geometry, then motion. Every surface answers with the gap and
the unit normal n into the wall of up to two places; a gap of infinity stands for none. A plane
holds one half space. A rectangle is a plate without thickness, touched from both sides by the
closest point. On a frustum the foot within the surface has a signed distance, positive on the
bodies' side, and one that lies deeper than the radius on the other side is not touched; a rim is a
circle, touched from everywhere. A sphere in a snug tube, in a tapering cone or in a hole is held on
two sides: the second place is on the opposite meridian.

Most bodies are far from most walls: `may_touch` is small enough to be inlined into their loop, and
what it lets through is measured by `touches`.

Symbols: f rows of faces, k one of them; x, y, z position; r radius; phi gap; n normal; u velocity
of the wall where it is touched; h time step; c relative margin; rolling = |w| r; (s, rho) meridian
coordinates along and across the axis of a frustum.
"""

from __future__ import annotations

import numpy as np

from dem_mpi._jit import jit
from dem_mpi.wall_kinds import CENTRE as _C
from dem_mpi.wall_kinds import FRUSTUM, PLANE, RECTANGLE
from dem_mpi.wall_kinds import KIND as _KIND
from dem_mpi.wall_kinds import SPIN as _W
from dem_mpi.wall_kinds import VELOCITY as _V

_ON_AXIS = 1e-12  # of the radius: closer to the axis than this, no meridian is the nearest


@jit
def norm(x, y, z):
    """Return the length of (x, y, z)."""
    return np.sqrt(x * x + y * y + z * z)


# ---- is a wall near ------------------------------------------------------------------------


@jit
def turns(f, k):
    """Whether face k turns in this step."""
    return f[k, _W] != 0.0 or f[k, _W + 1] != 0.0 or f[k, _W + 2] != 0.0


@jit
def _margin(speed, rolling, mu, r, h, c):
    """max(c r, h (speed (1 + mu) + |w| r))."""
    return max(c * r, h * (speed * (1.0 + mu) + rolling))


@jit
def largest_margin(f, k, x, y, z, vx, vy, vz, r, rolling, mu, h, c):
    """Return the margin of a sphere and face k; on one that turns, a bound of it.

    There |u| <= |V| + |W| (|x - C| + r + phi/2), so phi <= A + B phi/2 for all within the margin.
    """
    speed = norm(vx - f[k, _V], vy - f[k, _V + 1], vz - f[k, _V + 2])
    if not turns(f, k):
        return _margin(speed, rolling, mu, r, h, c)
    rate = norm(f[k, _W], f[k, _W + 1], f[k, _W + 2])
    arm = norm(x - f[k, _C], y - f[k, _C + 1], z - f[k, _C + 2]) + r
    growth = 0.5 * h * rate * (1.0 + mu)
    if growth >= 0.5:
        return np.inf
    # 1e-9: the sum in `_turning_margin` may be rounded the other way.
    bound = _margin(speed + rate * arm, rolling, mu, r, h, c) / (1.0 - growth)
    return bound * (1.0 + 1e-9)


@jit
def plane_gap(f, k, x, y, z, r):
    """Return the gap between a sphere and plane k whose normal points to the bodies."""
    return ((x - f[k, 0]) * f[k, 3] + (y - f[k, 1]) * f[k, 4] + (z - f[k, 2]) * f[k, 5]) - r


@jit
def may_touch(f, k, x, y, z, r, limit):
    """Whether the gap to face k may be up to `limit` [m]: exact for planes, else a cheap bound."""
    height = plane_gap(f, k, x, y, z, 0.0)
    reach = r + limit
    kind = f[k, _KIND]
    if kind == PLANE:
        return height - r <= limit
    if kind == RECTANGLE:
        return abs(height) <= reach
    if kind != FRUSTUM or height < -reach or height > f[k, 6] + reach:
        return False
    # For a frustum the height is that along its axis, and the mantle is beyond the line through it.
    dx, dy, dz = x - f[k, 0], y - f[k, 1], z - f[k, 2]
    rho = np.sqrt(max(0.0, dx * dx + dy * dy + dz * dz - height * height))
    base, rise, widest = f[k, 7], f[k, 8] - f[k, 7], max(f[k, 7], f[k, 8])
    # A difference of squares knows rho to the root of their rounding: the exact test decides.
    reach += 1e-7 * (widest + abs(height))
    if rho > widest + reach:
        return False
    slant = np.sqrt(f[k, 6] * f[k, 6] + rise * rise)
    return abs(f[k, 6] * (base - rho) + rise * height) <= reach * slant


# ---- places on a wall: (gap, n_x, n_y, n_z) ------------------------------------------------


@jit
def _on_rectangle(f, k, x, y, z, r):
    """Return the place nearest to the centre; a centre in the plate counts as above it."""
    x, y, z = x - f[k, 0], y - f[k, 1], z - f[k, 2]
    mx, my, mz = f[k, 3], f[k, 4], f[k, 5]
    height = x * mx + y * my + z * mz
    ax, ay, az = f[k, 6], f[k, 7], f[k, 8]
    bx, by, bz = f[k, 9], f[k, 10], f[k, 11]
    a = (x * ax + y * ay + z * az) / (ax * ax + ay * ay + az * az)
    b = (x * bx + y * by + z * bz) / (bx * bx + by * by + bz * bz)
    sign = 1.0 if height < 0.0 else -1.0
    if abs(a) <= 1.0 and abs(b) <= 1.0:
        return abs(height) - r, sign * mx, sign * my, sign * mz
    a, b = min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0)
    ux, uy, uz = a * ax + b * bx - x, a * ay + b * by - y, a * az + b * bz - z
    distance = norm(ux, uy, uz)
    if distance == 0.0:
        return -r, sign * mx, sign * my, sign * mz
    return distance - r, ux / distance, uy / distance, uz / distance


@jit
def _on_meridian(s, rho, length, base, top, side, r, opposite):
    """Return (gap, n_s, n_rho) of a point (s, rho) and a meridian of a frustum, from base to top.

    On the `opposite` meridian rho is negative. What is no place of its own is left out there: the
    tip of a cone and the middle of a disc, and the face of a wall that is touched from outside.
    """
    rise = top - base
    slant = np.sqrt(length * length + rise * rise)
    us, ur = length / slant, rise / slant
    foot = us * s + ur * (rho - base)
    if 0.0 <= foot <= slant:
        height = side * (us * (base - rho) + ur * s)
        if height < -r or (opposite and side < 0.0):
            return np.inf, 0.0, 0.0
        return height - r, -side * ur, side * us
    rim_s, rim = (0.0, base) if foot < 0.0 else (length, top)
    if opposite and rim == 0.0:
        return np.inf, 0.0, 0.0
    ds, drho = rim_s - s, rim - rho
    distance = np.sqrt(ds * ds + drho * drho)
    if distance == 0.0:
        return -r, -side * ur, side * us
    return distance - r, ds / distance, drho / distance


@jit
def _across(x, y, z):
    """Return a unit vector perpendicular to the unit vector (x, y, z)."""
    if abs(x) < 0.6:
        length = np.sqrt(y * y + z * z)
        return 0.0, z / length, -y / length
    length = np.sqrt(x * x + z * z)
    return -z / length, 0.0, x / length


@jit
def _on_frustum(f, k, x, y, z, r):
    """Return the places on the nearest meridian and on the one opposite."""
    x, y, z = x - f[k, 0], y - f[k, 1], z - f[k, 2]
    kx, ky, kz = f[k, 3], f[k, 4], f[k, 5]
    length, base, top, side = f[k, 6], f[k, 7], f[k, 8], f[k, 9]
    s = x * kx + y * ky + z * kz
    x, y, z = x - s * kx, y - s * ky, z - s * kz
    rho = norm(x, y, z)
    if rho > _ON_AXIS * r:
        x, y, z = x / rho, y / rho, z / rho
    else:
        x, y, z = _across(kx, ky, kz)
    phi, ns, nr = _on_meridian(s, rho, length, base, top, side, r, False)
    near = (phi, ns * kx + nr * x, ns * ky + nr * y, ns * kz + nr * z)
    phi, ns, nr = _on_meridian(s, -rho, length, base, top, side, r, True)
    far = (phi, ns * kx - nr * x, ns * ky - nr * y, ns * kz - nr * z)
    return near, far


@jit
def sphere_wall(f, k, x, y, z, r):
    """Return the two places (gap, n_x, n_y, n_z) where a sphere meets face k, the nearer first.

    n points from the sphere into the wall.
    """
    nowhere = (np.inf, 0.0, 0.0, 0.0)
    kind = f[k, _KIND]
    if kind == PLANE:
        return (plane_gap(f, k, x, y, z, r), -f[k, 3], -f[k, 4], -f[k, 5]), nowhere
    if kind == RECTANGLE:
        return _on_rectangle(f, k, x, y, z, r), nowhere
    if kind == FRUSTUM:
        return _on_frustum(f, k, x, y, z, r)
    return nowhere, nowhere


# ---- contacts ------------------------------------------------------------------------------


@jit
def _turning_margin(f, k, place, x, y, z, vx, vy, vz, r, rolling, mu, h, c):
    """Return the margin at a place on a turning wall, whose velocity is that at mid-gap."""
    phi, nx, ny, nz = place
    arm = r + 0.5 * phi
    x, y, z = x + arm * nx - f[k, _C], y + arm * ny - f[k, _C + 1], z + arm * nz - f[k, _C + 2]
    wx, wy, wz = f[k, _W], f[k, _W + 1], f[k, _W + 2]
    ux = f[k, _V] + wy * z - wz * y
    uy = f[k, _V + 1] + wz * x - wx * z
    uz = f[k, _V + 2] + wx * y - wy * x
    return _margin(norm(vx - ux, vy - uy, vz - uz), rolling, mu, r, h, c)


@jit
def touches(f, k, x, y, z, vx, vy, vz, r, rolling, mu, h, c, limit):
    """Return (first, second, near, far): the places of a sphere on face k, and which count.

    A place is a contact iff phi <= max(c r, h (|v - u| (1 + mu) + |w| r)) with the velocity u of
    the wall at the point in the middle of the gap.

    limit : the `largest_margin`, which is the margin itself where the wall does not turn.
    """
    near, far = sphere_wall(f, k, x, y, z, r)
    first, second = near[0] <= limit, far[0] <= limit
    if not turns(f, k):
        return first, second, near, far
    if first and near[0] < np.inf:
        first = near[0] <= _turning_margin(f, k, near, x, y, z, vx, vy, vz, r, rolling, mu, h, c)
    if second and far[0] < np.inf:
        second = far[0] <= _turning_margin(f, k, far, x, y, z, vx, vy, vz, r, rolling, mu, h, c)
    return first and near[0] < np.inf, second and far[0] < np.inf, near, far


@jit
def wall_impulses(x, a, b, normal, arm, p, reference, out):
    """Add up the impulse [N s] of each face's contacts and its torque about `reference` [N m s].

    The point of a contact is x_a + arm n, or x_a + arm where arms are vectors.

    x : (n, 3) positions from which the contacts were found; a, b : (m,) rows, b = -(k + 1);
    p : (m, 3) world impulses on b; reference : (w, 3) [m]; out : (w, 6), zeros on entry.
    """
    along = arm.shape[1] == 2
    for i in range(b.shape[0]):
        k = -b[i] - 1
        if along:
            lx, ly, lz = (
                arm[i, 0] * normal[i, 0],
                arm[i, 0] * normal[i, 1],
                arm[i, 0] * normal[i, 2],
            )
        else:
            lx, ly, lz = arm[i, 0], arm[i, 1], arm[i, 2]
        lx += x[a[i], 0] - reference[k, 0]
        ly += x[a[i], 1] - reference[k, 1]
        lz += x[a[i], 2] - reference[k, 2]
        out[k, 0] += p[i, 0]
        out[k, 1] += p[i, 1]
        out[k, 2] += p[i, 2]
        out[k, 3] += ly * p[i, 2] - lz * p[i, 1]
        out[k, 4] += lz * p[i, 0] - lx * p[i, 2]
        out[k, 5] += lx * p[i, 1] - ly * p[i, 0]
