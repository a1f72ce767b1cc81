"""Compression as in S. De, PhD thesis, University of Michigan 2021, section 4.4: TT-SVD, no coding.

A chunk of 32 steps is a tensor of bodies x steps x components, or, tensorised, of 14 binary levels
of bodies, 5 of steps, and 3 components: 20 dimensions. Bodies lie in Morton order at the chunk's
1st step, from the 17th on in that at the 17th step. Cores are kept as float64.
"""

from __future__ import annotations

import math
from time import process_time
from typing import Any

import numpy as np
from lib.compress_data import Sediment
from numpy.typing import NDArray

from compress.tensorize import morton_order

FORMS = ("natural, by gid", "natural", "tensorised")
JOINED = {True: "concatenate", False: "stack"}  # of natural chunks, and of tensorised ones
RESORTED = 16  # from this step of a chunk on bodies lie in another order


def work(run: Sediment, tau: float) -> list[dict[str, Any]]:
    """Every chunk of velocities in each form: parameters, largest rank, errors, CPU seconds.

    `order_bytes` are those of the permutations that the form needs, coded by this project's code.
    """
    rows, previous = [], None
    for chunk in run.chunks:
        found = run.load(chunk, ("velocity", "position"))
        velocity, orders = found["velocity"], resorting(found["position"])
        coded = _coded(orders, previous)
        previous = orders[1]
        for form in FORMS:
            tensor = as_tensor(velocity, orders, form)
            began = process_time()
            cores = tt_svd(tensor, tau)
            seconds = process_time() - began
            error = float(np.linalg.norm(expand(cores) - tensor))
            rows.append({
                "chunk": chunk, "phase": run.phases[chunk], "form": form,
                "dimensions": tensor.ndim, "parameters": sum(core.size for core in cores),
                "rank": max(core.shape[2] for core in cores), "frobenius": error,
                "nrmse": error / math.sqrt(tensor.size) / float(np.ptp(velocity)),
                "order_bytes": 0 if form == FORMS[0] else coded, "seconds": seconds,
            })  # fmt: skip
    return rows


def streamed(run: Sediment, tau: float, form: str) -> list[dict[str, Any]]:
    """His figure 4.5: parameters of all chunks so far, joined as they come.

    Natural chunks are joined along time (algorithm 4.3), tensorised ones in pairs and pairs of
    pairs along new dimensions (4.4), by this project's stream, which keeps the error of the whole.
    """
    from compress.stream import TensorTrainStream

    natural = form != "tensorised"
    levels = run.bodies.bit_length() - 1
    stream = TensorTrainStream(tau, axis=1 if natural else levels, form=JOINED[natural])
    rows, count = [], 0
    for chunk in run.chunks:
        found = run.load(chunk, ("velocity", "position"))
        tensor = as_tensor(found["velocity"], resorting(found["position"]), form)
        began = process_time()
        stream.append(tensor)
        count += tensor.size
        rows.append({"chunk": chunk, "phase": run.phases[chunk], "form": form, "count": count,
                     "parameters": stream.parameters,
                     "seconds": process_time() - began})  # fmt: skip
    return rows


def resorting(position: NDArray) -> tuple[NDArray, NDArray]:
    """The Morton orders at the 1st and 17th step of a chunk of positions (T, n, 3)."""
    return morton_order(position[0]), morton_order(position[RESORTED])


def _coded(orders: tuple[NDArray, NDArray], previous: NDArray | None) -> int:
    from compress.permutation import encode

    first, second = orders
    return len(encode(first, previous)) + len(encode(second, first))


def as_tensor(velocity: NDArray, orders: tuple[NDArray, NDArray], form: str) -> NDArray:
    """Velocities (T, n, 3) as (n, T, 3), or as (2, ..., 2, 3), the coarsest levels first."""
    if form != FORMS[0]:
        halves = (velocity[:RESORTED, orders[0]], velocity[RESORTED:, orders[1]])
        velocity = np.concatenate(halves)
    natural = np.ascontiguousarray(velocity.transpose(1, 0, 2))
    if form != "tensorised":
        return natural
    bodies, steps, width = natural.shape
    return natural.reshape([2] * (bodies.bit_length() - 1 + steps.bit_length() - 1) + [width])


def tt_svd(tensor: NDArray, tau: float) -> list[NDArray]:
    """Cores (r, n, r') of algorithm 4.1: ||X - Y||_F <= tau ||X||_F."""
    shape, d = tensor.shape, tensor.ndim
    allowed = (tau * float(np.linalg.norm(tensor))) ** 2 / (d - 1)
    cores, rest, rank = [], tensor, 1
    for n in shape[:-1]:
        u, s, vt = _svd(rest.reshape(rank * n, -1))
        tail = np.cumsum((s**2)[::-1])[::-1]
        kept = max(int((tail > allowed).sum()), 1)
        cores.append(u[:, :kept].reshape(rank, n, kept))
        rest, rank = s[:kept, None] * vt[:kept], kept
    return [*cores, rest.reshape(rank, shape[-1], 1)]


def _svd(matrix: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Thin singular value decomposition, of a triangular factor where one side is far longer."""
    rows, columns = matrix.shape
    if columns > 4 * rows:
        q, r = np.linalg.qr(matrix.T)
        u, s, vt = np.linalg.svd(r.T, full_matrices=False)
        return u, s, vt @ q.T
    return np.linalg.svd(matrix, full_matrices=False)


def expand(cores: list[NDArray]) -> NDArray:
    """The full tensor."""
    full = cores[0]
    for core in cores[1:]:
        full = np.tensordot(full, core, axes=1)
    return full.reshape([core.shape[1] for core in cores])
