"""Collapsing columns of spheres: run-out against aspect ratio, beside published laws.

The columns of configs/column_collapse.yaml, of several heights in the same tube. Height H0 is twice
the height of the centre of mass when the tube vanishes. Two measures of the front, each with one
sphere's radius added: `mass`, the distance from the axis that 97.5 % of the mass keep within, and
`heap`, that of the outermost sphere of the heap, which is what hangs together by gaps below a tenth
of a diameter (stray spheres are no heap). Experiments look at the edge of the deposit, as `heap`
does.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lib.granular_runs import Run, run
from numpy.typing import NDArray
from records import Record
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

TUBE, RADIUS, GRAVITY = 0.07, 0.005, 9.81  # [m], [m], [m/s^2] as in the scene
SIDE, CELL, BASE = 0.0494, 0.01116, 0.003  # [m] half width, layer, bottom of the first grid
PER_LAYER = 81  # spheres in a layer of it
PER_ASPECT = 1124  # spheres in a column as high as the tube is wide (half of it)
SETTLING, SPREADING = 0.12, 5.0  # [s] after the fall; of the collapse [sqrt(H0 / g)]
HELD = 0.975  # share of the mass within the front
GAP = 0.1  # [diameters] that the heap may have between neighbours

ASPECTS = (0.5, 0.9, 1.4, 2.1, 3.1, 4.4, 6.0)
AGAIN = ((0.9, 1), (2.1, 1), (0.9, 2), (2.1, 2))  # aspect ratios and seeds, for the scatter
QUICK = (0.3, 0.5, 0.9)
BREAK = 1.7  # aspect ratio at which the published laws change


@dataclass(frozen=True)
class Collapse:
    """One column: a = H0 / R0 at release, fronts r / R0 at the end, and what is left moving."""

    seed: int
    spheres: int
    aspect: float
    height: float
    mass_front: float
    heap_front: float
    heap_share: float
    late_growth: float
    kinetic_speed: float


def lube(aspect: NDArray) -> NDArray:
    """(r - R0) / R0 of Lube, Huppert, Sparks, Hallworth, J. Fluid Mech. 508 (2004) 175."""
    return np.where(aspect < BREAK, 1.24 * aspect, 1.6 * np.sqrt(aspect))


def collapse(aspect: float, seed: int) -> Collapse:
    """Run one column and measure it."""
    spheres = round(PER_ASPECT * aspect)
    top = BASE + CELL * math.ceil(spheres / PER_LAYER)
    height = aspect * TUBE
    release = round(math.sqrt(2 * max(top - height, 0.0) / GRAVITY) + SETTLING, 2)
    overrides = {
        "seed": seed,
        "bodies.0.count": spheres,
        "bodies.0.placement.jittered_grid.max": [SIDE, SIDE, round(top, 4)],
        "walls.1.until": release,
        "time.end": round(release + SPREADING * math.sqrt(height / GRAVITY), 2),
    }
    return measure(run("column_collapse", overrides), release, seed)


def measure(done: Run, release: float, seed: int) -> Collapse:
    """Height at release, fronts at the end and 1 - 1/SPREADING of the way to it."""
    frames = done.frames("position")
    time = np.array([t for t, _ in frames])

    def points(t: float) -> NDArray:
        return frames[int(np.argmin(np.abs(time - t)))][1]["position"]

    height = 2.0 * float(points(release)[:, 2].mean())
    last = points(time[-1])
    before = points(time[-1] - (time[-1] - release) / SPREADING)
    share, heap = heap_front(last)
    front = mass_front(last)
    (speed,) = done.metrics("kinetic_speed")
    return Collapse(
        seed=seed,
        spheres=len(last),
        aspect=height / TUBE,
        height=height,
        mass_front=front / TUBE,
        heap_front=heap / TUBE,
        heap_share=share,
        late_growth=front / mass_front(before) - 1.0,
        kinetic_speed=float(speed[-1]),
    )


def mass_front(position: NDArray) -> float:
    """Distance from the axis that holds the share HELD of equal spheres [m]."""
    return float(np.quantile(np.hypot(*position[:, :2].T), HELD)) + RADIUS


def heap_front(position: NDArray) -> tuple[float, float]:
    """Share of the spheres in the largest cluster, and how far that reaches from the axis [m]."""
    pairs = cKDTree(position).query_pairs(2 * RADIUS * (1 + GAP), output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(position),) * 2)
    cluster = connected_components(links, directed=False)[1]
    heap = cluster == np.argmax(np.bincount(cluster))
    return float(heap.mean()), float(np.hypot(*position[heap, :2].T).max()) + RADIUS


# ---- records and figure --------------------------------------------------------------------


def fits(columns: list[Collapse], front: str) -> tuple[float, float, float]:
    """Slope through the origin below BREAK; exponent and factor of a power of a above it."""
    a = np.array([c.aspect for c in columns])
    run_out = np.array([getattr(c, front) for c in columns]) - 1.0
    low, high = a < BREAK, a >= BREAK
    slope = float(a[low] @ run_out[low] / (a[low] @ a[low]))
    if np.count_nonzero(high) < 2:
        return slope, math.nan, math.nan
    exponent, logarithm = np.polyfit(np.log(a[high]), np.log(run_out[high]), 1)
    return slope, float(exponent), float(math.exp(logarithm))


def scatter(columns: list[Collapse], front: str) -> dict[str, float]:
    """Standard deviation over the seeds of (r - R0) / R0 over its mean, by column."""
    found = {}
    for spheres in sorted({c.spheres for c in columns}):
        values = [getattr(c, front) - 1.0 for c in columns if c.spheres == spheres]
        if len(values) > 1:
            mean_aspect = np.mean([c.aspect for c in columns if c.spheres == spheres])
            found[f"{mean_aspect:.2f}"] = float(np.std(values, ddof=1) / np.mean(values))
    return found


def records(columns: list[Collapse]) -> list[Record]:
    """One record a column and measure, then the fits and the scatter."""
    rows = []
    for c in columns:
        law = float(lube(np.array(c.aspect)))
        rows.append(_against("run_out.heap", asdict(c), c.heap_front - 1, law))
        rows.append(_against("run_out.mass", {"aspect": c.aspect}, c.mass_front - 1, law))
    for front in ("heap", "mass"):
        slope, exponent, factor = fits(columns, f"{front}_front")
        rows.append(_against(f"slope.{front}", {"below": BREAK}, slope, 1.24))
        if not math.isnan(exponent):
            rows.append(_against(f"exponent.{front}", {"above": BREAK}, exponent, 0.5))
            rows.append(_against(f"factor.{front}", {"above": BREAK}, factor, 1.6))
        for aspect, value in scatter(columns, f"{front}_front").items():
            name = f"granular.column.scatter.{front}"
            rows.append(Record(name, {"aspect": aspect}, value, "1"))
    return rows


def _against(name: str, params: dict[str, Any], value: float, law: float) -> Record:
    """A record beside the published value; their ratio is no contest."""
    return Record(
        f"granular.column.{name}", params, value, "1", "Lube et al. 2004", law, value / law
    )


def draw(columns: list[Collapse], path: Path) -> None:
    """Run-out against aspect ratio, both measures, with the published law."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FixedLocator, FormatStrFormatter, NullFormatter

    figure, axes = plt.subplots(figsize=(6, 4.5), constrained_layout=True)
    a = np.array([c.aspect for c in columns])
    for front, marker, label in (
        ("heap_front", "o", "edge of the heap"), ("mass_front", "s", "97.5 % of the mass"),
    ):  # fmt: skip
        values = np.array([getattr(c, front) for c in columns]) - 1.0
        slope, exponent, factor = fits(columns, front)
        axes.loglog(a, values, marker, ms=5, mfc="none",
                    label=f"{label}: {slope:.2f} a, {factor:.2f} a^{exponent:.2f}")  # fmt: skip
    fine = np.geomspace(0.8 * a.min(), 1.2 * a.max(), 200)
    for part in (fine < BREAK, fine >= BREAK):
        label = "Lube et al. 2004: 1.24 a, 1.6 a^0.5" if part[0] else None
        axes.loglog(fine[part], lube(fine[part]), "k-", lw=1, label=label)
    for axis, ticks in ((axes.xaxis, (0.5, 1, 2, 5)), (axes.yaxis, (0.5, 1, 2, 4))):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter(FormatStrFormatter("%g"))
        axis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("aspect ratio a = H0 / R0")
    axes.set_ylabel("run-out (r - R0) / R0")
    axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def study(quick: bool) -> tuple[list[Record], list[Collapse]]:
    """Run the columns; return the records, and what `draw` needs."""
    cases = [(aspect, 0) for aspect in (QUICK if quick else ASPECTS)]
    cases += () if quick else AGAIN
    columns = [collapse(aspect, seed) for aspect, seed in cases]
    return records(columns), columns
