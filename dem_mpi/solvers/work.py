"""What it costs to solve a cone problem, foretold from counts alone: work [s] and memory [B].

Decisions that change a result may not read a clock, so work is counts times constants that were
measured once, on one core of one machine, by scripts/bench/calibrate.py. On another machine all of
them change by much the same factor, and a decision between two methods by little.

Factors. Nested dissection of the contact graph of n bodies in three dimensions: the last front has
the s = n^(2/3) / elongation bodies of the narrowest cut through the region that they fill. Fronts
of elongated and of flat regions repeat along the longer sides, so that entries grow as n s^0.6 and
operations as n s^1.5. Both grow with the bonds that hold the graph together, m/n contacts a body,
and with the unknowns f of a body. Beds of 500 and 2,000 spheres, from a cloud of 0.01 contacts a
body to 2.76 in the settled bed, columns, slabs and cubes of up to 13,800 have entries within a
factor 1.4 of this, operations within 2; a single layer has 4 times fewer.

Symbols: n bodies; m contacts; c components of an impulse; f rows of the Newton matrix for a body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:  # who estimates a scene starts neither MPI nor the compiler
    from dem_mpi.cone import ConeProblem
    from dem_mpi.parallel import Parallel

_BONDS = 3.0  # contacts a body for which the constants of a factor stand
_TYPICAL_BONDS = 2.75  # where a problem does not tell how many bodies it has


@dataclass(frozen=True)
class Costs:
    """The constants, measured on a core that does 4.2e10 operations a second in dense products.

    Of a product with N and the vector operations of the APGD iteration around it:
      call [s]; vector [s per contact]: by components 1, 3; assembled: factor on it with matrices
    Of a Newton iteration:
      newton_call [s]; contact [s per contact]: scalings, step lengths, products, assembly
      solves: triangular solves with a factor
    Of a factorisation:
      operation [s]; entry [s]; row [s per body]; visit [s per entry of a triangular solve]
      analysis [s per entry], once for a graph
    Of conjugate gradients without a factor:
      conjugate: products with the matrix in a Newton iteration; block [s per entry of that matrix]
    Of more ranks: message [s] per product and doubling of ranks; a factorisation is
    ranks^scaling faster.
    Of an interior point solve:
      iterations, iterations_per_decade: of the velocity scale over the tolerance
    Of an entry of a factor: memory [B].
    """

    call: float = 1.0e-5
    vector: tuple[float, float] = (1.5e-8, 3.5e-8)
    assembled: float = 1.8
    message: float = 2.0e-5
    newton_call: float = 3.0e-3
    contact: float = 3.5e-6
    solves: float = 4.0
    operation: float = 1.0 / 4.2e10
    entry: float = 1.6e-8
    row: float = 1.0e-5
    visit: float = 2.0e-9
    analysis: float = 2.5e-8
    conjugate: float = 2000.0
    block: float = 2.5e-9
    scaling: float = 0.75
    iterations: float = 5.0
    iterations_per_decade: float = 1.0
    memory: float = 12.0


COSTS = Costs()


@dataclass(frozen=True)
class Size:
    """The counts of a problem, the same on every rank.

    contacts, bodies : on all ranks; largest : contacts of the fullest rank
    rows             : of the Newton matrix for a body: 6 or 3 velocities, or two impulses
    elongation       : longest side over the mean side of the region that the bodies fill
    """

    contacts: int
    bodies: int
    largest: int
    columns: int
    rows: int
    elongation: float = 1.0
    ranks: int = 1
    threads: int = 1
    assembled: bool = False


def size_of(problem: ConeProblem, form: Literal["auto", "velocity", "contact"] = "auto") -> Size:
    """Collective. The counts of a problem whose Newton systems would be solved in this form."""
    operator, parallel = problem.operator, problem.parallel
    halo = getattr(operator, "halo", None)
    contacts = parallel.sum(problem.contacts)
    bodies = round(contacts / _TYPICAL_BONDS) if halo is None else parallel.sum(halo.owned)
    columns = problem.b.shape[1]
    velocity = form == "velocity" or (form == "auto" and hasattr(operator, "body_impulse"))
    return Size(
        contacts=contacts,
        bodies=max(1, bodies),
        largest=parallel.max(problem.contacts),
        columns=columns,
        rows=getattr(operator, "freedoms", 6) if velocity else 2 * columns,
        elongation=problem.elongation,
        ranks=parallel.size,
        threads=problem.threads,
        assembled=not hasattr(operator, "contact_velocity") or hasattr(operator, "d_transposed"),
    )


def elongation_of(position: NDArray, size: NDArray, parallel: Parallel) -> float:
    """Collective. Longest side over the mean side of the region that bodies fill, at least 1.

    Sides are those of the box whose filling scatters as the positions (n, 3) [m] do, so that single
    bodies far off do not matter, and at least the diameter of a body of mean size (n,) [m].
    """
    moments = np.concatenate(
        ([len(position), size.sum()], position.sum(axis=0), (position**2).sum(axis=0))
    )
    parallel.sum_in_place(moments)
    count = max(moments[0], 1.0)
    mean = moments[2:5] / count
    variance = np.maximum(moments[5:8] / count - mean**2, 0.0)
    return elongation(np.sqrt(12.0 * variance + (2.0 * moments[1] / count) ** 2))


def elongation(sides: ArrayLike) -> float:
    """Longest side of a box over the geometric mean of its three sides [m]; 1 for an empty box."""
    sides = np.asarray(sides, dtype=float)
    volume = float(sides.prod())
    return float(sides.max()) / volume ** (1.0 / 3.0) if volume > 0.0 else 1.0


# ---- factors -------------------------------------------------------------------------------


def factor_entries(size: Size) -> float:
    """Non-zeros of the Cholesky factor of a Newton matrix."""
    n, f, s = size.bodies, size.rows, _cut(size)
    return n * f**2 * (0.55 + 2.7 * s**0.6 * _bonds(size) ** 1.5)


def factor_operations(size: Size) -> float:
    """Floating point operations of its factorisation."""
    n, f, s = size.bodies, size.rows, _cut(size)
    return n * f**3 * (0.4 + 4.0 * s**1.5 * _bonds(size) ** 2)


def factor_memory(size: Size, costs: Costs = COSTS) -> float:
    """Memory of a factorisation on each rank [B], the fullest having a third more than its share.

    Fronts on the way to the factor and blocks that ranks send each other are in it, MUMPS's extra
    working space is not.
    """
    share = 1.0 if size.ranks == 1 else 1.33 / size.ranks
    return costs.memory * factor_entries(size) * share


def _cut(size: Size) -> float:
    return max(1.0, size.bodies ** (2.0 / 3.0) / size.elongation)


def _bonds(size: Size) -> float:
    return size.contacts / size.bodies / _BONDS


# ---- work ----------------------------------------------------------------------------------


def product_work(size: Size, costs: Costs = COSTS) -> float:
    """Seconds of a product with N within an iteration of APGD."""
    vector = costs.vector[0 if size.columns == 1 else 1]
    if size.assembled:
        vector *= costs.assembled
    message = costs.message * math.log2(size.ranks)
    return costs.call + vector * size.largest / size.threads + message


def newton_work(size: Size, linear: str = "mumps", costs: Costs = COSTS) -> float:
    """Seconds of an iteration of the interior point method."""
    if linear == "mumps":
        entries = factor_entries(size)
        shared = factor_operations(size) * costs.operation + entries * costs.entry
        shared += size.bodies * costs.row + entries * costs.visit * costs.solves
        shared /= size.ranks**costs.scaling
    else:
        entries = size.rows**2 * (size.bodies + 2 * size.contacts)
        shared = costs.conjugate * costs.block * entries / size.ranks
        shared += costs.conjugate * costs.message * math.log2(size.ranks)
    return shared + costs.newton_call + size.largest * costs.contact


def interior_point_work(
    size: Size, decades: float, linear: str = "mumps", costs: Costs = COSTS
) -> float:
    """Seconds of a solve to a tolerance so many decades below the velocity scale."""
    iterations = costs.iterations + costs.iterations_per_decade * max(0.0, decades)
    analysis = costs.analysis * factor_entries(size) if linear == "mumps" else 0.0
    return iterations * newton_work(size, linear, costs) + analysis
