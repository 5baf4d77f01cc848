# SPDX-License-Identifier: Apache-2.0
"""What a newcomer gets wrong, and the sentence that says so: tilts, times, what a shell's *.csv takes in; tables."""

import csv
import json
import math
import shutil

import numpy as np
import pytest
from astropy.io import fits
from cli_calls import AIR, KNOWN, PLACE, WIDE, objects, solve

from starpos import open_night
from starpos.fix.fix import length_text
from starpos.frames.reading import read_frame
from starpos_testing.command_line import run

NEAR = ("--near", PLACE["latitude"] - 0.2, PLACE["longitude"] + 0.2)
ELSEWHERE = ("--near", PLACE["latitude"], PLACE["longitude"] - 90)


def rewritten(path, folder, of_row):
    """A table of tilts whose angles are of_row(x, y)."""
    head, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    changed = [[t, *map(repr, of_row(float(x), float(y))), *rest] for t, x, y, *rest in cells]
    (folder / "tilt.csv").write_text("\n".join([head, *(",".join(row) for row in changed)]) + "\n")
    return folder / "tilt.csv"


def one(capsys, lists, tilt, *more):
    """The last JSON object and the complaints of a frame solved with other tilts."""
    status, out, errors = run(
        capsys, "solve", lists / "stars_0000.csv", "--tilt", tilt, *KNOWN, *more, "--json"
    )
    assert status == 0
    return objects(out)[-1], errors


def test_a_fix_near_the_stated_place_is_told_its_distance_and_one_that_is_far_is_the_same(lists, capsys):
    near, errors = one(capsys, lists, lists / "tilt.csv", *NEAR)
    assert errors == [] and 20 < near["km_from_near"] < 35
    far, errors = one(capsys, lists, lists / "tilt.csv", *NEAR, "--near-km", "10")
    assert "and should be within 10 km" in errors[0] and len(errors) == 1
    assert far == near
    away, errors = one(capsys, lists, lists / "tilt.csv", *ELSEWHERE)
    assert away["latitude"] == near["latitude"] and "its times may be 6 h behind UTC" in errors[0]


HEADERS = [
    # what is the header's longitude from the place's, and what is said of it
    (0, 1, None),
    (0, -1, None),
    (-15, 1, "its times may be 1 h behind UTC: check"),
    (30, 1, "its times may be 2 h ahead of UTC: check"),
    (3, 1, "check the times (UTC)"),
    (3, -1, "check the times (UTC)"),
]


@pytest.mark.parametrize(("east_deg", "sign", "said"), HEADERS)
def test_a_site_in_the_header_far_from_the_place_is_said_and_what_would_explain_it(
    east_deg, sign, said, lists, tmp_path, capsys
):
    first, rest = (lists / "stars_0000.csv").read_text().split("\n", 1)
    site = {"SITELAT": PLACE["latitude"], "SITELONG": sign * (PLACE["longitude"] + east_deg)}
    header = {**json.loads(first.removeprefix("# ")), **site}
    (tmp_path / "stars.csv").write_text(f"# {json.dumps(header)}\n{rest}")
    tilt = ("--tilt", lists / "tilt.csv")
    status, _, errors = run(capsys, "solve", tmp_path / "stars.csv", *tilt, *KNOWN, "--json")
    assert status == 0 and len(errors) == (said is not None)
    assert all("from the header's SITELAT" in e and said in e for e in errors)


def in_seconds(deg):
    """dd.mmss of an angle."""
    minutes, seconds = divmod(abs(deg) * 3600 / 60, 1)
    return math.copysign(minutes // 60 + (minutes % 60) / 100 + seconds * 60 / 10_000, deg)


MISTAKES = {
    "theta_x and theta_y exchanged": lambda x, y: (y, x),
    "the other sign of theta_x": lambda x, y: (-x, y),
    "tilts that were gon": lambda x, y: (x / 0.9, y / 0.9),
    "tilts that were percent": lambda x, y: tuple((100 * np.tan(np.radians([x, y]))).tolist()),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_the_mistake_that_sets_a_place_far_from_near_is_named(mistake, lists, tmp_path, capsys):
    tilt = rewritten(lists / "tilt.csv", tmp_path, MISTAKES[mistake])
    answer, errors = one(capsys, lists, tilt, *NEAR)
    assert answer["km_from_near"] > 100
    assert f"with {mistake} it would be 27 km from there" in errors[-1]


PACKED = {
    "dd.mm": lambda x, y: tuple((np.trunc([x, y]) + 0.6 * np.fmod([x, y], 1)).tolist()),
    "dd.mmss": lambda x, y: (in_seconds(x), in_seconds(y)),
}


@pytest.mark.parametrize("mistake", [*MISTAKES, *PACKED])
def test_mistakes_show_by_themselves_where_the_camera_is_turned(mistake, lists, tmp_path, capsys):
    tilt = rewritten(lists / "tilt.csv", tmp_path, (MISTAKES | PACKED)[mistake])
    frames = sorted(lists.glob("stars_*.csv"))
    _, _, errors = run(capsys, "solve", *frames, "--tilt", tilt, *KNOWN)
    assert any("km apart, and with" in line and mistake in line for line in errors), errors


def test_tilts_that_look_like_radians_are_refused(night, tmp_path, capsys):
    rewritten(night / "tilt.csv", tmp_path, lambda x, y: tuple(np.radians([x, y]).tolist()))
    shutil.copy(night / "frame_0000.fits", tmp_path)
    status, _, errors = run(capsys, "solve", tmp_path, *KNOWN)
    (line,) = errors
    assert status == 2 and "the tilts look like radians" in line and "write them in deg" in line
    (shot,) = open_night(tmp_path).solve().shots
    assert shot.place is None and "look like radians" in shot.message


def test_what_a_glob_takes_in_beside_the_frames_is_left_out(lists, tmp_path, capsys):
    for path in lists.iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "tilt.csv").rename(tmp_path / "sensor.csv")
    every = sorted(tmp_path.iterdir())
    status, out, errors = run(capsys, "solve", *every, "--tilt", tmp_path / "sensor.csv", *KNOWN, "--json")
    assert (status, errors) == (0, []) and len(objects(out)) == 4
    (tmp_path / "sensor.csv").rename(tmp_path / "tilt.csv")
    for command, options in (("identify", WIDE), ("detect", ())):
        status, out, errors = run(capsys, command, *sorted(tmp_path.iterdir()), *options, "--json")
        assert (status, errors) == (0, []) and len(objects(out)) == 3
    status, _, errors = run(capsys, "detect", tmp_path / "tilt.csv")
    assert status == 2 and "tilt.csv" in errors[0]


def test_a_simulated_night_never_replaces_files_that_were_not_simulated(tmp_path, capsys):
    make = ("simulate", tmp_path, "-n", "2", "--size", "64", "48", "--altitude", "80")
    assert run(capsys, *make)[0] == 0
    assert run(capsys, *make[:3], "1", *make[4:])[0] == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frame_0000.fits", "tilt.csv", "truth.json"]
    with open(tmp_path / "tilt.csv", "a") as tilt:
        tilt.write("1793642400.75,0.1,0.2,15\n")
    before = {p: p.read_bytes() for p in tmp_path.iterdir()}
    status, _, errors = run(capsys, *make)
    assert status == 2 and "tilt.csv: it is there already" in errors[0]
    assert {p: p.read_bytes() for p in tmp_path.iterdir()} == before
    for name in ("tilt.csv", "my_frame.fits", "truth.json"):
        folder = tmp_path / f"real-{name}"
        folder.mkdir()
        (folder / name).write_text("{}")
        status, _, errors = run(capsys, "simulate", folder, *make[2:])
        assert status == 2 and f"{name}: it is there already" in errors[0]
        assert [p.name for p in folder.iterdir()] == [name]


def test_simulated_frames_state_the_focal_length_and_the_pixels_that_were_asked_for(night):
    header = fits.getheader(night / "frame_0000.fits")
    assert (header["FOCALLEN"], header["XPIXSZ"], header["ORIGIN"]) == (29.67, 6.4, "starpos simulate")


def test_simulated_lists_are_solved_without_a_focal_length(lists, capsys):
    assert read_frame(lists / "stars_0000.csv").focal_px == pytest.approx(29670 / 6.4, rel=1e-12)
    assert run(capsys, "solve", lists, *AIR)[0] == 0


def test_a_report_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys):
    (tmp_path / "file").touch()
    status, _, errors = run(capsys, "report", tmp_path / "no night", "-o", tmp_path / "file" / "report")
    assert status == 2 and "the report cannot be written there (Not a directory)" in errors[0]
    status, _, errors = run(capsys, "report", tmp_path / "no night", "-o", tmp_path / "new" / "report")
    assert "there is no such night" in errors[0] and not (tmp_path / "new").exists()


def test_a_csv_has_the_values_of_json(lists, capsys):
    _, out, _ = solve(capsys, lists, *KNOWN, "--json", frames="stars_*.csv")
    expected = objects(out)
    _, out, errors = solve(capsys, lists, *KNOWN, "--csv", frames="stars_*.csv")
    rows = list(csv.DictReader(out.splitlines()))
    assert errors == [] and len(rows) == len(expected) == 4
    for row, value in zip(rows, expected, strict=True):
        for key in ("latitude", "longitude", "sigma_east_m", "heading"):
            assert float(row[key]) == value[key]
        assert row["status"] == "ok" and row["file"] == value.get("file", "")
    assert [row["combined"] for row in rows] == ["", "", "", "True"]
    status, _, errors = solve(capsys, lists, *KNOWN, "--csv", "--json", frames="stars_*.csv")
    assert status == 2 and "not allowed with" in errors[0]


def test_csv_of_identify_and_detect(lists, capsys):
    frame = lists / "stars_0000.csv"
    _, out, _ = run(capsys, "identify", frame, *WIDE, "--csv")
    (row,) = csv.DictReader(out.splitlines())
    assert row["file"] == str(frame) and float(row["focal_px"]) == pytest.approx(4636, rel=3e-3)
    _, out, _ = run(capsys, "detect", frame, "--csv")
    stars = list(csv.DictReader(out.splitlines()))
    _, out, _ = run(capsys, "detect", frame, "--json")
    assert [float(s["x"]) for s in stars] == [s[0] for s in json.loads(out)["stars"]]


def test_a_table_says_first_what_follows_and_wide_places_are_km_wide(lists, capsys):
    _, out, _ = solve(capsys, lists, *WIDE, frames="stars_0000.csv")
    head, frame, *_ = out.splitlines()
    assert head.startswith("file: latitude and longitude (deg, astronomic") and "1 sigma" in head
    assert " km N " in frame and " m N " not in frame
    assert [length_text(x) for x in (0.4, 9999, 1.1e6)] == ["0 m", "9999 m", "1100 km"]
