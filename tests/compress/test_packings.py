"""The stand-in for stress, strain and moduli: what it is made of is right."""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType

import numpy as np
import pytest

from launch import ROOT


@pytest.fixture(scope="module")
def packings() -> ModuleType:
    path = ROOT / "scripts" / "bench" / "lib" / "compress_packings.py"
    spec = importlib.util.spec_from_file_location("compress_packings", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_moduli_of_a_linear_material_are_found(packings):
    rng = np.random.default_rng(1)
    moduli = 1e7 * rng.standard_normal((2, 6, 6))
    strain = 1e-4 * rng.standard_normal((50, 2, 6))
    stress = np.einsum("vij,tvj->tvi", moduli, strain)
    found = packings.tangent_moduli(strain, stress, 32).reshape(50, 2, 6, 6)
    # The ridge is 1e-3 of the mean square, and the window has few steps beyond 6.
    np.testing.assert_allclose(found, np.broadcast_to(moduli, found.shape), atol=1e-2 * 1e7)


def test_a_bed_at_rest_carries_its_weight(packings, tmp_path):
    few = packings.Packings(volumes=1, spheres=30, settling=100, steps=10, amplitude=1e-9)
    series = packings.packing_series(tmp_path, few)
    assert series["stress"].shape == (10, 1, 6)
    pressure = series["stress"][:, 0, 2].mean()
    # A load that grows evenly with depth has the mean rho g z, z the height of the centre of mass,
    # at the density of the bed: the weight over the area, halved. Walls carry some by friction.
    mass = 30 * 2500.0 * 4.0 / 3.0 * np.pi * packings.RADIUS**3
    mean = 0.5 * mass * 9.81 / packings.SIDE**2
    assert 0.5 * mean < pressure < 1.2 * mean
    again = packings.packing_series(tmp_path, few)
    np.testing.assert_array_equal(again["stress"], series["stress"])


def test_table_keeps_to_its_tolerances(packings):
    t = np.linspace(0.0, 1.0, 40)[:, None, None]
    series = {
        "strain": t * np.ones((40, 3, 6)),
        "noise": np.random.default_rng(2).random((40, 3, 6)),
    }
    rows = packings.table(series)
    assert len(rows) == 6
    assert all(row.relative_error <= row.tolerance for row in rows)
    assert {row.largest_rank for row in rows if row.variable == "strain"} == {1}
