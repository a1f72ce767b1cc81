"""Preconditioners of SCIP's Newton systems: conjugate gradients beside a factorisation.

    python scripts/bench/preconditioners.py [--quick] [--json FILE] [--figure FILE] [--page FILE]

Settled piles of 2,000 and 16,000 spheres (lib/piles.py) are solved by the interior point method to
1e-6 m/s, with exact factors. At an early, a middle and a late Newton iteration its system, in
velocities, is solved by conjugate gradients with each candidate too: CPU seconds of its set-up,
iterations and CPU seconds to relative residuals 1e-4 and 1e-10 of the Newton system (the latter is
what the solver asks of a factor), entries of its factor. Rival is the exact factor by MUMPS, itself
measured in the same way. One core; a solve ends after 3,000 iterations or 20 s.

Set-ups are second ones, that know the matrix's pattern, as all but the first of a solve do. A
candidate that this PETSc was built without is named, and left out. --quick: 2,000 spheres alone,
a minute. In full some ten minutes of CPU. --page puts the tables between the markers of a Markdown
file.
"""

from __future__ import annotations

import json
import math
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from lib import piles
from lib.preconditioner_work import CANDIDATES, EXACT, Trial, measure, missing
from records import BUILD, Record, arguments, mpirun, put, write
from scip import checked_out

# Newton iterations at which candidates are tried, from 1: early, middle, late.
CHOSEN = {"pile-2000/settled": (3, 7, 12), "pile-16000/settled": (4, 11, 18)}
QUICK = ("pile-2000/settled",)
ACCURACY = 1e-6  # m/s, of the interior point solve
TOLERANCES = (1e-4, 1e-10)
NAMES = ("10⁻⁴", "10⁻¹⁰")

Found = dict[str, dict[str, Any]]


def run(state: str) -> dict[str, Any]:
    """Measure the systems of a state, in a process of its own: one core, nothing else loaded."""
    BUILD.mkdir(parents=True, exist_ok=True)
    result = BUILD / f"preconditioners-{os.getpid()}.json"
    checkpoint = piles.state(state)
    try:
        mpirun(1, [str(Path(__file__).resolve()), "--worker", state, str(checkpoint), str(result)])
        return json.loads(result.read_text())
    finally:
        result.unlink(missing_ok=True)


def work(state: str, checkpoint: Path, result: Path) -> None:
    """Measure and write."""
    from dem_mpi.parallel import Parallel
    from dem_mpi.warmup import warm_up

    parallel = Parallel()
    warm_up(parallel, 1, ("matrix_free",), solvers=("scip",))
    found = measure(parallel, checkpoint, CHOSEN[state], ACCURACY, TOLERANCES)
    result.write_text(json.dumps(found | {"missing": missing()}))


# ---- records -------------------------------------------------------------------------------


def trials_of(row: dict[str, Any]) -> dict[str, Trial]:
    """The trials at one iteration, by name."""
    return {one["name"]: Trial(**one) for one in row["trials"]}


def records_of(found: Found) -> list[Record]:
    """Seconds to each tolerance, set-up included, beside those of the exact factor; the rest."""
    records = []
    for state, solve in found.items():
        common = {"state": state, **{k: solve[k] for k in ("spheres", "contacts")}}
        for key in ("iterations", "solves"):
            records.append(Record(f"preconditioners.newton.{key}", common, solve[key], "1"))
        for name, package in solve["missing"].items():
            params = common | {"preconditioner": name, "failure": f"PETSc without {package}"}
            records.append(Record("preconditioners.missing", params, 1, "1"))
        for row in solve["rows"]:
            where = common | {k: row[k] for k in ("iteration", "least", "most")}
            trials = trials_of(row)
            for one in trials.values():
                records += _trial_records(one, trials[EXACT], where)
    return records


def _trial_records(one: Trial, exact: Trial, where: dict[str, Any]) -> list[Record]:
    params = where | {"preconditioner": one.name}
    records = [Record("preconditioners.set_up", params | {"first": one.first}, one.set_up, "s")]
    if one.entries is not None:
        records.append(Record("preconditioners.entries", params, one.entries, "1"))
    for k, tolerance in enumerate(TOLERANCES):
        iterations, seconds, rival = one.iterations[k], one.seconds[k], exact.seconds[k]
        asked = params | {"tolerance": tolerance}
        if iterations is None or seconds is None:
            asked["failure"] = "not positive definite" if one.broken else "not reached"
            records.append(Record("preconditioners.iterations", asked, one.spent, "1"))
            continue
        records.append(Record("preconditioners.iterations", asked, iterations, "1"))
        total = Record("preconditioners.seconds", asked, one.set_up + seconds, "s")
        if rival is not None and one is not exact:
            total.rival, total.rival_value = EXACT, exact.set_up + rival
            total.ratio = total.value / total.rival_value
        records.append(total)
    return records


# ---- tables --------------------------------------------------------------------------------


def tables(found: Found) -> str:
    """A table a pile: a row a candidate, two columns an iteration."""
    return "\n\n".join([f"Commit {checked_out()}.", *(_table(solve) for solve in found.values())])


def _table(solve: dict[str, Any]) -> str:
    rows = [(row, trials_of(row)) for row in solve["rows"]]
    heads = ["preconditioner", "set-up [s]", "entries [10⁶]"]
    heads += [f"{row['iteration']}: to {name}" for row, _ in rows for name in NAMES]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    last = rows[-1][1]
    for candidate in CANDIDATES:
        name = candidate.name
        if name in solve["missing"]:
            cells = [f"PETSc has no {solve['missing'][name]}", *["–"] * (len(heads) - 2)]
        elif name in last:
            one = last[name]
            entries = "–" if one.entries is None else _number(one.entries / 1e6)
            cells = [_number(one.set_up), entries]
            cells += [_cell(at[name], k) for _, at in rows for k in range(len(TOLERANCES))]
        else:
            continue
        lines.append("| " + " | ".join([name, *cells]) + " |")
    title = (
        f"**{solve['spheres']:,} spheres, {solve['contacts']:,} contacts, "
        f"{solve['iterations']} Newton iterations, {solve['solves']:.1f} systems a matrix**"
    )
    spreads = ", ".join(
        f"{_decade(row['least'])} to {_decade(row['most'])} at {row['iteration']}"
        for row, _ in rows
    )
    return "\n".join([title, "", *lines, "", f"Eigenvalues of Q times N: {spreads}."])


def _cell(one: Trial, k: int) -> str:
    """Iterations / seconds of conjugate gradients to a tolerance."""
    iterations, seconds = one.iterations[k], one.seconds[k]
    if iterations is None or seconds is None:
        return "breaks down" if one.broken else f"> {one.spent:,}"
    return f"{iterations:,} / {_number(seconds)}"


def _number(value: float) -> str:
    """Two significant digits."""
    return f"{float(f'{value:.2g}'):g}"


def _decade(value: float) -> str:
    """The nearest power of ten."""
    exponent = str(round(math.log10(value)))
    return "10" + exponent.translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


# ---- figure --------------------------------------------------------------------------------


def draw(found: Found, path: Path) -> None:
    """Seconds to the tighter tolerance, set-up included, along the solve."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(found), figsize=(6 * len(found), 4.5), squeeze=False)
    for axis, solve in zip(axes[0], found.values(), strict=True):
        for number, candidate in enumerate(CANDIDATES):
            points = [
                (row["iteration"], one.set_up + one.seconds[-1])
                for row in solve["rows"]
                for one in trials_of(row).values()
                if one.name == candidate.name and one.seconds[-1] is not None
            ]
            if points:
                style = "k--" if candidate.name == EXACT else f"C{number % 10}o-"
                axis.semilogy(*zip(*points, strict=True), style, label=candidate.name)
        axis.set_title(f"{solve['spheres']:,} spheres")
        axis.set_xlabel("Newton iteration")
        axis.set_ylabel("CPU seconds, one system to 1e-10")
        axis.grid(True, which="both", alpha=0.25)
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


# ---- program -------------------------------------------------------------------------------


def main() -> None:
    """Parse the options; measure; write records, figure and tables."""
    if sys.argv[1:2] == ["--worker"]:
        work(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]))
        return
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--page", type=Path, help="put the tables into this Markdown file")
    options = parser.parse_args()
    found = {state: run(state) for state in (QUICK if options.quick else CHOSEN)}
    records = [replace(record, commit=checked_out()) for record in records_of(found)]
    write(records, options.json)
    if options.page:
        put("preconditioners", tables(found), options.page)
    if options.figure:
        draw(found, options.figure)


if __name__ == "__main__":
    main()
