"""Everything a run needs to go on bit for bit, and its way into a checkpoint and back."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi import checkpoint
from dem_mpi.bodies import FIELDS, Bodies, ImpulseMemory
from dem_mpi.contacts import Reference
from dem_mpi.errors import DataError
from dem_mpi.frame_buffer import PendingFrames
from dem_mpi.parallel import Parallel
from dem_mpi.partition import Partition

_RAGGED = {"impulses": ("bodies", "impulse_count")}
# What a stored state holds; raised with every change of it. 2: bodies of several shapes.
_LAYOUT = 2


@dataclass
class State:
    """The bodies of this rank and all that later steps depend on.

    memory      : impulses of the last step, for warm starts; made with step `memory_step` [s]
    reference   : where the standing list of near pairs was made; None asks for a new one
    lipschitz   : step-size constant of the last solve
    deepest     : overlap that the run started with, in radii of the smaller body
    rotating    : whether orientations change at all
    balanced    : imbalance that the last new splitters reached
    wall_impulse: (w, 6) impulse [N s] and torque impulse [N m s] that each face took, on all ranks
    wall_time   : time [s] in which it did, since they were last taken for output
    flagged     : steps that missed their tolerance
    inserted    : (groups,) bodies of each group that came in during the run
    removed, removed_mass : bodies taken out so far, and their mass [kg]
    taken, taken_mass     : the same by removal region; the rest left the domain
    pending     : frames that wait to be compressed; None where nothing is compressed
    """

    bodies: Bodies
    memory: ImpulseMemory
    partition: Partition
    reference: Reference | None = None
    step: int = 0
    memory_step: float = 0.0
    lipschitz: float = 0.0
    deepest: float = -1.0
    rotating: bool = True
    flagged: int = 0
    inserted: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    removed: int = 0
    removed_mass: float = 0.0
    taken: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    taken_mass: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    steps_at_rest: int = 0
    balanced: float = 1.0
    wall_impulse: NDArray = field(default_factory=lambda: np.zeros((0, 6)))
    wall_time: float = 0.0
    pending: PendingFrames | None = None


def save(
    parallel: Parallel,
    state: State,
    directory: Path,
    stem: str,
    effective: dict[str, Any],
    version: str,
    keep: int,
    time: float,
    **options: Any,
) -> Path:
    """Collective. Write the state at `time` [s] as a checkpoint and return its path."""
    bodies = dict(state.bodies.arrays())
    bodies["impulse_count"] = np.diff(state.memory.offsets)
    reference = state.reference
    if reference is not None:
        bodies["reference_position"] = reference.position
        bodies["reference_reach"] = reference.reach
    partition = state.partition
    shared = {
        "origin": partition.origin,
        "splitter_key": partition.splitter_key,
        "splitter_gid": partition.splitter_gid,
        "wall_impulse": state.wall_impulse,
        "reference_frame": reference.frame if reference is not None else np.zeros(3),
        "inserted": state.inserted,
        "taken": state.taken,
        "taken_mass": state.taken_mass,
    }
    attributes = {
        "layout": _LAYOUT,
        "scene": json.dumps(effective),
        "version": version,
        "time": time,
        "edge": partition.edge,
        "memory_step": state.memory_step,
        "lipschitz": state.lipschitz,
        "deepest": state.deepest,
        "rotating": int(state.rotating),
        "flagged": state.flagged,
        "removed": state.removed,
        "removed_mass": state.removed_mass,
        "steps_at_rest": state.steps_at_rest,
        "balanced": state.balanced,
        "wall_time": state.wall_time,
    }
    groups = {
        "bodies": bodies,
        "impulses": {"other": state.memory.other, "impulse": state.memory.impulse},
    }
    if state.pending is not None:
        attributes["archived"] = state.pending.archived
        if len(state.pending.step):
            groups["pending"] = state.pending.rows
            shared |= {"pending_step": state.pending.step, "pending_time": state.pending.time}
    return checkpoint.write(
        parallel, directory, stem, state.step, groups, shared, attributes,
        ragged=_RAGGED, keep=keep, **options,
    )  # fmt: skip


def restore(parallel: Parallel, path: Path) -> tuple[State, dict[str, Any]]:
    """Collective. Read a checkpoint; return the state and the effective scene it was made by.

    On as many ranks as wrote it the state is the written one, bit for bit. On another number each
    rank has an equal slice of the bodies, the partition is the old one and the reference is gone:
    the caller divides them anew.
    """
    stored = checkpoint.read(parallel, path)
    _check_layout(stored, path)
    try:
        state = _state_of(stored, parallel)
        scene = json.loads(stored.attributes["scene"])
        problem = None
    except (KeyError, ValueError) as error:
        problem = DataError(f"{path}: not a state of this program: {error}")
    parallel.raise_together(problem)
    return state, scene


def _check_layout(stored: checkpoint.Checkpoint, path: Path) -> None:
    """Raise DataError, alike on all ranks, for a state stored by an older or a newer program."""
    layout = stored.attributes.get("layout", 1)
    if layout != _LAYOUT:
        version = stored.attributes.get("version", "an unknown version")
        raise DataError(
            f"{path}: state of layout {layout}, by dem-mpi {version}; this program reads layout "
            f"{_LAYOUT}: resume with that version, or start the run anew with --force"
        )


def _state_of(stored: checkpoint.Checkpoint, parallel: Parallel) -> State:
    rows, shared, attributes = stored.groups["bodies"], stored.shared, stored.attributes
    bodies = Bodies(**{name: rows[name] for name in FIELDS})
    offsets = np.concatenate(([0], np.cumsum(rows["impulse_count"], dtype=np.int64)))
    impulses = stored.groups["impulses"]
    reference = None
    if stored.ranks == parallel.size and "reference_position" in rows:
        reference = Reference(
            rows["reference_position"], rows["reference_reach"], shared["reference_frame"]
        )
    return State(
        bodies=bodies,
        memory=ImpulseMemory(offsets, impulses["other"], impulses["impulse"]),
        partition=Partition(
            shared["origin"],
            float(attributes["edge"]),
            shared["splitter_key"],
            shared["splitter_gid"],
        ),
        reference=reference,
        step=stored.step,
        memory_step=float(attributes["memory_step"]),
        lipschitz=float(attributes["lipschitz"]),
        deepest=float(attributes["deepest"]),
        rotating=bool(attributes["rotating"]),
        flagged=int(attributes["flagged"]),
        inserted=shared["inserted"],
        removed=int(attributes["removed"]),
        removed_mass=float(attributes["removed_mass"]),
        taken=shared["taken"],
        taken_mass=shared["taken_mass"],
        steps_at_rest=int(attributes["steps_at_rest"]),
        balanced=float(attributes["balanced"]),
        wall_impulse=shared["wall_impulse"],
        wall_time=float(attributes["wall_time"]),
        pending=_pending_of(stored),
    )


def _pending_of(stored: checkpoint.Checkpoint) -> PendingFrames | None:
    if "archived" not in stored.attributes:
        return None
    archived = int(stored.attributes["archived"])
    if "pending" not in stored.groups:
        return PendingFrames(archived, np.zeros(0, np.int64), np.zeros(0), {})
    shared = stored.shared
    return PendingFrames(
        archived, shared["pending_step"], shared["pending_time"], stored.groups["pending"]
    )
