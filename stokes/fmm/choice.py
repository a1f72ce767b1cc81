"""From the asked error to grids, precision and leaves: a model of errors and one of costs.

Errors come from a table measured by `python -m stokes.fmm.calibrate`, or, for kernels that are
not in it, from small sums when the plan is made (`accuracy`). Costs are counts of operations times
the nanoseconds of `constants.json`. No clock is read: the same points get the same plan on every
machine, whatever the number of ranks.

Symbols: l nodes of a grid in one direction; V, U, W, X the interaction lists.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dem_mpi import morton
from dem_mpi.parallel import Parallel
from stokes.fmm.accuracy import operator_eps, sample_scheme, sum_error
from stokes.fmm.chebyshev import is_symmetric
from stokes.fmm.kernels import KERNELS, Kernel
from stokes.fmm.lists import Pairs, interaction_lists
from stokes.fmm.options import FmmOptions
from stokes.fmm.tree import Boxes, Splitting, build, cube_about
from stokes.fmm.tree_sum import Scheme

# Errors are measured on small clouds: a plan aims at this fraction of the asked one.
SAFETY = 0.6
# Most nodes tried. Equispaced polynomials lose a digit to round-off every 3 nodes.
MOST_NODES = {"ufmm": 18, "bbfmm": 20, "symmetric": 20}
_LEAST_NODES = 3
_BEYOND_TABLE = 4
# Edges of clouds, in kernel lengths, for which errors of kernels with a length are measured.
SAMPLE_EDGES = (0.5, 4.0, 32.0)
# Keys on which leaf sizes are compared; of more points a part is drawn by its keys.
_SAMPLE = 1 << 17
_FINEST_SAMPLED_LEAF = 8
_SMALLEST_LEAF, _LARGEST_LEAF = 8, 4096


@dataclass(frozen=True)
class Choice:
    """A scheme, the error expected of it, and a sentence that says where it comes from."""

    scheme: Scheme
    expected_error: float
    why: str


@dataclass(frozen=True)
class _Far:
    """How boxes far apart are summed."""

    method: str
    nodes: int
    derivative: str
    single: bool
    error: float

    @property
    def admissible(self) -> float:
        """Order of the work of a transfer, to compare kinds of the same method."""
        return self.nodes**3


def choose(
    kernel: Kernel,
    sources: NDArray,
    targets: NDArray,
    eps: float,
    options: FmmOptions,
    parallel: Parallel,
) -> Choice:
    """Collective. What a plan for these points, this kernel and this error is made of."""
    origin, edge = _cube(sources, targets, parallel)
    far, why = _choose_far(kernel, eps, options, edge / kernel.length)
    admissibility = "standard" if options.admissibility == "auto" else options.admissibility
    direct_below = far.nodes**3
    if options.depth is not None:
        splitting = Splitting(depth=options.depth)
    elif options.leaf_size is not None:
        splitting = Splitting(leaf_size=options.leaf_size)
    else:
        keys = [_sample(points, origin, edge, parallel) for points in (sources, targets)]
        stride = max(stride for _, stride in keys)
        cost = Cost(kernel, far.method, far.nodes, far.derivative, far.single)
        splitting = Splitting(leaf_size=_best_leaf(keys, stride, cost, direct_below))
    scheme = Scheme(
        method=far.method,
        nodes=far.nodes,
        splitting=splitting,
        single=far.single,
        derivative=far.derivative,
        admissibility=admissibility,
        direct_below=0 if admissibility == "smooth" else direct_below,
        operator_eps=operator_eps(far.nodes),
    )
    return Choice(scheme, far.error, why)


# ---- error ------------------------------------------------------------------------------------


def _choose_far(kernel: Kernel, eps: float, options: FmmOptions, edge: float) -> tuple[_Far, str]:
    """The cheapest way to the error, by equispaced grids where they are stable enough."""
    if options.method != "auto":
        methods: tuple[str, ...] = (options.method,)
    else:
        methods = ("ufmm", "symmetric" if is_symmetric(kernel) else "bbfmm")
    derivatives = ("exact",)
    if kernel.base is not None:
        derivatives = ("exact", "interpolated")
        if options.derivative != "auto":
            derivatives = (options.derivative,)
    best: _Far | None = None
    for method in methods:
        found = []
        for derivative in derivatives:
            errors = Errors(kernel, method, derivative, edge)
            far = _with_order(errors, options) if options.order else _enough_nodes(errors, eps)
            found.append(_in_precision(far, errors, eps, options))
        good = [far for far in found if options.order or far.error <= SAFETY * eps]
        if good:
            return min(good, key=lambda far: _transfer_work(kernel, far)), _reason(good[0], method)
        closest = min(found, key=lambda far: far.error)
        best = closest if best is None or closest.error < best.error else best
    return best, (
        f"no grid of {methods[-1]} reaches {eps:.0e}: the most accurate one known, "
        f"expected error {best.error:.1e}"
    )


def _reason(far: _Far, method: str) -> str:
    if method == "ufmm":
        return "equispaced grids reach the error"
    return "equispaced grids are unstable for this error, or were not asked for"


def _transfer_work(kernel: Kernel, far: _Far) -> float:
    moved = kernel.base if far.derivative == "interpolated" else kernel
    return far.nodes**3 * moved.n_in * moved.n_out


class Errors:
    """Errors of one kernel by nodes, from the table or from samples."""

    def __init__(self, kernel: Kernel, method: str, derivative: str, edge: float) -> None:
        """edge: of the cube about all points, in kernel lengths."""
        self.kernel, self.method, self.derivative = kernel, method, derivative
        self._edges = sampled_edges(kernel, edge)
        rows = constants()["errors"].get(kernel.name, {}) if _is_built_in(kernel) else {}
        wanted = [row_name(method, derivative, size) for size in self._edges]
        self._rows = [
            {int(nodes): error for nodes, error in rows[name].items()}
            for name in wanted
            if name in rows
        ]
        self._known = len(self._rows) == len(wanted)

    def __call__(self, nodes: int, single: bool = False) -> float:
        """Largest relative error measured with so many nodes."""
        if single:
            return float(np.hypot(self(nodes), self._round_off))
        if self._known:
            return max(_interpolated(row, nodes) for row in self._rows)
        return self._measured(nodes, False)

    @functools.cached_property
    def _round_off(self) -> float:
        """What single precision adds."""
        known = constants()["single"].get(self.kernel.name) if self._known else None
        return known or max(self._measured(9, True), 1e-6)

    @functools.cache  # noqa: B019 (an object of a plan's own short life)
    def _measured(self, nodes: int, single: bool) -> float:
        scheme = sample_scheme(self.method, nodes, self.derivative, single)
        return max(sum_error(self.kernel, scheme, "cube", edge) for edge in self._edges)


def row_name(method: str, derivative: str, edge: float | None) -> str:
    """The name of a row of errors by nodes; edge None for a homogeneous kernel."""
    grid = "equispaced" if method == "ufmm" else "chebyshev"
    return f"{grid} {derivative}" + ("" if edge is None else f" {edge:g}")


def sampled_edges(kernel: Kernel, edge: float) -> list[float | None]:
    """Sizes of sample clouds, in kernel lengths: all that matter, [None] for all the same.

    A kernel varies on the scale of its length: boxes much larger see nothing of each other, in
    boxes much smaller it is one of its limits.
    """
    if kernel.homogeneous:
        return [None]
    return [size for size in SAMPLE_EDGES if size <= 2.0 * edge][-2:] or [SAMPLE_EDGES[0]]


def _is_built_in(kernel: Kernel) -> bool:
    """Whether it is one of the package's kernels, whatever its length and factor."""
    known = KERNELS.get(kernel.name)
    return known is not None and known.apply is kernel.apply


def _interpolated(table: dict[int, float], nodes: int) -> float:
    """log-linear between the nodes of the table; a few beyond its end, as it falls there.

    Not below 3e-11: what round-off leaves of sums on grids of so many nodes.
    """
    known = sorted(table)
    logs = np.log([table[k] for k in known])
    if nodes <= known[-1]:
        return float(np.exp(np.interp(nodes, known, logs)))
    slope = (logs[-1] - logs[-2]) / (known[-1] - known[-2])
    further = min(nodes - known[-1], _BEYOND_TABLE)
    return max(float(np.exp(logs[-1] + min(slope, 0.0) * further)), 3e-11)


def _enough_nodes(errors: Errors, eps: float) -> _Far:
    """Fewest nodes whose error is small enough; else those of the smallest error."""
    best = None
    for nodes in range(_LEAST_NODES, MOST_NODES[errors.method] + 1):
        far = _Far(errors.method, nodes, errors.derivative, False, errors(nodes))
        if far.error <= SAFETY * eps:
            return far
        if best is None or far.error < best.error:
            best = far
        elif far.error > 30.0 * best.error:
            break  # round-off has taken over
    return best


def _with_order(errors: Errors, options: FmmOptions) -> _Far:
    nodes = options.order + 1
    return _Far(errors.method, nodes, errors.derivative, False, errors(nodes))


def _in_precision(far: _Far, errors: Errors, eps: float, options: FmmOptions) -> _Far:
    """The same in single precision, if that is asked for or good enough."""
    if options.precision == "double" or not errors.kernel.single:
        return far
    # below this no kernel's single precision is enough: saves the measurement
    if options.precision == "auto" and eps < 1e-6:
        return far
    error = errors(far.nodes, single=True)
    if options.precision == "auto" and error > max(SAFETY * eps, 1.1 * far.error):
        return far
    return _Far(far.method, far.nodes, far.derivative, True, error)


# ---- cost -------------------------------------------------------------------------------------


@functools.cache
def constants() -> dict[str, Any]:
    """Measured errors and nanoseconds, as written by the calibration."""
    return json.loads(resources.files("stokes.fmm").joinpath("constants.json").read_text())


class Cost:
    """Nanoseconds of an application on one thread, from the lengths of the lists."""

    def __init__(
        self, kernel: Kernel, method: str, nodes: int, derivative: str, single: bool
    ) -> None:
        ns = constants()["nanoseconds"]["single" if single else "double"]
        moved = kernel.base if derivative == "interpolated" else kernel
        near = ns["near"].get(kernel.name, ns["near_entry"] * kernel.n_in * kernel.n_out)
        entries, ends = moved.n_in * moved.n_out, moved.n_in + moved.n_out
        self.near = near
        self.nodes = nodes
        self.points = ns["points"] * nodes**3 * ends
        self.passes = ns["passes"] * nodes**4 * ends
        if method == "ufmm":
            rate = ns["product"] if entries == 1 else ns["product_tensor"]
            self.transfer = rate * (2 * nodes - 1) ** 3 * entries
            self.passes += ns["transform"] * nodes**4 * ends
        else:
            self.transfer = ns["matrix"] * nodes**4 * entries

    def of(self, boxes: Boxes, direct_below: int, stride: int) -> float:
        """Nanoseconds with the tree of the points of which every stride-th is in `boxes`."""
        lists = interaction_lists(boxes, direct_below=direct_below)
        count = (boxes.target_count.astype(float), boxes.source_count.astype(float))
        nodes = self.nodes**3 / stride
        pairs = _point_pairs(lists.near, *count)
        pairs += nodes * _point_pairs(lists.multipole_to_target, count[0], np.ones(len(boxes)))
        pairs += nodes * _point_pairs(lists.source_to_local, np.ones(len(boxes)), count[1])
        parents = np.count_nonzero(~boxes.leaf)
        siblings = len(boxes) / max(parents, 1)
        # families of siblings together, 27 products for 64 pairs of which 0.91 are far
        work = min(1.6, 29.7 / siblings**2) * len(lists.far)
        points = 0.5 * (count[0][0] + count[1][0])
        return (
            self.near * pairs * stride**2
            + self.transfer * work
            + self.passes * len(boxes)
            + self.points * points * stride
        )


def _point_pairs(pairs: Pairs, of_target: NDArray, of_source: NDArray) -> float:
    """Sum over pairs of boxes of the product of their counts."""
    return float(np.sum(of_target[pairs.target()] * of_source[pairs.source]))


def _best_leaf(keys: list[tuple[NDArray, int]], stride: int, cost: Cost, direct_below: int) -> int:
    """The cheapest of leaf sizes by factors of sqrt 2, from a first guess downhill."""
    sources, targets = keys[0][0], keys[1][0]
    smallest = max(_SMALLEST_LEAF, _FINEST_SAMPLED_LEAF * stride if stride > 1 else 0)
    known: dict[int, float] = {}

    def nanoseconds(step: int) -> float:
        leaf = round(2.0 ** (0.5 * step))
        if step not in known:
            boxes = build(sources, targets, Splitting(leaf_size=max(1, leaf // stride)))
            known[step] = cost.of(boxes, direct_below // stride, stride)
        return known[step]

    low = int(np.ceil(2.0 * np.log2(smallest)))
    high = max(low, int(2.0 * np.log2(_LARGEST_LEAF)))
    guess = int(np.clip(_guess(cost), low, high))
    # two octaves about the guess: trees over volumes change by factors of 8
    steps = [step for step in range(guess - 6, guess + 7, 2) if low <= step <= high]
    best = min(steps, key=nanoseconds)
    return round(2.0 ** (0.5 * best))


def _guess(cost: Cost) -> int:
    """Twice the binary logarithm of the leaf size that balances U and V in a full tree."""
    per_box = 90.0 * cost.transfer + cost.passes
    return round(2.0 * np.log2(np.sqrt(per_box / (27.0 * cost.near))))


def _sample(
    points: NDArray, origin: NDArray, edge: float, parallel: Parallel
) -> tuple[NDArray[np.int64], int]:
    """Collective. Rising Morton keys of a part of all ranks' points, and one in how many it is.

    Points are drawn by a hash of their keys: which ones does not depend on ranks or order.
    """
    keys = morton.encode(points, origin, edge)
    total = parallel.sum(len(keys))
    stride = 1 << max(0, int(np.ceil(np.log2(max(total, 1) / _SAMPLE))))
    if stride > 1:
        mixed = keys.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        keys = keys[(mixed >> np.uint64(40)) % np.uint64(stride) == 0]
    gathered = parallel.broadcast(parallel.gather(keys))
    return np.sort(np.concatenate(gathered)), stride


def _cube(
    sources: NDArray, targets: NDArray, parallel: Parallel
) -> tuple[NDArray[np.float64], float]:
    """Collective. The cube about all points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in (sources, targets):
        low = np.minimum(low, points.min(axis=0, initial=np.inf))
        high = np.maximum(high, points.max(axis=0, initial=-np.inf))
    low, high = parallel.min(low), parallel.max(high)
    return cube_about(low, high) if np.all(low <= high) else (np.zeros(3), 1.0)
