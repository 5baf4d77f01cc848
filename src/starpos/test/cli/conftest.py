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
    """Three lists of stars (CSV) with hardly any tilt noise, turning by 40 deg from one to the next."""
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
    assert main([*command, "--tilt-noise", "0.000001"]) == 0
    return folder


@pytest.fixture(scope="module")
def archive(tmp_path_factory):
    """Two nights: of lists that turn, and of frames; the first has a broken frame among its good ones."""
    folder = tmp_path_factory.mktemp("archive")
    size = ("--size", "1000", "700", *WIDE)
    turned = ["simulate", str(folder / "turned"), "-n", "8", "--turn", "45", "--stars-only", *size]
    assert main(turned) == 0
    assert main(["simulate", str(folder / "still"), "-n", "2", "--seed", "2", *size]) == 0
    (folder / "turned" / "stars_0002b.csv").write_text("no list of stars\n")
    return folder


@pytest.fixture
def run(capsys):
    """Run a command: exit status, standard output, lines of standard error."""
    return partial(command_line.run, capsys)
