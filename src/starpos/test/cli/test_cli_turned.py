# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --self-calibrate` on a night with an unknown A3, and the instrument file it leaves."""

import json

import pytest
from cli_calls import AIR, PLACE, WIDE, objects

from starpos.cli import main
from starpos.instrument.instrument_file import read
from starpos_testing.command_line import SENSOR, run


def simulated(folder, *more):
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    size = ("--size", "1000", "700")
    command = ["simulate", str(folder), "--stars-only", *size, *WIDE, *place, *AIR, *more]
    assert main([*command, "--misalignment", "1.5", "-2", "130", "--tilt-zero", "0.2", "-0.1"]) == 0
    return folder


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("turned"), "-n", "8", "--turn", "45")


def solve(capsys, folder, *more):
    frames = sorted(folder.glob("stars_*.csv"))
    return run(capsys, "solve", *frames, "--tilt", folder / "tilt.csv", *AIR, *more)


def arcsec_off(combined):
    return [abs(combined[k] - PLACE[k]) * 3600 for k in PLACE]


def test_the_place_is_found_and_a3_saved_for_another_night(turned, tmp_path, capsys):
    saved = tmp_path / "mine.yaml"
    status, out, errors = solve(capsys, turned, *WIDE, *SENSOR, "--self-calibrate", "--save", saved, "--json")
    *each, combined = objects(out)
    assert status == 0 and len(each) == 8
    assert max(arcsec_off(combined)) < 4 * max(combined["sigma_north_m"], combined["sigma_east_m"]) / 20
    assert combined["sigma_north_m"] < 400
    said, caveat, kept = errors
    assert "the plumb line in the camera is known to" in said and f"{saved} is written" in kept
    assert "plumb line matters, which is not known" in said and "--turn-stddev" in caveat
    assert read(saved).calibration.frames == 8

    later = simulated(tmp_path / "later", "-n", "4", "--seed", "9", "--azimuth", "100")
    status, out, errors = solve(capsys, later, "--instrument", saved, "--json")
    combined = objects(out)[-1]
    assert (status, errors) == (0, [])
    sigma = max(combined["sigma_north_m"], combined["sigma_east_m"])
    assert max(arcsec_off(combined)) < 4 * sigma / 20
    assert 10 < sigma < 800


def test_a_night_at_another_lean_than_the_turn_says_what_makes_it_wide(turned, tmp_path, capsys):
    lean = simulated(tmp_path / "lean", "-n", "1", "--seed", "9", "--altitude", "77")
    turn = ("--misalignment", "0", "0", "20", "--turn-stddev")
    for name, known in (("loose", ()), ("held", (*turn, "2"))):
        saved = tmp_path / f"{name}.yaml"
        assert solve(capsys, turned, *WIDE, *SENSOR, *known, "--self-calibrate", "--save", saved)[0] == 0
        status, out, errors = solve(capsys, lean, "--instrument", saved, "--json")
        wide = objects(out)[-1]["sigma_east_m"] > 1e5
        assert status == 0 and wide == (name == "loose")
        assert any("leans otherwise than when A3 was found" in line for line in errors) == wide


def test_without_a_turn_nothing_is_saved_and_the_error_is_wide(tmp_path, capsys):
    still = simulated(tmp_path / "still", "-n", "2")
    status, out, errors = solve(
        capsys, still, *WIDE, *SENSOR, "--self-calibrate", "--save", tmp_path / "no.yaml", "--json"
    )
    # the place is there, and what was asked to be written is not
    assert status == 1 and json.loads(out.splitlines()[-1])["sigma_north_m"] > 1e5
    assert any("not written" in line for line in errors) and not (tmp_path / "no.yaml").exists()


def test_a_frames_own_place_waits_for_the_turn_and_no_loose_angles_are_printed(turned, capsys):
    status, out, errors = solve(capsys, turned, *WIDE, *SENSOR, "--self-calibrate")
    said, _, kept = errors
    assert status == 0 and out.count("its place waits for the whole turn") == 8
    assert "--misalignment" not in said and "the plumb line" in said and "--save OUT keeps A3" in kept


def test_save_needs_self_calibrate(turned, tmp_path, capsys):
    status, _, errors = solve(capsys, turned, *WIDE, *SENSOR, "--save", tmp_path / "no.yaml")
    assert status == 2 and "give both" in errors[0]


@pytest.mark.parametrize("command", [("solve", "--tilt", "t.csv"), ("report",)])
def test_a_turn_that_nothing_would_use_is_refused(command, capsys):
    status, _, errors = run(capsys, *command, "x.csv", "--turn-stddev", "2")
    assert status == 2 and "--self-calibrate" in errors[0]


def test_a_map_without_a_camera_is_refused(capsys):
    status, _, errors = run(capsys, "calibrate", "x.csv", "--map", "m.png", "--site", "1", "2")
    assert status == 2 and "--camera" in errors[0]


def test_a_place_under_the_ground_is_refused(turned, tmp_path, capsys):
    frames = sorted(turned.glob("stars_*.csv"))[:1]
    site = ("--site", -PLACE["latitude"], PLACE["longitude"] + 180)
    out = tmp_path / "no.yaml"
    status, _, errors = run(
        capsys, "calibrate", *frames, "--tilt", turned / "tilt.csv", *WIDE, *AIR, *site, "-o", out
    )
    assert status == 1 and "into the ground" in errors[-1] and not out.exists()
