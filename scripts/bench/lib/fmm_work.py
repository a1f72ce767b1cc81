"""One measurement of a fast sum: points, a method, its seconds, memory and error; in a process."""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

SEED = 20170626
SAMPLES = 1000
BUDGET = 40.0  # s, after which the rival's calls are not repeated


def points(distribution: str, n: int) -> NDArray:
    """Coordinates (n, 3): uniform in the unit cube, or on a surface, seeded."""
    generator = np.random.default_rng(SEED)
    if distribution == "cube":
        return generator.random((n, 3))
    directions = generator.standard_normal((n, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    if distribution == "sphere":
        return directions
    if distribution == "prolate":  # 10:1, P. Blanchard's ellipsoid: images of the sphere's points
        return directions * np.array([0.1, 0.1, 1.0])
    raise ValueError(f"unknown distribution {distribution!r}")


def weights(n: int, components: int) -> NDArray:
    """Normal weights (n, components), seeded: signs at random, so that errors do not hide."""
    return np.random.default_rng(SEED + 1).standard_normal((n, components))


def sampled(n: int) -> NDArray:
    """Indices of the targets on which errors are measured."""
    count = min(SAMPLES, n)
    return np.sort(np.random.default_rng(SEED + 2).choice(n, count, replace=False))


def reference(task: dict[str, Any]) -> tuple[NDArray, float]:
    """Direct sums on the sampled targets and the seconds a target, kept in a file."""
    from stokes.fmm import direct_sum

    path = Path(task["reference"])
    if not path.exists():
        x, kernel = points(task["distribution"], task["n"]), _kernel(task)
        w, chosen = weights(task["n"], kernel.n_in), sampled(task["n"])
        direct_sum(kernel, x[:100], x[:100], w[:100])
        began = perf_counter()
        values = direct_sum(kernel, x, x[chosen], w)
        seconds = (perf_counter() - began) / len(chosen)
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(f".{os.getpid()}.npz")
        np.savez(unfinished, values=values, seconds=seconds)
        unfinished.rename(path)
    with np.load(path) as stored:
        return stored["values"], float(stored["seconds"])


def run(task: dict[str, Any]) -> dict[str, Any]:
    """Collective. Measure one method on one case: seconds of plan and of each apply, error."""
    return (_fmm3d if task["method"] == "fmm3d" else _own)(task)


def _kernel(task: dict[str, Any]) -> Any:
    from stokes.fmm import kernels

    if task["kernel"] == "gaussian":
        return kernels.gaussian(task["length"])
    return kernels.KERNELS[task["kernel"]]


def _error(values: NDArray, exact: NDArray) -> float:
    difference = values.reshape(exact.shape) - exact
    return float(np.linalg.norm(difference) / np.linalg.norm(exact))


def _memory() -> float:
    """Largest resident set of this process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0


def _own(task: dict[str, Any]) -> dict[str, Any]:
    from dem_mpi.parallel import Parallel
    from stokes.fmm import Fmm, FmmOptions

    parallel, kernel, n = Parallel(), _kernel(task), task["n"]
    share = slice(n * parallel.rank // parallel.size, n * (parallel.rank + 1) // parallel.size)
    x, w = points(task["distribution"], n)[share], weights(n, kernel.n_in)[share]
    options = FmmOptions(**task.get("options", {}))

    def plan() -> Fmm:
        return Fmm(kernel, x, eps=task["eps"], options=options, parallel=parallel)

    before = _memory()
    plan().apply(w)  # compiles, or loads what is compiled
    plans, applies = [], []
    for _ in range(task["plans"]):
        parallel.barrier()
        began = perf_counter()
        ready = plan()
        parallel.barrier()
        plans.append(perf_counter() - began)
    for _ in range(task["runs"]):
        parallel.barrier()
        began = perf_counter()
        values = ready.apply(w)
        parallel.barrier()
        applies.append(perf_counter() - began)
    chosen = sampled(n)
    mine = chosen[(chosen >= share.start) & (chosen < share.stop)]
    parts = parallel.gather(values[mine - share.start])
    found = {
        "plan": plans,
        "apply": applies,
        "memory": parallel.sum(_memory()),
        "memory_before": parallel.sum(before),
        "report": _plain(ready.report),
    }
    if parallel.rank == 0:
        exact, per_target = reference(task)
        found |= {"error": _error(np.concatenate(parts), exact), "direct": per_target * n}
    parallel.barrier()
    return found


def _fmm3d(task: dict[str, Any]) -> dict[str, Any]:
    import fmm3dpy

    n, stokes = task["n"], task["kernel"] == "stokeslet"
    x = np.asfortranarray(points(task["distribution"], n).T)
    w = np.asfortranarray(weights(n, 3 if stokes else 1).T)

    def apply(x: NDArray, w: NDArray, eps: float) -> NDArray:
        if stokes:
            # version 2.1 gives (1, 3, n)
            return fmm3dpy.stfmm3d(eps=eps, sources=x, stoklet=w, ifppreg=1).pot.reshape(3, -1).T
        return fmm3dpy.lfmm3d(eps=eps, sources=x, charges=w[0], pg=1).pot[:, None]

    before = _memory()
    applies = []
    for _ in range(task["runs"]):
        began = perf_counter()
        values = apply(x, w, task["eps"])
        applies.append(perf_counter() - began)
        if sum(applies) > BUDGET:
            break
    # Its Stokeslet has another factor in each version: taken from a pair at unit distance.
    pair = np.asfortranarray([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    push = np.asfortranarray([[1.0, 0.0], [0.0, 0.0], [0.0, 0.0]]) if stokes else np.eye(1, 2)
    factor = apply(pair, push, 1e-12)[1, 0]
    exact, per_target = reference(task)
    return {
        "plan": [],
        "apply": applies,
        "memory": _memory(),
        "memory_before": before,
        "error": _error(values[sampled(n)] / factor, exact),
        "direct": per_target * n,
    }


def _plain(report: Any) -> Any:
    """What of a report JSON can hold."""
    from dataclasses import asdict

    return json.loads(json.dumps(asdict(report), default=str))


if __name__ == "__main__":
    order, result = sys.argv[1:]
    outcome = run(json.loads(Path(order).read_text()))
    if outcome.get("error") is not None:  # the rank that knows all
        Path(result).write_text(json.dumps(outcome))
