# SPDX-License-Identifier: Apache-2.0
"""What --json prints is what docs/reference/starpos.schema.json promises; `objects` holds every test's output to it."""

import json

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
