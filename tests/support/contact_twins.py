"""Slow, readable twins of contact detection and of the cone solve, and clouds to try them on.

Twins hold all bodies or all contacts in one process and follow the definitions literally. Tables
of contacts are structured arrays of `CONTACT`, sorted by (a, other), so that two tables agree to
the bit iff their bytes are equal.

Symbols: n bodies, m contacts; gamma impulse, g velocity; rows (normal, tangent 1, tangent 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.bodies import Bodies, ImpulseMemory
from dem_mpi.contacts import (
    ContactSet,
    DetectionOptions,
    Neighbours,
    Reference,
    find_contacts,
    find_neighbours,
)
from dem_mpi.parallel import Parallel
from dem_mpi.partition import Partition, balance, migrate
from dem_mpi.wall_kinds import PLANE
from dem_mpi.walls import Walls

CONTACT = np.dtype(
    [
        ("a", np.int64),
        ("other", np.int64),
        ("normal", np.float64, 3),
        ("gap", np.float64),
        ("arm", np.float64, 2),
        ("friction", np.float64),
    ]
)

FIRST_GID = 2**40  # gids need 64 bits

# ---- clouds and walls ----------------------------------------------------------------------


def cloud(
    position: ArrayLike,
    radius: ArrayLike,
    velocity: ArrayLike = 0.0,
    angular_velocity: ArrayLike = 0.0,
    seed: int = 0,
) -> Bodies:
    """Spheres of two materials with shuffled gids above 2^40: no order agrees with another."""
    position = np.asarray(position, dtype=np.float64).reshape(-1, 3)
    count = len(position)
    rng = np.random.default_rng(seed)
    arrays = {
        "gid": FIRST_GID + rng.permutation(count),
        "material": rng.integers(0, 2, count),
        "radius": np.broadcast_to(radius, count),
        "position": position,
        "velocity": np.broadcast_to(velocity, (count, 3)),
        "angular_velocity": np.broadcast_to(angular_velocity, (count, 3)),
    }
    return Bodies.from_arrays(arrays, np.array([1000.0, 2500.0]))


def plane_walls(point: NDArray, normal: NDArray, velocity: NDArray, material: NDArray) -> Walls:
    """Return planes through points (w, 3) with unit normals (w, 3) that move at velocities."""
    count = len(point)
    geometry = np.zeros((count, 12))
    geometry[:, 0:3], geometry[:, 3:6] = point, normal
    kind = np.full(count, PLANE, np.int8)
    still = np.zeros((count, 3))
    return Walls(kind, geometry, material, velocity, still, still)


def no_walls() -> Walls:
    """Return walls of which there are none."""
    none = np.zeros((0, 3))
    return plane_walls(none, none, none, np.zeros(0, np.int32))


def room(low: float, high: float) -> Walls:
    """Return the six faces of a cube, normals inward: -x, +x, -y, +y, -z, +z."""
    normal = np.repeat(np.eye(3), 2, axis=0)
    normal[1::2] *= -1.0
    point = np.where(normal > 0.0, low, high)
    velocity = np.zeros((6, 3))
    velocity[1] = (-0.3, 0.1, 0.0)
    return plane_walls(point, normal, velocity, np.arange(6, dtype=np.int32) % 2)


def detection(margin: float = 0.02, skin: float = 0.01, threads: int = 1) -> DetectionOptions:
    """Options with another friction for each pair of materials."""
    return DetectionOptions(margin, skin, np.array([[0.3, 0.5], [0.5, 0.0]]), threads)


# ---- detection on several ranks, and all contacts in one table -----------------------------


@dataclass(frozen=True)
class Detected:
    """Bodies of this rank with their neighbours and contacts."""

    partition: Partition
    bodies: Bodies
    neighbours: Neighbours
    contacts: ContactSet


def distribute(
    parallel: Parallel, bodies: Bodies, partition: Partition | None = None
) -> tuple[Partition, Bodies]:
    """Collective. Send all bodies, known to every rank, to their owners."""
    mine = bodies.take(np.arange(parallel.rank, len(bodies), parallel.size))
    if partition is None:
        partition = balance(parallel, mine, np.ones(len(mine), dtype=np.int64))
    owned, _, _ = migrate(parallel, partition, mine, ImpulseMemory.empty(len(mine)))
    return partition, owned


def detect(
    parallel: Parallel,
    bodies: Bodies,
    options: DetectionOptions,
    step: float = 1e-3,
    walls: Walls | None = None,
    partition: Partition | None = None,
) -> Detected:
    """Collective. Distribute all bodies, list near pairs, find contacts (no forces: v_hat = v)."""
    partition, owned = distribute(parallel, bodies, partition)
    reference = Reference.of(parallel, owned, owned.velocity, options, step)
    neighbours = find_neighbours(parallel, partition, owned, reference, options)
    contacts = measure(neighbours, owned, options, step, walls)
    return Detected(partition, owned, neighbours, contacts)


def measure(
    neighbours: Neighbours,
    owned: Bodies,
    options: DetectionOptions,
    step: float,
    walls: Walls | None = None,
) -> ContactSet:
    """Collective. The contacts of the bodies as they stand, from a list that exists."""
    position = neighbours.extend_position(owned.position)
    motion = [neighbours.extend(x) for x in (owned.velocity, owned.angular_velocity)]
    return find_contacts(neighbours, position, *motion, walls or no_walls(), options, step)


def table_of(contacts: ContactSet, gid: NDArray) -> NDArray:
    """This rank's contacts in local order; `gid` (n,) of the local rows."""
    table = np.zeros(contacts.count, dtype=CONTACT)
    table["a"], table["other"] = gid[contacts.a], contacts.other
    for name in ("normal", "gap", "arm", "friction"):
        table[name] = getattr(contacts, name)
    return table


def gathered(parallel: Parallel, rows: NDArray) -> NDArray:
    """Collective. The rows of all ranks, in rank order, on every rank."""
    parts = parallel.gather(rows)
    return parallel.broadcast(None if parts is None else np.concatenate(parts))


def all_contacts(parallel: Parallel, contacts: ContactSet, gid: NDArray) -> NDArray:
    """Collective. The table of all ranks' contacts, sorted, on every rank."""
    return np.sort(gathered(parallel, table_of(contacts, gid)), order=["a", "other"])


# ---- the contact rule, pair by pair --------------------------------------------------------


def _norm(d: NDArray) -> NDArray:
    return np.sqrt(d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2])


def brute_force(bodies: Bodies, options: DetectionOptions, step: float, walls: Walls) -> NDArray:
    """Every pair and every wall tried: phi <= max(c min r, h (|dv| (1 + mu) + |w| r + |w| r)).

    The arithmetic stands in the order of the definition, so that results agree to the bit.
    """
    b = bodies
    spin = _norm(b.angular_velocity) * b.radius
    parts = [np.zeros(0, dtype=CONTACT)]
    for i in range(len(b)):
        for k in range(len(walls.kind)):
            d = b.position[i] - walls.geometry[k, 0:3]
            n = walls.geometry[k, 3:6]
            phi = d[0] * n[0] + d[1] * n[1] + d[2] * n[2] - b.radius[i]
            mu = options.friction[b.material[i], walls.material[k]]
            speed = _norm(b.velocity[i] - walls.velocity[k])
            margin = step * (speed * (1.0 + mu) + spin[i])
            if phi <= max(options.margin * b.radius[i], margin):
                arm = (b.radius[i] + 0.5 * phi, 0.0)
                parts.append(np.array([(b.gid[i], -(k + 1), -n, phi, arm, mu)], dtype=CONTACT))

        j = np.flatnonzero(b.gid > b.gid[i])
        d = b.position[j] - b.position[i]
        distance = _norm(d)
        phi = distance - (b.radius[i] + b.radius[j])
        mu = options.friction[b.material[i], b.material[j]]
        speed = _norm(b.velocity[i] - b.velocity[j])
        margin = np.maximum(
            options.margin * np.minimum(b.radius[i], b.radius[j]),
            step * (speed * (1.0 + mu) + spin[i] + spin[j]),
        )
        touching = np.flatnonzero(phi <= margin)
        j, phi = j[touching], phi[touching]
        found = np.zeros(len(j), dtype=CONTACT)
        found["a"], found["other"] = b.gid[i], b.gid[j]
        found["gap"], found["friction"] = phi, mu[touching]
        with np.errstate(invalid="ignore"):
            normal = d[touching] / distance[touching, None]
        normal[distance[touching] == 0.0] = (0.0, 0.0, 1.0)
        found["normal"] = normal
        found["arm"] = np.stack((b.radius[i] + 0.5 * phi, b.radius[j] + 0.5 * phi), axis=1)
        parts.append(found)
    return np.sort(np.concatenate(parts), order=["a", "other"])


# ---- D and M^-1, contact by contact --------------------------------------------------------


def tangents(n: NDArray) -> tuple[NDArray, NDArray]:
    """Both tangents of a unit normal (Duff et al., JCGT 6(1), 2017)."""
    sign = np.copysign(1.0, n[2])
    q = -1.0 / (sign + n[2])
    t1 = np.array([1.0 + sign * n[0] * n[0] * q, sign * n[0] * n[1] * q, -sign * n[0]])
    t2 = np.array([n[0] * n[1] * q, sign + n[1] * n[1] * q, -n[1]])
    return t1, t2


def dense_operator(table: NDArray, bodies: Bodies, frictional: bool) -> tuple[NDArray, NDArray]:
    """D (dof n, columns m) and the diagonal of M^-1 (dof n,), bodies in order of gid.

    Each contact's impulse acts at one common point, x_a + arm_a n: column t of D is
    (t, (point - x_b) x t) on b and -(t, (point - x_a) x t) on a. Without friction bodies do not
    turn: 3 rows a body, 1 column a contact.
    """
    bodies = bodies.take(np.argsort(bodies.gid))
    dof, columns = (6, 3) if frictional else (3, 1)
    D = np.zeros((dof * len(bodies), columns * len(table)))
    for i, contact in enumerate(table):
        n = contact["normal"]
        a = int(np.searchsorted(bodies.gid, contact["a"]))
        point = bodies.position[a] + contact["arm"][0] * n
        sides = [(a, -1.0)]
        if contact["other"] >= 0:
            sides.append((int(np.searchsorted(bodies.gid, contact["other"])), 1.0))
        for c, t in enumerate((n, *tangents(n))[:columns]):
            for k, sign in sides:
                lever = point - bodies.position[k]
                generalised = np.concatenate((t, np.cross(lever, t)))[:dof]
                D[dof * k : dof * (k + 1), columns * i + c] = sign * generalised
    inverse = np.stack((bodies.mass,) * 3 + (bodies.inertia,) * 3, axis=1) ** -1.0
    return D, inverse[:, :dof].ravel()


def dense_delassus(table: NDArray, bodies: Bodies, frictional: bool) -> NDArray:
    """N = D^T M^-1 D, (columns m, columns m)."""
    D, inverse = dense_operator(table, bodies, frictional)
    return D.T @ (inverse[:, None] * D)


class DenseDelassus:
    """N as an array, on one rank: what `ConeProblem` asks of an operator, and nothing else."""

    def __init__(self, matrix: NDArray, columns: int) -> None:
        self.matrix = matrix
        self.columns = columns
        self.products = 0

    def apply(self, impulse: NDArray, out: NDArray) -> None:
        """out = N impulse, (m, columns)."""
        self.products += 1
        out[:] = (self.matrix @ impulse.ravel()).reshape(out.shape)

    def diagonal(self) -> NDArray:
        """Return the diagonal of N, tangents averaged: an isotropic scaling keeps the cone."""
        diag = np.diag(self.matrix).reshape(-1, self.columns).copy()
        if self.columns == 3:
            diag[:, 1:] = diag[:, 1:].mean(axis=1, keepdims=True)
        return diag


# ---- cone, residuals, projected gradients --------------------------------------------------


def projected(gamma: NDArray, mu: NDArray) -> NDArray:
    """The nearest point of {|gamma_t| <= mu gamma_n} for each row."""
    result = np.empty_like(gamma)
    for i, (row, m) in enumerate(zip(gamma, mu, strict=True)):
        n, t = row[0], np.linalg.norm(row[1:])
        if n >= 0.0 and t <= m * n:
            result[i] = row
        elif m * t <= -n:
            result[i] = 0.0
        else:
            new = (m * t + n) / (1.0 + m * m)
            result[i, 0] = new
            result[i, 1:] = m * new * row[1:] / t if t > 0.0 else 0.0
    return result


def residuals(N: NDArray, b: NDArray, mu: NDArray, gamma: NDArray) -> dict[str, float]:
    """r_p, r_d, r_c, objective, and the largest of S. De's 2.35-2.37, by their definitions."""
    g = (N @ gamma.ravel()).reshape(b.shape) + b
    slip, push = np.linalg.norm(g[:, 1:], axis=1), np.linalg.norm(gamma[:, 1:], axis=1)
    work = np.sum(gamma * g, axis=1)
    rubbing = mu > 0.0
    thesis_primal = np.maximum(0.0, push - mu * gamma[:, 0])
    thesis_dual = np.maximum(0.0, slip[rubbing] - g[rubbing, 0] / mu[rubbing])
    return {
        "primal": max(0.0, np.max(np.maximum(push - mu * gamma[:, 0], -gamma[:, 0]))),
        "dual": max(0.0, np.max(mu * slip - g[:, 0])),
        "complementarity": np.max(np.abs(work)),
        "objective": 0.5 * gamma.ravel() @ N @ gamma.ravel() + b.ravel() @ gamma.ravel(),
        "thesis": max(
            np.max(thesis_primal, initial=0.0), np.max(thesis_dual, initial=0.0), abs(work.mean())
        ),
    }


def fixed_point(N: NDArray, b: NDArray, mu: NDArray, steps: int) -> NDArray:
    """Accelerated projected gradients with the exact largest eigenvalue: no scaling, no search."""
    L = np.linalg.eigvalsh(N)[-1]
    gamma = old = np.zeros_like(b)
    theta, beta = 1.0, 0.0
    for _ in range(steps):
        y = gamma + beta * (gamma - old)
        slope = (N @ y.ravel()).reshape(b.shape) + b
        new = projected(y - slope / L, mu)
        if np.sum(slope * (new - gamma)) > 0.0:
            theta, beta = 1.0, 0.0
        else:
            theta_new = 0.5 * (theta * np.sqrt(theta * theta + 4.0) - theta * theta)
            beta = theta * (1.0 - theta) / (theta * theta + theta_new)
            theta = theta_new
        old, gamma = gamma, new
    return gamma
