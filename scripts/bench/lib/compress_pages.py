"""Tables, figures and the picture of compress.py."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from lib.compress_data import FIELDS, PHASES, STEP, STEPS, TAUS, Sediment

Known = list[tuple[Any, Any]]
Row = dict[str, Any]
NAMES = {"sz3": "SZ3", "sperr": "SPERR", "zfp": "zfp", "blosc2": "blosc2"}


def chosen(known: Known, part: str) -> Known:
    """The pieces of a part."""
    return [(piece, found) for piece, found in known if piece.part == part]


# ---- what rows say -------------------------------------------------------------------------


def raw_bytes(bodies: int, rows: Sequence[Row]) -> int:
    """Bytes of these chunks of a field as float64."""
    return 8 * 3 * STEPS * bodies * len(rows)


def total_bytes(rows: Iterable[Row]) -> int:
    """Ours."""
    return sum(row["bytes"] for row in rows)


def phase_bytes(rows: Sequence[Row], rival: str, kind: str = "rivals") -> float | None:
    """A rival's; None unless it is known for all of these chunks."""
    found = [row[kind].get(rival) for row in rows if kind in row]
    if len(found) < len(rows) or not all(found):
        return None
    return sum(one["bytes"] for one in found)


def relative_error(rows: Sequence[Row]) -> float:
    """Root mean square over the chunks of ||X - Y||_F / ||X||_F; chunks of zeros left out."""
    squares = [(row["frobenius"] / row["norm"]) ** 2 for row in rows if row["norm"] > 0.0]
    return math.sqrt(sum(squares) / len(squares)) if squares else 0.0


def bytes_by_coder(rows: Iterable[Row]) -> dict[str, int]:
    """Ours, by the coder that won."""
    found: dict[str, int] = {}
    for row in rows:
        found[row["coder"]] = found.get(row["coder"], 0) + row["bytes"]
    return found


def _of_phase(rows: Iterable[Row], phase: str) -> list[Row]:
    return [row for row in rows if row["phase"] == phase]


def _archives(known: Known, field: str) -> dict[float, list[Row]]:
    """Rows of the archives of a field by tolerance."""
    return {
        piece.task["tau"]: found["rows"]
        for piece, found in chosen(known, "sediment")
        if piece.task["kind"] == "archive" and piece.task["fields"][-1] == field
    }


def _trains(known: Known) -> dict[float, list[Row]]:
    return {
        piece.task["tau"]: rows
        for piece, rows in chosen(known, "sediment")
        if piece.task["kind"] == "trains"
    }


def _ratio(bodies: int, rows: Sequence[Row], size: float | None = None) -> float | None:
    if not rows:
        return None
    return raw_bytes(bodies, rows) / (total_bytes(rows) if size is None else size)


# ---- tables --------------------------------------------------------------------------------


def tables(known: Known, records: Sequence[Any], version: str) -> dict[str, str]:
    """Markdown by the name of its markers; parts of which nothing is known are left alone."""
    if not known:
        return {}
    bodies = Sediment(known[0][0].task["quick"]).bodies
    made = {
        "compress ratios": _ratio_table(known, bodies),
        "compress": _total_table(known, bodies),
        "compress phases": _phase_table(known, bodies),
        "compress coders": _coder_table(known),
        "compress thesis": _thesis_table(known, bodies),
        "compress ttsvd": _ttsvd_table(records),
        "compress precision": _precision_table(known, bodies),
        "compress stress": _stress_table(known),
        "compress insitu": _insitu_table(known),
    }
    note = f"`scripts/bench/compress.py` at {version}."
    return {name: f"{note}\n\n{text}" for name, text in made.items() if text}


def _markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    if not rows:
        return ""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def number(value: float | None, digits: int = 3) -> str:
    """For a table: 12,300, 0.012, 1.2·10⁻⁵."""
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0.0 and (abs(value) < 1e-2 or abs(value) >= 1e6):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·{power(int(exponent))}"
    return f"{float(f'{value:.{digits}g}'):,.12g}"


def power(exponent: int) -> str:
    """10⁻³ for -3."""
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _tolerance(tau: float) -> str:
    exponent = round(math.log10(tau), 6)
    return power(int(exponent)) if exponent == int(exponent) else number(tau, 1)


def _words(name: str) -> str:
    return name.replace("_", " ")


def _total_table(known: Known, bodies: int) -> str:
    lines = []
    for field in FIELDS:
        for tau, rows in sorted(_archives(known, field).items(), reverse=True):
            theirs = [_ratio(bodies, rows, phase_bytes(rows, name) or math.nan) for name in NAMES]
            moving = [row["nrmse"] for row in rows if row["norm"] > 0.0]
            lines.append([
                _words(field), _tolerance(tau), f"**{number(_ratio(bodies, rows))}**",
                *map(number, theirs), number(float(np.median(moving)), 2),
                *(number(float(np.mean([row[k] for row in rows])), 2) for k in ("write", "read")),
                *(_mean_seconds(rows, "sz3", k) for k in ("write", "read")),
            ])  # fmt: skip
    heads = ["field", "error", "ours", *NAMES.values(), "nRMSE", "write [s]", "read [s]",
             "SZ3 write [s]", "read [s]"]  # fmt: skip
    return _markdown(heads, lines)


def _ratio_table(known: Known, bodies: int) -> str:
    """Velocities alone, for a reader in a hurry."""
    lines = [
        [_tolerance(tau), f"**{number(_ratio(bodies, rows))}**",
         *(number(_ratio(bodies, rows, phase_bytes(rows, name) or math.nan)) for name in NAMES),
         number(float(np.mean([row["write"] for row in rows])), 2),
         _mean_seconds(rows, "sz3", "write")]
        for tau, rows in sorted(_archives(known, "velocity").items(), reverse=True)
    ]  # fmt: skip
    heads = ["relative error", "ours", *NAMES.values(), "ours [s a chunk]", "SZ3 [s a chunk]"]
    return _markdown(heads, lines)


def _mean_seconds(rows: Sequence[Row], rival: str, kind: str) -> str:
    seconds = [row["rivals"][rival][kind] for row in rows if rival in row["rivals"]]
    return number(float(np.mean(seconds)), 2) if seconds else "–"


def _phase_table(known: Known, bodies: int) -> str:
    """Velocities: ours, trains alone, and SZ3, by phase."""
    archives, trains = _archives(known, "velocity"), _trains(known)
    lines = []
    for phase in PHASES:
        cells = []
        for tau in TAUS:
            rows = _of_phase(archives.get(tau, ()), phase)
            alone = _of_phase(trains.get(tau, ()), phase)
            theirs = phase_bytes(rows, "sz3") if rows else None
            cells += [
                f"**{number(_ratio(bodies, rows))}**" if rows else "–",
                number(_ratio(bodies, alone)),
                number(_ratio(bodies, rows, theirs)) if theirs else "–",
            ]
        if any(cell != "–" for cell in cells):
            first = next(iter(archives.values()), None) or next(iter(trains.values()))
            lines.append([f"{phase} ({len(_of_phase(first, phase))})", *cells])
    heads = ["phase (chunks)"]
    for tau in TAUS:
        heads += [f"{_tolerance(tau)}: ours", "trains alone", "SZ3"]
    return _markdown(heads, lines)


def _coder_table(known: Known) -> str:
    """Velocities: bytes and chunks of each coder, by phase."""
    lines = []
    for tau, rows in sorted(_archives(known, "velocity").items(), reverse=True):
        cells = []
        for phase in PHASES:
            those = _of_phase(rows, phase)
            cells.append(", ".join(
                f"{coder} {number(size)} ({sum(row['coder'] == coder for row in those)})"
                for coder, size in bytes_by_coder(those).items()
            ) or "–")  # fmt: skip
        lines.append([_tolerance(tau), *cells])
    return _markdown(["error", *PHASES], lines)


def _thesis(known: Known, kind: str) -> Known:
    return [(piece, rows) for piece, rows in chosen(known, "thesis") if piece.task["kind"] == kind]


def _thesis_table(known: Known, bodies: int) -> str:
    """His figure 4.4 by phase: parameters alone, and with the order of the bodies."""
    count = 3 * STEPS * bodies
    lines = []
    for piece, rows in _thesis(known, "thesis"):
        for form in dict.fromkeys(row["form"] for row in rows):
            cells = []
            for phase in (*PHASES, None):
                those = [r for r in rows if r["form"] == form and phase in (None, r["phase"])]
                if not those:
                    cells.append("–")
                    continue
                parameters = sum(row["parameters"] for row in those)
                order = sum(row["order_bytes"] for row in those) / 8
                text = number(count * len(those) / parameters)
                if order:
                    text += f" / {number(count * len(those) / (parameters + order))}"
                cells.append(text)
            lines.append([_tolerance(piece.task["tau"]), form, *cells])
    return _markdown(["error", "form", *PHASES, "all"], lines)


def _ttsvd_table(records: Sequence[Any]) -> str:
    """Ours, by the method that it chose and by each, and the rivals."""
    found = [record for record in records if record.name.startswith("compress.ttsvd")]
    lines, ours = [], math.nan
    for record in found:
        if record.name.startswith("compress.ttsvd_seconds"):
            if not lines:
                ours = record.value
                methods = ", ".join(record.params["methods"])
                lines.append([f"ours ({methods})", number(ours), "1", number(record.error, 2),
                              f"{record.params['parameters']:,}"])  # fmt: skip
            if record.rival:
                params = record.params
                lines.append([record.rival, number(record.rival_value),
                              number(record.rival_value / ours), number(params["rival_error"], 2),
                              f"{params['rival_parameters']:,}"])  # fmt: skip
        else:
            method = record.name.removeprefix("compress.ttsvd_").removesuffix("_seconds")
            lines.append([f"ours, {method}", number(record.value), number(record.value / ours),
                          number(record.error, 2), f"{record.params['parameters']:,}"])  # fmt: skip
    return _markdown(["", "CPU seconds", "times ours", "error", "numbers"], lines)


def _precision_table(known: Known, bodies: int) -> str:
    """Bytes and seconds of writing a chunk, over one of each phase."""
    lines = []
    for piece, rows in chosen(known, "precision"):
        cells = [_tolerance(piece.task["tau"])]
        for name in (None, *NAMES):
            methods = [row["rivals"].get(name) if name else row["ours"] for row in rows]
            if all(methods):
                size = sum(method["bytes"] for method in methods)
                seconds = sum(method["write"] for method in methods) / len(rows)
                cells.append(f"{number(raw_bytes(bodies, rows) / size)} · {number(seconds, 2)} s")
            else:
                cells.append("–")
        lines.append(cells)
    return _markdown(["error", "ours", *NAMES.values()], lines)


def _stress_table(known: Known) -> str:
    lines = []
    for _, rows in chosen(known, "stress"):
        for variable in dict.fromkeys(row["variable"] for row in rows):
            of = {row["tolerance"]: row for row in rows if row["variable"] == variable}
            cells = [
                f"{row['largest_rank']} · {number(row['ratio'])} · {number(row['nrmse'], 2)}"
                for row in (of[tau] for tau in TAUS)
            ]
            lines.append([_words(variable), *cells])
    return _markdown(["largest rank · ratio · nRMSE", *map(_tolerance, TAUS)], lines)


def _insitu_table(known: Known) -> str:
    lines = [
        [f"{row['bodies']:,}", str(row["ranks"]), number(row["without"]), number(row["with"]),
         f"{100 * row['overhead']:.1f} %", number(row["ratio"])]
        for _, row in chosen(known, "insitu")
    ]  # fmt: skip
    heads = ["bodies", "ranks", "run without [s]", "with [s]", "overhead", "ratio"]
    return _markdown(heads, lines)


# ---- figure --------------------------------------------------------------------------------


def draw(known: Known, path: Path) -> None:
    """Ratios over simulated time; S. De's figure 4.4; error against bytes, and against seconds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(16, 9), constrained_layout=True)
    bodies = Sediment(known[0][0].task["quick"]).bodies if known else 0
    for axis, tau in zip(axes[0], TAUS, strict=True):
        _draw_over_time(axis, known, bodies, tau)
    _draw_thesis(axes[1, 0], known, bodies)
    _draw_precision(axes[1, 1], known, bodies)
    _draw_seconds(axes[1, 2], known)
    for axis in axes.flat:
        axis.grid(True, which="both", alpha=0.25)
        if axis.lines:
            axis.legend(fontsize=8)
        else:
            axis.set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _time(row: Row) -> float:
    return STEP * STEPS * (row["chunk"] + 1)


def _draw_over_time(axis: Any, known: Known, bodies: int, tau: float) -> None:
    """Bytes of float64 over bytes stored, chunk by chunk, of velocities."""
    rows = _archives(known, "velocity").get(tau)
    if not rows:
        return
    times, raw = [_time(row) for row in rows], raw_bytes(bodies, rows[:1])
    axis.semilogy(times, [raw / row["bytes"] for row in rows], "k-o", markersize=3, label="ours")
    for name, label in NAMES.items():
        line = [(_time(r), raw / r["rivals"][name]["bytes"]) for r in rows if name in r["rivals"]]
        if line:
            axis.semilogy(*zip(*line, strict=True), "-", linewidth=1, label=label)
    alone = _trains(known).get(tau)
    if alone:
        line = [raw / row["bytes"] for row in alone]
        axis.semilogy([_time(row) for row in alone], line, "k:", label="tensor trains alone")
    for earlier, row in pairwise(rows):
        if row["phase"] != earlier["phase"]:
            axis.axvline(_time(row) - STEP * STEPS, color="grey", linewidth=0.5)
    axis.set(xlabel="time [s]", ylabel="ratio", title=f"velocity, error {_tolerance(tau)}")


def _draw_thesis(axis: Any, known: Known, bodies: int) -> None:
    """S. De's figures 4.4 and 4.5, and with the order of bodies that they leave out."""
    for piece, rows in _thesis(known, "thesis")[:1]:
        count = 3 * STEPS * bodies
        for form, colour in (("natural", "C0"), ("tensorised", "C3")):
            those = [row for row in rows if row["form"] == form]
            times = [_time(row) for row in those]
            alone = [count / row["parameters"] for row in those]
            whole = [count / (row["parameters"] + row["order_bytes"] / 8) for row in those]
            axis.semilogy(times, alone, "o", color=colour, markersize=4, label=form)
            axis.semilogy(times, whole, "-", color=colour, linewidth=0.8,
                          label=f"{form}, with the order of bodies")  # fmt: skip
        for _, streamed in _thesis(known, "streamed"):
            form = streamed[0]["form"]
            line = [(_time(row), row["count"] / row["parameters"]) for row in streamed]
            axis.semilogy(*zip(*line, strict=True), "C0--" if form == "natural" else "C3--",
                          label=f"{form}, all chunks so far")  # fmt: skip
        axis.set(xlabel="time [s]", ylabel="ratio of parameters",
                 title=f"S. De's set-up, error {_tolerance(piece.task['tau'])}")  # fmt: skip


def _methods(known: Known) -> dict[str, list[tuple[float, float, float]]]:
    """(error, bytes a value, seconds a chunk) over the phases by method."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for _, rows in chosen(known, "precision"):
        for name, label in {"ours": "ours", **NAMES}.items():
            methods = [row["ours"] if name == "ours" else row["rivals"].get(name) for row in rows]
            if all(methods):
                size = sum(method["bytes"] for method in methods) / len(rows)
                seconds = sum(method["write"] for method in methods) / len(rows)
                found.setdefault(label, []).append((relative_error(rows), size, seconds))
    return found


def _draw_precision(axis: Any, known: Known, bodies: int) -> None:
    for label, line in _methods(known).items():
        points = [(8 * size / (3 * STEPS * bodies), error) for error, size, _ in sorted(line)]
        style = "k-o" if label == "ours" else "-o"
        axis.loglog(*zip(*points, strict=True), style, markersize=3, label=label)
    axis.set(xlabel="bits a value", ylabel="relative error",
             title="velocity, a chunk of each phase")  # fmt: skip


def _draw_seconds(axis: Any, known: Known) -> None:
    for label, line in _methods(known).items():
        points = [(seconds, error) for error, _, seconds in sorted(line)]
        style = "k-o" if label == "ours" else "-o"
        axis.loglog(*zip(*points, strict=True), style, markersize=3, label=label)
    axis.set(xlabel="CPU seconds to write a chunk", ylabel="relative error",
             title="at equal errors, not equal bytes")  # fmt: skip


# ---- picture -------------------------------------------------------------------------------


def draw_bed(data: Path, told: Row, tau: float, path: Path) -> None:
    """A slice of the bed as it was, as restored, and the error of each body's velocity."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import EllipseCollection

    frame = np.load(data)
    x, _, z = frame["position"].T
    depth = np.abs(frame["position"][:, 1])
    shown = depth < 0.15 * depth.max()
    speeds = [np.linalg.norm(frame[name], axis=1) for name in ("velocity", "restored")]
    error = np.linalg.norm(frame["velocity"] - frame["restored"], axis=1)
    panels = [
        ("original", speeds[0], "speed [m/s]", "viridis", speeds[0].max()),
        (f"restored, 1/{told['ratio']:.0f} of the bytes", speeds[1], "speed [m/s]", "viridis",
         speeds[0].max()),
        (f"error, {tau:g} of the whole", error, "speed of the difference [m/s]", "magma",
         error[shown].max()),
    ]  # fmt: skip
    # Beds are wide: one above the other they are as large as a page allows.
    figure, axes = plt.subplots(3, 1, figsize=(10, 7.5), sharex=True, constrained_layout=True)
    for axis, (title, values, label, colours, top) in zip(axes, panels, strict=True):
        widths = np.full(int(shown.sum()), 0.02)
        spheres = EllipseCollection(
            widths, widths, np.zeros_like(widths), units="xy", cmap=colours,
            offsets=np.column_stack([x, z])[shown], offset_transform=axis.transData,
        )  # fmt: skip
        spheres.set_array(values[shown])
        spheres.set_clim(0.0, top)
        axis.add_collection(spheres)
        axis.set(xlim=(x.min() - 0.02, x.max() + 0.02), ylim=(-0.51, z[shown].max() + 0.05),
                 aspect="equal", title=title, ylabel="z [m]")  # fmt: skip
        figure.colorbar(spheres, ax=axis, label=label)
    axes[-1].set_xlabel("x [m]")
    figure.suptitle(f"Velocities at {told['time']:.3f} s, a slice through the middle")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)
