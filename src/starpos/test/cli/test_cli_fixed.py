# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate --fixed`, and `solve` without tilts of a camera that nothing moved, and of one that was."""

import json

import pytest
from cli_calls import AIR, PLACE, WIDE, objects

from starpos.cli import main
from starpos.instrument.instrument_file import read
from starpos_testing.command_line import run

SITE = ("--site", PLACE["latitude"], PLACE["longitude"])


def simulated(folder, start, *more):
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    size = ("--size", "1000", "700")
    command = [
        "simulate",
        str(folder),
        "--stars-only",
        "-n",
        "2",
        "--start",
        start,
        *size,
        *WIDE,
        *place,
        *AIR,
    ]
    assert main([*command, *more]) == 0
    return sorted(folder.glob("stars_*.csv"))


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("first"), "2026-11-02T04:00:00")


@pytest.fixture
def instrument(first, tmp_path, capsys):
    out = tmp_path / "vertical.yaml"
    args = ("calibrate", *first, *WIDE, *AIR, *SITE, "--fixed", "--sag", 3, "-o", out)
    status, said, errors = run(capsys, *args)
    assert (status, errors) == (0, [])
    assert said.startswith("the vertical of a fixed camera of 2 frames") and "3 arcsec of sag" in said
    return out


def test_a_later_night_needs_no_tilt(instrument, tmp_path, capsys):
    later = simulated(tmp_path / "later", "2026-11-03T05:00:00", "--seed", "7")
    outs = []
    for jobs in ((), ("--jobs", "2")):
        status, out, errors = run(capsys, "solve", *later, "--instrument", instrument, *AIR, *jobs, "--json")
        assert (status, errors) == (0, [])
        outs.append(out)
    assert outs[0] == outs[1]
    together = objects(outs[0])[-1]
    # 3 arcsec an hour are 15 after 25 hours
    assert together["sigma_north_m"] == pytest.approx(15 * 30.9, rel=0.05)
    for k, v in PLACE.items():
        assert together[k] == pytest.approx(v, abs=2 / 3600)
    truth = json.loads((tmp_path / "later" / "truth.json").read_text())
    assert together["heading"] == pytest.approx(truth["frames"][0]["heading_deg"], abs=0.005)


def test_a_camera_that_was_moved_says_so_and_gives_no_fix(instrument, tmp_path, capsys):
    moved = simulated(tmp_path / "moved", "2026-11-03T05:00:00", "--azimuth", "41")
    status, out, errors = run(capsys, "solve", *moved, "--instrument", instrument, *AIR, "--json")
    assert status == 1 and objects(out)[-1]["latitude"] is None
    assert "the camera has moved, by " in errors[0] and "calibrate it again" in errors[0]


def test_a_touch_in_the_night_costs_the_frames_after_it(instrument, first, tmp_path, capsys):
    moved = simulated(tmp_path / "moved", "2026-11-02T04:10:00", "--altitude", "77.5")
    status, out, errors = run(capsys, "solve", *first, *moved, "--instrument", instrument, *AIR, "--json")
    *each, together = objects(out)
    assert status == 0 and [row["status"] for row in each] == ["ok", "ok", "poor fit", "poor fit"]
    assert together["frames"] == 2 and len(errors) == 2


REFUSED = {
    "tilts too": (("--fixed", *SITE, "--tilt", "t.csv", "-o", "OUT"), "--fixed and --tilt do not go"),
    "an A3 too": (("--fixed", *SITE, "--misalignment", 1, 2, 3, "-o", "OUT"), "do not go together"),
    "an inclinometer too": (("--fixed", *SITE, "--inclinometer", "scl3300", "-o", "OUT"), "do not go together"),
    "no site": (("--fixed", "-o", "OUT", "--camera", "OUT"), "--fixed is for --site"),
    "nowhere to write": (("--fixed", *SITE), "-o INSTRUMENT.yaml"),
    "sag alone": (("--sag", 3, *SITE, "--tilt", "t.csv", "-o", "OUT"), "--sag is for --fixed"),
    "a negative sag": (("--fixed", *SITE, "--sag", -1, "-o", "OUT"), "must lie between 0 and 3600"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bad_call_is_refused_in_a_line(kind, first, tmp_path, capsys):
    options, words = REFUSED[kind]
    options = [tmp_path / "out.yaml" if o == "OUT" else o for o in options]
    status, out, errors = run(capsys, "calibrate", *first, *WIDE, *options)
    assert (status, out, len(errors)) == (2, "", 1) and words in errors[0]
    assert not list(tmp_path.iterdir())


def test_the_file_is_not_mixed_with_an_inclinometer(instrument, first, tmp_path, capsys):
    tilt = first[0].parent / "tilt.csv"
    assert read(instrument).vertical is not None
    for more in (("--tilt", tilt), ("--self-calibrate",)):
        status, _, errors = run(capsys, "solve", *first, "--instrument", instrument, *more)
        assert status == 2 and "describes a camera fixed to the ground" in errors[0]
    again = ("calibrate", *first, "--instrument", instrument, *AIR, *SITE, "-o", tmp_path / "again.yaml")
    status, _, errors = run(capsys, *again, "--tilt", tilt)
    assert status == 2 and "describes a camera fixed to the ground" in errors[0]
    assert run(capsys, *again, "--fixed")[0] == 0
