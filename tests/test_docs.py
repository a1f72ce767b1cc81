"""What the pages under docs/ say, held against the program."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields

import pytest

from launch import ROOT, run_ranks

SCENE = """
name: two
domain: {min: [-1, -1, -1], max: [1, 1, 1]}
materials: {glass: {density: 2500}}
bodies:
  - {material: glass, count: 2, radius: 0.1,
     placement: {jittered_grid: {min: [0, 0, 0], max: [0.4, 0.4, 0.2]}}}
walls:
  - {shape: plane, material: glass, point: [0, 0, 0], normal: [0, 0, 1]}
time: {step: 1.0e-3, end: 3.0e-3}
output: {interval: 1.0e-3}
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    path = tmp_path_factory.mktemp("two")
    (path / "scene.yaml").write_text(SCENE)
    arguments = ["-m", "dem_mpi", "run", path / "scene.yaml", "--out", path]
    done = run_ranks(1, arguments, timeout=120)
    assert done.returncode == 0, done.stderr
    return path


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text()


def python_examples(text: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def keys_of_table(text: str, heading: str) -> set[str]:
    """The names in the first column of the first table behind a heading."""
    table = text.split(f"## {heading}\n")[1].split("\n\n## ")[0]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row)}


def test_h5py_example_reads_every_frame(directory):
    (example,) = re.findall(r"```python\n(.*?)```", page("output.md"), re.DOTALL)
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=directory, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    # The spheres lie on the plane, their centres at 0.1 m, from the first frame to the last.
    assert lines == [f"t = 0.00{k} s: 2 bodies, centre at z = 0.1000 m" for k in range(4)]


def test_every_column_of_metrics_is_explained(directory):
    from dem_mpi.simulation import StepRecord

    written = set(json.loads((directory / "metrics.jsonl").read_text().splitlines()[0]))
    assert {field.name for field in fields(StepRecord)} <= written
    assert keys_of_table(page("output.md"), "metrics.jsonl") == written


def test_every_field_of_the_trajectory_is_explained():
    from typing import get_args

    from dem_mpi.scene_models import BodyField

    assert keys_of_table(page("output.md"), "Reading run.h5 with h5py") == set(get_args(BodyField))


def test_scene_reference_is_up_to_date():
    script = ROOT / "scripts" / "make_scene_reference.py"
    done = subprocess.run(
        [sys.executable, script, "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_headings_of_the_scene_reference_are_told_apart():
    text = page("scenes.md")
    headings = re.findall(r"^## (.*)$", text, re.MULTILINE)
    assert len(headings) == len(set(headings))
    choices = [heading for heading in headings if heading.startswith("`bodies[].radius[")]
    assert choices == [
        f"`bodies[].radius[{c}]`" for c in ("uniform", "lognormal", "weighted", "mix")
    ]
    assert "`bodies[].radius.lognormal`" in headings
    assert re.search(r"\| `edges` \| 2 lists of 3 numbers \| m \|", text)


def test_links_between_pages_lead_somewhere():
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", path.read_text()):
            assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_scene_in_the_readme_is_the_shipped_one():
    (scene,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    shipped = (ROOT / "configs" / "quick.yaml").read_text()
    assert scene == "name:" + shipped.split("\nname:", 1)[1]
    assert len(scene.splitlines()) == 20


def test_h5py_example_of_the_readme_reads_the_last_frame(directory):
    example = python_examples((ROOT / "README.md").read_text())[0]
    example = example.replace("runs/quick/run.h5", "run.h5")
    done = subprocess.run(
        [sys.executable, "-c", example], cwd=directory, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("0.003 [[")


# ---- fast sums: fewer points than in the examples, to be quick ----------------------------------

FEWER = {"100_000": "5_000", "50_000": "2_000", "20_000": "3_000"}


def run_fast_sum(example: str, path, ranks: int = 1) -> str:
    """What an example of a fast sum prints, run from a file: a kernel's loops know it by that."""
    for many, few in FEWER.items():
        example = example.replace(many, few)
    (path / "example.py").write_text(example)
    done = run_ranks(ranks, [path / "example.py"], timeout=240)
    assert done.returncode == 0, done.stderr
    return done.stdout


def printed_error(text: str) -> float:
    return float(re.search(r"error (\S+)", text)[1])


@pytest.mark.parametrize(
    ("number", "ranks", "eps"),
    [(0, 1, 1e-6), (1, 2, 1e-3), (2, 1, 1e-4)],
    ids=["stokeslet", "two ranks", "own kernel"],
)
def test_examples_of_fast_sums_reach_the_asked_error(number, ranks, eps, tmp_path):
    example = python_examples(page("fmm.md"))[number]
    assert f"eps={eps:.0e}".replace("e-0", "e-") in example
    assert printed_error(run_fast_sum(example, tmp_path, ranks)) <= eps


def test_fast_sum_of_the_readme_reaches_the_asked_error(tmp_path):
    example = python_examples((ROOT / "README.md").read_text())[1]
    assert "eps=1e-6" in example
    assert printed_error(run_fast_sum(example, tmp_path)) <= 1e-6


def test_every_kernel_of_the_fast_sums_is_in_the_table():
    from stokes.fmm import KERNELS

    text = page("fmm.md").split("### A kernel of your own")[0]
    rows = re.findall(r"^\| `(\w+)` \|.*\| (\d+) → (\d+) \| (\d+) \| (\S+) \|$", text, re.MULTILINE)
    table = {name: row for name, *row in rows}
    for name, k in KERNELS.items():
        degree = "–" if k.degree is None else f"−{-k.degree:.0f}"
        assert table.pop(name) == [str(k.n_in), str(k.n_out), str(k.n_unique), degree]
    assert not table


def test_every_option_of_the_fast_sums_is_explained():
    from stokes.fmm import FmmOptions

    assert keys_of_table(page("fmm.md"), "Options") >= {field.name for field in fields(FmmOptions)}


# ---- compression -------------------------------------------------------------------------------


def run_compression(number: int, path) -> str:
    """What an example of compression prints, run in an empty directory."""
    example = python_examples(page("compress.md"))[number]
    (path / "example.py").write_text(example)
    done = subprocess.run(
        [sys.executable, "example.py"], cwd=path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_archive_of_the_example_meets_its_bound_and_reads_a_part(tmp_path):
    printed = run_compression(0, tmp_path)
    assert printed.startswith("(20, 100, 3)")
    assert 0.0 < printed_error(printed) <= 1e-2


def test_train_of_the_example_meets_its_tolerance_and_rounds_back(tmp_path):
    lines = run_compression(1, tmp_path).splitlines()
    assert 0.0 < printed_error(lines[0]) <= 1e-6
    assert lines[1].startswith("(100, 5)")
    # The longer tensor is x -> (1, 2)(x) times the first one: the same ranks do.
    ranks, rounded = lines[2].split(" -> ")
    assert lines[0].startswith(rounded) and ranks != rounded


def test_every_coder_of_archives_is_explained():
    from compress.coders import CODERS

    assert keys_of_table(page("compress.md"), "Coders") == set(CODERS)
