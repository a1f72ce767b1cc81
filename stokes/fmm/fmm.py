"""Sums phi_i = sum_j k(x_i - y_j) w_j over n sources and m targets in O(n + m).

    plan = Fmm(stokeslet, sources, targets, eps=1e-6)
    velocity = plan.apply(forces)          # any number of times
    plan.estimate_error(forces, velocity)  # against direct sums on sampled targets

The plan fixes points, tree, lists and tables; applying it passes upward through the tree, transfers
between boxes of one level, passes downward and adds the near field (`tree_sum`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from numbers import Real
from types import MappingProxyType

import numpy as np
from numba.core import event
from numba.core.errors import NumbaError
from numpy.typing import ArrayLike, NDArray

from dem_mpi.parallel import Parallel
from stokes.fmm._requests import as_given, checked_points, columns_of, raised_together
from stokes.fmm.backends import Direct, Fmm3d
from stokes.fmm.choice import Choice, choose, not_of_smooth
from stokes.fmm.direct import direct_sum
from stokes.fmm.kernels import Kernel
from stokes.fmm.options import ErrorEstimate, FmmOptions, FmmReport
from stokes.fmm.tree_sum import TreeSum

_SAMPLE_SEED = 20170405


class Fmm:
    """A plan for sums of one kernel over fixed points, to a relative error eps in the 2-norm."""

    def __init__(
        self,
        kernel: Kernel,
        sources: ArrayLike,
        targets: ArrayLike | None = None,
        eps: float = 1e-6,
        options: FmmOptions | None = None,
        parallel: Parallel | None = None,
    ) -> None:
        """Collective over `parallel` (default: this process alone).

        kernel  : from `stokes.fmm.kernels`, or one of your own
        sources : (n, 3), targets (m, 3), this rank's, in any unit; None for the sources themselves.
                  A singular kernel leaves out the term of a source that coincides with the target
                  Distances, in the unit, between 1e-150 and 1e150: their squares must not vanish
        eps     : ||u - u_direct||_2 / ||u_direct||_2 over all targets that is aimed at

        Raises ValueError for points that are not finite or not (n, 3), eps outside (0, 1),
        options that exclude each other, and a kernel, eps or options that are not the same on all
        ranks; on all ranks.
        """
        self.kernel = kernel
        self.options = options or FmmOptions()
        self.eps = eps
        if not isinstance(parallel, Parallel | None):
            raise TypeError("parallel: must be a dem_mpi.parallel.Parallel of a communicator")
        self._parallel = parallel or Parallel.alone()
        self._compile_seconds = 0.0
        with raised_together(self._parallel), self._compiling():
            self._sources = checked_points("sources", sources)
            self._targets = None if targets is None else checked_points("targets", targets)
            _check_request(kernel, eps, self.options, self._parallel)
        _check_agreement(kernel, eps, self.options, self._parallel)
        with self._compiling():
            self._build()

    def __repr__(self) -> str:
        """Kernel, this rank's points, the asked error, and how it is reached."""
        sources, targets = len(self._sources), len(self._points)
        points = f"{sources} points" if self._targets is None else f"{sources} to {targets} points"
        how = f"backend={self.options.backend!r}"
        if self._choice is not None:
            how = f"{self._choice.scheme.method}, {self._choice.scheme.nodes} nodes"
        return f"<Fmm {self.kernel.name}, {points}, eps={self.eps:.3g}, {how}>"

    @property
    def _points(self) -> NDArray:
        """The targets (m, 3)."""
        return self._sources if self._targets is None else self._targets

    def _build(self) -> None:
        threads = self.options.threads
        self._choice: Choice | None = None
        if self.options.backend == "direct":
            self._sum = Direct(self.kernel, self._sources, self._points, self._parallel, threads)
        elif self.options.backend == "fmm3d":
            self._sum = Fmm3d(self.kernel, self._sources, self._targets, self.eps)
        else:
            self._choice = choose(
                self.kernel, self._sources, self._points, self.eps, self.options, self._parallel
            )
            self._warn_of_error()
            self._sum = TreeSum(
                self.kernel,
                self._sources,
                self._targets,
                self._choice.scheme,
                self._parallel,
                threads,
            )

    def _warn_of_error(self) -> None:
        """Say it where the asked error cannot be reached; who gave the order knows why."""
        expected = self._choice.expected_error
        if expected > self.eps and self.options.order is None:
            warnings.warn(
                f"eps = {self.eps:.1e} is out of reach for the kernel {self.kernel.name}: "
                f"expected error {expected:.1e}",
                RuntimeWarning,
                stacklevel=4,
            )

    def apply(self, weights: ArrayLike) -> NDArray:
        """Collective. The sums at this rank's targets.

        weights: (n, n_in), (n, n_in, r) for r right-hand sides, or (n,) if n_in = 1. Returns
        (m, n_out), (m, n_out, r), or (m,) if weights are (n,) and n_out = 1. Values are finite for
        finite weights; one weight that is not can make all values of its column NaN.

        Raises ValueError, on all ranks, for weights of another shape or complex ones.
        """
        columns = columns_of(self.kernel, weights, len(self._sources), self._parallel)
        with self._compiling():
            values = self._sum.apply(columns)
        return as_given(self.kernel, weights, values)

    def estimate_error(
        self, weights: ArrayLike, values: ArrayLike, samples: int = 1000, seed: int = _SAMPLE_SEED
    ) -> ErrorEstimate:
        """Collective. Compare `values = apply(weights)` with direct sums on sampled targets.

        Targets are drawn without repetition, in proportion to what each rank has; of all of them
        the estimate is the error itself. O(samples n).

        Raises ValueError, on all ranks, for weights or values of another shape, or no samples.
        """
        columns = columns_of(self.kernel, weights, len(self._sources), self._parallel)
        with raised_together(self._parallel):
            if samples < 1:
                raise ValueError(f"samples = {samples}: must be >= 1")
            given = self._as_applied(values, columns.shape[2])
        mine = self._sampled(samples, seed)
        exact = direct_sum(
            self.kernel,
            self._sources,
            self._points[mine],
            columns,
            parallel=self._parallel,
            threads=self.options.threads,
        )
        difference = given[mine] - exact
        # scaled by the largest value: squares of extreme magnitudes would leave the range
        largest = self._parallel.max(float(np.abs(exact).max(initial=0.0)))
        worst = self._parallel.max(float(np.abs(difference).max(initial=0.0)))
        scale = largest or 1.0
        squares = [np.sum((a / scale) ** 2) for a in (difference, exact)]
        squares = self._parallel.sum(np.array(squares))
        return ErrorEstimate(
            relative_l2=_ratio(float(np.sqrt(squares[0])), float(np.sqrt(squares[1]))),
            relative_max=_ratio(worst, largest),
            samples=self._parallel.sum(len(mine)),
        )

    def _as_applied(self, values: ArrayLike, r: int) -> NDArray[np.float64]:
        """Values of `apply` as (m, n_out, r)."""
        array, shape = np.asarray(values, dtype=np.float64), (len(self._points), self.kernel.n_out)
        if array.shape not in ((*shape, r), shape, shape[:1]) or array.size != math.prod(shape) * r:
            raise ValueError(f"values of shape {array.shape}: must be what `apply(weights)` gives")
        return array.reshape(*shape, r)

    def _sampled(self, samples: int, seed: int) -> NDArray[np.int64]:
        """Targets of this rank that are in the sample."""
        own = len(self._points)
        total, before = self._parallel.sum(own), self._parallel.exclusive_sum(own)
        # unlike a permutation, `choice` of few needs no memory for all targets of all ranks
        drawn = np.random.default_rng(seed).choice(total, min(samples, total), replace=False)
        return np.sort(drawn[(drawn >= before) & (drawn < before + own)]) - before

    @property
    def apply_seconds(self) -> Mapping[str, float]:
        """Wall-clock seconds by stage, over all applications so far, compilation included."""
        return MappingProxyType(getattr(self._sum, "apply_seconds", {}))

    @property
    def report(self) -> FmmReport:
        """What the plan is made of, on this rank."""
        common = {"kernel": self.kernel.name, "compile_seconds": self._compile_seconds}
        if self._choice is None:
            direct = self.options.backend == "direct"
            error = float(np.finfo(np.float64).eps) if direct else self.eps
            return FmmReport(method=self.options.backend, expected_error=error, **common)
        scheme, plan = self._choice.scheme, self._sum
        return FmmReport(
            method=scheme.method,
            expected_error=self._choice.expected_error,
            why=self._choice.why,
            nodes=scheme.nodes,
            precision="single" if scheme.single else "double",
            derivative=scheme.derivative,
            admissibility=scheme.admissibility,
            near="recomputed" if plan.near_matrices is None else "cached",
            leaf_size=scheme.splitting.leaf_size,
            depth=plan.boxes.depth,
            boxes=len(plan.boxes),
            pairs=plan.pair_counts(),
            memory=plan.memory(),
            plan_seconds=dict(plan.plan_seconds),
            **common,
        )

    @contextmanager
    def _compiling(self) -> Iterator[None]:
        """Count the seconds that kernels are compiled for."""
        with event.install_recorder("numba:compile") as record:
            try:
                yield
            finally:
                self._compile_seconds += _outermost_seconds(record.buffer)


def _outermost_seconds(buffer: list) -> float:
    """Seconds between start and end of events, those inside another one left out."""
    seconds, depth, begin = 0.0, 0, 0.0
    for moment, what in buffer:
        if what.is_start:
            begin = moment if depth == 0 else begin
            depth += 1
        else:
            depth -= 1
            seconds += moment - begin if depth == 0 else 0.0
    return seconds


def _ratio(part: float, whole: float) -> float:
    """part / whole; 0 if both vanish."""
    if whole > 0.0:
        return part / whole
    return 0.0 if part == 0.0 else np.inf


def _check_request(kernel: Kernel, eps: float, options: FmmOptions, parallel: Parallel) -> None:
    if not isinstance(kernel, Kernel):
        raise TypeError(f"kernel = {kernel!r}: must be a Kernel, such as KERNELS['stokeslet']")
    if not isinstance(options, FmmOptions):
        raise TypeError(f"options = {options!r}: must be FmmOptions")
    if not (isinstance(eps, Real) and 0.0 < eps < 1.0):
        raise ValueError(f"eps = {eps!r}: must be a number between 0 and 1")
    if options.derivative == "interpolated" and kernel.base is None:
        raise ValueError(f"kernel {kernel.name} is not a derivative: derivative must be 'exact'")
    if options.admissibility == "smooth" and not kernel.smooth:
        raise ValueError(f"kernel {kernel.name} is not smooth at the origin: it has a near field")
    if options.admissibility == "smooth" and not_of_smooth(options):
        names = ", ".join(not_of_smooth(options))
        raise ValueError(f"admissibility 'smooth' excludes the options given for: {names}")
    if options.precision == "single" and not kernel.single:
        raise ValueError(f"kernel {kernel.name} has no form in single precision")
    if options.backend == "fmm3d" and parallel.size > 1:
        raise ValueError("backend 'fmm3d' works on one rank only")
    _check_function(kernel)


def _check_function(kernel: Kernel) -> None:
    """Raise ValueError for a kernel's function that does not compile, or not vanish at r = 0."""
    try:
        at_origin = kernel.matrix(np.zeros((1, 3)))
    except NumbaError as fault:
        raise ValueError(
            f"kernel {kernel.name}: its function does not compile; it must be decorated with "
            f"numba.extending.register_jitable, or: {fault}"
        ) from fault
    if not np.isfinite(at_origin).all():
        raise ValueError(
            f"kernel {kernel.name}: is not finite at r = 0, where it must be 0 if it is singular; "
            "write it in powers of stokes.fmm.kernels.inverse_distance"
        )


def _check_agreement(kernel: Kernel, eps: float, options: FmmOptions, parallel: Parallel) -> None:
    """Collective. Raise ValueError on all ranks where they do not ask for the same sum."""
    if parallel.size == 1:
        return
    same = replace(options, threads=1)  # each rank's own
    request = f"kernel {kernel.name}, length {kernel.length}, factor {kernel.factor}, {eps}, {same}"
    first = parallel.broadcast(request)
    with raised_together(parallel):
        if request != first:
            raise ValueError(f"not the same on all ranks: {request}; on rank 0 {first}")
