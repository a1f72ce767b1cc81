"""Background flows: incompressible solutions of the Stokes equations, and their texts."""

from __future__ import annotations

import numpy as np
import pytest

from stokes.background import (
    LinearFlow,
    PoiseuilleFlow,
    SumOfFlows,
    UniformFlow,
    extensional_flow,
    parse_background,
    shear_flow,
)

ORIGIN = (0.3, -0.2, 0.7)
FLOWS = {
    "uniform": UniformFlow((1.0, -2.0, 0.5)),
    "shear": shear_flow(1.7, "xz", ORIGIN),
    "uniaxial extension": extensional_flow(0.8, "y", ORIGIN),
    "planar extension": extensional_flow(-0.6, "zx"),
    "linear": LinearFlow([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, -0.6]], ORIGIN),
    "tube": PoiseuilleFlow(2.0, 0.9, "z", ORIGIN),
    "planes": PoiseuilleFlow(2.0, 0.9, "xy", ORIGIN),
}
FLOWS["sum"] = SumOfFlows((FLOWS["uniform"], FLOWS["shear"], FLOWS["tube"]))
VISCOSITY = 1.9
STEP = 2.0**-6
# Central differences are exact for polynomials of degree two, but for round-off: about 1e-15 times
# a velocity of 10, divided once or twice by the step.
FIRST, SECOND = 1e-12, 1e-10


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(3).uniform(-1.0, 1.0, (20, 3))


def slopes(function, points):
    """d function / dx_j by central differences, stacked along the last axis."""
    steps = STEP * np.eye(3)
    return np.stack(
        [(function(points + s) - function(points - s)) / (2.0 * STEP) for s in steps], axis=-1
    )


def laplacian(function, points):
    steps = STEP * np.eye(3)
    parts = [function(points + s) - 2.0 * function(points) + function(points - s) for s in steps]
    return sum(parts) / STEP**2


@pytest.mark.parametrize("name", FLOWS)
def test_a_flow_has_its_gradient_and_keeps_volume(name, points):
    flow = FLOWS[name]
    gradient = flow.velocity_gradient(points)
    np.testing.assert_allclose(gradient, slopes(flow.velocity, points), rtol=0, atol=FIRST)
    np.testing.assert_allclose(np.trace(gradient, axis1=1, axis2=2), 0.0, atol=1e-14)


@pytest.mark.parametrize("name", FLOWS)
def test_viscous_force_balances_the_pressure_gradient(name, points):
    flow = FLOWS[name]
    force = VISCOSITY * laplacian(flow.velocity, points)
    gradient = slopes(lambda x: flow.pressure(x, VISCOSITY), points)
    np.testing.assert_allclose(force, gradient, rtol=0, atol=SECOND)


@pytest.mark.parametrize("name", FLOWS)
def test_stress_is_symmetric_and_its_trace_is_minus_three_pressures(name, points):
    stress = FLOWS[name].stress(points, VISCOSITY)
    np.testing.assert_array_equal(stress, np.swapaxes(stress, 1, 2))
    pressure = FLOWS[name].pressure(points, VISCOSITY)
    np.testing.assert_allclose(
        np.trace(stress, axis1=1, axis2=2), -3.0 * pressure, rtol=1e-14, atol=1e-13
    )


def test_tube_and_planes_have_full_speed_on_the_axis_and_none_at_the_walls():
    tube, planes = FLOWS["tube"], FLOWS["planes"]
    axis = np.array(ORIGIN) + [[0.0, 0.0, 5.0]]
    np.testing.assert_allclose(tube.velocity(axis), [[0.0, 0.0, 2.0]], rtol=1e-15)
    wall = np.array(ORIGIN) + 0.9 * np.array([[np.cos(0.4), np.sin(0.4), 3.0]])
    np.testing.assert_allclose(tube.velocity(wall), 0.0, atol=1e-14)
    wall = np.array(ORIGIN) + [[4.0, -0.9, 2.0]]
    np.testing.assert_allclose(planes.velocity(wall), 0.0, atol=1e-14)


def test_shear_turns_and_strains_in_equal_parts():
    G = np.array(shear_flow(3.0).gradient)
    np.testing.assert_array_equal(G, [[0, 0, 3], [0, 0, 0], [0, 0, 0]])
    assert np.linalg.norm(G + G.T) == np.linalg.norm(G - G.T)


@pytest.mark.parametrize("name", FLOWS)
def test_text_of_a_flow_gives_the_flow_back(name):
    assert parse_background(FLOWS[name].text) == FLOWS[name]
    assert hash(parse_background(FLOWS[name].text)) == hash(FLOWS[name])


@pytest.mark.parametrize(
    ("text", "flow"),
    [
        ("", UniformFlow((0.0, 0.0, 0.0))),
        ("uniform:0,0,-1e-3", UniformFlow((0.0, 0.0, -1e-3))),
        ("shear:2", shear_flow(2.0, "xz")),
        ("shear:2,yx@1,2,3", shear_flow(2.0, "yx", (1.0, 2.0, 3.0))),
        ("extension:1e+2", extensional_flow(100.0, "z")),
        ("extension:1,xz", extensional_flow(1.0, "xz")),
        ("poiseuille:1,0.5", PoiseuilleFlow(1.0, 0.5, "x")),
        ("uniform:1,0,0  shear:2", SumOfFlows((UniformFlow((1.0, 0.0, 0.0)), shear_flow(2.0)))),
    ],
)
def test_short_texts(text, flow):
    assert parse_background(text) == flow


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sheer:1", "must be one of uniform:ux,uy,uz, shear:rate"),
        ("uniform:1,2", "must be uniform:ux,uy,uz"),
        ("uniform:1,2,3@0,0,0", "must be uniform:ux,uy,uz"),
        ("uniform:1,2,nan", "finite"),
        ("shear:", "must be shear:rate"),
        ("shear:x", "must be shear:rate"),
        ("shear:nan", "finite"),
        ("shear:1,xx", "axes 'xx'"),
        ("shear:1,x", "axes 'x'"),
        ("shear:1,xw", "axes 'xw'"),
        ("shear:1@0,0", "[@x,y,z]"),
        ("extension:1,xyz", "axes 'xyz'"),
        ("linear:1,0,0,0,1,0,0,0,1", "trace 3"),
        ("poiseuille:1,0", "half width 0: must be > 0"),
        ("poiseuille:inf,1", "speed inf"),
    ],
)
def test_a_wrong_text_is_refused_with_the_rule(text, words):
    with pytest.raises(ValueError) as caught:
        parse_background(text)
    assert words in str(caught.value)
