"""The battery of hard cases for contact: what every solver has to get right, and how well.

A case is a function of a `Trial`: it builds small scenes, steps them, and holds what it finds
against values known in closed form. The trial watches every step besides: the balances of energy
and momentum, the cones, and whether the solver reached its tolerance within its iterations. Tests
assert all of it; the benchmark writes it down.

Errors follow from what a solve leaves. With g >= -r_d in every contact and |gamma.g| <= r_c, a
contact that carries the impulse p has -r_d <= g_n <= r_c/p (g_n: separation speed plus gap over
h), so a gap is within h r_d and h r_c/p of zero after *every* step: there is nothing to add up.
(Of contacts that do not slide. One that slips at s hovers at g_n = mu s, whatever it carries.)
Where contacts do not determine velocities one by one, two solutions of a problem are apart by
|v - v'|^2 = (gamma - gamma').(g - g') <= sum |gamma.g| + |gamma'.g'| + r_d gamma_n' + r_d' gamma_n
in the norm of the kinetic energy, |v|^2 = v.Mv.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dem_mpi import integrator
from dem_mpi.bodies import Bodies
from dem_mpi.cone import ConeProblem
from dem_mpi.parallel import Parallel
from dem_mpi.scenario import Scenario, frictional
from dem_mpi.shapes import SPHEROCYLINDER, SPHEROID
from dem_mpi.simulation import Simulation, StepRecord, start
from dem_mpi.solvers.result import SolveReport

from scenes import FLOOR, RecordingSolver, everybody, scene, watch

SOLVERS = ("apgd", "scip")
NEWTON_LIMIT = 60  # Newton iterations that a cone problem may take

R = 0.01  # [m] radius of most bodies
H = 1e-3  # [s]
G = 9.81  # [m/s^2]
WEIGHTLESS = (0.0, 0.0, 0.0)
RECOVERY = 0.2  # [m/s] largest speed at which overlap is pushed out
R_D = 1e-8  # [m/s] dual residual that problems are solved to
WORK = 1e-8  # of v_ref gamma_ref, complementarity that problems are solved to
EPS = np.finfo(float).eps
ROUND_OFF = 1e-12  # of the sum of the sizes of the terms
CONE = 1e-14  # of the largest impulse, how far outside its cone one may lie
DENSITIES = {"m": 1e3, "heavy": 1e9}  # [kg/m^3]
"""Every scene knows these materials; the second makes a mass ratio of 10^6 at equal size."""


@dataclass(frozen=True)
class Check:
    """An error with its limit, both in `unit`, and why the limit is what it is."""

    what: str
    error: float
    limit: float
    unit: str
    source: str

    @property
    def passed(self) -> bool:
        """Whether the error is a number within its limit."""
        return self.error <= self.limit

    def __str__(self) -> str:
        return f"{self.what}: {self.error:.3g} > {self.limit:.3g} {self.unit} ({self.source})"


@dataclass
class Effort:
    """What the solves of a case took and left, over all its steps."""

    iterations: list[int] = field(default_factory=list)
    products: int = 0
    dual: float = 0.0
    failures: list[str] = field(default_factory=list)

    def add(self, iterations: int, products: int, dual: float, converged: bool, reason: str):
        """Count one solve or step."""
        self.iterations.append(iterations)
        self.products += products
        self.dual = max(self.dual, dual)
        if not converged:
            self.failures.append(reason)


@dataclass
class Trial:
    """One solver under trial in one case: builds scenes, steps them, collects errors."""

    parallel: Parallel
    solver: str
    effort: Effort = field(default_factory=Effort)
    checks: dict[str, Check] = field(default_factory=dict)

    def simulation(
        self,
        position: ArrayLike,
        *,
        radius: ArrayLike = R,
        velocity: ArrayLike = 0.0,
        spin: ArrayLike = 0.0,
        material: ArrayLike = 0,
        shape: int | None = None,
        half_length: ArrayLike = 0.0,
        orientation: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        contact: dict[str, Any] | None = None,
        **sections: Any,
    ) -> Simulation:
        """Collective. Bodies (n, 3) given alike on every rank, gid = row, in a scene of `scene`."""
        settings = {
            "solver": self.solver,
            "tolerance": R_D,
            "complementarity": WORK,
            "recovery_speed": RECOVERY,
            "max_iterations": 100_000,
            "stop_factor": 1e12,
        }
        materials = {name: {"density": density} for name, density in DENSITIES.items()}
        sections.setdefault("materials", materials)
        sections.setdefault("step", H)
        if shape is not None:
            sections["bodies"] = [_group_of(shape)]
        scenario = scene(contact={**settings, **(contact or {})}, **sections)
        position = np.array(position, dtype=float).reshape(-1, 3)
        n = len(position)
        arrays = {
            "gid": np.arange(n),
            "material": np.broadcast_to(material, n),
            "radius": np.broadcast_to(radius, n),
            "position": position,
            "velocity": np.broadcast_to(velocity, (n, 3)),
            "angular_velocity": np.broadcast_to(spin, (n, 3)),
            "orientation": np.broadcast_to(orientation, (n, 4)),
        }
        if shape is not None:
            arrays["shape"] = np.full(n, shape)
            arrays["half_length"] = np.broadcast_to(half_length, n)
        return self._started(scenario, arrays)

    def _started(self, scenario: Scenario, arrays: dict[str, NDArray]) -> Simulation:
        mine = np.arange(len(arrays["gid"])) % self.parallel.size == self.parallel.rank
        density = [m.density for m in scenario.materials.values()]
        bodies = Bodies.from_arrays({k: v[mine] for k, v in arrays.items()}, density)
        state = start(self.parallel, bodies)
        state.rotating = frictional(scenario) or bool(arrays["angular_velocity"].any())
        simulation = Simulation(self.parallel, scenario, state)
        watch(simulation)
        return simulation

    def run(self, simulation: Simulation, steps: int) -> Iterator[StepRecord]:
        """Collective. Step, hold every step against what all of them must keep, and yield it.

        The scales v_ref and gamma_ref are those of the first step where a later one has larger:
        a solver that sends bodies flying must not widen its own limits.
        """
        first: StepRecord | None = None
        for _ in range(steps):
            before = _momentum(simulation)
            record = simulation.step()
            self.effort.add(
                record.iterations, record.products, record.r_d, record.converged, record.reason
            )
            self._balance(simulation, record, before)
            first = first or record
            v_ref = min(record.v_ref, first.v_ref)
            yield replace(record, v_ref=v_ref, gamma_ref=min(record.gamma_ref, first.gamma_ref))

    def advance(self, simulation: Simulation, steps: int) -> Bodies:
        """Collective. Step, and return all bodies in the order of gid."""
        for _ in self.run(simulation, steps):
            pass
        return self.bodies(simulation)

    def bodies(self, simulation: Simulation) -> Bodies:
        """Collective. All bodies on every rank, in the order of gid."""
        return everybody(self.parallel, simulation.state)

    def check(self, what: str, error: float, limit: float, unit: str, source: str) -> None:
        """Hold an error against its limit; of checks with one name the worst is kept."""
        found = Check(what, float(error), float(limit), unit, source)
        known = self.checks.get(what)
        if known is None or not found.passed or _share(found) > _share(known):
            self.checks[what] = found

    @property
    def converged(self) -> bool:
        """Whether every solve reached its tolerance."""
        return not self.effort.failures

    @property
    def complaints(self) -> list[str]:
        """What is wrong, in words; nothing if the case is passed."""
        found = [str(check) for check in self.checks.values() if not check.passed]
        failures = self.effort.failures
        if failures:
            found.append(f"{len(failures)} of {len(self.effort.iterations)}: {failures[0]}")
        if self.solver == "scip" and max(self.effort.iterations) > NEWTON_LIMIT:
            found.append(f"{max(self.effort.iterations)} > {NEWTON_LIMIT} Newton iterations")
        return found

    @property
    def summary(self) -> dict[str, Any]:
        """Return effort and errors in plain numbers, for a JSON file."""
        iterations = self.effort.iterations
        return {
            "solver": self.solver,
            "solves": len(iterations),
            "iterations": {"max": max(iterations), "median": float(np.median(iterations))},
            "products": self.effort.products,
            "r_d": self.effort.dual,
            "converged": self.converged,
            "unconverged": len(self.effort.failures),
            "reasons": sorted(set(self.effort.failures)),
            "checks": [asdict(check) for check in self.checks.values()],
        }

    def _balance(self, simulation: Simulation, record: StepRecord, before: NDArray) -> None:
        """Collective. Energy, momentum and cones of a step."""
        recorder: RecordingSolver = simulation._solver
        problem, report = recorder.problem, recorder.report
        gamma = report.impulse
        diagonal = problem.operator.diagonal()
        after = _momentum(simulation)
        sums = np.array([np.sum(diagonal * gamma**2), np.sum(np.abs(gamma))])
        sums = self.parallel.sum(sums)
        largest = self.parallel.max(float(gamma[:, 0].max(initial=0.0)))
        h, gravity = simulation.scenario.time.step, np.array(simulation.scenario.gravity)

        energy = 2 * record.kinetic_energy + abs(record.energy_change) + float(sums[0])
        error = abs(record.energy_change - record.energy_balance)
        self.check(
            "energy balance of a step", _ratio(error, energy), ROUND_OFF, "1",
            "round-off of the summed terms",
        )  # fmt: skip
        mass = after[-1]
        walls = sum((np.array(force[:3]) for force in record.walls.values()), np.zeros(3))
        change = after[:3] - before[:3] - h * (mass * gravity - walls)
        size = after[6] + before[6] + h * mass * np.linalg.norm(gravity) + sums[1]
        error = float(np.linalg.norm(change))
        if not record.walls and not gravity.any():
            reach = max(after[8], before[8])
            spin = after[3:6] - before[3:6]
            turned = after[7] + before[7] + reach * sums[1]
            error = max(error, _ratio(float(np.linalg.norm(spin)), turned) * size)
        self.check(
            "momentum balance of a step", _ratio(error, size), ROUND_OFF, "1",
            "round-off of the summed terms",
        )  # fmt: skip
        self.check(
            "impulses outside their cones", _ratio(record.r_p, largest), CONE, "1",
            "of the largest impulse: projections round by a few eps",
        )  # fmt: skip


# Groups tell which materials and shapes a scene has; bodies from arrays take their place.
TEMPLATE: dict[str, Any] = {
    "material": "m",
    "count": 1,
    "radius": 1e-6,
    "placement": {"jittered_grid": {"min": [-1e-3, -1e-3, 1e-3], "max": [1e-3, 1e-3, 3e-3]}},
}


def _group_of(shape: int) -> dict[str, Any]:
    name = {SPHEROCYLINDER: "spherocylinder", SPHEROID: "spheroid"}[shape]
    return {**TEMPLATE, "shape": name, "aspect_ratio": 2.0}


def _share(check: Check) -> float:
    return check.error / check.limit if check.limit > 0.0 else check.error


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else part


def _momentum(simulation: Simulation) -> NDArray:
    """Collective. Linear and angular momentum, the sizes of their terms, the reach, the mass."""
    b = simulation.state.bodies
    linear = b.mass[:, None] * b.velocity
    d, w = integrator.symmetry_axes(b), b.angular_velocity
    along = (b.axial_inertia - b.inertia) * np.sum(w * d, axis=1)
    spin = b.inertia[:, None] * w + along[:, None] * d
    orbital = np.cross(b.position, linear)
    sizes = [np.linalg.norm(term, axis=1).sum() for term in (linear, orbital, spin)]
    angular = (orbital + spin).sum(axis=0)
    parallel = simulation.parallel
    total = np.concatenate(
        (linear.sum(axis=0), angular, [sizes[0], sizes[1] + sizes[2], b.mass.sum()])
    )
    total = parallel.sum(total)
    reach = parallel.max(float(np.linalg.norm(b.position, axis=1).max(initial=0.0)))
    return np.concatenate((total[:8], [reach, total[8]]))


# ---- the cases -----------------------------------------------------------------------------

Case = Callable[[Trial], None]
CASES: dict[str, Case] = {}
"""Every case by its name; the docstring of each says what it shows."""


def case(name: str) -> Callable[[Case], Case]:
    """Enter a function under a name in the battery."""

    def enter(function: Case) -> Case:
        CASES[name] = function
        return function

    return enter


def attempt(name: str, solver: str, parallel: Parallel | None = None) -> Trial:
    """Collective. Run one case with one solver; what became of it is in the trial."""
    trial = Trial(parallel or Parallel.alone(), solver)
    CASES[name](trial)
    return trial


# gamma_ref is that of the median contact. Where the median is light, an impulse p of 10^6 gamma_ref
# leaves rounding errors eps p/m in g, so eps p^2/m in p g: 10^12 eps = 2e-4 of v_ref gamma_ref, and
# no solver can be asked for less. (A fifty times larger limit still leaves no more than 1e-8 v_ref
# in the contact that carries p.) Where it is heavy, a light contact has a gamma_ref of its own.
MASS_RATIO_WORK = 1e-2


def stack(
    trial: Trial, material: Sequence[int], steps: int, speed: float = 0.0, work: float = WORK
) -> None:
    """Equal spheres on one another on a floor, falling as one at `speed` [m/s]: all of it stops.

    A gap is within h max(r_d, r_c/p) of zero, so a speed within twice the sum of those of the
    contacts below; the force on the floor misses the weight by the change of momentum.
    """
    count = len(material)
    position = [[0.0, 0.0, R * (1 + 2 * k)] for k in range(count)]
    simulation = trial.simulation(
        position, material=material, velocity=[0.0, 0.0, -speed], mu=0.3, walls=[FLOOR],
        contact={"complementarity": work},
    )  # fmt: skip
    left = np.zeros(count)
    for k, record in enumerate(trial.run(simulation, steps)):
        bodies = trial.bodies(simulation)
        push = G * H + (speed if k == 0 else 0.0)
        impulse = np.cumsum(bodies.mass[::-1])[::-1] * push
        stiffness = 3.5 * (1 / bodies.mass + np.append(0.0, 1 / bodies.mass[:-1]))
        left = np.maximum(left, separation_limit(record, impulse, work, stiffness))
        slow = 2 * np.cumsum(left)
        gaps = np.diff(bodies.position[:, 2], prepend=-R) - 2 * R
        trial.check("gap", np.abs(gaps).max(), H * left.max(), "m", "h max(r_d, r_c/p)")
        trial.check(
            "speed", np.abs(bodies.velocity[:, 2]).max(), slow.max(), "m/s",
            "sum of 2 max(r_d, r_c/p) over the contacts below",
        )  # fmt: skip
        expected = bodies.mass.sum() * push / H
        trial.check(
            "force on the floor, relative", abs(record.walls["floor"][2] + expected) / expected,
            2 * float(bodies.mass @ slow) / (expected * H), "1", "momentum at that speed",
        )  # fmt: skip
        trial.check("lateral position", np.abs(bodies.position[:, :2]).max(), 0.0, "m", "symmetry")


def separation_limit(
    record: StepRecord, impulse: ArrayLike, work: float = WORK, stiffness: ArrayLike = 0.0
) -> NDArray:
    """How far g_n [m/s] may be from zero in contacts that carry `impulse` [N s], solved as asked.

    max(r_d, r_c/p), with half of p, since the impulse itself is found to some accuracy only.
    stiffness : their N_tt [1/kg], where they may be lighter than the median contact
    """
    own = np.full(np.shape(stiffness), record.gamma_ref)
    np.divide(record.v_ref, stiffness, out=own, where=np.greater(stiffness, 0.0))
    scale = np.minimum(own, record.gamma_ref)
    return np.maximum(R_D, 2 * work * record.v_ref * scale / np.asarray(impulse))


@case("heavy on light")
def heavy_on_light(trial: Trial) -> None:
    """A sphere bears one of 10^6 times its mass: at rest, and landing at 1 m/s."""
    stack(trial, [0, 1], steps=10, work=MASS_RATIO_WORK)
    stack(trial, [0, 1], steps=10, speed=1.0, work=MASS_RATIO_WORK)


@case("light on heavy")
def light_on_heavy(trial: Trial) -> None:
    """A sphere lies on one of 10^6 times its mass; and a stack of light, heavy, light, heavy."""
    stack(trial, [1, 0], steps=10)
    stack(trial, [0, 1, 0, 1], steps=10, work=MASS_RATIO_WORK)


COLUMN = 1000
# The lowest contacts carry 10^3 gamma_ref, and keep g_n = r_c/p below 1e-8 v_ref with this.
COLUMN_WORK = 1e-5


@case("column of 1000")
def column(trial: Trial, count: int = COLUMN) -> None:
    """Spheres on one another in a square tube with 10^-3 r of clearance: a cold and a warm step.

    Nothing pushes sideways, and the floor bears the whole weight.
    """
    half = R * 1.001
    tube = {"shape": "box", "name": "tube", "material": "m", "open": ["z_max"]}
    tube |= {"min": [-half, -half, 0], "max": [half, half, 3 * count * R]}
    position = [[0.0, 0.0, R * (1 + 2 * k)] for k in range(count)]
    simulation = trial.simulation(
        position, mu=0.3, walls=[tube], contact={"complementarity": COLUMN_WORK}
    )
    # Gradients treat opposite walls alike, to the bit; elimination has an order.
    aside = 0.0 if trial.solver == "apgd" else 2 * EPS * G * H**2
    for record in trial.run(simulation, 2):
        bodies = trial.bodies(simulation)
        weight = bodies.mass.sum() * G
        above = np.cumsum(bodies.mass[::-1])[::-1] * G * H
        slow = 2 * np.cumsum(separation_limit(record, above, COLUMN_WORK))
        floor = record.walls["tube.z_min"][2]
        trial.check(
            "lateral position", np.abs(bodies.position[:, :2]).max(), aside, "m",
            "symmetry; a factor breaks it by round-off, eps g h^2 a step",
        )  # fmt: skip
        trial.check(
            "weight on the floor, relative", abs(floor + weight) / weight,
            2 * float(bodies.mass @ slow) / (weight * H), "1",
            "momentum at the speeds that max(r_d, r_c/p) leaves in each contact below",
        )  # fmt: skip
        trial.check(
            "speed", np.abs(bodies.velocity[:, 2]).max(), slow.max(), "m/s",
            "sum of 2 max(r_d, r_c/p) over the contacts below",
        )  # fmt: skip


# ---- friction ------------------------------------------------------------------------------

FRICTIONS = {"smooth": 0.0, "slick": 1e-3, "rough": 0.5, "sticky": 2.0}
SLOPE = math.radians(30.0)


def slide(trial: Trial, names: Sequence[str], steps: int = 100) -> None:
    """Spheres of given materials, apart from each other, let go on a slope of 30 degrees.

    Rolling (tan < 7/2 mu): v = 5/7 g t sin. Sliding: v_x + mu v_z = g t (sin - mu cos), for
    where a contact slips the relaxed law adds mu times the friction lost to the lift. A solve
    leaves r_d in g_n and mu |g_t|, and max(r_d, r_c/p) at most above zero: slips of that / mu.
    """
    mu = np.array([FRICTIONS[name] for name in names])
    n = len(names)
    pairs = [{"between": ["floor", name], "mu": FRICTIONS[name]} for name in names]
    simulation = trial.simulation(
        [[0.0, 10 * R * k, R] for k in range(n)],
        material=np.arange(n),
        materials={name: {"density": 1e3} for name in [*names, "floor"]},
        bodies=[{**TEMPLATE, "material": name} for name in names],
        friction={"default": 0.0, "pairs": pairs},
        gravity=(G * math.sin(SLOPE), 0.0, -G * math.cos(SLOPE)),
        walls=[{**FLOOR, "material": "floor"}],
    )
    bodies = trial.bodies(simulation)
    impulse = bodies.mass * G * H * math.cos(SLOPE)
    rolls = math.tan(SLOPE) < 3.5 * mu
    left = 0.0
    for k, record in enumerate(trial.run(simulation, steps), start=1):
        bodies = trial.bodies(simulation)
        left += separation_limit(record, impulse).max()
        t = k * H
        sliding = G * t * (math.sin(SLOPE) - mu * math.cos(SLOPE))
        speed = np.where(rolls, 5 / 7 * G * t * math.sin(SLOPE), sliding)
        found = bodies.velocity[:, 0] + np.where(rolls, 0.0, mu * bodies.velocity[:, 2])
        # Without friction a residual in g_n does not touch v_x.
        limit = np.where(mu > 0.0, left / np.where(mu > 0.0, mu, 1.0), 0.0) + ROUND_OFF * G * t
        for one, error, most in zip(mu, np.abs(found - speed), limit, strict=True):
            trial.check(
                f"speed down the slope, mu = {one:g}", error, most, "m/s",
                "max(r_d, r_c/p) / mu of slip a step",
            )  # fmt: skip
    smooth = mu == 0.0
    trial.check(
        "spin without friction", np.abs(bodies.angular_velocity[smooth]).max(initial=0.0), 0.0,
        "rad/s", "gamma_t = 0 exactly",
    )  # fmt: skip


for _name, _mu in FRICTIONS.items():
    case(f"mu = {_mu:g}")(lambda trial, name=_name: slide(trial, [name]))


@case("mixed mu")
def mixed_friction(trial: Trial) -> None:
    """The four friction coefficients side by side in one problem; each body as if alone."""
    slide(trial, list(FRICTIONS))


# ---- impulses that are not unique ----------------------------------------------------------


def lattice(trial: Trial, rng: np.random.Generator, side: int = 3) -> Simulation:
    """Spheres in a cubic lattice that fills a box, each with a random velocity."""
    half = R * side
    box = {"shape": "box", "name": "box", "material": "m", "open": ["z_max"]}
    box |= {"min": [-half, -half, 0], "max": [half, half, 3 * half]}
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    position = (2 * grid + 1) * R - [half, half, 0]
    velocity = rng.uniform(-0.1, 0.1, position.shape)
    return trial.simulation(position, velocity=velocity, mu=0.5, walls=[box])


@case("hyperstatic")
def hyperstatic(trial: Trial) -> None:
    """297 impulse components on 162 freedoms, from four starts: one velocity, any impulses.

    The bound is that of two solutions of one problem, with their residuals in it.
    """
    rng = np.random.default_rng(3)
    simulation = lattice(trial, rng)
    problem, guess = simulation.pose()
    wild = rng.uniform(0.0, 100.0, guess.shape[0]) * problem.impulse_scale
    pressed = np.zeros_like(guess)
    pressed[:, 0] = wild
    aslant = np.array(pressed)
    aslant[:, 1] = 0.5 * wild
    starts = [np.zeros_like(guess), pressed, aslant, np.full_like(guess, problem.impulse_scale)]
    compare_solutions(trial, simulation, problem, [solve(trial, simulation, s) for s in starts])
    freedoms = 6 * trial.parallel.sum(len(simulation.state.bodies))
    rows = trial.parallel.sum(problem.b.size)
    trial.check("freedoms over impulse components", freedoms / rows, 0.6, "1", "N is singular")


def solve(trial: Trial, simulation: Simulation, guess: NDArray) -> SolveReport:
    """Collective. Solve the next step's problem from `guess`, which is copied."""
    problem, _ = simulation.pose()
    report = simulation._solver.solve(problem, guess.copy(), None)
    dual = report.residuals.dual
    trial.effort.add(report.iterations, report.products, dual, report.converged, report.reason)
    return report


def compare_solutions(
    trial: Trial, simulation: Simulation, problem: ConeProblem, reports: Sequence[SolveReport]
) -> None:
    """Collective. Distances of velocities of solutions from the first one, and their bound."""
    bodies, parallel = simulation.state.bodies, trial.parallel
    first = reports[0]
    for other in reports[1:]:
        change = np.empty_like(first.impulse)
        problem.operator.apply(other.impulse - first.impulse, change)
        distance = parallel.sum(float(np.sum(change * (other.impulse - first.impulse))))
        terms = [abs(np.sum(r.impulse * r.velocity, axis=1)).sum() for r in (first, other)]
        pushes = [r.impulse[:, 0].sum() for r in (other, first)]
        sums = parallel.sum(np.array([*terms, *pushes, bodies.mass.sum()]))
        duals = first.residuals.dual, other.residuals.dual
        limit = sums[0] + sums[1] + duals[0] * sums[2] + duals[1] * sums[3]
        # Round-off of products with N, which even exact solutions have.
        rounding = ROUND_OFF * problem.velocity_scale * (sums[2] + sums[3])
        trial.check(
            "velocities of two solutions, root mean square", math.sqrt(max(distance, 0) / sums[4]),
            math.sqrt((limit + rounding) / sums[4]), "m/s", "residuals of both, see above",
        )  # fmt: skip


# ---- overlap -------------------------------------------------------------------------------


@case("deep overlap")
def deep_overlap(trial: Trial) -> None:
    """Five spheres in line, each half a radius into the next, and one as deep in a floor.

    Neighbours part at the recovery speed, exactly and never faster, until gaps are open; what
    jumps off the floor falls back from v^2/2g.
    """
    count, depth = 5, 0.5 * R
    mass = 4 / 3 * np.pi * R**3 * DENSITIES["m"]
    position = [[(2 * R - depth) * k, 0.0, 0.0] for k in range(count)]
    simulation = trial.simulation(position, mu=0.5, gravity=WEIGHTLESS)
    parting = math.ceil(depth / (RECOVERY * H))
    limit = 0.0
    for k, record in enumerate(trial.run(simulation, 2 * parting)):
        speed = np.diff(trial.bodies(simulation).velocity[:, 0])
        # m v_rec at least passes each contact of the row in the first step. Later on neither
        # impulse nor g are needed, and m |v - v*|^2 <= sum gamma.g is what is left of them.
        work = record.contacts * WORK * record.v_ref * record.gamma_ref
        first = 2 * float(separation_limit(record, mass * RECOVERY))
        limit += first if k == 0 else R_D + 2 * math.sqrt(work / mass)
        trial.check(
            "speed of parting less that of recovery", np.abs(speed - RECOVERY).max(), limit,
            "m/s", "2 max(r_d, r_c/p); then 2 (sum gamma.g / m)^1/2 a step",
        )  # fmt: skip
    gaps = np.diff(trial.bodies(simulation).position[:, 0]) - 2 * R
    trial.check("overlap left", max(0.0, -gaps.min()), 0.0, "m", "twice the steps it takes")

    simulation = trial.simulation([0.0, 0.0, R - depth], mu=0.5, walls=[FLOOR])
    top = 0.0
    for _ in trial.run(simulation, 2 * parting + math.ceil(2 * RECOVERY / (G * H))):
        bodies = trial.bodies(simulation)
        top = max(top, bodies.position[0, 2] - R)
        trial.check(
            "rebound above that of recovery", bodies.velocity[0, 2] - RECOVERY, 10 * R_D, "m/s",
            "r_d, r_c/p",
        )  # fmt: skip
    # The step in which the gap opens may end h v_rec above the floor.
    trial.check(
        "height of the rebound", top, RECOVERY**2 / (2 * G) + RECOVERY * H, "m", "v^2/2g + h v"
    )
    trial.check("height at rest", abs(bodies.position[0, 2] - R), 10 * H * R_D, "m", "h r_d, r_c/p")


@case("coincident centres")
def coincident(trial: Trial) -> None:
    """Three spheres in one point part along e_z, the agreed normal, at v_rec each from the next.

    Three parallel contacts on two relative freedoms: the one of the outer two carries nothing.
    """
    simulation = trial.simulation(np.zeros((3, 3)), mu=0.5, gravity=WEIGHTLESS)
    (record,) = trial.run(simulation, 1)
    bodies = trial.bodies(simulation)
    expected = np.zeros((3, 3))
    expected[:, 2] = [-RECOVERY, 0.0, RECOVERY]
    limit = 2 * separation_limit(record, bodies.mass[0] * RECOVERY)
    trial.check(
        "velocity", np.abs(bodies.velocity - expected).max(), limit, "m/s", "2 max(r_d, r_c/p)"
    )
    trial.check("pairs not counted as coincident", 3 - record.coincident, 0, "1", "all three")


# ---- sizes, spins, steps -------------------------------------------------------------------


@case("size ratio 100")
def size_ratio(trial: Trial) -> None:
    """A sphere on three of a hundredth of its radius, a millionth of its mass.

    Each bears a third. The small ones touch it at theta from below, and roll off unless friction
    carries p tan(theta/2) at both ends.
    """
    big, small = 0.1, 1e-3
    away = 4e-3  # of the small ones from the axis
    height = small + math.sqrt((big + small) ** 2 - away**2)
    angle = 2 * np.pi / 3 * np.arange(3)
    ring = np.stack([away * np.cos(angle), away * np.sin(angle), np.full(3, small)], axis=1)
    simulation = trial.simulation(
        [*ring, [0.0, 0.0, height]], radius=[small, small, small, big], mu=0.3, walls=[FLOOR],
        contact={"complementarity": MASS_RATIO_WORK},
    )  # fmt: skip
    for record in trial.run(simulation, 5):
        bodies = trial.bodies(simulation)
        impulse = bodies.mass[3] * G * H / 3
        left = separation_limit(record, impulse, MASS_RATIO_WORK)
        lean = 1 / math.cos(math.asin(away / (big + small)))
        trial.check(
            "speed", np.linalg.norm(bodies.velocity, axis=1).max(), 4 * lean * left / 0.3, "m/s",
            "r_d, r_c/p of both contacts below the large one, over mu, of two steps",
        )  # fmt: skip
        weight = bodies.mass.sum() * G
        trial.check(
            "force on the floor, relative", abs(record.walls["floor"][2] + weight) / weight,
            8 * lean * left / (0.3 * G * H), "1", "momentum at that speed",
        )  # fmt: skip
    trial.check(
        "share of each small sphere, of a third", _uneven(trial, simulation, 3), 1e-3, "1",
        "symmetry; impulses are known to the residuals' speeds over g h",
    )  # fmt: skip


def _uneven(trial: Trial, simulation: Simulation, count: int) -> float:
    """Collective. The largest deviation of the `count` impulses on the floor that bear weight
    from their mean, over that."""
    report, memory = simulation._solver.report, simulation.state.memory
    on_floor = report.impulse[memory.other < 0, 0]
    every = np.concatenate(trial.parallel.broadcast(trial.parallel.gather(on_floor)))
    every = np.sort(every)[-count:]
    return float(np.abs(every / every.mean() - 1).max())


@case("spin 1e4 rad/s")
def fast_spin(trial: Trial) -> None:
    """About the normal, along the floor, and in a head-on impact; of a spheroid on its flat side.

    About the normal nothing slips: the body stays and spins. Along the floor the relaxed law
    lifts it at mu times its slip, p = (mu s0 + g h)/(1 + 7/2 mu^2) per unit mass.
    """
    spin, mu = 1e4, 0.3
    simulation = trial.simulation([0.0, 0.0, R], spin=[0, 0, spin], mu=mu, walls=[FLOOR])
    for record in trial.run(simulation, 50):
        bodies = trial.bodies(simulation)
        limit = 2 * separation_limit(record, bodies.mass[0] * G * H) / mu
        moved = np.linalg.norm(bodies.velocity, axis=1).max()
        trial.check("speed of a spinning top", moved, limit, "m/s", "2 max(r_d, r_c/p) / mu")
        turned = np.abs(bodies.angular_velocity - [0, 0, spin]).max()
        trial.check(
            "change of its spin, relative", turned / spin, 2.5 * limit / (R * spin) + ROUND_OFF,
            "1", "that speed at the rim",
        )  # fmt: skip

    simulation = trial.simulation([0.0, 0.0, R], spin=[0, spin, 0], mu=mu, walls=[FLOOR])
    (record,) = trial.run(simulation, 1)
    bodies = trial.bodies(simulation)
    slip = -spin * R  # of the contact point, v - w x r
    p = (mu * abs(slip) + G * H) / (1 + 3.5 * mu**2)
    expected = [mu * p, 0.0, p - G * H]
    limit = 2 * float(separation_limit(record, bodies.mass[0] * p)) / mu
    trial.check(
        "velocity after spinning on the floor", np.abs(bodies.velocity[0] - expected).max(), limit,
        "m/s", "2 max(r_d, r_c/p) / mu",
    )  # fmt: skip

    simulation = trial.simulation(
        [[0.0, 0.0, 0.0], [2 * R, 0.0, 0.0]], velocity=[[1.0, 0, 0], [-1.0, 0, 0]],
        spin=[[0, spin, 0], [0, spin, 0]], mu=mu, gravity=WEIGHTLESS,
    )  # fmt: skip
    energy = _energy(trial.bodies(simulation))
    for record in trial.run(simulation, 20):
        trial.check(
            "growth of energy, relative", record.kinetic_energy / energy - 1.0, ROUND_OFF, "1",
            "an impact without overlap only dissipates",
        )  # fmt: skip

    flat = 0.2 * R
    simulation = trial.simulation(
        [0.0, 0.0, flat], shape=SPHEROID, half_length=flat, spin=[0, 0, spin], mu=mu, walls=[FLOOR]
    )
    for record in trial.run(simulation, 50):
        bodies = trial.bodies(simulation)
        limit = 4 * separation_limit(record, bodies.mass[0] * G * H) / mu
        moved = np.linalg.norm(bodies.velocity, axis=1).max()
        trial.check("speed of a spinning spheroid", moved, limit, "m/s", "max(r_d, r_c/p) / mu")
        tilt = 1.0 - abs(float(integrator.symmetry_axes(bodies)[0, 2]))
        trial.check("its tilt, 1 - cos", tilt, ROUND_OFF, "1", "no torque across the axis")


def _energy(b: Bodies) -> float:
    return integrator.kinetic_energy(b, b.velocity, b.angular_velocity)


TEN_BOX = {"shape": "box", "name": "box", "material": "m", "open": ["z_max"]}
TEN_BOX |= {"min": [-2 * R, -2 * R, 0], "max": [2 * R, 2 * R, 20 * R]}


def ten() -> NDArray:
    """Four spheres, one in their pocket, four more and the last: centres (10, 3) [m] in a box.

    (Piles that no wall holds are no use here: a tetrahedral one of ten rolls apart at mu = 0.5,
    however small the disturbance.)
    """
    four = np.array([[x, y, 0.0] for x in (-R, R) for y in (-R, R)])
    one, rise = np.zeros((1, 3)), np.array([0.0, 0.0, math.sqrt(2) * R])
    layers = [four, one + rise, four + 2 * rise, one + 3 * rise]
    return np.concatenate(layers) + [0.0, 0.0, R]


def rest(trial: Trial, step: float, steps: int, mu: float = 0.5) -> None:
    """Ten spheres at rest in a box stay where they are, however long.

    After every step all loaded gaps lie within h max(r_d, r_c/p) of zero, p a tenth of a body's
    weight at least. 32 of them determine the 30 coordinates, so that these stray no further than
    the gaps over the least singular value: a bound of the state, which time does not enter.
    """
    start_at = ten()
    # Between walls a residual of -1e-11 m/s, within the tolerance, is an overlap that nothing can
    # resolve: the next problem has no admissible velocity, and no central path. The interior point
    # method leaves none if it begins from nothing.
    warm = {"warm_start": trial.solver == "apgd"}
    simulation = trial.simulation(
        start_at, mu=mu, walls=[TEN_BOX], step=step, end=steps * step, contact=warm
    )
    least = 0.1 * 4 / 3 * np.pi * R**3 * DENSITIES["m"] * G * step
    stiffness = _gap_gradients(start_at)
    sigma = np.linalg.svd(stiffness, compute_uv=False)[-1]
    bound = 0.0
    for record in trial.run(simulation, steps):
        speed = float(separation_limit(record, least))
        bound = max(bound, math.sqrt(len(stiffness)) / sigma * speed)
        bodies = simulation.state.bodies
        mine = start_at[bodies.gid]
        moved = trial.parallel.max(float(np.abs(bodies.position - mine).max(initial=0.0)))
        trial.check(
            "displacement", moved, step * bound, "m",
            "h max(r_d, r_c/p) in each gap, over the least singular value of their gradients",
        )  # fmt: skip
        trial.check("speed", record.largest_speed, 2 * bound, "m/s", "twice that over h")
        trial.check(
            "overlap", record.overlap * R, step * R_D + ROUND_OFF * R, "m", "h r_d after any step"
        )


def _gap_gradients(position: NDArray) -> NDArray:
    """d gap / d coordinates (32, 30) of the contacts of `ten` that bear load."""
    rows = []
    for i, x in enumerate(position):
        for axis, wall in ((0, 2 * R), (1, 2 * R)):
            if abs(abs(x[axis]) + R - wall) < 1e-6 * R:
                rows.append((i, -1, -np.sign(x[axis]) * np.eye(3)[axis]))
        if abs(x[2] - R) < 1e-6 * R:
            rows.append((i, -1, np.eye(3)[2]))
        for j in range(i):
            apart = x - position[j]
            # Neighbours of one layer touch as well, and bear nothing.
            if abs(np.linalg.norm(apart) - 2 * R) < 1e-6 * R and abs(apart[2]) > 1e-6 * R:
                rows.append((i, j, apart / (2 * R)))
    gradients = np.zeros((len(rows), len(position), 3))
    for row, (i, j, normal) in zip(gradients, rows, strict=True):
        row[i] = normal
        if j >= 0:
            row[j] = -normal
    return gradients.reshape(len(rows), -1)


@case("ten at rest")
def ten_at_rest(trial: Trial) -> None:
    """Ten spheres at rest in a box do not creep in 10^4 steps."""
    rest(trial, H, 10_000)


@case("step 1e-6 s")
def tiny_step(trial: Trial) -> None:
    """A landing resolved to a micrometre, and the ten at rest."""
    land(trial, step=1e-6, gap=1.5e-6)
    rest(trial, 1e-6, 20)


@case("step 1e-1 s")
def huge_step(trial: Trial) -> None:
    """A landing in one stride of ten radii, and the ten at rest."""
    land(trial, step=0.1, gap=0.12)
    rest(trial, 0.1, 20)


def land(trial: Trial, step: float, gap: float, speed: float = 1.0) -> None:
    """A sphere falls on a floor: it arrives with the gap closed, to h r_d, and then rests."""
    simulation = trial.simulation(
        [0.0, 0.0, R + gap], velocity=[0.0, 0.0, -speed], mu=0.5, walls=[FLOOR], step=step,
        end=1e3 * step,
    )  # fmt: skip
    v, z = -speed, gap
    for record in trial.run(simulation, 5):
        # v+ = max(v - g h, -z/h): it stops at the floor, within the step.
        v = max(v - G * step, -z / step)
        z += step * v
        bodies = trial.bodies(simulation)
        limit = 2 * separation_limit(record, bodies.mass[0] * G * step) + ROUND_OFF * R / step
        error = abs(bodies.velocity[0, 2] - v)
        trial.check("landing speed", error, limit, "m/s", "2 max(r_d, r_c/p)")
        trial.check(
            "landing height", abs(bodies.position[0, 2] - R - z), step * limit + ROUND_OFF * R,
            "m", "h times that",
        )  # fmt: skip


# ---- wedge, weightlessness -----------------------------------------------------------------

HALF_ANGLE = math.radians(15.0)  # of the wedge


@case("wedge that jams")
def wedge(trial: Trial) -> None:
    """A sphere in a groove of half angle 15 degrees: let go, shot in, and pulled out.

    Out along the axis at speed u both contacts have g_n = u sin, g_t = u cos. With mu > tan no
    u but zero is admissible: it jams, at any pull, and impulses have no bound. With mu < tan it
    follows the pull as if nothing were there.
    """
    sine, cosine = math.sin(HALF_ANGLE), math.cos(HALF_ANGLE)
    walls = [
        {**FLOOR, "name": name, "normal": [side * cosine, 0.0, sine]}
        for name, side in (("left", 1.0), ("right", -1.0))
    ]
    for mu in (0.1, 0.5):
        jams = mu > math.tan(HALF_ANGLE)
        for speed, pull in ((0.0, -G), (1.0, -G), (0.0, G), (0.0, 100 * G)):
            simulation = trial.simulation(
                [0.0, 0.0, R / sine], velocity=[0, 0, -speed], mu=mu, walls=walls,
                gravity=(0.0, 0.0, pull),
            )  # fmt: skip
            (record,) = trial.run(simulation, 1)
            bodies = trial.bodies(simulation)
            free = pull > 0.0 and not jams
            expected = pull * H if free else 0.0
            least = bodies.mass[0] * abs(pull * H - speed) / (2 * (sine + mu * cosine))
            left = 0.0 if free else float(separation_limit(record, least))
            # Along the groove and in rotation only friction holds it; else the wedge does.
            limit = ROUND_OFF + 2 * left / min(mu, sine)
            error = np.linalg.norm(bodies.velocity[0] - [0.0, 0.0, expected])
            name = "jammed" if jams else ("pulled out" if free else "at rest, mu < tan")
            trial.check(f"velocity {name}", error, limit, "m/s", "2 max(r_d, r_c/p) over sin or mu")


@case("zero gravity")
def zero_gravity(trial: Trial) -> None:
    """Touching spheres at rest: nothing at all happens. A row struck at its end moves on as one.

    The first has v_ref = 0 and gamma_ref = 0, by which nothing may be divided.
    """
    grid = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    simulation = trial.simulation(2 * R * grid, mu=0.5, gravity=WEIGHTLESS)
    for record in trial.run(simulation, 3):
        bodies = trial.bodies(simulation)
        trial.check("speed of bodies at rest", np.abs(bodies.velocity).max(), 0.0, "m/s", "b = 0")
        trial.check("iterations on it", record.iterations, 0, "1", "the guess is the solution")
    count = 5
    simulation = trial.simulation(
        [[2 * R * k, 0.0, 0.0] for k in range(count)], mu=0.5, gravity=WEIGHTLESS,
        velocity=[[1.0, 0, 0]] + [[0.0, 0, 0]] * (count - 1),
    )  # fmt: skip
    (record,) = trial.run(simulation, 1)
    bodies = trial.bodies(simulation)
    # The last contact passes on least: m/count times the speed.
    limit = count * separation_limit(record, bodies.mass[0] / count)
    expected = np.tile([1.0 / count, 0.0, 0.0], (count, 1))
    trial.check(
        "velocity of the row", np.abs(bodies.velocity - expected).max(), limit, "m/s",
        "max(r_d, r_c/p) in each contact",
    )  # fmt: skip


# ---- rods and spheroids --------------------------------------------------------------------

LYING = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # the axis along x


@case("rods and spheroids")
def long_bodies(trial: Trial) -> None:
    """A rod lies on two contacts, rolls down a slope, and parts from another in the same place;
    a spheroid lies on its side, another stands on its tip.

    A rod rolls with g sin / (1 + I_a/(m r^2)).
    """
    half, mu = 3 * R, 0.5
    rod = {"shape": SPHEROCYLINDER, "half_length": half, "orientation": LYING, "mu": mu}
    simulation = trial.simulation([0.0, 0.0, R], walls=[FLOOR], **rod)
    for record in trial.run(simulation, 20):
        bodies = trial.bodies(simulation)
        limit = 2 * separation_limit(record, 0.5 * bodies.mass[0] * G * H) / mu
        trial.check("speed of a lying rod", _speed(bodies), limit, "m/s", "max(r_d, r_c/p) / mu")
        trial.check(
            "its two impulses, of a half", _uneven(trial, simulation, 2), limit / (G * H), "1",
            "that speed over g h",
        )  # fmt: skip

    gravity = (0.0, G * math.sin(SLOPE), -G * math.cos(SLOPE))
    simulation = trial.simulation([0.0, 0.0, R], walls=[FLOOR], gravity=gravity, **rod)
    left = 0.0
    for k, record in enumerate(trial.run(simulation, 50), start=1):
        bodies = trial.bodies(simulation)
        share = 1 + bodies.axial_inertia[0] / (bodies.mass[0] * R**2)
        impulse = 0.5 * bodies.mass[0] * G * H * math.cos(SLOPE)
        left += float(separation_limit(record, impulse)) / mu
        error = abs(bodies.velocity[0, 1] - gravity[1] * k * H / share)
        trial.check("speed of a rolling rod", error, left, "m/s", "max(r_d, r_c/p) / mu a step")

    simulation = trial.simulation(np.zeros((2, 3)), gravity=WEIGHTLESS, **rod)
    (record,) = trial.run(simulation, 1)
    bodies = trial.bodies(simulation)
    limit = 4 * float(separation_limit(record, 0.25 * bodies.mass[0] * RECOVERY))
    speed = bodies.velocity[1] - bodies.velocity[0]
    trial.check(
        "parting speed of coincident rods", abs(np.linalg.norm(speed) - RECOVERY), limit, "m/s",
        "max(r_d, r_c/p)",
    )  # fmt: skip

    for orientation, height in ((LYING, R), ((1.0, 0.0, 0.0, 0.0), half)):
        simulation = trial.simulation(
            [0.0, 0.0, height], shape=SPHEROID, half_length=half, orientation=orientation, mu=mu,
            walls=[FLOOR],
        )  # fmt: skip
        for record in trial.run(simulation, 20):
            bodies = trial.bodies(simulation)
            limit = 2 * separation_limit(record, bodies.mass[0] * G * H) / mu
            trial.check("speed of a spheroid", _speed(bodies), limit, "m/s", "max(r_d, r_c/p) / mu")


def _speed(bodies: Bodies) -> float:
    """The largest speed of a body and of its surface, [m/s]."""
    rim = bodies.bounding_radius * np.linalg.norm(bodies.angular_velocity, axis=1)
    return float((np.linalg.norm(bodies.velocity, axis=1) + rim).max())
