"""What solving a suspension would take, counted from its resolutions without any work on surfaces.

Symbols: M modes, n_s nodes on a meridian; matrices of a shape have (M + 1) (3 n_s)^2 entries.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dem_mpi.parallel import Parallel
from stokes.sources import UnitShape
from stokes.suspension_options import (
    FormulationName,
    SuspensionEstimate,
    SuspensionOptions,
    Tolerances,
)
from stokes.suspension_scene import Scene

_FLOAT = 8
_KEPT = 2  # matrices of a shape: factorisation, and exact less plain operator
_ASSEMBLED = 4  # more of them, of one shape at a time, while it is assembled
_VECTORS = 30  # of a usual GMRES solution, and work
_FIELDS = 12  # densities, velocities, weights, points of a node, three numbers each
# Near matrices and tables of a fast sum, bytes a node: measured at 1e-4 .. 1e-8 on clusters.
_FMM_FIXED, _FMM_NEAR = 2e3, 1.4e4
# Of the nodes of a body, those in the gap to one close neighbour; panels each of them sees.
_IN_GAP, _PANELS = 0.1, 2.0


def estimate(
    scene: Scene,
    formulation: FormulationName,
    tolerances: Tolerances,
    options: SuspensionOptions,
    parallel: Parallel,
) -> SuspensionEstimate:
    """Collective. Bytes and operations of the rank that has most of each."""
    own = scene.shape[scene.table.own]
    nodes = int(scene.nodes[scene.table.own].sum())
    used = [scene.shapes[k] for k in np.unique(own).tolist()]
    sizes = [matrix_entries(shape) for shape in used]
    layers = 1 if formulation == "single" else 2
    fmm = _FMM_FIXED + min(_FMM_NEAR, options.fmm.near_memory / max(nodes, 1))
    mine = np.array(
        [
            _FLOAT * (_KEPT * sum(sizes) + _ASSEMBLED * max(sizes, default=0)),
            _FLOAT * 3 * nodes * (min(_VECTORS, options.restart) + _FIELDS),
            _near_bytes(scene),
            layers * fmm * nodes,
            sum(_factorisation(shape) for shape in used),
        ]
    )
    most = parallel.max(mine)
    return SuspensionEstimate(
        bodies=scene.table.count,
        nodes=int(scene.nodes.sum()),
        levels=scene.levels,
        tolerances=tolerances,
        matrix_bytes=int(most[0]),
        vector_bytes=int(most[1]),
        near_bytes=int(most[2]),
        fmm_bytes=int(most[3]),
        factorisation_flops=float(most[4]),
    )


def matrix_entries(shape: UnitShape) -> int:
    """Entries of one operator's matrices."""
    return (shape.resolution.modes + 1) * (3 * shape.meridian.size) ** 2


def _factorisation(shape: UnitShape) -> float:
    return 2.0 / 3.0 * matrix_entries(shape) * 3 * shape.meridian.size


def _near_bytes(scene: Scene) -> float:
    """Blocks of modes for the nodes in the gaps of close pairs."""
    first, second = scene.close_pairs.T
    blocks = np.array([_block(shape) for shape in scene.shapes])
    if len(first) == 0:
        return 0.0
    seen: NDArray = _IN_GAP * scene.nodes[first] * _PANELS * blocks[scene.shape[second]]
    return float(_FLOAT * seen.sum())


def _block(shape: UnitShape) -> int:
    """Numbers of the block of one node and one panel."""
    return 9 * shape.resolution.nodes * (shape.resolution.modes + 1)
