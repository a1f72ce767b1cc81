"""A rotating drum in steady state: slope of the bed, torque on the mantle, power."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lib.granular_runs import Run, run
from numpy.typing import NDArray
from records import Record

RADIUS = 0.1  # [m] of the drum
SPHERE = 0.004  # [m]
DENSITY = 2500.0  # [kg/m^3]
GRAVITY = 9.81  # [m/s^2]


@dataclass(frozen=True)
class Steady:
    """Means over the steady part of a run."""

    angle: float  # of the centre of mass from straight below the axis [degrees]
    scatter: float  # standard deviation of that angle from frame to frame [degrees]
    surface: float  # slope of the free surface in the middle half of the drum [degrees]
    torque: float  # on the mantle about its axis [N m]
    torque_ratio: float  # torque over weight times lateral offset of the centre of mass
    power: float  # work of the mantle on the bed per time [W]
    power_ratio: float  # dissipation over work


def surface_angle(position: NDArray[np.float64]) -> float:
    """Slope [degrees] of the surface in the middle half of the drum, over frames (frames, n, 3).

    In strips about as wide as a sphere the highest centre of each frame; the median over the
    frames, which leaves out spheres in flight; a straight line through the strips.
    """
    strips = int(0.5 * RADIUS / SPHERE)
    strip = np.floor((position[:, :, 0] + 0.5 * RADIUS) / RADIUS * strips).astype(int)
    inside = (strip >= 0) & (strip < strips)
    highest = np.full((len(position), strips), -np.inf)
    frame = np.broadcast_to(np.arange(len(position))[:, None], strip.shape)
    np.maximum.at(highest, (frame[inside], strip[inside]), position[:, :, 2][inside])
    slope = np.polyfit(np.arange(strips) * RADIUS / strips, np.median(highest, axis=0), 1)[0]
    return float(np.degrees(np.arctan(-slope)))


def steady(done: Run, start: float) -> Steady:
    """Measure from `start` [s] to the end of a run of the drum, which turns about y.

    Each step kicks every body by g h, and the contacts take back what is not needed to fall: of
    what they dissipate, m g^2 h / 2 per time is that, and not the mantle's work.
    """
    time, work, balance = done.metrics("time", "wall_work", "energy_balance")
    torque = done.reaction("mantle")[:, 4]
    window = time > start
    position = np.array([frame["position"] for t, frame in done.frames("position") if t > start])
    centre = position.mean(axis=1)
    weight = DENSITY * 4.0 / 3.0 * np.pi * SPHERE**3 * GRAVITY * position.shape[1]
    angle = np.degrees(np.arctan2(-centre[:, 0], -centre[:, 2]))
    seconds = float(time[-1] - start)
    power = float(work[window].sum()) / seconds
    lost = power - float(balance[window].sum()) / seconds
    kick = 0.5 * weight * GRAVITY * float(time[0])
    mean_torque = float(torque[window].mean())
    return Steady(
        angle=float(angle.mean()),
        scatter=float(angle.std()),
        surface=surface_angle(position),
        torque=mean_torque,
        torque_ratio=mean_torque / (weight * float(centre[:, 0].mean())),
        power=power,
        power_ratio=(lost - kick) / power,
    )


# ---- the study ------------------------------------------------------------------------------

# Friction between the spheres, and rate of rotation [rad/s].
CASES = ((0.2, 2.0), (0.4, 2.0), (0.8, 2.0), (0.4, 1.0), (0.4, 4.0))
START, END = 1.5, 3.0  # [s]


def overrides(mu: float, rate: float, count: int, end: float) -> dict[str, Any]:
    """The settings of configs/drum.yaml; its depth goes with the number of bodies."""
    depth = 0.05 * count / 1500.0
    return {
        "bodies.0.count": count,
        "bodies.0.placement.jittered_grid.max": [0.069, depth, 0.069],
        "walls.0.end": [0, depth, 0],
        "walls.0.motion.rotation.rate": rate,
        "walls.2.point": [0, depth, 0],
        "friction.default": mu,
        "time.end": end,
    }


def study(quick: bool) -> tuple[list[Record], list[dict[str, Any]]]:
    """Run the drum at several frictions and speeds; return records, and rows for `draw`."""
    count, end = (500, 2.0) if quick else (1000, END)
    records, rows = [], []
    for mu, rate in CASES[:3] if quick else CASES:
        found = steady(run("drum", overrides(mu, rate, count, end)), START)
        froude = rate**2 * RADIUS / GRAVITY
        params = {"mu": mu, "rate": rate, "froude": froude, "spheres": count}
        rows.append({"mu": mu, "froude": froude} | asdict(found))
        for name, value, unit, error in (
            ("angle", found.angle, "degrees", found.scatter),
            ("surface_angle", found.surface, "degrees", None),
            ("torque", found.torque, "N m", None),
            ("torque_ratio", found.torque_ratio, "1", abs(found.torque_ratio - 1.0)),
            ("power", found.power, "W", None),
            ("power_ratio", found.power_ratio, "1", abs(found.power_ratio - 1.0)),
        ):
            records.append(Record(f"granular.drum.{name}", params, value, unit, error=error))
    return records, rows


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Angle of repose against friction, and against the Froude number."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(8, 3.5), constrained_layout=True, sharey=True)
    same_speed = [row for row in rows if row["froude"] == rows[0]["froude"]]
    same_friction = sorted((row for row in rows if row["mu"] == 0.4), key=lambda row: row["froude"])
    for axis, key, chosen, label in (
        (axes[0], "mu", same_speed, "friction coefficient"),
        (axes[1], "froude", same_friction, "Froude number"),
    ):
        angle, scatter = ([row[name] for row in chosen] for name in ("angle", "scatter"))
        along = [row[key] for row in chosen]
        axis.errorbar(along, angle, scatter, fmt="o-", capsize=3, label="centre of mass")
        axis.plot(along, [row["surface"] for row in chosen], "s--", label="surface")
        axis.set_xlabel(label)
        axis.grid(True, alpha=0.25)
    axes[1].legend()
    axes[0].set_ylabel("dynamic angle of repose [degrees]")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
