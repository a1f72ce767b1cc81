"""Write the problems of settled piles that tests/data/fclib holds beside those of the collection.

    python scripts/make_fclib_piles.py [DIRECTORY]

Spheres of 1 cm radius fall into a narrow box, pile up and come to rest; the cone problem of the
next step goes into a file in FCLIB's layout, global: M v = H r + f, u = H^T v + w with f = 0. About
four minutes. The files in the repository are not to be made anew without need: other versions of
the program settle into other piles.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from dem_mpi.bodies import Bodies
from dem_mpi.cone import ConeProblem
from dem_mpi.parallel import Parallel
from dem_mpi.placement import place
from dem_mpi.scenario import parse_scenario
from dem_mpi.simulation import Simulation, start

DIRECTORY = Path(__file__).resolve().parents[1] / "tests" / "data" / "fclib"
STEP = 2e-3  # [s]
DENSITY = 1000.0  # [kg/m^3]


@dataclass(frozen=True)
class Pile:
    """Spheres in a box of square ground plan `side` [m], for so many steps."""

    name: str
    count: int
    side: float
    mu: float
    steps: int


PILES = (
    Pile("pile-60", 60, 0.06, 0.5, 500),
    Pile("pile-200", 200, 0.08, 0.5, 700),
    Pile("pile-200-jammed", 200, 0.08, 1.0, 700),
)


def settled(pile: Pile) -> ConeProblem:
    """Return the problem of the step after the last, with its matrices assembled."""
    top = [pile.side, pile.side, 0.9]
    scene = {
        "domain": {"min": [-1e3] * 3, "max": [1e3] * 3},
        "gravity": [0.0, 0.0, -9.81],
        "materials": {"m": {"density": DENSITY}},
        "friction": {"default": pile.mu},
        "bodies": [
            {
                "material": "m",
                "count": pile.count,
                "radius": 0.01,
                "placement": {"jittered_grid": {"jitter": 1.0, "min": [0, 0, 0], "max": top}},
            }
        ],
        "walls": [
            {
                "shape": "box",
                "name": "box",
                "material": "m",
                "min": [0, 0, 0],
                "max": [pile.side, pile.side, 1.0],
            }
        ],
        "time": {"step": STEP, "end": 10.0},
        "contact": {"operator": "assembled", "tolerance": 1e-4},
    }
    scenario = parse_scenario(json.dumps(scene), Path(pile.name)).scenario
    alone = Parallel.alone()
    state = start(alone, Bodies.from_arrays(place(alone, scenario), [DENSITY]))
    state.rotating = True
    simulation = Simulation(alone, scenario, state)
    for _ in range(pile.steps):
        simulation.step()
    problem, _ = simulation.pose()
    return problem


def write(path: Path, problem: ConeProblem, title: str, description: str) -> None:
    """Write M, H = D, f = 0, w = b and mu."""
    D = _csr(problem.operator.d_transposed).T.tocsc()
    D.eliminate_zeros()
    M = sparse.diags(1.0 / _csr(problem.operator.inverse_mass).diagonal(), format="csc")
    with h5py.File(path, "w", libver=("earliest", "v110")) as file:
        group = file.create_group("fclib_global")
        group["spacedim"] = np.array([3], dtype=np.int32)
        _write_matrix(group.create_group("M"), M)
        _write_matrix(group.create_group("H"), D)
        vectors = {"f": np.zeros(D.shape[0]), "w": problem.b.ravel(), "mu": problem.mu}
        for name, values in vectors.items():
            _write(group, f"vectors/{name}", values)
        group["info/title"] = np.bytes_(title)
        group["info/description"] = np.bytes_(description)


def _write_matrix(group: h5py.Group, matrix: sparse.csc_matrix) -> None:
    """Store compressed columns, which FCLIB marks by nz = -1."""
    matrix.sort_indices()
    sizes = {"m": matrix.shape[0], "n": matrix.shape[1], "nz": -1, "nzmax": matrix.nnz}
    for name, value in sizes.items():
        group[name] = np.array([value], dtype=np.int32)
    _write(group, "p", matrix.indptr.astype(np.int32))
    _write(group, "i", matrix.indices.astype(np.int32))
    _write(group, "x", matrix.data)


def _write(group: h5py.Group, name: str, values: NDArray) -> None:
    group.create_dataset(name, data=values, compression="gzip", shuffle=True)


def _csr(matrix) -> sparse.csr_matrix:
    indptr, indices, values = matrix.getValuesCSR()
    return sparse.csr_matrix((values, indices, indptr), shape=matrix.getSize())


def main() -> None:
    """Make all of them."""
    directory = Path(sys.argv[1]) if len(sys.argv) > 1 else DIRECTORY
    for pile in PILES:
        path = directory / f"{pile.name}.hdf5"
        problem = settled(pile)
        text = (
            f"{pile.count} spheres settled in a box {pile.side:g} m wide, friction {pile.mu:g}, "
            f"step {STEP:g} s; made by scripts/make_fclib_piles.py"
        )
        write(path, problem, pile.name, text)
        print(f"{path}: {problem.contacts} contacts", flush=True)


if __name__ == "__main__":
    main()
