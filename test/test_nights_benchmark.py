# SPDX-License-Identifier: Apache-2.0
"""The benchmark of whole nights drawn at random: what it counts, however many work on it."""

import importlib.util
import json
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from starpos_testing.skies import random_nights

TOOL = Path(__file__).resolve().parents[1] / "tools" / "benchmarks" / "random_nights.py"


@pytest.fixture
def run(capsys, monkeypatch):
    spec = importlib.util.spec_from_file_location("random_nights_tool", TOOL)
    tool = importlib.util.module_from_spec(spec)
    # its work goes to other processes by name
    monkeypatch.setitem(sys.modules, spec.name, tool)
    monkeypatch.syspath_prepend(str(TOOL.parent))
    spec.loader.exec_module(tool)

    def of(*args):
        capsys.readouterr()
        status = tool.main([*map(str, args)])
        said = capsys.readouterr()
        return status, said.out, said.err.splitlines()

    return of


def test_the_papers_nights(run, monkeypatch):
    """They have 4 frames a heading, where the paper has 25."""
    monkeypatch.setattr(random_nights, "turned_night", partial(random_nights.turned_night, frames=4))
    status, said, errors = run("nights", "--nights", 2, "--seed", 5, "--tiltmeter", 1, "--json", "--jobs", 1)
    assert (status, errors) == (0, [])
    *each, all_of_them = [json.loads(line) for line in said.splitlines()]
    assert [n["kind"] for n in each] == ["turned"] * 2
    assert all_of_them["solved"] == all_of_them["nights"] == 2
    for axis in ("north", "east"):
        assert all_of_them[f"mean_abs_{axis}_m"] == pytest.approx(
            np.mean([abs(n[f"{axis}_m"]) for n in each])
        )
        assert max(abs(n[f"{axis}_m"]) / n[f"sigma_{axis}_m"] for n in each) < 5
    assert all_of_them["mean_abs_latitude_arcsec"] == pytest.approx(all_of_them["mean_abs_north_m"] / 30.87)


@pytest.mark.montecarlo
def test_whether_claims_are_honest(run):
    args = ("honesty", "--nights", 2, "--seed", 2)
    status, said, errors = run(*args, "--jobs", 1, "--json")
    *each, whole, turned, calibrated = [json.loads(line) for line in said.splitlines()]
    assert len(each) == whole["nights"] == turned["nights"] + calibrated["nights"] == 2
    assert [r["row"] for r in (whole, turned, calibrated)] == ["all", "turned", "calibrated"]
    assert errors == []
    off = [abs(whole[k] / n - 1) for k, n in (("position_nees", 2), ("ground_nees", 2), ("heading_nees", 1))]
    assert status == int(max(off) >= 0.1)
    # However many work on it.
    assert run(*args, "--jobs", 2, "--json") == (status, said, [])
