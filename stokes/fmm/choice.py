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
from stokes.fmm.close_pairs import close_distance
from stokes.fmm.kernels import KERNELS, Kernel
from stokes.fmm.lists import Pairs, interaction_lists
from stokes.fmm.options import FmmOptions, Near
from stokes.fmm.symmetry import VECTORS
from stokes.fmm.tree import Boxes, Splitting, build, corners, cube_about
from stokes.fmm.tree_sum import Scheme, grid_of, single_pairs

# Errors are measured on small clouds: a plan aims at this fraction of the asked one.
SAFETY = 0.8
# Most nodes tried. Equispaced polynomials lose a digit to round-off every 3 nodes.
MOST_NODES = {"ufmm": 18, "bbfmm": 20, "symmetric": 20}
# Of tensors on Chebyshev grids: beyond it operators of low rank take minutes to find.
_MOST_TENSOR_NODES = 14
_LEAST_NODES = 3
# Nodes with which the round-off of single precision is measured; it grows with more.
ROUND_OFF_NODES = 7
_BEYOND_TABLE = 4
# Sums without near field: most points that are summed sooner than samples are taken, deepest
# tree, largest leaf in kernel lengths.
_WORTH_SAMPLES, _SMOOTH_DEPTHS, _SMOOTH_EDGE = 50_000, 5, 2.0
# Near matrices take memory and time to be made: how much faster than computing reading must be.
_WORTH_STORING = 1.3
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
    edge /= kernel.length
    far, why = _choose_far(kernel, eps, options, edge)
    total = max(parallel.sum(len(points)) for points in (sources, targets))
    if _may_be_smooth(kernel, far, options, total):
        smooth = _smooth_plan(kernel, eps, options, edge, total)
        if smooth is not None:
            return smooth
    direct_below = far.nodes**3
    if options.depth is not None:
        splitting = Splitting(depth=options.depth)
    elif options.leaf_size is not None:
        splitting = Splitting(leaf_size=options.leaf_size)
    else:
        keys, stride = _sample([sources, targets], origin, edge * kernel.length, parallel)
        cost = Cost(kernel, far.method, far.nodes, far.derivative, far.single)
        splitting = Splitting(leaf_size=_best_leaf(keys, stride, cost, direct_below))
    scheme = Scheme(
        method=far.method,
        nodes=far.nodes,
        splitting=splitting,
        single=far.single,
        derivative=far.derivative,
        direct_below=direct_below,
        operator_eps=operator_eps(far.nodes),
        close=close_distance(eps),
        near=_near(kernel, far.single, options),
        near_memory=options.near_memory,
    )
    return Choice(scheme, far.error, why)


def _near(kernel: Kernel, single: bool, options: FmmOptions) -> Near:
    """What is asked of near matrices; "auto" only where an application is faster with them."""
    if options.near != "auto":
        return options.near
    ns = constants()["nanoseconds"]["single" if single else "double"]
    if not _is_built_in(kernel) or kernel.name not in ns["near"]:
        return "recomputed"
    read = ns["stored"] * kernel.n_in * kernel.n_out
    return "auto" if ns["near"][kernel.name] > _WORTH_STORING * read else "recomputed"


# ---- kernels smooth at the origin ---------------------------------------------------------------


def _may_be_smooth(kernel: Kernel, far: _Far, options: FmmOptions, points: int) -> bool:
    """Whether a sum without near field is asked for, or worth the samples that it takes."""
    if options.admissibility != "auto":
        return options.admissibility == "smooth"
    free = options.depth is None and options.order is None and not not_of_smooth(options)
    return kernel.smooth and free and far.method == "ufmm" and points >= _WORTH_SAMPLES


def not_of_smooth(options: FmmOptions) -> list[str]:
    """Names of options that are given and mean nothing without near field, in double precision."""
    given = {
        "leaf_size": options.leaf_size is not None,
        "precision": options.precision == "single",
        "derivative": options.derivative == "interpolated",
        "near": options.near == "cached",
    }
    return [name for name, is_given in given.items() if is_given]


def _smooth_plan(
    kernel: Kernel, eps: float, options: FmmOptions, edge: float, points: int
) -> Choice | None:
    """The cheapest uniform tree without near field; None if none reaches the error by itself.

    Transfers are between all 343 neighbours at the leaves; fewer nodes do as leaves shrink.
    """
    method = "ufmm" if options.method == "auto" else options.method
    asked = options.admissibility == "smooth"
    depths = [options.depth] if options.depth is not None else range(1, _SMOOTH_DEPTHS + 1)
    best: tuple[float, Choice] | None = None
    for depth in depths:
        leaf_edge = edge * 0.5**depth
        if options.depth is None and leaf_edge > _SMOOTH_EDGE:
            continue
        nodes, error = _smooth_nodes(kernel, method, eps, options, leaf_edge)
        scheme = Scheme(
            method=method,
            nodes=nodes,
            splitting=Splitting(depth=depth),
            admissibility="smooth",
            operator_eps=operator_eps(nodes),
        )
        choice = Choice(scheme, error, "the kernel is smooth at the origin: no near field")
        cost = Cost(kernel, method, nodes, "exact", single=False).smooth(depth, points)
        reached = error <= SAFETY * eps or options.order is not None or options.depth is not None
        if reached and (best is None or cost < best[0]):
            best = (cost, choice)
    if best is None and asked:
        raise ValueError(
            f"kernel {kernel.name}: no tree of at most {_SMOOTH_DEPTHS} levels reaches {eps:.0e} "
            f"without near field over a cube of {edge:.3g} kernel lengths; give `depth`, or the "
            "admissibility 'standard'"
        )
    return None if best is None else best[1]


def _smooth_nodes(
    kernel: Kernel, method: str, eps: float, options: FmmOptions, leaf_edge: float
) -> tuple[int, float]:
    """Fewest nodes, and their error, of a sample of 2^3 leaves that all touch."""
    found = (0, np.inf)
    nodes = [options.order + 1] if options.order else range(_LEAST_NODES, 15)
    for count in nodes:
        scheme = Scheme(
            method=method,
            nodes=count,
            splitting=Splitting(depth=1),
            admissibility="smooth",
            operator_eps=operator_eps(count),
        )
        error = sum_error(kernel, scheme, "cube", 2.0 * leaf_edge)
        if error < found[1]:
            found = (count, error)
        if error <= SAFETY * eps:
            break
    return found


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
            return min(good, key=lambda far: _transfer_work(kernel, far)), _reason(options, method)
        closest = min(found, key=lambda far: far.error)
        best = closest if best is None or closest.error < best.error else best
    return best, (
        f"no grid of {methods[-1]} reaches {eps:.0e}: the most accurate one known, "
        f"expected error {best.error:.1e}"
    )


def _reason(options: FmmOptions, method: str) -> str:
    if options.order:
        return f"order {options.order} was asked for, whatever error it reaches"
    if options.method != "auto":
        return f"{method} was asked for"
    if method == "ufmm":
        return "equispaced grids reach the error"
    return "equispaced grids are unstable for this error"


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
        self._samples: dict[tuple[int, bool], float] = {}

    def __call__(self, nodes: int, single: bool = False) -> float:
        """Largest relative error measured with so many nodes."""
        if single:
            gain = grid_of(self.method, nodes).noise_gain
            gain /= grid_of(self.method, ROUND_OFF_NODES).noise_gain
            return float(np.hypot(self(nodes), max(gain, 1.0) * self._round_off))
        if self._known:
            # differentiated polynomials meet round-off sooner: no errors but the measured ones
            beyond = 0 if self.derivative == "interpolated" else _BEYOND_TABLE
            return max(_interpolated(row, nodes, beyond) for row in self._rows)
        return self._measured(nodes, False)

    @functools.cached_property
    def _round_off(self) -> float:
        """What single precision adds."""
        known = constants()["single"].get(self.kernel.name) if self._known else None
        return known or max(self._measured(ROUND_OFF_NODES, True), 1e-6)

    def _measured(self, nodes: int, single: bool) -> float:
        if (nodes, single) not in self._samples:
            scheme = sample_scheme(self.method, nodes, self.derivative, single)
            errors = [sum_error(self.kernel, scheme, "cube", edge) for edge in self._edges]
            self._samples[nodes, single] = max(errors)
        return self._samples[nodes, single]


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
    enough = next((k for k, size in enumerate(SAMPLE_EDGES) if size >= edge), len(SAMPLE_EDGES))
    return list(SAMPLE_EDGES[max(0, enough - 1) : enough + 1])


def _is_built_in(kernel: Kernel) -> bool:
    """Whether it is one of the package's kernels, whatever its length and factor."""
    known = KERNELS.get(kernel.name)
    return known is not None and known.apply is kernel.apply


def _interpolated(table: dict[int, float], nodes: int, beyond: int) -> float:
    """log-linear between the nodes of the table; up to `beyond` after its end, as it falls there.

    Not below 3e-11: what round-off leaves of sums on grids of so many nodes.
    """
    known = sorted(table)
    logs = np.log([table[k] for k in known])
    if nodes <= known[-1]:
        return float(np.exp(np.interp(nodes, known, logs)))
    slope = (logs[-1] - logs[-2]) / (known[-1] - known[-2])
    further = min(nodes - known[-1], beyond)
    return max(float(np.exp(logs[-1] + min(slope, 0.0) * further)), 3e-11)


def _enough_nodes(errors: Errors, eps: float) -> _Far:
    """Fewest nodes whose error is small enough; else those of the smallest error."""
    best = None
    most = MOST_NODES[errors.method]
    if errors.method != "ufmm" and errors.kernel.n_in * errors.kernel.n_out > 1:
        most = _MOST_TENSOR_NODES
    for nodes in range(_LEAST_NODES, most + 1):
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
    # below this no kernel's single precision is enough in all clouds: in clusters round-off of
    # the far field grew to 6e-5 with 9 nodes
    if options.precision == "auto" and eps < 1e-5:
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
        pairs = ns if single_pairs(kernel) else constants()["nanoseconds"]["double"]
        near = pairs["near"].get(kernel.name, pairs["near_entry"] * kernel.n_in * kernel.n_out)
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

    def of(self, boxes: Boxes, direct_below: int, stride: int) -> tuple[float, float]:
        """Nanoseconds with the tree of the points of which every stride-th is in `boxes`.

        The first are of what is done point by point, the second of what is done box by box.
        """
        lists = interaction_lists(boxes, direct_below=direct_below, far_counted=True)
        count = (boxes.target_count.astype(float), boxes.source_count.astype(float))
        nodes = self.nodes**3 / stride
        pairs = _point_pairs(lists.near, *count)
        pairs += nodes * _point_pairs(lists.multipole_to_target, count[0], np.ones(len(boxes)))
        pairs += nodes * _point_pairs(lists.source_to_local, np.ones(len(boxes)), count[1])
        parents = np.count_nonzero(~boxes.leaf)
        siblings = len(boxes) / max(parents, 1)
        # families of siblings together, 27 products for 64 pairs of which 0.91 are far
        work = min(1.6, 29.7 / siblings**2) * lists.far.start[-1]
        points = 0.5 * (count[0][0] + count[1][0])
        return (
            self.near * pairs * stride**2 + self.points * points * stride,
            self.transfer * work + self.passes * len(boxes),
        )

    def smooth(self, depth: int, points: int) -> float:
        """Nanoseconds of a full uniform tree whose leaves have all 343 transfers."""
        boxes = 8.0**depth
        return (VECTORS * self.transfer + 1.15 * self.passes) * boxes + self.points * points


def _point_pairs(pairs: Pairs, of_target: NDArray, of_source: NDArray) -> float:
    """Sum over pairs of boxes of the product of their counts."""
    sums = np.append(0.0, np.cumsum(of_source[pairs.source]))
    return float(np.dot(of_target, np.diff(sums[pairs.start])))


def _best_leaf(keys: list[NDArray], stride: int, cost: Cost, direct_below: int) -> int:
    """The cheapest of leaf sizes by factors of sqrt 2, from the largest down.

    More boxes take longer in the far field, by their number at least: trees are refined until
    that alone would take longer than the best of them.
    """
    smallest = max(_SMALLEST_LEAF, _FINEST_SAMPLED_LEAF * stride if stride > 1 else 0)
    best, fastest, known, far = _LARGEST_LEAF, np.inf, 0, 0.0
    low, high = (int(np.ceil(2.0 * np.log2(leaf))) for leaf in (smallest, _LARGEST_LEAF))
    for step in range(max(low, high), low - 1, -1):
        leaf = round(2.0 ** (0.5 * step))
        boxes = build(*keys, Splitting(leaf_size=max(1, leaf // stride)))
        if len(boxes) == known:
            continue  # trees contain each other: it is the same
        if far * len(boxes) >= fastest * known:
            break
        near, far = cost.of(boxes, direct_below // stride, stride)
        known = len(boxes)
        if near + far < fastest:
            best, fastest = leaf, near + far
    return best


def _sample(
    point_sets: list[NDArray], origin: NDArray, edge: float, parallel: Parallel
) -> tuple[list[NDArray[np.int64]], int]:
    """Collective. Rising Morton keys of a part of all ranks' points, and one in how many it is.

    Points are drawn by a hash of their keys: which ones does not depend on ranks or order.
    """
    one_set = not parallel.any(point_sets[0] is not point_sets[1])
    keys = [morton.encode(x, origin, edge) for x in point_sets[: 1 if one_set else 2]]
    most = max(parallel.sum(len(k)) for k in keys)
    stride = 1 << max(0, int(np.ceil(np.log2(max(most, 1) / _SAMPLE))))
    samples = []
    for drawn in keys:
        if stride > 1:
            mixed = drawn.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
            drawn = drawn[(mixed >> np.uint64(40)) % np.uint64(stride) == 0]
        samples.append(np.sort(np.concatenate(parallel.broadcast(parallel.gather(drawn)))))
    return [samples[0], samples[-1]], stride


def _cube(
    sources: NDArray, targets: NDArray, parallel: Parallel
) -> tuple[NDArray[np.float64], float]:
    """Collective. The cube about all points."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for points in (sources, targets):
        lowest, highest = corners(points)
        low, high = np.minimum(low, lowest), np.maximum(high, highest)
    low, high = parallel.min(low), parallel.max(high)
    return cube_about(low, high) if np.all(low <= high) else (np.zeros(3), 1.0)
