# SPDX-License-Identifier: Apache-2.0
"""The command line: what it prints, what it returns, on a small night made by itself."""

import json
import re
import shutil
import struct

import numpy as np
import pytest
from cli_calls import IDENTIFY_KEYS, KNOWN, PLACE, SOLVE_KEYS, WIDE, objects, solve, without_focal_length

from starpos.cli import main
from starpos_testing.command_line import SENSOR, run


def test_solve_a_night_of_frames(night, capsys):
    status, out, errors = solve(capsys, night, *KNOWN, "--json")
    assert (status, errors) == (0, [])
    truth = json.loads((night / "truth.json").read_text())
    *each, combined = objects(out)
    assert [e["file"] for e in each] == [str(p) for p in sorted(night.glob("*.fits"))]
    for answer, true in zip(each, truth["frames"], strict=True):
        assert set(answer) >= SOLVE_KEYS
        assert answer["status"] == "ok"
        assert abs(answer["latitude"] - PLACE["latitude"]) * 111195 < 4 * answer["sigma_north_m"]
        east = (answer["longitude"] - PLACE["longitude"]) * 111320 * np.cos(np.radians(PLACE["latitude"]))
        assert abs(east) < 4 * answer["sigma_east_m"]
        assert abs(answer["heading"] - true["heading_deg"]) < 4 * answer["sigma_heading_deg"]
        assert np.array(answer["covariance"]).shape == (3, 3)
        assert answer["covariance"][0][0] == pytest.approx(answer["sigma_east_m"] ** 2)
        assert answer["stars_matched"] <= answer["stars_detected"]
    assert combined["combined"] is True
    assert set(combined) >= SOLVE_KEYS
    assert combined["sigma_north_m"] < each[0]["sigma_north_m"]


def test_solve_star_lists_that_turn(lists, capsys):
    status, out, _ = solve(capsys, lists, *KNOWN, "--json", frames="stars_*.csv")
    assert status == 0
    *each, combined = objects(out)
    assert combined["poses"] == 3
    # The heading is the last pose's.
    assert combined["heading"] == pytest.approx(each[-1]["heading"], abs=0.01)
    assert [e["status"] for e in each] == ["ok"] * 3
    assert abs(combined["latitude"] - PLACE["latitude"]) * 3600 < 1
    truth = json.loads((lists / "truth.json").read_text())
    headings = [f["heading_deg"] for f in truth["frames"]]
    assert [e["heading"] for e in each] == pytest.approx(headings, abs=0.01)


def test_solve_without_json(night, capsys):
    status, out, errors = solve(capsys, night, *KNOWN)
    assert (status, errors) == (0, [])
    assert "2 frames together" in out
    last = out.splitlines()[-1]
    assert re.fullmatch(r"Earth rotation: IERS table, measured until 20\d\d-\d\d-\d\d, .* these frames", last)
    assert "calibration" in out
    assert "geodetic, WGS 84" in out


@pytest.mark.parametrize(
    "given", [(), ("--misalignment", "0", "0", "0")], ids=["not given", "without its error"]
)
def test_an_a3_that_nobody_vouches_for_is_over_1000_km_and_said_in_a_sentence(given, lists, capsys):
    status, out, errors = solve(capsys, lists, *WIDE, *SENSOR, *given, "--json", frames="stars_0000.csv")
    assert status == 0
    (said,) = errors
    for words in (
        "misalignment",
        "not known",
        " km (1 sigma)",
        "--self-calibrate",
        "--site",
        "--misalignment-stddev",
    ):
        assert words in said
    assert 1e6 < objects(out)[0]["sigma_north_m"] < 3e6


def test_the_header_gives_the_focal_length(night, capsys):
    assert solve(capsys, night, "--json")[0] == 0


def test_an_instrument_file(lists, tmp_path, capsys):
    path = tmp_path / "instrument.yaml"
    path.write_text(
        "starpos_instrument: 1\ncamera: {focal_mm: 29.67, pixel_um: 6.4}\nlink_to_camera: [[1,0,0],[0,1,0],[0,0,1]]\n"
        "misalignment_deg: [0, 0, 0]\ncalibration_stddev_arcsec: [5, 5, 5]\n"
    )
    status, out, _ = solve(capsys, lists, "--instrument", path, "--json", frames="stars_0000.csv")
    assert status == 0
    turned = (
        objects(out)[0]["heading"]
        - json.loads((lists / "truth.json").read_text())["frames"][0]["heading_deg"]
    )
    # x of the frame instead of its top: a quarter turn counter-clockwise, for the camera looks up
    assert turned % 360 == pytest.approx(270, abs=3)
    status, _, errors = solve(capsys, lists, "--instrument", path, *WIDE, frames="stars_0000.csv")
    assert (status, len(errors)) == (2, 1)
    assert "either" in errors[0]


def test_a_deflection_moves_the_geodetic_position_only(lists, capsys):
    plain, moved = (
        objects(solve(capsys, lists, *KNOWN, "--json", *xi, frames="stars_0000.csv")[1])[0]
        for xi in ((), ("--xi", "10", "--eta", "-5"))
    )
    assert moved["latitude"] == plain["latitude"]
    assert (moved["latitude_geodetic"] - plain["latitude_geodetic"]) * 3600 == pytest.approx(-10, abs=0.001)
    assert moved["covariance_geodetic"][0][0] < plain["covariance_geodetic"][0][0]


def test_a_deflection_given_by_hand_is_at_the_instrument_whatever_its_altitude(lists, capsys):
    by_hand = ("--xi", "3", "--altitude-m", "2000")
    status, _, errors = solve(capsys, lists, *KNOWN, *by_hand, frames="stars_0000.csv")
    assert status == 2
    assert "at the instrument" in errors[0]


def test_a_geoid_gives_the_deflection_of_the_place_or_says_that_it_cannot(lists, tmp_path, capsys):
    def solved(south, *options):
        # 1 m a degree to the north.
        heights = np.broadcast_to(np.arange(30)[:, None], (30, 40))
        header = struct.pack(">4d2i", south, -140, 1, 1, *heights.shape)
        (tmp_path / "slope.gtx").write_bytes(header + heights.astype(">f4").tobytes())
        geoid = ("--geoid", tmp_path / "slope.gtx", *options)
        status, out, errors = solve(capsys, lists, *KNOWN, "--json", *geoid, frames="stars_0000.csv")
        assert status == 0
        return objects(out), errors

    answers, errors = solved(30)
    for answer in answers:
        assert answer["xi_arcsec"] == pytest.approx(-1.855, abs=0.002)
        assert abs(answer["eta_arcsec"]) < 1e-6
        assert 0 < answer["deflection_stddev_arcsec"] < 1
        assert (answer["latitude"] - answer["latitude_geodetic"]) * 3600 == pytest.approx(-1.855, abs=0.002)
    assert errors == []
    higher, _ = solved(30, "--altitude-m", 3000)
    curved = 3 * 0.1713 * np.sin(2 * np.radians(PLACE["latitude"]))
    assert higher[0]["xi_arcsec"] - answers[0]["xi_arcsec"] == pytest.approx(curved, rel=0.01)
    assert higher[0]["deflection_stddev_arcsec"] < answers[0]["deflection_stddev_arcsec"]
    answers, errors = solved(-60)
    # the height is not known either
    assert [a["deflection_stddev_arcsec"] for a in answers] == pytest.approx([6.0, 6.0], abs=0.01)
    assert len(errors) == 1
    assert "6 arcsec" in errors[0]


def test_a_wrong_misalignment_is_a_wrong_place(lists, capsys):
    _, out, _ = solve(
        capsys, lists, *KNOWN, "--misalignment", "0.1", "0", "0", "--json", frames="stars_0000.csv"
    )
    answer = objects(out)[0]
    off = np.hypot(
        answer["latitude"] - PLACE["latitude"],
        (answer["longitude"] - PLACE["longitude"]) * np.cos(np.radians(47.3)),
    )
    assert off == pytest.approx(0.1, abs=0.01)


def test_an_unreadable_frame_among_good_ones(night, tmp_path, capsys):
    for path in night.iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "frame_0000a.fits").write_bytes(b"SIMPLE  = nothing of the kind")
    status, out, errors = solve(capsys, tmp_path, *KNOWN, "--json")
    assert status == 2
    assert len(errors) == 1
    assert errors[0].startswith("starpos solve: ")
    assert "frame_0000a.fits" in errors[0]
    good, bad, also_good, combined = objects(out)
    assert (good["status"], bad["status"], also_good["status"]) == ("ok", "bad input", "ok")
    assert bad["latitude"] is None
    assert combined["frames"] == 2


def test_an_inclinometer_that_nobody_names_is_said_once_and_errs_as_one_as_sold(lists, capsys):
    a3 = ("--misalignment", "0", "0", "0", "--misalignment-stddev", "5")

    def solved(*options):
        status, out, errors = solve(capsys, lists, *WIDE, *a3, *options, "--json", frames="stars_0000.csv")
        assert status == 0
        return objects(out)[0]["sigma_north_m"], [line for line in errors if "model is not stated" in line]

    unnamed, said = solved()
    as_sold, silent = solved("--inclinometer", "sca100t")
    assert len(said) == 1 and "as sold" in said[0] and "--inclinometer MODEL" in said[0]
    assert silent == [] and unnamed == pytest.approx(as_sold)
    assert unnamed > 3 * solved(*SENSOR)[0]


@pytest.mark.parametrize("how", [(), ("--self-calibrate",)])
def test_an_inclinometer_of_which_nothing_was_solved_is_not_spoken_of(how, lists, tmp_path, capsys):
    of_another_day = tmp_path / "tilt.csv"
    of_another_day.write_text("utc_unix_s,theta_x_deg,theta_y_deg\n1.0e9,0.1,0.1\n")
    paths = sorted(lists.glob("stars_*.csv"))
    status, _, errors = run(capsys, "solve", *paths, *WIDE, "--tilt", of_another_day, *how)
    assert status == 1 and errors and not any("model is not stated" in line for line in errors)


def test_no_fix_is_exit_1(lists, tmp_path, capsys):
    rows = (lists / "stars_0000.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(rows[:4]) + "\n")
    status, out, errors = run(capsys, "solve", few, "--tilt", lists / "tilt.csv", *WIDE, *SENSOR, "--json")
    assert (status, len(errors)) == (1, 1)
    assert objects(out)[0]["status"] == "too few stars"
    late = tmp_path / "tilt.csv"
    late.write_text("utc_unix_s,theta_x_deg,theta_y_deg\n1000,0,0\n")
    status, out, errors = run(
        capsys, "solve", lists / "stars_0000.csv", "--tilt", late, *WIDE, *SENSOR, "--json"
    )
    assert (status, len(errors)) == (1, 1)
    assert [o["status"] for o in objects(out)] == ["no tilt"]


BAD_CALLS = {
    "no command": (),
    "an unknown command": ("solv",),
    "no frame": ("solve",),
    "no tilt": ("identify",),
    "half a focal length": ("identify", "STARS", "--focal-mm", "600"),
    "no focal length": ("navigate", "BARE", "--tilt", "TILT"),
    "a negative focal length": ("identify", "STARS", "--focal-mm=-600", "--pixel-um", "6"),
    "a focal length of nan": ("identify", "STARS", "--focal-mm", "nan", "--pixel-um", "6"),
    "a word for a number": ("identify", "STARS", "--focal-mm", "long", "--pixel-um", "6"),
    "a missing tilt file": ("solve", "STARS", "--tilt", "none.csv", *WIDE),
    "pressure in Pa": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--pressure-hpa", "101325"),
    "a hundredth of the pressure": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--pressure-hpa", "8.8"),
    "humidity in percent": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--humidity", "30"),
    "a deflection of nan": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--xi", "nan"),
    "a missing geoid": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--geoid", "none.gtx"),
    "a geoid that is none": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--geoid", "TILT"),
    "a geoid and a deflection": ("solve", "STARS", "--tilt", "TILT", *WIDE, "--geoid", "a.gtx", "--eta", "0"),
    "a missing instrument file": ("solve", "STARS", "--tilt", "TILT", "--instrument", "none.yaml"),
    "a missing frame": ("detect", "none.fits"),
    "a folder for a frame": ("detect", "."),
    "a missing catalogue": ("catalogue", "info", "none.npz"),
    "a catalogue from nothing": ("catalogue", "build", "none"),
    "a night of no frames": ("simulate", "OUT", "-n", "0"),
    "pixels of no size": ("simulate", "OUT", "--pixel-um", "0"),
    "a place off the Earth": ("simulate", "OUT", "--latitude", "95"),
    "a start that is none": ("simulate", "OUT", "--start", "tomorrow"),
    "a start before the tables": ("simulate", "OUT", "--start", "1960-01-01"),
    "a frame of a terapixel": ("simulate", "OUT", "--size", "1000000", "1000000"),
    "an exposure of nan": ("simulate", "OUT", "--exposure", "nan"),
    "a negative seed": ("simulate", "OUT", "--seed", "-1"),
    "a night where a file is": ("simulate", "STARS", "-n", "1", "--size", "16", "16", "--stars-only"),
}


@pytest.mark.parametrize("kind", BAD_CALLS)
def test_a_bad_call_is_exit_2_and_one_line(kind, lists, tmp_path, capsys):
    bare = without_focal_length(lists / "stars_0000.csv", tmp_path)
    names = {
        "STARS": lists / "stars_0000.csv",
        "BARE": bare,
        "TILT": lists / "tilt.csv",
        "OUT": tmp_path / "out",
    }
    status, out, errors = run(capsys, *(names.get(a, a) for a in BAD_CALLS[kind]))
    assert status == 2
    assert len(errors) == 1
    assert errors[0].startswith("starpos")
    assert "Traceback" not in out


def test_identify(night, lists, capsys):
    frames = [night / "frame_0000.fits", lists / "stars_0000.csv"]
    status, out, errors = run(capsys, "identify", *frames, *WIDE, "--json")
    assert (status, errors) == (0, [])
    answers = objects(out)
    assert len(answers) == 2
    for a, path in zip(answers, frames, strict=True):
        assert set(a) >= IDENTIFY_KEYS
        assert a["file"] == str(path)
        assert a["status"] == "ok"
        assert a["cpu_ms"] > 0
        assert a["focal_px"] == pytest.approx(4636, rel=3e-3)
    # the same instant seen by the same instrument: by its pixels and by its list
    assert answers[0]["ra"] == pytest.approx(answers[1]["ra"], abs=5e-3)
    assert answers[0]["dec"] == pytest.approx(answers[1]["dec"], abs=5e-3)
    status, out, _ = run(capsys, "identify", *frames, *WIDE)
    assert status == 0
    assert out.count("RA ") == 2


def test_identify_needs_no_option_at_all(lists, tmp_path, capsys):
    """The scale is found with the stars; random points have none."""
    bare = without_focal_length(lists / "stars_0000.csv", tmp_path)
    status, out, errors = run(capsys, "identify", bare, "--json")
    (answer,) = objects(out)
    assert (status, errors) == (0, []) and answer["focal_px"] == pytest.approx(4636, rel=3e-3)
    _, out, _ = run(capsys, "identify", lists / "stars_0000.csv", *WIDE, "--json")
    assert objects(out)[0]["ra"] == pytest.approx(answer["ra"], abs=1e-4)


def test_identify_says_which_focal_length_fits(lists, capsys):
    status, _, errors = run(
        capsys, "identify", lists / "stars_0000.csv", "--focal-mm", "40", "--pixel-um", "6.4"
    )
    assert status == 1 and len(errors) == 2
    assert "check the focal length (6250 px given" in errors[0]
    assert "a focal length of 46" in errors[1] and "px fits: give that one" in errors[1]


def test_identify_needs_only_the_size_of_a_list(lists, tmp_path, capsys):
    """`identify` needs only the NAXIS pair; J2000 places then, null where nothing is found."""
    head, *rows = (lists / "stars_0000.csv").read_text().splitlines()
    bare = tmp_path / "bare.csv"
    about = {k: v for k, v in json.loads(head.lstrip("# ")).items() if k.startswith("NAXIS")}
    bare.write_text("\n".join([f"# {json.dumps(about)}", *rows]) + "\n")
    status, out, _ = run(capsys, "identify", bare, *WIDE, "--json")
    assert status == 0
    nothing = tmp_path / "nothing.csv"
    noise = np.random.default_rng(1).uniform(0, 700, (30, 2))
    nothing.write_text(
        f"# {json.dumps(about)}\nx,y,flux,sigma\n"
        + "".join(f"{x},{y},{1000 - k},0.05\n" for k, (x, y) in enumerate(noise))
    )
    status, out, errors = run(capsys, "identify", nothing, *WIDE, "--json")
    (answer,) = objects(out)
    assert (status, len(errors)) == (1, 1)
    assert answer["status"] == "not identified"
    assert all(answer[k] is None for k in ("ra", "dec", "roll", "focal_px", "residual_arcsec", "log_odds"))


def test_detect(night, capsys):
    status, out, errors = run(capsys, "detect", night / "frame_0000.fits", "--json")
    (answer,) = objects(out)
    assert (status, errors) == (0, [])
    assert (set(answer), answer["negative"]) == ({"file", "stars", "cpu_ms", "negative"}, False)
    assert len(answer["stars"]) > 50
    x, y, flux, snr, sigma_x, sigma_y, flags = np.array(answer["stars"]).T
    assert np.all(np.diff(flux) <= 0)
    assert (x.min() >= 0, y.max() <= 699) == (True, True)
    assert np.all((sigma_x > 0) & (sigma_y > 0) & (snr > 0) & (flags >= 0))


def test_simulate_is_the_same_for_the_same_seed(tmp_path):
    for name in ("a", "b"):
        assert (
            main(
                [
                    "simulate",
                    str(tmp_path / name),
                    "-n",
                    "1",
                    "--size",
                    "64",
                    "48",
                    "--seed",
                    "7",
                    "--altitude",
                    "80",
                ]
            )
            == 0
        )
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_identify_frames_of_any_year(lists, tmp_path, capsys):
    """No Earth rotation is needed for where a camera looks."""
    head, rows = (lists / "stars_0000.csv").read_text().split("\n", 1)
    about = json.loads(head.lstrip("# "))
    for year, expected in ((1950, 0), (2035, 0), (1850, 1)):
        path = tmp_path / f"{year}.csv"
        about["DATE-OBS"] = f"{year}-11-02T18:00:00"
        path.write_text(f"# {json.dumps(about)}\n{rows}")
        status, _, errors = run(capsys, "identify", path, *WIDE, "--json")
        assert (status, len(errors)) == (expected, expected), errors
    assert "between 1900 and 2100" in errors[0]
