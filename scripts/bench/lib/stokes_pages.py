"""Tables, figure and picture of stokes.py, and the figures of S. De's thesis beside them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class DeRow(NamedTuple):
    """S. De, PhD thesis 2021, Table 3.1, all seconds of one run; no error where none converged."""

    kernels: float
    factorisation: float
    applications: int | None
    near: float
    fmm: float
    error: float | None

    @property
    def seconds(self) -> float | None:
        """All of them, of runs that converged."""
        if self.error is None:
            return None
        return self.kernels + self.factorisation + self.near + self.fmm


DE_TABLE = {  # (threads, bodies)
    (1, 2): DeRow(3.8, 0.1, 14, 1.1, 2.0, 4.4471e-7),
    (1, 4): DeRow(4.2, 1.3, 22, 2.5, 4.5, 1.0709e-6),
    (1, 8): DeRow(6.6, 3.1, 27, 5.1, 16.5, 8.4709e-7),
    (1, 16): DeRow(13.5, 6.1, 29, 10.1, 37.9, 7.1951e-7),
    (1, 32): DeRow(24.5, 12.1, 54, 21.0, 85.7, 7.1479e-7),
    (1, 64): DeRow(49.5, 26.8, 177, 43.0, 196.1, 4.4704e-6),
    (2, 4): DeRow(3.5, 0.9, 23, 1.8, 2.7, 7.6096e-7),
    (2, 8): DeRow(4.1, 1.6, 22, 3.7, 9.1, 2.5302e-6),
    (2, 16): DeRow(7.0, 3.2, 46, 7.8, 21.0, 1.3312e-6),
    (2, 32): DeRow(14.2, 6.9, 56, 15.7, 47.6, 7.3557e-7),
    (2, 64): DeRow(26.9, 14.7, 123, 27.6, 100.5, 7.9819e-7),
    (2, 128): DeRow(52.6, 26.1, None, 56.6, 214.0, None),
}
STAGES = ("kernels", "factorisation", "near plan", "near", "fmm plan", "fmm", "self",
          "preconditioner")  # fmt: skip
Known = list[tuple[Any, dict[str, Any]]]


# ---- what rows say -------------------------------------------------------------------------


def gap_error(task: dict[str, Any], row: dict[str, Any]) -> float | None:
    """Of loads on spheres that move, relative; of a known flow, the largest at any point."""
    if "error_to_largest" in row:
        return max(row["error_to_largest"].values())
    from stokes.exact import two_spheres_axial, two_spheres_spinning

    name, arguments = task["scene"]
    if name != "pair" or tuple(arguments["semi_axes"]) != (1.0, 1.0):
        return None
    spins = task["data"].startswith("spin")
    matrix = (two_spheres_spinning if spins else two_spheres_axial)(1.0, 1.0, arguments["gap"])
    motion = np.array([1.0, 1.0 if task["data"].endswith("same") else -1.0])
    loads = np.array(row["loads"])[:, 5 if spins else 2]
    return float(np.abs(loads + matrix @ motion).max() / np.abs(matrix @ motion).max())


def compared(known: Known) -> list[tuple[str, float, dict[str, Any]]]:
    """Method, error of all loads in the 2-norm, and row, beside the tightest of ours."""
    ours = {p.task["tolerance"]: r for p, r in known if p.task["kind"] == "solve"}
    if not ours:
        return []
    reference = np.array(ours[min(ours)]["loads"])

    def error(row: dict[str, Any]) -> float:
        return float(np.linalg.norm(row["loads"] - reference) / np.linalg.norm(reference))

    found = [
        (f"boundary integrals, {t:.0e}", error(r), r) for t, r in ours.items() if t > min(ours)
    ]
    blobs = [(f"multiblob, {p.task['blobs']} blobs", error(r), r)
             for p, r in known if p.task["kind"] == "multiblob"]  # fmt: skip
    return found + blobs


def _part(known: Known, part: str) -> Known:
    return [(piece, row) for piece, row in known if piece.part == part]


# ---- tables --------------------------------------------------------------------------------


def tables(known: Known, records: Sequence[Any], version: str) -> dict[str, str]:
    """Markdown by the name of its markers; parts of which nothing is known are left alone."""
    made = {
        "single": _single_table(known, records),
        "table": "\n\n".join(filter(None, (_de_table(known, "his"), _de_table(known, "1e-8")))),
        "gaps": _gap_table(known),
        "rival": _rival_table(known),
        "squirmers": _squirmer_table(known),
    }
    note = f"`scripts/bench/stokes.py` at {version}."
    return {name: f"{note}\n\n{text}" for name, text in made.items() if text}


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return ""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _number(value: float | None, digits: int = 2) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0.0 and (abs(value) < 1e-2 or abs(value) >= 1e5):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        raised = str(int(exponent)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa}·10{raised}"
    return f"{float(f'{value:.{digits}g}'):,.12g}"


def _single_table(known: Known, records: Sequence[Any]) -> str:
    rows = []
    for piece, row in _part(known, "single"):
        if piece.task["modes"] == 5 * piece.task["panels"]:
            seconds = [_number(row["seconds"][stage]) for stage in SINGLE_STAGES]
            rows.append([str(piece.task["panels"]), str(piece.task["modes"]), f"{row['nodes']:,}",
                         *seconds, _number(row["error_to_largest"]),
                         _number(row["error_by_component"])])  # fmt: skip
    heads = ["panels", "modes", "nodes", *(f"{s} [s]" for s in SINGLE_STAGES),
             "error / largest velocity", "by component (3.141)"]  # fmt: skip
    grown = [f"{r.params['stage']} {r.value:.2f}" for r in records
             if r.name == "stokes.single.growth"]  # fmt: skip
    text = _markdown(heads, rows)
    if text and grown:
        text += f"\n\nSeconds grow with the nodes to the power of: {', '.join(grown)}."
    return text


SINGLE_STAGES = ("kernels", "factorisation", "solve", "evaluation")


def _de_table(known: Known, aim: str) -> str:
    rows = []
    for piece, row in _part(known, "table"):
        if not piece.label.startswith(aim):
            continue
        phases = row["phases"]
        seconds = [_sum(phases, ("kernels", "factorisation")),
                   _sum(phases, ("near plan", "near", "self")), _sum(phases, ("fmm plan", "fmm")),
                   phases.get("preconditioner")]  # fmt: skip
        whole = row["seconds"]["set-up"] + row["seconds"]["solve"]
        rows.append([
            f"{row['bodies']}", str(piece.ranks), f"{row['nodes']:,}", _number(row["gap"]),
            _number(row["volume_fraction"]), _told(row["iterations"], piece, row, "applications"),
            *map(_number, seconds), _told(whole, piece, row, "seconds"),
            _told(row["error_absolute"].get("box", math.nan), piece, row, "error"),
            _number(max(row["error_to_largest"].values())),
        ])  # fmt: skip
    heads = ["bodies", "ranks", "nodes", "least gap", "volume fraction", "applications",
             "kernels, factors [s]", "near, self [s]", "FMM [s]", "preconditioner [s]",
             "all [s]", "error in the box", "relative, to 10⁻³ of surfaces"]  # fmt: skip
    return _markdown(heads, rows)


def _sum(phases: dict[str, float], names: Sequence[str]) -> float:
    return sum(phases.get(name, 0.0) for name in names)


def _told(value: float, piece: Any, row: dict[str, Any], field: str) -> str:
    """Ours, and S. De's behind it at his resolution."""
    digits = 2 if field == "error" else 3
    unfinished = field == "applications" and not row["converged"]
    ours = _number(value, digits) + (" (not converged)" if unfinished else "")
    if piece.task.get("resolution") is None:
        return ours
    his = DE_TABLE.get((piece.ranks, row["bodies"]))
    return f"{ours} / {_number(getattr(his, field, None), digits)}"


def _gap_table(known: Known) -> str:
    found: dict[tuple[str, str, float], dict[str, Any]] = {}
    for piece, row in _part(known, "gaps"):
        name = piece.label.partition(f"-{row['gap']:g}-")[0]
        cell = found.setdefault((name, piece.task["data"], row["gap"]), {})
        cell[piece.task["options"]["preconditioner"]] = (piece.task, row)
    rows = []
    for (name, data, gap), cell in found.items():
        task, row = cell.get("neighbours") or cell["body"]
        iterations = [
            _number(cell[kind][1]["iterations"], 3) if kind in cell else "–"
            for kind in ("neighbours", "body")
        ]
        rows.append([name, _number(gap), data.replace("_", " "), f"{row['nodes']:,}", *iterations,
                     _number(row["seconds"]["set-up"] + row["seconds"]["solve"]),
                     _number(gap_error(task, row))])  # fmt: skip
    heads = ["bodies", "gap", "data", "nodes", "iterations", "with one-body inverses alone",
             "seconds", "error"]  # fmt: skip
    return _markdown(heads, rows)


def _rival_table(known: Known) -> str:
    rows = [
        [label, f"{row['nodes']:,}", str(row["iterations"]), _number(row["seconds"]["set-up"]),
         _number(row["seconds"]["solve"]), _number(error)]
        for label, error, row in compared(_part(known, "rival"))
    ]  # fmt: skip
    heads = ["method", "nodes or blobs", "iterations", "set-up [s]", "solution [s]",
             "error of forces and torques"]  # fmt: skip
    return _markdown(heads, rows)


def _squirmer_table(known: Known) -> str:
    rows = []
    for piece, row in _part(known, "squirmers"):
        seconds = [_number(row["seconds"][k]) for k in ("set-up", "held", "free", "evaluation")]
        rows.append([str(row["bodies"]), str(piece.ranks), f"{row['nodes']:,}",
                     _number(row["gap"]), _number(row["volume_fraction"]),
                     str(row["iterations"]), str(row["iterations_free"]), *seconds,
                     _number(row["fastest"])])  # fmt: skip
    heads = ["bodies", "ranks", "nodes", "least gap", "volume fraction", "iterations, held",
             "free", "set-up [s]", "solution, held [s]", "free [s]", "picture [s]",
             "fastest swims with"]  # fmt: skip
    return _markdown(heads, rows)


# ---- figure --------------------------------------------------------------------------------


def draw(known: Known, records: Sequence[Any], path: Path) -> None:
    """Errors and seconds of one body, of suspensions, of close pairs, and beside the rival."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(15, 8.5), constrained_layout=True)
    single = _part(known, "single")
    _draw_convergence(axes[0, 0], single)
    _draw_stages(axes[0, 1], single, records)
    _draw_gaps(axes[0, 2], _part(known, "gaps"))
    _draw_table(axes[1, 0], _part(known, "table"), "applications")
    _draw_table(axes[1, 1], _part(known, "table"), "seconds")
    _draw_rival(axes[1, 2], compared(_part(known, "rival")))
    for axis in axes.flat:
        axis.grid(True, which="both", alpha=0.25)
        if axis.lines:
            axis.legend(fontsize=8)
        else:
            axis.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _draw_convergence(axis: Any, found: Known) -> None:
    """S. De's figure 3.2: his measure against modes and panels."""
    lines = {"modes = 5 panels": [], "modes, 16 panels": [], "nodes of the meridian, 60 modes": []}
    for piece, row in found:
        panels, modes = piece.task["panels"], piece.task["modes"]
        error = max(row["error_by_component"], 1e-16)
        if modes == 5 * panels:
            lines["modes = 5 panels"].append((modes, error))
        if panels == 16:
            lines["modes, 16 panels"].append((modes, error))
        if modes == 60:
            lines["nodes of the meridian, 60 modes"].append((10 * panels, error))
    for label, line in lines.items():
        if len(line) > 1:
            axis.semilogy(*zip(*sorted(line), strict=True), "o-", label=label)
    if axis.lines:
        axis.axhline(1e-9, color="grey", linestyle=":", label="S. De's floor")
    axis.set(xlabel="modes, or nodes of a meridian", ylabel="relative error (3.141)",
             title="one spheroid, five point forces inside")  # fmt: skip


def _draw_stages(axis: Any, found: Known, records: Sequence[Any]) -> None:
    """S. De's figure 3.3: seconds of each stage against all nodes."""
    grown = {r.params["stage"]: r.value for r in records if r.name == "stokes.single.growth"}
    together = [(r["nodes"], r["seconds"]) for p, r in found
                if p.task["modes"] == 5 * p.task["panels"]]  # fmt: skip
    for stage in SINGLE_STAGES if len(together) > 1 else ():
        line = sorted((nodes, max(seconds[stage], 1e-5)) for nodes, seconds in together)
        label = f"{stage}, N^{grown[stage]:.2f}" if stage in grown else stage
        axis.loglog(*zip(*line, strict=True), "o-", label=label)
    axis.set(xlabel="nodes on the surface N", ylabel="seconds, one core", title="stages")


def _draw_gaps(axis: Any, found: Known) -> None:
    series: dict[tuple[str, str], list[tuple[float, int]]] = {}
    for piece, row in found:
        if piece.task["data"] == "point_forces":
            name = piece.label.partition(f"-{row['gap']:g}-")[0]
            key = (name, piece.task["options"]["preconditioner"])
            series.setdefault(key, []).append((row["gap"], row["iterations"]))
    colours = {name: f"C{k}" for k, name in enumerate(dict.fromkeys(n for n, _ in series))}
    for (name, kind), line in series.items():
        style = {"neighbours": "o-", "body": "x--"}[kind]
        label = name if kind == "neighbours" else None
        axis.loglog(*zip(*sorted(line), strict=True), style, color=colours[name], label=label)
    axis.set(xlabel="gap / radius", ylabel="iterations to 1e-6",
             title="dashed: one-body inverses alone")  # fmt: skip


def _draw_table(axis: Any, found: Known, field: str) -> None:
    for k, (aim, label) in enumerate((("his", "his resolution"), ("1e-8", "to 1e-8"))):
        for ranks in (1, 2):
            line = [(r["bodies"], _value(r, field)) for p, r in found
                    if p.label.startswith(aim) and p.ranks == ranks]  # fmt: skip
            if line:
                text = f"{label}, {ranks} rank{'s' * (ranks > 1)}"
                axis.loglog(*zip(*sorted(line), strict=True), "o-" if ranks == 1 else "s--",
                            color=f"C{k}", label=text)  # fmt: skip
    his = [(n, getattr(row, field)) for (threads, n), row in DE_TABLE.items()
           if threads == 1 and getattr(row, field)]  # fmt: skip
    if axis.lines:
        axis.loglog(*zip(*his, strict=True), "k:x", label="S. De 2021, one thread")
    axis.set(xlabel="random spheroids", ylabel=field, title=f"Table 3.1: {field}")


def _value(row: dict[str, Any], field: str) -> float:
    if field == "applications":
        return row["iterations"]
    return row["seconds"]["set-up"] + row["seconds"]["solve"]


def _draw_rival(axis: Any, found: list[tuple[str, float, dict[str, Any]]]) -> None:
    for label, style in (("boundary integrals", "o-"), ("multiblob", "s--")):
        line = [(_value(row, "seconds"), error) for name, error, row in found
                if name.startswith(label)]  # fmt: skip
        if line:
            axis.loglog(*zip(*sorted(line), strict=True), style, label=label)
    bodies = found[0][2]["bodies"] if found else 0
    axis.set(xlabel="seconds, one core", ylabel="error of forces and torques",
             title=f"{bodies} random spheroids")  # fmt: skip


def draw_flow(task: dict[str, Any], path: Path) -> None:
    """Streamlines and speed in the plane through the middle of the active spheroids."""
    from lib.stokes_scenes import grid_of_spheroids
    from lib.stokes_work import middle_plane

    from stokes.render import draw_slice

    scene = grid_of_spheroids(task["edge"], task["spacing"])
    plane, velocity = middle_plane(scene, task["pixels"]), np.load(task["field"])
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"{scene.count} active spheroids"
    draw_slice(path, plane, velocity, scene.bodies(), title, width=900)
