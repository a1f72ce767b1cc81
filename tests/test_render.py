"""Pictures of a trajectory, drawn without a screen (needs the extra `render`)."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import numpy as np
import pytest

from launch import ROOT, run_ranks

if importlib.util.find_spec("vtk") is None:
    pytest.skip("the extra `render` is not installed", allow_module_level=True)

SCRIPT = ROOT / "scripts" / "render.py"

# Eight spheres in a box for one step.
SCENE = """
name: eight
domain: {min: [-1, -1, -1], max: [1, 1, 1]}
materials: {glass: {density: 2500}}
bodies:
  - {material: glass, count: 8, radius: 0.1,
     placement: {jittered_grid: {min: [0, 0, 0], max: [0.4, 0.4, 0.4]}}}
walls:
  - {shape: box, material: glass, min: [0, 0, 0], max: [0.4, 0.4, 0.6], open: [z_max]}
time: {step: 1.0e-3, end: 1.0e-3}
"""


@pytest.fixture(scope="module")
def trajectory(tmp_path_factory):
    directory = tmp_path_factory.mktemp("eight")
    scene = directory / "scene.yaml"
    scene.write_text(SCENE)
    done = run_ranks(1, ["-m", "dem_mpi", "run", scene, "--out", directory], timeout=120)
    assert done.returncode == 0, done.stderr
    return directory / "run.h5"


def render(*arguments):
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    return subprocess.run(
        [sys.executable, SCRIPT, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=environment,
        timeout=120,
        check=False,
    )


def pixels(figure):
    """(height, width, 3) of a PNG, read by VTK."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkPNGReader()
    reader.SetFileName(str(figure))
    reader.Update()
    image = reader.GetOutput()
    width, height, _ = image.GetDimensions()
    return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)[..., :3]


def test_spheres_stand_on_white_and_are_coloured_by_height(trajectory, tmp_path):
    figure = tmp_path / "eight.png"
    done = render(trajectory, "--figure", figure, "--width", 400)
    assert done.returncode == 0, done.stderr
    image = pixels(figure).astype(int)
    assert image.shape == (300, 400, 3)
    assert (image[0] == 255).mean() > 0.9  # the edge of the picture is background
    drawn = np.any(image < 200, axis=2)[:, :320]  # without the legend
    assert 0.15 < drawn.mean() < 0.7
    # Rows count from the bottom, where the ramp is blue; at its top it is yellow.
    rows = np.flatnonzero(drawn.any(axis=1))
    middle = (rows[0] + rows[-1]) // 2
    low, high = (part[np.any(part < 200, axis=-1)] for part in (image[:middle], image[middle:]))
    assert (low[:, 2] - low[:, 0]).mean() > (high[:, 2] - high[:, 0]).mean() + 20


def test_a_frame_that_is_not_there_is_refused(trajectory, tmp_path):
    done = render(trajectory, "--frame", "7", "--figure", tmp_path / "none.png")
    assert done.returncode == 65
    assert "the file holds 2, numbered from 0" in done.stderr
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize("shape", ["spherocylinder", "spheroid"])
@pytest.mark.parametrize("axis", ["x", "z"])
def test_long_bodies_point_where_they_point(shape, axis, tmp_path):
    """One body six times as long as wide: the picture of a lying one is wider than high, and that
    of a standing one higher than wide."""
    direction = {"x": "[1, 0, 0]", "z": "[0, 0, 1]"}[axis]
    group = f"shape: {shape}, aspect_ratio: 6, axis: {direction}, material: glass, count: 1"
    scene = SCENE.replace("material: glass, count: 8", group).replace("radius: 0.1", "radius: 0.03")
    fields = "output: {fields: [position, orientation, radius, half_length, shape]}\n"
    (tmp_path / "scene.yaml").write_text(scene + fields)
    arguments = ["-m", "dem_mpi", "run", tmp_path / "scene.yaml", "--out", tmp_path]
    done = run_ranks(1, arguments, timeout=300)
    assert done.returncode == 0, done.stderr
    figure = tmp_path / "long.png"
    done = render(tmp_path / "run.h5", "--figure", figure, "--width", 400)
    assert done.returncode == 0, done.stderr
    image = pixels(figure).astype(int)[:, :320]
    coloured = np.ptp(image, axis=2) > 40  # the box is grey
    high, wide = (np.ptp(np.flatnonzero(coloured.any(axis=k))) for k in (1, 0))
    assert (wide > 1.3 * high) if axis == "x" else (high > 1.3 * wide)


def test_bodies_without_their_directions_are_refused(tmp_path):
    group = "shape: spheroid, aspect_ratio: 2, material: glass, count: 8"
    scene = SCENE.replace("material: glass, count: 8", group).replace("radius: 0.1", "radius: 0.05")
    (tmp_path / "scene.yaml").write_text(scene)
    arguments = ["-m", "dem_mpi", "run", tmp_path / "scene.yaml", "--out", tmp_path]
    assert run_ranks(1, arguments, timeout=300).returncode == 0
    done = render(tmp_path / "run.h5", "--figure", tmp_path / "none.png")
    assert done.returncode == 65
    assert "need shape, half_length, orientation in output.fields" in done.stderr
