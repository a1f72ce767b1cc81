"""The forces that a preconditioner knows of between bodies far from each other."""

from __future__ import annotations

import math

import numpy as np
import pytest

from stokes.coarse import _flat, _mobility
from stokes.exact import two_spheres_axial
from stokes.geometry import Body, sphere, spheroid
from stokes.suspension import Suspension, SuspensionOptions

from suspensions import quaternion


def test_mobility_of_far_spheres_is_exact_up_to_the_fourth_power_of_distance():
    """What two spheres reflect to each other twice is left out: (1/r^2)^2 of their stresslets."""
    errors = []
    for distance in (6.0, 12.0, 24.0):
        centre = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, distance]])
        drag = 6.0 * math.pi * np.tile(np.eye(3), (2, 1, 1))
        found = _mobility(centre, drag)[:, :, 2, 2]
        exact = np.linalg.inv(two_spheres_axial(1.0, 1.0, distance - 2.0))
        errors.append(np.abs(found - exact).max())
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.2)


def test_mobility_is_symmetric_and_positive_for_spheres_in_touch():
    places = 2.0 * np.stack(np.meshgrid(*[range(4)] * 3), axis=-1).reshape(-1, 3)
    drag = 6.0 * math.pi * np.tile(np.eye(3), (len(places), 1, 1))
    matrix = _flat(_mobility(places, drag))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    assert np.linalg.eigvalsh(matrix).min() > 0.0


def test_iterations_stay_where_forces_add_up():
    """8 for 8 and for 27 bodies; 13 and 16 without the coupling of forces."""
    counts = []
    for edge in (2, 3):
        places = 2.6 * np.stack(np.meshgrid(*[range(edge)] * 3), axis=-1).reshape(-1, 3)
        bodies = [
            Body((sphere(), spheroid(0.6, 1.0))[k % 2], 1.0, tuple(place), quaternion(k))
            for k, place in enumerate(places.tolist())
        ]
        options = SuspensionOptions(preconditioner="body")
        motions = np.random.default_rng(2).standard_normal((len(bodies), 3))
        found = Suspension(bodies, tolerance=1e-3, options=options).solve(velocity=motions)
        counts.append(found.iterations)
    assert counts[1] <= counts[0] + 1
