"""Compression of a trajectory: bytes and seconds against error, beside zfp, SZ3, SPERR and blosc2.

    python scripts/bench/compress.py [--quick] [--json FILE] [--figure FILE] [--picture FILE]
        [--only PART ...] [--page FILE] [--dry] [--version VERSION]

SEDIMENT (S. De, PhD thesis, University of Michigan 2021, section 4.4; lib/compress_data.py says
what it is and what its phases are) in chunks of 32 steps, each to a relative Frobenius error of
1e-1, 1e-2 and 1e-3 of its own norm (floor 0). Rivals have the same measured error in every chunk
(lib/compress_rivals.py). Ratios are of float64 bytes; bytes are those of the compressed pieces, of
ours and of rivals, without the HDF5 file around them (`file_bytes` is the whole of ours).

Parts:
  sediment   archives of velocity, angular velocity, and position (with velocity, from which it
             follows); rivals; tensor trains forced
  thesis     his own set-up: natural and tensorised TT-SVD in float64, no coding
  ttsvd      decomposition of 2^24 entries beside tensorly and others
  precision  error against bytes and seconds, a chunk of each phase
  stress     stand-in for his Table 4.2: stress, strain and moduli of packings
  picture    a bed as it was and as restored
  insitu     the simulation with and without compression

A measurement is a process of its own, kept under build/bench/compress by version of the package:
what is there is not measured again, and records are made of all that is there. The run, and what
rivals make of it, are kept for all versions. --dry measures nothing; --quick takes a quarter
of the bodies, every third chunk and no angular velocities. --page puts the tables between the
markers of Markdown files.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lib import compress_pages as pages
from lib.compress_data import CACHE, FIELDS, PHASES, STEPS, TAUS, Sediment
from lib.compress_pages import Known, chosen, phase_bytes, raw_bytes, total_bytes
from records import ROOT, Record, arguments, mpirun, put, write

PARTS = ("sediment", "thesis", "ttsvd", "precision", "stress", "picture", "insitu")
LADDER = (3e-1, 1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4)
PICTURED = 1e-1  # tolerance of the picture


# ---- pieces --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """One measurement: what a process is told, and after how many seconds it is given up."""

    part: str
    label: str
    task: dict[str, Any]
    limit: float = 3600.0

    def path(self, version: str) -> Path:
        """Where the result stands, or will stand."""
        digest = hashlib.sha256(json.dumps(self.task, sort_keys=True).encode()).hexdigest()[:8]
        return CACHE / version / f"{self.part}-{self.label}-{digest}.json"


def pieces(quick: bool) -> list[Piece]:
    """All measurements, in the order in which they are made."""
    found = []

    def add(part: str, label: str, **task: Any) -> None:
        found.append(Piece(part, label, {"quick": quick, **task}))

    for tau in TAUS:
        add("sediment", f"velocity-{tau:.0e}", kind="archive", fields=["velocity"], tau=tau)
    for tau in TAUS:
        add("sediment", f"trains-{tau:.0e}", kind="trains", tau=tau)
    others = (["velocity", "position"], ["angular_velocity"])
    for tau in TAUS:
        for fields in others[: 1 if quick else 2]:
            add("sediment", f"{fields[-1]}-{tau:.0e}", kind="archive", fields=fields, tau=tau)
    for tau in TAUS[: 1 if quick else 3]:
        add("thesis", f"{tau:.0e}", kind="thesis", tau=tau)
    for form in ("natural", "tensorised"):
        add("thesis", f"streamed-{form}", kind="streamed", tau=TAUS[0], form=form)
    add("ttsvd", "large", kind="ttsvd", runs=3 if quick else 5)
    for tau in LADDER[1::2] if quick else LADDER:
        add("precision", f"{tau:.0e}", kind="precision", tau=tau, runs=3 if quick else 5)
    add("stress", "packings", kind="stress")
    add("picture", "impact", kind="picture", tau=PICTURED, path=str(picture_data(quick)))
    add("insitu", "sediment", kind="insitu", runs=3, end=0.512 if quick else 1.024)
    return found


def picture_data(quick: bool) -> Path:
    """Where the frame of the picture is kept."""
    return Sediment(quick).directory / "picture.npz"


def checked_out() -> str:
    """The commit that the package was last changed in, and a digest of what differs from it."""

    def git(*command: str) -> str:
        call = ["git", "-C", str(ROOT), *command, "--", "compress"]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout

    commit, changes = git("log", "-1", "--format=%h").strip(), git("diff", "HEAD")
    return commit + ("+" + hashlib.sha256(changes.encode()).hexdigest()[:6] if changes else "")


def gather(todo: list[Piece], measured: tuple[str, ...], version: str) -> Known:
    """What is known of the pieces; those of the parts to measure are measured if it is not."""
    known: Known = []
    for piece in todo:
        path = piece.path(version)
        if not path.exists() and piece.part in measured:
            _measure(piece, path)
        if path.exists():
            known.append((piece, json.loads(path.read_text())))
    return known


def _measure(piece: Piece, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if piece.part not in ("ttsvd", "stress", "insitu"):
        Sediment(piece.task["quick"]).make()
    order, result = path.with_suffix(".task"), path.with_suffix(".result")
    order.write_text(json.dumps(piece.task))
    print(f"{piece.part} {piece.label} ...", flush=True)
    try:
        mpirun(1, [__file__, "--worker", str(order), str(result)], piece.limit)
        result.rename(path)
    except (subprocess.SubprocessError, FileNotFoundError) as error:
        print(f"  left out: {error}", flush=True)
    finally:
        order.unlink()


# ---- records -------------------------------------------------------------------------------


def records_of(known: Known) -> list[Record]:
    """Headlines, then every part's."""
    made = (_ratio_records, _train_records, _chunk_records, _thesis_records, _ttsvd_records,
            _precision_records, _stress_records, _insitu_records)  # fmt: skip
    return [record for make in made for record in make(known)]


def spelled(tau: float) -> str:
    """1e-1 for 0.1."""
    return f"{tau:.0e}".replace("e-0", "e-")


def _archives(known: Known, field: str) -> Iterable[tuple[Piece, dict[str, Any]]]:
    for piece, found in chosen(known, "sediment"):
        if piece.task["kind"] == "archive" and piece.task["fields"][-1] == field:
            yield piece, found


def _ratio_records(known: Known) -> Iterable[Record]:
    """Total ratio of each field and tolerance, and by phase, beside each rival's."""
    for field in FIELDS:
        prefix = "compress" if field == "velocity" else f"compress.{field}"
        for piece, found in _archives(known, field):
            tau, rows = piece.task["tau"], found["rows"]
            params = _about(piece) | {"field": field, "file_bytes": found["file"],
                                      "coders": pages.bytes_by_coder(rows)}  # fmt: skip
            for rival in ("sz3", "zfp", "sperr", "blosc2"):
                name = f"{prefix}.ratio.{spelled(tau)}"
                suffix = "" if rival == "sz3" else f".{rival}"
                yield _versus(f"{name}{suffix}", params, rows, rival)
                for phase in PHASES:
                    chosen_rows = [row for row in rows if row["phase"] == phase]
                    if chosen_rows:
                        yield _versus(f"{prefix}.phase.{spelled(tau)}{suffix}",
                                      {**_about(piece), "field": field, "phase": phase},
                                      chosen_rows, rival)  # fmt: skip


def _about(piece: Piece) -> dict[str, Any]:
    run = Sediment(piece.task["quick"])
    return {"tau": piece.task["tau"], "bodies": run.bodies, "chunks": len(run.chunks),
            "steps_a_chunk": STEPS}  # fmt: skip


def _versus(name: str, params: dict[str, Any], rows: list[dict], rival: str) -> Record:
    """Ratio of float64 bytes of these chunks, and the rival's at the same error of each."""
    raw = raw_bytes(params["bodies"], rows)
    ours, theirs = raw / total_bytes(rows), phase_bytes(rows, rival)
    extra = {"error_to_tolerance": pages.relative_error(rows) / params["tau"]}
    at_bound = phase_bytes(rows, rival, "rivals_at_bound")
    if at_bound:
        extra["rival_at_the_bound"] = raw / at_bound
    beside = {} if theirs is None else {
        "rival": rival, "rival_value": raw / theirs, "ratio": raw / theirs / ours
    }  # fmt: skip
    return Record(name, params | extra, ours, "1", error=pages.relative_error(rows), **beside)


def _train_records(known: Known) -> Iterable[Record]:
    for piece, rows in chosen(known, "sediment"):
        if piece.task["kind"] == "trains":
            tau = spelled(piece.task["tau"])
            params = _about(piece) | {"field": "velocity", "coder": "tensor train"}
            yield _versus(f"compress.trains.{tau}", params, rows, "sz3")
            for phase in PHASES:
                chosen_rows = [row for row in rows if row["phase"] == phase]
                if chosen_rows:
                    yield _versus(f"compress.trains.phase.{tau}", params | {"phase": phase},
                                  chosen_rows, "sz3")  # fmt: skip


def _chunk_records(known: Known) -> Iterable[Record]:
    """The curves over simulated time (his figures 4.4 and 4.5)."""
    for field in FIELDS:
        for piece, found in _archives(known, field):
            for row in found["rows"]:
                kept = ("chunk", "phase", "coder", "nrmse", "maximum", "write", "read")
                params = _about(piece) | {"field": field} | {k: row[k] for k in kept}
                params["rivals"] = {k: v["bytes"] for k, v in row["rivals"].items()}
                yield Record("compress.chunk.bytes", params, row["bytes"], "B",
                             error=pages.relative_error([row]))  # fmt: skip


def _thesis_records(known: Known) -> Iterable[Record]:
    for piece, rows in chosen(known, "thesis"):
        for row in rows:
            params = _about(piece) | row
            if piece.task["kind"] == "streamed":
                yield Record("compress.thesis.streamed", params,
                             row["count"] / row["parameters"], "1")  # fmt: skip
                continue
            count = Sediment(piece.task["quick"]).count
            params["ratio_with_order"] = count / (row["parameters"] + row["order_bytes"] / 8)
            yield Record("compress.thesis.ratio", params, count / row["parameters"], "1",
                         error=row["nrmse"])  # fmt: skip


def _ttsvd_records(known: Known) -> Iterable[Record]:
    for _, rows in chosen(known, "ttsvd"):
        yield from (Record(**row) for row in rows)


def _precision_records(known: Known) -> Iterable[Record]:
    for piece, rows in chosen(known, "precision"):
        for row in rows:
            for method, found in {"ours": row["ours"], **row["rivals"]}.items():
                params = {k: row[k] for k in ("chunk", "phase", "tau")}
                params |= {"method": method, **found}
                yield Record("compress.precision.seconds", params, found["write"], "s",
                             error=pages.relative_error([row]),
                             runs=piece.task["runs"])  # fmt: skip


def _stress_records(known: Known) -> Iterable[Record]:
    for _, rows in chosen(known, "stress"):
        for row in rows:
            yield Record("compress.stress.ratio", row, row["ratio"], "1", error=row["nrmse"])


def _insitu_records(known: Known) -> Iterable[Record]:
    for piece, row in chosen(known, "insitu"):
        yield Record("compress.insitu.overhead", row, row["overhead"], "1",
                     runs=piece.task["runs"], ranks=row["ranks"])  # fmt: skip


# ---- program -------------------------------------------------------------------------------


def main() -> None:
    """Parse the options; measure what is not known yet; write records, figures and tables."""
    if sys.argv[1:2] == ["--worker"]:
        from lib.compress_work import work

        order, result = map(Path, sys.argv[2:4])
        result.write_text(json.dumps(work(json.loads(order.read_text()))))
        return
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--dry", action="store_true", help="measure nothing, use what is known")
    parser.add_argument("--version", help="as which version results are kept and found")
    parser.add_argument("--page", type=Path, nargs="+", help="put the tables into these pages")
    parser.add_argument("--picture", type=Path, help="draw a bed as it was and as restored")
    options = parser.parse_args()
    version = options.version or checked_out()
    known = gather(pieces(options.quick), () if options.dry else tuple(options.only), version)
    records = [replace(record, commit=version) for record in records_of(known)]
    if any(math.isnan(record.value) for record in records):
        raise SystemExit("a figure is not a number")
    write(records, options.json)
    tables = pages.tables(known, records, version)
    for page in options.page or ():
        for name, text in tables.items():
            if f"<!-- {name}: begin -->" in page.read_text():
                put(name, text, page)
    if options.figure:
        pages.draw(known, options.figure)
    if options.picture:
        told = [found for _, found in chosen(known, "picture")]
        if not told:
            raise SystemExit("--picture: nothing is known; take the part `picture`")
        pages.draw_bed(picture_data(options.quick), told[0], PICTURED, options.picture)


if __name__ == "__main__":
    main()
