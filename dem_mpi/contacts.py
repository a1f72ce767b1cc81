"""Contact detection: near pairs found rarely, contacts measured every step.

A pair is a contact iff its gap is at most max(c min(r_a, r_b), h (|v_a - v_b| (1 + mu) +
|w_a| r_a + |w_b| r_b)): bitwise the same on any number of ranks. Near pairs are listed with that
margin and a skin, and the list stands until a body may have moved, or its margin grown, by half
the skin. In a periodic box it joins bodies with images of others: ghost rows that are displaced
by the period.

A contact joins a and b with gid(a) < gid(b) and belongs to the rank that owns a; walls are always
b, with negative ids. The normal points from a to b; the gap is positive when they are apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_detection as kernels
from dem_mpi import _kernels_solver as frames
from dem_mpi import _kernels_walls as wall_kernels
from dem_mpi.bodies import Bodies, ImpulseMemory
from dem_mpi.errors import DemError
from dem_mpi.parallel import Halo, Parallel
from dem_mpi.partition import Partition, ghost_targets, image_targets
from dem_mpi.periodic import ITSELF, PeriodicBox
from dem_mpi.walls import Walls, velocity_at


@dataclass(frozen=True)
class DetectionOptions:
    """What decides which pairs are listed and which are contacts.

    margin : c, in smaller radii; skin : [m]; friction : (materials, materials) table of mu
    general : whether bodies may be other than spheres
    box    : the periodic box, None where no axis repeats
    """

    margin: float
    skin: float
    friction: NDArray
    threads: int = 1
    box: PeriodicBox | None = None
    general: bool = False

    @property
    def largest_friction(self) -> float:
        """The largest mu of any pair of materials."""
        return float(self.friction.max(initial=0.0))


@dataclass(frozen=True)
class Reference:
    """The state of this rank's owned bodies from which near pairs were listed.

    With it alone the list can be made again: a run that resumes starts from the stored reference
    and has the list that the uninterrupted run has.

    position : (n, 3) [m]; reach : (n,) [m] bound of the body's share of the margin
    frame : (3,) [m/s] velocity subtracted in the bound
    """

    position: NDArray
    reach: NDArray
    frame: NDArray

    @classmethod
    def of(
        cls,
        parallel: Parallel,
        bodies: Bodies,
        predicted: NDArray,
        options: DetectionOptions,
        step: float,
    ) -> Reference:
        """Collective. The reference of the current state; `predicted` (n, 3) is v + h a."""
        total = np.append(predicted.sum(axis=0), float(len(bodies)))
        parallel.sum_in_place(total)
        frame = total[:3] / max(total[3], 1.0)
        reach = np.empty(len(bodies))
        kernels.reach_speed(
            predicted, bodies.angular_velocity, bodies.bounding_radius, frame,
            options.largest_friction, step, reach,
        )  # fmt: skip
        return cls(bodies.position.copy(), reach, frame)

    def drift(
        self, bodies: Bodies, predicted: NDArray, options: DetectionOptions, step: float
    ) -> float:
        """Return the largest displacement plus growth of the margin of an owned body [m]."""
        reach = np.empty(len(bodies))
        kernels.reach_speed(
            predicted, bodies.angular_velocity, bodies.bounding_radius, self.frame,
            options.largest_friction, step, reach,
        )  # fmt: skip
        return float(kernels.largest_drift(bodies.position, self.position, reach, self.reach))


@dataclass(frozen=True)
class Neighbours:
    """Near pairs of owned bodies, and what does not change while the list stands.

    Rows: n owned bodies, then the ghosts that some pair needs. gid, radius, material,
    inverse_mass, inverse_inertia cover all rows. The pairs of body a are
    neighbour[offset[a]:offset[a + 1]], in ascending gid, and those with several images of one
    body in order of the image.

    radius : (n + g,) [m] of the bounding spheres
    inverse_inertia : (n + g,) of spheres; (n + g, 2) across and along the axis of general bodies
    shift : (g, 3) [m] displacement of the ghosts from the bodies they are images of; None where
            no axis is periodic
    form  : (n + g, 3) shape, radius, half length of general bodies; None where all are spheres
    """

    reference: Reference
    halo: Halo
    gid: NDArray
    radius: NDArray
    material: NDArray
    inverse_mass: NDArray
    inverse_inertia: NDArray
    offset: NDArray
    neighbour: NDArray
    shift: NDArray | None = None
    form: NDArray | None = None

    @property
    def pairs(self) -> int:
        """Number of near pairs on this rank."""
        return self.neighbour.shape[0]

    def extend(self, owned: NDArray) -> NDArray:
        """Collective. A copy of (n, k) rows with current ghost rows behind them."""
        rows = np.empty((self.halo.owned + self.halo.ghosts, *owned.shape[1:]), owned.dtype)
        rows[: self.halo.owned] = owned
        self.halo.forward(rows)
        return rows

    def extend_position(self, owned: NDArray) -> NDArray:
        """Collective. As `extend`, for positions (n, 3) [m]: images stand where they are seen."""
        rows = self.extend(owned)
        if self.shift is not None:
            rows[self.halo.owned :] += self.shift
        return rows


class PeriodTooShortError(DemError):
    """The periodic box is narrower than the distance at which bodies interact."""


@dataclass(frozen=True)
class ContactSet:
    """The contacts this rank owns, ordered by (row of a, gid of b, image of b); walls first.

    a, b       : (m,) int32 local rows; b = -(k + 1) is wall k
    other      : (m,) int64 gid of b, or the wall's id
    row        : (n + 1,) int64; contacts of owned body k are row[k]:row[k + 1]
    normal     : (m, 3) from a to b;  gap : (m,) [m];  friction : (m,)
    arm        : (m, 2) [m] from each centre to the common point in the middle of the gap, along
                 the normal; (m, 6) vectors from a and from b where bodies may not be spheres
    coincident : number of contacts whose centres coincide (their normal is e_z by convention)
    """

    a: NDArray
    b: NDArray
    other: NDArray
    row: NDArray
    normal: NDArray
    gap: NDArray
    arm: NDArray
    friction: NDArray
    coincident: int

    @property
    def count(self) -> int:
        """Number of contacts on this rank."""
        return self.a.shape[0]

    @cached_property
    def tangents(self) -> tuple[NDArray, NDArray]:
        """Both tangents (m, 3) of each contact, pure functions of its normal."""
        t1, t2 = np.empty_like(self.normal), np.empty_like(self.normal)
        frames.tangents.serial(self.normal, t1, t2)
        return t1, t2

    def same_graph(self, other: ContactSet) -> bool:
        """Whether the same bodies touch, so that matrix patterns can be kept."""
        return np.array_equal(self.a, other.a) and np.array_equal(self.b, other.b)


def find_neighbours(
    parallel: Parallel,
    partition: Partition,
    bodies: Bodies,
    reference: Reference,
    options: DetectionOptions,
) -> Neighbours:
    """Collective. Make ghosts and list near pairs as the bodies stood at the reference.

    Every body must be on the rank that owned its key at the reference, and in the periodic box.
    O(n) by a hashed grid with one level for each doubling of the size. PeriodTooShortError on all
    ranks if bodies could interact with images further away than the next.
    """
    owned = len(bodies)
    # Two bodies are near iff their distance <= r + r + max(c min(r, r), reach + reach) + skin,
    # which is at most the sum of these two effective radii.
    radius = bodies.bounding_radius
    effective = (
        radius + np.maximum(0.5 * options.margin * radius, reference.reach) + 0.5 * options.skin
    )
    largest = parallel.max(float(effective.max(initial=0.0)))
    _check_period(options.box, 2.0 * largest)
    halo, image = _make_ghosts(
        parallel, partition, reference.position, effective + largest, options.box
    )
    shift = None if options.box is None else options.box.shift(image[owned:])

    static = Neighbours(
        reference=reference,
        halo=halo,
        gid=bodies.gid,
        radius=radius,
        material=bodies.material,
        inverse_mass=1.0 / bodies.mass,
        inverse_inertia=_inverse_inertia(bodies, options.general),
        offset=np.zeros(owned + 1, dtype=np.int64),
        neighbour=np.empty(0, dtype=np.int32),
        shift=shift,
        form=_form(bodies) if options.general else None,
    )
    gid, radius = static.extend(static.gid), static.extend(static.radius)
    position, reach = static.extend_position(reference.position), static.extend(reference.reach)
    effective = static.extend(effective)
    low, high = _near_pairs(position, radius, reach, effective, gid, owned, options)

    needed = np.zeros(halo.owned + halo.ghosts, dtype=bool)
    needed[high] = True
    needed[:owned] = True
    pruned = halo.keep(needed[owned:])
    renumber = (np.cumsum(needed) - 1).astype(np.int32)
    gid, image = gid[needed], image[needed]
    offset = np.zeros(owned + 1, dtype=np.int64)
    neighbour = np.empty(low.shape[0], dtype=np.int32)
    kernels.group_pairs(low, renumber[high], gid, image, owned, offset, neighbour)
    return Neighbours(
        reference=reference,
        halo=pruned,
        gid=gid,
        radius=radius[needed],
        material=static.extend(static.material)[needed],
        inverse_mass=static.extend(static.inverse_mass)[needed],
        inverse_inertia=static.extend(static.inverse_inertia)[needed],
        offset=offset,
        neighbour=neighbour,
        shift=None if shift is None else shift[needed[owned:]],
        form=None if static.form is None else static.extend(static.form)[needed],
    )


def _inverse_inertia(bodies: Bodies, general: bool) -> NDArray:
    """(n,) of spheres, or (n, 2) across and along the axis [1/(kg m^2)]."""
    if general:
        return 1.0 / np.stack((bodies.inertia, bodies.axial_inertia), axis=1)
    return 1.0 / bodies.inertia


def _form(bodies: Bodies) -> NDArray:
    """(n, 3): shape, radius and half length of bodies of any shape."""
    return np.stack((bodies.shape, bodies.radius, bodies.half_length), axis=1, dtype=np.float64)


def _check_period(box: PeriodicBox | None, interaction: float) -> None:
    """PeriodTooShortError if images beyond the next ones could come within `interaction` [m]."""
    if box is None:
        return
    shortest, axis = box.shortest
    if interaction > shortest:
        raise PeriodTooShortError(
            f"the domain repeats every {shortest:.6g} m along {axis}, but bodies may interact over "
            f"up to {interaction:.6g} m, a distance that grows with their size and with their "
            f"speed times the step: lengthen the domain, or lower time.step or contact.skin"
        )


def _make_ghosts(
    parallel: Parallel,
    partition: Partition,
    position: NDArray,
    reach: NDArray,
    box: PeriodicBox | None,
) -> tuple[Halo, NDArray]:
    """Collective. The halo of all ghosts within reach, and the image code (n + g,) of each row."""
    rows: dict[int, NDArray] = dict(ghost_targets(parallel, partition, position, reach))
    if box is None:
        halo = Halo.build(parallel, len(position), rows)
        return halo, np.full(halo.owned + halo.ghosts, ITSELF, dtype=np.int8)
    codes = {rank: np.full(len(index), ITSELF, dtype=np.int8) for rank, index in rows.items()}
    for rank, (index, code) in image_targets(partition, box, position, reach).items():
        rows[rank] = np.concatenate((rows.get(rank, index[:0]), index))
        codes[rank] = np.concatenate((codes.get(rank, code[:0]), code))
    halo = Halo.build(parallel, len(position), rows)
    mine = np.full(halo.owned, ITSELF, dtype=np.int8)
    return halo, np.concatenate((mine, halo.deliver(codes)))


def _near_pairs(
    position: NDArray,
    radius: NDArray,
    reach: NDArray,
    effective: NDArray,
    gid: NDArray,
    owned: int,
    options: DetectionOptions,
) -> tuple[NDArray, NDArray]:
    """Return the rows (low, high) of all near pairs, the smaller gid first and owned."""
    count = position.shape[0]
    none = np.empty(0, dtype=np.int32)
    if count == 0:
        return none, none
    smallest = float(effective.min())
    level = np.empty(count, dtype=np.int64)
    occupied = kernels.assign_levels(effective, smallest, level)
    buckets = 1 << max(4, int(2 * count - 1).bit_length())
    start = np.zeros(buckets + 1, dtype=np.int64)
    entry = np.empty(count, dtype=np.int32)
    entry_key = np.empty(count, dtype=np.int64)
    kernels.fill_table(position, level, 2.0 * smallest, start, entry, entry_key)
    search = kernels.search_pairs.using(options.threads)
    offset = np.zeros(count + 1, dtype=np.int64)
    grid = (level, occupied, 2.0 * smallest, start, entry, entry_key)
    rule = (owned, options.margin, options.skin)
    search(position, radius, reach, gid, *grid, *rule, offset, none, none)
    np.cumsum(offset, out=offset)
    low = np.empty(offset[-1], dtype=np.int32)
    high = np.empty(offset[-1], dtype=np.int32)
    if offset[-1]:
        search(position, radius, reach, gid, *grid, *rule, offset, low, high)
    return low, high


def find_contacts(
    neighbours: Neighbours,
    position: NDArray,
    predicted: NDArray,
    angular_velocity: NDArray,
    walls: Walls,
    options: DetectionOptions,
    step: float,
) -> ContactSet:
    """Measure the listed pairs and all walls, and keep those within the margin.

    position, predicted, angular_velocity : (n + g, 3), ghosts current.
    """
    n, owned = neighbours, neighbours.halo.owned
    row = np.zeros(owned + 1, dtype=np.int64)
    motion = (position, n.radius, predicted, angular_velocity)
    material = (n.material, options.friction)
    pairs = (n.offset, n.neighbour)
    wall = (walls.rows(), walls.material)
    rule = (step, options.margin)
    kernels.count_contacts.using(options.threads)(*motion, *material, *pairs, *wall, *rule, row)
    np.cumsum(row, out=row)
    m = int(row[-1])
    contacts = (
        np.empty(m, dtype=np.int32),
        np.empty(m, dtype=np.int32),
        np.empty(m, dtype=np.int64),
        np.empty((m, 3)),
        np.empty(m),
        np.empty((m, 2)),
        np.empty(m),
    )
    coincident = np.zeros(owned, dtype=np.int32)
    kernels.fill_contacts.using(options.threads)(
        *motion, n.gid, *material, *pairs, *wall, *rule, row, *contacts, coincident
    )
    a, b, other, normal, gap, arm, friction = contacts
    return ContactSet(a, b, other, row, normal, gap, arm, friction, int(coincident.sum()))


def contact_velocity_of_walls(
    contacts: ContactSet, position: NDArray, walls: Walls
) -> NDArray | None:
    """Return the world velocity (m, 3) [m/s] of b at the contact where b is a wall.

    position : (n, 3) of the owned bodies. None if no wall moves.
    """
    if not walls.moving:
        return None
    velocity = np.zeros((contacts.count, 3))
    rows = np.flatnonzero(contacts.b < 0)
    arm = contacts.arm[rows]
    arm = arm[:, :1] * contacts.normal[rows] if arm.shape[1] == 2 else arm[:, :3]
    point = position[contacts.a[rows]] + arm
    velocity[rows] = velocity_at(walls, -contacts.b[rows] - 1, point)
    return velocity


def wall_impulses(
    contacts: ContactSet, position: NDArray, walls: Walls, impulse: NDArray
) -> NDArray:
    """Return the impulse [N s] and torque impulse [N m s] of these contacts on each face, (w, 6).

    Torques are about the `centre` of each face. position : (n, 3) of the owned bodies, from which
    the contacts were found; impulse : (m, columns).
    """
    total = np.zeros((len(walls.kind), 6))
    if not len(total):
        return total
    rows = np.flatnonzero(contacts.b < 0)
    a, b, normal, arm = (x[rows] for x in (contacts.a, contacts.b, contacts.normal, contacts.arm))
    world = np.empty((len(rows), 3))
    frames.to_world.serial(normal, np.ascontiguousarray(impulse[rows]), world)
    wall_kernels.wall_impulses(position, a, b, normal, arm, world, walls.centre, total)
    return total


def recall_impulses(
    contacts: ContactSet, memory: ImpulseMemory, columns: int, scale: float, threads: int
) -> NDArray:
    """Return last step's impulses (m, columns) of the contacts that exist again, zero elsewhere.

    World-frame impulses, times `scale`, in the new contact frames.
    """
    world = np.zeros((contacts.count, 3))
    kernels.match_impulses.using(threads)(
        contacts.row, contacts.other, memory.offsets, memory.other, memory.impulse, world
    )
    world *= scale
    impulse = np.empty((contacts.count, columns))
    frames.to_contact.using(threads)(contacts.normal, world, impulse)
    return impulse


def remember_impulses(contacts: ContactSet, impulse: NDArray, threads: int) -> ImpulseMemory:
    """Keep impulses (m, columns) in the world frame, by the other body's gid."""
    world = np.empty((contacts.count, 3))
    frames.to_world.using(threads)(contacts.normal, impulse, world)
    return ImpulseMemory(contacts.row, contacts.other, world)
