# SPDX-License-Identifier: Apache-2.0
"""The parameter file that is installed says what the nodes declare."""

import re
from pathlib import Path

import yaml

from starpos_bringup.defaults import NODES, parameter_file

CONFIG = Path(__file__).parent.parent / "config" / "starpos.yaml"


def test_the_committed_file_is_the_nodes_own_tables():
    assert CONFIG.read_text() == parameter_file(), (
        "run `python -m starpos_bringup.defaults > src/starpos_bringup/config/starpos.yaml` in the root"
    )


def test_every_parameter_of_every_node_is_in_it():
    content = yaml.safe_load(CONFIG.read_text())
    for node, table in NODES.items():
        assert set(content[f"/**/{node}"]["ros__parameters"]) == {p.name for p in table}


def test_every_description_is_made_of_whole_sentences():
    """One that was cut at either end says nothing, or half of it."""
    whole = re.compile(r"""[A-Z`'"].*\.""", re.DOTALL)
    descriptions = {f"{node}: {p.name}": p.description for node, table in NODES.items() for p in table}
    assert {name: said for name, said in descriptions.items() if not whole.fullmatch(said)} == {}


def test_the_solver_keeps_the_names_that_users_files_have():
    fixed = {"refraction.pressure", "refraction.temperature", "refraction.humidity", "altitude", "altitude_stddev",
             "clock_stddev", "deflection.xi", "deflection.eta", "deflection.stddev", "min_stars", "frame_id",
             "calibration_url"}  # fmt: skip
    assert fixed <= {p.name for p in NODES["solver"]}
