import numpy as np
import pytest

from stokes.geometry import (
    Meridian,
    Resolution,
    ResolutionLadder,
    resolution_for,
    sphere,
    spherocylinder,
    spheroid,
)
from stokes.quadrature import interpolation_matrix


def image_field_error(resolution, gap, s):
    """Error of a grid for 1/|x - y|, y the nearest image across a gap over s, by its maximum."""
    meridian = Meridian(sphere(), resolution)
    D = gap / 2 + np.sqrt(gap + gap**2 / 4)
    y = (1 + D) * np.array([np.sin(np.pi * s), np.cos(np.pi * s)])

    def field(t, theta):
        r, z = np.sin(np.pi * t), np.cos(np.pi * t)
        return 1 / np.sqrt(r**2 + y[0] ** 2 - 2 * r * y[0] * np.cos(theta) + (z - y[1]) ** 2)

    angles = resolution.angles
    modes = np.fft.rfft(field(meridian.s[:, None], 2 * np.pi / angles * np.arange(angles)))
    modes = modes.reshape(resolution.panels, resolution.nodes, -1) / angles
    local = np.array([0.03, 0.2, 0.5, 0.7, 0.97])
    edges = np.array(resolution.breaks)
    t = edges[:-1, None] + np.diff(edges)[:, None] * local
    theta = np.array([0, 0.05, 0.3, 1.0, 2.0, 3.1])
    n = np.arange(modes.shape[2])
    waves = np.where(n > 0, 2, 1) * np.exp(1j * n * theta[:, None])
    found = np.einsum("xj,pjn,tn->pxt", interpolation_matrix(resolution.nodes, local), modes, waves)
    exact = field(t[..., None], theta)
    return np.abs(found.real - exact).max() / exact.max()


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8, 1e-12])
def test_levels_resolve_the_images_of_neighbours(tolerance):
    ladder = ResolutionLadder(sphere(), tolerance)
    for (pole, side), resolution in zip(ladder.gaps, ladder.levels, strict=True):
        # The images carry a tenth of the density: they are resolved to 10 tolerances.
        assert image_field_error(resolution, pole, 0.0) < 10 * tolerance
        for s in (0.1, 0.25, 0.5, 0.77):
            assert image_field_error(resolution, side, s) < 10 * tolerance


def test_error_falls_with_the_asked_tolerance():
    gap, s = 0.1, 0.4
    errors = [
        image_field_error(resolution_for(sphere(), 10.0**-k, [(gap, s)]), gap, s)
        for k in (4, 6, 8, 10)
    ]
    slopes = -np.diff(np.log10(errors))
    assert np.all(slopes > 1) and slopes.sum() > 5


def test_bodies_take_the_coarsest_level_that_serves_their_neighbours():
    ladder = ResolutionLadder(sphere(), 1e-6)
    assert len(ladder.levels) <= 6
    assert ladder.level([], []) == 0
    assert ladder.level([1.0], [0.3]) == 0
    side = ladder.level([0.1], [0.4])
    assert ladder.gaps[side][1] <= 0.1
    polar = ladder.resolution([0.01], [0.0])
    equatorial = ladder.resolution([0.01], [0.5])
    assert polar.modes < equatorial.modes
    assert polar == ladder.resolution([0.01, 0.6], [1.0, 0.5])
    assert ladder.level([0.01, 0.01], [0.0, 0.5]) == ladder.level([0.01], [0.5])
    with pytest.raises(ValueError, match=r"no level for the gap 0.0005 at s = 0"):
        ladder.level([0.5, 5e-4], [0.5, 0.0])
    with pytest.raises(ValueError, match=r"no level for the gap 0.005 at s = 0.5"):
        ladder.level([2e-3, 5e-3], [0.0, 0.5])


def test_modes_follow_the_decay_of_two_spheres():
    # exp(-alpha n), alpha = acosh(1 + gap/2), at the equator; panels at a polar contact halve.
    modes = np.array([resolution_for(sphere(), 1e-8, [(g, 0.5)]).modes for g in (1.0, 0.1, 0.01)])
    alpha = np.arccosh(1 + np.array([1.0, 0.1, 0.01]) / 2)
    np.testing.assert_allclose(modes * alpha, modes[0] * alpha[0], rtol=0.1)


@pytest.mark.parametrize(
    "curve", [spheroid(0.05, 1.0), spheroid(1.0, 0.05), spherocylinder(0.05, 0.95)]
)
def test_panels_resolve_slender_and_flat_shapes(curve):
    resolution = resolution_for(curve, 1e-10)
    meridian = Meridian(curve, resolution)
    local = np.array([0.02, 0.4, 0.9])
    matrix = interpolation_matrix(resolution.nodes, local)
    edges = np.array(resolution.breaks)
    points = curve.evaluate(edges[:-1, None] + np.diff(edges)[:, None] * local)
    for found, exact in (
        (meridian.normal_r, points.normal_r),
        (meridian.curvatures[:, 0], points.meridional_curvature),
        (meridian.curvatures[:, 1], points.azimuthal_curvature),
    ):
        values = found.reshape(resolution.panels, -1) @ matrix.T
        assert np.abs(values - exact).max() < 1e-9 * np.abs(exact).max()
    assert resolution.panels < 40


@pytest.mark.parametrize(
    "arguments",
    [((0.0, 0.5), 8, 2), ((0.0, 0.5, 0.5, 1.0), 8, 2), ((0.0, 1.0), 1, 2), ((0.0, 1.0), 8, -1)],
)
def test_impossible_resolutions_are_refused(arguments):
    with pytest.raises(ValueError, match="Resolution"):
        Resolution(*arguments)


def test_resolution_counts_its_nodes():
    resolution = Resolution.uniform(5, 10, 12)
    assert (resolution.panels, resolution.angles) == (5, 25)
    assert resolution.surface_nodes == 5 * 10 * 25
