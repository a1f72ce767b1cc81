"""The solver that a scene or a command line asks for."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from dem_mpi.cone import Tolerance
from dem_mpi.scene_models import Contact
from dem_mpi.scene_models import Scip as ScipSection
from dem_mpi.solvers.result import Solver

if TYPE_CHECKING:
    from dem_mpi.solvers.apgd import Apgd
    from dem_mpi.solvers.scip import Scip


@dataclass(frozen=True)
class SolverOptions:
    """Which method, for which law, to which tolerance.

    max_iterations : of APGD for a cone problem; scip : what the interior point method may do
    max_outer : cone problems of a solve under Coulomb's law
    """

    solver: Literal["apgd", "scip", "auto"] = "apgd"
    law: Literal["ccp", "coulomb"] = "ccp"
    tolerance: Tolerance = field(default_factory=Tolerance)
    max_iterations: int = 5000
    scip: ScipSection = field(default_factory=ScipSection)
    max_outer: int = 100

    @classmethod
    def of(cls, contact: Contact) -> SolverOptions:
        """Return the options of a scene's contact section."""
        tolerance = Tolerance(contact.tolerance, contact.tolerance_kind, contact.complementarity)
        return cls(
            contact.solver,
            contact.law,
            tolerance,
            contact.max_iterations,
            contact.scip,
            contact.max_outer,
        )


def make_solver(options: SolverOptions) -> Solver:
    """Return the solver. What it does not need is not imported: PETSc only for Newton systems."""
    inner = _cone_solver(options)
    if options.law == "ccp":
        return inner
    from dem_mpi.solvers.coulomb import Coulomb, CoulombOptions

    # Digits are cheap by Newton's method: fewer cone problems, each solved more closely.
    part = 1e-3 if options.solver == "scip" else CoulombOptions.coarsest
    schedule = CoulombOptions(
        max_outer=options.max_outer, coarsest=part, finest=min(part, CoulombOptions.finest)
    )
    return Coulomb(inner, options.tolerance, schedule)


def _cone_solver(options: SolverOptions) -> Solver:
    if options.solver == "apgd":
        return _apgd(options)
    if options.solver == "scip":
        return _scip(options)
    from dem_mpi.solvers.auto import Auto

    return Auto(_apgd(options), _scip(options))


def _apgd(options: SolverOptions) -> Apgd:
    from dem_mpi.solvers.apgd import Apgd, ApgdOptions

    return Apgd(ApgdOptions(options.tolerance, options.max_iterations))


def _scip(options: SolverOptions) -> Scip:
    from dem_mpi.newton import NewtonOptions
    from dem_mpi.solvers.scip import Scip, ScipOptions

    section = options.scip
    newton = NewtonOptions(
        form=section.form,
        linear=section.linear,
        preconditioner=section.preconditioner,
        ordering=section.ordering,
        workspace=section.workspace,
        memory=section.memory,
    )
    return Scip(ScipOptions(options.tolerance, section.max_iterations, newton))
