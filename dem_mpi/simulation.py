"""One time step, and the loop over them.

migrate -> ghosts -> contacts -> assemble D, M^-1, b -> cone solve -> v+ = v_hat + M^-1 D gamma ->
q+ = q + h L v+ -> record.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dem_mpi import _kernels_solver as kernels
from dem_mpi import insertion, integrator, shapes
from dem_mpi.bodies import Bodies, ImpulseMemory
from dem_mpi.cone import ConeProblem, median_of_positive
from dem_mpi.contacts import (
    ContactSet,
    DetectionOptions,
    Neighbours,
    PeriodTooShortError,
    Reference,
    contact_velocity_of_walls,
    find_contacts,
    find_neighbours,
    recall_impulses,
    remember_impulses,
    wall_impulses,
)
from dem_mpi.errors import DemError
from dem_mpi.metrics import PhaseTimer
from dem_mpi.narrow_phase import find_general_contacts
from dem_mpi.operators import Assembled, MatrixFree, world_inverse_inertia
from dem_mpi.parallel import Parallel
from dem_mpi.partition import balance, imbalance, migrate
from dem_mpi.periodic import AXES, PeriodicBox
from dem_mpi.scenario import Scenario, friction_table, frictional
from dem_mpi.scene_models import only_spheres
from dem_mpi.solvers.choice import SolverOptions, make_solver
from dem_mpi.solvers.result import SolveReport
from dem_mpi.solvers.work import elongation_of
from dem_mpi.state import State
from dem_mpi.walls import Walls, wall_faces, walls_at

_IMBALANCE_LIMIT = 1.15  # max/mean of bodies + contacts that asks for new splitters
_SHORTEST_STEP = 64  # shrink_step halves a step down to h / 64
_RUNAWAY_OVERLAP = 0.5  # radii of the smaller body


class SolverFailureError(DemError):
    """The run cannot go on from this step; the state before the step is kept, see `step`.

    `intact` tells whether that state is worth a checkpoint.
    """

    def __init__(self, message: str, intact: bool = True) -> None:
        super().__init__(message)
        self.intact = intact


@dataclass(frozen=True)
class StepRecord:
    """What one time step did, the same on every rank. Energies in J, residuals as in `cone`.

    energy_change is KE(v+) - KE(v_hat), energy_balance the same from the contact side:
    -gamma.N gamma/2 + gamma.g - sum gamma_n b_phi - gamma.b_wall; the two agree to round-off.
    wall_work is -gamma.b_wall, what the walls do on the bodies. walls holds by name the mean force
    [N] on each face, and its torque [N m] about the centre of its rotation or else its point.
    """

    step: int
    time: float
    bodies: int
    contacts: int
    solver: str
    iterations: int
    products: int
    factorisations: int
    outer: int
    form: str
    factor_entries: int
    linear_residual: float
    refinements: int
    linear_iterations: int
    converged: bool
    reason: str
    r_p: float
    r_d: float
    r_c: float
    objective: float
    v_ref: float
    gamma_ref: float
    kinetic_energy: float
    kinetic_speed: float
    largest_speed: float
    energy_change: float
    energy_balance: float
    wall_work: float
    walls: dict[str, list[float]]
    overlap: float
    coincident: int
    outside: int
    waiting: int
    removed: int
    removed_mass: float
    substeps: int
    rejected: int
    rebuilt: bool
    moved: int
    ghosts: int
    imbalance: float
    bytes_sent: int


@dataclass
class _Effort:
    """Sums over all solves of a step, also of those whose outcome was thrown away."""

    solves: int = 0
    iterations: int = 0
    products: int = 0
    factorisations: int = 0
    outer: int = 0
    refinements: int = 0
    linear_iterations: int = 0
    linear_residual: float = 0.0

    def add(self, report: SolveReport) -> None:
        """Count one solve."""
        self.solves += 1
        self.iterations += report.iterations
        self.products += report.products
        self.factorisations += report.factorisations
        self.outer += report.outer
        self.refinements += report.refinements
        self.linear_iterations += report.linear_iterations
        self.linear_residual = max(self.linear_residual, report.linear_residual)


@dataclass(frozen=True)
class _Posed:
    """The cone problem of a step and what it was made from; predicted is v_hat (n, 3)."""

    contacts: ContactSet
    operator: MatrixFree | Assembled
    problem: ConeProblem
    guess: NDArray
    predicted: NDArray
    b_gap: NDArray
    b_wall: NDArray | None
    walls: Walls
    overlap: float


@dataclass(frozen=True)
class _Substep:
    """A solved but not yet accepted step of length h; wall_impulse (w, 6) as in `State`."""

    step: float
    contacts: ContactSet
    report: SolveReport
    problem: ConeProblem
    velocity: NDArray
    angular_velocity: NDArray
    energy_before: float
    energy_after: float
    energy_balance: float
    wall_work: float
    wall_impulse: NDArray
    overlap: float

    @property
    def failed(self) -> bool:
        return not self.report.converged


class Simulation:
    """Advances a `State` by whole time steps. Every method that steps is collective."""

    def __init__(self, parallel: Parallel, scenario: Scenario, state: State) -> None:
        """Collective. Take over a state; a resumed one gets the pair list it had."""
        self.parallel = parallel
        self.scenario = scenario
        self.state = state
        self.timer = PhaseTimer()
        self.frictional = frictional(scenario)
        self._columns = 3 if self.frictional else 1
        # Normal impulses turn bodies that are not spheres: these always have six freedoms.
        self._general = not only_spheres(scenario)
        state.rotating = state.rotating or self._general
        self._gravity = np.array(scenario.gravity)
        self._faces = wall_faces(scenario)
        self._reserved = insertion.reserved_gids(scenario)
        if state.wall_impulse.shape[0] != len(self._faces.name):
            state.wall_impulse, state.wall_time = np.zeros((len(self._faces.name), 6)), 0.0
        contact = scenario.contact
        self._detection = self._detection_options()
        options = SolverOptions.of(contact)
        self._tolerance = options.tolerance
        self._solver = make_solver(options)
        self._neighbours: Neighbours | None = None
        if state.reference is not None:
            self._neighbours = find_neighbours(
                parallel, state.partition, state.bodies, state.reference, self._detection
            )
        self._operator: MatrixFree | Assembled | None = None
        self._rebuilt, self._moved = False, 0
        self._effort = _Effort()

    # ---- one step --------------------------------------------------------------------------

    def step(self) -> StepRecord:
        """Collective. Advance by one time step and return what it did.

        Raises SolverFailureError on all ranks if a value is not a number, an overlap runs away, or
        the solver misses its tolerance by more than the scene allows. Then no body has moved, and
        time and impulses are those before the step; bodies that were due at its beginning have
        come in, and are counted: a checkpoint of that state goes on without inserting them again.
        """
        state, h = self.state, self.scenario.time.step
        self._rebuilt, self._moved = False, 0
        self._effort = _Effort()
        sent = self.parallel.bytes_sent
        time = state.step * h
        waiting = self._let_in(time)
        done = self._advance(time, h)
        state.step += 1
        state.wall_impulse = state.wall_impulse + sum(s.wall_impulse for s in done)
        state.wall_time += h
        outside = self._take_out()
        record = self._record(done, outside, waiting, self.parallel.bytes_sent - sent)
        if not record.converged:
            state.flagged += 1
        return record

    def _advance(self, time: float, h: float) -> list[_Substep]:
        """Collective. Solve and accept a step, in halves if it fails and the scene says so."""
        substep = self._solve_step(time, h)
        if substep.failed:
            policy = self.scenario.contact.on_failure
            shortest = h <= self.scenario.time.step / _SHORTEST_STEP
            if policy == "shrink_step" and not shortest:
                return self._advance_by_halves(time, h)
            self._refuse(substep, stop=policy != "continue_and_flag")
        self._accept(substep)
        return [substep]

    def _advance_by_halves(self, time: float, h: float) -> list[_Substep]:
        """Collective. Two half steps, or the state as it was before the first one."""
        state, half = self.state, 0.5 * h
        every = np.arange(len(state.bodies))
        kept = replace(state, bodies=state.bodies.take(every)), self._neighbours
        try:
            return self._advance(time, half) + self._advance(time + half, half)
        except SolverFailureError:
            self.state, self._neighbours = kept
            raise

    def _solve_step(self, time: float, h: float) -> _Substep:
        """Collective. Everything of a step but its effect on the bodies."""
        posed = self._pose(time, h)
        with self.timer.phase("solve"):
            report = self._solver.solve(posed.problem, posed.guess, self.state.lipschitz)
        self._effort.add(report)
        with self.timer.phase("advance"):
            # v+ = v_hat + M^-1 D gamma
            bodies, spin = self.state.bodies, self.state.bodies.angular_velocity
            u = posed.operator.body_velocity(report.impulse)[: len(bodies)]
            new_velocity = posed.predicted + u[:, :3]
            new_spin = spin + u[:, 3:] if u.shape[1] == 6 else spin
            before = integrator.kinetic_energy(bodies, posed.predicted, spin)
            after = integrator.kinetic_energy(bodies, new_velocity, new_spin)
            work = 0.0 if posed.b_wall is None else -float(np.sum(report.impulse * posed.b_wall))
            balance_terms = _energy_balance(posed.problem, report, posed.b_gap, work)
            reaction = wall_impulses(posed.contacts, bodies.position, posed.walls, report.impulse)
            sums = np.concatenate(([before, after, balance_terms, work], reaction.ravel()))
            self.parallel.sum_in_place(sums)
        return _Substep(
            h, posed.contacts, report, posed.problem, new_velocity, new_spin,
            float(sums[0]), float(sums[1]), float(sums[2]), float(sums[3]),
            sums[4:].reshape(reaction.shape), posed.overlap,
        )  # fmt: skip

    def pose(self) -> tuple[ConeProblem, NDArray]:
        """Collective. The cone problem of the next step and the warm start it would begin from.

        Bodies may migrate and the pair list may be made anew, as in a step; nothing moves.
        """
        h = self.scenario.time.step
        posed = self._pose(self.state.step * h, h)
        return posed.problem, posed.guess

    def _pose(self, time: float, h: float) -> _Posed:
        """Collective. Find the contacts of a step and set up their cone problem."""
        timer = self.timer
        self._check_finite()
        self._update_neighbours(h)
        bodies, neighbours = self.state.bodies, self._neighbours
        assert neighbours is not None
        walls = walls_at(self._faces, time, h)
        with timer.phase("contacts"):
            # v_hat = v + h M^-1 f_ext
            predicted = integrator.predict(bodies, self._gravity, h)
            position = neighbours.extend_position(bodies.position)
            velocity = neighbours.extend(predicted)
            spin = self._extend_spin(neighbours)
            inverse_inertia = neighbours.inverse_inertia
            surroundings = (velocity, spin, walls, self._detection, h)
            if self._general:
                threads = self.scenario.threads
                axis = neighbours.extend(integrator.symmetry_axes(bodies, threads))
                inverse_inertia = world_inverse_inertia(axis, inverse_inertia, threads)
                contacts = find_general_contacts(neighbours, position, axis, *surroundings)
            else:
                contacts = find_contacts(neighbours, position, *surroundings)
        with timer.phase("assemble"):
            operator = self._make_operator(contacts, neighbours, inverse_inertia)
            problem, b_gap, b_wall, overlap = self._make_problem(
                operator, contacts, velocity, spin, walls, h
            )
            self._check_runaway(contacts, overlap)
            guess = self._guess(contacts, h)
        return _Posed(contacts, operator, problem, guess, predicted, b_gap, b_wall, walls, overlap)

    def _accept(self, substep: _Substep) -> None:
        """Collective. Give the bodies new velocities, move them, and remember the impulses."""
        state = self.state
        self._check_new_velocity(substep)
        with self.timer.phase("advance"):
            integrator.advance(
                state.bodies,
                substep.velocity,
                substep.angular_velocity,
                substep.step,
                state.rotating,
                self.scenario.threads,
            )
            state.memory = remember_impulses(
                substep.contacts, substep.report.impulse, self.scenario.threads
            )
            state.memory_step = substep.step
            state.lipschitz = substep.report.lipschitz
            if state.deepest < 0.0:
                state.deepest = substep.overlap

    # ---- partition and pair list -----------------------------------------------------------

    def _detection_options(self) -> DetectionOptions:
        """Collective. Margin, skin and friction of pair lists of the bodies present and to come."""
        contact = self.scenario.contact
        to_come = insertion.thinnest_to_come(self.scenario)
        smallest = float(self.state.bodies.smallest_size.min(initial=to_come))
        return DetectionOptions(
            margin=contact.margin,
            skin=contact.skin * _finite(self.parallel.min(smallest)),
            friction=friction_table(self.scenario)[1],
            threads=self.scenario.threads,
            box=PeriodicBox.of(self.scenario.domain),
            general=self._general,
        )

    def _update_neighbours(self, h: float) -> None:
        """Collective. Migrate and list near pairs anew if the standing list may miss one."""
        state, options = self.state, self._detection
        with self.timer.phase("neighbours"):
            predicted = integrator.predict(state.bodies, self._gravity, h)
            if self._neighbours is not None:
                drift = self._neighbours.reference.drift(state.bodies, predicted, options, h)
                if self.parallel.max(drift) <= 0.5 * options.skin:
                    return
        self._rebuilt = True
        with self.timer.phase("partition"):
            state.bodies.position = self.wrapped_position()
            self._repartition()
        with self.timer.phase("neighbours"):
            predicted = integrator.predict(state.bodies, self._gravity, h)
            state.reference = Reference.of(self.parallel, state.bodies, predicted, options, h)
            try:
                self._neighbours = find_neighbours(
                    self.parallel, state.partition, state.bodies, state.reference, options
                )
            except PeriodTooShortError as error:
                self.forget_neighbours()
                raise SolverFailureError(f"step {state.step + 1}: {error}") from None

    def wrapped_position(self) -> NDArray:
        """Positions (n, 3) [m] of this rank's bodies within the periodic box.

        Between two lists of near pairs bodies move past the faces of the box, so that lists and
        displacements stay valid.
        """
        position, box = self.state.bodies.position, self._detection.box
        return position if box is None else box.wrap(position)

    def _repartition(self) -> None:
        """Collective. Send strayed bodies home; move the splitters if the load asks for it."""
        state, parallel = self.state, self.parallel
        state.bodies, state.memory, moved = migrate(
            parallel, state.partition, state.bodies, state.memory
        )
        self._moved += moved
        weights = 1 + np.diff(state.memory.offsets)
        load = imbalance(parallel, float(weights.sum()))
        # Few bodies on many ranks cannot be balanced: only ask for more than was once reached.
        if load > max(_IMBALANCE_LIMIT, _IMBALANCE_LIMIT * state.balanced):
            partition = balance(parallel, state.bodies, weights)
            state.partition = partition
            state.bodies, state.memory, moved = migrate(
                parallel, partition, state.bodies, state.memory
            )
            self._moved += moved
            weights = 1 + np.diff(state.memory.offsets)
            state.balanced = imbalance(parallel, float(weights.sum()))

    def forget_neighbours(self) -> None:
        """Make the next step list near pairs anew, as it does when bodies have moved far."""
        self.state.reference, self._neighbours = None, None

    # ---- coming and going ------------------------------------------------------------------

    @property
    def expected(self) -> int:
        """Number of bodies that are still to come in."""
        return insertion.total_to_come(self.scenario) - int(self.state.inserted.sum())

    def _let_in(self, time: float) -> int:
        """Collective. Insert the bodies that are due and find a place; return how many wait."""
        state = self.state
        if not self.expected:
            return 0
        with self.timer.phase("partition"):
            walls = walls_at(self._faces, time, self.scenario.time.step)
            arrivals = insertion.arrive(
                self.parallel, self.scenario, self._reserved, state, walls, time
            )
            arrived = int(arrivals.inserted.sum() - state.inserted.sum())
            state.inserted = arrivals.inserted
            if arrived:
                memory = ImpulseMemory.empty(len(arrivals.bodies))
                state.bodies = Bodies.concatenate([state.bodies, arrivals.bodies])
                state.memory = ImpulseMemory.concatenate([state.memory, memory])
                state.rotating = state.rotating or arrivals.spinning
                self.forget_neighbours()
        return arrivals.waiting

    def _take_out(self) -> int:
        """Collective. Take bodies out by their centres: those in a removal region, and those
        outside the domain if the scene says so. Return how many are outside, removed or not.
        """
        state, domain, regions = self.state, self.scenario.domain, self.scenario.removal
        position = self.wrapped_position()
        # One row a region, and the last for the domain; a body is in the first that has it.
        gone = np.zeros((len(regions) + 1, len(state.bodies)), dtype=bool)
        for row, region in zip(gone, regions, strict=False):
            row[:] = np.all((position >= region.min) & (position <= region.max), axis=1)
        within = (position >= domain.min) & (position <= domain.max)
        within[:, [axis in domain.periodic for axis in AXES]] = True
        gone[-1] = ~within.all(axis=1)
        gone[1:] &= ~np.logical_or.accumulate(gone, axis=0)[:-1]
        count = self.parallel.sum(np.count_nonzero(gone, axis=1))
        outside = int(count[-1])
        if domain.on_leave == "keep":
            gone[-1], count[-1] = False, 0
        if count.any():
            self._remove(gone, count)
        return outside

    def _remove(self, gone: NDArray, count: NDArray) -> None:
        """Collective. Remove bodies: `gone` (regions + 1, n) bool, `count` on all ranks."""
        state, regions = self.state, len(gone) - 1
        mass = self.parallel.sum(np.array([state.bodies.mass[row].sum() for row in gone]))
        stay = np.flatnonzero(~gone.any(axis=0))
        state.bodies, state.memory = state.bodies.take(stay), state.memory.take(stay)
        state.removed += int(count.sum())
        state.removed_mass += float(mass.sum())
        if len(state.taken) != regions:  # a first step, or a changed scene
            state.taken, state.taken_mass = np.zeros(regions, np.int64), np.zeros(regions)
        state.taken = state.taken + count[:-1]
        state.taken_mass = state.taken_mass + mass[:-1]
        self.forget_neighbours()
        # A run resumed from here would know the remaining bodies alone.
        self._detection = self._detection_options()

    # ---- the cone problem ------------------------------------------------------------------

    def _extend_spin(self, neighbours: Neighbours) -> NDArray:
        """Collective. Angular velocities with ghosts; zeros, not sent, where nothing rotates."""
        if self.state.rotating:
            return neighbours.extend(self.state.bodies.angular_velocity)
        return np.zeros((neighbours.halo.owned + neighbours.halo.ghosts, 3))

    def _make_operator(
        self, contacts: ContactSet, neighbours: Neighbours, inverse_inertia: NDArray
    ) -> MatrixFree | Assembled:
        """Collective. N for these contacts; an assembled pattern is kept while the graph stands."""
        masses = (neighbours.inverse_mass, inverse_inertia, neighbours.halo)
        if self.scenario.contact.operator == "matrix_free":
            return MatrixFree(contacts, *masses, self.frictional, self.scenario.threads)
        kept = self._operator if isinstance(self._operator, Assembled) else None
        turned = inverse_inertia if self._general else None
        if kept is not None and not self._rebuilt and kept.refill(contacts, turned):
            return kept
        if kept is not None:
            kept.destroy()
        self._operator = Assembled(contacts, *masses, self.frictional, self.parallel)
        return self._operator

    def _make_problem(
        self,
        operator: MatrixFree | Assembled,
        contacts: ContactSet,
        velocity: NDArray,
        spin: NDArray,
        walls: Walls,
        h: float,
    ) -> tuple[ConeProblem, NDArray, NDArray | None, float]:
        """Collective. b = (b_phi, 0, 0) + D^T v_hat + b_wall and the scales of its residuals.

        b_phi = max(phi/h, -v_rec): overlap is pushed out at a bounded speed. Returns the problem,
        b_phi (m,), b_wall (m, columns) or None, and the deepest overlap in smaller radii.
        """
        b = np.empty((contacts.count, self._columns))
        turning = self.frictional or self._general
        motion = np.hstack((velocity, spin)) if turning else velocity
        operator.contact_velocity(motion, b)
        b_wall = None
        wall_velocity = contact_velocity_of_walls(contacts, self.state.bodies.position, walls)
        if wall_velocity is not None:
            b_wall = np.empty_like(b)
            kernels.to_contact.serial(contacts.normal, wall_velocity, b_wall)
            b += b_wall
        fastest = float(np.sqrt(np.max(np.sum(b * b, axis=1), initial=0.0)))
        recovery = self.scenario.contact.recovery_speed
        b_gap = contacts.gap / h
        if recovery is not None:
            np.maximum(b_gap, -recovery, out=b_gap)
        b[:, 0] += b_gap
        overlap = float(np.max(-contacts.gap / self._smaller_size(contacts), initial=0.0))
        largest = self.parallel.max(np.array([fastest, overlap]))
        v_ref = max(h * float(np.linalg.norm(self._gravity)), float(largest[0]))
        if v_ref == 0.0:
            # All at rest without gravity: overlap is what moves bodies, and sets the scale.
            v_ref = self.parallel.max(float(np.max(-b_gap, initial=0.0)))
        gamma_ref = v_ref / median_of_positive(operator.diagonal(), self.parallel)
        problem = ConeProblem(
            operator, b, contacts.friction, v_ref, gamma_ref, self.parallel,
            self.scenario.threads, self._elongation(),
        )  # fmt: skip
        return problem, b_gap, b_wall, float(largest[1])

    def _elongation(self) -> float:
        """Collective. Of the region that the bodies fill; 1 where no solver asks for it."""
        if self.scenario.contact.solver != "auto":
            return 1.0
        bodies = self.state.bodies
        return elongation_of(self.wrapped_position(), bodies.smallest_size, self.parallel)

    def _smaller_size(self, contacts: ContactSet) -> NDArray:
        """Return the radius (m,) [m] of the largest sphere inside the smaller body."""
        pair = contacts.b >= 0
        neighbours = self._neighbours
        if neighbours is not None and neighbours.form is not None:
            size = shapes.smallest_size(*neighbours.form.T)
            smaller = size[contacts.a]
            smaller[pair] = np.minimum(smaller[pair], size[contacts.b[pair]])
            return smaller
        smaller = contacts.arm[:, 0] - 0.5 * contacts.gap
        smaller[pair] = np.minimum(smaller[pair], (contacts.arm[:, 1] - 0.5 * contacts.gap)[pair])
        return smaller

    def _guess(self, contacts: ContactSet, h: float) -> NDArray:
        """Impulses of the last step where the contacts stand, scaled with the step length."""
        if not (self.scenario.contact.warm_start and self.state.memory_step > 0.0):
            return np.zeros((contacts.count, self._columns))
        scale = h / self.state.memory_step
        return recall_impulses(
            contacts, self.state.memory, self._columns, scale, self.scenario.threads
        )

    # ---- faults ----------------------------------------------------------------------------

    def _check_finite(self) -> None:
        """Collective. Raise if a position or velocity is not a number, naming the body."""
        gid = self.parallel.max(integrator.find_not_finite(self.state.bodies))
        if gid >= 0:
            raise SolverFailureError(
                f"step {self.state.step + 1}: position or velocity of body {gid} is not finite",
                intact=False,
            )

    def _check_new_velocity(self, substep: _Substep) -> None:
        """Collective. Raise before a velocity that is not a number reaches the bodies."""
        if math.isfinite(substep.energy_after):  # the sum over all ranks
            return
        new = replace(
            self.state.bodies,
            velocity=substep.velocity,
            angular_velocity=substep.angular_velocity,
        )
        gid = self.parallel.max(integrator.find_not_finite(new))
        raise SolverFailureError(
            f"step {self.state.step + 1}: the new velocity of body {gid} is not finite"
        )

    def _refuse(self, substep: _Substep, stop: bool) -> None:
        """Collective. Raise unless the scene lets a step that missed its tolerance pass."""
        step, report, contact = self.state.step + 1, substep.report, self.scenario.contact
        residuals, problem = report.residuals, substep.problem
        merit = self._tolerance.merit(residuals, problem)
        if not residuals.finite:
            why = "a residual is not a number"
        elif stop:
            why = f"the solver missed its tolerance ({report.reason})"
        elif merit > contact.stop_factor:
            why = (
                f"a residual exceeds {contact.stop_factor:g} times the tolerance ({report.reason})"
            )
        else:
            return
        over, measure = self._largest_residual(substep)
        low, high = self._worst_contact(substep.contacts, measure)
        remedy = self._remedy(report)
        raise SolverFailureError(
            f"step {step}: {why}: {over}, worst at the contact of body {low} with "
            f"{self._name(high)}{f'. {remedy}' if remedy else ''}"
        )

    def _largest_residual(self, substep: _Substep) -> tuple[str, NDArray]:
        """The residual that is furthest over its limit, in words, and each contact's part (m,)."""
        report, problem = substep.report, substep.problem
        residuals, tolerance = report.residuals, self._tolerance
        dual, work = tolerance.limits(problem)
        scaled_dual = residuals.dual / dual
        scaled_work = residuals.weighted_work / work if work > 0.0 else 0.0
        if tolerance.kind != "thesis" and scaled_work > scaled_dual:
            each = problem.weight * np.abs(np.sum(report.impulse * report.velocity, axis=1))
            times, key = f"{scaled_work:.3g} times", "contact.complementarity"
            return f"r_c = {residuals.weighted_work:.3g} J, {times} what {key} allows", each
        violation = -report.velocity[:, 0]
        if self.scenario.contact.law == "ccp":
            slip = np.sqrt(np.sum(report.velocity[:, 1:] ** 2, axis=1))
            violation += substep.contacts.friction * slip
        if tolerance.kind == "thesis":
            return f"the largest of the thesis's residuals is {residuals.thesis:.3g}", violation
        times, key = f"{scaled_dual:.3g} times", "contact.tolerance"
        return f"r_d = {residuals.dual:.3g} m/s, {times} what {key} allows", violation

    def _remedy(self, report: SolveReport) -> str:
        """What may help; nothing more where the reason of the solver says it."""
        contact = self.scenario.contact
        if "contact." in report.reason:
            return ""
        limited = "iteration limit" in report.reason
        if contact.solver == "apgd" and (limited or report.outer == 1):
            first = "Raise contact.max_iterations, set contact.solver: auto"
        elif limited and contact.solver == "scip":
            first = "Raise contact.scip.max_iterations"
        elif limited:
            first = "Raise contact.max_iterations or contact.scip.max_iterations"
        else:
            first = "Loosen contact.tolerance and contact.complementarity"
        if contact.on_failure == "shrink_step":
            return f"{first}, or lower time.step"
        return f"{first}, lower time.step, or set contact.on_failure: shrink_step"

    def _worst_contact(self, contacts: ContactSet, measure: NDArray) -> tuple[int, int]:
        """Collective. The gids of the contact with the largest, or an undefined, measure (m,)."""
        measure = np.nan_to_num(measure, nan=np.inf, posinf=np.inf)
        mine = np.array([-np.inf, -1.0, 0.0])
        if measure.size:
            i = int(np.argmax(measure))
            mine[:] = measure[i], self.state.bodies.gid[contacts.a[i]], contacts.other[i]
        every = self.parallel.allgather(mine)
        worst = every[int(np.argmax(every[:, 0]))]
        return int(worst[1]), int(worst[2])

    def _check_runaway(self, contacts: ContactSet, overlap: float) -> None:
        """Collective. Raise if bodies sank into each other further than they were at the start."""
        allowed = max(_RUNAWAY_OVERLAP, 1.05 * self.state.deepest)
        if self.state.deepest < 0.0 or overlap <= allowed:
            return
        depth = -contacts.gap / self.state.bodies.smallest_size[contacts.a]
        low, high = self._worst_contact(contacts, depth)
        missed, remedy = self.state.flagged, "lower time.step or contact.tolerance"
        if missed:
            # Their impulses were not what holds bodies apart.
            remedy = (
                f"{missed} of {self.state.step} steps before it missed their tolerance: lower "
                f"contact.stop_factor to end at the first that is far off, or time.step"
            )
        raise SolverFailureError(
            f"step {self.state.step + 1}: an overlap of {overlap:.2g} radii, over {allowed:.2g}, "
            f"of body {low} with {self._name(high)}: bodies pass through each other; {remedy}",
            intact=False,
        )

    def _name(self, other: int) -> str:
        return f"body {other}" if other >= 0 else f"wall '{self._faces.name[-other - 1]}'"

    # ---- records ---------------------------------------------------------------------------

    def _record(self, done: list[_Substep], outside: int, waiting: int, sent: int) -> StepRecord:
        """Collective. Sum up the substeps of a step over ranks."""
        state, parallel, last, effort = self.state, self.parallel, done[-1], self._effort
        motion = integrator.measure(parallel, state.bodies)
        halo = self._neighbours.halo.ghosts if self._neighbours is not None else 0
        load = float(len(state.bodies) + last.contacts.count)
        counts = np.array([last.contacts.count, last.contacts.coincident, halo, sent])
        counts = parallel.sum(counts.astype(np.int64))
        residuals = [s.report.residuals for s in done]
        missed = [s.report.reason for s in done if s.failed]
        return StepRecord(
            step=state.step,
            time=state.step * self.scenario.time.step,
            bodies=motion.bodies,
            contacts=int(counts[0]),
            solver=last.report.solver,
            iterations=effort.iterations,
            products=effort.products,
            factorisations=effort.factorisations,
            outer=effort.outer,
            form=last.report.form,
            factor_entries=last.report.factor_entries,
            linear_residual=effort.linear_residual,
            refinements=effort.refinements,
            linear_iterations=effort.linear_iterations,
            converged=not missed,
            reason=missed[0] if missed else "converged",
            r_p=max(r.primal for r in residuals),
            r_d=max(r.dual for r in residuals),
            r_c=max(r.complementarity for r in residuals),
            objective=last.report.residuals.objective,
            v_ref=last.problem.velocity_scale,
            gamma_ref=last.problem.impulse_scale,
            kinetic_energy=motion.kinetic_energy,
            kinetic_speed=motion.kinetic_speed,
            largest_speed=motion.largest_speed,
            energy_change=sum(s.energy_after - s.energy_before for s in done),
            energy_balance=sum(s.energy_balance for s in done),
            wall_work=sum(s.wall_work for s in done),
            walls=self._wall_forces(done),
            overlap=max(s.overlap for s in done),
            coincident=int(counts[1]),
            outside=outside,
            waiting=waiting,
            removed=state.removed,
            removed_mass=state.removed_mass,
            substeps=len(done),
            rejected=effort.solves - len(done),
            rebuilt=self._rebuilt,
            moved=self._moved,
            ghosts=int(counts[2]),
            imbalance=imbalance(parallel, load),
            bytes_sent=int(counts[3]),
        )

    def _wall_forces(self, done: list[_Substep]) -> dict[str, list[float]]:
        """Mean force and torque on each face over a step."""
        mean = sum(s.wall_impulse for s in done) / self.scenario.time.step
        return dict(zip(self._faces.name, mean.tolist(), strict=True))

    def take_wall_impulse(self) -> tuple[NDArray, float]:
        """Return what the faces took since the last call, and begin anew.

        Their impulses (w, 6) [N s, N m s], as in `State`, and the time [s] in which they came.
        """
        state = self.state
        taken = state.wall_impulse, state.wall_time
        state.wall_impulse, state.wall_time = np.zeros_like(state.wall_impulse), 0.0
        return taken

    def destroy(self) -> None:
        """Collective. Free the PETSc objects."""
        self._solver.destroy()
        if self._operator is not None:
            self._operator.destroy()
            self._operator = None


def _finite(smallest: float) -> float:
    """A smallest size [m], 0 where there are no bodies to have one."""
    return smallest if math.isfinite(smallest) else 0.0


def start(parallel: Parallel, bodies: Bodies) -> State:
    """Collective. The state of newly placed bodies, divided among the ranks."""
    memory = ImpulseMemory.empty(len(bodies))
    partition = balance(parallel, bodies, np.ones(len(bodies), dtype=np.int64))
    bodies, memory, _ = migrate(parallel, partition, bodies, memory)
    return State(bodies=bodies, memory=memory, partition=partition)


def redistribute(parallel: Parallel, state: State) -> State:
    """Collective. A state read on another number of ranks, divided among these."""
    partition = balance(parallel, state.bodies, 1 + np.diff(state.memory.offsets))
    bodies, memory, _ = migrate(parallel, partition, state.bodies, state.memory)
    return replace(
        state, bodies=bodies, memory=memory, partition=partition, reference=None, balanced=1.0
    )


def _energy_balance(
    problem: ConeProblem, report: SolveReport, b_gap: NDArray, wall_work: float
) -> float:
    """-gamma.N gamma/2 + gamma.g - sum gamma_n b_phi + wall work of this rank's contacts [J]."""
    gamma = report.impulse
    work = float(np.sum(gamma * report.velocity))
    push = float(np.sum(gamma * problem.b))
    total = -0.5 * (work - push) + work - float(np.sum(gamma[:, 0] * b_gap))
    return total + wall_work
