"""TT-SVD of a large tensor beside tensorly's and teneva's, at the same error.

2^24 entries in 24 dimensions of two (2^20 where quick), ranks up to 32, norm 1, with white noise of
norm 1e-4 over it; tolerance 1e-3. tensorly takes ranks, not a tolerance: it is given those that
ours found. teneva cuts in bases that are not orthonormal, so that its tolerance is not one on the
error: it has the same and the largest of those ranks, and is further off (without the cap it is
nearer, with as many parameters as entries, and slower). All take the same array, in one process;
CPU seconds of it and wall seconds, medians.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from time import perf_counter, process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compress.decompose import Decomposition, tt_svd
from compress.tensor_train import TensorTrain

RANK, NOISE, TOLERANCE, SEED = 32, 1e-4, 1e-3, 20210407
ORDER, QUICK_ORDER = 24, 20
RIVAL_RUNS = 3
BLOCK = 1 << 20
NAMES = {"auto": "compress.ttsvd_seconds"} | {
    method: f"compress.ttsvd_{method}_seconds" for method in ("gram", "qr", "randomised")
}


def tensor(order: int) -> NDArray:
    """Ranks 2, 4, ..., 32, ..., 32, ..., 4, 2 and noise; binary; norm 1 but for the noise."""
    generator = np.random.default_rng(SEED)
    ranks = [min(2**k, 2 ** (order - k), RANK) for k in range(order + 1)]
    cores = tuple(
        generator.standard_normal((ranks[k], 2, ranks[k + 1])) / math.sqrt(ranks[k + 1])
        for k in range(order)
    )
    X = TensorTrain(cores).full().reshape(-1)
    X /= np.linalg.norm(X)
    for first in range(0, X.size, BLOCK):
        block = X[first : first + BLOCK]
        block += generator.standard_normal(block.size) * (NOISE / math.sqrt(X.size))
    return X.reshape((2,) * order)


def error(cores: Sequence[NDArray], X: NDArray) -> float:
    """||X - Y||_F / ||X||_F, of the first dimension's halves one after the other."""
    squares = 0.0
    for i in range(2):
        first = np.asarray(cores[0])[:, i : i + 1]
        part = TensorTrain((first, *(np.asarray(core) for core in cores[1:]))).full()
        squares += float(np.linalg.norm(part[0] - X[i]) ** 2)
    return math.sqrt(squares) / float(np.linalg.norm(X))


def work(quick: bool = False, runs: int = 5) -> list[dict[str, Any]]:
    """Fields of records: seconds of "auto" beside each rival, and of each method by itself.

    A rival that is not installed is left out; ours are then without one.
    """
    order = QUICK_ORDER if quick else ORDER
    X = tensor(order)
    first = tt_svd(X, TOLERANCE)
    ours = {"auto": _timed(lambda: tt_svd(X, TOLERANCE), runs)}
    rivals = {name: _timed(call, min(runs, RIVAL_RUNS)) for name, call in _rivals(X, first).items()}
    for method in ("gram", "qr", "randomised"):
        ours[method] = _timed(lambda method=method: tt_svd(X, TOLERANCE, method=method), runs)
    params = {"entries": X.size, "order": order, "rank": RANK, "noise": NOISE, "tau": TOLERANCE}
    made = []
    for name, (cpu, wall, found) in rivals.items():
        other = {
            "rival_wall": wall,
            "rival_error": error(found, X),
            "rival_parameters": int(sum(np.size(core) for core in found)),
            "rival_runs": min(runs, RIVAL_RUNS),
        }
        suffix = "" if name == "tensorly" else f".{name}"
        record = _record(X, "auto", ours["auto"], params | other, runs)
        record |= {"rival": name, "rival_value": cpu, "ratio": record["value"] / cpu}
        made.append(record | {"name": record["name"] + suffix})
    if not rivals:
        made.append(_record(X, "auto", ours["auto"], params, runs))
    made += [_record(X, m, ours[m], params, runs) for m in ("gram", "qr", "randomised")]
    return made


def _record(
    X: NDArray, method: str, timed: tuple[float, float, Any], params: dict[str, Any], runs: int
) -> dict[str, Any]:
    cpu, wall, found = timed
    used = sorted({step.method for step in found.steps})
    about = params | {"wall": wall, "parameters": found.train.parameters, "methods": used}
    return {
        "name": NAMES[method],
        "params": about,
        "value": cpu,
        "unit": "s",
        "error": error(found.train.cores, X),
        "runs": runs,
    }


def _rivals(X: NDArray, found: Decomposition) -> dict[str, Callable[[], Sequence[NDArray]]]:
    calls: dict[str, Callable[[], Sequence[NDArray]]] = {}
    try:
        from tensorly.decomposition import tensor_train

        ranks = list(found.train.ranks)
        calls["tensorly"] = lambda: tensor_train(X, rank=ranks).factors
    except ImportError:
        pass
    try:
        import teneva

        most = max(found.train.ranks)
        calls["teneva"] = lambda: teneva.svd(X, e=TOLERANCE, r=most)
    except ImportError:
        pass
    return calls


def _timed(call: Callable[[], Any], runs: int) -> tuple[float, float, Any]:
    """Median CPU and wall seconds, and what the last call returned."""
    cpu, wall = [], []
    for _ in range(runs):
        began, started = process_time(), perf_counter()
        found = call()
        cpu.append(process_time() - began)
        wall.append(perf_counter() - started)
    return statistics.median(cpu), statistics.median(wall), found
