"""Stokes flow around many rigid bodies of revolution.

    bodies = [Body(spheroid(0.5, 1.0), centre=c, quaternion=q) for c, q in zip(centres, turns)]
    suspension = Suspension(bodies, viscosity=1.0, tolerance=1e-6)
    suspension.solve(velocity=velocities, angular_velocity=spins).forces
    suspension.solve(force=weights).velocities

The fluid moves with U + omega cross (x - centre) + slip on the surface of each body, and far away
as the background flow does. Unknown are densities of layers on the surfaces; GMRES finds them, a
fast sum and corrections near close surfaces apply the operator (`suspension_operator`).

One `tolerance` bounds the error of velocities, relative to the mean of the data over the surfaces:
resolutions, fast sums, near corrections and the residual of GMRES each get their part of it.

Bodies stay on the rank that brings them; `distribute` deals out a list that all ranks know.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi.parallel import Parallel
from stokes.background import BackgroundFlow
from stokes.coarse import MOST_BODIES, CoarseForces
from stokes.fmm._requests import raised_together
from stokes.formulation import DEFAULT_ETA, OperatorCache, ShapeSolver
from stokes.geometry import Body
from stokes.krylov import KrylovResult, gmres
from stokes.near import Layers, reach
from stokes.preconditioner import BodyPreconditioner, Preconditioner
from stokes.sources import UnitShape
from stokes.suspension_estimate import estimate
from stokes.suspension_layout import Field, Layout, Packing
from stokes.suspension_operator import Ghosts, Members, PhaseClock, SuspensionOperator
from stokes.suspension_options import (
    FormulationName,
    SuspensionEstimate,
    SuspensionOptions,
    SuspensionReport,
    Tolerances,
    check_tolerance,
)
from stokes.suspension_problem import Function, Problem, Request, SurfaceData, pose
from stokes.suspension_scene import Scene
from stokes.suspension_solution import DisturbedFlow, SuspensionSolution, in_given_order, moments
from stokes.suspension_surfaces import OwnSurfaces
from stokes.suspension_table import distribute

__all__ = ["Suspension", "SuspensionOptions", "SuspensionSolution", "distribute"]

# Drag and torque of a sphere of radius and viscosity 1: loads over these are velocities.
_DRAG = np.repeat([6.0 * math.pi, 8.0 * math.pi], 3)
# Relative gap below which inverting pairs of bodies is worth its price.
_NARROW = 0.1


class Suspension:
    """Rigid bodies in a viscous fluid, on all ranks of a group."""

    def __init__(
        self,
        bodies: Sequence[Body],
        viscosity: float = 1.0,
        background: BackgroundFlow | None = None,
        tolerance: float = 1e-6,
        formulation: FormulationName = "single",
        parallel: Parallel | None = None,
        options: SuspensionOptions | None = None,
    ) -> None:
        """Collective over `parallel` (default: this process alone).

        bodies      : this rank's; other ranks may have none
        tolerance   : relative error of velocities
        formulation : "single", whose unknown is the traction on the surfaces; "combined", with a
                      double layer, of the second kind, at twice the work of a sum or more
        Raises ValueError, on all ranks, for bodies that overlap or are closer than
        `options.least_gap`, naming both, and for arguments outside their rules.
        """
        self.parallel = parallel or Parallel.alone()
        self.options = options or SuspensionOptions()
        self.viscosity, self.background = viscosity, background
        self.tolerance, self.formulation = tolerance, formulation
        self.bodies = tuple(bodies)
        with raised_together(self.parallel):
            self._check()
        self.tolerances = Tolerances.of(tolerance, self.options)
        self._clock = PhaseClock()
        with self._clock.phase("geometry"):
            self._scene = Scene.survey(
                self.bodies, self.tolerances.resolution, self.options, self.parallel
            )
            self._surfaces = self._own_surfaces()
        self.tolerances = self.tolerances.for_gap(self._scene.least_gap, self.options)
        self._cache = OperatorCache(self.options.threads)
        self._solvers: dict[int, ShapeSolver] = {}
        self._operator: SuspensionOperator | None = None
        self._preconditioners: dict[bool, Preconditioner] = {}

    def _check(self) -> None:
        check_tolerance("tolerance", self.tolerance)
        if not (self.viscosity > 0.0 and math.isfinite(self.viscosity)):
            raise ValueError(f"viscosity = {self.viscosity}: must be > 0")
        if self.formulation not in ("single", "combined"):
            raise ValueError(f"formulation = {self.formulation!r}: must be single or combined")
        for body in self.bodies:
            if not isinstance(body, Body):
                raise TypeError(f"bodies: {body!r} is not a Body")

    def _own_surfaces(self) -> OwnSurfaces:
        scene = self._scene
        own = scene.table.own
        layout = Layout.of_shapes(
            scene.shape[own],
            [(shape.meridian.size, shape.resolution.angles) for shape in scene.shapes],
        )
        order = layout.order.tolist()
        turned = [scene.table.body(own[k]) for k in order]
        return OwnSurfaces(layout, scene.shapes, turned, [self.bodies[k] for k in order])

    @property
    def _shapes(self) -> list[UnitShape]:
        """Shapes of this rank's bodies, in the layout's order."""
        groups = self._surfaces.layout.groups
        return [self._scene.shapes[g.shape] for g in groups for _ in range(g.count)]

    # ---- what is known before any solution ---------------------------------------------------

    @property
    def nodes(self) -> NDArray:
        """Nodes (n, 3) of this rank in the world, body after body as they were given."""
        return self._surfaces.points[self._surfaces.given_order]

    @property
    def normals(self) -> NDArray:
        """Outward unit normals (n, 3) at `nodes`, in the world."""
        return self._surfaces.to_world(self._surfaces.normals)[self._surfaces.given_order]

    @property
    def weights(self) -> NDArray:
        """Weights (n,) of surface integrals over `nodes`."""
        return self._surfaces.weights[self._surfaces.given_order]

    @property
    def offsets(self) -> NDArray:
        """First of `nodes` of each body as given, and their number behind: (b + 1,)."""
        sizes = np.diff(self._surfaces.layout.offsets)
        return np.concatenate([[0], np.cumsum(sizes[self._surfaces.layout.rows])])

    @property
    def grids(self) -> NDArray:
        """(b, 2): nodes on the meridian and azimuths of each body as given."""
        layout = self._surfaces.layout
        grids = [group.grid for group in layout.groups for _ in range(group.count)]
        return np.array(grids, dtype=np.int64).reshape(-1, 2)[layout.rows]

    @property
    def report(self) -> SuspensionReport:
        """What the suspension is made of, and what it took so far."""
        operator, scene = self._operator, self._scene
        sums = () if operator is None else operator.sums
        memory = {"operators": self._cache.nbytes}
        if operator is not None:
            memory["near"] = operator.near.report.bytes
            memory["fmm"] = sum(sum(plan.report.memory.values()) for _, plan in sums)
            memory["preconditioner"] = sum(p.nbytes for p in self._preconditioners.values())
        return SuspensionReport(
            bodies=scene.table.count,
            nodes=int(scene.nodes.sum()),
            levels=scene.levels,
            least_gap=scene.least_gap,
            tolerances=self.tolerances,
            applications=0 if operator is None else operator.applications,
            seconds=self._clock.seconds,
            memory=memory,
            near_pairs=0 if operator is None else operator.near.report.pairs,
            fmm=sums[0][1].report if sums else None,
        )

    def estimate(self) -> SuspensionEstimate:
        """Collective. Nodes, bytes and operations of a solution, without its work."""
        return estimate(self._scene, self.formulation, self.tolerances, self.options, self.parallel)

    # ---- solutions ---------------------------------------------------------------------------

    def solve(
        self,
        velocity: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
        force: ArrayLike | None = None,
        torque: ArrayLike | None = None,
        slip: SurfaceData | None = None,
        boundary_velocity: ArrayLike | Function | None = None,
    ) -> SuspensionSolution:
        """Collective. The flow for given motions, or given loads, or given surface velocities.

        velocity, angular_velocity : of the bodies, (b, 3) or (3,) for all; one that is left out
                is zero. The answer are forces and torques
        force, torque : applied to the bodies, likewise; the answer are their motions. The same
                without any arguments: bodies freely suspended in the background flow
        slip  : velocity of the surface beside the rigid motion, in the frame of each body: a
                function of points (k, 3) of the unit shape, one such function for each body, or
                (n, 3) at `nodes`
        boundary_velocity : of the fluid on the surfaces, alone, in the world's frame: a function
                of points (k, 3), or (n, 3) at `nodes`

        PETSc starts with the first solution, and on all ranks of the job together: where only some
        ranks solve, all have to import `petsc4py.PETSc` before.

        A solution that has not converged says so, and warns. Raises ValueError, on all ranks, for
        data of other shapes, arguments that exclude each other and velocities with a net flux.
        """
        request = Request(velocity, angular_velocity, force, torque, slip, boundary_velocity)
        with raised_together(self.parallel):
            problem = pose(request, self._surfaces, self.background, self.viscosity)
        self._check_agreement(request)
        self._prepare()
        with self._clock.phase("krylov"):
            result, unknown = self._iterate(problem.right_side)
        if not result.converged:
            warnings.warn(
                f"GMRES has not converged: residual {result.residuals[-1]:.1e} after "
                f"{result.iterations} iterations, {self.tolerances.residual:.1e} asked for",
                RuntimeWarning,
                stacklevel=2,
            )
        return self._answer(request, problem, unknown, result)

    def _check_agreement(self, request: Request) -> None:
        mine = [name for name, value in vars(request).items() if value is not None]
        first = self.parallel.broadcast(mine)
        with raised_together(self.parallel):
            if mine != first:
                raise ValueError(f"solve: given {mine}, but {first} on rank 0")

    def _iterate(self, right_side: Field) -> tuple[KrylovResult, Field]:
        """Solve, residuals in the norm of L2 over all surfaces; loads count as velocities."""
        free = right_side.rigid is not None
        pack = Packing(
            velocity_weight=np.sqrt(self._surfaces.weights)[:, None],
            load_weight=np.sqrt(self._surfaces.area)[:, None] / _DRAG,
            free=free,
        )
        operator, preconditioner = self._operator, self._preconditioner(free)

        def corrected(residual: NDArray) -> NDArray:
            with self._clock.phase("preconditioner"):
                return pack.unknown_vector(preconditioner.apply(pack.residual(residual)))

        result = gmres(
            operator=lambda x: pack.residual_vector(operator.apply(pack.unknown(x))),
            preconditioner=corrected,
            right_hand_side=pack.residual_vector(right_side),
            tolerance=self.tolerances.residual,
            max_iterations=self.options.max_iterations,
            restart=self.options.restart,
            flexible=preconditioner.flexible,
            parallel=self.parallel,
        )
        return result, pack.unknown(result.unknown)

    def _answer(
        self, request: Request, problem: Problem, unknown: Field, result: KrylovResult
    ) -> SuspensionSolution:
        surfaces = self._surfaces
        with_double = self.formulation != "single"
        found = moments(unknown.nodal, surfaces, self._solvers, self.viscosity, with_double)
        velocities = spins = None
        if request.boundary_velocity is None:
            motion = unknown.rigid if problem.motion is None else problem.motion
            pair = surfaces.rotation @ np.swapaxes(motion.reshape(-1, 2, 3), 1, 2)
            velocities, spins = pair[:, :, 0], pair[:, :, 1] / surfaces.scale[:, None]
        order, at_nodes = surfaces.layout.order, surfaces.given_order
        mu = found.double
        flow = DisturbedFlow(
            surfaces.bodies,
            [s.resolution for s in self._shapes],
            found.single,
            mu,
            self.background,
            self.viscosity,
            min(self.tolerances.near, self.tolerances.fmm),
            self.options,
            self.parallel,
        )
        return SuspensionSolution(
            forces=in_given_order(found.forces, order),
            torques=in_given_order(found.torques, order),
            stresslets=in_given_order(found.stresslets, order),
            velocities=None if velocities is None else in_given_order(velocities, order),
            angular_velocities=None if spins is None else in_given_order(spins, order),
            single_layer=surfaces.to_world(found.single)[at_nodes],
            double_layer=None if mu is None else surfaces.to_world(mu)[at_nodes],
            density=unknown.nodal,
            iterations=result.iterations,
            residuals=result.residuals,
            converged=result.converged,
            reason=result.reason,
            report=self.report,
            flow=flow,
        )

    # ---- operators ---------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Collective. Make operators, plans and preconditioner, once."""
        if self._operator is not None:
            return
        self._refuse_too_large()
        with raised_together(self.parallel):
            self._factorise()
        members, needed = self._members()
        ghosts = Ghosts(self._surfaces.layout, needed, self.parallel)
        self._operator = SuspensionOperator(
            self._surfaces,
            self._solvers,
            members,
            ghosts,
            self.tolerances,
            self.options,
            self._clock,
            self.parallel,
        )

    def _factorise(self) -> None:
        for group in self._surfaces.layout.groups:
            shape = self._scene.shapes[group.shape]
            with self._clock.phase("kernels"):
                solver = self._cache.solver(shape.curve, shape.resolution, self.formulation)
            with self._clock.phase("factorisation"):
                _ = solver.resistance  # the first solution factorises
            self._solvers[group.shape] = solver
        self._cache.release_operators()

    def _refuse_too_large(self) -> None:
        allowed = self.options.memory
        if allowed is None:
            return
        found = self.estimate()
        if found.bytes > allowed:
            raise ValueError(
                f"{found.bodies} bodies with {found.nodes} nodes would take {found.bytes / 1e9:.3g}"
                f" GB on a rank, {allowed / 1e9:.3g} GB are allowed: take a larger tolerance, "
                "fewer bodies or more ranks"
            )

    def _preconditioner(self, free: bool) -> Preconditioner:
        """Collective. The one for given loads (`free`) or given motions, made once."""
        if free not in self._preconditioners:
            with self._clock.phase("preconditioner"):
                self._preconditioners[free] = self._make_preconditioner(free)
        return self._preconditioners[free]

    def _make_preconditioner(self, free: bool) -> Preconditioner:
        """Collective. Bodies alone or close pairs of them; forces between all, if unknown."""
        surfaces, table = self._surfaces, self._scene.table
        alone = BodyPreconditioner(surfaces.layout, self._solvers)
        found: Preconditioner = alone
        known = np.empty((0, 2), dtype=np.int64)
        if self._neighbours_first:
            from stokes.schwarz import ClosePairs, NeighbourOptions, NeighbourSchwarz

            options = NeighbourOptions()
            found = NeighbourSchwarz(
                alone,
                surfaces.layout,
                table,
                self._solvers,
                self.formulation,
                self._cache,
                self.parallel,
                free,
                options,
            )
            known = ClosePairs.of(table, options.reach).numbers
        if free or not 1 < table.count <= MOST_BODIES:
            return found
        return CoarseForces(found, alone, known, surfaces, self._solvers, table, self.parallel)

    @property
    def _neighbours_first(self) -> bool:
        """Whether close pairs are inverted, not bodies alone."""
        asked = self.options.preconditioner
        narrow = self._scene.least_gap < _NARROW
        return asked == "neighbours" or (asked == "auto" and narrow)

    def _members(self) -> tuple[Members, dict[int, NDArray]]:
        """Bodies of this rank, and those of other ranks that its nodes are close to."""
        scene, table = self._scene, self._scene.table
        layers = self._layers(scene.shapes)
        far = np.array([reach(shape, layers, self.tolerances.near) for shape in scene.shapes])
        radius = table.bounding_radius
        pairs = table.pairs(radius, radius + far[scene.shape] * table.scale)
        others = np.unique(pairs[:, 1])
        others = others[table.owner(others) != table.rank]
        owners = table.owner(others)
        needed = {int(r): others[owners == r] - table.first[r] for r in np.unique(owners).tolist()}
        own = table.own[self._surfaces.layout.order]
        numbers = np.concatenate([own, others]).tolist()
        shapes = [scene.shapes[scene.shape[k]] for k in numbers]
        members = Members(
            [*self._surfaces.bodies, *(table.body(k) for k in others.tolist())],
            [shape.resolution for shape in shapes],
            self._layers(shapes),
        )
        return members, needed

    def _layers(self, shapes: Sequence[UnitShape]) -> Layers:
        """The layers that a density makes on bodies of these shapes, as `ShapeSolver.layers`."""
        if self.formulation == "single":
            return Layers()
        lengths = [math.sqrt(shape.meridian.area / (4.0 * math.pi)) for shape in shapes]
        return Layers(single=DEFAULT_ETA / np.array(lengths), double=1.0)
