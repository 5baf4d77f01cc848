# SPDX-License-Identifier: Apache-2.0
"""`starpos replay`: what it prints of a bag, its parameters, its exit status."""

import json
import math
import shutil
from pathlib import Path

import pytest

pytest.importorskip("rosbags")

from starpos.cli import main
from starpos.errors import InstrumentError
from starpos.session import session
from starpos.session.settings import Settings

NIGHT = Path(__file__).resolve().parents[4] / "test" / "data" / "night"
if not NIGHT.is_dir():
    pytest.skip("the recorded night is not beside this package", allow_module_level=True)
FILE = """
/**:
  ros__parameters:
    use_sim_time: true
/rover:
  solver:
    ros__parameters:
      misalignment: [0.31, -0.22, 0.53]
      misalignment_stddev: 0.1
      refraction: {pressure: 66000, temperature: -4.0}
/detector:
  ros__parameters:
    threshold: 4.0
"""


@pytest.fixture
def told(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(FILE)
    return "--params-file", str(path)


def run(capsys, *words):
    status = main(["replay", *map(str, words)])
    out = capsys.readouterr()
    return status, out.out.splitlines(), out.err


def test_a_night_is_told_as_solve_tells_one(capsys, told):
    truth = json.loads(NIGHT.with_suffix(".json").read_text())
    status, lines, errors = run(capsys, NIGHT, "--json", *told)
    assert status == 0 and "10 frames, 10 answers, 10 fixes" in errors
    *frames, whole = map(json.loads, lines)
    assert len(frames) == 10 and whole["combined"] and whole["frames"] == 10
    for frame in frames:
        assert frame["status"] == "ok"
        north_m = (frame["latitude"] - truth["latitude_deg"]) * 111_000
        assert abs(north_m) < 4 * frame["sigma_north_m"]
    status, lines, _ = run(capsys, NIGHT, *told)
    assert status == 0 and "10 frames together" in lines[11]


OF_TWO = """
/**/solver:
  ros__parameters: {misalignment: [0.31, -0.22, 0.53], min_stars: 1000}
/left/solver:
  ros__parameters: {misalignment_stddev: 0.1}
/right:
  solver:
    ros__parameters: {min_stars: 7}
"""


def test_frames_that_got_no_answer_are_counted(capsys, told, monkeypatch):
    monkeypatch.setattr(session, "MAX_WAITING", 0)
    status, _, errors = run(capsys, NIGHT, *told)
    assert status == 1 and "10 frames, 0 answers, 0 fixes" in errors


def test_a_file_of_two_instruments_is_read_as_their_nodes_read_it(tmp_path):
    path = tmp_path / "robot.yaml"
    path.write_text(OF_TWO)
    left, right = (Settings.of(path, (), name).values for name in ("left", "/right/"))
    assert left["misalignment"] == right["misalignment"] == (0.31, -0.22, 0.53)
    assert (left["misalignment_stddev"], left["min_stars"]) == (0.1, 1000)
    assert math.isnan(right["misalignment_stddev"]) and right["min_stars"] == 7
    with pytest.raises(
        InstrumentError, match="of the instruments /left, /right: choose one with --namespace"
    ):
        Settings.of(path, ())


def test_what_to_do_about_an_unknown_misalignment_is_said_in_parameters(capsys):
    status, _, errors = run(capsys, NIGHT)
    assert status == 0 and "set self_calibration:=true" in errors and "--misalignment" not in errors


def test_two_processes_say_the_same(capsys, told, tmp_path):
    shutil.copytree(NIGHT, tmp_path / "another")
    bags = NIGHT, tmp_path / "another"
    assert run(capsys, *bags, *told, "-j", 2) == run(capsys, *bags, *told)


def test_a_parameter_that_is_given_counts_more_than_the_files(capsys, told):
    status, _, errors = run(capsys, NIGHT, *told, "-p", "min_stars:=1000")
    assert status == 1 and "10 answers, 0 fixes" in errors and "min_stars is 1000" in errors


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("-p", "min_star:=7"), "there is no parameter min_star: did you mean min_stars?"),
        (("-p", "min_stars:=seven"), "must be a whole number from 4 to 1000"),
        (("-p", "min_stars"), "write NAME:=VALUE"),
        (("-p", "calibration_url:=/nowhere.yaml"), "/nowhere.yaml"),
        (("--params-file", "/nowhere.yaml"), "not a readable parameter file"),
        (
            ("--namespace", "rover"),
            "the instrument in it has no namespace, not /rover: leave --namespace out",
        ),
    ],
)
def test_a_bad_call_is_one_line(capsys, words, said):
    status, lines, errors = run(capsys, NIGHT, *words)
    assert (status, lines) == (2, []) and said in errors and "Traceback" not in errors


def test_one_broken_bag_does_not_stop_the_others(capsys, told, tmp_path):
    status, lines, errors = run(capsys, tmp_path / "none", NIGHT, *told)
    assert status == 2 and len(lines) > 10
    assert f"starpos replay: {tmp_path / 'none'}: there is no such bag" in errors
