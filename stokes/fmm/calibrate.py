"""Measure the constants by which plans are chosen: `python -m stokes.fmm.calibrate`.

Writes `constants.json` beside this file, the only one that plans read: errors by kernel, grid and
nodes, which depend on no machine, and nanoseconds of this machine on one thread. What is not
measured stays as it was. Takes about ten minutes; run it on an idle machine. Nothing is timed when
sums are made.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from dem_mpi.parallel import Parallel
from stokes.fmm.accuracy import cloud, sample_scheme, sum_error
from stokes.fmm.choice import SAMPLE_EDGES, row_name
from stokes.fmm.kernels import KERNELS, Kernel, laplace, stokeslet
from stokes.fmm.near_field import NearField
from stokes.fmm.near_matrices import NearMatrices
from stokes.fmm.tree import Splitting
from stokes.fmm.tree_sum import Scheme, TreeSum

_FILE = Path(__file__).with_name("constants.json")
_NODES = {
    "equispaced": (3, 4, 5, 6, 7, 8, 10, 12, 14),
    "chebyshev": (3, 4, 6, 8, 10),
}
_METHODS = {"equispaced": "ufmm", "chebyshev": "symmetric"}
# The largest errors were those of the cube in all comparisons, clustered clouds' the smallest.
_CLOUDS = ("cube", "sphere")
_REPEATS = 5
_SMALLEST = 1e-10  # no smaller errors are of interest


def main() -> None:
    """Measure errors, costs or both, and write the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=("errors", "costs"), help="measure these only")
    parser.add_argument(
        "--kernels",
        nargs="+",
        choices=tuple(KERNELS),
        metavar="KERNEL",
        help="errors of these kernels only, by name",
    )
    parser.add_argument(
        "--grids",
        nargs="+",
        choices=tuple(_NODES),
        default=tuple(_NODES),
        help="errors of these grids only",
    )
    arguments = parser.parse_args()
    if not os.access(_FILE, os.W_OK):
        parser.error(f"{_FILE} cannot be written: install the package where you may write")
    constants = json.loads(_FILE.read_text())
    if arguments.only != "costs":
        wanted = list(KERNELS.values())
        if arguments.kernels:
            wanted = [KERNELS[name] for name in arguments.kernels]
        for kernel in wanted:
            rows = constants["errors"].setdefault(kernel.name, {})
            rows.update(errors_of(kernel, arguments.grids))
            if kernel.single:
                constants["single"][kernel.name] = round_off_of(kernel)
            _write(constants)
    if arguments.only != "errors":
        constants["nanoseconds"] = {
            "double": nanoseconds(single=False),
            "single": nanoseconds(single=True),
        }
    _write(constants)


def _write(constants: dict[str, Any]) -> None:
    _FILE.write_text(json.dumps(constants, indent=1, sort_keys=True) + "\n")


def errors_of(kernel: Kernel, grids: Sequence[str]) -> dict[str, dict[str, float]]:
    """Rows of errors by nodes, the largest over distributions and signs of weights."""
    rows = {}
    edges = [None] if kernel.homogeneous else SAMPLE_EDGES
    derivatives = ("exact",) if kernel.base is None else ("exact", "interpolated")
    for grid, derivative, edge in product(grids, derivatives, edges):
        row: dict[str, float] = {}
        method = _METHODS[grid]
        for nodes in _NODES[grid]:
            scheme = sample_scheme(method, nodes, derivative, single=False)
            error = max(sum_error(kernel, scheme, where, edge) for where in _CLOUDS)
            row[str(nodes)] = float(f"{max(error, 1e-16):.2e}")
            if error > 10.0 * min(row.values()) or error < _SMALLEST:
                break
        name = row_name(method, derivative, edge)
        rows[name] = row
        print(kernel.name, name, row, flush=True)
    return rows


def round_off_of(kernel: Kernel) -> float:
    """What single precision adds to the error, in 7 nodes."""
    worst = 0.0
    for distribution in _CLOUDS:
        edge = None if kernel.homogeneous else 2.0
        single = sum_error(kernel, sample_scheme("ufmm", 7, "exact", True), distribution, edge)
        double = sum_error(kernel, sample_scheme("ufmm", 7, "exact", False), distribution, edge)
        worst = max(worst, float(np.sqrt(max(single**2 - double**2, 0.0))))
    return float(f"{worst:.2e}")


def nanoseconds(*, single: bool) -> dict[str, Any]:
    """Cost of each kind of operation on one thread."""
    near = {name: _near_pair(kernel, single) for name, kernel in KERNELS.items()}
    entries = np.array([k.n_in * k.n_out for k in KERNELS.values()])
    return {
        "near": near,
        "stored": _stored_entry(single),
        "near_entry": round(float(np.median(np.array(list(near.values())) / entries)), 3),
        **_far_field(single),
    }


def _near_pair(kernel: Kernel, single: bool) -> float:
    """Of a pair of points, in groups of 64."""
    count, group = 4096, 64
    x = np.ascontiguousarray(cloud("cube", count, 1).T)
    w = np.ones((kernel.n_in, count))
    out = np.zeros((kernel.n_out, count))
    ranges = np.stack((np.arange(0, count, group), np.arange(group, count + 1, group)), axis=1)
    start = np.arange(len(ranges) + 1)
    everything = np.tile([0, count], (len(ranges), 1))
    near = NearField(kernel, single)
    seconds = _fastest(lambda: near.add(x, ranges, x, w, start, everything, out))
    return round(1e9 * seconds / count**2, 3)


def _stored_entry(single: bool) -> float:
    """Of an entry of stored near matrices, more of them than caches hold."""
    count, group, listed = 16384, 64, 32
    x = np.ascontiguousarray(cloud("cube", count, 1).T)
    first = np.arange(0, count, group)
    ranges = np.stack((first, first + group), axis=1)
    sources = ranges[np.arange(len(ranges) * listed) % len(ranges)]
    start = listed * np.arange(len(ranges) + 1)
    near = NearMatrices(laplace, x, ranges, x, start, sources, single=single)
    w, out = np.ones((1, 1, count)), np.zeros((1, 1, count))
    seconds = _fastest(lambda: near.add(w, out))
    return round(1e9 * seconds / (count * listed * group), 3)


def _far_field(single: bool) -> dict[str, float]:
    """Of points, passes and transfers, by sums over a full tree of three levels.

    Transforms, a small share, and products of Chebyshev grids, which are chosen for their accuracy
    and not for their speed, have typical figures instead.
    """
    points = cloud("cube", 20000, 1)
    stages = {}
    for kernel, nodes in ((laplace, 5), (laplace, 9), (stokeslet, 7)):
        scheme = Scheme("ufmm", nodes, Splitting(depth=3), single=single)
        plan = TreeSum(kernel, points, None, scheme, Parallel.alone(), clock=process_time)
        weights = np.ones((len(points), kernel.n_in, 1))
        plan.apply(weights)
        fastest: dict[str, float] = {}
        for _ in range(_REPEATS):
            plan.apply_seconds.clear()
            plan.apply(weights)
            for name, seconds in plan.apply_seconds.items():
                fastest[name] = min(seconds, fastest.get(name, seconds))
        stages[kernel.name, nodes] = fastest
    boxes, pairs = len(plan.boxes), len(plan.lists.far)
    passes = stages["laplace", 9]["upward"] + stages["laplace", 9]["downward"]
    work = 0.46 * pairs * (2 * 9 - 1) ** 3
    tensor_work = 0.46 * pairs * (2 * 7 - 1) ** 3 * 9
    return {
        "points": round(1e9 * 0.5 * passes / (2 * 9**3 * len(points)), 4),
        "passes": round(1e9 * 0.5 * passes / (2 * 9**4 * boxes), 4),
        "transform": 0.05,
        "product": round(1e9 * stages["laplace", 9]["far"] / work, 4),
        "product_tensor": round(1e9 * stages["stokeslet", 7]["far"] / tensor_work, 4),
        "matrix": 0.5 if single else 1.0,
    }


def _fastest(function: Any) -> float:
    """Least CPU seconds of some repeats, the first (compilation) left out."""
    function()
    seconds = []
    for _ in range(_REPEATS):
        start = process_time()
        function()
        seconds.append(process_time() - start)
    return min(seconds)


if __name__ == "__main__":
    main()
