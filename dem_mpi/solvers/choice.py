"""The solver that a scene or a command line asks for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from dem_mpi.cone import Tolerance
from dem_mpi.scene_models import Contact
from dem_mpi.scene_models import Scip as ScipSection
from dem_mpi.solvers.result import Solver


@dataclass(frozen=True)
class SolverOptions:
    """Which method, for which law, to which tolerance.

    max_iterations : of APGD for a cone problem; scip : what the interior point method may do
    """

    solver: Literal["apgd", "scip", "auto"] = "apgd"
    law: Literal["ccp", "coulomb"] = "ccp"
    tolerance: Tolerance = field(default_factory=Tolerance)
    max_iterations: int = 5000
    scip: ScipSection = field(default_factory=ScipSection)

    @classmethod
    def of(cls, contact: Contact) -> SolverOptions:
        """Return the options of a scene's contact section."""
        tolerance = Tolerance(contact.tolerance, contact.tolerance_kind, contact.complementarity)
        return cls(contact.solver, contact.law, tolerance, contact.max_iterations, contact.scip)


def make_solver(options: SolverOptions) -> Solver:
    """Return the solver. What it does not need is not imported: PETSc only for Newton systems."""
    if options.law == "coulomb":
        from dem_mpi.solvers.coulomb import Coulomb

        return Coulomb(_cone_solver(options, options.tolerance), options.tolerance)
    return _cone_solver(options, options.tolerance)


def _cone_solver(options: SolverOptions, tolerance: Tolerance) -> Solver:
    if options.solver == "apgd":
        return _apgd(options, tolerance)
    if options.solver == "scip":
        return _scip(options, tolerance)
    from dem_mpi.solvers.auto import Auto

    return Auto(_apgd(options, tolerance), _scip(options, tolerance))


def _apgd(options: SolverOptions, tolerance: Tolerance) -> Solver:
    from dem_mpi.solvers.apgd import Apgd, ApgdOptions

    return Apgd(ApgdOptions(tolerance=tolerance, max_iterations=options.max_iterations))


def _scip(options: SolverOptions, tolerance: Tolerance) -> Solver:
    from dem_mpi.newton import NewtonOptions
    from dem_mpi.solvers.scip import Scip, ScipOptions

    section = options.scip
    newton = NewtonOptions(
        form=section.form,
        linear=section.linear,
        ordering=section.ordering,
        workspace=section.workspace,
        memory=section.memory,
    )
    return Scip(ScipOptions(tolerance, section.max_iterations, newton))
