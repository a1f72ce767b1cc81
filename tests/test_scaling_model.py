"""The model by which scripts/bench/scaling.py goes from few cores to many."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from launch import ROOT


def load_model():
    path = ROOT / "scripts" / "bench" / "lib" / "scaling_model.py"
    spec = importlib.util.spec_from_file_location("scaling_model", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["scaling_model"] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


model = load_model()
COST = model.Cost(detection=1e-6, other=5e-7, contact=6e-8, slowdown=1.25)
LOAD = model.Load(bodies=1e5, contacts=3e5, bytes=2e6, messages=10.0, reductions=2.0)


def test_one_rank_pays_for_its_contacts_alone():
    lonely = model.Load(bodies=1e5, contacts=3e5, bytes=0.0, messages=0.0, reductions=2.0)
    slow = model.Network(latency=1.0, bandwidth=1.0)
    assert model.product_seconds(COST, lonely, 1, slow) == pytest.approx(3e5 * 6e-8 * 1.25)


def test_each_term_of_a_product_is_there_once():
    network = model.Network(latency=1e-3, bandwidth=1e9)
    seconds = model.product_seconds(COST, LOAD, 512, network)
    # contacts + bytes + messages + two reductions of nine levels
    assert seconds == pytest.approx(3e5 * 6e-8 * 1.25 + 2e-3 + 10e-3 + 2 * 9 * 1e-3)


def test_a_step_is_detection_the_rest_and_all_products():
    network = model.Network()
    part = model.step_seconds(COST, LOAD, 8, 700.0, network)
    assert part["detection"] == pytest.approx(0.125)
    assert part["other"] == pytest.approx(0.0625)
    assert part["solve"] == pytest.approx(700 * model.product_seconds(COST, LOAD, 8, network))


@pytest.mark.parametrize("exponent", [0.5, 1 / 3])
def test_what_squares_and_cubes_of_ranks_send_is_prolonged_exactly(exponent):
    # Of k^d equal blocks each of the 2 d (k - 1) k^(d - 1) pairs of sides sends a message:
    # a block sends 2 d (1 - 1/k) of them on average, and k = P^(1/d).
    d = round(1 / exponent)
    k = np.arange(2, 5)
    law = model.surface_law(k**d, 2 * d * (1 - 1 / k), exponent)
    assert law == pytest.approx((2 * d, 1.0))
    assert model.surface_amount(law, 10**d, exponent) == pytest.approx(2 * d * 0.9)


def test_trend_of_the_thesis_stays_within_its_scatter():
    told = [model.thesis_iterations(cores) for cores in model.THESIS_CORES]
    scatter = np.abs(np.subtract(told, model.THESIS_ITERATIONS))
    # Neighbouring entries of the table differ by up to 50, not always upwards.
    assert scatter.max() < 50
    assert model.THESIS_ITERATIONS[-1] < model.thesis_iterations(512) < 900


def test_exponent_of_a_power_law():
    x = np.array([1e4, 1e5, 2e6])
    assert model.power(x, 3.0 * x**1.05) == pytest.approx(1.05)
