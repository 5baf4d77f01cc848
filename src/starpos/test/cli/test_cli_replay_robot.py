# SPDX-License-Identifier: Apache-2.0
"""`starpos replay` and `starpos report` of a robot's own images, intrinsics and accelerations."""

import json

import numpy as np
import pytest

pytest.importorskip("rosbags")

from starpos.cli import main
from starpos_testing.skies import robots

KNOWN = ("misalignment_stddev:=0.01", "inclinometer.model:=sca100t_calibrated", "refraction.pressure:=95000.0",
         "refraction.temperature:=8.0", "refraction.humidity:=0.5", "deflection.stddev:=0.0")  # fmt: skip
STAMPS = ("detector:stamp:=start", "detector:stamp_stddev:=0.001", f"detector:exposure:={robots.EXPOSURE_S}",
          "detector:readout:=0.0")  # fmt: skip
# m of a degree of latitude
DEGREE_M = 111_200


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot") / "bag"
    robots.write(folder)
    return folder


@pytest.fixture
def replay(capsys):
    def replay(bag, *words, parameters=(*KNOWN, *STAMPS)):
        more = [word for p in parameters for word in ("-p", p)]
        status = main(["replay", str(bag), "--json", *more, *words])
        out = capsys.readouterr()
        return status, [json.loads(line) for line in out.out.splitlines()], out.err

    return replay


def errors_m(frame):
    """East and north of the true place, m, and what is claimed of them."""
    east = (frame["longitude"] - robots.LONGITUDE_DEG) * np.cos(np.radians(robots.LATITUDE_DEG)) * DEGREE_M
    north = (frame["latitude"] - robots.LATITUDE_DEG) * DEGREE_M
    return np.array([east, north]), np.array([frame["sigma_east_m"], frame["sigma_north_m"]])


def test_images_and_accelerations_give_the_place(bag, replay):
    status, answers, said = replay(bag)
    assert status == 0 and "3 frames, 3 answers, 3 fixes" in said
    assert "stars from /cam0/image_raw, tilts from /imu/data, camera/camera_info is /cam0/camera_info" in said
    *frames, whole = answers
    for frame in frames:
        error, claimed = errors_m(frame)
        assert (np.abs(error) < 4 * claimed).all() and (claimed < 300).all()
    # stamps of the start, 0.2 s of exposure: the middle is 0.1 s later
    assert frames[0]["utc"].startswith("2024-11-03T18:00:01.100") and whole["frames"] == 3


def test_until_the_stamp_is_stated_the_claim_is_wide_and_a_sentence_says_what_to_set(bag, replay):
    wide, narrow = replay(bag, parameters=KNOWN), replay(bag)
    assert "set the parameters stamp, stamp_stddev and exposure" in wide[2] and "stamp" not in narrow[2]
    assert wide[1][0]["sigma_east_m"] > narrow[1][0]["sigma_east_m"] + 20


def test_compressed_pictures_give_what_raw_ones_give(bag, replay, tmp_path):
    robots.write(tmp_path / "bag", compressed=True)
    raw, pictures = replay(bag), replay(tmp_path / "bag")
    assert pictures[0] == 0 and "stars from /cam0/image_raw/compressed" in pictures[2]
    assert [f["latitude"] for f in raw[1]] == [f["latitude"] for f in pictures[1]]


def test_a_robot_that_moves_gives_no_tilt_and_the_reason_is_said(bag, replay):
    status, _, said = replay(bag, parameters=(*KNOWN, *STAMPS, "inclinometer:imu.max_force_error:=0.0001"))
    assert status == 1 and "no tilt was made of 800 messages of the IMU: it feels" in said


def test_a_parameter_of_another_node_that_is_none_is_refused(bag, replay):
    for text, said in (
        ("detector:stmp:=start", "did you mean stamp?"),
        ("camera:exposure:=1.0", "there is no node camera here"),
        ("inclinometer:imu.averag:=1.0", "did you mean imu.average?"),
    ):
        status, _, err = replay(bag, parameters=(text,))
        assert status == 2 and said in err


@pytest.mark.usefixtures("unpainted")
def test_a_report_tells_of_it(bag, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    words = ["report", str(bag), "-o", str(tmp_path / "out"), "--inclinometer", "sca100t_calibrated"]
    words += ["--misalignment", "0", "0", "0", "--misalignment-stddev", "0.01"]
    words += ["--pressure-hpa", "950", "--temperature-c", "8"]
    more = [word for p in STAMPS for word in ("-p", p)]
    assert main([*words, "--humidity", "0.5", *more]) == 0
    assert "stars from /cam0/image_raw" in capsys.readouterr().err
    assert "46.54" in (tmp_path / "out" / "index.html").read_text()
    assert main([*words, "-p", "misalignment:=[0.0, 0.0, 0.0]"]) == 2
    assert "-p takes NODE:NAME:=VALUE of detector and inclinometer" in capsys.readouterr().err
