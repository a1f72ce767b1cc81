"""Modes of Stokes kernels: against decimal arithmetic, adaptive quadrature, and their identities.

Errors are relative to the largest entry of a mode's block, or to that of all modes.
"""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from scipy.integrate import quad_vec

from stokes import _kernels_modal as kernels
from stokes.modal import KINDS, modal_kernel

from toroidal_twin import modal_twin

MATRIX_KINDS = ["velocity_single", "traction_single", "velocity_double", "traction_double"]
PRESSURE_KINDS = ["pressure_single", "pressure_double"]

# (equatorial, polar) semi-axes
SPHEROIDS = [(1.0, 1.0), (1.0, 0.5), (0.3, 2.0)]
N_MAX = 28


# ---------------------------------------------------------------------------------------------
# points


def spheroid_point(u, equatorial, polar):
    """(r, z, normal) at the rational parameter u of the meridian, in decimals."""
    r = equatorial * 2 * u / (1 + u * u)
    z = polar * (1 - u * u) / (1 + u * u)
    normal = (r / equatorial**2, z / polar**2)
    length = (normal[0] ** 2 + normal[1] ** 2).sqrt()
    return [r, z, normal[0] / length, normal[1] / length]


def neighbours(u, step, equatorial, polar):
    """Two points of a meridian, their difference and offsets, all in decimals."""
    with localcontext() as context:
        context.prec = 100
        shape = (Decimal(equatorial), Decimal(polar))
        target = spheroid_point(Decimal(u) + Decimal(step), *shape)
        source = spheroid_point(Decimal(u), *shape)
        difference = [target[0] - source[0], target[1] - source[1]]
        offsets = [side[2] * difference[0] + side[3] * difference[1] for side in (target, source)]
        return target, source, difference, offsets


def row(values):
    return np.array([[float(v) for v in values]])


def random_points(rng, count):
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    return np.stack(
        [rng.uniform(0.1, 1.5, count), rng.normal(size=count), np.cos(angle), np.sin(angle)], axis=1
    )


def errors(values, reference):
    """Worst error relative to the mode's own block (if not negligible), and to all modes."""
    wrong = np.abs(values - reference).max(axis=(1, 2))
    size = np.abs(reference).max(axis=(1, 2))
    kept = size > 1e-30 * size.max()
    return np.max(wrong[kept] / size[kept]), np.max(wrong) / size.max()


# ---------------------------------------------------------------------------------------------
# against many digits


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("shape", SPHEROIDS)
@pytest.mark.parametrize("step", [0.5, 0.1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-12])
def test_no_digits_are_lost_between_neighbours_on_a_curve(kind, shape, step):
    target, source, difference, offsets = neighbours(0.7, step, *shape)
    reference = modal_twin(kind, target, source, N_MAX)
    values = modal_kernel(kind, row(target), row(source), row(difference), row(offsets), N_MAX)[0]
    by_mode, overall = errors(values, reference)
    # ten roundings of a mode decay by up to n xi roundings of the distance
    assert by_mode < 1e-14
    assert overall < 3e-15


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("step", [1e-2, 1e-4, 1e-6])
def test_without_exact_offsets_as_many_digits_are_lost_as_the_distance_has(kind, step):
    target, source, difference, _ = neighbours(0.7, step, 1.0, 0.5)
    reference = modal_twin(kind, target, source, N_MAX)
    values = modal_kernel(kind, row(target), row(source), row(difference), n_max=N_MAX)[0]
    # nu.(x - x') = O(h^2) has an error of eps h
    assert errors(values, reference)[1] < 1e-14 + 1e-15 / step


PLACES = {
    "side by side": (1.0, 0.3, 0.7, -0.2),
    "near": (1.0, 0.0, 1.05, 0.1),
    "across": (1.0, 0.0, 0.1, 0.5),
    "chi just below 3": (1.0, 0.0, 1.0, 1.999),
    "chi just above 3": (1.0, 0.0, 1.0, 2.001),
    "above": (1.0, 0.0, 1.0, 5.0),
    "far": (1.0, 0.0, 30.0, 2.0),
    "target on the axis": (0.0, 0.3, 1.0, 0.0),
    "target by the axis": (1e-10, 0.3, 1.0, 0.0),
    "source on the axis": (1.0, 0.0, 0.0, 0.4),
    "source by the axis": (1.0, 0.0, 1e-7, 0.4),
    "both on the axis": (0.0, 0.0, 0.0, 1.0),
    "both by the axis": (1e-5, 0.0, 1e-5, 1e-5),
    "at a pole": (1e-5, 0.0, 2e-4, 1e-5),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", PLACES)
def test_points_anywhere_with_any_normals(kind, place):
    r, z, r_source, z_source = PLACES[place]
    target = [r, z, 0.6, -0.8]
    source = [r_source, z_source, -0.28, 0.96]
    with localcontext():
        difference = [Decimal(r) - Decimal(r_source), Decimal(z) - Decimal(z_source)]
    reference = modal_twin(kind, target, source, N_MAX)
    values = modal_kernel(kind, row(target), row(source), row(difference), n_max=N_MAX)[0]
    by_mode, overall = errors(values, reference)
    assert by_mode < 2e-14
    assert overall < 3e-15


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("gap", [1e-1, 1e-3, 1e-5])
def test_points_off_the_surface_are_as_good_as_their_distance(kind, gap):
    source = [0.6, 0.8, 0.6, 0.8]
    target = [0.6 * (1.0 + gap), 0.8 * (1.0 + gap), 0.6, 0.8]
    reference = modal_twin(kind, target, source, N_MAX)
    values = modal_kernel(kind, row(target), row(source), n_max=N_MAX)[0]
    # differences of doubles are exact here, and nu.(x - x') is of first order
    assert errors(values, reference)[1] < 3e-15


# ---------------------------------------------------------------------------------------------
# against quadrature of the kernels in space


def space_kernel(kind, x, normal, source_normal):
    """The kernel between points x apart, Cartesian components."""
    R = np.sqrt(x @ x)
    along, along_source = x @ normal, x @ source_normal
    dyad, unit = np.outer(x, x), np.eye(3)
    if kind == "velocity_single":
        return (unit / R + dyad / R**3) / (8.0 * np.pi)
    if kind == "pressure_single":
        return (x / R**3)[None] / (4.0 * np.pi)
    if kind == "traction_single":
        return -3.0 / (4.0 * np.pi) * dyad * along / R**5
    if kind == "velocity_double":
        return 3.0 / (4.0 * np.pi) * dyad * along_source / R**5
    if kind == "pressure_double":
        return (-source_normal / R**3 + 3.0 * x * along_source / R**5)[None] / (2.0 * np.pi)
    return (
        2.0 * np.outer(normal, source_normal) / R**3
        + 3.0
        * (
            np.outer(source_normal, x) * along
            + unit * along * along_source
            + dyad * (normal @ source_normal)
            + np.outer(x, normal) * along_source
        )
        / R**5
        - 30.0 * dyad * along * along_source / R**7
    ) / (4.0 * np.pi)


def rotated_kernel(kind, t, target, source):
    """The same in the frames of target, at the angle t, and source, at the angle zero."""
    c, s = np.cos(t), np.sin(t)
    to_frame = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    x = np.array([target[0] * c - source[0], target[0] * s, target[1] - source[1]])
    normal = np.array([target[2] * c, target[2] * s, target[3]])
    kernel = space_kernel(kind, x, normal, np.array([source[2], 0.0, source[3]]))
    return kernel if kernel.shape[0] == 1 else to_frame @ kernel


@pytest.mark.parametrize("kind", MATRIX_KINDS + PRESSURE_KINDS)
@pytest.mark.parametrize(
    ("target", "source"),
    [
        ((0.9, 0.3, 0.6, -0.8), (0.7, -0.2, -0.28, 0.96)),
        ((0.62, 0.81, 0.6, 0.8), (0.6, 0.8, 0.6, 0.8)),
        ((0.0, 1.2, 0.0, 1.0), (0.8, -0.6, 0.8, -0.6)),
        ((1.0, 2.5, 0.8, 0.6), (0.3, -0.4, 0.6, -0.8)),
    ],
)
def test_modes_are_fourier_integrals_of_the_kernels_in_space(kind, target, source):
    modes = np.array([0, 1, 2, 7])

    def integrand(t):
        kernel = rotated_kernel(kind, t, target, source)
        return np.exp(-1j * modes * t)[:, None, None] * kernel

    values = modal_kernel(kind, row(target), row(source), n_max=7)[0][modes]
    C = np.array([1.0, 1j, 1.0])
    complex_values = values / C
    if values.shape[1] == 3:
        complex_values = C[:, None] * complex_values
    size = np.abs(values).max()
    reference = sum(
        quad_vec(integrand, *interval, epsabs=1e-14 * size, epsrel=0.0, norm="max")[0]
        for interval in [(-np.pi, 0.0), (0.0, np.pi)]
    )
    assert np.abs(complex_values - reference).max() < 1e-13 * size


@pytest.mark.parametrize("layer", ["single", "double"])
def test_tractions_are_those_of_the_velocity_and_pressure(layer):
    rng = np.random.default_rng(3)
    x, normal, source_normal = rng.normal(size=(3, 3))
    step = 1e-30
    gradient = np.array(  # [k, i, j] = d u_i / d x_k, by complex steps: exact to rounding
        [
            space_kernel(f"velocity_{layer}", x + 1j * step * axis, normal, source_normal).imag
            / step
            for axis in np.eye(3)
        ]
    )
    pressure = space_kernel(f"pressure_{layer}", x, normal, source_normal)
    traction = (
        -np.outer(normal, pressure)
        + np.einsum("kij,k->ij", gradient, normal)
        + np.einsum("ikj,k->ij", gradient, normal)
    )
    expected = space_kernel(f"traction_{layer}", x, normal, source_normal)
    assert traction == pytest.approx(expected, abs=1e-13 * np.abs(expected).max())
    assert np.abs(np.einsum("iij->j", gradient)).max() < 1e-13 * np.abs(gradient).max()


# ---------------------------------------------------------------------------------------------
# identities


@pytest.fixture
def pairs():
    rng = np.random.default_rng(5)
    target, source = random_points(rng, 40), random_points(rng, 40)
    source[20:30, :2] = target[20:30, :2] + 1e-3 * rng.normal(size=(10, 2))
    target[:3, 0] = 0.0
    source[2:5, 0] = 0.0
    return target, source


@pytest.mark.parametrize(
    ("kind", "reverse"),
    [
        ("velocity_single", "velocity_single"),
        ("traction_single", "velocity_double"),
        ("traction_double", "traction_double"),
    ],
)
def test_kernels_are_reciprocal(kind, reverse, pairs):
    target, source = pairs
    forth = modal_kernel(kind, target, source, n_max=20)
    back = modal_kernel(reverse, source, target, n_max=20).transpose(0, 1, 3, 2)
    size = np.abs(forth).max(axis=(1, 2, 3), keepdims=True)
    assert np.all(np.abs(forth - back) < 1e-14 * size)


@pytest.mark.parametrize("layer", ["single", "double"])
def test_stresses_on_a_plane_are_tractions_and_their_trace_is_the_pressure(layer, pairs):
    target, source = pairs
    stress = modal_kernel(f"stress_{layer}", target, source, n_max=20)
    traction = modal_kernel(f"traction_{layer}", target, source, n_max=20)
    pressure = modal_kernel(f"pressure_{layer}", target, source, n_max=20)
    nr, nz = (target[:, k, None, None, None] for k in (2, 3))
    contracted = nr * stress[:, :, [0, 1, 2]] + nz * stress[:, :, [2, 4, 5]]
    size = np.abs(stress).max(axis=(1, 2, 3), keepdims=True)
    assert np.all(np.abs(contracted - traction) < 1e-14 * size)
    trace = stress[:, :, [0]] + stress[:, :, [3]] + stress[:, :, [5]]
    assert np.all(np.abs(trace + 3.0 * pressure) < 1e-14 * size)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if "stress" not in kind])
def test_a_point_on_the_axis_sees_the_first_two_modes_alone(kind, pairs):
    target, source = (points[:2] for points in pairs)
    values = modal_kernel(kind, target, source, n_max=12)
    highest = 0 if "pressure" in kind else 1
    if "traction" not in kind:  # a normal with a radial part turns with the frame
        assert np.all(values[:, highest + 1 :] == 0.0)
        assert np.all(np.abs(values[:, : highest + 1]).max(axis=(2, 3)) > 0.0)
    close = target.copy()
    close[:, 0] = 1e-12
    error = np.abs(modal_kernel(kind, close, source, n_max=12) - values)
    assert error.max() < 1e-10 * np.abs(values).max()


@pytest.mark.parametrize(
    ("kind", "power"),
    [
        ("velocity_single", 1),
        ("pressure_single", 2),
        ("traction_single", 2),
        ("velocity_double", 2),
        ("pressure_double", 3),
        ("traction_double", 3),
        ("stress_single", 2),
        ("stress_double", 3),
    ],
)
def test_kernels_scale_with_length_to_the_last_bit(kind, power, pairs):
    target, source = pairs
    stretch = np.array([8.0, 8.0, 1.0, 1.0])
    values = modal_kernel(kind, target, source, n_max=15)
    stretched = modal_kernel(kind, stretch * target, stretch * source, n_max=15)
    assert np.array_equal(stretched, values * 8.0**-power)


@pytest.mark.parametrize("kind", ["velocity_single", "traction_double"])
def test_modes_up_to_two_hundred_stay_sound(kind):
    target, source, difference, offsets = neighbours(0.7, 0.03, 1.0, 0.5)
    reference = modal_twin(kind, target, source, 200)
    values = modal_kernel(kind, row(target), row(source), row(difference), row(offsets), 200)[0]
    by_mode, overall = errors(values, reference)
    assert by_mode < 1e-13  # n xi = 6 roundings, and powers of it where terms of a mode cancel
    assert overall < 3e-15


# ---------------------------------------------------------------------------------------------
# how they are called


@pytest.mark.parametrize("kind", KINDS)
def test_bits_do_not_depend_on_threads_nor_on_the_way_of_calling(kind, pairs):
    target, source = (np.concatenate([points] * 4) for points in pairs)
    values = modal_kernel(kind, target, source, n_max=9)
    assert np.array_equal(modal_kernel(kind, target, source, n_max=9, threads=2), values)
    same_target = np.broadcast_to(target[5], source.shape)
    out = np.empty((len(source), 10, values.shape[2], 3))
    kernels.target_modes(KINDS[kind], tuple(target[5]), source, 9, kernels.new_workspace(9), out)
    assert np.array_equal(out, modal_kernel(kind, same_target, source, n_max=9))


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_pairs_modes_rows_columns(kind, pairs):
    rows = {"pressure": 1, "stress": 6}.get(kind.split("_")[0], 3)
    assert modal_kernel(kind, *pairs).shape == (40, 1, rows, 3)
    assert modal_kernel(kind, pairs[0][:0], pairs[1][:0], n_max=4).shape == (0, 5, rows, 3)


def test_what_is_no_pair_of_points_is_refused(pairs):
    target, source = pairs
    with pytest.raises(ValueError, match="none of"):
        modal_kernel("velocity", target, source)
    with pytest.raises(ValueError, match="coincide"):
        modal_kernel("velocity_single", target, target)
    with pytest.raises(ValueError, match="negative"):
        modal_kernel("velocity_single", target * [-1.0, 1.0, 1.0, 1.0], source)
    with pytest.raises(ValueError, match="source must be of shape"):
        modal_kernel("velocity_single", target, source[:-1])
    with pytest.raises(ValueError, match="offsets must be of shape"):
        modal_kernel("velocity_single", target, source, offsets=np.zeros((len(target), 1)))
    with pytest.raises(ValueError, match="mode -1"):
        modal_kernel("velocity_single", target, source, n_max=-1)
