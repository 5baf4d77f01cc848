# SPDX-License-Identifier: Apache-2.0
"""The command line: what it prints, what it returns, on a small night made by itself."""

import json
import os
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest

from starpos.cli import COMMANDS, main
from starpos_testing.patience import WAIT_S

WIDE = ("--focal-mm", "29.67", "--pixel-um", "6.4")  # 4636 px: 15 deg across 1000 x 700 px
# the same, with an A3 that is known
KNOWN = (*WIDE, "--misalignment", "0", "0", "0", "--misalignment-stddev", "5")
PLACE = {"latitude": 47.3, "longitude": -122.8}
AIR = ("--pressure-hpa", "1000", "--temperature-c", "5")
SOLVE_KEYS = {"utc", "latitude", "longitude", "heading", "latitude_geodetic", "longitude_geodetic",
              "sigma_east_m", "sigma_north_m", "sigma_heading_deg", "covariance", "stars_detected", "stars_matched",
              "residual_arcsec", "log_odds", "status", "warnings"}  # fmt: skip
IDENTIFY_KEYS = {"file", "ra", "dec", "roll", "focal_px", "stars_detected", "stars_matched", "residual_arcsec",
                 "log_odds", "status", "warnings", "cpu_ms"}  # fmt: skip


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """Two frames (FITS) with their tilts and truth."""
    folder = tmp_path_factory.mktemp("night")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    assert main(["simulate", str(folder), "-n", "2", "--size", "1000", "700", *WIDE, *place, *AIR]) == 0
    return folder


@pytest.fixture(scope="module")
def lists(tmp_path_factory):
    """Three lists of stars (CSV) without tilt noise, turning by 40 deg from one to the next."""
    folder = tmp_path_factory.mktemp("lists")
    place = [f"--{k}={v}" for k, v in PLACE.items()]
    command = [
        "simulate",
        str(folder),
        "-n",
        "3",
        "--turn",
        "40",
        "--stars-only",
        "--size",
        "1000",
        "700",
        *WIDE,
        *place,
        *AIR,
    ]
    assert main([*command, "--tilt-noise", "0"]) == 0
    return folder


def run(capsys, *args):
    """Exit status, standard output, lines of standard error."""
    capsys.readouterr()
    try:
        status = main([str(a) for a in args])
    except SystemExit as e:
        status = e.code
    said = capsys.readouterr()
    return status, said.out, said.err.splitlines()


def objects(out):
    def no_constants(name):
        pytest.fail(f"{name} is no JSON")

    return [json.loads(line, parse_constant=no_constants) for line in out.splitlines()]


def solve(capsys, folder, *more, frames="frame_*.fits"):
    paths = sorted(folder.glob(frames))
    return run(capsys, "solve", *paths, "--tilt", folder / "tilt.csv", *AIR, *more)


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
    assert combined["heading"] == pytest.approx(each[-1]["heading"], abs=0.01)  # of the last pose
    assert [e["status"] for e in each] == ["ok"] * 3
    assert abs(combined["latitude"] - PLACE["latitude"]) * 3600 < 1
    truth = json.loads((lists / "truth.json").read_text())
    headings = [f["heading_deg"] for f in truth["frames"]]
    assert [e["heading"] for e in each] == pytest.approx(headings, abs=0.01)


def test_solve_without_json(night, capsys):
    status, out, errors = solve(capsys, night, *KNOWN)
    assert (status, errors) == (0, [])
    assert "2 frames together" in out
    assert "calibration" in out
    assert "geodetic, WGS 84" in out


@pytest.mark.parametrize(
    "given", [(), ("--misalignment", "0", "0", "0")], ids=["not given", "without its error"]
)
def test_an_a3_that_nobody_vouches_for_is_1100_km_and_said_in_a_sentence(given, lists, capsys):
    status, out, errors = solve(capsys, lists, *WIDE, *given, "--json", frames="stars_0000.csv")
    assert status == 0
    (said,) = errors
    for words in (
        "misalignment",
        "not known",
        " km wide",
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
        heights = np.broadcast_to(np.arange(30)[:, None], (30, 40))  # 1 m a degree to the north
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


def test_no_fix_is_exit_1(lists, tmp_path, capsys):
    rows = (lists / "stars_0000.csv").read_text().splitlines()
    few = tmp_path / "few.csv"
    few.write_text("\n".join(rows[:4]) + "\n")
    status, out, errors = run(capsys, "solve", few, "--tilt", lists / "tilt.csv", *WIDE, "--json")
    assert (status, len(errors)) == (1, 1)
    assert objects(out)[0]["status"] == "too few stars"
    late = tmp_path / "tilt.csv"
    late.write_text("utc_unix_s,theta_x_deg,theta_y_deg\n1000,0,0\n")
    status, out, errors = run(capsys, "solve", lists / "stars_0000.csv", "--tilt", late, *WIDE, "--json")
    assert (status, len(errors)) == (1, 1)
    assert [o["status"] for o in objects(out)] == ["no tilt"]


BAD_CALLS = {
    "no command": (),
    "an unknown command": ("solv",),
    "no frame": ("solve",),
    "no tilt": ("identify",),
    "half a focal length": ("identify", "STARS", "--focal-mm", "600"),
    "no focal length": ("identify", "STARS"),
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
    names = {"STARS": lists / "stars_0000.csv", "TILT": lists / "tilt.csv", "OUT": tmp_path / "out"}
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
    assert set(answer) == {"file", "stars", "cpu_ms"}
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


def test_catalogue_info(capsys):
    status, out, _ = run(capsys, "catalogue", "info")
    assert status == 0
    assert "stars of Tycho-2" in out
    assert "Hog et al. 2000" in out


def test_a_catalogue_that_cannot_be_written(capsys, monkeypatch, catalogue, tmp_path):
    from starpos.sky import tycho2

    monkeypatch.setattr(tycho2, "build", lambda *_: catalogue)  # the real one reads 500 MB
    status, _, errors = run(
        capsys, "catalogue", "build", "x", "--out", tmp_path / "no" / "such" / "folder.npz"
    )
    assert (status, len(errors)) == (2, 1)
    assert "folder.npz" in errors[0]


def test_help_and_version(capsys):
    status, out, errors = run(capsys, "--help")
    assert (status, errors) == (0, [])
    assert all(name in out for name in COMMANDS)
    for name in COMMANDS:
        status, out, _ = run(capsys, name, "--help")
        assert status == 0
        assert f"starpos {name}" in out
    assert run(capsys, "--version")[:2] == (0, "starpos 0.1.0\n")


def test_help_imports_nothing_slow():
    """Start-up: neither astropy nor OpenCV nor scipy is loaded to print a help text."""
    program = (
        "import sys\nfrom starpos.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
        "print([m for m in ('astropy', 'cv2', 'scipy', 'numpy', 'yaml') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=WAIT_S
    )
    assert done.stdout.splitlines()[-1] == "[]"


def test_solves_help_does_not_import_astropy():
    program = (
        "import sys\nfrom starpos.cli import main\ntry: main(['solve', '--help'])\nexcept SystemExit: pass\n"
        "print('astropy' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=WAIT_S
    )
    assert done.stdout.splitlines()[-1] == "False"


def test_python_m_starpos(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "starpos", "detect", str(tmp_path / "none.fits")],
        capture_output=True,
        text=True,
        timeout=WAIT_S,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "none.fits" in done.stderr


def starpos(*args, **environment):
    """A whole process: its exit status and its lines of standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "starpos", *map(str, args)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    return done.returncode, done.stderr.splitlines()


def test_a_cache_that_cannot_be_written_is_one_line_for_all_frames(lists, tmp_path):
    rows = (lists / "stars_0001.csv").read_text()
    other = tmp_path / "other.csv"  # of another size, so that two catalogues of triangles are wanted
    other.write_text(rows.replace('"NAXIS1": 1000', '"NAXIS1": 1010'))
    assert other.read_text() != rows
    (tmp_path / "file").touch()
    frames = (lists / "stars_0000.csv", other, lists / "stars_0002.csv")
    status, errors = starpos("identify", *frames, *WIDE, XDG_CACHE_HOME=str(tmp_path / "file"))
    assert (status, len(errors)) == (0, 1), errors
    assert errors[0].startswith("starpos identify: ")
    assert "XDG_CACHE_HOME" in errors[0]


@pytest.mark.parametrize("command", ["solve", "identify"])
def test_a_missing_catalogue_is_one_line(command, lists, tmp_path):
    tilt = ("--tilt", lists / "tilt.csv") if command == "solve" else ()
    none = str(tmp_path / "none.npz")
    status, errors = starpos(command, lists / "stars_0000.csv", *tilt, *WIDE, STARPOS_CATALOGUE=none)
    assert (status, len(errors)) == (2, 1), errors
    assert errors[0].startswith(f"starpos {command}: {none}: no catalogue there")


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


def test_a_reader_that_goes_away_is_no_error(lists):
    """`starpos ... | head` ends quietly."""
    command = [sys.executable, "-m", "starpos", "catalogue", "info"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    _, errors = process.communicate(timeout=WAIT_S)
    assert errors == b""
