"""The examples of docs/stokes.md, as they stand there."""

from __future__ import annotations

import re
import subprocess
import sys

from launch import ROOT


def _run_example(number: int) -> str:
    page = (ROOT / "docs" / "stokes.md").read_text()
    example = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[number]
    done = subprocess.run(
        [sys.executable, "-c", example], capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _numbers(text: str) -> list[float]:
    return [float(word) for word in re.findall(r"-?\d+\.\d*(?:e[-+]\d+)?", text)]


def test_two_bodies_settle_and_drag_each_other_as_the_page_shows():
    printed = _run_example(0)
    velocities, rest = printed.split("forces")
    forces, flow = rest.split("flow")
    sphere, spheroid = _numbers(velocities)[:3], _numbers(velocities)[3:6]
    # Faster than the sphere alone, 1/(6 pi) = 0.053, with the spheroid before it.
    assert -0.053 > sphere[2] > -0.1
    assert -0.053 > spheroid[2] > -0.1
    # The sphere's drag alone is 6 pi = 18.8; a body at rest nearby makes it more.
    assert -18.8 > _numbers(forces)[0] > -25.0
    assert 0.0 < _numbers(flow)[0] < 1.0


def test_exact_solutions_are_had_as_the_page_shows():
    drag, *matrix = _numbers(_run_example(1))
    assert abs(drag - 11.346876506623) < 1e-10
    assert matrix[0] > 0.0 > matrix[1]
