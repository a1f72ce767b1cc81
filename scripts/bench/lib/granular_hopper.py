"""Mass flow out of a conical hopper against the width of its outlet: Beverloo's law.

Beverloo, Leniger and van de Velde (1961): W = C rho_b sqrt(g) (D - k d)^(5/2), with D the diameter
of the outlet, d that of the grains (here the Sauter mean of the mix) and rho_b the bulk density.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lib.granular_runs import Run, run
from numpy.typing import NDArray
from records import Record

SMALL, LARGE = 0.004, 0.005  # [m] radii, half the volume each
SAUTER = 2.0 / (0.5 / SMALL + 0.5 / LARGE)  # [m] diameter d
BULK_DENSITY = 2500 * 0.6  # [kg/m^3] of a random packing; W / C is what it scales
GRAVITY = 9.81
BIN = 0.08  # [m] radius
SLOPE = 1.5  # rise over run of the cone: 34 degrees from the axis
OPENING = 0.35  # [s] when the shutter vanishes
FORMING = 0.12  # [s] to start from rest, and to fall to where bodies are taken out
FILL = 2 * SAUTER  # [m] the lowest bodies start that far above the cone


@dataclass(frozen=True)
class Flow:
    """One discharge: W [kg/s] by a straight line through removed mass against time."""

    ratio: float  # D / d
    rate: float  # W
    unsteadiness: float  # slope of the window's second half over that of its first, minus 1
    residual: float  # largest distance of the removed mass from the line [kg]
    body: float  # mean mass of a body [kg]
    bodies: int  # removed in the window
    overlap: float  # deepest in the window, in radii


@dataclass(frozen=True)
class Beverloo:
    """Fit of W^(2/5) = (C rho_b sqrt g)^(2/5) (D - k d), linear in D."""

    C: float
    k: float
    r_squared: float  # of W itself


def overrides(ratio: float, count: int, discharge: float, **more: Any) -> dict[str, Any]:
    """The settings of configs/hopper.yaml that make an outlet of `ratio` grain diameters."""
    outlet = ratio * SAUTER / 2.0
    height = SLOPE * (BIN - outlet)
    half = 0.7 * BIN
    grid = "bodies.0.placement.jittered_grid"
    return {
        "bodies.0.count": count,
        f"{grid}.min": [-half, -half, height + FILL],
        f"{grid}.max": [half, half, height + FILL + 0.115 * count / 1000.0],
        "walls.0.start": [0, 0, height],
        "walls.1.end": [0, 0, height],
        "walls.1.radii": [outlet, BIN],
        "walls.2.radii": [0, outlet + 0.01],
        "walls.2.until": OPENING,
        "time.end": round(OPENING + discharge, 3),
        "output.interval": 0.1,
        **more,
    }


def flow(ratio: float, done: Run, discharge: float) -> Flow:
    """Measure W once the flow has formed, from a fifth of the watch at least, to its end."""
    time, mass, number, overlap = done.metrics("time", "removed_mass", "removed", "overlap")
    window = time >= OPENING + max(0.2 * discharge, FORMING)
    t, m, n = time[window], mass[window], number[window]
    slope, start = np.polyfit(t, m, 1)
    half = len(t) // 2
    first, second = (
        np.polyfit(t[part], m[part], 1)[0] for part in (slice(half), slice(half, None))
    )
    return Flow(
        ratio=ratio,
        rate=float(slope),
        unsteadiness=float(second / first - 1.0),
        residual=float(np.abs(m - start - slope * t).max()),
        body=float(mass[-1] / number[-1]),
        bodies=int(n[-1] - n[0]),
        overlap=float(overlap[window].max()),
    )


def fit(ratio: NDArray, rate: NDArray) -> Beverloo:
    """Least squares of W^(2/5) against D: C, k, and R^2 of the W that they give."""
    width = np.asarray(ratio) * SAUTER
    slope, intercept = np.polyfit(width, np.asarray(rate) ** 0.4, 1)
    predicted = (slope * width + intercept) ** 2.5
    spread = np.sum((rate - np.mean(rate)) ** 2)
    return Beverloo(
        C=float(slope**2.5 / (BULK_DENSITY * math.sqrt(GRAVITY))),
        k=float(-intercept / slope / SAUTER),
        r_squared=float(1.0 - np.sum((rate - predicted) ** 2) / spread),
    )


def error_of_k(ratio: NDArray, rate: NDArray, scatter: float) -> float:
    """Standard error of k where every W has a relative error of `scatter` on its own."""
    k = fit(ratio, rate).k
    shifted = rate * (1.0 + scatter * np.eye(len(rate)))
    return float(np.sqrt(sum((fit(ratio, row).k - k) ** 2 for row in shifted)))


# ---- the study ------------------------------------------------------------------------------

# D / d, and how long the outlet is watched [s]: as long as the bed still covers the cone.
OUTLETS = ((4.5, 1.5), (6.0, 1.0), (7.5, 0.6), (9.0, 0.35))
VARIED = 7.5  # the outlet that seeds, time step and tolerance are tried on
SEEDS = (0, 1, 2)


def study(quick: bool) -> tuple[list[Record], dict[str, Any]]:
    """Run the discharges; return the records, and what `draw` needs."""
    count = 1500 if quick else 3000
    outlets = OUTLETS[1:3] if quick else OUTLETS
    share = 0.4 if quick else 1.0
    watched = {ratio: share * seconds for ratio, seconds in outlets}
    seeds = SEEDS[:1] if quick else SEEDS
    flows: dict[tuple[float, int], Flow] = {}

    def discharge(ratio: float, **more: Any) -> Flow:
        done = run("hopper", overrides(ratio, count, watched[ratio], **more))
        return flow(ratio, done, watched[ratio])

    for ratio in watched:
        for seed in seeds if ratio == VARIED else seeds[:1]:
            flows[ratio, seed] = discharge(ratio, seed=seed)
    records = [_flow_record(found, count, {"seed": seed}) for (_, seed), found in flows.items()]
    ratios = np.array(list(watched))
    mean = np.array([np.mean([f.rate for f in flows.values() if f.ratio == r]) for r in ratios])
    law = fit(ratios, mean)
    if not quick:  # two outlets make any line fit
        rates = [found.rate for found in flows.values() if found.ratio == VARIED]
        scatter = float(np.std(rates, ddof=1) / np.mean(rates))
        params = {"spheres": count, "outlets": list(watched), "d": SAUTER}
        params |= {"bulk_density": BULK_DENSITY}
        about = {"spheres": count, "ratio": VARIED}
        error = error_of_k(ratios, mean, scatter)
        records += [
            Record("granular.hopper.k", params, law.k, "1", error=error),
            Record("granular.hopper.C", params, law.C, "1"),
            Record("granular.hopper.r_squared", params, law.r_squared, "1"),
            Record("granular.hopper.scatter", about, scatter, "1", runs=len(rates)),
        ]
        finer = {"time.step": 5e-4}
        tighter = {"contact.tolerance": 1e-4, "contact.complementarity": 1e-3}
        records += [
            _flow_record(discharge(VARIED, seed=0, **changed), count, {"seed": 0, **changed})
            for changed in (finer, tighter)
        ]
    return records, {"flows": list(flows.values()), "law": law}


def _flow_record(found: Flow, count: int, varied: dict[str, Any]) -> Record:
    params = {
        "ratio": found.ratio, "spheres": count, "bodies_out": found.bodies,
        "unsteadiness": found.unsteadiness, "residual_bodies": found.residual / found.body,
        "overlap": found.overlap, **varied,
    }  # fmt: skip
    return Record("granular.hopper.mass_flow", params, found.rate, "kg/s")


def draw(found: dict[str, Any], path: Path) -> None:
    """W^(2/5) against D/d with the fitted line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    flows, law = found["flows"], found["law"]
    figure, axis = plt.subplots(figsize=(5, 4), constrained_layout=True)
    ratio = np.array([f.ratio for f in flows])
    axis.plot(ratio, [f.rate**0.4 for f in flows], "o", label="measured")
    line = np.array([law.k, ratio.max() + 0.5])
    factor = (law.C * BULK_DENSITY * math.sqrt(GRAVITY)) ** 0.4 * SAUTER
    axis.plot(line, factor * (line - law.k), "-", label=f"C = {law.C:.2f}, k = {law.k:.2f}")
    axis.set_xlabel("outlet D / d")
    axis.set_ylabel("W^(2/5)  [(kg/s)^(2/5)]")
    axis.set_xlim(left=0)
    axis.set_ylim(bottom=0)
    axis.grid(True, alpha=0.25)
    axis.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
