"""What a scene would take, told without running it: contacts, files, memory.

Nothing here starts MPI. Figures are estimates: a contact count within about a fifth for a packing
that has settled, memory within 30 % of the largest resident size of a rank.

Contacts. In a settled packing a sphere has z = z0 + 11 (c/2)^0.6 others within a gap of c radii
(second term: A. Donev, S. Torquato, F. H. Stillinger, Phys. Rev. E 71, 011105, 2005); z0 falls from
6 without friction towards 4 with much. Half of z is a body's share. What the free surface lacks,
floor and side walls make up for: settled beds of 500, 2,000 and 25,000 spheres (mu = 0.3, c = 0.02)
had 2.73, 2.74 and 2.75 contacts a body, for which this gives 2.80; mu = 0 had 3.26 (3.35), mu = 1
2.45 (2.55), c = 0.1 3.16 (3.37). Layers 0.7, 1.1 and 1.6 diameters deep had 1.9, 2.6 and 2.7.

Memory. A base for interpreter, libraries and compiled kernels; so many bytes for each body,
measured on 125,000 that touch nothing; so many for each contact, counted from the arrays that are
alive in a solve. Fitted on one rank to cubic packings of 125,000 spheres with and without friction,
matrix-free and assembled. The interior point method adds its vectors, its matrix and above all the
factor of that, whose entries `solvers.work` foretells within a factor 2 from the shape of the bed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dem_mpi.bodies import FIELDS
from dem_mpi.errors import InputError
from dem_mpi.scenario import Scenario, body_count, friction_table, frictional
from dem_mpi.scene_models import Scip, only_spheres
from dem_mpi.scene_walls import BoxWall
from dem_mpi.sizes import mean_radius, mean_volume
from dem_mpi.solvers.work import Size, elongation, factor_memory
from dem_mpi.wall_checks import holds
from dem_mpi.walls import wall_faces

_PACKING_FRACTION = 0.6  # of a settled bed

# ---- memory of a rank [B] ------------------------------------------------------------------

_BASE = 200 << 20  # interpreter, numpy, numba and its code, MPI, HDF5
_PETSC = 22 << 20
_BODY = 520  # fields, their copies while bodies migrate, predicted motion, lists of neighbours
_GHOST = 600  # the same rows, and buffers to send and receive them
# ContactSet 72, incidence and world impulses of the operator 28, remembered impulse 32, gap speed 8
_CONTACT = 72 + 28 + 32 + 8
# b, d, the best impulse, and three each of impulse and velocity; the scaling comes on top
_CONTACT_VECTORS = 9
# Of the interior point method: iterate, scalings and two directions, for c components of an impulse
# 18 c + 2 c^2 + 1 numbers; of its matrix two blocks, with what MUMPS's analysis makes of them.
_NEWTON_VECTORS = (21, 73)
_NEWTON_ENTRY = 2 * (8 + 4) + 12
_MUMPS = 40 << 20  # its code and that of the orderings
_DOUBT = 1.5  # estimates this much over a limit are refused
_MATRIX_ENTRY = 2 * (8 + 4)  # value and column, in PETSc and where the rows are filled
_MATRIX_ROW = 2 * 4 + 2 * 8  # row pointers likewise, and its place in two vectors

# ---- files [B] -----------------------------------------------------------------------------

_FRAME_INDEX = 400  # entries of a frame in the tables of frames, which grow 256 frames at a time
_TRAJECTORY_STRUCTURE = 220_000  # data sets, attributes and the first 256 entries of each table
_REACTION = 6 * 8  # force and torque on a face
_SERIES_STRUCTURE = 8_000  # four data sets more, with their checksums
_CHECKPOINT_STRUCTURE = 12_000
_CHECKPOINT_CONTACT = 8 + 24  # partner and impulse


@dataclass(frozen=True)
class Estimate:
    """What a run of a scene would take; sizes in B, memory for the fullest of `ranks` ranks.

    settled : whether the contacts are those of a settled packing, rather than of free bodies
    factors : the part of the memory that factors of Newton matrices take, 0 where there are none
    """

    bodies: int
    faces: int
    contacts: int
    settled: bool
    steps: int
    frames: int
    trajectory: int
    checkpoint: int
    checkpoints: int
    ranks: int
    memory: int
    factors: int
    warnings: tuple[str, ...]

    def lines(self) -> list[str]:
        """What there is to say, one fact a line."""
        per_body = self.contacts / self.bodies
        where = "in a settled packing" if self.settled else "between freely moving bodies"
        several = f"{self.ranks} ranks" if self.ranks > 1 else "1 rank"
        kept = f"{self.checkpoints} of {_size(self.checkpoint)}"
        return [
            f"bodies       {self.bodies:,}",
            f"wall faces   {self.faces}",
            f"contacts     about {self.contacts:,} {where}, {per_body:.2g} a body (estimate)",
            f"steps        {self.steps:,}",
            f"trajectory   {_size(self.trajectory)} in {self.frames:,} frames, uncompressed",
            f"checkpoints  {kept} kept, one more while it is written",
            f"memory       about {_size(self.memory)} a rank on {several} (estimate)",
            *([f"factors      about {_size(self.factors)} of it"] if self.factors else []),
            *(f"warning: {warning}" for warning in self.warnings),
        ]


def estimate(scenario: Scenario, ranks: int = 1) -> Estimate:
    """Estimate what a run of a checked scene would take on so many ranks; runs nothing."""
    bodies = body_count(scenario)
    settled = _settles(scenario)
    contacts = round(bodies * (contacts_per_body(scenario) if settled else 0.5))
    frames = _frames(scenario)
    return Estimate(
        bodies=bodies,
        faces=len(wall_faces(scenario).name),
        contacts=contacts,
        settled=settled,
        steps=scenario.steps,
        frames=frames,
        trajectory=trajectory_bytes(scenario, bodies, frames),
        checkpoint=checkpoint_bytes(bodies, contacts),
        checkpoints=min(scenario.checkpoint.keep, -(-scenario.steps // scenario.checkpoint_every)),
        ranks=ranks,
        memory=rank_memory(scenario, bodies, contacts, ranks),
        factors=factor_share(scenario, bodies, contacts, ranks),
        warnings=_warnings(bodies, ranks),
    )


# ---- contacts ------------------------------------------------------------------------------


def _settles(scenario: Scenario) -> bool:
    """Whether something holds the bodies against gravity: a wall that faces it."""
    return holds(wall_faces(scenario), scenario.gravity)


def contacts_per_body(scenario: Scenario) -> float:
    """Contacts of each body's share in the packing that settles on the floor."""
    names, table = friction_table(scenario)
    used = [names.index(group.material) for group in scenario.bodies]
    mu = float(table[np.ix_(used, used)].mean())
    # z0 = 6 without friction, 4.9 at mu = 0.3, towards 4
    touching = 4.0 + 2.0 / (1.0 + 4.0 * mu)
    bulk = 0.5 * (touching + 11.0 * (0.5 * scenario.contact.margin) ** 0.6)
    layers = _layers(scenario)
    if layers is None:
        return bulk
    # Alone on the floor a body has one contact; one layer deep nearly as many as in the bulk.
    return 1.0 + (bulk - 1.0) * (1.0 - math.exp(-1.5 * layers * layers))


def _layers(scenario: Scenario) -> float | None:
    """Depth of the settled bed in diameters; None where no box says how large the floor is."""
    sides = _sides(scenario)
    return None if sides is None else float(sides[0])


def _sides(scenario: Scenario) -> NDArray | None:
    """Depth of the settled bed and the sides of its floor, (3,), in mean diameters."""
    boxes = [wall for wall in scenario.walls if isinstance(wall, BoxWall)]
    down = np.abs(np.array(scenario.gravity))
    if not boxes or not down.any():
        return None
    axis = int(np.argmax(down))
    extent = np.delete(np.array(boxes[0].max) - np.array(boxes[0].min), axis)
    volume = diameters = 0.0
    for group in scenario.bodies:
        if group.radius is None:
            return None
        count = group.count or 0
        volume += count * mean_volume(group)
        diameters += count * 2.0 * mean_radius(group)
    depth = volume / _PACKING_FRACTION / float(extent.prod())
    return np.append(depth, extent) * body_count(scenario) / diameters


# ---- files ---------------------------------------------------------------------------------


def _frames(scenario: Scenario) -> int:
    """The first state, one each interval, and the last state."""
    return 1 + -(-scenario.steps // scenario.output_every)


def trajectory_bytes(scenario: Scenario, bodies: int, frames: int) -> int:
    """Size [B] of the whole trajectory: its columns, and the connectivity for ParaView."""
    columns = {"position", "gid", *scenario.output.fields}
    row = sum(_row_bytes(name) for name in columns)
    index = _TRAJECTORY_STRUCTURE + max(0, frames - 256) * _FRAME_INDEX
    faces = len(wall_faces(scenario).name)
    if faces:
        index += _SERIES_STRUCTURE + max(256, frames) * (faces * _REACTION + 16)
    return frames * bodies * row + 8 * bodies + index


def checkpoint_bytes(bodies: int, contacts: int) -> int:
    """Size [B] of a checkpoint: fields, number of impulses, pair list's origin; impulses."""
    row = sum(_row_bytes(name) for name in FIELDS) + 8 + 32
    return _CHECKPOINT_STRUCTURE + bodies * row + contacts * _CHECKPOINT_CONTACT


def _row_bytes(name: str) -> int:
    field = FIELDS[name]
    return np.dtype(field.dtype).itemsize * math.prod(field.row_shape)


# ---- memory --------------------------------------------------------------------------------


def rank_memory(scenario: Scenario, bodies: int, contacts: int, ranks: int) -> int:
    """Largest resident size [B] of a rank that has its share of bodies and contacts."""
    columns = 3 if frictional(scenario) else 1
    own_bodies, own_contacts = -(-bodies // ranks), -(-contacts // ranks)
    moving = any(wall.motion is not None for wall in scenario.walls)
    base = _BASE
    contact = _CONTACT + 8 * columns * (_CONTACT_VECTORS + moving) + 8 * min(columns, 2)
    if not only_spheres(scenario):
        contact += 32  # arms are vectors
    if scenario.contact.operator == "assembled":
        base += _PETSC
        # D^T has for each of two bodies 3 entries in the normal row and 6 in either tangent's.
        contact += _MATRIX_ENTRY * (30 if columns == 3 else 6) + _MATRIX_ROW * columns
    newton = scenario.contact.solver != "apgd"
    body = _BODY
    if newton:
        rows = _freedoms(scenario)
        base += _PETSC + _MUMPS + factor_share(scenario, bodies, contacts, ranks)
        contact += 8 * _NEWTON_VECTORS[columns == 3] + 2 * rows**2 * _NEWTON_ENTRY
        body += rows**2 * _NEWTON_ENTRY
    # Ghosts are one layer of neighbours around a cube of bodies.
    ghosts = min(round(6.0 * own_bodies ** (2.0 / 3.0)), bodies - own_bodies)
    return base + own_bodies * body + own_contacts * contact + ghosts * _GHOST


def factor_share(scenario: Scenario, bodies: int, contacts: int, ranks: int) -> int:
    """Memory [B] of a rank for the factorisation of a Newton matrix; 0 where none is made."""
    contact = scenario.contact
    if contact.solver == "apgd" or contact.scip.linear != "mumps":
        return 0
    sides = _sides(scenario)
    columns = 3 if frictional(scenario) else 1
    size = Size(
        contacts=contacts,
        bodies=bodies,
        largest=-(-contacts // ranks),
        columns=columns,
        rows=2 * columns if contact.scip.form == "contact" else _freedoms(scenario),
        elongation=1.0 if sides is None else elongation(np.maximum(sides, 1.0)),
        ranks=ranks,
    )
    return round(factor_memory(size) * (1.0 + contact.scip.workspace / 100.0))


def refuse_what_does_not_fit(scenario: Scenario, ranks: int, share: int) -> None:
    """Raise InputError where factors would need far more than they may, or a rank than `share` [B].

    With `solver: auto` they are made only where they fit.
    """
    refuse_what_exceeds_its_limit(scenario, ranks)
    lacking = shortage(scenario, ranks, share)
    if lacking:
        raise InputError(lacking)


def refuse_what_exceeds_its_limit(scenario: Scenario, ranks: int) -> None:
    """Raise InputError where factors would need far more than `contact.scip.memory` allows."""
    scip = scenario.contact.scip
    if scenario.contact.solver != "scip" or scip.memory is None:
        return
    factors = estimate(scenario, ranks).factors
    if factors > _DOUBT * scip.memory * 1e6:
        raise InputError(
            f"contact.scip.memory = {scip.memory:g} MB: factors of Newton matrices would take "
            f"about {factors / 1e6:.0f} MB a rank; raise it, {_remedy(scenario)}"
        )


def shortage(scenario: Scenario, ranks: int, share: int) -> str:
    """Say what a rank would need far more of than its `share` of memory [B]; "" if nothing."""
    if scenario.contact.solver != "scip":
        return ""
    found = estimate(scenario, ranks)
    if found.memory <= _DOUBT * share:
        return ""
    return (
        f"contact.solver = scip would take about {_size(found.memory)} a rank, "
        f"{_size(found.factors)} of it for factors of Newton matrices, and this machine has "
        f"{_size(share)}: {_remedy(scenario)}"
    )


def _remedy(scenario: Scenario) -> str:
    """What makes factors take less, or do without."""
    scip = scenario.contact.scip
    generous = scip.workspace > Scip().workspace and scip.linear == "mumps"
    less = f"lower contact.scip.workspace = {scip.workspace} %, " if generous else ""
    return f"{less}use more ranks, contact.scip.linear: cg, or contact.solver: auto"


def _freedoms(scenario: Scenario) -> int:
    return 6 if frictional(scenario) or not only_spheres(scenario) else 3


def _warnings(bodies: int, ranks: int) -> tuple[str, ...]:
    if ranks > bodies:
        return (f"{ranks - bodies} of {ranks} ranks would have no body",)
    return ()


def _size(size: int) -> str:
    """A size for people, in powers of 1024."""
    amount = float(size)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if amount < 1024.0:
            return f"{amount:.3g} {unit}" if unit != "B" else f"{size} B"
        amount /= 1024.0
    return f"{amount:.3g} TiB"
