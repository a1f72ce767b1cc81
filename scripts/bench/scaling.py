"""What a step costs from ten thousand to two million spheres, and on 512 cores by a fitted model.

    python scripts/bench/scaling.py [--quick] [--json FILE] [--figure FILE]
        [--only PART ...] [--scene FILE ...]

Parts: two_million, memory, detection, scaling (strong, weak, the model) and imbalance. Beds are
those of configs/weak_scaling.yaml, S. De's scaling scene, stacked eleven layers deep as a jittered
lattice in which all six neighbours are contacts: as deep as that scene settles, but there at once.
Seconds are taken on 1 and 2 ranks; on more ranks than cores only bytes, messages, iterations and
memory are. docs/scaling.md explains the figures and the assumptions of the model. --quick: a
twentieth of the size. Imbalance: configs/hopper.yaml and configs/drum.yaml unless --scene says
otherwise.
"""

from __future__ import annotations

import json
import math
import os
import re
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lib import scaling_model as model
from numpy.typing import NDArray
from records import BUILD, ROOT, Record, arguments, mpirun, save, write

SCENE = ROOT / "configs" / "weak_scaling.yaml"
RADIUS = 0.01
LAYERS = 11
# Gaps stay below 0.0038 r, within the margin 0.02 r and less than gravity closes in one step.
SPACING, JITTER = 2.002 * RADIUS, 0.9
LOOSE = 2.4 * RADIUS  # no pair is near
WIDE_MARGIN = 0.85  # makes contacts of the next neighbours of the lattice, nine a body
BODY_LIMIT, CONTACT_LIMIT = 600, 400  # bytes
DETECTION = ("partition", "neighbours", "contacts")
OTHER = ("assemble", "advance")
CORES, SPHERES_A_CORE = 512, 500_000


@dataclass(frozen=True)
class Sizes:
    """How large everything is; in `quick` a twentieth."""

    most: int  # bodies of the largest bed
    limit: int  # iterations of its steps
    memory: int  # bodies of the beds that bytes are counted on
    detection: tuple[int, ...]
    ratio_bodies: int
    ratio_repeats: int
    strong: int  # bodies on one and on two ranks
    timed_iterations: int
    weak: int  # bodies a rank, with more ranks than cores
    ranks: tuple[int, ...]
    steps: int
    imbalance_seconds: float


FULL = Sizes(
    most=2_000_000, limit=1000, memory=500_000,
    detection=(10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000),
    ratio_bodies=1_000_000, ratio_repeats=3, strong=400_000, timed_iterations=100, weak=4000,
    ranks=(1, 2, 4, 8, 16), steps=5, imbalance_seconds=300.0,
)  # fmt: skip
QUICK = Sizes(
    most=100_000, limit=200, memory=50_000, detection=(10_000, 30_000, 100_000),
    ratio_bodies=100_000, ratio_repeats=3, strong=40_000, timed_iterations=50, weak=1000,
    ranks=(1, 2, 4, 8), steps=3, imbalance_seconds=12.0,
)  # fmt: skip


# ---- beds ----------------------------------------------------------------------------------


def bed(
    bodies: int, spacing: float = SPACING, iterations: int | None = None, *more: str
) -> dict[str, Any]:
    """Scene and overrides of a bed of so many bodies, eleven layers deep and square."""
    columns = math.ceil(bodies / LAYERS)
    nx = math.ceil(math.sqrt(columns))
    ny = math.ceil(columns / nx)
    side = [n * spacing for n in (nx, ny)]
    grid = "bodies.0.placement.jittered_grid"
    overrides = [
        f"bodies.0.count={bodies}",
        f"{grid}.max=[{side[0]!r}, {side[1]!r}, {LAYERS * spacing!r}]",
        f"{grid}.spacing={spacing!r}",
        f"{grid}.jitter={JITTER if spacing == SPACING else 0.0}",
        f"walls.0.max=[{side[0]!r}, {side[1]!r}, 0.6]",
        f"domain.max=[{side[0] + 1.0!r}, {side[1] + 1.0!r}, 0.7]",
        "contact.stop_factor=1e29",
        *more,
    ]
    if iterations is not None:
        overrides.append(f"contact.max_iterations={iterations}")
    return {"scene": str(SCENE), "overrides": overrides}


def drop(bodies: int) -> dict[str, Any]:
    """The task of a whole run of the thesis' scaling scene: so many spheres fall into a box."""
    side = math.sqrt(0.036 * bodies / 1000)
    corner = f"[{side!r}, {side!r}, 0.6]"
    overrides = [
        f"bodies.0.count={bodies}",
        f"bodies.0.placement.jittered_grid.max={corner}",
        f"walls.0.max={corner}",
    ]
    return {"kind": "steps", "scene": str(SCENE), "overrides": overrides, "steps": 10**9}


def timed(bodies: int, sizes: Sizes) -> dict[str, Any]:
    """A task of some steps with a new pair list and a fixed number of iterations each."""
    scene = bed(bodies, SPACING, sizes.timed_iterations, "contact.tolerance=1e-15")
    return {"kind": "steps", **scene, "steps": sizes.steps, "anew": True}


# ---- running tasks, and what comes back -----------------------------------------------------


class Run:
    """The result of the task `steps`: arrays of (steps, ranks, phases) by column."""

    def __init__(self, found: dict[str, Any], ranks: int) -> None:
        self.found, self.ranks = found, ranks
        self.steps: list[dict[str, Any]] = found["steps"]
        if not self.steps:
            raise RuntimeError(f"no step was done: {found['failure']}")
        table = np.array([step["ranks"] for step in self.steps])
        self._columns = dict(zip(found["columns"], np.moveaxis(table, 3, 0), strict=True))

    def column(self, name: str, phase: str) -> NDArray:
        """One column of one phase, (steps, ranks)."""
        return self._columns[name][:, :, self.found["phases"].index(phase)]

    def seconds(self, *phases: str) -> float:
        """Median over the steps of the slowest rank's seconds in some phases."""
        return float(np.median(sum(self.column("seconds", p).max(axis=1) for p in phases)))

    def a_product(self, name: str) -> NDArray:
        """One column of the solve a product, (ranks,), median over the steps."""
        products = np.array([step["products"] for step in self.steps])
        return np.median(self.column(name, "solve") / products[:, None], axis=0)

    def peak(self, phase: str | None = None) -> float:
        """Largest resident size [B] of the fullest rank beyond what it had before the scene.

        In one phase of the steps or in "placement"; else in any.
        """
        base, placed = np.array(self.found["memory"]).T
        peaks = dict(zip(self.found["phases"], self._columns["peak"].max(axis=0).T, strict=True))
        peaks["placement"] = placed
        column = np.max(list(peaks.values()), axis=0) if phase is None else peaks[phase]
        return float((column - base).max())

    def memory(self) -> NDArray:
        """Largest resident size [B] of each rank, program included."""
        placed = np.array(self.found["memory"])[:, 1]
        return np.maximum(self._columns["peak"].max(axis=(0, 2)), placed)

    def total_memory(self) -> float:
        """Sum over ranks of the largest resident size [B], program included."""
        return float(self.memory().sum())

    @property
    def contacts(self) -> int:
        return self.steps[-1]["contacts"]

    @property
    def bodies(self) -> int:
        return self.steps[-1]["bodies"]


def measure(task: dict[str, Any], ranks: int) -> Any:
    """Run a task on so many ranks and return what it found."""
    BUILD.mkdir(parents=True, exist_ok=True)
    result = BUILD / "scaling-result.json"
    result.unlink(missing_ok=True)
    order = BUILD / "scaling-task.json"
    order.write_text(json.dumps(task))
    mpirun(ranks, [str(Path(__file__).resolve()), "--worker", str(order), str(result)])
    return json.loads(result.read_text())


def stepped(task: dict[str, Any], ranks: int) -> Run:
    return Run(measure(task, ranks), ranks)


def work(task: dict[str, Any], result: Path) -> None:
    """Collective. Do one task; rank 0 writes what was found."""
    from lib.scaling_work import KINDS, Meter, measure_halos

    from dem_mpi.warmup import warm_up

    parallel = Meter()
    parallel.install_abort_hook()
    warm_up(parallel, 1)
    measure_halos()
    found = KINDS[task["kind"]](parallel, task)
    if parallel.rank == 0:
        result.write_text(json.dumps(found))


# ---- two million spheres --------------------------------------------------------------------


def two_million(sizes: Sizes) -> list[Record]:
    """A step of the largest bed: seconds by phase, memory, iterations."""
    records = []
    for ranks in (1, 2):
        scene = bed(sizes.most, SPACING, sizes.limit)
        run = stepped({"kind": "steps", **scene, "steps": 2}, ranks)
        first = run.steps[0]
        params = {
            "spheres": run.bodies, "contacts": first["contacts"],
            "iterations": first["iterations"], "iteration_limit": sizes.limit,
            "tolerance": 1e-2, "converged": first["converged"],
        }  # fmt: skip

        def put(name: str, value: float, unit: str, params=params, ranks=ranks, **more: Any):
            records.append(
                Record(f"scaling.two_million.{name}", params, value, unit, ranks=ranks, **more)
            )

        put("seconds.placement", run.found["placed"], "s")
        for phase in (*DETECTION, "assemble", "solve", "advance"):
            # The first step alone lists near pairs and has nothing to start the solve from.
            put(f"seconds.{phase}", float(run.column("seconds", phase)[0].max()), "s")
        seconds = {p: float(run.column("seconds", p)[0].max()) for p in run.found["phases"]}
        outside, solve = sum(seconds.values()) - seconds["solve"], seconds["solve"]
        put("seconds.step", outside + solve, "s")
        put("seconds.product", solve / first["products"], "s")
        put("ns_per_contact_product", solve / first["products"] / first["contacts"] * 1e9, "ns")
        # As long as it would take with the iterations that the thesis needs for two million.
        thesis = model.THESIS_ITERATIONS[0]
        put(
            f"seconds.step_of_{thesis}_iterations",
            outside + solve * thesis / first["iterations"],
            "s",
        )
        put("iterations", first["iterations"], "1", error=first["r_d"])
        put("memory_gb", run.total_memory() / 1e9, "GB")
        records.append(_foretold(scene, run, params))
    return records


def _foretold(scene: dict[str, Any], run: Run, params: dict[str, Any]) -> Record:
    """Memory that `dem-mpi check` foretells for a rank, over what the fullest one took."""
    from dem_mpi.estimate import estimate
    from dem_mpi.scenario import load_scenario

    foretold = estimate(load_scenario(scene["scene"], scene["overrides"]).scenario, run.ranks)
    base = max(row[0] for row in run.found["memory"])
    ratio = foretold.memory / (base + run.peak())
    return Record("scaling.memory_estimate_over_peak", params, ratio, "1", ranks=run.ranks)


def memory(sizes: Sizes) -> list[Record]:
    """Bytes of a body, from a loose bed, and of a contact, from beds with three and nine a body.

    Beyond a rank's memory before it places its bodies, at the peak of the phase that takes most.
    """
    records = []
    for mu in (0.3, 0.0):

        def grown(spacing: float, margin: float, mu=mu) -> Run:
            more = (f"friction.default={mu}", f"contact.margin={margin}")
            scene = bed(sizes.memory, spacing, 3, *more)
            return stepped({"kind": "steps", **scene, "steps": 2}, 1)

        loose, dense, wide = (
            grown(LOOSE, 0.02), grown(SPACING, 0.02), grown(SPACING, WIDE_MARGIN)
        )  # fmt: skip
        base = {"spheres": sizes.memory, "mu": mu}
        records.append(
            Record(
                "scaling.bytes_per_body", base | {"contacts": loose.contacts, "limit": BODY_LIMIT},
                loose.peak() / sizes.memory, "B",
            )
        )  # fmt: skip
        for phase in ("placement", *DETECTION, "assemble", "solve", "advance"):
            more = wide.contacts - dense.contacts
            params = base | {"contacts": [dense.contacts, wide.contacts]}
            records.append(
                Record(f"scaling.bytes_per_body.{phase}", base, loose.peak(phase) / sizes.memory,
                       "B")
            )  # fmt: skip
            records.append(
                Record(f"scaling.bytes_per_contact.{phase}", params,
                       (wide.peak(phase) - dense.peak(phase)) / more, "B")
            )  # fmt: skip
        records.append(
            Record(
                "scaling.bytes_per_contact", params | {"limit": CONTACT_LIMIT},
                (wide.peak() - dense.peak()) / more, "B",
            )
        )  # fmt: skip
        # What a bed as it settles takes: bodies and contacts need not peak in the same phase.
        records.append(
            Record(
                "scaling.bytes_of_bed_per_body", base | {"contacts": dense.contacts},
                dense.peak() / sizes.memory, "B", "limits of both",
                BODY_LIMIT + CONTACT_LIMIT * dense.contacts / sizes.memory,
                dense.peak() / (BODY_LIMIT * sizes.memory + CONTACT_LIMIT * dense.contacts),
            )
        )  # fmt: skip
    return records


# ---- detection ------------------------------------------------------------------------------


def detection(sizes: Sizes) -> list[Record]:
    """Nanoseconds of a new pair list and its contacts a body, by size and by ratio of sizes."""
    records = []

    def put(row: dict[str, Any], name: str, params: dict[str, Any]) -> float:
        times = [sum(step[p] for p in DETECTION) / row["bodies"] * 1e9 for step in row["seconds"]]
        params |= {"spheres": row["bodies"], "contacts": row["contacts"], "pairs": row["pairs"]}
        value = statistics.median(times)
        records.append(Record(name, params, value, "ns", runs=len(times)))
        return value

    # Few repetitions of large beds take as long as many of small ones.
    per_body = []
    for bodies in sizes.detection:
        task = {"kind": "detection", "scenes": [bed(bodies)],
                "repeats": min(15, max(3, 500_000 // bodies))}  # fmt: skip
        (row,) = measure(task, 1)
        per_body.append(put(row, f"scaling.detection.ns_per_body.n{bodies}", {}))
    params = {"spheres": list(sizes.detection)}
    records.append(
        Record("scaling.detection.largest_over_smallest", params, per_body[-1] / per_body[0], "1")
    )
    records.append(
        Record("scaling.detection.exponent", params, 1.0 + model.power(sizes.detection, per_body),
               "1")
    )  # fmt: skip
    scenes = [bed(sizes.ratio_bodies) | {"size_ratio": ratio} for ratio in (1, 10, 100)]
    rows = measure({"kind": "detection", "scenes": scenes, "repeats": sizes.ratio_repeats}, 1)
    for scene, row in zip(scenes, rows, strict=True):
        ratio = scene["size_ratio"]
        put(row, f"scaling.detection.size_ratio.{ratio}", {"large": row["largest"]})
    return records


# ---- strong and weak scaling, and the model -------------------------------------------------


def scaling(sizes: Sizes) -> list[Record]:
    """Seconds on 1 and 2 ranks, messages on more, and what the model makes of them."""
    half, whole = sizes.strong // 2, sizes.strong
    alone = stepped(timed(half, sizes), 1)
    strong = {1: stepped(timed(whole, sizes), 1), 2: stepped(timed(whole, sizes), 2)}
    busy = [Run(found, 1) for found in measure(timed(half, sizes) | {"kind": "together"}, 2)]
    slowdown = max(run.seconds("solve") for run in busy) / alone.seconds("solve")
    records = _timed_records(alone, strong, slowdown, sizes)

    weak = {}
    for ranks in sizes.ranks:
        task = {"kind": "steps", **bed(sizes.weak * ranks), "steps": 1}
        weak[ranks] = stepped(task, ranks)
    records += _weak_records(weak, sizes)
    drops = {ranks: stepped(drop(sizes.weak * ranks), 2) for ranks in sizes.ranks}
    records += _iteration_records(drops)

    cost = model.Cost(
        detection=strong[1].seconds(*DETECTION) / whole,
        other=strong[1].seconds(*OTHER) / whole,
        contact=float(strong[1].a_product("seconds")[0]) / strong[1].contacts,
        slowdown=max(slowdown, 1.0),
    )
    records += _model_checks(cost, strong[2], weak)
    return records + _prediction(cost, strong[2], weak, drops)


def _timed_records(
    alone: Run, strong: dict[int, Run], slowdown: float, sizes: Sizes
) -> list[Record]:
    records = []
    for part, phases in (("detection", DETECTION), ("resolution", ("solve",))):
        one, two = strong[1].seconds(*phases), strong[2].seconds(*phases)
        params = {"part": part, "spheres": strong[1].bodies, "iterations": sizes.timed_iterations}
        common = {"unit": "s", "runs": sizes.steps}
        records += [
            Record("scaling.strong.seconds", params, one, ranks=1, **common),
            Record("scaling.strong.seconds", params, two, ranks=2, **common),
            Record("scaling.strong.efficiency", params, one / two / 2, "1", ranks=2),
            Record("scaling.weak.seconds.ranks1", params | {"spheres": alone.bodies},
                   alone.seconds(*phases), ranks=1, **common),
            Record("scaling.weak.seconds.ranks2", params, two, ranks=2, **common),
            Record("scaling.weak.efficiency", params, alone.seconds(*phases) / two, "1", ranks=2),
        ]  # fmt: skip
    params = {"spheres": alone.bodies, "what": "two independent beds at once over one"}
    records.append(Record("scaling.slowdown_busy", params, slowdown, "1", runs=sizes.steps))
    return records


def _weak_records(weak: dict[int, Run], sizes: Sizes) -> list[Record]:
    """What a rank sends, holds and does, at a fixed number of bodies a rank."""
    records = []
    for ranks, run in weak.items():
        params = {"spheres_a_rank": sizes.weak, "contacts": run.contacts, "tolerance": 1e-2}
        ghosts = np.array([own[1] for own in run.steps[0]["own"]])
        for name, values, unit in (
            ("bytes", run.a_product("bytes"), "B"),
            ("messages", run.a_product("messages"), "1"),
            ("reductions", run.a_product("reductions"), "1"),
            ("ghosts", ghosts, "1"),
            ("memory", run.memory(), "B"),
        ):
            records.append(
                Record(f"scaling.weak.{name}.ranks{ranks}",
                       params | {"mean_of_ranks": float(np.mean(values))},
                       float(np.max(values)), unit, ranks=ranks)
            )  # fmt: skip
    return records


def _iteration_records(drops: dict[int, Run]) -> list[Record]:
    """Iterations of whole runs, as in S. De's table 2.2: they hardly depend on the ranks.

    `ranks` names the size: bodies of so many ranks. The runs took place on two.
    """
    records = []
    for ranks, run in drops.items():
        counts = [step["iterations"] for step in run.steps]
        params = {
            "spheres": run.bodies, "contacts": statistics.fmean(s["contacts"] for s in run.steps),
            "largest": max(counts), "steps": len(counts), "tolerance": 1e-2,
            "missed": sum(not step["converged"] for step in run.steps), "run_on": run.ranks,
        }  # fmt: skip
        records.append(
            Record(f"scaling.weak.iterations.ranks{ranks}", params, statistics.fmean(counts), "1",
                   ranks=ranks)
        )  # fmt: skip
    return records


def _load(run: Run) -> model.Load:
    """What the fullest rank of a run does in a product."""
    contacts = run.contacts / run.ranks
    return model.Load(
        bodies=run.bodies / run.ranks,
        contacts=contacts,
        bytes=float(run.a_product("bytes").max()),
        messages=float(run.a_product("messages").max()),
        reductions=float(run.a_product("reductions").max()),
    )


def _model_checks(cost: model.Cost, two: Run, weak: dict[int, Run]) -> list[Record]:
    """The model against what it was not fitted to."""
    network = model.Network()
    found = float(two.a_product("seconds").max())
    told = model.product_seconds(cost, _load(two), 2, network)
    params = {"spheres": two.bodies, "foretold": told, "measured": found, "unit": "s a product"}
    records = [Record("scaling.model.error_two_ranks", params, told / found - 1.0, "1", ranks=2)]
    *fitted, last = [ranks for ranks in weak if ranks > 1]
    sent = {ranks: float(weak[ranks].a_product("bytes").mean()) for ranks in weak}
    law = model.surface_law(fitted, [sent[ranks] for ranks in fitted])
    told = model.surface_amount(law, last)
    params = {"fitted_on": fitted, "foretold": told, "measured": sent[last], "unit": "B a product"}
    records.append(
        Record(f"scaling.model.error_bytes.ranks{last}", params, told / sent[last] - 1.0, "1",
               ranks=last)
    )  # fmt: skip
    # What a rank of a flat bed sends grows as the rim of its columns, the square root of bodies.
    told = sent[2] * math.sqrt(two.bodies / weak[2].bodies)
    large = float(two.a_product("bytes").mean())
    params = {"fitted_on": weak[2].bodies // 2, "spheres_a_rank": two.bodies // 2,
              "foretold": told, "measured": large, "unit": "B a product"}  # fmt: skip
    records.append(
        Record("scaling.model.error_bytes.larger", params, told / large - 1.0, "1", ranks=2)
    )
    return records


def _prediction(
    cost: model.Cost, two: Run, weak: dict[int, Run], drops: dict[int, Run]
) -> list[Record]:
    """A step of 256 million spheres on 512 cores, by the thesis' iterations and by ours."""
    network = model.Network()
    last = drops[max(drops)].steps
    products = sum(step["products"] for step in last) / sum(step["iterations"] for step in last)
    load = _inner_load(two, weak)
    own = {
        run.bodies: statistics.fmean(s["iterations"] for s in run.steps) for run in drops.values()
    }
    a, b = model.logarithmic(list(own), list(own.values()))
    iterations = {
        "": model.thesis_iterations(CORES),
        "_own_iterations": max(a + b * math.log2(CORES * SPHERES_A_CORE), max(own.values())),
    }
    records = []
    for kind, count in iterations.items():
        part = model.step_seconds(cost, load, CORES, count * products, network)
        computing = count * products * load.contacts * cost.contact * cost.slowdown
        params = {
            "cores": CORES, "spheres": CORES * SPHERES_A_CORE, "contacts": CORES * load.contacts,
            "iterations": count, "products_an_iteration": products,
            "bytes_a_product": load.bytes, "messages_a_product": load.messages,
            "reductions_a_product": load.reductions, "latency_s": network.latency,
            "bandwidth_B_s": network.bandwidth, "slowdown": cost.slowdown,
            "ns_a_contact_and_product": cost.contact * 1e9,
            "detection_ns_a_body": cost.detection * 1e9,
            "communication_share_of_solve": 1.0 - computing / part["solve"],
        }  # fmt: skip
        for what, seconds, rival in (
            # The resolution alone takes 24 minutes there.
            ("step", sum(part.values()), 24.0),
            ("resolution", part["solve"], 24.0),
            ("detection", part["detection"], 2.0),
        ):
            records.append(
                Record(f"scaling.model.{what}_minutes{kind}.512x500k", params, seconds / 60.0,
                       "min", "S. De table 2.2", rival, seconds / 60.0 / rival, ranks=CORES)
            )  # fmt: skip
    return records


def _inner_load(two: Run, weak: dict[int, Run]) -> model.Load:
    """What a rank among 511 others has to do, from what the fullest ranks of few do."""
    many = [ranks for ranks in weak if ranks > 1]
    # The rim of a rank's columns, across which it sends, grows as the square root of its bodies.
    rim = math.sqrt(SPHERES_A_CORE / (weak[many[-1]].bodies / many[-1]))

    def inside(name: str) -> float:
        found = [float(weak[ranks].a_product(name).max()) for ranks in many]
        return max(model.surface_amount(model.surface_law(many, found), CORES), *found)

    return model.Load(
        bodies=SPHERES_A_CORE,
        contacts=SPHERES_A_CORE * two.contacts / two.bodies,
        bytes=inside("bytes") * rim,
        messages=inside("messages"),
        reductions=float(two.a_product("reductions").max()),
    )


# ---- load balance ---------------------------------------------------------------------------


def scenes(given: list[Path]) -> list[Path]:
    """The scenes to balance: those asked for, else hopper and drum, else what there is."""
    usual = [ROOT / "configs" / f"{name}.yaml" for name in ("hopper", "drum")]
    present = [path for path in usual if path.exists()]
    return given or present or [ROOT / "configs" / "quick.yaml"]


def imbalance(sizes: Sizes, quick: bool, paths: list[Path]) -> list[Record]:
    """Maximum over mean of the ranks' work in the solve, over a scene's run.

    On 2 ranks of its seconds without communication, on more of bodies and contacts. A scene runs
    as far as its seconds allow, on more ranks than cores in its reduced form.
    """
    records = []
    for path in paths:
        header = re.search(r"^# reduced: (.*)$", path.read_text(), flags=re.MULTILINE)
        reduced = header[1].split() if header else []
        for ranks in (2, 4, 8):
            small = quick or ranks > (os.cpu_count() or 1)
            overrides = [*(reduced if small else []), "output.interval=null",
                         "checkpoint.interval=null"]  # fmt: skip
            task = {"kind": "steps", "scene": str(path), "overrides": overrides,
                    "steps": 10**9, "seconds": sizes.imbalance_seconds}  # fmt: skip
            records += _imbalance_records(path.stem, stepped(task, ranks), small)
    return records


def _imbalance_records(name: str, run: Run, reduced: bool) -> list[Record]:
    ranks, steps = run.ranks, run.steps
    work = run.column("seconds", "solve") - run.column("waited", "solve")
    busy = work.max(axis=1).sum() / work.mean(axis=1).sum()
    by_step = [step["imbalance"] for step in steps]
    by_load = statistics.fmean(by_step)
    timed_too = ranks <= (os.cpu_count() or 1)
    moved = sum(step["moved"] for step in steps)
    seconds = run.column("seconds", "partition").max(axis=1).sum()
    total = sum(run.column("seconds", p).max(axis=1).sum() for p in run.found["phases"])
    params = {
        "measure": "seconds of the solve" if timed_too else "bodies + contacts",
        "reduced": reduced, "spheres": steps[-1]["bodies"], "steps": len(steps),
        "planned_steps": run.found["planned"], "lists": sum(step["rebuilt"] for step in steps),
        "moved": moved, "bodies_and_contacts": by_load,
        "worst_bodies_and_contacts": max(by_step), "stopped": run.found["failure"],
    }  # fmt: skip
    if timed_too:
        params["partition_share_of_step"] = float(seconds / total)
    value = float(busy) if timed_too else by_load
    return [Record(f"scaling.imbalance.{name}.ranks{ranks}", params, value, "1", ranks=ranks)]


# ---- figure ---------------------------------------------------------------------------------


def draw(records: list[Record], path: Path) -> None:
    """Detection by size, iterations by size, bytes by ranks, and the step on 512 cores."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(10, 7.5), constrained_layout=True)
    named = {(r.name, r.ranks): r for r in records}
    _draw_detection(axes[0, 0], records)
    _draw_iterations(axes[0, 1], records)
    _draw_bytes(axes[1, 0], records)
    _draw_step(axes[1, 1], named)
    for axis in axes.flat:
        axis.grid(True, which="both", alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _draw_detection(axis: Any, records: list[Record]) -> None:
    rows = [r for r in records if r.name.startswith("scaling.detection.ns_per_body")]
    axis.semilogx([r.params["spheres"] for r in rows], [r.value for r in rows], "o-",
                  label="equal spheres")  # fmt: skip
    for k, r in enumerate(r for r in records if r.name.startswith("scaling.detection.size_ratio")):
        label = f"size ratio {r.name.rpartition('.')[2]}"
        axis.semilogx([r.params["spheres"]], [r.value], "s", color=f"C{k + 1}", label=label)
    axis.set(xlabel="bodies", ylabel="ns a body, 1 rank", title="new pair list and contacts")
    axis.set_ylim(0, 1.1 * axis.get_ylim()[1])
    axis.legend(fontsize=8)


def _draw_iterations(axis: Any, records: list[Record]) -> None:
    rows = [r for r in records if r.name.startswith("scaling.weak.iterations.")]
    own = [r.params["spheres"] for r in rows], [r.value for r in rows]
    axis.semilogx(*own, "o-", label="mean of a run, warm starts")
    axis.semilogx(own[0], [r.params["largest"] for r in rows], "C0:", label="largest of a run")
    axis.semilogx(model.THESIS_SPHERES, model.THESIS_ITERATIONS, "k^--", label="S. De, table 2.2")
    axis.set(xlabel="spheres", ylabel="APGD iterations", title="iterations to 1e-2")
    axis.legend(fontsize=8)


def _draw_bytes(axis: Any, records: list[Record]) -> None:
    rows = [r for r in records if r.name.startswith("scaling.weak.bytes.") and r.ranks > 1]
    axis.plot([r.ranks for r in rows], [r.value / 1e3 for r in rows], "o-", label="fullest rank")
    axis.plot([r.ranks for r in rows], [r.params["mean_of_ranks"] / 1e3 for r in rows], "s--",
              label="mean")  # fmt: skip
    check = [r for r in records if r.name.startswith("scaling.model.error_bytes.ranks")]
    for r in check:
        axis.plot([r.ranks], [r.params["foretold"] / 1e3], "kx", label="foretold from fewer ranks")
    a_rank = rows[0].params["spheres_a_rank"] if rows else 0
    axis.set_ylim(bottom=0)
    axis.set(xlabel="ranks", ylabel="kB a product and rank", title=f"{a_rank} spheres a rank")
    axis.legend(fontsize=8)


def _draw_step(axis: Any, named: dict[tuple[str, int], Record]) -> None:
    bars = []
    for part in ("detection", "resolution"):
        record = named.get((f"scaling.model.{part}_minutes.512x500k", CORES))
        if record:
            bars += [(f"{part},\nthis model", record.value, "C0"),
                     (f"{part},\nS. De", record.rival_value, "0.6")]  # fmt: skip
    for k, (_, value, color) in enumerate(bars):
        axis.bar(k, value, color=color)
        axis.annotate(f"{value:.2g}", (k, value), ha="center", va="bottom")
    axis.set_xticks(range(len(bars)), [label for label, _, _ in bars], fontsize=8)
    axis.set(ylabel="minutes a step", title="256 million spheres on 512 cores")
    if bars:
        axis.set_yscale("log")


def main() -> None:
    """Parse the options and write records and figure."""
    if sys.argv[1:2] == ["--worker"]:
        work(json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3]))
        return
    parser = arguments(__doc__.splitlines()[0])
    parts = ("two_million", "memory", "detection", "scaling", "imbalance")
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, metavar="PART")
    parser.add_argument("--scene", nargs="+", type=Path, default=[], metavar="FILE")
    options = parser.parse_args()
    sizes = QUICK if options.quick else FULL
    bench: dict[str, Callable[[], list[Record]]] = {
        "two_million": lambda: two_million(sizes),
        "memory": lambda: memory(sizes),
        "detection": lambda: detection(sizes),
        "scaling": lambda: scaling(sizes),
        "imbalance": lambda: imbalance(sizes, options.quick, scenes(options.scene)),
    }
    records: list[Record] = []
    for part in options.only:
        found = bench[part]()
        records += found
        write(found)
        # A long run that is broken off keeps what it has.
        save(records, options.json)
    if options.figure:
        draw(records, options.figure)


if __name__ == "__main__":
    main()
