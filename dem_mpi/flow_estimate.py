"""What a Stokes step would take, told from counts: nodes, memory, seconds. No clock is read.

Nodes are exact: gaps between bodies and the tolerance decide them, and both are known before any
work on surfaces. Memory is what matrices of shapes, GMRES's vectors, near corrections and fast sums
take, with a base for interpreter and libraries. Seconds come from stored costs of one core of an
AMD EPYC. Iterations are the least certain part: they grow with closeness and number of the bodies,
here as for spheres on cubic grids, 8 to 64 of them, moving at random, which is hard; bodies that
move alike take fewer. In these cases (g from 0.01 to 1, tolerances from 1e-3 to 1e-6, both
formulations) memory came out within 20 %, iterations within 10 %, seconds within a factor 2.

Symbols: n nodes and b bodies of the fullest rank; n_s nodes on a meridian, M modes of a level; gaps
g over the smaller body's size, the least of all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from dem_mpi.errors import InputError
from dem_mpi.flow_options import FlowOptions
from dem_mpi.h5files import readable_size
from dem_mpi.parallel import Parallel

if TYPE_CHECKING:
    from stokes.suspension import Suspension

# ---- memory [B] ----------------------------------------------------------------------------

_BASE = 260 << 20  # interpreter, numpy, numba and its code, MPI, PETSc, HDF5
_MATRICES = {1: 2, 2: 4}  # of a level at one time, for so many layers: assembled, and factored
_VECTORS = 16  # beside those of GMRES's basis
_SUM_NODE = 800  # for a layer, to three digits; as the 2.5th power of the digits
_NEAR_NODE = 170  # for a layer at g = 1; as g^-1/2
_FIELD_POINT = 500
_DOUBT = 1.5  # estimates this much over what there is are refused

# ---- seconds -------------------------------------------------------------------------------

_START = 0.3
_ENTRY = 1e-6  # of a modal matrix, assembled: (M + 1) n_s^2 for a level
_FLOP = 2e-10  # of factors and of products with them
_NEAR_PLAN = 2e-5  # a node of close bodies
_NEAR_APPLY = 3e-6  # with the preconditioner
_SUM_APPLY = 1.6e-6  # a node, for a layer, to three digits; as the digits
_CLOSE = 0.1  # g from which on near corrections count
_FARTHEST = 4.0  # g from which on bodies hardly feel each other


@dataclass(frozen=True)
class FlowEstimate:
    """What solving would take; memory and seconds are those of the fullest of `ranks` ranks.

    levels : curves and resolutions, for each of which matrices are made; share : memory a rank may
    use [B]; file : size of the flow file [B]
    """

    bodies: int
    nodes: int
    levels: int
    points: int
    iterations: int
    memory: int
    seconds: float
    file: int
    ranks: int
    share: int

    @property
    def contents(self) -> str:
        """What the flow file holds."""
        field = f", {self.points:,} points of the field" if self.points else ""
        several = "bodies" if self.bodies > 1 else "body"
        return f"{self.bodies:,} {several}, {self.nodes:,} nodes{field}"

    def lines(self) -> list[str]:
        """What there is to say, one fact a line."""
        ranks = f"{self.ranks} ranks" if self.ranks > 1 else "1 rank"
        kinds = f"{self.levels} resolution{'s' if self.levels > 1 else ''}"
        return [
            f"nodes    {self.nodes:,} on {self.bodies:,} surfaces of {kinds}, "
            f"{3 * self.nodes:,} unknowns",
            f"memory   about {readable_size(self.memory)} a rank on {ranks} (estimate)",
            f"seconds  about {self.seconds:.2g}, {self.iterations} iterations (estimate)",
            f"file     {readable_size(self.file)}",
        ]

    def refuse_what_does_not_fit(self) -> None:
        """Raise InputError where a rank would need far more memory than its share."""
        if self.memory > _DOUBT * self.share:
            raise InputError(
                f"{self.nodes:,} nodes would take about {readable_size(self.memory)} a rank, and "
                f"this machine has {readable_size(self.share)}: take fewer bodies (--bodies, "
                "--region), wider gaps (a smaller --hydrodynamic-radius), a looser --tolerance, a "
                "coarser --grid, or more machines"
            )


def estimate_flow(
    parallel: Parallel, suspension: Suspension, options: FlowOptions, points: int, share: int
) -> FlowEstimate:
    """Collective. Estimate a solution of a suspension that has not been solved.

    points : of the field, on all ranks; share : memory that a rank may use [B]
    """
    from stokes.flow_file import flow_bytes

    report = suspension.report
    work = _Work.of(parallel, suspension, options, -(-points // parallel.size))
    return FlowEstimate(
        bodies=report.bodies,
        nodes=report.nodes,
        levels=len(report.levels),
        points=points,
        iterations=work.iterations,
        memory=round(work.memory),
        seconds=work.seconds,
        file=flow_bytes(report.bodies, report.nodes, points),
        ranks=parallel.size,
        share=share,
    )


@dataclass(frozen=True)
class _Work:
    """What the fullest rank has to do.

    nodes n, bodies b, points of the field; layers on a surface; digits of the tolerance; gap g
    rows, modes : (levels,) 3 n_s and M + 1, of the matrices of each level
    basis       : vectors that GMRES keeps
    """

    nodes: int
    bodies: int
    points: int
    layers: int
    digits: float
    gap: float
    rows: NDArray
    modes: NDArray
    iterations: int
    basis: int

    @classmethod
    def of(
        cls, parallel: Parallel, suspension: Suspension, options: FlowOptions, points: int
    ) -> _Work:
        """Collective. Count."""
        report = suspension.report
        own = np.array([suspension.offsets[-1], len(suspension.bodies)])
        nodes, bodies = parallel.max(own).tolist()
        digits = -math.log10(report.tolerances.residual)
        iterations = _iterations(suspension, digits)
        grids = [level.resolution for level in report.levels]
        return cls(
            nodes=nodes,
            bodies=bodies,
            points=points,
            layers=2 if options.formulation == "combined" else 1,
            digits=digits,
            gap=_gap(suspension),
            rows=np.array([3.0 * grid.panels * grid.nodes for grid in grids]),
            modes=np.array([grid.modes + 1.0 for grid in grids]),
            iterations=iterations,
            basis=min(iterations, suspension.options.restart) + _VECTORS,
        )

    @property
    def entries(self) -> float:
        """Of one matrix of every level."""
        return float(self.rows**2 @ self.modes)

    @property
    def memory(self) -> float:
        """Largest resident size [B]."""
        sums = self.layers * _SUM_NODE * (self.digits / 3.0) ** 2.5
        near = self.layers * _NEAR_NODE / math.sqrt(self.gap)
        matrices = 8 * _MATRICES[self.layers] * self.entries
        return (
            _BASE
            + matrices
            + self.nodes * (8 * 3 * self.basis + sums + near)
            + _FIELD_POINT * self.points
        )

    @property
    def seconds(self) -> float:
        """Of one core."""
        close = self.layers * self.nodes * (self.gap < _CLOSE)
        sums = _SUM_APPLY * self.digits / 3.0 * self.layers
        preparation = (
            _START
            + _ENTRY * self.layers * self.entries / 9.0
            + _FLOP * 2.0 / 3.0 * float(self.rows**3 @ self.modes)
            + _NEAR_PLAN * close
        )
        # A body multiplies with a matrix and a factor of its level, here of the mean one.
        own = 4.0 * _FLOP * self.entries * self.bodies / len(self.rows)
        product = sums * self.nodes + _NEAR_APPLY * close + own
        return preparation + self.iterations * product + 2.0 * sums * self.points


def _gap(suspension: Suspension) -> float:
    """The least gap, between what is resolved and what is felt."""
    return min(max(suspension.report.least_gap, 1e-3), _FARTHEST)


def _iterations(suspension: Suspension, digits: float) -> int:
    """One body alone is inverted exactly; 1.25 b^1/6 g^-1/2 a digit for b bodies, or a third."""
    report = suspension.report
    if report.bodies == 1:
        return 1
    each = 1.25 * report.bodies ** (1.0 / 6.0) / math.sqrt(_gap(suspension))
    if suspension.options.preconditioner == "neighbours":
        each /= 3.0
    return min(math.ceil(digits * max(1.0, each)), suspension.options.max_iterations)
