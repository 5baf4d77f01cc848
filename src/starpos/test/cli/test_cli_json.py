# SPDX-License-Identifier: Apache-2.0
"""What --json prints is what docs/reference/starpos.schema.json promises; `objects` holds every test's output to it."""

import json

import numpy as np
import pytest
from cli_calls import KNOWN, SCHEMA, WIDE, objects, promised, solve

from starpos_testing.command_line import run
from starpos_testing.lacking import require


@pytest.fixture(autouse=True)
def checker():
    require("fastjsonschema")


def test_lines_of_every_command_are_as_promised(lists, capsys):
    some = sorted(lists.glob("stars_*.csv"))[:2]
    assert len(objects(run(capsys, "detect", "--json", *some)[1])) == 2
    assert len(objects(run(capsys, "identify", "--json", *WIDE, *some)[1])) == 2
    *frames, together = objects(solve(capsys, lists, "--json", *KNOWN, frames="stars_*.csv")[1])
    assert frames and together["combined"]


def test_lines_of_bad_frames_are_as_promised(lists, tmp_path, capsys):
    bad = tmp_path / "bad.csv"
    bad.write_text("nothing\n")
    for command in (("detect",), ("identify", *WIDE), ("solve", *KNOWN, "--tilt", lists / "tilt.csv")):
        [first, *_] = objects(run(capsys, *command, "--json", bad)[1])
        assert first["status"] == "bad input"


def test_what_the_doctor_finds_is_as_promised(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = objects(run(capsys, "doctor", "--json")[1])
    assert len(found) > 5 and all(check["found"] for check in found)


def test_rows_of_montecarlo_are_as_promised(capsys):
    few = ("--size", 1000, 700, "--fields", 2, "--points", 2, "--false", 0, "--stars")
    fields, points = objects(run(capsys, "montecarlo", "--json", *WIDE, *few)[1])
    assert (fields["fields"], points["row"]) == (2, "random points")


@pytest.mark.parametrize("change", [{"latitude": "52 N"}, {"height": 52.0}, {"status": "fine"}])
def test_a_key_or_a_value_that_is_not_promised_is_refused(change, lists, capsys):
    import fastjsonschema

    [line] = objects(run(capsys, "identify", "--json", *WIDE, sorted(lists.glob("stars_*.csv"))[0])[1])
    with pytest.raises(fastjsonschema.JsonSchemaException):
        promised()(line | change)


def test_every_field_says_what_it_is():
    lines = json.loads(SCHEMA.read_text())["definitions"]
    assert {
        (name, key)
        for name, line in lines.items()
        for key, value in line["properties"].items()
        if "description" not in value and "const" not in value
    } == set()


@pytest.mark.parametrize("focal_mm", [50, 300])
def test_the_focal_length_errs_as_it_claims(capsys, tmp_path, focal_mm):
    lens = ("--focal-mm", focal_mm, "--pixel-um", 6.4)
    sky = (
        "-n",
        30,
        "--turn",
        12,
        "--altitude",
        80,
        "--pressure-hpa",
        0,
        "--size",
        2808,
        1872,
        "--stars-only",
    )
    assert run(capsys, "simulate", tmp_path / "night", *sky, *lens)[0] == 0
    lists = sorted((tmp_path / "night").glob("stars_*.csv"))
    answers = objects(run(capsys, "identify", *lists, *lens, "--json")[1])
    error = np.array([a["focal_px"] for a in answers]) - focal_mm / 6.4e-3
    pull = error / [a["focal_stddev_px"] for a in answers]
    # 30 true claims give 0.63 to 1.40 in 999 of 1000 cases
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 1.45
