"""Before the first step all of a run's kernels are compiled, and none that it does not use."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from launch import ROOT

# Compiles for one scene, and prints which kernels of some modules are there to be called.
PROGRAM = """
import sys
from dem_mpi.parallel import Parallel
from dem_mpi.warmup import warm_up

warm_up(Parallel.alone(), 1, {arguments})
for name in ("_kernels_solver", "_kernels_scip", "_kernels_newton"):
    module = sys.modules.get("dem_mpi." + name)
    for key, kernel in vars(module).items() if module else ():
        kernel = getattr(kernel, "serial", kernel)
        if getattr(kernel, "__module__", "") == "dem_mpi." + name and hasattr(kernel, "signatures"):
            print(name, key, len(kernel.signatures))
print("PETSc", int("petsc4py.PETSc" in sys.modules))
"""


def compiled(arguments: str) -> dict[str, int]:
    """The number of compiled variants by kernel, of modules that were imported at all."""
    program = PROGRAM.format(arguments=arguments)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, timeout=300
    )
    assert done.returncode == 0, done.stderr
    lines = [line.rsplit(" ", 1) for line in done.stdout.splitlines()]
    return {name: int(count) for name, count in lines}


def test_a_run_with_gradients_imports_neither_petsc_nor_the_interior_point_method():
    found = compiled("solvers=('apgd',)")
    assert found["PETSc"] == 0
    assert not [name for name in found if "scip" in name or "newton" in name]
    assert found["_kernels_solver gradient_step"] == 1


def test_newton_steps_on_coulombs_law_are_compiled_before_the_first_step():
    found = compiled("solvers=('apgd',), law='coulomb'")
    assert found["PETSc"] == 1  # by all ranks together, before any of them comes to need it
    assert [name for name, count in found.items() if "newton" in name and count > 0]
    assert not [name for name in found if "scip" in name]
    assert found["_kernels_solver gradient_step"] == 1


@pytest.mark.parametrize("solver", ["scip", "auto"])
def test_every_kernel_of_the_interior_point_method_is_compiled_before_the_first_step(solver):
    found = compiled(f"solvers=({solver!r},)")
    assert found["PETSc"] == 1
    new = {name: n for name, n in found.items() if "scip" in name or "newton" in name}
    assert len(new) > 10
    # Helpers that start with an underscore are compiled into their callers.
    assert [name for name, n in new.items() if n == 0 and " _" not in name] == []
    assert found["_kernels_solver gradient_step"] == (1 if solver == "auto" else 0)


def test_a_cache_that_holds_the_kernels_counts_as_no_compilation(tmp_path):
    """What is loaded was not compiled, however long it takes."""
    program = "from dem_mpi.parallel import Parallel; from dem_mpi.warmup import warm_up;"
    program += "print(warm_up(Parallel.alone(), 1))"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}

    def compilations() -> int:
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT,
            env=environment, timeout=300, check=True,
        )  # fmt: skip
        return int(done.stdout)

    assert compilations() > 10
    assert compilations() == 0
