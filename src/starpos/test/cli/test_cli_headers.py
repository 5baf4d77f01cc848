# SPDX-License-Identifier: Apache-2.0
"""Star lists whose headers say less, or other things, than the sky: no wrong place, and a sentence."""

import json

import numpy as np
import pytest
from cli_calls import AIR, KNOWN, PLACE, WIDE, objects

from starpos_testing.command_line import SENSOR

LEFT, TOP, WIDTH, HEIGHT = 300, 180, 640, 480
WHOLE = "camera: {focal_mm: 29.67, pixel_um: 6.4, width: 1000, height: 700}"
A3 = "misalignment_deg: [0, 0, 0]\ncalibration_stddev_arcsec: [5, 5, 5]\nclock_stddev_s: 0.001\n"
A3 += "inclinometer: {model: sca100t_calibrated}\n"


def changed(lists, folder, cut=None, **cards):
    """Copies of the lists with other cards, None for none, and cut to a part (left, top, width, height)."""
    paths = []
    for path in sorted(lists.glob("stars_*.csv")):
        first, names, *rows = path.read_text().splitlines()
        header = json.loads(first.lstrip("# ")) | cards
        if cut is not None:
            left, top, header["NAXIS1"], header["NAXIS2"] = cut
            inside = []
            for row in rows:
                x, y, rest = row.split(",", 2)
                x, y = float(x) - left, float(y) - top
                if 0 < x < header["NAXIS1"] - 1 and 0 < y < header["NAXIS2"] - 1:
                    inside.append(f"{x:.5f},{y:.5f},{rest}")
            rows = inside
        header = {key: value for key, value in header.items() if value is not None}
        paths.append(folder / path.name)
        paths[-1].write_text("\n".join([f"# {json.dumps(header)}", names, *rows]) + "\n")
    return paths


@pytest.fixture
def solve(lists, run):
    def solved(paths, *options):
        """Exit status, the combined object (None without one), lines of standard error."""
        status, out, errors = run("solve", *paths, "--tilt", lists / "tilt.csv", *AIR, *options, "--json")
        told = [json.loads(line) for line in out.splitlines()]
        return status, next((t for t in told if t.get("combined")), None), errors

    return solved


def off_sigma(answer):
    """How far the place is from where it was simulated, in sigmas north and east."""
    north = (answer["latitude"] - PLACE["latitude"]) * 111.2e3
    east = (answer["longitude"] - PLACE["longitude"]) * 111.2e3 * np.cos(np.radians(PLACE["latitude"]))
    return abs(north) / answer["sigma_north_m"], abs(east) / answer["sigma_east_m"]


def test_a_part_of_the_sensor_is_where_its_header_and_the_instrument_file_say(lists, solve, tmp_path):
    paths = changed(lists, tmp_path, (LEFT, TOP, WIDTH, HEIGHT), XORGSUBF=LEFT, YORGSUBF=TOP)
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"starpos_instrument: 1\n{WHOLE}\n{A3}")
    status, answer, _ = solve(paths, "--instrument", mine)
    assert status == 0 and max(off_sigma(answer)) < 4 and answer["sigma_north_m"] < 2000
    # the whole frame besides
    status, both, _ = solve([*paths, *sorted(lists.glob("stars_*.csv"))[:1]], "--instrument", mine)
    assert status == 0 and max(off_sigma(both)) < 4


@pytest.mark.parametrize("cards", [{"XORGSUBF": 0, "YORGSUBF": 0}, {"XORGSUBF": LEFT, "YORGSUBF": TOP}])
def test_where_nobody_says_the_size_of_the_sensor_a3_counts_as_not_known(lists, solve, tmp_path, cards):
    paths = changed(lists, tmp_path, (cards["XORGSUBF"], cards["YORGSUBF"], WIDTH, HEIGHT), **cards)
    status, answer, errors = solve(paths, *KNOWN)
    # 2000 px are 23 deg here
    assert (status, answer["latitude"]) == (1, None)
    assert any("of a sensor whose size is not stated" in line for line in errors)


def test_frames_of_another_size_than_the_first_or_the_files_have_no_fix(lists, solve, tmp_path):
    paths = changed(lists, tmp_path, (LEFT, TOP, WIDTH, HEIGHT))
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"starpos_instrument: 1\n{WHOLE}\n{A3}")
    status, answer, errors = solve(paths, "--instrument", mine)
    assert (status, answer) == (1, None) and any("A3 are of 1000 x 700 px" in line for line in errors)
    status, _, errors = solve([*sorted(lists.glob("stars_*.csv"))[:1], paths[1]], *KNOWN)
    assert status == 0 and any("640 x 480 px but focal length and A3" in line for line in errors)


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"EXPTIME": 0}, "how long it was exposed is unknown, its EXPTIME is 0"),
        ({"EXPTIME": 10, "STACKCNT": 8}, "a stack of 8 exposures"),
        ({"EXPTIME": 4, "EXPOSURE": 0.5}, "contradict each other"),
        ({"DATE-OBS": "26/07/102"}, "'26/07/102', which is no time"),
    ],
)
def test_a_frame_without_a_sound_time_has_no_fix_and_is_identified_all_the_same(
    lists, solve, run, tmp_path, cards, words
):
    paths = changed(lists, tmp_path, **cards)
    status, answer, errors = solve(paths, *KNOWN)
    assert (status, answer) == (1, None)
    # the same sentence is printed once, whatever the number of frames
    assert 1 <= sum(words in line for line in errors) < len(paths)
    assert run("identify", paths[0], *WIDE, "--json")[0] == 0


def test_the_sentence_about_a_wrong_header_is_in_the_json(lists, run, tmp_path):
    wrong, right = changed(lists, tmp_path, XPIXSZ=6.8)[0], sorted(lists.glob("stars_*.csv"))[1]
    gnss = tmp_path / "gnss.csv"
    gnss.write_text("utc_unix_s,latitude,longitude,sigma_east_m,sigma_north_m\n")
    solve = ("solve", "--tilt", lists / "tilt.csv", *AIR, *KNOWN[len(WIDE) :])
    for command in (("identify",), solve, (*solve, "--gnss", gnss)):
        _, out, errors = run(*command, wrong, right, "--json")
        told = next(line for line in errors if "its header is wrong" in line)
        of_wrong, of_right, *_ = objects(out)
        assert (of_wrong["status"], of_right["remark"]) == ("ok", None)
        assert told == f"starpos {command[0]}: {of_wrong['remark']}"


def test_a_wrong_header_keeps_no_frame_from_a_calibration(lists, run, tmp_path):
    paths, mine = changed(lists, tmp_path, XPIXSZ=6.8), tmp_path / "mine.yaml"
    site = ("--tilt", lists / "tilt.csv", "--site", *PLACE.values(), *SENSOR, *AIR)
    status, out, errors = run(
        "calibrate", *paths, *site, "-o", mine, "--camera", tmp_path / "c.yaml", "--json"
    )
    camera, a3 = objects(out)
    assert status == 0 and camera["fx"] == pytest.approx(29670 / 6.4, rel=1e-3)
    assert a3["frames"] == 3 and np.allclose(a3["misalignment_deg"], 0, atol=0.01)
    assert sum("its header is wrong" in line for line in errors) == 3
