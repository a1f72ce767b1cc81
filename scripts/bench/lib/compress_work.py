"""What a process of compress.py does: one measurement, from a task to a dictionary.

A task has `kind` and `quick`, and beside it

    archive    fields, tau: an archive of the whole run; rivals at its errors of the last field
    trains     tau: velocities with tensor trains forced
    thesis     tau: S. De's own set-up (lib/compress_thesis.py)
    streamed   tau, form: its chunks joined into one train as they come
    precision  tau, runs: one chunk of each phase, ours beside the rivals, in turn
    picture    tau, path: a frame of the impact, as it was and as restored
    ttsvd      runs: decomposition of a large tensor (lib/compress_ttsvd.py)
    stress     tables of stress and strain of packings (lib/compress_packings.py)
    insitu     runs: the simulation with and without compression

Seconds are CPU seconds of this process: other work on the machine does not count.
"""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
import yaml
from lib.compress_data import CACHE, SCENE, STEP, STEPS, Sediment, simulate
from lib.compress_rivals import AIM, RIVALS, Point, Rivals, measured, pieces

from compress.archive import Archive, ArchiveWriter, Block, Chunk, FieldSpec, Settings
from compress.bounds import Bound, Errors, measure

UNITS = {"velocity": "m/s", "position": "m", "angular_velocity": "rad/s"}
GUIDES = {"position": "velocity"}


def work(task: dict[str, Any]) -> Any:
    """Do a task."""
    run = Sediment(task["quick"])
    return {
        "archive": _archive,
        "trains": _trains,
        "thesis": _thesis,
        "streamed": _streamed,
        "precision": _precision,
        "picture": _picture,
        "ttsvd": _ttsvd,
        "stress": _stress,
        "insitu": _insitu,
    }[task["kind"]](run, task)


# ---- archives ------------------------------------------------------------------------------


def specs(fields: Iterable[str], tau: float) -> dict[str, FieldSpec]:
    """Fields of an archive with a relative bound on each."""
    names = tuple(fields)
    return {
        name: FieldSpec(
            Bound("relative", tau),
            dtype="f8",
            width=3,
            unit=UNITS[name],
            guide=GUIDES.get(name) if GUIDES.get(name) in names else None,
        )
        for name in names
    }


def chunk_of(run: Sediment, number: int, fields: tuple[str, ...]) -> Chunk:
    """A chunk of the run as a block of all bodies."""
    steps = STEPS * number + np.arange(1, STEPS + 1)
    block = Block(np.arange(run.bodies), run.load(number, fields))
    return Chunk(steps, run.times(number), (block,))


class Written:
    """An archive of some chunks of a run: what was said when each was coded.

    coded : {chunk: CodedBlock}; seconds : {chunk: CPU seconds}; size : bytes of the whole file
    """

    def __init__(
        self, run: Sediment, chunks: Iterable[int], fields: tuple[str, ...], tau: float, path: Path
    ) -> None:
        self.path, self.coded, self.seconds = path, {}, {}
        settings = Settings(step_size=STEP)
        with ArchiveWriter(path, specs(fields, tau), settings=settings, force=True) as writer:
            for number in chunks:
                chunk = chunk_of(run, number, fields)
                began = process_time()
                (self.coded[number],) = writer.append(chunk).blocks
                self.seconds[number] = process_time() - began
        self.size = path.stat().st_size


def _archive(run: Sediment, task: dict[str, Any]) -> dict[str, Any]:
    """Bytes, errors and seconds of each chunk; bytes of one field are of the task's last one."""
    fields, tau = tuple(task["fields"]), task["tau"]
    field = fields[-1]
    with tempfile.TemporaryDirectory() as directory:
        _warm_up(run, fields, tau, Path(directory))
        written = Written(run, run.chunks, fields, tau, Path(directory) / "archive.h5")
        reading = _read(run, written, field)
    rivals = Rivals(run, field)
    rows = []
    for number in run.chunks:
        coded = written.coded[number].fields[field]
        errors, seconds = reading[number]
        target = tau * run.norms(field)[number]
        rows.append({
            "chunk": number, "phase": run.phases[number], "coder": coded.coder,
            "bytes": len(coded.data), **_told(errors),
            "write": written.seconds[number], "read": seconds,
            "rivals": _beside(rivals, number, errors.frobenius or AIM * target, tau),
            "rivals_at_bound": _beside(rivals, number, AIM * target, tau),
        })  # fmt: skip
        if errors.frobenius > target:
            raise SystemExit(f"{field}, chunk {number}: error {errors.frobenius} above {target}")
    return {"rows": rows, "file": written.size, "fields": list(fields)}


def _warm_up(run: Sediment, fields: tuple[str, ...], tau: float, directory: Path) -> None:
    """Compile, or load what is compiled."""
    Written(run, [run.chunks[1]], fields, tau, directory / "first.h5")
    _read(run, Written(run, [run.chunks[-1]], fields, tau, directory / "first.h5"), fields[-1])


def _read(run: Sediment, written: Written, field: str) -> dict[int, tuple[Errors, float]]:
    """Errors of each chunk as it is read from the file, and CPU seconds to read it."""
    found = {}
    with Archive(written.path) as archive:
        for k, number in enumerate(written.coded):
            began = process_time()
            restored = archive.read([field], steps=slice(STEPS * k, STEPS * (k + 1)))
            seconds = process_time() - began
            values = run.load(number, (field,))[field]
            found[number] = measure(values, restored.fields[field]), seconds
    return found


def _told(errors: Errors) -> dict[str, float]:
    return {"frobenius": errors.frobenius, "norm": errors.norm, "maximum": errors.maximum,
            "nrmse": errors.nrmse if math.isfinite(errors.nrmse) else 0.0}  # fmt: skip


def _beside(rivals: Rivals, chunk: int, error: float, tau: float) -> dict[str, Any]:
    """Each rival's bytes at an error, and what it took nearest to it."""
    found = {name: rivals.at(name, chunk, error, tau) for name in RIVALS}
    return {name: {"bytes": known[0], **_point(known[1])} for name, known in found.items() if known}


def _point(point: Point) -> dict[str, Any]:
    return {"layout": point.layout, "write": point.write, "read": point.read}


# ---- tensor trains alone -------------------------------------------------------------------


def _trains(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Velocities by tensor trains whatever else would be smaller; the better of the two forms."""
    from compress import tt_coder
    from compress.permutation import encode as encode_order
    from compress.tensorize import morton_order

    tau, rivals = task["tau"], Rivals(run, "velocity")
    rows, previous = [], None
    for number in run.chunks:
        found = run.load(number, ("velocity", "position"))
        values, order = found["velocity"], morton_order(found["position"][0])
        target = Bound("relative", tau).target(values)
        orders = {"natural": None, "tensorised": order}
        sizes, coded, began = {}, {}, process_time()
        for form, rows_in in orders.items():
            coded[form] = tt_coder.encode(values, target, order=rows_in, form=form)
            permutation = b"" if rows_in is None else encode_order(order, previous)
            sizes[form] = len(coded[form]) + len(permutation)
        seconds = process_time() - began
        form = min(sizes, key=sizes.__getitem__)
        errors = measure(values, tt_coder.decode(coded[form], order=orders[form]))
        rows.append({
            "chunk": number, "phase": run.phases[number], "coder": form, "bytes": sizes[form],
            "bytes_by_form": sizes, **_told(errors), "write": seconds,
            "rivals": _beside(rivals, number, errors.frobenius, tau),
        })  # fmt: skip
        previous = order
    return rows


def _thesis(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    from lib.compress_thesis import work as do

    return do(run, task["tau"])


def _streamed(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    from lib.compress_thesis import streamed

    return streamed(run, task["tau"], task["form"])


# ---- work against precision ----------------------------------------------------------------


def one_of_each_phase(run: Sediment) -> list[int]:
    """The middle chunk of every phase."""
    chunks = {}
    for number in run.chunks:
        chunks.setdefault(run.phases[number], []).append(number)
    return [those[len(those) // 2] for those in chunks.values()]


def _precision(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    """Bytes and seconds at one tolerance; ours and the rivals in turn, medians of `runs`."""
    tau, chunks = task["tau"], one_of_each_phase(run)
    rivals = Rivals(run, "velocity")
    with tempfile.TemporaryDirectory() as directory:
        place = Path(directory)
        _warm_up(run, ("velocity",), tau, place)
        written = Written(run, chunks, ("velocity",), tau, place / "archive.h5")
        reading = _read(run, written, "velocity")
        rows = [_row(run, written, reading, rivals, tau, number) for number in chunks]
        for _ in range(task["runs"]):
            written = Written(run, chunks, ("velocity",), tau, place / "archive.h5")
            reading = _read(run, written, "velocity")
            for row in rows:
                number = row["chunk"]
                row["ours"]["write"].append(written.seconds[number])
                row["ours"]["read"].append(reading[number][1])
                _again(run, row, place)
    for row in rows:
        for method in (row["ours"], *row["rivals"].values()):
            method |= {kind: median(method[kind]) for kind in ("write", "read")}
    return rows


def _row(
    run: Sediment, written: Written, reading: dict, rivals: Rivals, tau: float, number: int
) -> dict[str, Any]:
    coded, errors = written.coded[number], reading[number][0]
    size = len(coded.fields["velocity"].data)
    error = errors.frobenius or AIM * tau * run.norms("velocity")[number]
    found = {name: rivals.at(name, number, error, tau) for name in RIVALS}
    beside = {
        name: {"bytes": known[0], "layout": known[1].layout, "bound": known[1].bound,
               "write": [], "read": []}
        for name, known in found.items() if known
    }  # fmt: skip
    ours = {"bytes": size, "coder": coded.fields["velocity"].coder, "write": [], "read": []}
    return {"chunk": number, "phase": run.phases[number], "tau": tau, **_told(errors),
            "ours": ours, "rivals": beside}  # fmt: skip


def _again(run: Sediment, row: dict[str, Any], place: Path) -> None:
    """Time each rival once more on a row's chunk."""
    from compress.tensorize import morton_order

    found = run.load(row["chunk"], ("velocity", "position"))
    order = morton_order(found["position"][0])
    for name, method in row["rivals"].items():
        arrays = pieces(found["velocity"], method["layout"], order)
        _, _, write, read = measured(name, arrays, method["bound"], place / "rival.h5")
        method["write"].append(write)
        method["read"].append(read)


# ---- picture -------------------------------------------------------------------------------


def _picture(run: Sediment, task: dict[str, Any]) -> dict[str, Any]:
    """Positions, velocities and restored ones of the last frame of the middle of the impact."""
    chunk = next(k for k in one_of_each_phase(run) if run.phases[k] == "impact")
    values = run.load(chunk, ("position", "velocity"))
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "archive.h5"
        written = Written(run, [chunk], ("velocity",), task["tau"], path)
        with Archive(path) as archive:
            restored = archive.read(["velocity"]).fields["velocity"]
    size = len(written.coded[chunk].fields["velocity"].data)
    np.savez(task["path"], position=values["position"][-1], velocity=values["velocity"][-1],
             restored=restored[-1])  # fmt: skip
    return {"chunk": chunk, "time": float(run.times(chunk)[-1]), "bytes": size,
            "ratio": 8 * run.count / size}  # fmt: skip


# ---- while a run goes on -------------------------------------------------------------------


def _insitu(run: Sediment, task: dict[str, Any]) -> dict[str, Any]:
    """Wall seconds of a run on two ranks without and with an archive, in turn, and its share.

    Only positions are written besides. `overhead` is what the run itself counts as compression over
    all else: the difference of two runs drowns in what else the machine does.
    """
    seconds: dict[str, list[float]] = {"without": [], "with": []}
    shares, size = [], 0
    with tempfile.TemporaryDirectory() as directory:
        # A run of two chunks compiles what is not compiled yet.
        first = _scene(run, Path(directory) / "first.yaml", True, 2 * STEPS * STEP)
        simulate(first, Path(directory) / "first", run.settings)
        for kind in [*seconds] * task["runs"]:
            place = Path(directory) / kind
            scene = _scene(run, Path(directory) / f"{kind}.yaml", kind == "with", task["end"])
            began = perf_counter()
            simulate(scene, place, run.settings)
            seconds[kind].append(perf_counter() - began)
            if kind == "with":
                spent = _seconds_by_phase(place / "metrics.jsonl")
                compression = spent.pop("compress")
                shares.append(compression / sum(spent.values()))
                size = (place / "run.tt.h5").stat().st_size
            shutil.rmtree(place)
    steps = round(task["end"] / STEP)
    return {
        "bodies": run.bodies, "ranks": 2, "steps": steps, "overhead": median(shares),
        "shares": shares, "file_bytes": size, "ratio": 2 * 8 * 3 * run.bodies * steps / size,
        **{kind: median(times) for kind, times in seconds.items()},
    }  # fmt: skip


def _scene(run: Sediment, path: Path, compressed: bool, end: float) -> Path:
    scene = yaml.safe_load(SCENE.read_text())
    scene["time"]["end"] = end
    scene["output"]["fields"] = ["position"]
    if compressed:
        bounds = {"velocity": 1e-2, "position": {"pointwise": 1e-4}}
        scene["compress"] = {"fields": bounds, "chunk": STEPS}
    path.write_text(yaml.safe_dump(scene))
    return path


def _seconds_by_phase(metrics: Path) -> dict[str, float]:
    """Sums over the steps of a run [s]."""
    found: dict[str, float] = {}
    for line in metrics.read_text().splitlines():
        for phase, seconds in json.loads(line)["seconds"].items():
            found[phase] = found.get(phase, 0.0) + seconds
    return found


# ---- of other files ------------------------------------------------------------------------


def _ttsvd(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    from lib.compress_ttsvd import work as do

    return do(quick=run.quick, runs=task["runs"])


def _stress(run: Sediment, task: dict[str, Any]) -> list[dict[str, Any]]:
    from lib.compress_packings import Packings, packing_series, table

    packings = Packings(volumes=4, steps=256) if run.quick else Packings()
    series = packing_series(CACHE / f"packings-{packings.volumes}", packings)
    return [asdict(row) for row in table(series)]
