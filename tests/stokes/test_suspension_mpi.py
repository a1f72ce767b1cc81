"""The same suspension on any number of ranks, its bodies dealt out in any way.

Fast sums are cut differently by ranks, so that answers agree to the tolerance, not to the bit.
PETSc is started here, on all ranks: some tests solve on one of them, and it would wait for others.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

import petsc4py.PETSc  # noqa: F401

from dem_mpi.parallel import Parallel
from stokes.geometry import Body, Resolution, sphere, spheroid
from stokes.suspension import Suspension, SuspensionOptions, distribute

from suspensions import ForcesAtCentres, mixed_cluster, quaternion

RANKS = [1, 2, 3, 8]
TOLERANCE = 1e-4
# Coarse: ranks must agree on the solution of one discrete system, whatever its own error.
COARSE = SuspensionOptions(resolution=Resolution.uniform(2, 6, 5), residual_tolerance=1e-5)


def dealt(bodies, parallel):
    return distribute(bodies, parallel)


def all_on_first(bodies, parallel):
    return bodies if parallel.rank == 0 else []


def all_on_last(bodies, parallel):
    return bodies if parallel.rank == parallel.size - 1 else []


def scattered(bodies, parallel):
    """Neighbours on different ranks."""
    return bodies[parallel.rank :: parallel.size]


def touching_pair():
    """A sphere and a spheroid whose near field is needed, on two ranks if there are two."""
    return [
        Body(sphere(), 1.0, (0.0, 0.0, 0.0)),
        Body(spheroid(0.6, 1.0), 1.0, (0.0, 0.0, 2.02)),
    ]


def collected(parallel, bodies, mine, values):
    """Collective. Rows of all ranks in the order of `bodies`."""
    numbers = [bodies.index(body) for body in mine]
    table = np.zeros((len(bodies), *np.shape(values)[1:]))
    table[numbers] = values
    return parallel.sum(table)


def alone(parallel, bodies, **data):
    """Collective. Forces and velocities of all bodies, found by rank 0 alone."""
    found = None
    if parallel.rank == 0:
        solution = Suspension(bodies, tolerance=TOLERANCE, options=COARSE).solve(**data)
        found = (solution.forces, solution.velocities, solution.iterations)
    return parallel.broadcast(found)


def worst(found, expected):
    return np.abs(found - expected).max() / np.abs(expected).max()


@pytest.mark.mpi(ranks=RANKS)
@pytest.mark.parametrize("deal", [dealt, scattered, all_on_first, all_on_last])
def test_forces_do_not_depend_on_ranks(parallel, deal):
    bodies = mixed_cluster()
    velocity = np.random.default_rng(1).standard_normal((5, 3))
    expected, _, iterations = alone(parallel, bodies, velocity=velocity)
    mine = deal(bodies, parallel)
    suspension = Suspension(mine, tolerance=TOLERANCE, parallel=parallel, options=COARSE)
    found = suspension.solve(velocity=velocity[[bodies.index(body) for body in mine]])
    assert found.converged
    assert worst(collected(parallel, bodies, mine, found.forces), expected) < TOLERANCE
    assert abs(found.iterations - iterations) <= 1
    assert found.report.bodies == 5


@pytest.mark.mpi(ranks=RANKS)
def test_motions_do_not_depend_on_ranks(parallel):
    bodies = mixed_cluster()
    force = np.random.default_rng(2).standard_normal((5, 3))
    _, expected, _ = alone(parallel, bodies, force=force)
    mine = distribute(bodies, parallel)
    suspension = Suspension(mine, tolerance=TOLERANCE, parallel=parallel, options=COARSE)
    found = suspension.solve(force=force[[bodies.index(body) for body in mine]])
    assert worst(collected(parallel, bodies, mine, found.velocities), expected) < TOLERANCE


@pytest.mark.mpi(ranks=[1, 2, 3])
@pytest.mark.parametrize("formulation", ["single", "combined"])
def test_near_field_crosses_ranks(parallel, formulation):
    """A density on one rank, the nodes close to it on another: the flow is known exactly."""
    bodies = touching_pair()
    exact = ForcesAtCentres(bodies)
    mine = scattered(bodies, parallel)
    suspension = Suspension(mine, tolerance=1e-3, formulation=formulation, parallel=parallel)
    found = suspension.solve(boundary_velocity=exact.velocity)
    forces = collected(parallel, bodies, mine, found.forces)
    assert parallel.any(found.report.near_pairs > 0)
    assert worst(forces, -exact.forces) < 5.0 * 1e-3
    # points on one rank only, in the gap and on a surface
    points = np.array([[0.0, 0.0, 1.01], [0.0, 0.0, 1.0], [3.0, 0.0, 0.0]])
    points = points if parallel.rank == parallel.size - 1 else points[:0]
    u = found.velocity(points)
    assert u.shape == points.shape
    error = np.abs(u - exact.velocity(points)).max(initial=0.0)
    assert error < 1e-3 * np.abs(exact.velocity(np.array([[0.0, 0.0, 1.01]]))).max()


@pytest.mark.mpi(ranks=[2, 3])
def test_neighbours_on_other_ranks_are_seen(parallel):
    """Gaps, turned axes and resolutions are those of one rank."""
    bodies = [Body(sphere(), 1.0, (2.3 * k, 0.3 * k, 0.0)) for k in range(4)]
    whole = Suspension(bodies, tolerance=1e-3)
    mine = scattered(bodies, parallel)
    shared = Suspension(mine, tolerance=1e-3, parallel=parallel)
    assert shared.report.least_gap == whole.report.least_gap
    assert shared.report.nodes == whole.report.nodes
    assert sorted(map(repr, shared.report.levels)) == sorted(map(repr, whole.report.levels))
    starts = whole.offsets
    rows = [np.arange(starts[k], starts[k + 1]) for k in map(bodies.index, mine)]
    rows = np.concatenate([np.empty(0, int), *rows])
    np.testing.assert_allclose(shared.nodes, whole.nodes[rows], atol=1e-14)


@pytest.mark.mpi(ranks=[2, 3])
def test_overlap_is_refused_on_all_ranks(parallel):
    bodies = [Body(sphere(), 1.0, (1.5 * k, 0.0, 0.0)) for k in range(parallel.size)]
    mine = [bodies[parallel.rank]]
    with pytest.raises(ValueError, match=r"bodies \d and \d.* overlap"):
        Suspension(mine, parallel=parallel)


@pytest.mark.mpi(ranks=[2, 3])
def test_bad_data_of_one_rank_are_refused_on_all(parallel):
    bodies = [Body(sphere(), 1.0, (3.0 * parallel.rank, 0.0, 0.0))]
    suspension = Suspension(bodies, tolerance=1e-2, parallel=parallel)
    shape = (3,) if parallel.rank else (4,)
    with pytest.raises(ValueError, match=r"velocity of shape \(4,\)"):
        suspension.solve(velocity=np.zeros(shape))
    data = {"velocity": (1, 0, 0)} if parallel.rank else {"force": (1, 0, 0)}
    with pytest.raises(ValueError, match="on rank 0"):
        suspension.solve(**data)
    assert suspension.solve(velocity=(1.0, 0.0, 0.0)).converged


@pytest.mark.mpi(ranks=[3])
def test_ranks_may_have_no_body_at_all(parallel):
    suspension = Suspension([], tolerance=1e-3, parallel=parallel)
    assert suspension.report.bodies == 0
    assert math.isinf(suspension.report.least_gap)
    found = suspension.solve(velocity=(1.0, 0.0, 0.0))
    assert found.forces.shape == (0, 3)
    assert found.converged


@pytest.mark.mpi(ranks=[2])
def test_groups_of_ranks_solve_their_own_suspensions(parallel):
    group = Parallel.alone()
    body = Body(sphere(), 1.0 + parallel.rank, (0.0, 0.0, 0.0), quaternion(parallel.rank))
    options = SuspensionOptions(turn_spheres=False)
    found = Suspension([body], tolerance=1e-3, parallel=group, options=options).solve(
        velocity=(1.0, 0.0, 0.0)
    )
    assert found.forces[0, 0] == pytest.approx(-6.0 * math.pi * (1.0 + parallel.rank))


@pytest.mark.mpi(ranks=[1, 3, 8])
def test_distribute_deals_every_body_to_one_rank(parallel):
    bodies = mixed_cluster()
    counts = collected(
        parallel, bodies, mine := distribute(bodies, parallel), np.ones((len(mine), 1))
    )
    assert np.all(counts == 1.0)
    assert parallel.max(len(mine)) - parallel.min(len(mine)) <= 1
