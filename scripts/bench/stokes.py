"""Flow around rigid bodies: error and seconds of one body, of suspensions, and of a rival.

    python scripts/bench/stokes.py [--quick] [--json FILE] [--figure FILE] [--picture FILE]
        [--only PART ...] [--page FILE] [--dry] [--version VERSION]

The experiments are those of S. De, PhD thesis, University of Michigan 2021, sections 3.6.1 to
3.6.3: flows of point forces inside the bodies, which are known exactly, are found again from their
values on the surfaces. His figures were taken on another machine (2.5 GHz Xeon, MATLAB).

Parts:
  single     one spheroid: error against panels and modes, seconds of each stage
  table      his Table 3.1, n_b = 2 to 256 random spheroids: at his resolution and tolerance, and
             at the resolution that a tolerance of 1e-8 asks for
  gaps       iterations and error of close pairs, chains and a close packing
  rival      work against precision beside rigid multiblobs (lib/multiblob.py)
  squirmers  125 active spheroids, and the picture of their flow

A measurement is a run of its own under mpirun, once over to compile and then timed, kept under
build/bench/stokes by version of the package: what is there is not measured again, and records are
made of all that is there. --dry measures nothing; --quick is a set of its own, of smaller cases.
--page puts the tables between the markers of a Markdown file.
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

import numpy as np
from lib import stokes_pages as pages
from records import BUILD, ROOT, Record, arguments, mpirun, put, write

CACHE = BUILD / "stokes"
PARTS = ("single", "table", "gaps", "rival", "squirmers")
BODIES = (2, 4, 8, 16, 32, 64, 128, 256)
DE_RESOLUTION = (5, 25)  # panels of 10 nodes, modes
# The matrices of one shape take some 300 MB at a tolerance of 1e-8.
TIGHT_SHAPES = 4
GAPS = (1e-1, 1e-2, 1e-3)
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
REFERENCE = 1e-9  # tolerance of what the rival and we are compared with
BLOBS = (42, 162, 642)
Known = list[tuple["Piece", dict[str, Any]]]


# ---- pieces --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """One measurement: what the ranks are told, and after how many seconds they are given up."""

    part: str
    label: str
    task: dict[str, Any]
    ranks: int = 1
    limit: float = 1800.0

    def path(self, version: str) -> Path:
        """Where the result stands, or will stand."""
        digest = hashlib.sha256(json.dumps(self.task, sort_keys=True).encode()).hexdigest()[:8]
        return CACHE / version / f"{self.part}-{self.label}-{self.ranks}-{digest}.json"


def pieces(quick: bool) -> list[Piece]:
    """All measurements, in the order in which they are made."""
    made = (_single_pieces, _table_pieces, _gap_pieces, _rival_pieces, _squirmer_pieces)
    return [piece for make in made for piece in make(quick)]


def _single_pieces(quick: bool) -> Iterable[Piece]:
    together = (2, 4, 6, 8, 12, 16, 20) if quick else (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 30)
    sizes = [(panels, 5 * panels) for panels in together]
    if not quick:
        sizes += [(panels, 60) for panels in (2, 3, 4, 5, 6, 8, 10)]
        sizes += [(16, modes) for modes in (5, 10, 15, 20, 30, 40, 60)]
    for panels, modes in dict.fromkeys(sizes):
        task = {"kind": "single", "panels": panels, "modes": modes, "formulation": "single",
                "runs": 3 if panels * modes <= 500 else 1}  # fmt: skip
        yield Piece("single", f"{panels}-{modes}", task)


def _spheroids(count: int, shapes: int = 0) -> list[Any]:
    arguments = {"count": count, "shapes": shapes, "directory": str(CACHE / "scenes")}
    return ["random_spheroids", arguments]


def table_task(count: int, aim: str) -> dict[str, Any]:
    """S. De's experiment with so many bodies: at his resolution, or to a tolerance of 1e-8."""
    task = {"kind": "solve", "data": "point_forces"}
    if aim == "his":
        task |= {"scene": _spheroids(count)}
        parts = {"fmm_tolerance": 1e-6, "residual_tolerance": 1e-6}
        return task | {"tolerance": 1e-6, "formulation": "single", "resolution": DE_RESOLUTION,
                       "options": parts}  # fmt: skip
    task |= {"scene": _spheroids(count, TIGHT_SHAPES)}
    return task | {"tolerance": 1e-8, "formulation": "single"}


def _table_pieces(quick: bool) -> Iterable[Piece]:
    for aim, most in (("his", 256), ("1e-8", 64)):
        counts = [count for count in BODIES if count <= most]
        if quick:
            counts = [2, 8, 64] if aim == "his" else [2, 4]
        for count in counts:
            for ranks in (1,) if quick else (1, 2):
                runs = 3 if aim == "his" and count <= 64 else 1
                task = table_task(count, aim) | {"runs": runs}
                yield Piece("table", f"{aim}-{count}", task, ranks, 3600.0)


def _gap_pieces(quick: bool) -> Iterable[Piece]:
    """Coaxial pairs and chains at all gaps; others where modes about the axis are many, to 1e-2."""
    sphere, prolate, oblate = (1.0, 1.0), (0.5, 1.0), (1.0, 0.5)
    gaps = GAPS[:2] if quick else GAPS
    scenes: list[tuple[str, list[Any], tuple[str, ...]]] = []
    for gap in gaps:
        for name, axes in (("spheres", sphere), ("prolate", prolate), ("oblate", oblate)):
            scene = {"semi_axes": axes, "gap": gap, "placed": "coaxial"}
            data = ("opposite", "spin_opposite") if axes == sphere else ()
            scenes.append((name, ["pair", scene], ("point_forces", *data)))
        scenes.append(("chain-8", ["chain", {"count": 8, "gap": gap}], ("point_forces",)))
        if gap >= (1e-1 if quick else 1e-2):
            side = {"semi_axes": prolate, "gap": gap, "placed": "side"}
            scenes.append(("prolate-side", ["pair", side], ("point_forces",)))
    for gap in (1e-1,) if quick else (1e-1, 3e-2, 1e-2):
        scenes.append(("cluster-13", ["cluster", {"gap": gap}], ("point_forces",)))
    for name, scene, data in scenes:
        for motion in data:
            # Far more nodes there, and no use of an axis: half an hour for what is known.
            slow = name in ("prolate-side", "cluster-13") and scene[1]["gap"] < 3e-2
            for preconditioner in ("neighbours",) if slow else ("neighbours", "body"):
                task = {"kind": "solve", "scene": scene, "data": motion, "tolerance": 1e-6,
                        "formulation": "single",
                        "options": {"preconditioner": preconditioner}}  # fmt: skip
                label = f"{name}-{scene[1]['gap']:g}-{motion}-{preconditioner}"
                yield Piece("gaps", label, task, 1 if scene[0] == "pair" else 2)


def _rival_pieces(quick: bool) -> Iterable[Piece]:
    scene = {"scene": _spheroids(4 if quick else 16, TIGHT_SHAPES), "data": "random"}
    solve = scene | {"kind": "solve", "formulation": "single", "points": False}
    ours = (*TOLERANCES[1:4], TOLERANCES[-1]) if quick else (*TOLERANCES, REFERENCE)
    for tolerance in ours:
        yield Piece("rival", f"ours-{tolerance:.0e}", solve | {"tolerance": tolerance})
    for blobs in BLOBS[: 2 if quick else None]:
        task = scene | {"kind": "multiblob", "blobs": blobs, "tolerance": 1e-4}
        yield Piece("rival", f"multiblob-{blobs}", task)


def _squirmer_pieces(quick: bool) -> Iterable[Piece]:
    edge = 3 if quick else 5
    for ranks in (1,) if quick else (1, 2):
        task = {"kind": "squirmers", "edge": edge, "spacing": 2.5, "speed": 10.0,
                "tolerance": 1e-4, "formulation": "single", "pixels": 60 if quick else 240,
                "field": str(_field(edge))}  # fmt: skip
        yield Piece("squirmers", f"{edge}", task, ranks)


def _field(edge: int) -> Path:
    return CACHE / f"squirmers-{edge}.npy"


def checked_out() -> str:
    """The commit that the package was last changed in, and a digest of what differs from it."""

    def git(*command: str) -> str:
        call = ["git", "-C", str(ROOT), *command, "--", "stokes"]
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
    order, result = path.with_suffix(".task"), path.with_suffix(".result")
    order.write_text(json.dumps(piece.task))
    print(f"{piece.part} {piece.label}, {piece.ranks} ranks ...", flush=True)
    try:
        mpirun(piece.ranks, [__file__, "--worker", str(order), str(result)], piece.limit)
        result.rename(path)
    except (subprocess.SubprocessError, FileNotFoundError) as error:
        print(f"  left out: {error}", flush=True)
    finally:
        order.unlink()


# ---- records -------------------------------------------------------------------------------


def records_of(known: Known) -> list[Record]:
    """Headlines, then every part's."""
    made = (_single_records, _table_records, _gap_records, _rival_records, _squirmer_records)
    return [record for make in made for record in make(known)]


def chosen(known: Known, part: str) -> Known:
    """The pieces of a part."""
    return [(piece, found) for piece, found in known if piece.part == part]


def _single_records(known: Known) -> Iterable[Record]:
    found = chosen(known, "single")
    for piece, row in found:
        params = {k: piece.task[k] for k in ("panels", "modes", "formulation")}
        params |= {k: row[k] for k in ("nodes", "seconds", "error_absolute", "error_by_component")}
        yield Record("stokes.single", params, sum(row["seconds"].values()), "s",
                     error=row["error_to_largest"], runs=row["runs"])  # fmt: skip
    together = [(p, r) for p, r in found if p.task["modes"] == 5 * p.task["panels"]]
    if not together:
        return
    piece, best = min(together, key=lambda one: one[1]["error_to_largest"])
    params = {k: piece.task[k] for k in ("panels", "modes")}
    error = best["error_to_largest"]
    yield Record("stokes.single_body_error", params | {"over": "largest velocity"}, error, "1",
                 error=error)  # fmt: skip
    error = best["error_by_component"]
    yield Record("stokes.single_body_error_by_component", params | {"over": "each component"},
                 error, "1", rival="S. De 2021, figure 3.2", rival_value=1e-9, ratio=error / 1e-9,
                 error=error)  # fmt: skip
    for stage in best["seconds"]:
        points = [(r["nodes"], r["seconds"][stage]) for _, r in together]
        if len(points) > 2:
            yield Record("stokes.single.growth", {"stage": stage}, growth(points), "1")


def growth(points: list[tuple[float, float]]) -> float:
    """Exponent of the second in the first, least squares over the larger half."""
    larger = sorted(points)[len(points) // 2 - 1 :]
    x, y = np.log(np.maximum(np.array(larger, dtype=float).T, 1e-9))
    return float(np.polyfit(x, y, 1)[0])


def whole(row: dict[str, Any]) -> float:
    """Seconds of set-up and solution."""
    return row["seconds"]["set-up"] + row["seconds"]["solve"]


def _table_records(known: Known) -> Iterable[Record]:
    for aim in ("his", "1e-8"):
        for piece, row in chosen(known, "table"):
            if piece.label.startswith(aim):
                yield from _table_pair(aim, piece, row)
        for ranks in (1, 2):
            points = [(r["bodies"], whole(r)) for p, r in chosen(known, "table")
                      if p.label.startswith(aim) and p.ranks == ranks]  # fmt: skip
            if len(points) > 2:
                params = {"aim": aim, "bodies": [n for n, _ in points]}
                yield Record("stokes.growth.seconds", params, growth(points), "1", ranks=ranks)


def _table_pair(aim: str, piece: Piece, row: dict[str, Any]) -> Iterable[Record]:
    """Applications and seconds of one suspension, beside his where he has a number."""
    his = pages.DE_TABLE.get((piece.ranks, row["bodies"])) if aim == "his" else None
    kept = ("bodies", "nodes", "gap", "volume_fraction", "converged", "residual", "phases",
            "error_absolute", "error_to_largest", "error_of_forces", "memory")  # fmt: skip
    params = {k: row[k] for k in kept}
    # His measure at his resolution; for a tolerance the harder one, up to the surfaces.
    at_his = row["error_absolute"].get("box")
    error = at_his if aim == "his" else max(row["error_to_largest"].values())
    prefix = "stokes" if aim == "his" else f"stokes.to_{aim}"
    values = ((row["iterations"], his and his.applications), (whole(row), his and his.seconds))
    for (name, unit), (ours, theirs) in zip(
        (("applications", "1"), ("seconds", "s")), values, strict=True
    ):
        rival = {"rival": "S. De 2021, Table 3.1", "rival_value": theirs,
                 "ratio": ours / theirs} if theirs else {}  # fmt: skip
        yield Record(f"{prefix}.{name}.nb{row['bodies']}", params, ours, unit,
                     error=error, runs=row["runs"], ranks=piece.ranks, **rival)  # fmt: skip


def _gap_records(known: Known) -> Iterable[Record]:
    for piece, row in chosen(known, "gaps"):
        params = {"scene": piece.label, "gap": row["gap"], "data": piece.task["data"],
                  **piece.task["options"], "seconds": row["seconds"],
                  "converged": row["converged"], "nodes": row["nodes"]}  # fmt: skip
        yield Record("stokes.gaps.iterations", params, row["iterations"], "1",
                     error=pages.gap_error(piece.task, row), ranks=piece.ranks)  # fmt: skip


def _rival_records(known: Known) -> Iterable[Record]:
    for label, error, row in pages.compared(chosen(known, "rival")):
        params = {"method": label, "bodies": row["bodies"], "nodes": row["nodes"],
                  "iterations": row["iterations"]}  # fmt: skip
        yield Record("stokes.rival", params, whole(row), "s", error=error)


def _squirmer_records(known: Known) -> Iterable[Record]:
    for piece, row in chosen(known, "squirmers"):
        params = {k: row[k] for k in ("bodies", "nodes", "gap", "volume_fraction", "iterations",
                                      "iterations_free", "fastest", "points")}  # fmt: skip
        for kind in ("held", "free", "set-up", "evaluation"):
            name = f"stokes.squirmers.{kind.replace('-', '')}"
            yield Record(name, params, row["seconds"][kind], "s", ranks=piece.ranks)


# ---- program -------------------------------------------------------------------------------


def work(order: Path, result: Path) -> None:
    """Collective. Do one task; rank 0 writes its result."""
    from lib.stokes_work import work as do

    from dem_mpi.parallel import Parallel

    parallel = Parallel()
    parallel.install_abort_hook()
    found = do(parallel, json.loads(order.read_text()))
    if parallel.rank == 0:
        result.write_text(json.dumps(found))


def main() -> None:
    """Parse the options; measure what is not known yet; write records, figures and tables."""
    if sys.argv[1:2] == ["--worker"]:
        work(Path(sys.argv[2]), Path(sys.argv[3]))
        return
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--dry", action="store_true", help="measure nothing, use what is known")
    parser.add_argument("--version", help="as which version results are kept and found")
    parser.add_argument("--page", type=Path, help="put the tables into this Markdown file")
    parser.add_argument("--picture", type=Path, help="draw the flow of the active spheroids")
    options = parser.parse_args()
    version = options.version or checked_out()
    todo = pieces(options.quick)
    known = gather(todo, () if options.dry else tuple(options.only), version)
    records = [replace(record, commit=version) for record in records_of(known)]
    if any(math.isnan(record.value) for record in records):
        raise SystemExit("a figure is not a number")
    write(records, options.json)
    if options.page:
        for name, text in pages.tables(known, records, version).items():
            put(name, text, options.page)
    if options.figure:
        pages.draw(known, records, options.figure)
    if options.picture:
        (task,) = {json.dumps(p.task): p.task for p in todo if p.part == "squirmers"}.values()
        if not Path(task["field"]).exists():
            raise SystemExit("--picture: no flow is known; take the part `squirmers`")
        pages.draw_flow(task, options.picture)


if __name__ == "__main__":
    main()
