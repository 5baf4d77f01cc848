# SPDX-License-Identifier: Apache-2.0
"""A night in a camera's raw files, whose times are its own clock's."""

import json
from datetime import datetime, timezone

import numpy as np
import pytest

from starpos.cli import main
from starpos.frames.reading import read_frame
from starpos_testing.command_line import A3, OPTICS
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

AIR = ("--pressure-hpa", "1000", "--temperature-c", "5")
LONGITUDE_DEG, OFFSET_H = -122.8, -8.0
M_PER_S = 464.0 * np.cos(np.radians(47.3))

pytestmark = [needs("rawpy"), needs("exifread")]


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Two raw files, whole seconds of local time in them, and tilt.csv."""
    folder = tmp_path_factory.mktemp("raw")
    place = ("--latitude", "47.3", f"--longitude={LONGITUDE_DEG}")
    assert main(["simulate", str(folder), "-n", "2", "--size", "1000", "700", *OPTICS, *place, *AIR]) == 0
    for path in folder.glob("*.fits"):
        frame = read_frame(path)
        begin_s = frame.mid_unix_s - frame.exposure_s / 2 + 3600 * OFFSET_H
        shown = datetime.fromtimestamp(begin_s, timezone.utc).strftime("%Y:%m:%d %H:%M:%S")
        path.with_suffix(".dng").write_bytes(raws.dng(frame.pixels, start=shown))
    return folder


def solve(capsys, folder, *more):
    """Exit status, the objects printed, what was said."""
    frames = [str(path) for path in sorted(folder.glob("*.dng"))]
    tilts = ("--tilt", str(folder / "tilt.csv"))
    status = main(["solve", *frames, *tilts, *OPTICS, *A3, *AIR, "--json", *more])
    said = capsys.readouterr()
    return status, [json.loads(line) for line in said.out.splitlines()], said.err


def test_a_camera_clock_nobody_vouches_for_gives_no_fix(night, capsys):
    status, answers, said = solve(capsys, night)
    assert status == 1 and {a["status"] for a in answers} == {"bad input"}
    assert "--exif-utc-offset" in said


def test_the_errors_of_the_cameras_clock_are_in_the_budget(night, capsys):
    status, answers, _ = solve(capsys, night, "--exif-utc-offset", str(OFFSET_H), "--exif-clock-stddev", "3")
    assert status == 0
    first, together = answers[0], answers[-1]
    assert first["budget"]["clock"][0] == pytest.approx(3 * M_PER_S, rel=0.01)
    assert first["budget"]["time stamp"][0] == pytest.approx(
        M_PER_S * np.hypot(1 / np.sqrt(12), 0.06), rel=0.01
    )
    east_m = (together["longitude"] - LONGITUDE_DEG) * 111_320 * np.cos(np.radians(47.3))
    assert abs(east_m) < 3 * together["sigma_east_m"] < 11 * M_PER_S
    # frames at whole seconds of cadence are all rounded alike: averaging does not help
    for name in ("clock", "time stamp"):
        assert together["budget"][name][0] == pytest.approx(first["budget"][name][0], rel=0.01)


def test_an_untended_clock_may_be_a_minute_off(night, capsys):
    _, answers, _ = solve(capsys, night, "--exif-utc-offset", str(OFFSET_H))
    assert answers[0]["budget"]["clock"][0] == pytest.approx(60 * M_PER_S, rel=0.01)


def test_files_that_do_not_say_their_zone_have_no_time_where_they_should_say_it(night, capsys):
    status, answers, said = solve(capsys, night, "--exif-utc-offset", "file")
    assert status == 1 and {a["status"] for a in answers} == {"bad input"}
    assert "OffsetTimeOriginal" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--exif-clock-stddev", "3"), "--exif-utc-offset: give both"),
        (("--exif-utc-offset", "15"), "between -14 and 14"),
        (("--exif-utc-offset", "local"), "neither a number nor file"),
        (("--exif-utc-offset", "nan"), "between -14 and 14"),
    ],
)
def test_a_bad_call(night, capsys, options, words):
    try:
        status, _, said = solve(capsys, night, *options)
    except SystemExit as e:
        status, said = e.code, capsys.readouterr().err
    assert status == 2 and words in said


@pytest.mark.parametrize("film_mm", [164, 50, None])
def test_a_photo_is_identified_with_no_option_whatever_its_exif_says_of_the_lens(
    night, capsys, tmp_path, film_mm
):
    (frame, *_) = sorted(night.glob("*.fits"))
    (tmp_path / "a.dng").write_bytes(raws.dng(read_frame(frame).pixels, film_mm=film_mm))
    assert main(["identify", str(tmp_path / "a.dng"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["focal_px"] == pytest.approx(4636, rel=2e-3) and answer["warnings"] == []
