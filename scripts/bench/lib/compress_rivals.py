"""What compressors of others make of a chunk: bytes against error, measured once.

zfp, SZ3, SPERR and blosc2 are taken as filters of HDF5 (package hdf5plugin); bytes are those of the
compressed pieces, without the file around them. zfp and SZ3 get a pointwise bound, SPERR a signal
to noise ratio, which is what each works best with for a root mean square error; blosc2 gets
multiples of a step as integers, bit-shuffled, by zstd at its highest level.

A chunk (T, n, 3) is stored as it is or component by component, its bodies in the order of their
gids or in Morton order at its first step, which is not charged. Which of the four is best is found
on the middle chunk of each phase and for each tolerance.

A curve keeps what was measured: a line of JSON for each bound that was tried. `bytes_at` asks it
for the bytes at an error: bounds are tried until one has an error within 2 % of it, and bytes are
taken at the error itself, between the logarithms of the two measurements around it. A looser error
is thus never charged, and errors that come in steps (zfp's, of powers of two) cost nothing extra.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from time import process_time

import h5py
import numpy as np
from lib.compress_data import Sediment
from numpy.typing import NDArray

from compress.tensorize import morton_order

RIVALS = ("zfp", "sz3", "sperr", "blosc2")
LAYOUTS = ("gid", "gid, components", "morton", "morton, components")
MATCHED = 0.02  # relative distance of errors that are taken as equal
TRIALS = 6  # new bounds for one error
NOTHING = 1e-9  # stands for an error of 0
AIM = 0.99  # part of a tolerance that a good coder uses
Layout = str


@dataclass(frozen=True)
class Point:
    """One bound tried: bytes stored, ||X - Y||_F, CPU seconds to write and to read."""

    chunk: int
    layout: Layout
    bound: float
    bytes: int
    error: float
    write: float
    read: float


# ---- one measurement -----------------------------------------------------------------------


def pieces(values: NDArray, layout: Layout, morton: NDArray) -> list[NDArray]:
    """The arrays that a layout stores instead of `values` (T, n, 3)."""
    if layout.startswith("morton"):
        values = values[:, morton]
    if layout.endswith("components"):
        return [np.ascontiguousarray(values[..., k]) for k in range(values.shape[2])]
    return [np.ascontiguousarray(values)]


def measured(rival: str, arrays: list[NDArray], bound: float, scratch: Path) -> tuple:
    """Bytes, error, seconds to write and to read of `arrays`, with a bound on the error.

    bound : as the root mean square error that it aims at [unit of the values].
    """
    # Without a cache of pieces, from which small ones would come back as they were.
    with h5py.File(scratch, "w", driver="core", backing_store=False, rdcc_nbytes=0) as file:
        began = process_time()
        stored = [_store(file, f"a{k}", rival, array, bound) for k, array in enumerate(arrays)]
        file.flush()
        written = process_time()
        restored = [data[...] for data in stored]
        if rival == "blosc2":
            restored = [data * (math.sqrt(12.0) * bound) for data in restored]
        read = process_time()
        size = sum(data.id.get_storage_size() for data in stored)
    error = math.hypot(
        *(float(np.linalg.norm(a - b)) for a, b in zip(arrays, restored, strict=True))
    )
    return size, error, written - began, read - written


def _store(file: h5py.File, name: str, rival: str, array: NDArray, bound: float) -> h5py.Dataset:
    import hdf5plugin

    if rival == "blosc2":
        steps = np.rint(array / (math.sqrt(12.0) * bound))
        largest = float(np.abs(steps).max())
        kind = next(t for t in (np.int8, np.int16, np.int32, np.int64) if largest < np.iinfo(t).max)
        array = steps.astype(kind)
        options = hdf5plugin.Blosc2(cname="zstd", clevel=9, filters=hdf5plugin.Blosc2.BITSHUFFLE)
    elif rival == "sperr":
        noise = 20.0 * math.log10(max(float(np.ptp(array)), 1e-300) / bound)
        options = hdf5plugin.Sperr(peak_signal_to_noise_ratio=max(noise, 1e-2))
    elif rival == "zfp":
        options = hdf5plugin.Zfp(accuracy=bound * 8.0)  # as much below its bound it stays
    else:
        options = hdf5plugin.SZ3(absolute=bound * math.sqrt(3.0))
    return file.create_dataset(name, data=array, chunks=array.shape, **options)


# ---- bytes against error -------------------------------------------------------------------


class Curve:
    """What is known of one rival on one field of one run.

    load : gives (values (T, n, 3), Morton order (n,)) of a chunk. Nothing is measured, and no chunk
    loaded, where `dry`.
    """

    def __init__(
        self,
        path: Path,
        rival: str,
        load: Callable[[int], tuple[NDArray, NDArray]],
        dry: bool = False,
    ) -> None:
        self._path, self._rival, self._load, self._dry = path, rival, load, dry
        self._points: dict[tuple[int, Layout], list[Point]] = {}
        if path.exists():
            for line in path.read_text().splitlines():
                self._keep(Point(**json.loads(line)))

    def _keep(self, point: Point) -> None:
        self._points.setdefault((point.chunk, point.layout), []).append(point)

    def _try(self, chunk: int, layout: Layout, bound: float) -> Point:
        values, morton = self._load(chunk)
        scratch = self._path.with_suffix(".scratch")
        found = measured(self._rival, pieces(values, layout, morton), bound, scratch)
        point = Point(chunk, layout, bound, *found)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a") as file:
            file.write(json.dumps(asdict(point)) + "\n")
        self._keep(point)
        return point

    def known(self, chunk: int, layout: Layout) -> list[Point]:
        """What was measured of a chunk, by error."""
        return sorted(self._points.get((chunk, layout), []), key=lambda point: point.error)

    def bytes_at(
        self, chunk: int, layout: Layout, error: float, count: int
    ) -> tuple[float, Point] | None:
        """Bytes of a chunk of `count` values at ||X - Y||_F = error, and the point nearest to it.

        None where nothing is known near it and nothing may be measured.
        """
        if not self._dry:
            self._close_in(chunk, layout, error, count)
        points = self.known(chunk, layout)
        if not points:
            return None
        nearest = min(points, key=lambda p: abs(math.log(max(p.error, 1e-300) / error)))
        below = [point for point in points if point.error <= error]
        choices = [float(min(point.bytes for point in below))] if below else []
        between = _interpolated(points, error)
        if between is not None and (below or nearest.error < error * (1.0 + MATCHED)):
            choices.append(between)
        return (min(choices), nearest) if choices else None

    def _close_in(self, chunk: int, layout: Layout, error: float, count: int) -> None:
        """Try bounds until one has an error within MATCHED of `error`, or TRIALS of them.

        More are tried while no error is small enough: in steady motion errors hardly follow bounds.
        """
        for trial in range(4 * TRIALS):
            points = self.known(chunk, layout)
            if trial >= TRIALS and points[0].error <= error:
                return
            if points and points[0].error <= error and _any_matches(points, error):
                return
            bound = _next_bound(points, 0.99 * error, error / math.sqrt(count))
            if self._rival == "zfp":  # it takes the power of two below
                bound = 2.0 ** math.floor(math.log2(bound))
            if any(abs(math.log(bound / point.bound)) < 1e-4 for point in points):
                return  # errors come in steps, and this one is between two of them
            self._try(chunk, layout, bound)


def _any_matches(points: list[Point], error: float) -> bool:
    return any(abs(point.error / error - 1.0) <= MATCHED for point in points)


def _next_bound(points: list[Point], error: float, first: float) -> float:
    """The bound that promises the error: by a line through the logarithms of two points."""
    points = [point for point in points if point.error > 0.0]
    if not points:
        return first
    below = [point for point in points if point.error <= error]
    above = [point for point in points if point.error > error]
    if below and above:
        low, high = below[-1], above[0]
        x = math.log(error / low.error) / math.log(high.error / low.error)
        # Never close to an end: an error that grows in steps would not let the other end move.
        return low.bound * (high.bound / low.bound) ** min(max(x, 0.1), 0.9)
    if below:
        return below[-1].bound * min(error / below[-1].error, 1e2)
    smallest = min(above, key=lambda point: point.bound)
    return smallest.bound * min(max(error / smallest.error, 1e-2), 0.9)


def _interpolated(points: list[Point], error: float) -> float | None:
    """Bytes at an error between the two points around it, both logarithmic; None outside."""
    below = [point for point in points if 0.0 < point.error <= error]
    above = [point for point in points if point.error > error]
    if not below or not above:
        return None
    low, high = below[-1], above[0]
    x = math.log(error / low.error) / math.log(high.error / low.error)
    return low.bytes * (max(high.bytes, 1) / low.bytes) ** x


class Rivals:
    """All rivals on one field of a run; curves stay beside it, by version of hdf5plugin."""

    def __init__(self, run: Sediment, field: str, dry: bool = False) -> None:
        self._run, self._field = run, field
        place = run.directory / f"rivals-{version('hdf5plugin')}"
        self._curves = {
            rival: Curve(place / f"{field}-{rival}.jsonl", rival, self._load, dry)
            for rival in RIVALS
        }
        self._loaded: tuple[int, NDArray, NDArray] | None = None
        self._layouts: dict[tuple[str, str, float], Layout | None] = {}

    def _load(self, chunk: int) -> tuple[NDArray, NDArray]:
        if self._loaded is None or self._loaded[0] != chunk:
            found = self._run.load(chunk, tuple({self._field, "position"}))
            order = morton_order(found["position"][0])
            self._loaded = (chunk, found[self._field], order)
        return self._loaded[1:]

    def at(self, rival: str, chunk: int, error: float, tau: float) -> tuple[float, Point] | None:
        """Bytes of a chunk at ||X - Y||_F = error, and the measurement nearest to it.

        `tau` is the tolerance whose best layout is taken. None where nothing is known. A chunk of
        zeros, where nothing can be lost, has an error of 0.
        """
        layout = self._layout(rival, self._run.phases[chunk], tau)
        if layout is None:
            return None
        error = error or NOTHING
        return self._curves[rival].bytes_at(chunk, layout, error, self._run.count)

    def _layout(self, rival: str, phase: str, tau: float) -> Layout | None:
        """The layout with the fewest bytes on the middle chunk of a phase; None if not known."""
        key = (rival, phase, tau)
        if key not in self._layouts:
            chunks = [k for k in self._run.chunks if self._run.phases[k] == phase]
            middle = chunks[len(chunks) // 2]
            error = AIM * tau * self._run.norms(self._field)[middle] or NOTHING
            curve, count = self._curves[rival], self._run.count
            found = {
                layout: known[0]
                for layout in LAYOUTS
                if (known := curve.bytes_at(middle, layout, error, count))
            }
            self._layouts[key] = min(found, key=found.__getitem__) if found else None
        return self._layouts[key]

    def measure_ahead(self, taus: Iterable[float], rivals: Iterable[str] = RIVALS) -> None:
        """Measure near the error that a coder leaves that uses all of its tolerance."""
        for rival in rivals:
            for tau in taus:
                for chunk in self._run.chunks:
                    self.at(rival, chunk, AIM * tau * self._run.norms(self._field)[chunk], tau)
