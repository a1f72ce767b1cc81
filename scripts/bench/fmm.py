"""Fast sums: ours beside FMM3D and the direct sum, at equal measured error; grids beside grids.

    python scripts/bench/fmm.py [--quick] [--json FILE] [--figure FILE] [--only PART ...]
        [--page FILE] [--dry] [--version VERSION]

FMM3D (Z. Gimbutas, L. Greengard et al.) is the Fortran library one would take for Laplace and
Stokes: it is measured where the Python package fmm3dpy is found. To be a fair rival it has to be
built by scripts/bench/build_fmm3d: its wheel does without AVX and threads, and neither it nor a
plain build from source has its vectorised kernels, which make it three to four times faster.

Errors are |u - u_direct|_2 / |u_direct|_2 on 1000 sampled targets, weights normal, seeds fixed.
Ours is compared at its loosest setting whose measured error is not above the rival's. A case is a
process of its own for each method, one after the other, with 1 thread, then 2 ranks against 2
threads; seconds are medians (5 runs, 3 of 10^6 points; of the rival fewer, once they have taken 40
seconds), of the rival whole calls, of ours the plan and its application apart. What the rival takes
is kept and not measured again: the whole set takes it half an hour.

Parts:
  rival   Laplace and Stokeslet, 10^4 to 10^6 points in a cube, on a sphere, on a 10:1 spheroid
  curve   work against precision, 10^5 points in the cube, every method
  grids   P. Blanchard's figures 5.10-5.12: seconds and memory against the order, 20,000 points
  smooth  his figure 5.13: a smooth kernel without a near field, up to 10^6 points
  limits  near field in flop/s and translations in bytes/s beside what the machine can do
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from hashlib import sha1
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from records import BUILD, ROOT, Record, arguments, commit, put, save, write

CACHE = BUILD / "fmm"
WORKER = Path(__file__).resolve().parent / "lib" / "fmm_work.py"
PARTS = ("rival", "curve", "grids", "smooth", "limits")
KERNELS = ("laplace", "stokeslet")
ASKED = (1e-3, 1e-6, 1e-9)  # of FMM3D
# Settings of ours that are tried, in units of the rival's measured error, loosest first.
TRIED = (10.0, 3.0, 1.0, 0.3, 0.1)
GRID_POINTS, GRID_DEPTH = 20_000, 3
ORDERS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)
SMOOTH_LENGTH = 0.5


# ---- one case ------------------------------------------------------------------------------


def measure(ranks: int = 1, limit: float = 900.0, **task: Any) -> dict[str, Any] | None:
    """What a case gives, measured at this commit or found; None where it did not end."""
    task.setdefault("runs", 3 if task["n"] > 300_000 else 5)
    task.setdefault("plans", 1 if task["n"] > 300_000 else 3)
    size, kernel = task["n"], task["kernel"]
    task["reference"] = str(CACHE / "exact" / f"{kernel}-{task['distribution']}-{size}.npz")
    if "length" in task:
        task["reference"] = task["reference"].replace(".npz", f"-{task['length']}.npz")
    told = ("kernel", "distribution", "n", "method", "eps", "options", "runs")
    name = "-".join(str(task[key]) for key in told if key in task)
    version = "rival" if task["method"] == "fmm3d" else own_version()
    path = CACHE / version / f"{_safe(name)}-{ranks}.json"
    if not path.exists():
        if "dry" in _ASKED:
            return None
        path.parent.mkdir(parents=True, exist_ok=True)
        order, result = (path.with_suffix(f".{kind}-{os.getpid()}") for kind in ("task", "result"))
        order.write_text(json.dumps(task))
        try:
            _start(task["method"], ranks, [str(WORKER), str(order), str(result)], limit)
            result.rename(path)
        except (subprocess.SubprocessError, FileNotFoundError) as error:
            print(f"  left out: {name}, {ranks} ranks: {error}", flush=True)
            return None
        finally:
            order.unlink()
    return json.loads(path.read_text())


def _safe(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-." else "_" for c in name)


def _start(method: str, ranks: int, command: list[str], limit: float) -> None:
    threads = ranks if method == "fmm3d" else 1
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_STACKSIZE": "256M",
        "OMPI_ALLOW_RUN_AS_ROOT": "1",
        "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1",
        "OMPI_MCA_rmaps_base_oversubscribe": "1",
        "OMPI_MCA_hwloc_base_binding_policy": "none",
    }
    call = [sys.executable, *command]
    if method != "fmm3d" and ranks > 1:
        call = ["mpirun", "-n", str(ranks), *call]
    subprocess.run(call, check=True, env=environment, cwd=ROOT, timeout=limit)


# What the command line says of all cases: "version" to look results up by, "dry" to measure none.
_ASKED: dict[str, str] = {}


def own_version() -> str:
    """The commit in which the package was last changed, + and a digest if it differs from it."""
    if "version" not in _ASKED:

        def git(*command: str) -> str:
            call = ["git", "-C", str(ROOT), *command, "--", "stokes/fmm"]
            return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()

        changes = git("diff", "HEAD")
        mark = "+" + sha1(changes.encode()).hexdigest()[:6] if changes else ""
        _ASKED["version"] = git("log", "-1", "--format=%h") + mark
    return _ASKED["version"]


def has_rival() -> bool:
    """Whether fmm3dpy can be imported, or need not be."""
    if "dry" in _ASKED:
        return True
    call = [sys.executable, "-c", "import fmm3dpy"]
    return subprocess.run(call, capture_output=True, check=False).returncode == 0


def params(task: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """What a record says of a case."""
    report = found.get("report", {})
    kept = ("method", "nodes", "leaf_size", "depth", "precision", "boxes", "compile_seconds")
    return (
        {k: v for k, v in task.items() if k in ("kernel", "distribution", "n", "eps", "options")}
        | {k: report[k] for k in kept if k in report}
        | {
            "plan_seconds": median(found["plan"]) if found["plan"] else None,
            "memory_bytes": found["memory"],
            "memory_before_bytes": found["memory_before"],
            "direct_seconds": found["direct"],
        }
    )


# ---- parts ---------------------------------------------------------------------------------


def rival(quick: bool) -> Iterable[Record]:
    """Ours beside FMM3D, every kernel, distribution, size and accuracy."""
    there = has_rival()
    sizes = (10_000, 100_000) if quick else (10_000, 100_000, 1_000_000)
    for distribution in ("cube",) if quick else ("cube", "sphere", "prolate"):
        for n in sizes:
            for kernel in KERNELS:
                for asked in ASKED:
                    both = n == 100_000 and distribution == "cube" and not quick
                    for ranks in (1, 2) if both else (1,):
                        yield from _beside(kernel, distribution, n, asked, ranks, there)


def _beside(
    kernel: str, distribution: str, n: int, asked: float, ranks: int, there: bool
) -> Iterable[Record]:
    case: dict[str, Any] = {"kernel": kernel, "distribution": distribution, "n": n}
    theirs = measure(ranks, method="fmm3d", eps=asked, **case) if there else None
    goal = theirs["error"] if theirs else asked
    ours, eps = None, asked
    for multiple in TRIED if theirs else (1.0,):
        eps = min(goal * multiple, 0.1)
        ours = measure(ranks, method="own", eps=eps, **case)
        if ours is None or ours["error"] <= goal:
            break
    if ours is None:
        return
    seconds = median(ours["apply"])
    more: dict[str, Any] = {}
    described = params(case | {"eps": eps}, ours) | {"reached": ours["error"] <= goal}
    if theirs:
        told = median(theirs["apply"])
        more = {"rival": "FMM3D", "rival_value": told, "ratio": seconds / told}
        described |= {
            "rival_error": theirs["error"],
            "rival_eps": asked,
            "rival_memory_bytes": theirs["memory"] - theirs["memory_before"],
        }
    name = f"fmm.{kernel}." + f"{asked:.0e}".replace("e-0", "e-")
    yield Record(name, described, seconds, "s", error=ours["error"], runs=len(ours["apply"]),
                 ranks=ranks, **more)  # fmt: skip
    whole = seconds + median(ours["plan"])
    if theirs:
        more = {"rival": "FMM3D", "rival_value": told, "ratio": whole / told}
    yield Record(f"{name}.with_plan", described, whole, "s", error=ours["error"],
                 runs=len(ours["apply"]), ranks=ranks, **more)  # fmt: skip
    yield Record(f"{name}.direct", {"kernel": kernel, "distribution": distribution, "n": n},
                 ours["direct"], "s", runs=1)  # fmt: skip


def growth(records: list[Record]) -> Iterable[Record]:
    """Exponents of seconds in points, by kernel, accuracy and distribution."""
    series: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for r in records:
        if _compared(r) and r.ranks == 1:
            key = (r.name, r.params["distribution"])
            series.setdefault(key, []).append((r.params["n"], r.value))
    for (name, distribution), found in series.items():
        if len(found) > 1:
            n, seconds = np.log(np.array(sorted(found)).T)
            exponent = float(np.polyfit(n, seconds, 1)[0])
            yield Record("fmm.growth", {"of": name, "distribution": distribution}, exponent, "1")


def curve(quick: bool) -> Iterable[Record]:
    """Work against precision of 10^5 points in the cube."""
    n = 20_000 if quick else 100_000
    ladder = [10.0**-k for k in range(2, 7 if quick else 11)]
    for kernel in KERNELS:
        case: dict[str, Any] = {"kernel": kernel, "distribution": "cube", "n": n}
        for eps in ladder:
            for label, method, options in (
                ("chosen by eps", "own", {}),
                ("symmetric bbfmm", "own", {"method": "symmetric"}),
                ("FMM3D", "fmm3d", {}),
            ):
                if (method == "fmm3d" and not has_rival()) or (options and eps < 1e-7):
                    continue
                found = measure(1, method=method, eps=eps, options=options, **case)
                if found:
                    yield Record(f"fmm.curve.{kernel}", params(case | {"eps": eps}, found) |
                                 {"label": label}, median(found["apply"]), "s",
                                 error=found["error"], runs=len(found["apply"]))  # fmt: skip


def grids(quick: bool) -> Iterable[Record]:
    """Seconds and memory against the order, 20,000 points, three levels (his figs 5.10-5.12)."""
    for kernel in ("laplace",) if quick else ("laplace", "stokeslet"):
        for method in ("ufmm", "bbfmm", "symmetric"):
            for order in ORDERS[: 5 if quick else None]:
                if kernel == "stokeslet" and method == "bbfmm" and order > 6:
                    continue  # the factorisation of all operators asks for more than 10 GB
                options = {"method": method, "order": order, "depth": GRID_DEPTH,
                           "precision": "double"}  # fmt: skip
                found = measure(1, method="own", kernel=kernel, distribution="cube",
                                n=GRID_POINTS, eps=10.0**-order, options=options)  # fmt: skip
                if not found:
                    continue
                described = params({"kernel": kernel, "n": GRID_POINTS, "options": options}, found)
                described |= {"order": order, "tables": found["report"].get("memory")}
                for name, value in (("apply", found["apply"]), ("plan", found["plan"])):
                    yield Record(f"fmm.grids.{name}", described, median(value), "s",
                                 error=found["error"], runs=len(value))  # fmt: skip


def smooth(quick: bool) -> Iterable[Record]:
    """A Gaussian of length 0.5: no near field, against the standard form (his fig. 5.13)."""
    for n in (10_000, 100_000) if quick else (10_000, 100_000, 1_000_000):
        case = {"kernel": "gaussian", "length": SMOOTH_LENGTH, "distribution": "cube", "n": n}
        found = {
            form: measure(1, method="own", eps=1e-6, options={"admissibility": form}, **case)
            for form in ("smooth", "standard")
        }
        if found["smooth"]:
            rival = {}
            if found["standard"]:
                told = median(found["standard"]["apply"])
                rival = {"rival": "standard", "rival_value": told,
                         "ratio": median(found["smooth"]["apply"]) / told}  # fmt: skip
            yield Record("fmm.smooth", params(case | {"eps": 1e-6}, found["smooth"]),
                         median(found["smooth"]["apply"]), "s", error=found["smooth"]["error"],
                         runs=len(found["smooth"]["apply"]), **rival)  # fmt: skip


def limits(quick: bool) -> Iterable[Record]:
    """Near field and translations beside the machine's peak and its memory's bandwidth."""
    sys.path.insert(0, str(Path(__file__).resolve().parent / "lib"))
    import fmm_limits

    yield from fmm_limits.records(quick)


# ---- figure and page -----------------------------------------------------------------------


def draw(records: list[Record], path: Path) -> None:
    """Work-precision, gain over the rival, growth; grids against the order, smooth kernels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 4, figsize=(18, 8), constrained_layout=True)
    for axis, kernel in zip(axes[0], KERNELS, strict=False):
        _draw_curve(axis, kernel, [r for r in records if r.name == f"fmm.curve.{kernel}"])
    cube = [r for r in records if _compared(r) and r.params["distribution"] == "cube"
            and r.ranks == 1]  # fmt: skip
    _draw_gain(axes[0, 2], cube)
    _draw_growth(axes[0, 3], cube)
    _draw_grids(axes[1, 0], records, "apply")
    _draw_grids(axes[1, 1], records, "plan")
    _draw_tables(axes[1, 2], records)
    _draw_smooth(axes[1, 3], [r for r in records if r.name == "fmm.smooth"])
    for axis in axes.flat:
        if axis.has_data():
            axis.legend(fontsize=8)
        else:
            axis.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _compared(record: Record) -> bool:
    """Whether it is a sum of ours at an accuracy that the rival was asked for."""
    _, *kind = record.name.split(".")
    return len(kind) == 2 and kind[0] in KERNELS and kind[1] in ("1e-3", "1e-6", "1e-9")


def _draw_curve(axis: Any, kernel: str, found: list[Record]) -> None:
    for label in dict.fromkeys(r.params["label"] for r in found):
        line = sorted((r.error, r.value) for r in found if r.params["label"] == label)
        axis.loglog(*zip(*line, strict=True), "o-", label=label)
    if found:
        axis.axhline(found[0].params["direct_seconds"], color="k", lw=0.8, ls=":", label="direct")
        axis.set(title=f"{kernel}: {found[0].params['n']:,} points in a cube")
    axis.set(xlabel="relative error (2-norm)", ylabel="seconds an application, one core")
    axis.invert_xaxis()


def _draw_gain(axis: Any, found: list[Record]) -> None:
    found = [r for r in found if r.ratio]
    for kernel, n in dict.fromkeys((r.params["kernel"], r.params["n"]) for r in found):
        line = sorted((r.error, 1.0 / r.ratio) for r in found
                      if (r.params["kernel"], r.params["n"]) == (kernel, n))  # fmt: skip
        axis.semilogx(*zip(*line, strict=True), "o-", label=f"{kernel}, {n:,}")
    if found:
        axis.axhline(1.0, color="k", lw=0.8)
    axis.invert_xaxis()
    axis.set(xlabel="relative error (2-norm)", ylabel="FMM3D's seconds over ours",
             title="cube, one core")  # fmt: skip


def _draw_growth(axis: Any, found: list[Record]) -> None:
    for name in dict.fromkeys(r.name for r in found):
        line = sorted((r.params["n"], r.value) for r in found if r.name == name)
        axis.loglog(*zip(*line, strict=True), "o-", label=name.removeprefix("fmm."))
    axis.set(xlabel="points in a cube", ylabel="seconds an application, one core", title="growth")


def _draw_grids(axis: Any, records: list[Record], name: str) -> None:
    for label, of in _by_grid(records, name).items():
        axis.semilogy([r.params["order"] for r in of], [r.value for r in of], "o-", label=label)
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set(xlabel="order", ylabel="seconds", title=f"{name}: {GRID_POINTS:,} points, 3 levels")


def _draw_tables(axis: Any, records: list[Record]) -> None:
    for label, of in _by_grid(records, "apply").items():
        megabytes = [1e-6 * r.params["tables"]["tables"] for r in of]
        axis.semilogy([r.params["order"] for r in of], megabytes, "o-", label=label)
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set(xlabel="order", ylabel="MB", title="memory of the operators")


def _by_grid(records: list[Record], name: str) -> dict[str, list[Record]]:
    lines: dict[str, list[Record]] = {}
    for r in records:
        if r.name == f"fmm.grids.{name}":
            label = f"{r.params['kernel']}, {r.params['options']['method']}"
            lines.setdefault(label, []).append(r)
    return lines


def _draw_smooth(axis: Any, found: list[Record]) -> None:
    n = [r.params["n"] for r in found]
    if found:
        axis.loglog(n, [r.value for r in found], "o-", label="without a near field")
    told = [(r.params["n"], r.rival_value) for r in found if r.rival_value]
    if told:
        axis.loglog(*zip(*told, strict=True), "o-", label="standard")
    axis.set(xlabel="points in a cube", ylabel="seconds an application, one core",
             title=f"Gaussian of length {SMOOTH_LENGTH}, eps 1e-6")  # fmt: skip


def table(records: list[Record]) -> str:
    """The comparison, growth with the points and the machine's limits, as Markdown."""
    lines = [
        f"`scripts/bench/fmm.py` at {records[0].commit if records else commit()}.",
        "",
        "| kernel | points | error | ours (plan) [s] | FMM3D [s] | FMM3D / ours | direct [s] |",
        "|---|---|---|---|---|---|---|",
        *(_compared_row(r) for r in records if _compared(r)),
        *_growth_lines([r for r in records if r.name == "fmm.growth"]),
        *_limit_lines([r for r in records if r.name.startswith("fmm.limits.")]),
    ]
    return "\n".join(lines)


def _compared_row(r: Record) -> str:
    p = r.params
    told = f"{r.rival_value:.3g} | {1.0 / r.ratio:.2g}" if r.ratio else "- | -"
    cores = "" if r.ranks == 1 else f", {r.ranks} ranks (threads)"
    mark = "" if p["reached"] else " (not as exact)"
    return (
        f"| {p['kernel']} | {p['n']:,} {p['distribution']}{cores} | {r.error:.0e}{mark} | "
        f"{r.value:.3g} ({p['plan_seconds']:.2g}) | {told} | {p['direct_seconds']:.3g} |"
    )


def _growth_lines(found: list[Record]) -> list[str]:
    if not found:
        return []
    told = (f"{r.params['of'].removeprefix('fmm.')} {r.params['distribution']} {r.value:.2f}"
            for r in found)  # fmt: skip
    return ["", f"Seconds grow with the points to the power of: {', '.join(told)}."]


def _limit_lines(found: list[Record]) -> list[str]:
    """Rows of flop/s and ns a pair; of transfers loads as well."""
    by_loop: dict[tuple[str, ...], dict[str, Record]] = {}
    for r in found:
        kind, *name = r.name.removeprefix("fmm.limits.").split(".")
        if kind in ("near", "transfer"):
            nodes = f", {r.params['nodes']} nodes" if "nodes" in r.params else ""
            loop = (f"{kind}, {name[0]}{nodes}", r.params["precision"])
            by_loop.setdefault(loop, {})[name[1] if name[1:] else "flops"] = r
    if not by_loop:
        return []
    lines = [
        "",
        "| loop, on one core | precision | ns a pair | GFlop/s (of the peak) | loads in GB/s |",
        "|---|---|---|---|---|",
    ]
    for (loop, precision), rates in by_loop.items():
        flops, loads = rates["flops"], rates.get("loads")
        lines.append(
            f"| {loop} | {precision} | {flops.params['ns_of_a_pair']:.3g} | {flops.value:.3g} "
            f"({flops.params['fraction']:.0%}) | {f'{loads.value:.3g}' if loads else ''} |"
        )
    rates = {r.name.removeprefix("fmm.limits."): r for r in found}
    peak, product = (
        [rates[f"{name}.{kind}"].value for kind in ("double", "single")]
        for name in ("peak", "matrix_product")
    )
    return [
        *lines,
        "",
        f"The peak, products added in registers, is {peak[0]:.0f} GFlop/s in double and "
        f"{peak[1]:.0f} in single precision; numpy's matrix product reaches {product[0]:.0f} and "
        f"{product[1]:.0f}; STREAM's triad {rates['triad'].value:.0f} GB/s. Loads beyond that "
        "come from the caches.",
    ]


def main() -> None:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--page", type=Path, help="put the table into this Markdown file")
    parser.add_argument("--dry", action="store_true", help="measure nothing, use what is known")
    parser.add_argument("--version", help="take what this version of stokes/fmm measured")
    options = parser.parse_args()
    if options.version:
        _ASKED["version"] = options.version
    if options.dry:
        _ASKED["dry"] = "yes"
    records: list[Record] = []
    for part in options.only:
        for record in globals()[part](options.quick):
            if options.version:
                record.commit = options.version
            write([record])
            records.append(record)
    records += growth(records)
    if any(math.isnan(r.value) for r in records):
        raise SystemExit("a figure is not a number")
    if options.json:
        save(records, options.json)
    if options.figure:
        draw(records, options.figure)
    if options.page:
        if not any(_compared(r) for r in records):
            raise SystemExit("--page: nothing compared; take the part `rival`")
        put("fmm", table(records), options.page)


if __name__ == "__main__":
    main()
