"""Which solver, and at what price: interior point (SCIP) beside first-order (APGD) and others.

    python scripts/bench/scip.py [--quick] [--json FILE] [--figure FILE]
        [--only PART ...] [--dry] [--page FILE] [--states NAME ...]

Cone problems of beds of spheres (lib/piles.py: landed, settled, sheared; S. De's falling clouds),
each solved by each method on 1 and 2 ranks: seconds and iterations against both residuals and
against the error of the bodies' velocities, whose true values come from a much finer solution.

Parts, in the order of their worth:
  piles     settled piles of 500 to 16,000 spheres to 1e-8 m/s: iterations, seconds, growth
  thesis    S. De's Table 2.1, 25,000 and 100,000 spheres, his criterion
  precision work-precision of 2,000 spheres, every method
  large     the pile of 100,000: seconds and memory of a Newton iteration, Cholesky and CG
  deep      work-precision of 16,000 spheres
  coulomb   the original law beside Siconos NSGS

A measurement is a run of its own, kept under build/bench/scip by state, method, ranks and version
of dem_mpi: a long set can be done in pieces (--only), what is there is not measured again, and
records are made of all that is there. --version VERSION ... takes what other versions measured,
the first of them where it is known.
--dry measures nothing; --quick is a set of its own, piles
of 500 and 2,000 spheres alone. --states makes states (or names them all) and ends. --page puts
the tables between the markers of a Markdown file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from lib import piles
from records import BUILD, ROOT, Record, arguments, mpirun, put, write

CACHE = BUILD / "scip"
LADDER = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
THESIS = (1e-1, 1e-2, 1e-3, 1e-4)
CLARABEL_LIMIT = 2000  # spheres whose true velocities it gives in a minute
# S. De, PhD thesis 2021, Table 2.1: iterations at THESIS; one of his SCIP took hours on 16 cores.
DE = {
    ("apgd", 25_000): (409, 433, 470, 509),
    ("apgd", 100_000): (435, 451, 506, 521),
    ("scip", 25_000): (45, 50, 54, 57),
    ("scip", 100_000): (47, 52, 56, 58),
}
METHODS: dict[str, dict[str, Any]] = {
    "apgd cold": {"solver": "apgd", "start": "cold"},
    "apgd warm": {"solver": "apgd", "start": "warm"},
    "scip velocity": {"solver": "scip", "scip": {"form": "velocity"}},
    "scip contact": {"solver": "scip", "scip": {"form": "contact"}},
    "scip cg": {"solver": "scip", "scip": {"form": "velocity", "linear": "cg"}},
    "clarabel": {"rival": "clarabel", "operator": "assembled"},
    "coulomb apgd": {"solver": "apgd", "law": "coulomb"},
    "coulomb scip": {"solver": "scip", "law": "coulomb", "scip": {"form": "velocity"}},
    "siconos nsgs": {"rival": "nsgs", "law": "coulomb", "operator": "assembled"},
}
PARTS = ("piles", "thesis", "precision", "large", "deep", "coulomb")
QUICK_PARTS = ("piles", "precision", "coulomb")


# ---- pieces --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """One measurement: a method on a state, one solve for each tolerance, `runs` times.

    limit : seconds after which it is given up
    truth : compare velocities with the reference of the state
    """

    part: str
    state: str
    method: str
    ranks: int
    tolerances: tuple[float, ...]
    runs: int = 1
    limit: float = 900.0
    kind: str = "both"
    truth: bool = False
    more: tuple[tuple[str, Any], ...] = field(default=())

    def task(self) -> dict[str, Any]:
        """The work as the ranks get it."""
        task = METHODS[self.method] | {
            "state": str(piles.state(self.state)),
            "tolerances": self.tolerances,
            "runs": self.runs,
            "kind": self.kind,
            "trial": str(piles.state("pile-500/settled")),
        }
        for key, value in self.more:
            task[key] = task.get(key, {}) | value if isinstance(value, dict) else value
        if self.truth:
            task["reference"] = str(reference(self.state))
        return task

    def path(self, version: str) -> Path:
        """Where the result stands, or will stand."""
        text = json.dumps([self.tolerances, self.runs, self.kind, self.truth, self.more])
        digest = hashlib.sha256(text.encode()).hexdigest()[:8]
        name = f"{self.state}-{self.method}-{self.ranks}-{digest}".replace("/", "-")
        return CACHE / version / f"{name.replace(' ', '-')}.json"


def checked_out() -> str:
    """The commit that dem_mpi was last changed in, and a digest of what differs from it."""

    def git(*command: str) -> str:
        call = ["git", "-C", str(ROOT), *command, "--", "dem_mpi"]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout

    commit, changes = git("log", "-1", "--format=%h").strip(), git("diff", "HEAD")
    return commit + ("+" + hashlib.sha256(changes.encode()).hexdigest()[:6] if changes else "")


def pieces(quick: bool) -> list[Piece]:
    """All measurements, in the order in which they are made."""
    found: list[Piece] = []

    def add(part: str, state: str, method: str, ranks: int, *tolerances: float, **more: Any):
        found.append(Piece(part, state, method, ranks, tolerances, **more))

    sizes = (500, 2000) if quick else (500, 2000, 8000, 16000)
    for size in reversed(sizes):
        state, runs = f"pile-{size}/settled", 5 if size <= 2000 else 1
        for ranks in (2, 1):
            add("piles", state, "scip velocity", ranks, 1e-8, runs=runs)
            finest = 1e-8 if size <= 2000 or ranks == 2 else 1e-6  # minutes at 16,000
            add("piles", state, "apgd cold", ranks, finest, runs=min(runs, 3))
    add("piles", "pile-2000/settled", "clarabel", 1, 1e-8, runs=3)

    if not quick:
        for size in (25_000, 100_000):
            for moment in ("landed", "falling"):
                state = f"cloud-{size}/{moment}"
                add("thesis", state, "apgd cold", 2, *THESIS, kind="thesis")
                add("thesis", state, "scip velocity", 2, *THESIS[-1:], kind="thesis", limit=1800)

    beds = ("pile-2000/settled",) if quick else (
        "pile-2000/settled", "pile-2000/landed", "shear-2000/sheared",
    )  # fmt: skip
    if not quick:  # ten minutes for three solves: once is enough to see it
        add("precision", "pile-2000/settled", "scip cg", 1, *LADDER[1::3], truth=True)
    for state in beds:
        for ranks in (1,) if quick else (1, 2):
            add("precision", state, "scip velocity", ranks, *LADDER, truth=True)
            add("precision", state, "scip contact", ranks, *LADDER[1::3], truth=True)
            for method in ("apgd cold", "apgd warm"):
                add("precision", state, method, ranks, *LADDER[: 5 if quick else 6], truth=True)
        add("precision", state, "clarabel", 1, 1e-2, 1e-4, 1e-6, 1e-8, 1e-10, truth=True)

    if not quick:
        state = "pile-100000/settled"
        for method in ("scip velocity", "scip cg"):
            brief = (("scip", {"max_iterations": 2}),)
            add("large", state, method, 2, 1e-8, limit=1800, more=brief)
        add("large", state, "apgd cold", 2, 1e-4, limit=1800)

        for state in ("pile-16000/settled", "shear-16000/sheared", "pile-16000/landed"):
            for ranks in (2, 1) if "settled" in state else (2,):
                add("deep", state, "scip velocity", ranks, *LADDER[1::3], truth=True)
                add("deep", state, "apgd cold", ranks, *LADDER[1:5], truth=True)
                add("deep", state, "apgd warm", ranks, *LADDER[1:5], truth=True)
            add("deep", state, "scip contact", 2, 1e-8, more=(("scip", {"max_iterations": 3}),))

    laws = [("pile-2000/settled", 2000)] if quick else [
        ("pile-2000/settled", 2000), ("shear-2000/sheared", 2000), ("shear-16000/sheared", 16000),
    ]  # fmt: skip
    for state, size in laws:
        tolerances = (1e-2, 1e-3, 1e-4) if quick or size > 2000 else (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
        for method in ("coulomb apgd", "coulomb scip"):
            add("coulomb", state, method, 1, *tolerances)
        # Its tolerance is of its own measure, relative to |b|.
        add("coulomb", state, "siconos nsgs", 1, 1e-2, 1e-3, 1e-4, 1e-5)
    return found


def reference(state: str) -> Path:
    """The file of the true velocities of a state's bodies, made if need be.

    Clarabel, which is not ours, gives those of small beds. The interior point method gives those of
    large ones, as exactly as it can: 1e-10 m/s is asked, 1e-8 m/s accepted. The residuals stand
    beside the file.
    """
    checkpoint = piles.state(state)
    path = checkpoint.with_suffix(".velocity.npy")
    if not path.exists():
        small = piles.RECIPES[state.partition("/")[0]].spheres <= CLARABEL_LIMIT
        method, ranks, tolerance = ("clarabel", 1, 1e-12) if small else ("scip velocity", 2, 1e-10)
        unfinished = path.with_suffix(".unfinished.npy")
        task = {"state": str(checkpoint), "tolerances": (tolerance,), "save": str(unfinished)}
        found = run_task(METHODS[method] | task, ranks, 1800.0)
        rows = found["rows"]
        accuracy = max(rows[0]["r_d"], rows[0]["r_c"] / found["gamma_ref"]) if rows else math.inf
        if accuracy > 1e-8:
            raise RuntimeError(f"{state}: no velocities to compare with: {found}")
        row = {k: rows[0][k] for k in ("r_d", "r_c", "reason")}
        note = {"method": method, "accuracy": accuracy, **row}
        path.with_suffix(".json").write_text(json.dumps(note, indent=1))
        unfinished.rename(path)
    return path


def run_task(task: dict[str, Any], ranks: int, limit: float) -> dict[str, Any]:
    """Run a task on so many ranks for `limit` seconds at most, and return what it found.

    Raises CalledProcessError where it broke off; such a run is no measurement.
    """
    CACHE.mkdir(parents=True, exist_ok=True)
    # Names of its own: another copy of this script may be at work.
    order, result = (CACHE / f"{name}-{os.getpid()}.json" for name in ("task", "result"))
    order.write_text(json.dumps(task))
    command = [str(Path(__file__).resolve()), "--worker", str(order), str(result)]
    try:
        mpirun(ranks, command, limit)
        return json.loads(result.read_text())
    except subprocess.TimeoutExpired:
        return {"rows": [], "failure": f"not done after {limit:.0f} s"}
    finally:
        order.unlink()
        result.unlink(missing_ok=True)


def gather(
    chosen: list[Piece], parts: tuple[str, ...], versions: list[str]
) -> list[tuple[Piece, dict[str, Any]]]:
    """What is known of each piece; those of `parts` that are not known are measured."""
    known = []
    for piece in chosen:
        version = next((v for v in versions if piece.path(v).exists()), versions[0])
        path = piece.path(version)
        if not path.exists() and piece.part in parts:
            print(f"{piece.part}: {piece.state}, {piece.method}, {piece.ranks} ranks", flush=True)
            task, began = piece.task(), perf_counter()
            try:
                found = run_task(task, piece.ranks, piece.limit)
            except subprocess.CalledProcessError as error:
                print(f"  left out: it ended with code {error.returncode}", flush=True)
                continue
            wall = perf_counter() - began
            print(f"  {wall:.0f} s", flush=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(found | {"wall": wall}, indent=1))
        if path.exists():
            known.append((piece, json.loads(path.read_text()) | {"version": version}))
    return known


# ---- records -------------------------------------------------------------------------------

Known = list[tuple[Piece, dict[str, Any]]]


def records_of(known: Known) -> list[Record]:
    """Every figure: one record a row for iterations and seconds, and what follows from them."""
    records: list[Record] = []
    for piece, found in known:
        params = {
            "part": piece.part,
            "state": piece.state,
            "method": piece.method,
            "spheres": found.get("spheres"),
            "contacts": found.get("contacts"),
        }
        if found.get("failure"):
            params["failure"] = found["failure"]
            failed = Record("scip.failure", params, 1, "1", ranks=piece.ranks)
            records.append(replace(failed, commit=found["version"]))
        for row in found["rows"]:
            both = _row_records(piece, row, params)
            records += [replace(record, commit=found["version"]) for record in both]
    drawn = headlines(known) + growth(known) + crossings(known)
    version = next((found["version"] for piece, found in known if piece.part == "piles"), None)
    return records + [replace(r, commit=version or checked_out()) for r in drawn]


def _row_records(piece: Piece, row: dict[str, Any], params: dict[str, Any]) -> list[Record]:
    keys = ("tolerance", "converged", "r_d", "r_c", "thesis", "objective", "velocity_error",
            "form", "factor_entries", "linear_residual", "refinements", "memory", "outer", "to",
            "products", "phases")  # fmt: skip
    params = params | {k: row[k] for k in keys if k in row}
    params |= {"kind": piece.kind, **dict(piece.more)}
    error = row.get("velocity_error", row["r_d"])
    rival: dict[str, Any] = {}
    index = THESIS.index(row["tolerance"]) if piece.kind == "thesis" else None
    if index is not None:
        name, spheres = METHODS[piece.method]["solver"], params["spheres"]
        theirs = DE[(name, spheres)][index]
        rival = {"rival": "S. De 2021, Table 2.1", "rival_value": theirs}
        rival["ratio"] = row["iterations"] / theirs
    common = {"error": error, "runs": piece.runs, "ranks": piece.ranks}
    return [
        Record("scip.iterations", params, row["iterations"], "1", **rival, **common),
        Record("scip.seconds", params, row["seconds"], "s", **common),
    ]


def per_iteration(row: dict[str, Any]) -> float:
    """Seconds of an iteration; of an interior point method without what is done once."""
    once = row["phases"].get("analysis", 0.0)
    return (row["seconds"] - once) / max(row["iterations"], 1)


def one(known: Known, state: str, method: str, ranks: int, part: str) -> dict[str, Any] | None:
    """The last row of a piece, of the smallest tolerance, if it is known."""
    for piece, found in known:
        same = (piece.state, piece.method, piece.ranks, piece.part) == (state, method, ranks, part)
        if same and found["rows"]:
            return found["rows"][-1] | {k: found[k] for k in ("spheres", "contacts")}
    return None


def headlines(known: Known) -> list[Record]:
    """Iterations to 1e-6 and 1e-8 m/s on settled piles, seconds of an iteration."""
    records = []
    states = {piece.state: None for piece, _ in known if piece.part in ("piles", "large")}
    for state in states:
        for ranks in (1, 2):
            part = "piles" if state != "pile-100000/settled" else "large"
            ours = one(known, state, "scip velocity", ranks, part)
            first_order = one(known, state, "apgd cold", ranks, part)
            clarabel = one(known, state, "clarabel", 1, part)
            if ours is None:
                continue
            params = {"state": state, "spheres": ours["spheres"], "contacts": ours["contacts"]}
            for decade in ("1e-06", "1e-08"):
                count = ours["to"]["both"].get(decade)
                if count is None:
                    continue
                theirs = (first_order or {"to": {"both": {}}})["to"]["both"].get(decade)
                rival = (
                    {"rival": "APGD", "rival_value": theirs, "ratio": count / theirs}
                    if theirs
                    else {}
                )
                name = f"scip.iterations_to_{decade.replace('e-0', 'e-')}"
                alone = ours["to"]["dual"].get(decade)
                records.append(
                    Record(name, params | {"by_dual_residual_alone": alone}, count, "1",
                           error=ours["r_d"], ranks=ranks, **rival)
                )  # fmt: skip
            rival = {}
            if clarabel and ranks == 1:
                theirs = per_iteration(clarabel)
                rival = {
                    "rival": "clarabel",
                    "rival_value": theirs,
                    "ratio": per_iteration(ours) / theirs,
                }
            once = {k: ours[k] for k in ("factor_entries", "memory", "form", "phases")}
            records.append(
                Record("scip.seconds_per_iteration", params | once, per_iteration(ours), "s",
                       error=ours["r_d"], runs=len(ours["all_seconds"]), ranks=ranks, **rival)
            )  # fmt: skip
    return records


def growth(known: Known) -> list[Record]:
    """Exponents of the seconds of an iteration and of the factor with the bodies, least squares."""
    records = []
    for ranks in (1, 2):
        points = []
        for state in dict.fromkeys(p.state for p, _ in known if p.part in ("piles", "large")):
            part = "large" if state.startswith("pile-100000") else "piles"
            row = one(known, state, "scip velocity", ranks, part)
            if row:
                points.append((row["spheres"], per_iteration(row), row["factor_entries"]))
        if len(points) < 2:
            continue
        bodies, seconds, entries = np.log(np.maximum(np.array(points, float).T, 1.0e-9))
        for name, values in (("seconds", seconds), ("factor_entries", entries)):
            exponent = float(np.polyfit(bodies, values, 1)[0])
            params = {"spheres": sorted(int(p[0]) for p in points)}
            records.append(Record(f"scip.growth.{name}", params, exponent, "1", ranks=ranks))
    return records


def crossings(known: Known) -> list[Record]:
    """By state and tolerance APGD's seconds over SCIP's: beyond one, SCIP is the faster choice."""
    records = []
    for state in dict.fromkeys(piece.state for piece, _ in known):
        for ranks in (1, 2):
            for decade in LADDER:
                ours = seconds_to(known, state, ("scip velocity",), ranks, decade)
                theirs = seconds_to(known, state, ("apgd cold", "apgd warm"), ranks, decade)
                if not (ours and theirs):  # not known, or true of the zero impulse
                    continue
                params = {"state": state, "tolerance": decade}
                records.append(
                    Record("scip.crossing", params, ours, "s", "APGD", theirs, ours / theirs,
                           ranks=ranks)
                )  # fmt: skip
    return records


def seconds_to(
    known: Known, state: str, methods: tuple[str, ...], ranks: int, tolerance: float
) -> float | None:
    """Seconds that the fastest of the methods takes to both residuals.

    Of a solve to that tolerance where there is one; else, of a tighter one, the share of its
    iterations, which all cost the same.
    """
    found = []
    for piece, result in known:
        same = piece.state == state and piece.method in methods and piece.ranks == ranks
        if not same or piece.kind != "both":
            continue
        for row in result["rows"]:
            count = row.get("to", {}).get("both", {}).get(f"{tolerance:.0e}")
            if row["tolerance"] == tolerance and row["converged"]:
                found.append((0, row["seconds"]))
            elif count:
                once = row["phases"].get("analysis", 0.0)
                found.append((1, once + count * per_iteration(row)))
    if not found:
        return None
    exactly = min(found)[0]
    return min(seconds for kind, seconds in found if kind == exactly)


# ---- tables --------------------------------------------------------------------------------


def tables(known: Known, records: list[Record]) -> str:
    """The tables of the page, in Markdown."""
    blocks = [
        _pile_table(known),
        _thesis_table(known),
        _crossing_table(records),
        *(_precision_table(known, state) for state in _states(known, ("precision", "deep"))),
        *(_coulomb_table(known, state) for state in _states(known, ("coulomb",))),
    ]
    parts = {piece.part: found["version"] for piece, found in known}
    usual, *others = dict.fromkeys(parts.values())
    note = f"Commit {usual}."
    for version in others:
        note += f" Of {version}: {', '.join(p for p, v in parts.items() if v == version)}."
    return "\n\n".join([note, *(block for block in blocks if block)])


def _states(known: Known, parts: tuple[str, ...]) -> list[str]:
    return list(dict.fromkeys(piece.state for piece, _ in known if piece.part in parts))


def _table(title: str, heads: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return ""
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return f"**{title}**\n\n" + "\n".join(lines)


def _number(value: float | None, digits: int = 2) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    if value != 0.0 and (abs(value) < 1e-2 or abs(value) >= 1e5):
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10{_superscript(int(exponent))}"
    return f"{float(f'{value:.{digits}g}'):,.12g}"


def _superscript(value: int) -> str:
    return str(value).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def _pile_table(known: Known) -> str:
    rows = []
    for part in ("piles", "large"):
        for state in _states(known, (part,)):
            for ranks in (1, 2):
                row = one(known, state, "scip velocity", ranks, part)
                if row is None:
                    continue
                first_order = one(known, state, "apgd cold", ranks, part) or {"to": {"both": {}}}
                to = row["to"]["both"]
                rows.append([
                    f"{row['spheres']:,}", f"{row['contacts']:,}", str(ranks),
                    _number(to.get("1e-06"), 5), _number(to.get("1e-08"), 5),
                    _number(per_iteration(row)), _number(row["phases"].get("analysis")),
                    _number(row["factor_entries"] / 1e6), _number(row["memory"] / 1e6, 3),
                    _number(first_order["to"]["both"].get("1e-04"), 5),
                    _number(first_order["to"]["both"].get("1e-06"), 5),
                ])  # fmt: skip
    heads = ["spheres", "contacts", "ranks", "Newton iterations to 10⁻⁶", "10⁻⁸",
             "s an iteration", "analysis [s]", "factor [10⁶ entries]", "memory [MB]",
             "APGD to 10⁻⁴", "10⁻⁶"]  # fmt: skip
    return _table("Settled piles", heads, rows)


def _thesis_table(known: Known) -> str:
    rows = []
    for piece, found in known:
        if piece.part != "thesis" or not found["rows"]:
            continue
        solver = METHODS[piece.method]["solver"]
        last = found["rows"][-1]
        counts = {float(tau): n for tau, n in last["to"].get("thesis", {}).items()}
        counts |= {row["tolerance"]: row["iterations"] for row in found["rows"]}
        theirs = DE[(solver, found["spheres"])]
        cells = [
            f"{_number(counts.get(tau), 5)} / {de}" for tau, de in zip(THESIS, theirs, strict=True)
        ]
        rows.append([
            f"{found['spheres']:,}", piece.state.partition("/")[2], f"{found['contacts']:,}",
            solver.upper(), *cells, _number(last["seconds"] / max(last["iterations"], 1)),
            _number(last["memory"] / 1e6, 3),
        ])  # fmt: skip
    heads = ["spheres", "moment", "contacts", "solver", *(f"10{_superscript(-k)}" for k in
             (1, 2, 3, 4)), "s an iteration, 2 ranks", "memory [MB]"]  # fmt: skip
    return _table("S. De, Table 2.1: iterations, ours / his", heads, rows)


def _crossing_table(records: list[Record]) -> str:
    found = [r for r in records if r.name == "scip.crossing"]
    rows = []
    for state, ranks in dict.fromkeys((r.params["state"], r.ranks) for r in found):
        ratio = {
            r.params["tolerance"]: r.ratio
            for r in found
            if (r.params["state"], r.ranks) == (state, ranks)
        }
        rows.append([state, str(ranks), *(_number(ratio.get(tau)) for tau in LADDER)])
    heads = ["state", "ranks", *(f"10{_superscript(-k)}" for k in range(1, 9))]
    return _table("Seconds of SCIP over seconds of APGD, by tolerance [m/s]", heads, rows)


def _precision_table(known: Known, state: str) -> str:
    rows = []
    for piece, found in known:
        if piece.state != state or piece.part not in ("precision", "deep"):
            continue
        for row in found["rows"]:
            rows.append([
                piece.method, str(piece.ranks), _number(row["tolerance"]), str(row["iterations"]),
                _number(row["seconds"]), _number(row["r_d"]), _number(row["r_c"]),
                _number(row.get("velocity_error")), f"{row['objective']:.9e}",
                "" if row["converged"] else row["reason"],
            ])  # fmt: skip
        if found.get("failure"):
            rows.append([piece.method, str(piece.ranks), *["–"] * 7, found["failure"]])
    heads = ["method", "ranks", "asked", "iterations", "seconds", "r_d [m/s]", "r_c [J]",
             "velocity error [m/s]", "objective [J]", ""]  # fmt: skip
    return _table(f"Work and precision: {state}", heads, rows)


def _coulomb_table(known: Known, state: str) -> str:
    rows = []
    for piece, found in known:
        if piece.state != state or piece.part != "coulomb":
            continue
        for row in found["rows"]:
            rows.append([
                piece.method, _number(row["tolerance"]), str(row["iterations"]),
                str(row.get("outer", "–")), _number(row["seconds"]), _number(row["r_d"]),
                _number(row["r_c"]), "" if row["converged"] else row["reason"],
            ])  # fmt: skip
        if found.get("failure"):
            rows.append([piece.method, *["–"] * 6, found["failure"]])
    heads = ["method", "asked", "iterations", "cone problems", "seconds", "r_d [m/s]", "r_c [J]",
             ""]  # fmt: skip
    return _table(f"Coulomb's law: {state}", heads, rows)


# ---- figure --------------------------------------------------------------------------------


def draw(known: Known, path: Path) -> None:
    """Seconds against the error of velocities; iterations; growth with the bodies."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4), constrained_layout=True)
    states = _states(known, ("deep",)) or _states(known, ("precision",))
    state = states[0] if states else None
    colour = {method: f"C{k}" for k, method in enumerate(METHODS)}
    for piece, found in known:
        rows = [r for r in found["rows"] if "velocity_error" in r]
        if piece.state != state or not rows or piece.ranks != 1:
            continue
        error = [max(r["velocity_error"], 1e-11) for r in rows]
        style = {"marker": "o", "color": colour[piece.method], "label": piece.method}
        axes[0].loglog(error, [r["seconds"] for r in rows], **style)
        axes[1].loglog(error, [max(r["iterations"], 1) for r in rows], **style)
    for axis, label in zip(axes, ("seconds, 1 rank", "iterations"), strict=False):
        axis.set_ylabel(label)
        axis.set_xlabel("largest error of a body's velocity [m/s]")
        axis.invert_xaxis()
    axes[0].set_title(state or "")
    if axes[0].lines:
        axes[0].legend(fontsize=8)
    for ranks in (1, 2):
        points = []
        for state in _states(known, ("piles", "large")):
            part = "large" if state.startswith("pile-100000") else "piles"
            row = one(known, state, "scip velocity", ranks, part)
            if row:
                points.append((row["spheres"], per_iteration(row)))
        if points:
            x, y = np.array(sorted(points)).T
            axes[2].loglog(x, y, "o", color=f"C{ranks}", label=f"{ranks} rank{'s' * (ranks > 1)}")
            if len(x) > 1:
                exponent, offset = np.polyfit(np.log(x), np.log(y), 1)
                fit = np.exp(offset) * x**exponent
                axes[2].loglog(x, fit, "--", color=f"C{ranks}", label=f"n^{exponent:.2f}")
    axes[2].set_xlabel("spheres of a settled pile")
    axes[2].set_ylabel("seconds of a Newton iteration")
    axes[2].legend(fontsize=8)
    for axis in axes:
        axis.grid(True, which="both", alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


# ---- program -------------------------------------------------------------------------------


def work(order: Path, result: Path) -> None:
    """Collective. Do one task; rank 0 writes its result."""
    from lib.scip_work import work as do

    from dem_mpi.parallel import Parallel
    from dem_mpi.warmup import warm_up

    parallel = Parallel()
    parallel.install_abort_hook()
    task = json.loads(order.read_text())
    solver = task.get("solver", "apgd")
    warm_up(parallel, 1, (task.get("operator", "matrix_free"),), solvers=(solver,),
            law=task.get("law", "ccp"))  # fmt: skip
    if task.get("trial"):
        # The first solve pays for what is loaded or compiled late.
        trial = {"state": task["trial"], "tolerances": [1e-2], "runs": 1}
        do(parallel, task | trial | {"reference": None, "save": None})
    found = do(parallel, task)
    if parallel.rank == 0:
        result.write_text(json.dumps(found))


def main() -> None:
    """Parse the options; measure what is not known yet; write records, figure and tables."""
    if sys.argv[1:2] == ["--worker"]:
        work(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, help="measure these parts alone")
    parser.add_argument("--dry", action="store_true", help="measure nothing, use what is known")
    found = "as which version of dem_mpi results are kept; as which ones they are found"
    parser.add_argument("--version", nargs="+", metavar="VERSION", help=found)
    parser.add_argument("--page", type=Path, help="put the tables into this Markdown file")
    parser.add_argument("--states", nargs="*", metavar="NAME", help="make these states and end")
    options = parser.parse_args()
    if options.states is not None:
        for name in options.states or piles.RECIPES:
            recipe = piles.RECIPES[name]
            print(name, piles.make(name) if options.states else piles.directory(recipe))
        return
    parts = options.only or (QUICK_PARTS if options.quick else PARTS)
    versions = options.version or [checked_out()]
    known = gather(pieces(options.quick), () if options.dry else tuple(parts), versions)
    records = records_of(known)
    write(records, options.json)
    if options.page:
        put("tables", tables(known, records), options.page)
    if options.figure:
        draw(known, options.figure)


if __name__ == "__main__":
    main()
