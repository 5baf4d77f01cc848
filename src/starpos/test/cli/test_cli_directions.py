# SPDX-License-Identifier: Apache-2.0
"""`starpos altaz` and `starpos mount`, and `--axis` of `starpos solve`: directions at a known place."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_calls import AIR, PLACE, WIDE, objects

from starpos.cli import altaz

SITE = ("--site", str(PLACE["latitude"]), str(PLACE["longitude"]))
CLOCK = ("--clock-stddev", "0.001")


@pytest.fixture(scope="module")
def truth(lists):
    return json.loads((lists / "truth.json").read_text())["frames"]


def test_axes_of_solve(run, lists, truth):
    frames = sorted(lists.glob("stars_*.csv"))
    right = ("--axis", "right", "2", "0", "0")
    _, said, _ = run("solve", frames[0], *WIDE, *AIR, *SITE, *right, "--json")
    told = objects(said)[0]
    optical, side = told["axes"]
    # the frame's top is the base link's x axis: its pitch and the altitude of the optical axis make 90 deg without a roll
    assert optical["name"] == "optical axis" and side["name"] == "right"
    assert np.cos(np.radians([optical["altitude"], side["altitude"]])) @ np.ones(2) > 0
    v = np.radians([[a["azimuth"], a["altitude"]] for a in told["axes"]])
    xyz = np.stack(
        [np.cos(v[:, 1]) * np.sin(v[:, 0]), np.cos(v[:, 1]) * np.cos(v[:, 0]), np.sin(v[:, 1])], -1
    )
    assert xyz[0] @ xyz[1] == pytest.approx(0, abs=1e-12)
    # the right side, the forward direction and the top of the frame are a right-handed set
    top = np.cross(xyz[1], xyz[0])
    assert np.degrees(np.arctan2(top[0], top[1])) % 360 == pytest.approx(told["heading"])
    status, _, err = run("solve", frames[0], *WIDE, *SITE, "--axis", "right", "0", "0", "no")
    assert status == 2 and "three numbers" in err[-1]


def test_pixels_and_back(run, lists, tmp_path):
    frame = sorted(lists.glob("stars_*.csv"))[0]
    _, said, _ = run("solve", frame, *WIDE, *AIR, *SITE, "--json")
    axis = objects(said)[0]["axes"][0]
    (tmp_path / "points.csv").write_text("x,y\n499.5,349.5\n")
    status, said, _ = run(
        "altaz", frame, "100", "200", "--points", tmp_path / "points.csv", *WIDE, *AIR, *SITE, "--json"
    )
    assert status == 0
    corner, middle = objects(said)
    assert (middle["azimuth"], middle["altitude"]) == pytest.approx(
        (axis["azimuth"], axis["altitude"]), abs=1e-6
    )
    assert middle["altitude_airless"] < middle["altitude"]
    back = ("--back", corner["azimuth"], corner["altitude"])
    _, said, _ = run("altaz", frame, *WIDE, *AIR, *SITE, *back, "--csv")
    (row,) = csv.DictReader(said.splitlines())
    assert (float(row["x"]), float(row["y"])) == pytest.approx((100, 200), abs=1e-6)
    status, _, err = run("altaz", frame, "100", *WIDE, *SITE)
    assert status == 2 and "no pairs" in err[-1]
    status, _, err = run("altaz", frame, "1", "2", *WIDE)
    assert status == 2 and "--site" in err[-1]


def test_a_grid_is_drawn(run, night, tmp_path):
    frame, picture = sorted(night.glob("frame_*.fits"))[0], tmp_path / "grid.png"
    table = tmp_path / "horizon.csv"
    table.write_text("azimuth_deg,altitude_deg\n0,89\n180,89\n")
    whole = cv2.IMREAD_GRAYSCALE
    assert run("altaz", frame, "100", "200", *WIDE, *AIR, *SITE, "--overlay", picture)[0] == 0
    bright = cv2.imread(str(picture), whole).mean()
    # a field of 12 deg that looks 12 deg off the zenith shows neither the horizon nor 5 deg above it, but has its labels
    assert (np.abs(cv2.imread(str(picture)).astype(int) - altaz.LABELS).max(2) < 30).sum() > 50
    ground = ("--overlay", picture, "--horizon", table)
    assert run("altaz", frame, "100", "200", *WIDE, *AIR, *SITE, *ground)[0] == 0
    # all that the camera sees lies below this horizon
    assert cv2.imread(str(picture), whole).mean() < 0.6 * bright
    table.write_text("azimuth_deg,altitude_deg\n")
    status, _, err = run("altaz", frame, "1", "2", *WIDE, *SITE, *ground)
    assert status == 2 and "horizon.csv" in err[-1]


def test_the_axis_of_a_mount(run, lists):
    frames = sorted(lists.glob("stars_*.csv"))
    # the simulated instrument turns about the vertical
    _, said, _ = run("mount", *frames, *WIDE, *AIR, *SITE, *CLOCK, "--json")
    (found,) = objects(said)
    off = (90 - found["altitude"]) * 3600
    assert found["frames"] == len(frames) and off < 10
    assert off < 5 * max(found["sigma_across_arcsec"], found["sigma_altitude_arcsec"])
    assert found["above_pole_arcsec"] == pytest.approx(3600 * (90 - PLACE["latitude"]), abs=60)
    status, said, _ = run("mount", *frames, *WIDE, *AIR, *SITE)
    assert status == 0 and "above it" in said


def test_a_horizontal_circle(run, lists, truth, tmp_path):
    frames = sorted(lists.glob("stars_*.csv"))
    table = tmp_path / "circle.csv"
    rows = [f"{p.name},{(100 - t['heading_deg']) % 360}\n" for p, t in zip(frames, truth, strict=True)]
    table.write_text("file,azimuth_deg\n" + "".join(rows))
    top = ("--axis", "top", "0", "-1", "0")
    _, said, _ = run("mount", *frames, *WIDE, *AIR, *SITE, *CLOCK, *top, "--readings", table, "--json")
    (found,) = objects(said)
    assert found["sense"] == -1
    assert abs((found["zero"] - 100) * 3600) < 4 * found["sigma_arcsec"] < 20
    table.write_text("file,azimuth_deg\nother.fits,7\n")
    status, _, err = run("mount", *frames, *WIDE, *SITE, "--readings", table)
    assert status == 1 and "check the names" in err[-1]


def test_a_camera_that_turns_is_no_camera_that_stands_still(run, lists, tmp_path):
    page, ground = tmp_path / "history.html", tmp_path / "horizon.csv"
    written = ("--page", page, "--horizon", ground)
    status, said, err = run("calibrate", "--watch", lists, *WIDE, *AIR, *SITE, *written, "--json")
    assert ground.read_text().startswith("azimuth_deg,altitude_deg\n")
    nights = objects(said)
    assert status == 1 and [n["alarm"] for n in nights] == [False, True, True]
    assert nights[1]["moved_arcsec"] == pytest.approx(40 * 3600, rel=1e-3) and "has moved" in err[0]
    assert page.read_text().count("<tr>") == 1 + 3
    page.write_text("mine")
    status, _, err = run("calibrate", "--watch", lists, *WIDE, *SITE, "--page", page)
    assert status == 2 and "not of starpos" in err[-1]
    status, _, err = run("calibrate", "--watch", tmp_path / "none", *WIDE, *SITE)
    assert status == 2 and "cannot be read" in err[-1]


def test_a_frame_of_another_size_in_a_watched_folder_is_named(run, lists, tmp_path):
    first, *_ = sorted(Path(lists).rglob("*.csv"))
    night = tmp_path / "night"
    night.mkdir()
    (night / "a.csv").write_text(first.read_text())
    (night / "other.csv").write_text(first.read_text().replace('"NAXIS1": ', '"NAXIS1": 1', 1))
    _, _, err = run("calibrate", "--watch", night, *WIDE, *AIR, *SITE)
    assert any("other.csv: the frame is" in line for line in err)


def test_a_sky_that_saturates_simulated_frames_is_told(run, tmp_path):
    fisheye = ("--lens", "equidistant", "--focal-mm", 1.1, "--pixel-um", 3, "--size", 200, 200, "-n", 1)
    status, _, err = run("simulate", tmp_path / "night", *fisheye)
    assert status == 0 and "saturates" in err[0]
    exposure = err[0].partition("give --exposure ")[2].partition(",")[0]
    assert run("simulate", tmp_path / "night", *fisheye, "--exposure", exposure)[2] == []
