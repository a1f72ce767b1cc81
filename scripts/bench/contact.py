"""Speed against error of the contact solve, on snapshots of 25,000 settling spheres.

    python scripts/bench/contact.py [--quick] [--json FILE] [--figure FILE]

Runs configs/sedimentation.yaml to rest once on 2 ranks (tens of minutes; kept under build/bench,
resumed if interrupted), takes five snapshots of it and solves each one's cone problem to
r_d = 1e-2, 1e-4, 1e-6 m/s, cold and warm, on 1 and 2 ranks. Beside that: the cost of an iteration
per contact, matrix-free against D in PETSc; iterations under the criterion of S. De's Table 2.1;
seconds by phase; detection; what a frictionless scene saves. --quick: 2,000 spheres.
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from records import BUILD, ROOT, Record, arguments, mpirun, write

SCENE = ROOT / "configs" / "sedimentation.yaml"
QUICK = [
    "bodies.0.count=2000",
    "bodies.0.placement.jittered_grid.max=[0.2828,0.2828,0.5]",
    "walls.0.max=[0.2828,0.2828,0.5]",
]
TOLERANCES = (1e-2, 1e-4, 1e-6)
THESIS_TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4)
THESIS_ITERATIONS = {1e-1: 409, 1e-2: 433, 1e-3: 470, 1e-4: 509}  # S. De 2021, Table 2.1
PHASES = ("cloud", "first contacts", "landed", "settling", "rest")


# ---- the run that snapshots come from ------------------------------------------------------


def make_run(quick: bool) -> Path:
    """Run the scene to rest, or go on with it; return the directory of its checkpoints."""
    directory = BUILD / ("sedimentation-quick" if quick else "sedimentation")
    if not (directory / "done").exists():
        command = ["-m", "dem_mpi", "run", str(SCENE), "--out", str(directory), "--resume"]
        for value in ["checkpoint.keep=100000", *(QUICK if quick else [])]:
            command += ["--set", value]
        directory.mkdir(parents=True, exist_ok=True)
        mpirun(2, command)
        (directory / "done").touch()
    return directory


def lines_of(directory: Path) -> list[dict[str, Any]]:
    """Return the run's metrics, one record a step."""
    return [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]


def snapshots(directory: Path) -> dict[str, Path]:
    """Choose five checkpoints by what the bed does at them."""
    lines = {line["step"]: line for line in lines_of(directory)}
    checkpoints = sorted(directory.glob("run.checkpoint.*.h5"))
    step_of = {path: int(path.name.split(".")[2]) for path in checkpoints}
    known = [path for path in checkpoints if step_of[path] in lines]
    most = max(line["contacts"] for line in lines.values())

    def first(condition: Callable[[dict[str, Any]], bool]) -> Path:
        return next((p for p in known if condition(lines[step_of[p]])), known[-1])

    touching = first(lambda line: line["contacts"] > 0.2 * most)
    landed = first(lambda line: line["contacts"] > 0.9 * most)
    after = [p for p in known if step_of[p] > step_of[landed]]
    settling = next((p for p in after if lines[step_of[p]]["kinetic_speed"] < 0.02), known[-1])
    return dict(zip(PHASES, (known[0], touching, landed, settling, known[-1]), strict=True))


# ---- work on the ranks ---------------------------------------------------------------------


def load(parallel, checkpoint: Path, operator: str = "matrix_free", mu: float | None = None):
    """Collective. A simulation standing at a checkpoint, whatever ranks wrote it."""
    from dem_mpi.scenario import restore_scenario
    from dem_mpi.simulation import Simulation, redistribute
    from dem_mpi.state import restore

    state, scene = restore(parallel, checkpoint)
    scene["contact"]["operator"] = operator
    if mu is not None:
        scene["friction"] = {"default": mu, "pairs": []}
    if state.reference is None:
        state = redistribute(parallel, state)
    return Simulation(parallel, restore_scenario(scene), state)


def work(task: dict[str, Any], result: Path) -> None:
    """Collective. Do one task; rank 0 writes its results."""
    from dem_mpi.parallel import Parallel
    from dem_mpi.warmup import warm_up

    parallel = Parallel()
    parallel.install_abort_hook()
    warm_up(parallel, 1, ("matrix_free", "assembled"))
    found = {"solves": solves, "iterations": thesis_iterations, "steps": steps}[task["kind"]](
        parallel, task
    )
    if parallel.rank == 0:
        result.write_text(json.dumps(found))


def solves(parallel, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Solve each snapshot at each tolerance, cold and warm, several times."""
    from dem_mpi.cone import Tolerance
    from dem_mpi.solvers.apgd import Apgd, ApgdOptions

    found = []
    for phase, checkpoint in task["snapshots"].items():
        simulation = load(parallel, Path(checkpoint), task.get("operator", "matrix_free"))
        problem, guess = simulation.pose()
        contacts = parallel.sum(problem.contacts)
        for tolerance in task["tolerances"]:
            solver = Apgd(
                ApgdOptions(Tolerance(tolerance, relative_work=np.inf), task["max_iterations"])
            )
            for start in task["starts"]:
                seconds = []
                for _ in range(task["runs"]):
                    parallel.barrier()
                    began = perf_counter()
                    report = solver.solve(problem, guess * (start == "warm"))
                    seconds.append(parallel.max(perf_counter() - began))
                found.append(
                    {
                        "phase": phase,
                        "tolerance": tolerance,
                        "start": start,
                        "contacts": contacts,
                        "iterations": report.iterations,
                        "products": report.products,
                        "seconds": statistics.median(seconds),
                        "r_d": report.residuals.dual,
                        "r_c": report.residuals.complementarity,
                        "objective": report.residuals.objective,
                        "converged": report.converged,
                    }
                )
        simulation.destroy()
    return found


def thesis_iterations(parallel, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Iterations from zero under max(r_p, r_d, r_c) < tau of S. De (2.35-2.37)."""
    from dem_mpi.cone import Tolerance
    from dem_mpi.solvers.apgd import Apgd, ApgdOptions

    found = []
    for checkpoint in task["checkpoints"]:
        simulation = load(parallel, Path(checkpoint))
        problem, guess = simulation.pose()
        for tau in THESIS_TOLERANCES:
            solver = Apgd(ApgdOptions(Tolerance(tau, kind="thesis"), 10000))
            report = solver.solve(problem, np.zeros_like(guess))
            found.append({"tau": tau, "iterations": report.iterations})
        simulation.destroy()
    return found


def steps(parallel, task: dict[str, Any]) -> dict[str, Any]:
    """Take steps from a snapshot; seconds by phase, detection from a new list each time."""
    from dem_mpi.metrics import PHASES as TIMED
    from dem_mpi.simulation import SolverFailureError

    simulation = load(parallel, Path(task["checkpoint"]), mu=task.get("mu"))
    rows, bodies = [], parallel.sum(len(simulation.state.bodies))
    for _ in range(task["steps"]):
        simulation.forget_neighbours()
        try:
            record = simulation.step()
        except SolverFailureError:
            break
        rows.append(parallel.max(simulation.timer.step).tolist())
        simulation.timer.finish_step()
    simulation.destroy()
    median = np.median(np.array(rows), axis=0)
    return {
        "bodies": bodies,
        "contacts": record.contacts,
        "iterations": record.iterations,
        "seconds": dict(zip(TIMED, median.tolist(), strict=True)),
    }


# ---- the figures ---------------------------------------------------------------------------


def measure(task: dict[str, Any], ranks: int) -> Any:
    """Run a task on so many ranks and return what it found."""
    BUILD.mkdir(parents=True, exist_ok=True)
    result = BUILD / "result.json"
    result.unlink(missing_ok=True)
    mpirun(ranks, [str(Path(__file__).resolve()), "--worker", json.dumps(task), str(result)])
    return json.loads(result.read_text())


def bench(quick: bool) -> tuple[list[Record], list[dict[str, Any]]]:
    """Measure everything; return the records and the solves for the figure."""
    directory = make_run(quick)
    chosen = {phase: str(path) for phase, path in snapshots(directory).items()}
    bodies = 2000 if quick else 25000
    base = {"spheres": bodies}
    records: list[Record] = []
    curves: list[dict[str, Any]] = []
    task = {
        "kind": "solves",
        "snapshots": chosen,
        "tolerances": TOLERANCES,
        "starts": ("cold", "warm"),
        "max_iterations": 50000,
        "runs": 3 if quick else 1,
    }
    for ranks in (1, 2):
        for row in measure(task, ranks):
            curves.append(row | {"ranks": ranks})
            params = base | {
                k: row[k] for k in ("phase", "tolerance", "start", "contacts", "converged")
            }
            for name, unit in (
                ("iterations", "1"), ("products", "1"), ("seconds", "s"), ("objective", "J"),
            ):  # fmt: skip
                records.append(
                    Record(
                        f"contact.{name}", params, row[name], unit,
                        error=row["r_d"], runs=task["runs"], ranks=ranks,
                    )
                )  # fmt: skip

    rest = {"rest": chosen["rest"]}
    per = {}
    for operator in ("matrix_free", "assembled"):
        repeated = task | {
            "snapshots": rest, "tolerances": (1e-12,), "starts": ("cold",),
            "max_iterations": 100, "runs": 5, "operator": operator,
        }  # fmt: skip
        row = measure(repeated, 1)[0]
        per[operator] = row["seconds"] / row["iterations"] / row["contacts"] * 1e9
    records.append(
        Record(
            "contact.ns_per_contact_iteration", base | {"phase": "rest"}, per["matrix_free"],
            "ns", "D and M^-1 in PETSc", per["assembled"], per["matrix_free"] / per["assembled"],
            runs=5,
        )
    )  # fmt: skip
    settled = next(
        c for c in curves
        if (c["phase"], c["tolerance"], c["start"], c["ranks"]) == ("rest", 1e-4, "cold", 1)
    )  # fmt: skip
    records.append(
        Record(
            "contact.matvecs_to_1e-4_settled", base | {"contacts": settled["contacts"]},
            settled["products"], "1", error=settled["r_d"],
        )
    )  # fmt: skip

    every = sorted(directory.glob("run.checkpoint.*.h5"))[2:42:3]
    sampled = measure({"kind": "iterations", "checkpoints": [str(p) for p in every]}, 2)
    for tau in THESIS_TOLERANCES:
        counts = [row["iterations"] for row in sampled if row["tau"] == tau]
        median = statistics.median(counts)
        # The thesis gives counts for 25,000 spheres, at an instant that it does not state.
        rival = (
            {}
            if quick
            else {
                "rival": "S. De 2021, Table 2.1",
                "rival_value": THESIS_ITERATIONS[tau],
                "ratio": median / THESIS_ITERATIONS[tau],
            }
        )
        params = base | {"tau": tau, "steps": len(counts), "maximum": max(counts)}
        records.append(
            Record(
                "contact.thesis_iterations", params, median, "1", runs=len(counts), ranks=2, **rival
            )
        )

    for ranks in (1, 2):
        timed = measure({"kind": "steps", "checkpoint": chosen["rest"], "steps": 7}, ranks)
        seconds, total = timed["seconds"], sum(timed["seconds"].values())
        for phase, value in seconds.items():
            if phase != "record":
                records.append(
                    Record(f"contact.step_seconds.{phase}", base, value, "s", runs=7, ranks=ranks)
                )
        detection = seconds["partition"] + seconds["neighbours"] + seconds["contacts"]
        records.append(
            Record("contact.step_share_detection", base, detection / total, "1", runs=7,
                   ranks=ranks)
        )  # fmt: skip
        records.append(
            Record("contact.detection_rate", base, timed["bodies"] / detection, "bodies/s",
                   runs=7, ranks=ranks)
        )  # fmt: skip
    slippery = measure({"kind": "steps", "checkpoint": chosen["rest"], "steps": 7, "mu": 0.0}, 1)
    rough = measure({"kind": "steps", "checkpoint": chosen["rest"], "steps": 7}, 1)

    def per_iteration(timed: dict[str, Any]) -> float:
        return timed["seconds"]["solve"] / max(timed["iterations"], 1) / timed["contacts"] * 1e9

    records.append(
        Record(
            "contact.ns_per_contact_iteration_frictionless", base, per_iteration(slippery), "ns",
            "the same bed with friction", per_iteration(rough),
            per_iteration(slippery) / per_iteration(rough), runs=7,
        )
    )  # fmt: skip
    return records, curves


def draw(curves: list[dict[str, Any]], path: Path) -> None:
    """Work-precision curves: seconds against the residual reached, by phase."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    for k, phase in enumerate(PHASES):
        for start, style in (("cold", "o-"), ("warm", "s--")):
            rows = [
                c for c in curves
                if c["phase"] == phase and c["start"] == start and c["ranks"] == 1
            ]  # fmt: skip
            label = phase if start == "cold" else None
            error = [max(c["r_d"], 1e-8) for c in rows]
            axes[0].loglog(error, [c["seconds"] for c in rows], style, color=f"C{k}", label=label)
            axes[1].loglog(
                error, [max(c["iterations"], 1) for c in rows], style, color=f"C{k}", label=label
            )
    axes[0].set_ylabel("seconds, 1 rank")
    axes[1].set_ylabel("APGD iterations")
    for axis in axes:
        axis.set_xlabel("dual residual reached [m/s]")
        axis.invert_xaxis()
        axis.grid(True, which="both", alpha=0.25)
    axes[0].legend(title="solid cold, dashed warm", fontsize=8, title_fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Parse the options and write records and figure."""
    if sys.argv[1:2] == ["--worker"]:
        work(json.loads(sys.argv[2]), Path(sys.argv[3]))
        return
    options = arguments(__doc__.splitlines()[0]).parse_args()
    records, curves = bench(options.quick)
    write(records, options.json)
    if options.figure:
        draw(curves, options.figure)


if __name__ == "__main__":
    main()
