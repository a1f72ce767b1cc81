"""What each law of friction does to sliding contacts, against the step length h, and its price.

    python scripts/bench/dilation.py [--quick] [--json FILE] [--figure FILE]

The cone complementarity problem (law "ccp") lets a sliding contact open at mu |v_t|, Coulomb's law
("coulomb") does not. Two scenes: a sphere launched along a floor at 1 m/s from gap 0 (gap after the
first step, solved to 1e-10 m/s), and 475 spheres of configs/shear_box.yaml sheared between plates a
fixed distance apart, from one state for both laws and all h (gap of its sliding contacts weighted
by their impulse, load on a plate, products with the Delassus operator a step, over 0.05 s). The
price where a law is hardest: 150 spheres of configs/quick.yaml fall into a narrower box, 0.4 s.
Nothing is timed. Two minutes on one core; --quick leaves the two smaller steps of the bed and the
tighter tolerance of the fall out.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from records import Record, arguments, write

from dem_mpi.bodies import Bodies
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import load_scenario
from dem_mpi.simulation import Simulation, StepRecord, start

sys.path.insert(0, str(Path(__file__).resolve().parent / "lib"))
import dilation

MU, SPEED = 0.3, 1.0  # of the sphere; m/s
SPHERE_STEPS = (4e-3, 2e-3, 1e-3, 5e-4)  # s
BED_STEPS = (2e-3, 1e-3, 5e-4, 2.5e-4)
QUICK_BED_STEPS = BED_STEPS[:2]
COUNT = 475
SETTLING = Path(__file__).resolve().parents[2] / "configs" / "quick.yaml"
NARROW = (
    "bodies.0.count=150",
    "walls.0.max=[0.08,0.08,0.4]",
    "bodies.0.placement.jittered_grid.max=[0.08,0.08,0.4]",
    "time.end=0.4",
)
TOLERANCES = ((1e-3, 1e-2), (1e-4, 1e-2), (1e-4, 1e-4))  # m/s, and of complementarity


def sphere_records() -> list[Record]:
    """Gap after the first step of a sliding sphere."""
    records = []
    for step in SPHERE_STEPS:
        for law in dilation.LAWS:
            found = dilation.sliding_sphere(law, step, MU, SPEED)
            params = {"law": law, "step": step, "mu": MU, "speed": SPEED}
            records.append(Record("dilation.sphere.hop", params, found.hop, "m"))
    return records


def bed_records(steps: tuple[float, ...]) -> list[Record]:
    """Gap, load and work of the sheared bed; the products of Coulomb's law beside those of ccp."""
    parallel = Parallel.alone()
    pressed = dilation.pressed_bed(parallel, COUNT)
    records = []
    for step in steps:
        products: dict[str, float] = {}
        for law in dilation.LAWS:
            found = dilation.sheared_bed(parallel, pressed, law, step, COUNT)
            products[law] = found.products
            params = {
                "law": law, "step": step, "bodies": found.bodies, "contacts": found.contacts,
                "outer": found.outer, "unconverged": found.unconverged,
            }  # fmt: skip
            records += [
                Record("dilation.bed.gap", params, found.sliding, "m"),
                Record("dilation.bed.load", params, found.load, "N"),
                Record("dilation.bed.friction", params, found.friction, "1"),
            ]
            work = Record("dilation.bed.products", params, found.products, "1")
            if law == "coulomb":
                work.rival, work.rival_value = "ccp", products["ccp"]
                work.ratio = found.products / products["ccp"]
            records.append(work)
    return records


def settling_records(tolerances: tuple[tuple[float, float], ...]) -> list[Record]:
    """Products a step of a bed that falls, lands and settles."""
    records = []
    for tolerance, complementarity in tolerances:
        products: dict[str, float] = {}
        for law in dilation.LAWS:
            found = settle(law, tolerance, complementarity)
            products[law] = float(np.mean([r.products for r in found]))
            params = {
                "law": law, "tolerance": tolerance, "complementarity": complementarity,
                "bodies": found[-1].bodies, "steps": len(found),
                "outer": float(np.mean([r.outer for r in found])),
                "unconverged": sum(not r.converged for r in found),
            }  # fmt: skip
            work = Record("dilation.settling.products", params, products[law], "1")
            if law == "coulomb":
                work.rival, work.rival_value = "ccp", products["ccp"]
                work.ratio = products["coulomb"] / products["ccp"]
            records.append(work)
    return records


def settle(law: dilation.Law, tolerance: float, complementarity: float) -> list[StepRecord]:
    """Drop the narrow bed under a law; return what the steps did."""
    settings = [
        *NARROW, f"contact.law={law}", f"contact.tolerance={tolerance}",
        f"contact.complementarity={complementarity}",
    ]  # fmt: skip
    parallel, scenario = Parallel.alone(), load_scenario(SETTLING, settings).scenario
    density = [material.density for material in scenario.materials.values()]
    bodies = Bodies.from_arrays(place(parallel, scenario), density)
    simulation = Simulation(parallel, scenario, start(parallel, bodies))
    records = [simulation.step() for _ in range(scenario.steps)]
    simulation.destroy()
    return records


def draw(records: list[Record], path: Path) -> None:
    """Gaps of the sphere and of the bed, and the load, against h."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 3.8), constrained_layout=True)
    panels = (
        ("dilation.sphere.hop", "sliding sphere: |gap| after a step [m]"),
        ("dilation.bed.gap", "sheared bed: |gap| of sliding contacts [m]"),
        ("dilation.bed.load", "sheared bed: load on a plate [N]"),
    )
    for axis, (name, title) in zip(axes, panels, strict=True):
        for law, marker in zip(dilation.LAWS, "os", strict=True):
            points = [r for r in records if r.name == name and r.params["law"] == law]
            steps = [1e3 * r.params["step"] for r in points]
            axis.plot(steps, [abs(r.value) for r in points], marker=marker, label=law)
        axis.set(xlabel="h [ms]", title=title, xscale="log")
        ticks = sorted(steps)
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
        if not name.endswith("load"):
            axis.set_yscale("log")
        else:
            axis.set_ylim(bottom=0.0)
        axis.legend()
    figure.savefig(path, dpi=130)


def main() -> int:
    """Parse the options and write records and figure."""
    options = arguments(__doc__.split("\n", maxsplit=1)[0]).parse_args()
    records = sphere_records()
    records += bed_records(QUICK_BED_STEPS if options.quick else BED_STEPS)
    records += settling_records(TOLERANCES[:1] if options.quick else TOLERANCES)
    write(records, options.json)
    if options.figure:
        draw(records, options.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main())
