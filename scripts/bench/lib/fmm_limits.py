"""How near the fast sum's two heavy loops come to what one core can do.

The near field and the transfers on equispaced grids, in operations a second beside products added
in registers of the full width (the machine's peak) and a matrix product by numpy's BLAS (which may
use half of the width), and in bytes a second beside STREAM's triad (a = b + s c), all measured in
the same process, one thread, medians of 5. Additions and multiplications count one each, whatever
the instruction; so do those of a product that is added at once.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

RUNS = 5
KERNELS = ("laplace", "stokeslet")
# Operations of a pair besides 1/|r|: differences 3, |r|^2 5, then Laplace w/r 1, sum 1; Stokeslet
# (r.w)/r^2 7, (w_i + r_i s)/r 9, sums 3.
PAIR_FLOPS = {"laplace": 10, "stokeslet": 27}
# Of 1/|r| as it is computed: in double two steps of fourth order at 3 + 7, in single one of third
# (3 + 5) and one of second order (3 + 3).
INVERSE_FLOPS = {"double": 20, "single": 14}
GROUP = 64  # points of a leaf
LISTED = 27  # leaves near a leaf
NODES = (5, 9)


def records(quick: bool) -> Iterable[Any]:
    """Records of a process of its own, whose BLAS has one thread."""
    from records import Record

    threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    call = [sys.executable, str(Path(__file__).resolve()), "quick" if quick else "full"]
    done = subprocess.run(
        call, env={**os.environ, **threads}, stdout=subprocess.PIPE, text=True, check=True
    )
    for found in json.loads(done.stdout):
        yield Record(**found)


def measured(quick: bool) -> list[dict[str, Any]]:
    """Fields of all records."""
    triad = triad_bytes(1 << (22 if quick else 24))
    found = [_field("triad", {"bytes_of_each_number": 24}, triad, "GB/s")]
    for precision, dtype in (("double", np.float64), ("single", np.float32)):
        peak = register_flops(dtype)
        product = product_flops(1000 if quick else 2000, dtype)
        found.append(_field(f"peak.{precision}", {}, peak, "GFlop/s"))
        found.append(_field(f"matrix_product.{precision}", {}, product, "GFlop/s", "peak", peak))
        for kernel in KERNELS:
            found += near(kernel, precision, peak)
            for nodes in NODES:
                found += transfers(kernel, nodes, precision, 3 if quick else 4, peak, triad)
    return found


def _field(
    name: str,
    params: dict[str, Any],
    value: float,
    unit: str,
    rival: str | None = None,
    limit: float | None = None,
) -> dict[str, Any]:
    versus = {}
    if rival and limit:
        versus = {"rival": rival, "rival_value": limit, "ratio": limit / value}
        params = params | {"fraction": round(value / limit, 3)}
    return {"name": f"fmm.limits.{name}", "params": params, "value": value, "unit": unit,
            "runs": RUNS, **versus}  # fmt: skip


def _seconds(function: Callable[[], object]) -> float:
    """Median seconds of the processor; the first call, which may compile, left out."""
    function()
    seconds = []
    for _ in range(RUNS):
        began = process_time()
        function()
        seconds.append(process_time() - began)
    return median(seconds)


# ---- the machine -----------------------------------------------------------------------------


def register_flops(dtype: type) -> float:
    """GFlop/s of products added to as many vectors as there are registers for."""
    import numba

    chain, rounds = _chain(16), 1_000_000
    values = np.full(64 // np.dtype(dtype).itemsize, 0.5, dtype)

    @numba.njit
    def run(values: NDArray, rounds: int) -> None:
        chain(values, rounds)

    return 2e-9 * 16 * rounds * len(values) / _seconds(lambda: run(values, rounds))


def _chain(count: int) -> Any:
    """Make `rounds` times x = x a + a for `count` vectors that do not wait for each other."""
    from llvmlite import ir
    from numba import types
    from numba.core import cgutils
    from numba.extending import intrinsic

    @intrinsic
    def chain(typingctx: Any, values: Any, rounds: Any) -> Any:
        """One vector of 64 bytes in `values`: a on entry, the sum of all x on return."""

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            lanes = 64 * 8 // values.dtype.bitwidth
            vector = ir.VectorType(context.get_value_type(values.dtype), lanes)
            data = context.make_array(values)(context, builder, args[0]).data
            place = builder.bitcast(data, vector.as_pointer())
            a = builder.load(place, align=4)
            x = [cgutils.alloca_once_value(builder, a) for _ in range(count)]
            with cgutils.for_range(builder, args[1], intp=args[1].type):
                for each in x:
                    product = builder.fmul(builder.load(each), a, flags=("contract",))
                    builder.store(builder.fadd(product, a, flags=("contract",)), each)
            total = builder.load(x[0])
            for each in x[1:]:
                total = builder.fadd(total, builder.load(each))
            builder.store(total, place, align=4)
            return context.get_dummy_value()

        return types.void(values, types.intp), generate

    return chain


def product_flops(size: int, dtype: type) -> float:
    """GFlop/s of a matrix product, 2 size^3 operations."""
    a, b = (np.random.default_rng(k).random((size, size)).astype(dtype) for k in (1, 2))
    out = np.empty_like(a)
    return 2e-9 * size**3 / _seconds(lambda: np.dot(a, b, out=out))


def triad_bytes(length: int) -> float:
    """GB/s of a = b + s c in double: two loads and a store, 24 bytes a number, as STREAM counts."""
    import numba

    @numba.njit(fastmath={"contract"})
    def triad(a: NDArray, b: NDArray, c: NDArray, s: float) -> None:
        for i in range(len(a)):
            a[i] = b[i] + s * c[i]

    a, b, c = np.zeros(length), np.ones(length), np.full(length, 2.0)
    return 24e-9 * length / _seconds(lambda: triad(a, b, c, 3.0))


# ---- the sums --------------------------------------------------------------------------------


def near(name: str, precision: str, peak: float) -> Iterable[dict[str, Any]]:
    """Groups of 64 targets, each with 27 of 64 sources: the near field of a full tree."""
    from stokes.fmm import kernels
    from stokes.fmm.near_field import NearField

    kernel, groups = kernels.KERNELS[name], 512
    count = groups * GROUP
    x = np.random.default_rng(3).random((3, count))
    w, out = np.ones((kernel.n_in, count)), np.zeros((kernel.n_out, count))
    ranges = GROUP * np.stack((np.arange(groups), np.arange(1, groups + 1)), axis=1)
    listed = ranges[(np.arange(groups)[:, None] + np.arange(LISTED)).reshape(-1) % groups]
    start = LISTED * np.arange(groups + 1)
    field = NearField(kernel, precision == "single")
    seconds = _seconds(lambda: field.add(x, ranges, x, w, start, listed, out))
    pairs = groups * LISTED * GROUP**2
    flops = PAIR_FLOPS[name] + INVERSE_FLOPS[precision]
    described = {
        "precision": precision,
        "flops_of_a_pair": flops,
        "of_them_for_the_inverse_distance": INVERSE_FLOPS[precision],
        "ns_of_a_pair": round(1e9 * seconds / pairs, 3),
        "ns_of_a_pair_at_the_peak": round(flops / peak, 3),
    }
    rate = 1e-9 * flops * pairs / seconds
    yield _field(f"near.{name}", described, rate, "GFlop/s", "peak", peak)


def transfers(
    name: str, nodes: int, precision: str, level: int, peak: float, triad: float
) -> Iterable[dict[str, Any]]:
    """All transfers between the boxes of a full level."""
    from stokes.fmm import kernels
    from stokes.fmm.interpolation import Grid
    from stokes.fmm.transfer import FourierTransfer

    kernel, dtype = kernels.KERNELS[name], np.float64 if precision == "double" else np.float32
    boxes, far = _full_tree(level)
    transfer = FourierTransfer(kernel, Grid("equispaced", nodes), boxes.edges(1.0), dtype=dtype)
    tables = transfer.bytes
    first, last = (int(boxes.level_start[k]) for k in (level, level + 1))
    start, source, vector = far.of_level(boxes, level)
    pairs = transfer.prepare(level, start, source, vector, np.arange(first, last), boxes.cells())
    shape = (len(boxes), kernel.n_in, nodes, nodes, nodes)
    multipoles = np.random.default_rng(4).standard_normal(shape).astype(dtype)
    local = np.zeros((len(boxes), kernel.n_out, *shape[2:]), dtype)
    seconds = _seconds(lambda: transfer.apply(pairs, multipoles, local))

    count = Count(kernel, nodes, last - first, len(source), pairs.families, local.itemsize)
    described = {
        "precision": precision,
        "nodes": nodes,
        "boxes": last - first,
        "pairs": len(source),
        "ns_of_a_pair": round(1e9 * seconds / len(source), 1),
        "flops_of_products": count.products,
        "flops_of_transforms": count.transforms,
        "flops_without_families": count.pair_by_pair,
        "bytes_loaded_by_products": count.loads,
        "bytes_touched_once": count.touched + tables,
    }
    for unit, what, amount, rival, limit in (
        ("GFlop/s", "flops", count.products + count.transforms, "peak", peak),
        ("GB/s", "loads", count.loads, "triad", triad),
        ("GB/s", "memory", described["bytes_touched_once"], "triad", triad),
    ):
        yield _field(f"transfer.{name}.{what}", described, 1e-9 * amount / seconds, unit, rival,
                     limit)  # fmt: skip


def _full_tree(level: int) -> tuple[Any, Any]:
    """Boxes with a point in each cell of a level, and their far pairs."""
    from dem_mpi import morton
    from stokes.fmm.lists import interaction_lists
    from stokes.fmm.tree import Splitting, build

    cells = np.stack(np.meshgrid(*3 * [np.arange(1 << level)], indexing="ij"), -1).reshape(-1, 3)
    keys = np.sort(morton.encode((cells + 0.5) / (1 << level), np.zeros(3), 1.0))
    boxes = build(keys, keys, Splitting(depth=level))
    return boxes, interaction_lists(boxes).far


class Count:
    """Operations and bytes of the transfers of one level, from the loops as they are written."""

    def __init__(
        self, kernel: Any, nodes: int, boxes: int, pairs: int, families: Any, itemsize: int
    ) -> None:
        entries, ends = kernel.n_in * kernel.n_out, kernel.n_in + kernel.n_out
        n = 2 * nodes - 1
        frequencies = (n**3 + 1) // 2
        # A complex product that is added: 4 multiplications, 4 additions.
        self.pair_by_pair = 8 * frequencies * entries * pairs
        self.products = 8 * frequencies * entries * families.products
        # Cosines and sines along z, y, x: 2 l x l by l^2, then n x l by 2 l^2 and by 2 l n columns.
        self.transforms = (
            2 * boxes * ends * (2 * nodes**4 + 2 * n * nodes**3 + 2 * n * n * nodes**2)
        )
        # Of the innermost loop: for each direction and source parents of a group, a product's
        # tables of 1 or 3 outputs and the sources of the group, real and imaginary parts.
        outputs = 3 if kernel.n_out % 3 == 0 else 1
        steps = families.products // families.group * (kernel.n_out // outputs)
        complex_ = 2 * itemsize
        self.loads = steps * kernel.n_in * (families.group + outputs) * complex_ * frequencies
        # Grids read, spectra written and read; of locals the same, the grids written besides.
        grids = (kernel.n_in + 2 * kernel.n_out) * nodes**3 * itemsize
        self.touched = boxes * (grids + 2 * ends * frequencies * complex_)


if __name__ == "__main__":
    print(json.dumps(measured(sys.argv[1] == "quick")))
