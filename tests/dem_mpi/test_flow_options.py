"""What the command line of the Stokes step asks for: read, checked, refused in one line."""

from __future__ import annotations

import math

import pytest

from dem_mpi.errors import InputError
from dem_mpi.flow_options import FlowOptions, parse_options
from dem_mpi.handoff import Selection
from stokes.background import SumOfFlows, UniformFlow, shear_flow


def test_nothing_said_takes_the_defaults():
    assert parse_options() == FlowOptions()
    assert FlowOptions().selection == Selection()


def test_texts_become_values():
    options = parse_options(
        bodies="1 4-6",
        region=(0, 1, 0, 1, 0, 1),
        hydrodynamic_radius="0.9",
        background=["uniform:1,0,0", "shear:2,xz@0,0,0.1"],
        grid="4,5,6",
        plane="x=-0.25",
        tolerance=1e-3,
    )
    assert options.selection == Selection(((1, 1), (4, 6)), (0, 1, 0, 1, 0, 1))
    assert options.factor == 0.9
    flows = (UniformFlow((1.0, 0.0, 0.0)), shear_flow(2.0, "xz", (0.0, 0.0, 0.1)))
    assert options.background == SumOfFlows(flows)
    assert options.grid == (4, 5, 6) and options.plane == (0, -0.25)
    assert options.tolerance == 1e-3
    assert parse_options(grid="4x5x6").grid == (4, 5, 6)
    assert parse_options(plane="z").plane == (2, None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"bodies": "x"}, "--bodies x: must be a gid"),
        ({"region": (0, 1, 1, 0, 0, 1)}, "--region: y from 1 to 0: must rise"),
        ({"region": (0, math.nan, 0, 1, 0, 1)}, "--region 0 nan"),
        ({"hydrodynamic_radius": "big"}, "--hydrodynamic-radius big: must be auto, or a factor"),
        ({"hydrodynamic_radius": "1.1"}, "--hydrodynamic-radius 1.1: must be auto, or a factor"),
        ({"hydrodynamic_radius": "0"}, "--hydrodynamic-radius 0: must be auto"),
        ({"hydrodynamic_radius": "nan"}, "--hydrodynamic-radius nan"),
        ({"viscosity": 0.0}, "--viscosity 0: must be > 0"),
        ({"viscosity": math.inf}, "--viscosity inf"),
        ({"background": ["shear"]}, "--background 'shear': must be shear:rate[,xz]"),
        ({"problem": "drag"}, "--problem drag: must be one of resistance, mobility"),
        ({"formulation": "double"}, "--formulation double: must be one of single, combined"),
        ({"gravity": (0.0, 0.0, math.nan)}, "--gravity 0 0 nan: must be finite"),
        ({"fluid_density": -1.0}, "--fluid-density -1: must be >= 0"),
        ({"tolerance": 0.0}, "--tolerance 0: must be between"),
        ({"tolerance": math.nan}, "--tolerance nan"),
        ({"tolerance": 0.5}, "--tolerance 0.5"),
        ({"grid": "4,5"}, "--grid 4,5: must be three numbers of points"),
        ({"grid": "4,5,0"}, "--grid 4,5,0"),
        ({"grid": "4,5,-6"}, "--grid 4,5,-6"),
        ({"grid": "10000,10000,10000"}, "has more than 1,000,000,000 points"),
        ({"grid": "2,2,2", "points": "p.csv"}, "--grid and --points: give one"),
        ({"box": (0, 1, 0, 1, 0, 1)}, "--grid-box: says where the points of --grid are"),
        ({"grid": "2,2,2", "box": (0, 1, 0, 1, 2, 1)}, "--grid-box: z from 2 to 1"),
        ({"plane": "w"}, "--slice w: must be x, y or z"),
        ({"plane": "x="}, "--slice x="),
        ({"plane": "x=nan"}, "--slice x=nan"),
    ],
)
def test_what_breaks_a_rule_is_named_with_the_rule(arguments, words):
    with pytest.raises(InputError) as caught:
        parse_options(**arguments)
    assert words in str(caught.value) and "\n" not in str(caught.value)
