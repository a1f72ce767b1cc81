"""The 48 symmetries of the cube, acting on transfer vectors, grid nodes and tensor components.

A symmetry Q is a signed permutation of the axes. The operator of a transfer vector d follows
from that of Q d, since k(Q r) = R_out k(r) R_in^T and Q maps the nodes of a box's grid, which is
the same in each direction and symmetric about the centre, onto themselves:

    K_d[(i, a), (j, b)] = sum_{i', j'} R_out[i', i] K_{Q d}[(i', Q a), (j', Q b)] R_in[j', j].

16 of the 316 transfer vectors (20 of 343 with the neighbours) are enough: the cone
0 <= dz <= dy <= dx (M. Messner et al., arXiv:1210.7292; P. Blanchard, PhD thesis, alg. 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Kernel.rotate: Q (3, 3) -> R_out (n_out, n_out), R_in (n_in, n_in), signed permutations.
Rotation = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

# Transfer vectors: of all boxes whose parents touch, offsets in -3..3 in each direction.
VECTORS = 343


def vector_index(offset: np.ndarray) -> np.ndarray:
    """Index 0..342 of the offsets (k, 3), target's minus source's lattice coordinate, in -3..3."""
    return (np.asarray(offset) + 3) @ np.array([49, 7, 1])


def vector_offset(index: np.ndarray | int) -> np.ndarray:
    """Offsets (k, 3) of the indices (k,): the inverse of `vector_index`."""
    index = np.asarray(index)
    return np.stack([index // 49 - 3, index // 7 % 7 - 3, index % 7 - 3], axis=-1)


def transfer_vectors(neighbours: bool) -> np.ndarray:
    """Indices of all transfer vectors: 316, or 343 with those of adjacent and equal boxes."""
    index = np.arange(VECTORS)
    if neighbours:
        return index
    return index[np.abs(vector_offset(index)).max(axis=1) > 1]


def cone_symmetry(offset: np.ndarray) -> np.ndarray:
    """The signed permutation Q (3, 3) that takes an offset (3,) into 0 <= dz <= dy <= dx."""
    offset = np.asarray(offset)
    order = np.argsort(-np.abs(offset), kind="stable")
    Q = np.zeros((3, 3), dtype=np.int64)
    Q[np.arange(3), order] = np.where(offset[order] < 0, -1, 1)
    return Q


def node_permutation(Q: np.ndarray, nodes: int) -> np.ndarray:
    """image (nodes^3,): node a, x slowest and z fastest, lies at image[a] after the map Q."""
    twice = 2 * np.indices((nodes,) * 3).reshape(3, -1) - (nodes - 1)
    image = (Q @ twice + (nodes - 1)) // 2
    return np.ravel_multi_index(tuple(image), (nodes,) * 3)


def signed_permutation(R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """source (n,), sign (n,) with (R w)[i] = sign[i] w[source[i]]; ValueError if R is none."""
    R = np.asarray(R, dtype=np.float64)
    source = np.argmax(np.abs(R), axis=1)
    sign = R[np.arange(len(R)), source]
    exact = np.zeros_like(R)
    exact[np.arange(len(R)), source] = np.where(sign < 0, -1.0, 1.0)
    if not np.array_equal(exact, R) or len(np.unique(source)) != len(R):
        raise ValueError(f"the components must be permuted and negated only, got\n{R}")
    return source, sign


@dataclass(frozen=True)
class Orbits:
    """Which operator, seen through which symmetry, serves each transfer vector.

    representative : (343,) index of the vector whose operator is kept; -1 where there is none
    symmetry       : (343,) row of the tables below
    node           : (s, nodes^3) node of the box that lands on each node of the representative
    inverse        : (s, nodes^3) node of the representative on which each node of the box lands
    component_in, sign_in   : (s, n_in)  multipole of the representative = sign * that component
    component_out, sign_out : (s, n_out) local of the box = sign * that component
    """

    representative: np.ndarray
    symmetry: np.ndarray
    node: np.ndarray
    inverse: np.ndarray
    component_in: np.ndarray
    sign_in: np.ndarray
    component_out: np.ndarray
    sign_out: np.ndarray


def orbits(
    vectors: np.ndarray, nodes: int, rotation: Rotation | None, n_in: int, n_out: int
) -> Orbits:
    """Map the transfer vectors (k,) into the cone; without a rotation each stands for itself."""
    representative = np.full(VECTORS, -1, dtype=np.int64)
    symmetry = np.zeros(VECTORS, dtype=np.int64)
    maps: dict[bytes, int] = {}
    matrices: list[np.ndarray] = []
    for vector in vectors:
        offset = vector_offset(vector)
        Q = cone_symmetry(offset) if rotation else np.eye(3, dtype=np.int64)
        representative[vector] = vector_index(Q @ offset)
        symmetry[vector] = maps.setdefault(Q.tobytes(), len(maps))
        if len(maps) > len(matrices):
            matrices.append(Q)
    turns = [rotation(Q) if rotation else (np.eye(n_out), np.eye(n_in)) for Q in matrices]
    inward = [signed_permutation(R_in) for _, R_in in turns]
    outward = [signed_permutation(np.asarray(R_out).T) for R_out, _ in turns]
    inverse = np.stack([node_permutation(Q, nodes) for Q in matrices])
    return Orbits(
        representative,
        symmetry,
        np.argsort(inverse, axis=1),
        inverse,
        np.stack([source for source, _ in inward]),
        np.stack([sign for _, sign in inward]),
        np.stack([source for source, _ in outward]),
        np.stack([sign for _, sign in outward]),
    )
