# SPDX-License-Identifier: Apache-2.0
"""The installed parameter file says what the nodes declare, and their rows agree with the code that reads them."""

import re
from pathlib import Path

import pytest
import yaml

from starpos.frames.exposure import STAMPS
from starpos.instrument.sensors import presets
from starpos.navigation.vessel import LAWS
from starpos.parameters.table import NODES, parameters_of
from starpos_camera.sources.registry import SOURCES as CAMERAS
from starpos_inclinometer.sources.registry import SOURCES as INCLINOMETERS

CONFIG = Path(__file__).parent.parent / "config" / "starpos.yaml"
ROWS = {f"{node}: {p.name}": p for node in NODES for p in parameters_of(node)}


def test_every_parameter_of_every_node_is_in_it():
    content = yaml.safe_load(CONFIG.read_text())
    for node in NODES:
        assert set(content[f"/**/{node}"]["ros__parameters"]) == {p.name for p in parameters_of(node)}


@pytest.mark.parametrize("name", ROWS)
def test_a_row_is_whole(name):
    """A description that was cut at either end says nothing, or half of it; a default is a value that may be given."""
    row = ROWS[name]
    assert re.fullmatch(r"""[A-Z`'"].*\.""", row.description, re.DOTALL)
    assert repr(row.convert(row.default)) == repr(row.default)
    numbers = type(row.items[0]) in (int, float)
    assert numbers or (row.minimum, row.maximum, row.unit) == (None, None, "")


@pytest.mark.parametrize(
    "row, choices",
    [
        ("camera: source", CAMERAS),
        ("inclinometer: source", INCLINOMETERS),
        ("detector: stamp", STAMPS),
        ("navigator: vehicle", ("", *LAWS)),
    ],
)
def test_the_choices_are_those_that_the_code_has(row, choices):
    assert ROWS[row].choices == tuple(choices)


def test_the_inclinometers_that_the_code_knows_are_named():
    assert [name for name in presets() if name not in ROWS["solver: inclinometer.model"].description] == []


def test_the_solver_keeps_the_names_that_users_files_have():
    fixed = {"refraction.pressure", "refraction.temperature", "refraction.humidity", "altitude", "altitude_stddev",
             "clock_stddev", "deflection.xi", "deflection.eta", "deflection.stddev", "min_stars", "frame_id",
             "calibration_url"}  # fmt: skip
    assert fixed <= {p.name for p in parameters_of("solver")}
