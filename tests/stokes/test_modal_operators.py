"""Modal matrices of S, D and T against identities that hold on every closed surface.

Tolerances: 1e-12 of the largest value compared, where both sides are known to be resolved; the
operators themselves are good to some 1e-13, rounding in quadrature near the poles sets the floor.
"""

from dataclasses import replace

import numpy as np
import pytest

from stokes.formulation import OperatorCache, ShapeSolver, rigid_motions
from stokes.geometry import Resolution, fourier_curve, sphere, spherocylinder, spheroid
from stokes.modes import azimuths, from_modes, to_modes
from stokes.operators import Layer, ModalOperators
from stokes.resolution import resolution_for

from layer_sums import PointForces, flow_of_layers, on_grid, refined

TOLERANCE = 1e-12

# An egg has no mirror symmetry, a dumbbell a neck where it is not convex.
SHAPES = {
    "sphere": (sphere(), 4),
    "prolate": (spheroid(0.5, 1.0), 10),
    "oblate": (spheroid(1.0, 0.5), 10),
    "egg": (fourier_curve((1.0, 0.15), (0.0, 1.0, 0.2)), 12),
    "dumbbell": (fourier_curve((1.0, 0.0, 0.4), (0.0, 1.5)), 14),
    "rod": (spherocylinder(0.5, 1.0, 0.5), 16),
}


@pytest.fixture(scope="module")
def cache():
    return OperatorCache()


@pytest.fixture(params=SHAPES)
def operators(request, cache):
    curve, panels = SHAPES[request.param]
    return cache.operators(curve, Resolution.uniform(panels, 16, 12))


def inner(operators, f, g):
    return np.sum(operators.grid.weights[..., None] * f * g)


def smooth_fields(operators):
    """Two vector fields (n_s, n_theta, 3) with all components and some ten modes."""
    x, y, z = np.moveaxis(operators.grid.points, -1, 0)
    first = np.stack([x * y + z, np.cos(x + 0.5 * z), x**2 * y - y * z], axis=-1)
    second = np.stack([np.sin(y - z), x * z**2 + 0.3, np.exp(0.3 * x + 0.2 * y)], axis=-1)
    return first, second


def flow_from(operators, inside, seed=7):
    """Five random point forces well inside, or outside, of the unit shape."""
    rng = np.random.default_rng(seed)
    grid = operators.grid
    at = grid.points[::7, ::3].reshape(-1, 3)
    chosen = at[rng.choice(len(at), 5, replace=False)]
    distance = 0.15 if inside else 6.0
    return PointForces(distance * chosen, rng.standard_normal((5, 3)))


def relative(difference, reference):
    return np.abs(difference).max() / np.abs(reference).max()


# ---- modes ---------------------------------------------------------------------------------


def test_modes_and_nodal_values_determine_each_other():
    field = np.random.default_rng(1).standard_normal((7, 9, 3, 2))
    coefficients = to_modes(field)
    assert coefficients.shape == (5, 4, 21)
    np.testing.assert_allclose(from_modes(coefficients, 9, (2,)), field, atol=1e-14)


def test_modes_on_a_finer_grid_are_the_same_trigonometric_polynomials():
    def field(theta):
        radial, azimuthal = 1.0 + np.cos(2 * theta), np.sin(theta) - 0.2 * np.cos(3 * theta)
        cos, sin = np.cos(theta), np.sin(theta)
        x, y = cos * radial - sin * azimuthal, sin * radial + cos * azimuthal
        return np.stack([x, y, np.sin(3 * theta)], axis=-1)[None]

    finer = from_modes(to_modes(field(azimuths(7))), 20)
    np.testing.assert_allclose(finer, field(azimuths(20)), atol=1e-14)


def test_even_number_of_azimuths_is_refused():
    with pytest.raises(ValueError, match="8 azimuths"):
        to_modes(np.zeros((3, 8, 3)))


# ---- operators -----------------------------------------------------------------------------


def test_double_layer_of_rigid_motions_is_minus_half_of_them(operators):
    motions = rigid_motions(operators.grid.points)
    difference = operators.apply(Layer.DOUBLE, motions) + 0.5 * motions
    assert relative(difference, motions) < TOLERANCE


def test_double_layer_of_constants_is_minus_one_inside_and_zero_outside(cache):
    operators = cache.operators(*_prolate())
    solver = ShapeSolver(operators, "interior")
    constant = np.broadcast_to([0.3, -1.0, 0.7], operators.grid.points.shape)
    inside = np.array([[0.1, 0.1, -0.2], [0.0, -0.15, 0.5]])
    outside = np.array([[0.8, 0.1, 0.2], [0.0, 0.3, -1.4], [5.0, 2.0, 1.0]])
    np.testing.assert_allclose(
        flow_of_layers(solver, constant, inside), [[-0.3, 1.0, -0.7]] * 2, atol=TOLERANCE
    )
    np.testing.assert_allclose(flow_of_layers(solver, constant, outside), 0.0, atol=TOLERANCE)


def _prolate():
    return spheroid(0.5, 1.0), Resolution.uniform(10, 16, 12)


def test_single_layer_of_the_normals_vanishes(operators):
    n = operators.grid.normals
    assert np.abs(operators.apply(Layer.SINGLE, n)).max() < TOLERANCE


def test_traction_of_the_normals_is_the_pressure_inside(operators):
    # S n = 0 outside, pressure -1 inside: (T + 1/2) n = n, (T - 1/2) n = 0.
    n = operators.grid.normals
    assert np.abs(operators.apply(Layer.TRACTION, n) - 0.5 * n).max() < TOLERANCE


@pytest.mark.parametrize("inside", [True, False], ids=["exterior flow", "interior flow"])
def test_greens_representation_holds_on_the_surface(operators, inside):
    # Outside u = D u - S t, inside u = S t - D u; in both S t = (D -+ 1/2) u.
    finer = ModalOperators(operators.curve, _with_modes(operators.resolution, 24))
    u, t = on_grid(finer.grid, flow_from(finer, inside))
    jump = -0.5 if inside else 0.5
    difference = finer.apply(Layer.DOUBLE, u) + jump * u - finer.apply(Layer.SINGLE, t)
    assert relative(difference, u) < TOLERANCE


def _with_modes(resolution, modes):
    return Resolution(resolution.breaks, resolution.nodes, modes)


@pytest.mark.parametrize("inside", [True, False], ids=["from outside", "from inside"])
def test_traction_of_a_single_layer_jumps_by_its_density(cache, inside):
    curve, resolution = _prolate()
    solver = cache.solver(curve, _with_modes(resolution, 24), "single")
    operators = solver.operators
    u, t = on_grid(operators.grid, flow_from(operators, inside))
    rho = solver.solve(u)
    side = operators.apply(Layer.TRACTION, rho) + (-0.5 if inside else 0.5) * rho
    difference = side - t
    if not inside:  # the pressure inside is known up to a constant
        n = operators.grid.normals
        difference -= n * inner(operators, difference, n) / operators.grid.area
    # S is of the first kind: rho has the error of u times the condition of S, about 10^3.
    assert relative(difference, t) < 1e3 * TOLERANCE


def test_traction_is_the_transpose_of_the_double_layer(operators):
    f, g = smooth_fields(operators)
    left = inner(operators, f, operators.apply(Layer.TRACTION, g))
    right = inner(operators, operators.apply(Layer.DOUBLE, f), g)
    size = np.sqrt(inner(operators, f, f) * inner(operators, g, g))
    assert abs(left - right) < TOLERANCE * size


def test_single_layer_is_symmetric_and_positive(operators):
    f, g = smooth_fields(operators)
    Sf, Sg = operators.apply(Layer.SINGLE, f), operators.apply(Layer.SINGLE, g)
    size = np.sqrt(inner(operators, f, f) * inner(operators, g, g))
    assert abs(inner(operators, f, Sg) - inner(operators, Sf, g)) < TOLERANCE * size
    assert inner(operators, f, Sf) > 0.0


def test_single_and_double_layer_commute_as_calderon_says(operators):
    f, _ = smooth_fields(operators)
    left = operators.apply(Layer.DOUBLE, operators.apply(Layer.SINGLE, f))
    right = operators.apply(Layer.SINGLE, operators.apply(Layer.TRACTION, f))
    assert relative(left - right, left) < TOLERANCE


def test_single_layer_on_the_sphere_has_the_known_spectrum(cache):
    # On vector harmonics of degree l: l/((2l+1)(2l+3)), (l+1)/((2l+1)(2l-1)), 1/(2l+1).
    # (S. Corona, S. Veerapaneni, J. Comput. Phys. 362, 2018.)
    operators = cache.operators(sphere(), Resolution.uniform(6, 16, 12))
    for n in (1, 5, 12):
        degree = np.arange(n, n + 10.0)
        expected = np.concatenate(
            [
                degree / ((2 * degree + 1) * (2 * degree + 3)),
                (degree + 1) / ((2 * degree + 1) * (2 * degree - 1)),
                1.0 / (2 * degree + 1),
            ]
        )
        found = np.linalg.eigvals(operators.matrices(Layer.SINGLE)[n]).ravel()
        nearest = np.abs(expected[:, None] - found).min(axis=1)
        assert nearest.max() < TOLERANCE


def test_error_falls_with_the_order_of_the_panels():
    nodes, panels = 8, np.array([4, 8, 16])
    errors = []
    for count in panels:
        operators = ModalOperators(spheroid(0.5, 1.0), Resolution.uniform(int(count), nodes, 24))
        u, t = on_grid(operators.grid, flow_from(operators, inside=True))
        left = operators.apply(Layer.DOUBLE, u) - 0.5 * u
        errors.append(relative(left - operators.apply(Layer.SINGLE, t), u))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    # Densities are interpolated by polynomials of degree nodes - 1: errors h^nodes.
    assert np.all(orders > nodes - 1), (errors, orders)


def test_matrices_are_the_same_bits_with_threads():
    curve, resolution = spheroid(0.5, 1.0), Resolution.uniform(2, 8, 4)
    for layer in Layer:
        one, two = (ModalOperators(curve, resolution, threads=k) for k in (1, 2))
        np.testing.assert_array_equal(one.matrices(layer), two.matrices(layer))
        np.testing.assert_array_equal(one.plain(layer), two.plain(layer))


@pytest.mark.parametrize("refinement", [(1, 1), (2, 2)])
def test_even_and_odd_parts_are_those_of_the_whole_matrix(refinement):
    curve, resolution = spheroid(0.5, 1.0), Resolution.uniform(3, 8, 5)
    halves, whole = ModalOperators(curve, resolution), ModalOperators(curve, resolution)
    assert halves.parts == 2
    whole.parts = 1
    fields = np.stack(smooth_fields(halves), axis=-1)
    np.testing.assert_allclose(halves.from_rows(halves.to_rows(fields), (2,)), fields, atol=1e-14)
    for layer in Layer:
        np.testing.assert_allclose(
            halves.apply(layer, fields), whole.apply(layer, fields), atol=1e-13
        )
        plain = [o.multiply(o.plain(layer, refinement), fields) for o in (halves, whole)]
        np.testing.assert_allclose(*plain, atol=1e-11)  # its terms next to the target cancel


def test_shapes_without_mirror_image_are_not_halved():
    egg, _ = SHAPES["egg"]
    assert ModalOperators(egg, Resolution.uniform(4, 8, 2)).parts == 1
    prolate = spheroid(0.5, 1.0)
    assert ModalOperators(prolate, Resolution((0.0, 0.4, 0.7, 1.0), 8, 2)).parts == 1
    assert ModalOperators(prolate, Resolution.uniform(3, 7, 2)).parts == 1  # a node at z = 0


def test_cache_counts_its_bytes_and_shares_operators():
    cache = OperatorCache()
    curve, resolution = sphere(), Resolution.uniform(2, 8, 3)
    solver = cache.solver(curve, resolution, "combined")
    assert cache.solver(curve, resolution, "combined") is solver
    assert cache.solver(curve, resolution, "single").operators is solver.operators
    matrix = 4 * 2 * 24 * 24 * 8  # modes, even and odd part
    assert cache.nbytes == 0
    field = np.ones(solver.grid.points.shape)
    solver.solve(field)
    assert cache.nbytes == 4 * matrix  # S, D, their combination and its factorisation
    cache.release_operators()
    assert cache.nbytes == 2 * matrix
    solver.self_correction(field)
    assert cache.nbytes == 2 * matrix  # the correction in place of the combination
    np.testing.assert_allclose(solver.apply(solver.solve(field)), field, atol=1e-13)


# ---- the plain rule ------------------------------------------------------------------------


def plain_sum(operators, layer, field, refinement):
    """Sum over all refined nodes, term by term, those at the target left out."""
    fine, points, normals, weights = refined(operators, field, refinement)
    weighted = fine * weights[:, None]
    targets = operators.grid.points.reshape(-1, 3)
    x = targets[:, None] - points
    R = np.linalg.norm(x, axis=-1)
    R[R < 1e-10] = np.inf
    along = np.einsum("ijk,jk->ij", x, weighted)
    if layer is Layer.SINGLE:
        total = (1.0 / R) @ weighted + np.einsum("ijk,ij->ik", x, along / R**3)
        return total.reshape(field.shape) / (8.0 * np.pi)
    if layer is Layer.DOUBLE:
        flux = np.einsum("ijk,jk->ij", x, normals)
    else:
        flux = -np.einsum("ijk,ik->ij", x, operators.grid.normals.reshape(-1, 3))
    total = np.einsum("ijk,ij->ik", x, along * flux / R**5)
    return 3.0 / (4.0 * np.pi) * total.reshape(field.shape)


@pytest.mark.parametrize("refinement", [(1, 1), (2, 1), (1, 2), (3, 3)])
@pytest.mark.parametrize("layer", list(Layer))
def test_plain_block_is_the_sum_over_nodes_without_the_own_one(layer, refinement):
    operators = ModalOperators(spheroid(0.7, 1.0), Resolution.uniform(3, 6, 5))
    field, _ = smooth_fields(operators)
    found = operators.multiply(operators.plain(layer, refinement), field)
    expected = plain_sum(operators, layer, field, refinement)
    # Next to the target the sum cancels: the finer the sources, the more digits are lost.
    assert relative(found - expected, expected) < 1e-10


def test_correction_is_what_the_plain_rule_misses():
    operators = ModalOperators(spheroid(0.7, 1.0), Resolution.uniform(3, 8, 6))
    solver = ShapeSolver(operators, "combined")
    field, _ = smooth_fields(operators)
    total = solver.smooth_self(field) + solver.self_correction(field)
    np.testing.assert_allclose(total, solver.apply(field), atol=1e-13)


# ---- formulations --------------------------------------------------------------------------

# Condition numbers in the norm of L2 on the surface, worst over the modes, at any resolution.
CONDITIONS = {
    "sphere": {"combined": 2.0, "completed": 5.0, "traction": 5.0, "interior": 2.5},
    "prolate": {"combined": 3.21, "completed": 13.8, "traction": 12.7, "interior": 7.28},
    "oblate": {"combined": 2.64, "completed": 10.5, "traction": 10.5, "interior": 5.35},
}


@pytest.mark.parametrize("shape", CONDITIONS)
def test_second_kind_formulations_stay_well_conditioned_as_nodes_are_added(shape, cache):
    curve, _ = SHAPES[shape]
    for formulation, known in CONDITIONS[shape].items():
        for panels in (4, 8):
            solver = cache.solver(curve, Resolution.uniform(panels, 12, 6), formulation)
            assert solver.condition_numbers().max() == pytest.approx(known, rel=0.01)


def test_condition_of_the_first_kind_grows_with_the_nodes(cache):
    worst = [
        cache.solver(sphere(), Resolution.uniform(panels, 12, 6), "single").condition_numbers()
        for panels in (4, 8)
    ]
    growth = worst[1].max() / worst[0].max()
    # S takes the shortest wave that the nodes resolve to its length.
    assert growth == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("equatorial", [0.05, 20.0], ids=["needle", "disc"])
def test_only_the_combined_formulation_is_well_conditioned_on_slender_and_flat_bodies(
    equatorial, cache
):
    curve = spheroid(equatorial, 1.0)
    resolution = replace(resolution_for(curve, 1e-6), modes=4)
    worst = {
        name: cache.solver(curve, resolution, name).condition_numbers().max()
        for name in ("combined", "completed", "traction")
    }
    assert worst["combined"] < 40.0
    assert min(worst["completed"], worst["traction"]) > 5000.0


def test_solver_without_the_modes_of_rigid_motions_is_refused():
    with pytest.raises(ValueError, match="at least one mode"):
        ShapeSolver(ModalOperators(sphere(), Resolution.uniform(2, 8, 0)), "single")


@pytest.mark.parametrize("formulation", ["single", "combined", "completed", "interior", "traction"])
def test_solution_satisfies_its_equation(formulation, cache):
    curve, resolution = _prolate()
    solver = cache.solver(curve, resolution, formulation)
    fields = np.stack(smooth_fields(solver.operators), axis=-1)
    density = solver.solve(fields)
    assert density.shape == fields.shape
    np.testing.assert_allclose(solver.apply(density), fields, atol=1e-11)
    alone = solver.solve(fields[..., 1])
    np.testing.assert_allclose(alone, density[..., 1], atol=1e-11)
