"""A whole run: place or resume, step, record, checkpoint, stop when asked, report."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from dem_mpi import __version__, checkpoint
from dem_mpi.bodies import FIELDS, Bodies
from dem_mpi.errors import DemError, InputError, StoppedError
from dem_mpi.estimate import checkpoint_bytes, refuse_what_does_not_fit
from dem_mpi.h5files import OutputLock, require_space
from dem_mpi.insertion import changed_count
from dem_mpi.machine import memory_share
from dem_mpi.metrics import (
    PHASES,
    MetricsLog,
    Progress,
    SolverCounts,
    closing_table,
    resident_memory,
)
from dem_mpi.output import Field, Series, Trajectory, describe, frame_bytes
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import LoadedScenario, Scenario, body_count, difference, frictional
from dem_mpi.scene_bodies import removal_name
from dem_mpi.signals import StopRequest
from dem_mpi.simulation import Simulation, SolverFailureError, StepRecord, redistribute, start
from dem_mpi.state import State, restore, save
from dem_mpi.walls import wall_faces

if TYPE_CHECKING:
    from dem_mpi.compression import InSitu

_PATIENCE = 5.0  # seconds that ranks wait for each other when one reports an error
_MOST_CONTACTS = 4  # a body, in a bed of spheres that needs much space for its checkpoints


@dataclass(frozen=True)
class RunOptions:
    """How a run treats what is already in its directory.

    resume : continue from the newest valid checkpoint; force : replace an existing trajectory, or
    resume although the scene has changed
    """

    directory: Path
    resume: bool = False
    force: bool = False


def run(
    parallel: Parallel,
    loaded: LoadedScenario,
    options: RunOptions,
    stop: StopRequest,
    say: Callable[[str], None],
    on_stage: Callable[[str], None] = lambda stage: None,
) -> None:
    """Collective. Simulate a scene into `options.directory`; `say` prints a line for the user.

    Raises StoppedError (75) after a signal, with a checkpoint written, and whatever ended the run.
    `on_stage` is called between the stages of each checkpoint (tests end the process there).

    Errors for the user are meant to come on all ranks together; files are then closed. One that
    came on a single rank, and any other exception, leaves the files to the abort of all ranks:
    closing them needs every rank.
    """
    current = Run(parallel, loaded, options, say, on_stage)
    try:
        current.open()
        current.execute(stop)
    except DemError as error:
        if not parallel.all_arrive(_PATIENCE):
            raise RuntimeError(f"only this rank met: {error}") from error
        current.close()
        raise
    current.close()


class Run:
    """One run's files and its simulation."""

    def __init__(
        self,
        parallel: Parallel,
        loaded: LoadedScenario,
        options: RunOptions,
        say: Callable[[str], None],
        on_stage: Callable[[str], None],
    ) -> None:
        """Take what `open` and `execute` need."""
        self._started = perf_counter()
        self._options = options
        self._parallel, self._loaded, self._say = parallel, loaded, say
        self._on_stage = on_stage
        self._scenario = loaded.scenario
        self._directory = options.directory
        self._path = options.directory / loaded.scenario.output.path
        self._stem = self._path.stem
        self._fields = trajectory_fields(loaded.scenario)
        self._bodies = body_count(loaded.scenario)
        self._counts = SolverCounts()
        self._newest: Path | None = None  # checkpoint
        self._trajectory: Trajectory | None = None
        self._archive: InSitu | None = None
        self._metrics: MetricsLog | None = None
        self._simulation: Simulation | None = None

    # ---- start -----------------------------------------------------------------------------

    def open(self) -> None:
        """Collective. Place the bodies or read the checkpoint, and open the output."""
        parallel = self._parallel
        refuse_what_does_not_fit(self._scenario, parallel.size, memory_share(parallel))
        state, resumed = self._initial_state()
        self._check_space(self._scenario.steps - state.step)
        self._trajectory = self._open_trajectory(state, resumed)
        log = self._path.parent / "metrics.jsonl"
        self._metrics = MetricsLog(self._parallel, log, state.step if resumed else -1)
        self._simulation = Simulation(self._parallel, self._scenario, state)
        self._archive = self._open_archive(state, resumed)
        if not resumed:
            self._write_frame()

    def close(self) -> None:
        """Collective. Close what is open."""
        if self._metrics is not None:
            self._metrics.close()
        if self._trajectory is not None:
            self._trajectory.close()
        if self._archive is not None:
            self._archive.abandon()
        if self._simulation is not None:
            self._simulation.destroy()

    def _initial_state(self) -> tuple[State, bool]:
        parallel, options = self._parallel, self._options
        if options.resume:
            found = checkpoint.find(parallel, self._path.parent, self._stem)
            for skipped in found.skipped if found else ():
                self._say(f"skipped {skipped.path.name}: {skipped.reason}")
            if found is not None:
                state, scene = restore(parallel, found.path)
                self._compare_scene(scene, found.path, options.force)
                if state.partition.ranks != parallel.size:
                    state = redistribute(parallel, state)
                self._newest = found.path
                self._say(f"resuming from {found.path.name}, step {state.step}")
                return state, True
            self._refuse_to_repeat()
            self._say(f"no checkpoint in {self._path.parent}: starting from the beginning")
        else:
            self._refuse_to_replace()
        arrays = place(parallel, self._scenario)
        density = [material.density for material in self._scenario.materials.values()]
        state = start(parallel, Bodies.from_arrays(arrays, density))
        spinning = parallel.any(bool(state.bodies.angular_velocity.any()))
        state.rotating = spinning or frictional(self._scenario)
        return state, False

    def _refuse_to_replace(self) -> None:
        """Collective. Raise if a run is there already, or its archive, or checkpoints of one."""
        outputs, section = [self._path], self._scenario.compress
        if section is not None:
            outputs.append(self._path.parent / section.path)
        present = [path for path in outputs if path.exists()]
        present += self._path.parent.glob(f"{self._stem}.checkpoint.*.h5")
        first = self._parallel.broadcast(present[0] if present else None)
        if first is not None and not self._options.force:
            raise InputError(
                f"{first} exists: --resume continues that run, --force replaces it, "
                f"--out DIR writes elsewhere"
            )

    def _refuse_to_repeat(self) -> None:
        """Collective. Raise if there is nothing to resume but a finished trajectory to lose."""
        complete = False
        if self._parallel.rank == 0 and self._path.exists():
            complete = describe(self._path, verify=False).complete
        if self._parallel.broadcast(complete) and not self._options.force:
            raise InputError(
                f"{self._path} is complete and has no checkpoint to go on from: --force with "
                f"--resume starts again from the beginning"
            )

    def _compare_scene(self, stored: dict[str, Any], path: Path, force: bool) -> None:
        """Raise if the scene has changed, and is not meant to or cannot be resumed any more."""
        changed = changed_count(self._scenario, [group["count"] for group in stored["bodies"]])
        if changed:
            raise InputError(
                f"{self._loaded.path}: {changed} when {path.name} was written; bodies that come in "
                f"would take the gids of others. Take the change back, or add groups at the end"
            )
        changes = difference(stored, self._loaded.effective)
        if not changes:
            return
        listing = "\n  ".join(changes)
        if not force:
            raise InputError(
                f"{self._loaded.path}: the scene has changed since {path.name} was written:\n  "
                f"{listing}\nTake the changes back, or use --force to resume with them"
            )
        self._say(f"resuming with a changed scene:\n  {listing}")

    def _check_space(self, steps: int) -> None:
        """Collective. Refuse to start what the disk cannot hold."""
        frames = steps // self._scenario.output_every + 1
        needed = frames * frame_bytes(self._fields, self._bodies)
        # One more than is kept: the oldest goes only when the newest is in place.
        saved = steps // self._scenario.checkpoint_every + 1
        kept = min(self._scenario.checkpoint.keep + 1, saved)
        needed += kept * checkpoint_bytes(self._bodies, _MOST_CONTACTS * self._bodies)
        error = None
        if self._parallel.rank == 0:
            try:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                require_space(self._path, needed)
            except Exception as caught:
                error = caught
        self._parallel.raise_together(error)

    def _provenance(self) -> dict[str, Any]:
        """Where the files of the run come from."""
        return {
            "name": self._scenario.name,
            "scene": _json(self._loaded.effective),
            "scene_file": self._loaded.text,
            "version": __version__,
            "seed": self._scenario.seed,
            "units": "SI: m, kg, s, N s, J",
        }

    def _open_archive(self, state: State, resumed: bool) -> InSitu | None:
        """Collective. The archive that the scene asks for; nothing of it is imported otherwise."""
        section = self._scenario.compress
        if section is None:
            state.pending = None
            return None
        from dem_mpi.compression import InSitu

        path = self._path.parent / section.path
        common = (self._parallel, path, section, self._scenario.time.step, self._provenance())
        if not resumed:
            return InSitu.create(*common)
        archive, message = InSitu.resume(*common, state.pending)
        if message:
            self._say(message)
        state.pending = None  # the archive has it now
        return archive

    def _open_trajectory(self, state: State, resumed: bool) -> Trajectory:
        scenario = self._scenario
        attributes = {**self._provenance(), "walls": " ".join(wall_faces(scenario).name)}
        common = {
            "bodies": self._bodies,
            "series": wall_series(scenario),
            "compression": scenario.output.compression,
        }
        if not resumed:
            self._discard_checkpoints()
            return Trajectory.create(self._parallel, self._path, self._fields, attributes, **common)
        trajectory = Trajectory.open_for_append(
            self._parallel, self._path, self._fields, attributes, last_step=state.step, **common
        )
        if trajectory.message:
            self._say(trajectory.message)
        return trajectory

    def _discard_checkpoints(self) -> None:
        """Collective. A new run begins: no checkpoint of an earlier one may outlive its start."""
        lock = OutputLock(self._parallel, self._path)  # not those of a run that is going on
        try:
            checkpoint.remove_others(self._parallel, self._path.parent, self._stem, -1, keep=0)
        finally:
            lock.release()

    # ---- the loop --------------------------------------------------------------------------

    def execute(self, stop: StopRequest) -> None:
        """Collective. Step to the end, to rest, or to a stop."""
        simulation, state = self._simulation, self._simulation.state
        progress = Progress(self._parallel, state.step, self._scenario.steps, state.flagged)
        try:
            while state.step < self._scenario.steps and not self._at_rest():
                record = simulation.step()
                self._note_rest(record)
                self._counts.add(
                    record.solver, record.iterations, record.factorisations, record.outer
                )
                self._record(record)
                progress.show(asdict(record), self._scenario.time.end, state.flagged)
                if self._parallel.any(stop.requested):
                    self._stop(progress, stop)
        except SolverFailureError as error:
            progress.finish()
            if error.intact:
                self._say(f"state before the failed step kept in {self._save().name}")
            elif self._newest is not None:
                self._say(f"the newest checkpoint is {self._newest.name}")
            self._flush_archive()
            raise
        progress.finish()
        self._flush_archive()
        self._save()
        self._trajectory.seal({"steps": state.step, "flagged_steps": state.flagged})
        if self._archive is not None:
            self._archive.close()
        self._report()

    def _stop(self, progress: Progress, stop: StopRequest) -> None:
        """Collective. Save and raise StoppedError."""
        progress.finish()
        path = self._save()
        self._flush_archive()
        self._report()
        names = [name for name in self._parallel.gather(stop.name) or [] if name]
        name = self._parallel.broadcast(names[0] if names else "")
        raise StoppedError(
            f"stopped by {name or 'a signal'} after step {self._simulation.state.step}; "
            f"{path.name} is saved: run the same command with --resume"
        )

    def _at_rest(self) -> bool:
        rest = self._scenario.time.stop_at_rest
        return rest is not None and self._simulation.state.steps_at_rest >= rest.steps

    def _note_rest(self, record: StepRecord) -> None:
        rest, state = self._scenario.time.stop_at_rest, self._simulation.state
        if rest is None:
            return
        resting = (
            record.largest_speed < rest.max_speed and record.kinetic_speed < rest.kinetic_speed
        )
        resting = resting and not self._simulation.expected
        state.steps_at_rest = state.steps_at_rest + 1 if resting else 0

    # ---- records ---------------------------------------------------------------------------

    def _record(self, record: StepRecord) -> None:
        """Collective. The frame, the line of metrics and the checkpoint that this step is due."""
        timer = self._simulation.timer
        last = record.step == self._scenario.steps or self._at_rest()
        if record.step % self._scenario.output_every == 0 or last:
            self._write_frame()
        seconds = self._parallel.max(timer.step)
        memory = self._parallel.max(resident_memory())
        line = asdict(record)
        if not record.walls:
            del line["walls"]
        line["seconds"] = {
            name: round(float(s), 6) for name, s in zip(PHASES, seconds, strict=True)
        }
        line["memory"] = memory
        self._metrics.write(line)
        timer.finish_step()
        # Last, since a resumed run writes no line of metrics and no frame of a step it has saved.
        if record.step % self._scenario.checkpoint_every == 0 and not last:
            with timer.phase("record"):  # of the next step
                self._save()

    def _write_frame(self) -> None:
        """Collective. A frame of the trajectory, and of the archive if there is one."""
        state, timer = self._simulation.state, self._simulation.timer
        time = state.step * self._scenario.time.step
        with timer.phase("record"):
            position = self._simulation.wrapped_position()
            columns = {**state.bodies.arrays(), "position": position}
            impulse, elapsed = self._simulation.take_wall_impulse()
            mean = impulse / elapsed if elapsed > 0.0 else impulse
            reactions = {"walls/force": mean[:, :3], "walls/torque": mean[:, 3:]}
            self._trajectory.write_frame(state.step, time, columns, reactions)
        if self._archive is not None:
            with timer.phase("compress"):
                self._archive.record(state.step, time, columns)

    def _flush_archive(self) -> None:
        """Collective. Archive the frames that wait: no more may come for a while."""
        if self._archive is not None:
            with self._simulation.timer.phase("compress"):
                self._archive.flush()

    def _save(self) -> Path:
        """Collective. Checkpoint; the frames before it reach the disk first."""
        self._trajectory.sync()
        state = self._simulation.state
        state.pending = None if self._archive is None else self._archive.pending
        self._newest = save(
            self._parallel,
            state,
            self._path.parent,
            self._stem,
            self._loaded.effective,
            __version__,
            self._scenario.checkpoint.keep,
            time=state.step * self._scenario.time.step,
            on_stage=self._on_stage,
        )
        state.pending = None  # a copy that is as large as the frames that wait
        return self._newest

    def _report(self) -> None:
        state = self._simulation.state
        self._simulation.timer.finish_step()
        facts = [f"{self._trajectory.frames} frames in {self._path}"]
        if state.flagged:
            facts.append(f"{state.flagged} steps missed their tolerance and are flagged")
        if self._archive is not None:
            facts += self._archive.facts()
        facts += self._counts.facts() + self._comings_and_goings()
        closing_table(self._parallel, self._simulation.timer, perf_counter() - self._started, facts)

    def _comings_and_goings(self) -> list[str]:
        """What to report of bodies that came in, are still to come, and were taken out."""
        state, regions = self._simulation.state, self._scenario.removal
        facts = []
        if state.inserted.any() or self._simulation.expected:
            missing = self._simulation.expected
            still = f", {missing} have not come in yet" if missing else ""
            facts.append(f"{int(state.inserted.sum())} bodies were inserted{still}")
        for k, (count, mass) in enumerate(zip(state.taken, state.taken_mass, strict=True)):
            if k < len(regions):
                name = removal_name(regions[k], k)
                facts.append(f"{count} bodies, {mass:.6g} kg, were removed in '{name}'")
        left = state.removed - int(state.taken.sum())
        if left:
            facts.append(f"{left} bodies left the domain and were removed")
        return facts


def trajectory_fields(scenario: Scenario) -> tuple[Field, ...]:
    """Return the columns that the scene wants in its trajectory, with their units."""
    columns = []
    for name in scenario.output.fields:
        field = FIELDS[name]
        width = field.row_shape[0] if field.row_shape else 1
        columns.append(Field(name, _code(field.dtype), width, field.unit))
    return tuple(columns)


def wall_series(scenario: Scenario) -> tuple[Series, ...]:
    """Return the reactions of the walls that stand in the trajectory, none without walls."""
    faces = len(wall_faces(scenario).name)
    if not faces:
        return ()
    return (Series("walls/force", (faces, 3), "N"), Series("walls/torque", (faces, 3), "N m"))


def _code(dtype: Any) -> str:
    return np.dtype(dtype).str.lstrip("<=|")


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value)
