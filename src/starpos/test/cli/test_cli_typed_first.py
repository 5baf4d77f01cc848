# SPDX-License-Identifier: Apache-2.0
"""What people type first: folders of pictures, no focal length, a site in minutes, other programs' bags."""

import argparse
import shutil
from datetime import datetime, timezone

import cv2
import numpy as np
import pytest
from cli_calls import AIR, PLACE, WIDE, objects, without_focal_length

from starpos.cli import replay
from starpos.cli.commands import degrees
from starpos.cli.console import Output
from starpos.errors import FrameError
from starpos.frames.reading import read_frame
from starpos.night.opening import frames_in
from starpos_testing.command_line import A3
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

needs_exifread = needs("exifread")


@pytest.fixture(scope="module")
def pictures(night, tmp_path_factory):
    """The frames of `night` as JPEG whose EXIF has their times, with tilt.csv."""
    folder = tmp_path_factory.mktemp("pictures")
    for path in sorted(night.glob("*.fits")):
        frame = read_frame(path)
        light = frame.pixels - np.median(frame.pixels).astype(float)
        grey = np.clip(12 + light / 20, 0, 255).astype(np.uint8)
        begin_s = frame.mid_unix_s - frame.exposure_s / 2
        shown = datetime.fromtimestamp(begin_s, timezone.utc)
        exif = {"start": shown.strftime("%Y:%m:%d %H:%M:%S"), "offset": "+00:00", "film_mm": 200}
        plain = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        (folder / f"{path.stem}.jpg").write_bytes(raws.with_exif(plain, **exif))
    shutil.copy(night / "tilt.csv", folder)
    return folder


@needs_exifread
def test_a_folder_of_pictures_without_a_focal_length_is_a_night(pictures, run):
    clock = ("--exif-utc-offset", "file", "--exif-clock-stddev", "1")
    status, out, errors = run("solve", pictures, *A3, *clock, *AIR, "--json")
    together = objects(out)[-1]
    assert status == 0 and together["frames"] == 2
    assert abs(together["latitude"] - PLACE["latitude"]) * 111e3 < 4 * together["sigma_north_m"]
    # said of one of the two frames
    assert sum("its stars give" in line for line in errors) == 1


@pytest.mark.parametrize("command", [("solve",), ("report", "-o", "OUT"), ("calibrate", "--camera", "OUT")])
def test_pictures_without_a_time_are_named_and_told_what_to_add(pictures, run, tmp_path, command):
    (path,) = [p for p in pictures.glob("*.jpg") if "0000" in p.name]
    folder = tmp_path / "night"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    shutil.copy(pictures / "tilt.csv", folder)
    name, *more = command
    more = [tmp_path / "out" if word == "OUT" else word for word in more]
    status, _, errors = run(name, folder, *more, *WIDE)
    assert status != 0 and not any("no frames in it" in line for line in errors)
    assert any(".png" in line and "--exif-utc-offset" in line for line in errors)


def test_what_is_a_frame_in_a_folder(tmp_path):
    def files(**content):
        for old in tmp_path.iterdir():
            old.unlink()
        for name, text in content.items():
            (tmp_path / name.replace("_", ".")).write_text(text)
        return [p.name for p in frames_in(tmp_path)]

    weather, stars = "utc,celsius\n1,2\n", '# {"NAXIS1": 10, "NAXIS2": 10}\nx,y,flux\n'
    assert files(a_png="", tilt_csv="") == ["a.png"]
    assert files(a_png="", weather_csv=weather, tilt_csv="") == ["a.png"]
    assert files(a_png="", a_csv=stars, tilt_csv="") == ["a.csv"]
    assert files(a_png="", a_fits="", a_csv=stars) == ["a.fits"]
    assert files(a_dng="", a_jpg="", b_jpg="") == ["a.dng", "b.jpg"]
    with pytest.raises(FrameError, match="no frames in it"):
        files(tilt_csv="", readme_txt="")


def test_a_night_is_calibrated_as_it_is_solved(lists, run, tmp_path):
    site = ("--site", "47:18:00", "-122:48:00", *AIR)
    by_folder = run("calibrate", lists, *WIDE, *site, "-o", tmp_path / "a.yaml")
    frames = sorted(lists.glob("stars_*.csv"))
    plain = ("--site", "47.3", "-122.8", *AIR)
    by_files = run(
        "calibrate", *frames, *WIDE, *plain, "--tilt", lists / "tilt.csv", "-o", tmp_path / "b.yaml"
    )
    assert by_folder[:2] == by_files[:2] and by_folder[0] == 0
    status, _, errors = run("calibrate", lists, lists, *WIDE, *site, "-o", tmp_path / "c.yaml")
    assert status == 2 and "one night" in errors[0]


def test_without_a_focal_length_the_stars_give_it(lists, run, tmp_path):
    bare = [without_focal_length(path, tmp_path) for path in sorted(lists.glob("stars_*.csv"))]
    stated = run("solve", *bare, "--tilt", lists / "tilt.csv", *WIDE, *A3, *AIR, "--json")
    sought = run("solve", *bare, "--tilt", lists / "tilt.csv", *A3, *AIR, "--json")
    a, b = objects(stated[1])[-1], objects(sought[1])[-1]
    assert sought[0] == 0 and b["frames"] == 3
    assert abs(a["latitude"] - b["latitude"]) * 111e3 < 0.5 * a["sigma_north_m"]


@pytest.mark.parametrize(
    ("text", "deg"),
    [("47.1", 47.1), ("47:06:00", 47.1), ("-33:52:12", -33.87), ("11:18", 11.3), ("+5:00:36.0", 5.01)],
)
def test_degrees_may_have_minutes_and_seconds(text, deg):
    assert degrees(text) == pytest.approx(deg)


@pytest.mark.parametrize("text", ["47:66:00", "north", "4706.0N", "47:06:00:00"])
def test_other_angles_are_told_how_to_write_them(text):
    with pytest.raises(argparse.ArgumentTypeError, match="47:06:00"):
        degrees(text)


@needs("rosbags")
@pytest.mark.parametrize("command", ["replay", "report"])
def test_a_bag_of_ros_1_is_told_how_to_convert(run, tmp_path, command):
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(4096))
    status, _, errors = run(command, tmp_path / "old.bag")
    assert status == 2 and "ROS 1" in errors[-1] and "rosbags-convert" in errors[-1]


def test_a_bag_that_gives_no_night_is_said_and_not_a_traceback(capsys):
    args = argparse.Namespace(json=True, csv=False)
    error = FrameError("a: ValueError: no such type")
    assert replay.tell(args, Output(args, "fix"), "a", error, None) == 2
    assert "no such type" in capsys.readouterr().err
