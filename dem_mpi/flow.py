"""`dem-mpi flow`: the Stokes flow around the bodies of a frame, solved, written and drawn.

Two problems. `resistance`: the bodies move as in the run; what force and torque does the fluid
exert on each? `mobility`: each body feels its buoyant weight alone; how does it move? The fluid
fills all of space and moves far away as the background flow does; walls, periodic copies and
contact forces of the run are left out.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi import __version__, shapes
from dem_mpi._jit import compile_clock
from dem_mpi.body_file import BodyFile
from dem_mpi.errors import DataError, DemError, InputError, OutputError
from dem_mpi.flow_estimate import FlowEstimate, estimate_flow
from dem_mpi.flow_options import FlowOptions
from dem_mpi.h5files import OutputLock, agree, require_space
from dem_mpi.handoff import (
    FrameBodies,
    Shrinkage,
    buoyant_weight,
    load_bodies,
    shrinkage,
    stokes_bodies,
)
from dem_mpi.machine import memory_share
from dem_mpi.parallel import Parallel

if TYPE_CHECKING:
    from stokes.flow_file import FlowField, Grid, Surfaces
    from stokes.geometry import Body
    from stokes.suspension import Suspension, SuspensionSolution

NOT_CONVERGED = DemError.exit_code
_MARGIN = 1.0  # of a grid or a picture around the bodies, in largest radii
_PICTURES = (".png", ".pdf", ".svg")
_COMPILED = 1e-3  # tolerance to which two bodies are solved for to compile kernels
_WORTH_TELLING = 2.0  # seconds of compilation
_LISTED = 12  # bodies whose loads are printed one by one
_CLOSE = 0.1  # gap in radii from which on neighbours are worth preconditioning with
_STOKES = 0.1  # Reynolds number up to which the drag of a sphere is Stokes's within 2 %


def flow_file(
    parallel: Parallel, path: Path, options: FlowOptions, say: Callable[[str], None]
) -> int:
    """Collective. Compute the flow around bodies of a trajectory; returns the exit code.

    0 if the tolerance holds, 70 if not: the file is then written all the same, and says so.
    """
    out = path.with_name("flow.h5") if options.out is None else options.out
    if not options.dry_run:
        _refuse_output(parallel, path, out, options)
    case = Case.load(parallel, path, options)
    for line in case.lines():
        say(line)
    found = case.estimate()
    for line in found.lines():
        say(line)
    if options.dry_run:
        return 0
    found.refuse_what_does_not_fit()
    lock = OutputLock(parallel, out)
    try:
        with agree(parallel, out, "write"):
            if parallel.rank == 0:
                require_space(out, found.file)
        with compile_clock() as compiled:
            if parallel.size > 1:
                compile_kernels(parallel, options)
            result = case.solve()
        seconds = parallel.max(compiled.seconds)
        if seconds > _WORTH_TELLING:
            say(f"compiled kernels in {seconds:.0f} s (first run only; kept in the numba cache)")
        for line in result.lines():
            say(line)
        result.write(out)
        say(f"wrote {out}: {found.contents}")
        if options.picture is not None:
            where = result.draw(options.picture)
            say(f"wrote {options.picture}: speed and streamlines at {where}")
    finally:
        lock.release()
    return 0 if result.converged else NOT_CONVERGED


def _refuse_output(parallel: Parallel, path: Path, out: Path, options: FlowOptions) -> None:
    """Collective. Raise InputError for files that may not be written, or cannot."""
    error = None
    if parallel.rank == 0:
        try:
            _refuse_place("--output", out, options.force)
            if out.exists() and path.exists() and out.samefile(path):
                raise InputError(f"--output {out}: is the trajectory itself")
            if options.picture is not None:
                _refuse_place("--render", options.picture, force=True)
                _refuse_picture(options.picture)
        except InputError as caught:
            error = caught
    parallel.raise_together(error)


def _refuse_place(flag: str, out: Path, force: bool) -> None:
    if out.is_dir():
        raise InputError(f"{flag} {out}: is a directory, name a file")
    if not out.absolute().parent.is_dir():
        raise InputError(f"{flag} {out}: there is no directory {out.absolute().parent}")
    if out.exists() and not force:
        raise InputError(f"{flag} {out}: exists; --force replaces it")


def _refuse_picture(picture: Path) -> None:
    if picture.suffix.lower() not in _PICTURES:
        raise InputError(f"--render {picture}: must end in {', '.join(_PICTURES)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError(
            f"--render {picture}: needs matplotlib, the extra `plot` (pip install 'dem-mpi[plot]')"
        )


# ---- what is solved ------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """Bodies, fluid and problem, the same on every rank; rows of bodies are in order of gid."""

    parallel: Parallel
    bodies: FrameBodies
    room: Shrinkage
    options: FlowOptions

    @classmethod
    def load(cls, parallel: Parallel, path: Path, options: FlowOptions) -> Case:
        """Collective. Read the bodies and make room between them; DemError for what is wrong."""
        moving = options.problem == "resistance"
        bodies = load_bodies(parallel, path, options.frame, options.selection, moving)
        case = cls(parallel, bodies, shrinkage(bodies, options.factor), options)
        if not moving:
            buoyant_weight(bodies, case.gravity, options.fluid_density)
        return case

    @cached_property
    def everyone(self) -> list[Body]:
        """The bodies of all ranks, as `stokes` takes them."""
        return stokes_bodies(self.bodies, self.room.factor)

    @cached_property
    def share(self) -> tuple[list[Body], NDArray]:
        """Bodies of this rank, and their rows among all."""
        from stokes.suspension import distribute

        mine = distribute(self.everyone, self.parallel)
        row = {id(body): k for k, body in enumerate(self.everyone)}
        return mine, np.array([row[id(body)] for body in mine], dtype=np.int64)

    @property
    def gravity(self) -> tuple[float, float, float]:
        """What weighs on the bodies [m/s^2]; InputError where neither flag nor run says."""
        given = self.options.gravity or self.bodies.scene.gravity
        if given is None:
            raise InputError(f"--gravity: {self.bodies.path} does not tell the run's, give it")
        return given

    @cached_property
    def grid(self) -> Grid | None:
        """Where the field is asked for, if on a grid."""
        from stokes.flow_file import Grid

        if self.options.grid is None:
            return None
        if self.options.box is not None:
            low, high = np.reshape(self.options.box, (3, 2)).T
        else:
            reach = self.room.factor * shapes.bounding_radius(
                self.bodies.shape, self.bodies.radius, self.bodies.half_length
            )
            around = reach[:, None] + _MARGIN * reach.max()
            low = (self.bodies.position - around).min(axis=0)
            high = (self.bodies.position + around).max(axis=0)
        return Grid.over(low, high, self.options.grid)

    @cached_property
    def listed(self) -> NDArray | None:
        """Points (n, 3) [m] of the file that is given, this rank's share; None without one."""
        if self.options.points is None:
            return None
        with agree(self.parallel, self.options.points, "read", DataError):
            file = BodyFile(self.options.points)
            first, last = _range(file.rows, self.parallel)
            return file.read(first, last)["position"]

    @cached_property
    def points(self) -> int:
        """Number of points of the field on all ranks. Collective the first time."""
        if self.grid is not None:
            return self.grid.size
        return 0 if self.listed is None else self.parallel.sum(len(self.listed))

    @cached_property
    def suspension(self) -> Suspension:
        """Collective the first time. Bodies with their resolutions; nothing is solved yet."""
        from stokes.suspension import Suspension, SuspensionOptions

        options = self.options
        try:
            return Suspension(
                self.share[0],
                viscosity=options.viscosity,
                background=options.background,
                tolerance=options.tolerance,
                formulation=options.formulation,
                parallel=self.parallel,
                options=SuspensionOptions(
                    preconditioner="neighbours" if self.room.gap < _CLOSE else "body",
                    max_iterations=options.max_iterations,
                    threads=options.threads,
                ),
            )
        except ValueError as error:  # on all ranks: bodies are too close for what is asked
            raise InputError(str(error)) from None

    def estimate(self) -> FlowEstimate:
        """Collective. What solving would take, without doing it."""
        share = memory_share(self.parallel)
        return estimate_flow(self.parallel, self.suspension, self.options, self.points, share)

    def solve(self) -> Result:
        """Collective. Solve for the densities on the surfaces."""
        started = perf_counter()
        rows = self.share[1]
        with warnings.catch_warnings():
            # A solution that has not converged is told by lines, file and exit code.
            warnings.simplefilter("ignore", RuntimeWarning)
            if self.options.problem == "resistance":
                solution = self.suspension.solve(
                    velocity=self.bodies.velocity[rows],
                    angular_velocity=self.bodies.angular_velocity[rows],
                )
            else:
                density = self.options.fluid_density
                weight = buoyant_weight(self.bodies, self.gravity, density)
                solution = self.suspension.solve(force=weight[rows])
        return Result(self, solution, perf_counter() - started)

    def lines(self) -> list[str]:
        """What is asked, one fact a line."""
        bodies, options = self.bodies, self.options
        kinds = ", ".join(f"{n:,} {name}{'s' * (n > 1)}" for name, n in bodies.counts.items())
        ranks = self.parallel.size
        far = "at rest" if options.background is None else options.background.text
        lines = [
            f"{bodies.path.name}: frame {bodies.frame} of {bodies.frames} (step {bodies.step}, "
            f"t = {bodies.time:g} s), {len(bodies):,} of {bodies.total:,} bodies: {kinds}; "
            f"{ranks} rank{'s' if ranks > 1 else ''}",
            _room_line(self.room, options.factor is None),
            f"fluid: viscosity {options.viscosity:g} Pa s, far away {far}",
        ]
        if options.problem == "resistance":
            lines.append("resistance: the bodies move as in the run; loads are the fluid's on them")
        else:
            g = " ".join(f"{part:g}" for part in self.gravity)
            lines.append(
                f"mobility: weights less those of a fluid of {options.fluid_density:g} kg/m^3, "
                f"gravity {g} m/s^2, no torques"
            )
        lines += [f"note: {text}" for text in (*bodies.assumed, *self._left_out())]
        return lines

    def _left_out(self) -> list[str]:
        """What the scene has and the flow has not."""
        scene, left = self.bodies.scene, []
        if len(self.bodies) < self.bodies.total:
            left.append("the other bodies")
        if scene.walls:
            left.append("walls")
        if scene.periodic:
            left.append(f"periodic copies along {', '.join(scene.periodic)}")
        return [f"left out: {', '.join(left)} of the run"] if left else []


def _room_line(room: Shrinkage, chosen: bool) -> str:
    if not room.pair:
        apart = "no two bodies are nearer than a radius"
    else:
        apart = f"least gap {room.gap:.3g} radii, between bodies {room.pair[0]} and {room.pair[1]}"
    size = "that of the run" if room.factor == 1.0 else f"{room.factor:.6g} of the run's"
    why = ", for touching bodies have no solution" if chosen and room.factor < 1.0 else ""
    return f"size of the bodies: {size}{why}; {apart}"


def _range(count: int, parallel: Parallel) -> tuple[int, int]:
    """The share [first, last) that this rank has of so many rows."""
    return tuple(count * (parallel.rank + k) // parallel.size for k in (0, 1))


# ---- what came out -------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    """A solved case."""

    case: Case
    solution: SuspensionSolution
    seconds: float

    @property
    def converged(self) -> bool:
        """Whether the tolerance was met."""
        return bool(self.solution.converged)

    def lines(self) -> list[str]:
        """Collective. What came out, one fact a line."""
        solution = self.solution
        last = solution.residuals[-1] if solution.residuals else 0.0
        outcome = "converged" if self.converged else f"NOT CONVERGED: {solution.reason}"
        lines = [
            f"{outcome}: {solution.iterations} iterations, residual {last:.2e}, "
            f"{solution.report.nodes:,} nodes, {self.seconds:.3g} s"
        ]
        table = self._table()
        if self.case.options.problem == "resistance":
            columns = (("force", "N"), ("torque", "N m"))
        else:
            columns = (("velocity", "m/s"), ("angular_velocity", "rad/s"))
        lines += _summary(table["gid"], [(table[name], name, unit) for name, unit in columns])
        reynolds = self._reynolds(table)
        if reynolds > _STOKES:
            lines.append(
                f"warning: Reynolds number {reynolds:.2g} of the fastest body: Stokes flow leaves "
                f"inertia out, which counts above {_STOKES:g}"
            )
        return lines

    def _reynolds(self, table: dict[str, NDArray]) -> float:
        """The largest density |velocity - background| radius / viscosity of a body."""
        case, options = self.case, self.case.options
        velocity = table["velocity"]
        if options.background is not None:
            velocity = velocity - options.background.velocity(case.bodies.position)
        radius = case.room.factor * case.bodies.radius
        speed = np.linalg.norm(velocity, axis=1)
        return float((speed * radius).max() * options.fluid_density / options.viscosity)

    def _columns(self) -> dict[str, NDArray]:
        """Columns of this rank's bodies, as `stokes.flow_file` names them."""
        case, solution = self.case, self.solution
        mine = case.bodies.take(case.share[1])
        return {
            "gid": mine.gid,
            "position": mine.position,
            "orientation": mine.orientation,
            "shape": mine.shape,
            "radius": case.room.factor * mine.radius,
            "half_length": case.room.factor * mine.half_length,
            "velocity": solution.velocities,
            "angular_velocity": solution.angular_velocities,
            "force": solution.forces,
            "torque": solution.torques,
            "stresslet": solution.stresslets,
        }

    def _table(self) -> dict[str, NDArray]:
        """Collective. What is printed of all bodies, in order of gid, on every rank."""
        names = ("gid", "force", "torque", "velocity", "angular_velocity")
        own = self._columns()
        parts = self.case.parallel.gather([own[name] for name in names])
        table = None
        if parts is not None:
            whole = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
            order = np.argsort(whole[0])
            table = {name: values[order] for name, values in zip(names, whole, strict=True)}
        return self.case.parallel.broadcast(table)

    def write(self, out: Path) -> None:
        """Collective. Write the flow file; OutputError (74) if that fails."""
        from stokes.flow_file import Flow, write_flow

        case = self.case
        flow = Flow(self._columns(), self._surfaces(), self._attributes(), self._field())
        try:
            write_flow(case.parallel, out, flow, case.share[1])
        except OSError as error:  # on all ranks
            raise OutputError(str(error)) from None

    def _surfaces(self) -> Surfaces:
        from stokes.flow_file import Surfaces

        suspension, solution = self.case.suspension, self.solution
        return Surfaces(
            grid=suspension.grids,
            position=suspension.nodes,
            normal=suspension.normals,
            weight=suspension.weights,
            density=solution.single_layer,
            double_density=solution.double_layer,
        )

    def _field(self) -> FlowField | None:
        """Collective. Velocity and pressure where they are asked for, this rank's points."""
        from stokes.flow_file import FlowField

        case = self.case
        if not case.points:
            return None
        points = case.listed
        if case.grid is not None:
            points = case.grid.points(*_range(case.grid.size, case.parallel))
        velocity, pressure = self.solution.velocity(points), self.solution.pressure(points)
        return FlowField(velocity, pressure, case.grid, None if case.grid else points)

    def _attributes(self) -> dict[str, Any]:
        """What holds for the whole file."""
        case, solution = self.case, self.solution
        bodies, options = case.bodies, case.options
        attributes = {
            "version": __version__,
            "units": "SI: m, kg, s, N, Pa",
            "source": str(bodies.path),
            "scene": bodies.scene.name,
            "frame": bodies.frame,
            "step": bodies.step,
            "time": bodies.time,
            "bodies_of_frame": bodies.total,
            "assumed": "; ".join(bodies.assumed),
            "size_factor": case.room.factor,
            "least_gap": case.room.gap,
            "problem": options.problem,
            "loads": "of the fluid on the bodies",
            "viscosity": options.viscosity,
            "background": "" if options.background is None else options.background.text,
            "tolerance": options.tolerance,
            "formulation": options.formulation,
            "iterations": solution.iterations,
            "residual": solution.residuals[-1] if solution.residuals else 0.0,
            "converged": int(self.converged),
            "reason": solution.reason,
        }
        if options.problem == "mobility":
            attributes |= {
                "gravity": np.array(case.gravity),
                "fluid_density": options.fluid_density,
            }
        return attributes

    def draw(self, picture: Path) -> str:
        """Collective. Draw the flow on a plane; returns which. OutputError (74) if that fails."""
        from stokes.render import Plane, draw_slice

        case = self.case
        parallel = case.parallel
        plane = Plane.through(case.everyone, *case.options.plane, margin=_MARGIN)
        points = plane.points()
        where = f"{'xyz'[plane.axis]} = {plane.place:.4g} m"
        first, last = _range(len(points), parallel)
        parts = parallel.gather(self.solution.velocity(points[first:last]))
        with agree(parallel, picture, "draw"):
            if parts is not None:
                title = f"{case.bodies.path.name}, t = {case.bodies.time:g} s, {where}"
                draw_slice(picture, plane, np.concatenate(parts), case.everyone, title)
        return where


def _summary(gid: NDArray, columns: list[tuple[NDArray, str, str]]) -> list[str]:
    """Sum and largest of each column (n, 3); every row where there are few bodies."""
    lines = []
    for values, name, unit in columns:
        size = np.linalg.norm(values, axis=1)
        k = int(np.argmax(size))
        label = name.replace("_", " ")
        lines.append(
            f"  {label:<17} mean {_vector(values.mean(axis=0))} {unit}, largest "
            f"{size[k]:.4g} {unit} on body {gid[k]}"
        )
    if len(gid) <= _LISTED:
        rows = zip(gid, *(values for values, _, _ in columns), strict=True)
        titles = "   ".join(f"{name.replace('_', ' ')}, {unit}" for _, name, unit in columns)
        lines.append(f"  body   {titles}")
        lines += [f"  {row[0]:<6} " + "   ".join(_vector(v) for v in row[1:]) for row in rows]
    return lines


def _vector(values: NDArray) -> str:
    return " ".join(f"{value:11.4e}" for value in values)


# ---- compilation ---------------------------------------------------------------------------


def compile_kernels(parallel: Parallel, options: FlowOptions) -> None:
    """Collective. Compile the kernels of a solution on rank 0, then load them on the others.

    Ranks that compiled at the same time would race for numba's cache on disk.
    """
    # PETSc starts on all ranks together.
    import petsc4py.PETSc  # noqa: F401

    error = None
    for turn in (True, False):
        if (parallel.rank == 0) == turn:
            try:
                _solve_two_bodies(options)
            except Exception as caught:
                error = caught
        parallel.raise_together(error)


def _solve_two_bodies(options: FlowOptions) -> None:
    """Solve for a sphere and a spheroid close to it, and look at the flow, on this rank alone."""
    from stokes.geometry import Body, sphere, spheroid
    from stokes.suspension import Suspension, SuspensionOptions

    suspension = Suspension(
        [Body(sphere()), Body(spheroid(1.0, 1.5), centre=(2.2, 0.0, 0.0))],
        tolerance=max(options.tolerance, _COMPILED),
        formulation=options.formulation,
        options=SuspensionOptions(
            preconditioner="neighbours",
            threads=options.threads,
            fmm_tolerance=0.2 * options.tolerance,  # which decides what the sums compute in
        ),
    )
    if options.problem == "resistance":
        solution = suspension.solve(velocity=(0.0, 0.0, 1.0))
    else:
        solution = suspension.solve(force=(0.0, 0.0, 1.0))
    above = np.array([[0.0, 0.0, 1.1]])
    solution.velocity(above)
    solution.pressure(above)
