"""What the hard cases of contact cost each solver, and how far each ends from what must come out.

    python scripts/bench/hard_cases.py [--quick] [--json FILE] [--figure FILE] [--docs | --check]

Runs the battery that tests/validation/test_hard_cases.py asserts (tests/support/hard_cases.py says
what each case is and where its limits come from) and records, for each case and solver,
iterations, products with the Delassus operator, the residual reached and every error beside its
limit. A few minutes on one core; --quick: without the column of 1000 and the 10^4 steps at rest.
--docs writes the tables into docs/hard_cases.md from docs/bench/hard_cases.json, without a run;
--check only says whether they are there. Long runs at rest are taken from build/hard_cases, where
`scripts/test --long -k stay_at_rest` leaves them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import Any

from records import ROOT, Record, arguments, save

sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

PAGE = ROOT / "docs" / "hard_cases.md"
RECORDS = ROOT / "docs" / "bench" / "hard_cases.json"
LONG = ROOT / "build" / "hard_cases"
BEGIN, END = "<!-- tables: scripts/bench/hard_cases.py --docs -->", "<!-- end of tables -->"
SLOW = ("column of 1000", "ten at rest")
LONG_CASE = "ten at rest, long"


# ---- the records ---------------------------------------------------------------------------


def slug(name: str) -> str:
    """Turn a case's name into the last part of its record's."""
    return "".join(c if c.isalnum() or c in ".-" else "_" for c in name).replace("__", "_")


def record_of(name: str, summary: dict[str, Any], **known: Any) -> Record:
    """Return a record whose value is the largest error over its limit: passed if at most 1."""
    share = max(share_of(check) for check in summary["checks"])
    return Record(
        f"hard_cases.{slug(name)}", {"case": name, **summary}, share, "1", error=summary["r_d"],
        **known,
    )  # fmt: skip


def share_of(check: dict[str, Any]) -> float:
    """Error over limit; where the limit is zero, 0 if it is kept."""
    if check["limit"] > 0.0:
        return check["error"] / check["limit"]
    return 0.0 if check["error"] <= 0.0 else float("inf")


def bench(quick: bool) -> list[Record]:
    """Run every case with every solver."""
    from hard_cases import CASES, SOLVERS, attempt

    records = []
    for name in CASES:
        if quick and name in SLOW:
            continue
        for solver in SOLVERS:
            began = perf_counter()
            trial = attempt(name, solver)
            seconds = perf_counter() - began
            records.append(record_of(name, {**trial.summary, "seconds": seconds}))
            for complaint in trial.complaints:
                print(f"{name}, {solver}: {complaint}", flush=True)
    for path in sorted(LONG.glob("rest-*.json")):
        summary = json.loads(path.read_text())
        records.append(record_of(LONG_CASE, summary, commit=summary.pop("commit")))
    return records


# ---- the page ------------------------------------------------------------------------------


def tables(records: list[dict[str, Any]]) -> str:
    """Return what the solves took, and what was found beside its limit, as Markdown."""
    lines = [
        "| case | solver | solves | iterations, largest | median | products | r_d, m/s | converged "
        "| largest error / limit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for record in records:
        p = record["params"]
        kept = "yes" if p["converged"] else "; ".join(p["reasons"])
        lines.append(
            f"| {p['case']} | {p['solver']} | {p['solves']} | {p['iterations']['max']} "
            f"| {p['iterations']['median']:g} | {p['products']} | {number(p['r_d'])} | {kept} "
            f"| {number(record['value'])} |"
        )
    solvers = list(dict.fromkeys(record["params"]["solver"] for record in records))
    lines += [
        "",
        f"| case | what | unit | {' | '.join(f'{s}: error | limit' for s in solvers)} "
        "| where the limit comes from |",
        "|---|---|---|" + "---|---|" * len(solvers) + "---|",
    ]
    for name, found in by_case(records).items():
        for what in dict.fromkeys(w for checks in found.values() for w in checks):
            some = next(checks[what] for checks in found.values() if what in checks)
            cells = [cell(found.get(solver, {}).get(what)) for solver in solvers]
            lines.append(
                f"| {name} | {what} | {some['unit']} | {' | '.join(cells)} | {some['source']} |"
            )
    return "\n".join(lines)


def by_case(records: list[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """Checks by case, solver and name, those of every step once for all cases."""
    everywhere = " of a step", "outside their cones"
    found: dict[str, dict[str, dict[str, Any]]] = {"every step of all": {}}
    for record in records:
        p = record["params"]
        for check in p["checks"]:
            common = any(part in check["what"] for part in everywhere)
            name = "every step of all" if common else p["case"]
            checks = found.setdefault(name, {}).setdefault(p["solver"], {})
            known = checks.get(check["what"])
            if known is None or share_of(check) > share_of(known):
                checks[check["what"]] = check
    return found


def cell(check: dict[str, Any] | None) -> str:
    """Two cells of the second table."""
    return f"{number(check['error'])} | {number(check['limit'])}" if check else "– | –"


def number(value: float) -> str:
    """Two digits; nothing below zero, where an error is one to one side only."""
    return f"{max(value, 0.0):.2g}"


def page_with(text: str, records: list[dict[str, Any]]) -> str:
    """Return a page with the tables between its marks."""
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    return f"{head}{BEGIN}\n\n{tables(records)}\n\n{END}{tail}"


def missing(records: Iterable[dict[str, Any]]) -> list[str]:
    """Cases and solvers of the battery that the records do not have."""
    from hard_cases import CASES, SOLVERS

    found = {(r["params"]["case"], r["params"]["solver"]) for r in records}
    return [f"{n}, {s}" for n in CASES for s in SOLVERS if (n, s) not in found]


# ---- the figure ----------------------------------------------------------------------------


def draw(records: list[Record], path: Path) -> None:
    """Iterations of each case, and its largest error over the limit."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = [r for r in records if r.params["case"] != LONG_CASE]
    names = list(dict.fromkeys(r.params["case"] for r in rows))
    figure, axes = plt.subplots(1, 2, figsize=(10, 6), sharey=True, constrained_layout=True)
    for solver, mark in zip(dict.fromkeys(r.params["solver"] for r in rows), "osv^", strict=False):
        mine = [r for r in rows if r.params["solver"] == solver]
        y = [names.index(r.params["case"]) for r in mine]
        axes[0].plot([max(1, r.params["iterations"]["max"]) for r in mine], y, mark, label=solver)
        axes[1].plot([max(1e-10, r.value) for r in mine], y, mark, label=solver)
    axes[0].set(xscale="log", xlabel="iterations of the hardest solve")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    axes[0].legend()
    axes[1].axvline(1.0, color="0.3", lw=1)
    axes[1].set(xscale="log", xlabel="largest error over its limit")
    for axis in axes:
        axis.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run the battery, or write its tables into the page."""
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--docs", action="store_true", help="write the tables into the page")
    parser.add_argument("--check", action="store_true", help="say whether the page has them")
    options = parser.parse_args()
    if options.docs or options.check:
        rows = json.loads(RECORDS.read_text())
        text = PAGE.read_text()
        wanted = page_with(text, rows)
        if options.docs:
            PAGE.write_text(wanted)
        elif text != wanted or missing(rows):
            raise SystemExit(f"{PAGE} is out of date: run --json, then --docs; {missing(rows)}")
        return
    records = bench(options.quick)
    save(records, options.json)
    print(tables([vars(record) for record in records]))
    if options.figure:
        draw(records, options.figure)


if __name__ == "__main__":
    main()
