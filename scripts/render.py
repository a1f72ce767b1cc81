#!/usr/bin/env python
"""Draw a frame of a trajectory without a screen: shaded bodies, boxes as outlines.

    .venv/bin/python scripts/render.py run.h5 [--frame last|K] [--colour height|speed]

Needs the extra `render` (scripts/bootstrap --with render) and, where no screen is, libosmesa6.
The file must hold radius, and velocity for colour by speed (both are written by default); for
bodies that are not spheres also orientation, half_length and shape (output.fields).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import vtk
from numpy.typing import NDArray
from vtk.util.numpy_support import numpy_to_vtk

from dem_mpi.scenario import Scenario, restore_scenario
from dem_mpi.scene_bodies import SHAPES
from dem_mpi.scene_walls import BoxWall

_WHITE, _INK, _WALL = (1.0, 1.0, 1.0), (0.12, 0.12, 0.14), (0.45, 0.47, 0.50)

_RODS, _SPHEROIDS = SHAPES.index("spherocylinder"), SHAPES.index("spheroid")

# Perceptually even, readable in grey and by the colour-blind; pale enough at its ends for shading.
_COLOURS = ((0.13, 0.24, 0.47), (0.14, 0.52, 0.60), (0.49, 0.75, 0.52), (0.96, 0.85, 0.42))


@dataclass(frozen=True)
class Picture:
    """What is drawn: n bodies, a value (n,) of each and its label, walls, title."""

    position: NDArray  # (n, 3) [m]
    radius: NDArray  # (n,) [m]
    shape: NDArray  # (n,) index into SHAPES
    half_length: NDArray  # (n,) [m] as in the trajectory
    orientation: NDArray  # (n, 4) unit quaternions, scalar first
    value: NDArray
    label: str
    boxes: tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]
    title: str


def main(arguments: list[str] | None = None) -> int:
    options = _options(arguments)
    try:
        picture = read(options.trajectory, options.frame, options.colour)
    except (OSError, KeyError, ValueError) as error:
        print(f"render: error: {options.trajectory}: {error}", file=sys.stderr)
        return 65
    figure = options.figure or options.trajectory.with_suffix(".png")
    draw(picture, figure, options.width)
    print(f"{picture.title}: {figure}")
    return 0


def _options(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n")[0], epilog=__doc__.split("\n\n", 2)[2]
    )
    parser.add_argument("trajectory", type=Path, metavar="RUN.h5")
    parser.add_argument(
        "--frame", default="last", help="frame number from 0, or last (default: last)"
    )
    parser.add_argument(
        "--colour", choices=("height", "speed"), default="height", help="(default: height)"
    )
    parser.add_argument("--figure", type=Path, help="PNG to write (default: beside RUN.h5)")
    parser.add_argument("--width", type=int, default=1280, help="pixels (default: 1280)")
    return parser.parse_args(arguments)


def read(path: Path, frame: str, colour: str) -> Picture:
    """Read one frame. KeyError or ValueError where it is not there or lacks a column."""
    with h5py.File(path, "r") as file:
        # Data sets reach beyond the frames that are complete.
        frames = int(file["VTKHDF/Steps"].attrs["NSteps"])
        k = frames - 1 if frame == "last" else int(frame)
        if not 0 <= k < frames:
            raise ValueError(f"frame {frame}: the file holds {frames}, numbered from 0")
        start, count = int(file["frames/offset"][k]), int(file["frames/count"][k])
        rows = slice(start, start + count)
        position, radius = file["position"][rows], file["radius"][rows]
        if colour == "speed":
            value, label = np.linalg.norm(file["velocity"][rows], axis=1), "speed, m/s"
        else:
            value, label = position[:, 2], "height, m"
        scenario = restore_scenario(json.loads(file.attrs["scene"]), path.parent)
        shape, half_length, orientation = _shapes(file, rows, count, scenario)
        kind = "bodies" if shape.any() else "spheres"
        title = f"{count:,} {kind} at t = {file['frames/time'][k]:.3g} s"
    return Picture(
        position, radius, shape, half_length, orientation, value, label, _boxes(scenario), title
    )


def _shapes(
    file: h5py.File, rows: slice, count: int, scenario: Scenario
) -> tuple[NDArray, NDArray, NDArray]:
    """Shape, half length and orientation of a frame; a scene of spheres need not have them."""
    if all(group.shape == "sphere" for group in scenario.bodies):
        return np.zeros(count, np.int8), np.zeros(count), np.tile([1.0, 0, 0, 0], (count, 1))
    missing = [name for name in ("shape", "half_length", "orientation") if name not in file]
    if missing:
        raise ValueError(f"bodies that are not spheres need {', '.join(missing)} in output.fields")
    return file["shape"][rows], file["half_length"][rows], file["orientation"][rows]


def _boxes(scenario: Scenario) -> tuple:
    return tuple((wall.min, wall.max) for wall in scenario.walls if isinstance(wall, BoxWall))


# ---- drawing -------------------------------------------------------------------------------


def draw(picture: Picture, figure: Path, width: int) -> None:
    """Write the picture as a PNG of width : height 4 : 3."""
    if "DISPLAY" not in os.environ:
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkOSOpenGLRenderWindow")
    renderer = vtk.vtkRenderer()
    renderer.SetBackground(*_WHITE)
    table = _colour_table(picture.value)
    for solids in _solids(picture, table):
        renderer.AddActor(solids)
    for low, high in picture.boxes:
        renderer.AddActor(_outline(low, high))
    renderer.AddViewProp(_legend(table, picture.label, width))
    _light(renderer)
    _shade_crevices(renderer, picture)
    _aim(renderer, picture)

    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(width, width * 3 // 4)
    window.AddRenderer(renderer)
    window.Render()
    _write(window, figure)


def _colour_table(value: NDArray) -> vtk.vtkLookupTable:
    ramp = vtk.vtkColorTransferFunction()
    ramp.SetColorSpaceToLab()
    for place, colour in zip(np.linspace(0.0, 1.0, len(_COLOURS)), _COLOURS, strict=True):
        ramp.AddRGBPoint(place, *colour)
    table = vtk.vtkLookupTable()
    table.SetNumberOfTableValues(256)
    for k in range(256):
        table.SetTableValue(k, *ramp.GetColor(k / 255.0), 1.0)
    low, high = (float(value.min()), float(value.max())) if value.size else (0.0, 1.0)
    table.SetTableRange(low, high if high > low else low + 1.0)
    table.Build()
    return table


def _solids(picture: Picture, table: vtk.vtkLookupTable) -> list[vtk.vtkActor]:
    """Return the bodies as stretched balls, and rods as tubes with a ball at either end."""
    fine = 32 if len(picture.radius) < 10_000 else 16
    ball = vtk.vtkSphereSource()  # of diameter 1
    ball.SetThetaResolution(fine)
    ball.SetPhiResolution(fine // 2)
    width, length = 2.0 * picture.radius, 2.0 * picture.half_length
    rods = picture.shape == _RODS
    thick = np.where(picture.shape == _SPHEROIDS, length, width)
    caps = 0.5 * length[rods, None] * _axis(picture.orientation[rods])
    place = picture.position
    position = np.concatenate([place[~rods], place[rods] + caps, place[rods] - caps])
    rows = np.concatenate([np.flatnonzero(~rods), *2 * [np.flatnonzero(rods)]])
    scale = np.stack([width, width, thick], axis=1)[rows]
    turned = picture.orientation[rows] if picture.shape.any() else None
    actors = [_glyphs(ball, position, scale, turned, picture.value[rows], table)]
    if rods.any():
        scale = np.stack([width, width, length], axis=1)[rods]
        turned = picture.orientation[rods]
        actors.append(_glyphs(_tube(fine), place[rods], scale, turned, picture.value[rods], table))
    return actors


def _axis(orientation: NDArray) -> NDArray:
    """Return the bodies' own z axes (n, 3) in the world."""
    w, x, y, z = orientation.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def _tube(fine: int) -> vtk.vtkTubeFilter:
    """Return an open cylinder of diameter 1 and length 1 along z."""
    line = vtk.vtkLineSource()
    line.SetPoint1(0.0, 0.0, -0.5)
    line.SetPoint2(0.0, 0.0, 0.5)
    tube = vtk.vtkTubeFilter()
    tube.SetInputConnection(line.GetOutputPort())
    tube.SetRadius(0.5)
    tube.SetNumberOfSides(fine)
    tube.CappingOff()
    return tube


def _glyphs(
    source: vtk.vtkAlgorithm,
    position: NDArray,
    scale: NDArray,
    orientation: NDArray | None,
    value: NDArray,
    table: vtk.vtkLookupTable,
) -> vtk.vtkActor:
    """Return shaded copies of a polygonal source, stretched by scale (n, 3), then turned."""
    points = vtk.vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(position), deep=True))
    data = vtk.vtkPolyData()
    data.SetPoints(points)
    columns = {"scale": scale, "value": value}
    if orientation is not None:
        columns["orientation"] = orientation
    for name, column in columns.items():
        array = numpy_to_vtk(np.ascontiguousarray(column), deep=True)
        array.SetName(name)
        data.GetPointData().AddArray(array)
    data.GetPointData().SetActiveScalars("value")

    mapper = vtk.vtkGlyph3DMapper()
    mapper.SetInputData(data)
    mapper.SetSourceConnection(source.GetOutputPort())
    mapper.SetScaleArray("scale")
    mapper.SetScaleModeToScaleByVectorComponents()
    mapper.SetOrient(orientation is not None)
    if orientation is not None:
        mapper.SetOrientationArray("orientation")
        mapper.SetOrientationModeToQuaternion()
    mapper.SetLookupTable(table)
    mapper.UseLookupTableScalarRangeOn()
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    surface = actor.GetProperty()
    surface.SetInterpolationToPhong()
    surface.SetAmbient(0.22)
    surface.SetDiffuse(0.80)
    surface.SetSpecular(0.18)
    surface.SetSpecularPower(25.0)
    return actor


def _outline(low: tuple[float, ...], high: tuple[float, ...]) -> vtk.vtkActor:
    box = vtk.vtkOutlineSource()
    box.SetBounds(*[side for pair in zip(low, high, strict=True) for side in pair])
    mapper = vtk.vtkPolyDataMapper()
    mapper.SetInputConnection(box.GetOutputPort())
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(*_WALL)
    actor.GetProperty().SetLineWidth(2.0)
    actor.GetProperty().LightingOff()
    return actor


def _legend(table: vtk.vtkLookupTable, label: str, width: int) -> vtk.vtkScalarBarActor:
    bar = vtk.vtkScalarBarActor()
    bar.SetLookupTable(table)
    bar.SetTitle(label + "\n ")  # the empty line keeps it off the bar
    bar.SetNumberOfLabels(4)
    bar.SetLabelFormat("%.2g")
    bar.SetOrientationToVertical()
    bar.SetPosition(0.885, 0.30)
    bar.SetWidth(0.075)
    bar.SetHeight(0.42)
    bar.UnconstrainedFontSizeOn()
    for text in (bar.GetTitleTextProperty(), bar.GetLabelTextProperty()):
        text.SetColor(*_INK)
        text.SetFontSize(width // 60)
        text.BoldOff()
        text.ItalicOff()
        text.ShadowOff()
    return bar


def _light(renderer: vtk.vtkRenderer) -> None:
    for place, intensity in (((-0.7, 0.9, 1.0), 0.95), ((1.0, 0.2, 0.6), 0.35)):
        light = vtk.vtkLight()
        light.SetLightTypeToCameraLight()
        light.SetPosition(*place)
        light.SetIntensity(intensity)
        renderer.AddLight(light)


def _shade_crevices(renderer: vtk.vtkRenderer, picture: Picture) -> None:
    """Darken what lies deep between spheres: without it a dense bed looks flat."""
    basic = vtk.vtkRenderStepsPass()
    crevices = vtk.vtkSSAOPass()
    crevices.SetRadius(3.0 * float(np.median(picture.radius)) if picture.radius.size else 1.0)
    crevices.SetBias(0.02 * crevices.GetRadius())
    crevices.SetKernelSize(96)
    crevices.BlurOn()
    crevices.SetDelegatePass(basic)
    smooth = vtk.vtkSSAAPass()
    smooth.SetDelegatePass(crevices)
    renderer.SetPass(smooth)


def _aim(renderer: vtk.vtkRenderer, picture: Picture) -> None:
    """Look at the bodies from a corner, a little from above; open walls may reach out of view."""
    reach = (picture.radius + picture.half_length)[:, None]
    low = np.min(picture.position - reach, axis=0, initial=np.inf)
    high = np.max(picture.position + reach, axis=0, initial=-np.inf)
    if not np.all(low <= high):
        low, high = np.zeros(3), np.ones(3)
    centre, span = 0.5 * (low + high), float(np.linalg.norm(high - low))
    direction = np.array([0.50, -1.0, 0.62])
    camera = renderer.GetActiveCamera()
    camera.SetViewAngle(24.0)
    camera.SetFocalPoint(*centre)
    camera.SetPosition(*(centre + 2.2 * span * direction / np.linalg.norm(direction)))
    camera.SetViewUp(0.0, 0.0, 1.0)
    renderer.ResetCameraClippingRange()


def _write(window: vtk.vtkRenderWindow, figure: Path) -> None:
    image = vtk.vtkWindowToImageFilter()
    image.SetInput(window)
    image.ReadFrontBufferOff()
    figure.parent.mkdir(parents=True, exist_ok=True)
    writer = vtk.vtkPNGWriter()
    writer.SetFileName(str(figure))
    writer.SetCompressionLevel(9)
    writer.SetInputConnection(image.GetOutputPort())
    writer.Write()


if __name__ == "__main__":
    sys.exit(main())
