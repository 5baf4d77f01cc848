# SPDX-License-Identifier: Apache-2.0
"""`starpos solve --site`: headings at a known place, with and without tilts, and sites that are refused."""

import csv
import io
import json

import numpy as np
import pytest
from cli_calls import AIR, KNOWN, PLACE, WIDE, objects

SITE = ("--site", str(PLACE["latitude"]), str(PLACE["longitude"]))
CLOCK = ("--clock-stddev", "0.001")


@pytest.fixture
def solve(run, lists):
    frames = sorted(lists.glob("stars_*.csv"))
    return lambda *more: run("solve", *frames, *AIR, *CLOCK, *more)


@pytest.fixture(scope="module")
def truth(lists):
    frames = json.loads((lists / "truth.json").read_text())["frames"]
    return [frame["heading_deg"] for frame in frames]


def test_headings_without_tilts(solve, truth):
    status, said, errors = solve(*WIDE, *SITE, "--json")
    assert status == 0
    *frames, together = objects(said)
    for told, heading in zip(frames, truth, strict=True):
        assert told["status"] == "ok" and told["latitude"] is None and told["sigma_east_m"] is None
        assert abs(told["heading"] - heading) < 4 * told["sigma_heading_deg"] < 4 * 3 / 3600
        assert told["covariance_attitude"][0][0] == pytest.approx(told["sigma_heading_deg"] ** 2)
        assert told["covariance"][2][2] == pytest.approx(told["sigma_heading_deg"] ** 2)
        # 6 arcsec of unknown deflection
        assert told["sigma_heading_geodetic_deg"] * 3600 > 5
        assert told["budget"]["centroids"][:2] == [None, None] and told["budget"]["centroids"][2] > 0
    # the camera turns by 40 deg from frame to frame
    assert together["combined"] and together["heading"] is None
    assert len(errors) == 1 and "the camera turned between the frames" in errors[0]


def test_a_site_on_the_ellipsoid_knows_the_other_north(solve):
    _, said, _ = solve(*WIDE, *SITE, "--geodetic", "--json")
    for told in objects(said)[:-1]:
        assert told["sigma_heading_geodetic_deg"] * 3600 < 3 < told["sigma_heading_deg"] * 3600


def test_frames_of_one_pose_have_a_mean(run, night):
    frames = sorted(night.glob("frame_*.fits"))
    status, said, errors = run("solve", *frames, *AIR, *WIDE, *SITE, "--json")
    *each, together = objects(said)
    assert (status, errors) == (0, [])
    assert together["frames"] == 2 and together["latitude"] is None
    assert together["heading"] == pytest.approx(np.mean([told["heading"] for told in each]), abs=0.1 / 3600)
    assert together["sigma_heading_deg"] < min(told["sigma_heading_deg"] for told in each)


def test_with_tilts_the_place_is_the_stars_own(solve, lists, truth):
    tilts = (*KNOWN, "--tilt", str(lists / "tilt.csv"), "--json")
    alone, told = (objects(solve(*tilts, *site)[1]) for site in ((), SITE))
    for before, after, heading in zip(alone, told, truth, strict=False):
        assert (before["latitude"], before["longitude"]) == (after["latitude"], after["longitude"])
        assert abs(after["heading"] - heading) < 4 * after["sigma_heading_deg"]
        assert after["sigma_heading_deg"] < before["sigma_heading_deg"]
        assert after["covariance"][0][2] is None and after["covariance"][0][0] == before["covariance"][0][0]
        assert "heading_geodetic" not in before


def test_a_site_that_the_tilts_contradict_gives_no_heading(solve, lists):
    far = ("--site", str(PLACE["latitude"] + 0.5), str(PLACE["longitude"]))
    status, said, errors = solve(*KNOWN, "--tilt", str(lists / "tilt.csv"), *far, "--json")
    frame = objects(said)[0]
    assert status == 0 and frame["latitude"] is not None and frame["heading"] is None
    assert frame["covariance"][2] == [None, None, None]
    assert any("56 km from the given one" in line for line in errors)


@pytest.mark.parametrize(
    ("site", "said"),
    [
        (("47.3", "57.2"), "check latitude and longitude"),
        (("20", "57.2"), "below the horizon"),
        (("-47.3", "-122.8"), "check latitude and longitude"),
        (("147.3", "-122.8"), "no place is at latitude 147.3"),
        (("nan", "-122.8"), "no place is at latitude nan"),
        (("47.3",), "--site has 1 numbers"),
        (("47.3", "-122.8", "10", "20"), "--site has 4 numbers"),
        (("47.3", "-122.8", "10", "--altitude-m", "20"), "--site has a height"),
        (("47.3", "-122.8", "--self-calibrate"), "--site and --self-calibrate do not go"),
    ],
)
def test_a_site_that_cannot_be_is_refused_in_a_sentence(solve, site, said):
    status, out, errors = solve(*WIDE, "--site", *site, "--json")
    assert status in (1, 2) and said in errors[0]
    assert all(json.loads(line)["heading"] is None for line in out.splitlines())


def test_what_belongs_to_a_site_is_refused_without_one(solve):
    for option in (("--geodetic",), ("--site-stddev", "3")):
        status, _, errors = solve(*WIDE, *option)
        assert status == 2 and "is for --site" in errors[0]


def test_the_table_and_the_lines_have_headings(solve, truth):
    _, said, _ = solve(*WIDE, *SITE, "--csv")
    rows = list(csv.DictReader(io.StringIO(said)))
    assert float(rows[0]["heading"]) == pytest.approx(truth[0], abs=1e-3) and rows[0]["latitude"] == ""
    assert float(rows[0]["pitch"]) == pytest.approx(11.585, abs=0.01)
    _, said, _ = solve(*WIDE, *SITE)
    head, first, *_ = said.splitlines()
    assert "on WGS 84" in head and f"heading {truth[0]:.2f}"[:-1] in first
