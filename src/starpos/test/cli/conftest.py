# SPDX-License-Identifier: Apache-2.0
from functools import partial

import pytest
from cli_calls import AIR, PLACE, WIDE

from starpos.cli import main
from starpos_testing import command_line


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Two frames (FITS) with their tilts and truth."""
    folder = tmp_path_factory.mktemp("night")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    assert main(["simulate", str(folder), "-n", "2", "--size", "1000", "700", *WIDE, *place, *AIR]) == 0
    return folder


@pytest.fixture(scope="module")
def lists(tmp_path_factory):
    """Three lists of stars (CSV) without tilt noise, turning by 40 deg from one to the next."""
    folder = tmp_path_factory.mktemp("lists")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    command = [
        "simulate",
        str(folder),
        "-n",
        "3",
        "--turn",
        "40",
        "--stars-only",
        "--size",
        "1000",
        "700",
        *WIDE,
        *place,
        *AIR,
    ]
    assert main([*command, "--tilt-noise", "0"]) == 0
    return folder


@pytest.fixture
def run(capsys):
    """Run a command: exit status, standard output, lines of standard error."""
    return partial(command_line.run, capsys)
