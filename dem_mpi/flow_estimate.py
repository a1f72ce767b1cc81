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

from dem_mpi.errors import InputError
from dem_mpi.flow_options import FlowOptions
from dem_mpi.h5files import readable_size
from dem_mpi.parallel import Parallel

if TYPE_CHECKING:
    from stokes.suspension import Suspension

# ---- memory [B] ----------------------------------------------------------------------------

_BASE = 260 << 20  # interpreter, numpy, numba and its code, MPI, PETSc, HDF5
_MATRICES = {"single": 2, "combined": 4}  # of a level at one time: assembled, and factored
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
    n, b = parallel.max(np.array([suspension.offsets[-1], len(suspension.bodies)])).tolist()
    own_points = -(-points // parallel.size)
    layers = 2 if options.formulation == "combined" else 1
    digits = -math.log10(report.tolerances.residual)
    iterations = _iterations(suspension, digits)
    gap = min(max(report.least_gap, 1e-3), _FARTHEST)
    close = gap < _CLOSE
    sizes = np.array(
        [(3 * level.resolution.panels * level.resolution.nodes, level.resolution.modes + 1)
         for level in report.levels]
    )  # fmt: skip
    entries = float((sizes[:, 0] ** 2 * sizes[:, 1]).sum())
    flops = float((2.0 / 3.0 * sizes[:, 0] ** 3 * sizes[:, 1]).sum())
    basis = min(iterations, suspension.options.restart) + _VECTORS
    node = 8 * 3 * basis + layers * (_SUM_NODE * (digits / 3.0) ** 2.5 + _NEAR_NODE / gap**0.5)
    memory = _BASE + 8 * _MATRICES[options.formulation] * entries + node * n
    product = layers * n * (_SUM_APPLY * digits / 3.0 + close * _NEAR_APPLY)
    product += 4.0 * _FLOP * entries * b / len(report.levels)  # with matrices of the mean level
    seconds = (
        _START
        + _ENTRY * layers * entries / 9.0
        + _FLOP * flops
        + close * _NEAR_PLAN * layers * n
        + iterations * product
        + 2.0 * own_points * layers * _SUM_APPLY * digits / 3.0
    )
    return FlowEstimate(
        bodies=report.bodies,
        nodes=report.nodes,
        levels=len(report.levels),
        points=points,
        iterations=iterations,
        memory=round(memory + _FIELD_POINT * own_points),
        seconds=seconds,
        file=flow_bytes(report.bodies, report.nodes, points),
        ranks=parallel.size,
        share=share,
    )


def _iterations(suspension: Suspension, digits: float) -> int:
    """One body alone is inverted exactly; 1.25 b^1/6 g^-1/2 a digit for b bodies, or a third."""
    report = suspension.report
    if report.bodies == 1:
        return 1
    gap = min(max(report.least_gap, 1e-3), _FARTHEST)
    each = 1.25 * report.bodies ** (1.0 / 6.0) / gap**0.5
    if suspension.options.preconditioner == "neighbours":
        each /= 3.0
    return min(math.ceil(digits * max(1.0, each)), suspension.options.max_iterations)
