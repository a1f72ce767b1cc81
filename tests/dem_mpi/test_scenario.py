"""Scene files: what is read, what is refused and with which words."""

from __future__ import annotations

import json
import math
import pickle
import random
import re
import time
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml

from dem_mpi import yaml_reader
from dem_mpi.errors import InputError
from dem_mpi.scenario import (
    body_count,
    difference,
    friction_table,
    frictional,
    json_schema,
    load_scenario,
    parse_scenario,
    restore_scenario,
)
from dem_mpi.walls import wall_faces
from dem_mpi.yaml_reader import MAX_BYTES, parse

from scene_header import read_header

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))

SCENE = """\
domain: {min: [0, 0, 0], max: [1, 1, 2]}
gravity: [0, 0, -9.81]
materials:
  glass: {density: 2500}
  steel: {density: 7800}
friction:
  default: 0.3
  pairs:
    - {between: [glass, steel], mu: 0.5}
bodies:
  - material: glass
    count: 100
    radius: 0.01
    placement:
      jittered_grid: {min: [0, 0, 0], max: [0.5, 0.5, 0.5], jitter: 1}
walls:
  - {shape: box, name: box, material: steel, min: [0, 0, 0], max: [1, 1, 2], open: [z_max]}
time: {step: 1e-3, end: 1}
contact: {tolerance: 1e-3}
"""


def refusal(*overrides: str, text: str = SCENE) -> str:
    """The message that a scene is refused with."""
    with pytest.raises(InputError) as caught:
        parse_scenario(text, "scene.yaml", overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.exit_code == 64
    return message


# --- what is read ---------------------------------------------------------------------------


def test_numbers_follow_the_yaml_1_2_core_schema():
    text = "[1e-3, 1.5, .5, 0x10, 0o17, +3, true, null, ~, 1:30, yes, off, 1_000, '1', 012]"
    expected = [1e-3, 1.5, 0.5, 16, 15, 3, True, None, None]
    expected += ["1:30", "yes", "off", "1_000", "1", 12]
    values = parse(f"v: {text}", "s").data["v"]
    assert values == expected
    assert [type(v) for v in values] == [type(v) for v in expected]


def test_aliases_repeat_a_value():
    data = parse("a: &shape {r: [1, 2]}\nb: *shape\n", "s").data
    assert data["b"] == {"r": [1, 2]}
    assert data["b"] is not data["a"]


def test_effective_scene_is_json_and_restores_the_scenario():
    loaded = parse_scenario(SCENE, "scene.yaml")
    effective = json.loads(json.dumps(loaded.effective))
    assert effective["output"]["interval"] == pytest.approx(0.01)
    assert effective["checkpoint"]["interval"] == pytest.approx(0.05)
    restored = restore_scenario(effective)
    assert restored.output_every == loaded.scenario.output_every == 10
    assert restored.checkpoint_every == loaded.scenario.checkpoint_every == 50
    assert restored.steps == loaded.scenario.steps == 1000
    assert difference(effective, effective) == []


def test_difference_names_the_changed_keys():
    old = parse_scenario(SCENE, "s").effective
    new = parse_scenario(SCENE, "s", ["contact.tolerance=1e-4", "time.stop_at_rest={}"]).effective
    lines = difference(old, new)
    assert "contact.tolerance: 0.001 -> 0.0001" in lines
    assert "time.stop_at_rest.max_speed: added 0.01" in lines


def test_loaded_scene_travels_between_ranks():
    loaded = parse_scenario(SCENE, "scene.yaml")
    assert pickle.loads(pickle.dumps(loaded)) == loaded


def test_reader_without_libyaml_reads_and_refuses_the_same(monkeypatch: pytest.MonkeyPatch):
    fast = parse(SCENE, "s")
    typo = refusal(text=SCENE.replace("tolerance", "tolerence"))
    monkeypatch.setattr(yaml_reader, "_Loader", yaml.SafeLoader)
    assert parse(SCENE, "s") == fast
    assert refusal(text=SCENE.replace("tolerance", "tolerence")) == typo
    assert "nested more than" in refusal(text="a: " + "[" * 5000)
    assert "not valid YAML" in refusal(text="a: \x00")


def test_scenario_is_frozen():
    scenario = parse_scenario(SCENE, "s").scenario
    with pytest.raises(ValueError, match="frozen"):
        scenario.threads = 2


def test_overrides_name_list_items_both_ways_and_make_missing_sections():
    overrides = ["bodies.0.count=5", "walls[0].open=[]", "time.stop_at_rest.steps=7"]
    scenario = parse_scenario(SCENE, "s", overrides).scenario
    assert body_count(scenario) == 5
    assert scenario.walls[0].open == ()
    assert scenario.time.stop_at_rest.steps == 7


def test_friction_table_is_symmetric_with_the_default_elsewhere():
    names, table = friction_table(parse_scenario(SCENE, "s").scenario)
    assert names == ["glass", "steel"]
    np.testing.assert_array_equal(table, [[0.3, 0.5], [0.5, 0.3]])


def test_frictional_counts_only_pairs_that_can_touch():
    assert frictional(parse_scenario(SCENE, "s").scenario)
    frictionless = ["friction.default=0", "friction.pairs=[{between: [steel, steel], mu: 1}]"]
    assert not frictional(parse_scenario(SCENE, "s", frictionless).scenario)


def test_box_faces_point_inwards_and_open_faces_are_left_out():
    faces = wall_faces(parse_scenario(SCENE, "s").scenario)
    assert faces.name == ("box.x_min", "box.x_max", "box.y_min", "box.y_max", "box.z_min")
    inside = np.array([0.3, 0.4, 0.5])
    assert (((inside - faces.point) * faces.normal).sum(axis=1) > 0).all()
    assert faces.material.tolist() == [1] * 5


def test_plane_normal_is_normalised_and_motion_is_passed_on():
    plane = (
        "walls=[{shape: plane, material: glass, point: [0, 0, -1], normal: [0, 3, 4], "
        "motion: {velocity: [1, 0, 0], oscillation: {amplitude: [0, 0, .1], frequency: 2}}}]"
    )
    faces = wall_faces(parse_scenario(SCENE, "s", [plane]).scenario)
    np.testing.assert_allclose(faces.normal, [[0, 0.6, 0.8]])
    (motion,) = faces.motion
    assert motion.velocity == (1, 0, 0)
    assert motion.oscillation.amplitude == (0, 0, 0.1)
    assert (motion.oscillation.frequency, motion.oscillation.phase) == (2.0, 0.0)


def test_scene_without_walls_has_empty_faces():
    faces = wall_faces(parse_scenario(SCENE, "s", ["walls=[]"]).scenario)
    assert faces.normal.shape == (0, 3)


# --- what is refused: file, line, key, value, rule, nearest key -----------------------------


def test_typo_names_file_line_key_value_and_nearest_key():
    message = refusal(text=SCENE.replace("tolerance", "tolerence"))
    assert message == (
        "scene.yaml:19: contact.tolerence = 0.001: unknown key. Did you mean 'tolerance'?"
    )


def test_override_error_names_the_override_instead_of_a_line():
    message = refusal("contact.tolerence=1e-3")
    assert message.startswith("--set contact.tolerence=1e-3: contact.tolerence = 0.001: unknown")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("bodies.0.radius=-0.01", "bodies[0].radius = -0.01: must be > 0 [m]"),
        ("bodies.0.radius=[0.01, 0]", "bodies[0].radius[1] = 0: must be > 0 [m]"),
        ("bodies.0.radius={uniform: [2, 1]}", "below the largest"),
        ("bodies.0.radius='0.01'", "must be a number, not text; write 0.01 without quotes"),
        ("bodies.0.radius=0,01", "must be a number, not text; write 0.01 with a decimal point"),
        ("bodies.0.radius=.nan", "must be a finite number"),
        ("bodies.0.radius=1e400", "must be a finite number"),
        ("bodies.0.radius=1e-200", "between 1e-30 and 1e30"),
        ("bodies.0.radius=0.4", "too thin for bodies of diameter 0.8 m"),
        ("bodies.0.radius=null", "radius is required"),
        ("bodies.0.count=1.5", "must be a whole number"),
        ("contact.max_iterations=99999999999999999999", "must be a whole number of at most 18 dig"),
        ("contact.max_iterations=-1e30", "must be a whole number of at most 18 digits"),
        ("contact.max_iterations=1e3", "must be a whole number; write 1000"),
        ("contact.scip.workspace=3000000000", "must be <= 1000"),
        ("bodies.0.count=5.0", "write 5"),
        ("bodies.0.count=true", "must be a whole number, not a switch"),
        ("bodies.0.count=0", "must be >= 1"),
        ("bodies.0.count=100000", "15625 do. Lower count or enlarge"),
        ("bodies.0.density=2500", "'density' is a key of materials.<name>"),
        ("bodies.0.material=gloss", "unknown material. Did you mean 'glass'?"),
        ("bodies.0.placement={}", "exactly one of jittered_grid, random, insertion and file"),
        ("bodies.0.placement.jittered_grid.jitter=1.1", "must be <= 1"),
        ("bodies.0.placement.jittered_grid.spacing=0.01", "at least the largest diameter, 0.02 m"),
        ("bodies.0.placement.jittered_grid.max=[1,1,0]", "above min on every axis (z: 0 and 0)"),
        ("bodies.0.placement.jittered_grid.min=[0,0,-1]", "behind wall 'box.z_min'"),
        ("bodies.0.placement={file: missing.csv}", "no file missing.csv"),
        ("bodies.0.placement={file: bodies.txt}", "must end in .csv, .h5 or .hdf5"),
        ("bodies=[]", "must have at least 1 item"),
        ("bodies.1.count=3", "bodies has 1 items, numbered from 0; '1' is none of them"),
        ("gravity=[0, 0]", "gravity = [0, 0]: must be a list of more than 2 items"),
        ("gravity=[0, 0, 0, 0]", "must have at most 3 item(s)"),
        ("gravity=-9.81", "must be a list, not a number"),
        ("gravity=[0, 0, down]", "gravity[2]"),
        ("materials.bad name={density: 1}", "no key path"),
        ("materials.9={density: 1}", "a name starts with a letter"),
        ("materials.iron={}", "materials.iron.density: this key is required [kg/m^3]"),
        ("materials.iron={density: 0}", "must be > 0 [kg/m^3]"),
        ("friction.default=-1", "must be >= 0"),
        ("friction.pairs.0.between=[glass, stel]", "Did you mean 'steel'?"),
        ("friction.pairs.0.between=[glass]", "friction.pairs[0].between"),
        (
            "friction.pairs=[{between: [glass, steel], mu: 1}, {between: [steel, glass], mu: 2}]",
            "already in friction.pairs[0]",
        ),
        ("walls.0.shape=bax", 'walls[0].shape = "bax": must be one of plane, box, rectangle'),
        ("walls.0.nam=box", "Did you mean 'name'?"),
        ("walls.0.open=[z_mux]", "Did you mean 'z_max'?"),
        ("walls.0.motion.velocity=1", "walls[0].motion.velocity = 1: must be a list"),
        ("walls=[{shape: plane, material: glass, point: [0,0,0], normal: [0,0,0]}]", "direction"),
        ("domain.max=[0, 1, 1]", "above min on every axis (x: 0 and 0)"),
        ("time.step=0", "time.step = 0: must be > 0 [s]"),
        ("time.step=0.3", "time.end = 1: must be a whole number of steps of 0.3 s; nearest: 0.9"),
        ("time.step=1e-25", "more than 2^53 steps"),
        ("time.end=1e-4", "nearest: 0.001"),
        ("time.stop_at_rest=true", "must be a mapping"),
        ("output.interval=2.5e-3", "nearest: 0.002 or 0.003"),
        ("output.path=../run.h5", "--out names the directory"),
        ("output.fields=[speed]", "must be one of position, velocity"),
        ("checkpoint.keep=0", "must be >= 1"),
        ("contact.scip={form: contact, linear: cg}", "cg solves for velocities of bodies"),
        ("contact.solver=apdg", "must be one of apgd, scip, auto. Did you mean 'apgd'?"),
        ("contact.warm_start=yes", "must be true or false, not text"),
        ("contact.recovery_speed=0", "must be > 0 [m/s]"),
        ("threads=0", "must be >= 1"),
        ("seed=-1", "must be >= 0"),
        ("time", "write --set key.path=value"),
        ("=3", "no key path"),
        ("name.x=3", "name"),
        ("time.step.x=3", "time.step = 0.001 has no keys"),
        ("seed=[1", "not valid YAML"),
        ("seed=1\nthreads: 2", "one value on one line"),
        ("seed=!!int 1", "tag"),
    ],
)
def test_bad_value_is_refused_with_its_rule(override: str, words: str):
    message = refusal(override)
    assert words in message
    assert message.startswith(("--set ", "scene.yaml:"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "empty"),
        ("# only a comment\n", "empty"),
        ("null\n", "empty"),
        ("42\n", "a scene is a mapping of keys to values, not a number"),
        ("- a\n- b\n", "not a list"),
        ("a: [1, 2\nb: 3\n", "not valid YAML"),
        ("a: 1\n\tb: 2\n", "not valid YAML"),
        ("seed: 1\nthreads: 2\nseed: 3\n", "scene.yaml:3: seed: duplicate key; the first one is"),
        ("time: {step: 1, step: 2}\n", "scene.yaml:1: time.step: duplicate key"),
        ("seed: 1\n---\nseed: 2\n", "scene.yaml:2: a second YAML document"),
        ("seed: !!python/object/apply:os.system [ls]\n", "is not allowed; write the plain value"),
        ("seed: !secret 1\n", "'!secret' is not allowed"),
        ("? [a, b]\n: 1\n", "a key must be plain text"),
        ("&k seed: 1\n", "a key cannot carry an anchor"),
        ("seed: *nowhere\n", "alias *nowhere"),
        ("a: &a [*a]\n", "alias *a stands for nothing that is complete"),
        ("<<: {seed: 1}\n", "unknown key"),
        ("a: \x07\n", "not valid YAML"),
        ("a: " + "[" * 5000 + "]" * 5000, "nested more than 32 levels deep"),
        ("a: " + "[" * 200_000, "nested more than 32 levels deep"),
        ("\n".join("  " * i + f"k{i}:" for i in range(200)), "nested more than 32 levels deep"),
        ("v: [" + "1," * 120_000 + "]", "more than 100000 values"),
        ("v: &v 1\nw: [" + "*v," * 101 + "]", "more than 100 aliases"),
    ],
)
def test_unusual_yaml_is_refused(text: str, words: str):
    assert words in refusal(text=text)


def test_alias_bomb_is_refused_before_it_expands():
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    for i in range(1, 10):
        lines.append(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]")
    start = time.perf_counter()
    assert "more than 100000 values" in refusal(text="\n".join(lines))
    assert time.perf_counter() - start < 10


def test_nested_aliases_cannot_pass_the_depth_limit():
    lines = ["a0: &a0 [[[[[[[[[[1]]]]]]]]]]"]
    for i in range(1, 5):
        lines.append(f"a{i}: &a{i} [[[[[[[[[[*a{i - 1}]]]]]]]]]]")
    assert "nested more than 32 levels deep" in refusal(text="\n".join(lines))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\xff\xfe\x00seed", "not UTF-8 text"),
        (b"seed: 1\nname: \xe9\n", "scene.yaml:2: not UTF-8"),
        (b"\x89HDF\r\n\x1a\n" + bytes(100), "not UTF-8"),
        (bytes(50), "not valid YAML"),
        (b"#" * (MAX_BYTES + 1), "larger than 1000000 bytes"),
    ],
)
def test_file_that_is_no_text_is_refused(tmp_path: Path, content: bytes, words: str):
    path = tmp_path / "scene.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        load_scenario(path)


def test_missing_file_suggests_a_similar_one(tmp_path: Path):
    (tmp_path / "sedimentation.yaml").write_text(SCENE)
    with pytest.raises(InputError, match=r"no such file. Did you mean '.*sedimentation.yaml'"):
        load_scenario(tmp_path / "sedimentaton.yaml")


def test_directory_and_impossible_name_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match="cannot be read"):
        load_scenario(tmp_path)
    with pytest.raises(InputError, match="no file can have this name"):
        load_scenario("scene\0.yaml")


def test_missing_section_is_named():
    assert refusal(text="seed: 1\n") == "scene.yaml:1: domain: this key is required"


# --- what is doubted ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("time.step=1e-2", "cross its radius of 0.01 m"),
        ("bodies.0.velocity=[0, 30, 0]", "cross its radius of 0.01 m"),
        ("friction.default=2.5", "above 2 is unusual"),
        ("friction.pairs.0.mu=3", "above 2 is unusual"),
        ("contact.recovery_speed=null", "fly apart"),
        ("domain.min=[0.9, 0.9, 0.9]", "start outside the domain"),
        ("walls.0.motion={oscillation: {amplitude: [1, 0, 0], frequency: 50}}", "moves up to 314"),
    ],
)
def test_doubtful_but_legal_scene_warns(override: str, words: str):
    assert parse_scenario(SCENE, "s").warnings == ()
    (warning,) = parse_scenario(SCENE, "s", [override]).warnings
    assert words in warning


FALLING_DISC = """
domain: {min: [-1, -1, -1], max: [1, 1, 1]}
gravity: [0, 0, 0]
materials: {glass: {density: 2500}}
bodies:
  - {material: glass, shape: spheroid, aspect_ratio: 0.1, count: 1, radius: 0.03,
     velocity: [0, 0, -2], placement: {jittered_grid: {min: [0, 0, 0.1], max: [0.1, 0.1, 0.2]}}}
time: {step: 1e-3, end: 1}
"""


def test_a_step_in_which_flat_or_slender_bodies_turn_too_far_warns():
    """A half width of 3 mm: 2 mm a step are too many, 1 mm or a rounder body are not."""
    (warning,) = parse_scenario(FALLING_DISC, "s").warnings
    assert "time.step" in warning and "half width of 0.003 m" in warning
    named = re.search(r"([0-9.e-]+) s would resolve it", warning)[1]
    for overrides in (
        [f"time.step={named}", f"time.end={1000 * float(named)}"],
        ["bodies.0.velocity=[0, 0, -1]"],
        ["bodies.0.aspect_ratio=0.5"],
        ["bodies.0.shape=spherocylinder", "bodies.0.aspect_ratio=3", "bodies.0.radius=0.003"],
    ):
        assert parse_scenario(FALLING_DISC, "s", overrides).warnings == ()
    needle = ["bodies.0.aspect_ratio=10", "bodies.0.radius=3e-3"]
    turning = ["bodies.0.velocity=[0, 0, 0]", "bodies.0.angular_velocity=[200, 0, 0]"]
    for overrides in (needle, turning):
        (warning,) = parse_scenario(FALLING_DISC, "s", overrides).warnings
        assert "half width of 0.003 m" in warning


def test_grids_that_share_space_warn():
    group = SCENE.split("bodies:\n")[1].split("walls:")[0]
    text = SCENE.replace("walls:", group + "walls:")
    (warning,) = parse_scenario(text, "s").warnings
    assert "bodies[1].placement: shares space with bodies[0]" in warning


def test_region_corner_behind_an_oblique_wall_warns():
    plane = "walls=[{shape: plane, material: glass, point: [0.05, 0, 0], normal: [1, 0, 1]}]"
    (warning,) = parse_scenario(SCENE, "s", [plane]).warnings
    assert "oblique wall 'wall0'" in warning


# --- schema ---------------------------------------------------------------------------------


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_schema_accepts_every_shipped_scene(path: Path):
    data = parse(path.read_text(encoding="utf-8"), path.name).data
    jsonschema.Draft202012Validator(json_schema()).validate(data)


@pytest.mark.parametrize(
    "line",
    [
        "contact: {tolerence: 1}",
        "contact: {tolerance: 0}",
        "time: {step: 0, end: 1}",
        "materials: {glass: {density: -1}}",
        "friction: {default: -1}",
        "gravity: [0, 0]",
        "seed: -1",
        "threads: two",
        "walls: [{shape: cone}]",
    ],
)
def test_schema_refuses_what_the_program_refuses(line: str):
    key, value = line.split(": ", 1)
    refusal(f"{key}={value}")
    data = yaml_reader.override(parse(SCENE, "s"), [f"{key}={value}"]).data
    validator = jsonschema.Draft202012Validator(json_schema())
    assert validator.is_valid(parse(SCENE, "s").data)
    assert not validator.is_valid(data)


def test_schema_is_valid_and_states_a_unit_for_every_number():
    schema = json_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    for name, section in {"Scenario": schema, **schema["$defs"]}.items():
        for key, node in section.get("properties", {}).items():
            if _is_numeric(node):
                assert f"[{node['unit']}]" in node["description"], f"{name}.{key}"


def _is_numeric(node: object) -> bool:
    """Whether a key's own value (not that of a section it refers to) holds numbers."""
    if isinstance(node, list):
        return any(_is_numeric(item) for item in node)
    if not isinstance(node, dict):
        return False
    return node.get("type") in ("number", "integer") or any(
        _is_numeric(value) for key, value in node.items() if key != "default"
    )


# --- shipped scenes -------------------------------------------------------------------------


def test_there_are_shipped_scenes():
    names = {path.stem for path in CONFIGS}
    assert names >= {
        "column_collapse", "drum", "hopper", "hopper_slot", "incline", "quick", "rods",
        "sediment_archive", "sedimentation", "sedimentation_100k", "shear_box", "two_body_impact",
        "weak_scaling",
    }  # fmt: skip


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_scene_loads_without_doubts_in_full_and_reduced(path: Path):
    header = read_header(path)
    for overrides in ((), header.reduced):
        loaded = load_scenario(path, overrides)
        assert loaded.warnings == ()
        assert loaded.scenario.name == path.stem
        assert header.expect.tolerance > 0
        assert header.expect_reduced.tolerance > 0
    assert body_count(loaded.scenario) <= 600


@pytest.mark.parametrize(
    ("name", "solid_fraction", "base_per_thousand", "height"),
    [
        ("sedimentation", 0.2094, 0.04, 0.5),
        ("sedimentation_100k", 0.2094, 0.04, 0.5),
        ("weak_scaling", 0.1939, 0.036, 0.6),
    ],
)
def test_thesis_scenes_have_the_thesis_volume_fraction(
    name: str, solid_fraction: float, base_per_thousand: float, height: float
):
    (path,) = [path for path in CONFIGS if path.stem == name]
    scenario = load_scenario(path).scenario
    extent = np.subtract(scenario.walls[0].max, scenario.walls[0].min)
    count = body_count(scenario)
    assert extent[2] == height
    assert extent[0] * extent[1] == pytest.approx(base_per_thousand * count / 1000)
    volume = count * 4 / 3 * math.pi * scenario.bodies[0].radius ** 3
    assert volume / extent.prod() == pytest.approx(solid_fraction, abs=5e-5)


# --- anything at all ------------------------------------------------------------------------

FUZZ_WORDS = [
    "", "[", "]", "{", "}", ":", ": ", "- ", "\n", "\n  ", "\t", "#", "&a ", "*a", "!", "!!int ",
    "|", ">", "'", '"', "%", "@", "`", "?", "<<: ", "---\n", "...", "null", "true", ".nan",
    "-.inf", "1e999", "1e-320", "-1", "0", "1e308", "9" * 30, "0x" + "f" * 15, "\x00", "\x85",
    "\ufeff", "\u2028", "\U0001f600", "[]", "{}", "[[", "{shape: plane}", "domain", "radius: ",
    "step", "x" * 500, "{uniform: [1, 2]}", "[1, 2, 3]", "{file: a.csv}", "~",
]  # fmt: skip


def _mutated(text: str, draw: random.Random) -> str:
    for _ in range(draw.randint(1, 4)):
        kind = draw.randrange(6)
        lines = text.split("\n")
        i, j = draw.randrange(len(text) + 1), draw.randrange(len(lines))
        word = draw.choice(FUZZ_WORDS)
        if kind == 0:
            text = text[:i] + word + text[i:]
        elif kind == 1:
            text = text[:i] + text[i + draw.randint(1, 12) :]
        elif kind == 2:
            text = "\n".join([*lines[:j], lines[draw.randrange(len(lines))], *lines[j:]])
        elif kind == 3:
            text = "\n".join(lines[:j] + lines[j + 1 :])
        elif kind == 4:
            lines[j] = " " * draw.randrange(5) + lines[j]
            text = "\n".join(lines)
        else:
            key, colon, value = lines[j].partition(":")
            lines[j] = f"{key}{colon} {word}" if colon else value
            text = "\n".join(lines)
    return text


def _mutated_data(data: object, draw: random.Random) -> str:
    """JSON, which is YAML, of a scene with one value replaced anywhere."""
    data = json.loads(json.dumps(data))
    node = data
    while True:
        key = draw.choice(list(node) if isinstance(node, dict) else range(len(node)))
        child = node[key]
        if not isinstance(child, (dict, list)) or not child or draw.random() < 0.3:
            break
        node = child
    values = [None, True, -1, 0, 1e30, 1e-30, -1e30, 10**18, "", "glass", [], {}, [1, 2, 3]]
    node[key] = draw.choice([*values, [[]], {"min": 1}, {"x": None}, [None] * 3, 3.5, 2**53])
    return json.dumps(data)


@pytest.mark.parametrize(
    ("axis", "rule"),
    [
        ("[1, 2, true]", "axis[2] = true: must be a number"),
        ("randm", "axis = \"randm\": must be random. Did you mean 'random'?"),
        ("3", "axis = 3: must be a list"),
        ("[1, 2]", "axis = [1, 2]: must be a list of more than 2 items"),
    ],
)
def test_bad_word_or_list_is_refused_as_what_it_was_meant_to_be(axis: str, rule: str):
    rods = "{shape: spherocylinder, aspect_ratio: 2, axis: %s, material: glass, count: 1, radius: 1"
    placement = "placement: {random: {min: [-5, -5, -5], max: [5, 5, 5]}}}"
    text = f"""
domain: {{min: [-9, -9, -9], max: [9, 9, 9]}}
materials: {{glass: {{density: 1}}}}
bodies: [{rods % axis}, {placement}]
time: {{step: 1, end: 1}}
"""
    with pytest.raises(InputError) as caught:
        parse_scenario(text, "scene.yaml")
    assert rule in str(caught.value)


@pytest.mark.parametrize("seed", range(10))
def test_fuzzed_scenes_load_or_are_refused_in_one_line(seed: int):
    draw = random.Random(seed)
    texts = [SCENE] + [path.read_text(encoding="utf-8") for path in CONFIGS]
    for _ in range(50):
        text = draw.choice(texts)
        if draw.random() < 0.5:
            text = _mutated_data(parse(text, "s").data, draw)
        else:
            text = _mutated(text, draw)
        message = _outcome(text)
        assert "\n" not in message
        assert len(message) < 1000


def _outcome(text: str) -> str:
    """The message a scene is refused with, or nothing; any other exception fails the test."""
    try:
        loaded = parse_scenario(text, "scene.yaml")
    except InputError as error:
        return str(error)
    json.dumps(loaded.effective, allow_nan=False)
    return ""
