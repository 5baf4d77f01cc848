# SPDX-License-Identifier: Apache-2.0
"""A fisheye from the command line: simulated, identified, solved, calibrated, and used by its calibration."""

import json
import math

import pytest
from cli_calls import AIR, PLACE, objects, without_focal_length

from starpos.cli import main
from starpos.instrument import instrument_file
from starpos_testing.command_line import A3

# 500 px.
OPTICS = ("--focal-mm", "2.25", "--pixel-um", "4.5")
LENS = (*OPTICS, "--lens", "equidistant")


@pytest.fixture(scope="module")
def skies(tmp_path_factory):
    """Two lists of stars of nearly the whole sky, and their tilts."""
    folder = tmp_path_factory.mktemp("skies")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    shot = (
        "--stars-only",
        "-n",
        "2",
        "--turn",
        "90",
        "--size",
        "1400",
        "1400",
        "--altitude",
        "85",
        "--exposure",
        "0.02",
    )
    assert main(["simulate", str(folder), *shot, *LENS, *place, *AIR]) == 0
    return folder


def test_a_lens_of_113_degrees_that_is_no_fisheye_is_none(tmp_path, run):
    """The header alone says its focal length: as a fisheye's it was said to be wrong, and the place was 6 km off."""
    shot = ("--stars-only", "-n", "1", "--size", "4000", "4000", "--focal-mm", "12")
    assert main(["simulate", str(tmp_path / "night"), *shot]) == 0
    status, out, err = run("solve", tmp_path / "night", *A3, "--json")
    *_, together = objects(out)
    assert status == 0 and "header is wrong" not in err
    assert abs(together["latitude"] - 35.7046) < 4 * together["sigma_north_m"] / 111_000 < 0.03


def test_a_night_of_the_whole_sky_is_solved(skies, run):
    lists = sorted(skies.glob("stars_*.csv"))
    status, out, err = run("solve", *lists, "--tilt", skies / "tilt.csv", *LENS, *A3, *AIR, "--json")
    *_, together = objects(out)
    assert status == 0, err
    for found, true, sigma in (
        (together["latitude"], PLACE["latitude"], together["sigma_north_m"] / 111_000),
        (together["longitude"], PLACE["longitude"], together["sigma_east_m"] / 75_000),
    ):
        assert abs(found - true) < 4 * sigma < 0.02
    assert together["status"] == "ok"


def test_its_camera_is_found_and_serves(skies, run, tmp_path):
    lists, camera = sorted(skies.glob("stars_*.csv")), tmp_path / "camera.yaml"
    status, out, err = run(
        "calibrate", *lists, "--tilt", skies / "tilt.csv", *LENS, *AIR, "--camera", camera, "--json"
    )
    assert status == 0, err
    (answer,) = objects(out)
    assert answer["model"] == "equidistant" and list(answer["sigma"])[4:] == ["k1", "k2", "k3", "k4"]
    assert all(
        abs(k) < 5 * answer["sigma"][name]
        for name, k in zip(("k1", "k2", "k3", "k4"), answer["distortion"], strict=True)
    )
    assert instrument_file.read_camera(camera).model == "equidistant"
    (tmp_path / "mine.yaml").write_text("starpos_instrument: 1\ncamera: {calibration: camera.yaml}\n")
    status, out, _ = run("identify", lists[0], "--instrument", tmp_path / "mine.yaml", "--json")
    assert status == 0 and json.loads(out)["status"] == "ok"


def test_its_place_serves_as_well(skies, run, tmp_path):
    place = ("--site", PLACE["latitude"], PLACE["longitude"])
    status, out, err = run(
        "calibrate", *skies.glob("stars_*.csv"), *LENS, *AIR, *place, "--camera", tmp_path / "camera.yaml"
    )
    assert (status, err) == (0, []) and out.count("from the stars") == 8
    (tmp_path / "mine.yaml").write_text("starpos_instrument: 1\ncamera: camera.yaml\n")
    status, out, _ = run(
        "solve", *skies.glob("stars_*.csv"), *place, "--instrument", tmp_path / "mine.yaml", "--json"
    )
    assert status == 0 and objects(out)[0]["heading"] is not None


def test_without_its_tilts_it_is_not_calibrated(skies, run, tmp_path):
    status, _, err = run("calibrate", *skies.glob("stars_*.csv"), *LENS, "--camera", tmp_path / "camera.yaml")
    assert status == 1 and "--site, or the --tilt" in err[-1]


def test_a_pinhole_is_told_to_be_none(skies, run):
    status, _, err = run("identify", sorted(skies.glob("stars_*.csv"))[0], *OPTICS)
    assert status == 1 and "fisheye (equidistant)" in err[-1]


def test_a_lens_goes_with_a_focal_length_and_not_with_an_instrument_file(skies, run, tmp_path):
    frame = without_focal_length(sorted(skies.glob("stars_*.csv"))[0], tmp_path)
    (tmp_path / "mine.yaml").write_text(
        "starpos_instrument: 1\ncamera: {focal_px: 500, model: equidistant}\n"
    )
    assert run("identify", frame, "--instrument", tmp_path / "mine.yaml")[0] == 0
    status, _, err = run("identify", frame, "--instrument", tmp_path / "mine.yaml", "--lens", "equidistant")
    assert status == 2 and "either it or the options" in err[-1]
    status, _, err = run("identify", frame, "--lens", "equidistant")
    assert status == 2 and "no focal length" in err[-1]


def test_a_platepar_of_rms_is_written_and_serves_as_lens_and_place(skies, run, tmp_path):
    first, second = sorted(skies.glob("stars_*.csv"))
    site, plate = ("--site", PLACE["latitude"], PLACE["longitude"]), tmp_path / "platepar_cmn2010.cal"
    given = (*LENS, *AIR, "--camera", tmp_path / "camera.yaml")
    status, _, err = run("calibrate", first, *given, *site, "--platepar", plate)
    assert status == 0 and "RMS sees stars within 0.0" in err[-1]
    content = json.loads(plate.read_text())
    assert (
        content["lat"] == pytest.approx(PLACE["latitude"])
        and len(content["x_poly_rev"]) == content["poly_length"]
    )
    status, out, _ = run("solve", second, "--instrument", plate, *AIR, "--json")
    _, told, _ = run("solve", second, *LENS, *site, "--geodetic", *AIR, "--json")
    assert status == 0
    assert objects(out)[0]["heading"] == pytest.approx(objects(told)[0]["heading"], abs=0.02)
    for calls, why in (
        ((first, *given, *site, "--platepar", plate), "already"),
        ((first, second, *given, *site, "--platepar", tmp_path / "b.cal"), "stands still"),
        ((first, *given, "--tilt", skies / "tilt.csv", "--platepar", tmp_path / "b.cal"), "needs the place"),
    ):
        status, _, err = run("calibrate", *calls)
        assert status == 2 and why in err[-1] and not (tmp_path / "b.cal").exists()


def test_a_nominal_lens_claims_what_a_mask_and_an_axis_off_the_middle_do(skies, run, tmp_path):
    first = sorted(skies.glob("stars_*.csv"))[0]
    head, names, *rows = first.read_text().splitlines()
    half = tmp_path / first.name
    half.write_text("\n".join([head, names, *(row for row in rows if float(row.split(",")[0]) > 700)]) + "\n")
    site = ("--site", PLACE["latitude"], PLACE["longitude"])
    whole, part = (objects(run("solve", path, *LENS, *site, *AIR, "--json")[1])[0] for path in (first, half))
    assert 0 < abs(part["heading"] - whole["heading"]) < 3 * part["sigma_heading_deg"] < 0.5
    # the optical axis may be some degrees off the middle of the frame, and then the camera seems to lean
    assert whole["sigma_pitch_deg"] > 2


def test_a_pose_by_high_stars_alone_says_that_nothing_shows_the_hour(skies, run, tmp_path):
    path = sorted(skies.glob("stars_*.csv"))[0]
    head, names, *rows = path.read_text().splitlines()
    # 1400 x 1400 px
    high = [r for r in rows if math.dist(map(float, r.split(",")[:2]), (700, 700)) < 350]
    path = tmp_path / path.name
    path.write_text("\n".join([head, names, *high]) + "\n")
    site = ("--site", PLACE["latitude"], PLACE["longitude"])
    status, _, err = run("calibrate", path, *LENS, *site, *AIR, "--fixed", "-o", tmp_path / "fixed.yaml")
    assert status == 0 and any("hour is right" in line for line in err)
