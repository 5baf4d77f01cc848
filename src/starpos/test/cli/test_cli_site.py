# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate --site`: from frames at a known place to an instrument file that `solve` works with."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from cli_calls import WIDE, without_focal_length

from starpos.frames.tables import write_star_list
from starpos.instrument import instrument_file
from starpos.units import utc_text
from starpos_testing.command_line import SENSOR
from starpos_testing.skies.sites import TRUE_A3_DEG, a3_error, shots

LAT, LON = 35.7046, 51.4106
PLACE = ("--site", str(LAT), str(LON))
OPTICS = (*WIDE, *SENSOR)
AIR = ("--pressure-hpa", "880", "--temperature-c", "12")
ARCSEC_DEG = 1 / 3600


@dataclass(frozen=True)
class Night:
    shot: object
    folder: Path

    @property
    def frames(self) -> list[str]:
        return [str(p) for p in sorted(self.folder.glob("?.csv"))]

    @property
    def tilt(self) -> tuple[str, str]:
        return "--tilt", str(self.folder / "tilt.csv")


def written(shot, folder) -> Night:
    rows = ["utc_unix_s,theta_x_deg,theta_y_deg,temperature_c"]
    for k, stars in enumerate(shot.frames):
        write_star_list(
            folder / f"{k}.csv", stars, utc_text(stars.mid_unix_s - stars.exposure_s / 2).rstrip("Z")
        )
        t = shot.tilts[stars.mid_unix_s]
        rows.append(f"{stars.mid_unix_s},{np.degrees(t.theta_x):.8f},{np.degrees(t.theta_y):.8f},15.0")
    (folder / "tilt.csv").write_text("\n".join(rows) + "\n")
    return Night(shot, folder)


@pytest.fixture(scope="module")
def known(tmp_path_factory, catalogue):
    """At a known place, at two leans; tilts of 0.36 arcsec."""
    leans = [0.0, 0.0, 5.0, 5.0]
    return written(
        shots(catalogue, np.random.default_rng(1), leans, noise_deg=1e-4), tmp_path_factory.mktemp("known")
    )


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory, catalogue):
    shot = shots(
        catalogue,
        np.random.default_rng(2),
        [-3.0] * 2,
        noise_deg=1e-4,
        latitude_deg=-20.0,
        longitude_deg=130.0,
    )
    return written(shot, tmp_path_factory.mktemp("elsewhere"))


def check_elsewhere(run, elsewhere, instrument):
    """Check that `solve` finds the other place with this instrument file."""
    status, said, errors = run(
        "solve", *elsewhere.frames, *elsewhere.tilt, *AIR, "--instrument", instrument, "--json"
    )
    assert (status, errors) == (0, [])
    answer = json.loads(said.splitlines()[-1])
    east = (answer["longitude"] - 130.0) * 111.3e3 * np.cos(np.radians(20))
    north = (answer["latitude"] + 20.0) * 110.7e3
    assert abs(east) < 4 * answer["sigma_east_m"] < 4 * 1000
    assert abs(north) < 4 * answer["sigma_north_m"] < 4 * 1000


def test_from_a_known_place_to_a_fix_elsewhere(known, elsewhere, run, tmp_path):
    out = tmp_path / "new" / "mine.yaml"
    status, said, errors = run("calibrate", *known.frames, *known.tilt, *OPTICS, *AIR, *PLACE, "-o", out)
    assert (status, errors) == (0, [])
    first, second = said.splitlines()
    assert first.startswith("A3 of 4 frames at +35.704600 +51.410600 (by gravity): ")
    angles = [float(a) for a in first.split("(by gravity): ")[1].split()[:3]]
    assert angles == pytest.approx(TRUE_A3_DEG, abs=0.05)
    assert second.startswith("the plumb line in the camera is known to ")
    shot = known.shot.frames[0]
    assert instrument_file.read(out).size == (shot.width, shot.height)
    calibration = instrument_file.read(out).calibration
    assert a3_error(known.shot, calibration)[1] < 25
    assert calibration.misalignment_deg == pytest.approx(angles, abs=1e-5)
    assert (calibration.frames, calibration.temperature_c, calibration.valid_days) == (4, 15.0, 365.0)
    # For people.
    assert said.splitlines()[0] in out.read_text()
    check_elsewhere(run, elsewhere, out)


def test_json_is_an_object_a_line(known, elsewhere, run, tmp_path):
    a, b = tmp_path / "camera.yaml", tmp_path / "mine.yaml"
    both = ("--camera", a, *PLACE, "-o", b, "--json")
    status, said, _ = run(
        "calibrate", *known.frames, *known.tilt, *OPTICS, *AIR, "--misalignment", *TRUE_A3_DEG, *both
    )
    assert status == 0
    camera, site = (json.loads(line) for line in said.splitlines())
    assert camera["camera"] == str(a)
    assert site["instrument"] == str(b)
    i = instrument_file.read(b)
    # The camera that was found, and A3 with it.
    assert i.camera == instrument_file.read_camera(a)
    assert i.focal_px == i.camera.fx == camera["fx"]
    assert site["misalignment_deg"] == pytest.approx(i.calibration.misalignment_deg)
    np.testing.assert_allclose(site["covariance_arcsec2"], i.calibration.covariance_arcsec2)
    assert site["frames"] == 4 and 0 < site["plumb_stddev_arcsec"] < 10
    # what the camera's centre is off, A3 makes good: together they are right elsewhere
    check_elsewhere(run, elsewhere, b)


def found_on(run, night, out, *options):
    """Astronomic place that a calibrated instrument has of the very frames, deg, and the plumb line's error."""
    args = (*night.frames, *night.tilt, *AIR)
    status, said, errors = run("calibrate", *args, *OPTICS, "-o", out, "--json", *options)
    assert (status, errors) == (0, [])
    error = json.loads(said)["plumb_stddev_arcsec"]
    answer = json.loads(run("solve", *args, "--instrument", out, "--json")[1].splitlines()[-1])
    return np.array([answer["latitude"], answer["longitude"]]), error


def test_a_geodetic_place_gets_its_deflection(known, run, tmp_path):
    """Phi = phi + xi, Lambda = lambda + eta / cos(phi): north of the map for xi > 0, east for eta."""
    out = tmp_path / "mine.yaml"
    plain, sharp = found_on(run, known, out, *PLACE)
    assert plain == pytest.approx([LAT, LON], abs=3 * ARCSEC_DEG)
    args = ("--geodetic", "--xi", 20, "--eta", -10)
    there, error = found_on(run, known, out, *PLACE, *args, "--deflection-stddev", 0)
    moved = (there - plain) / ARCSEC_DEG
    assert moved == pytest.approx([20, -10 / np.cos(np.radians(LAT))], abs=0.1)
    assert error == pytest.approx(sharp, rel=0.01)
    given = found_on(run, known, out, *PLACE, *args)[1]
    assert given == pytest.approx(np.hypot(sharp, 1.0), rel=0.05)
    unknown = found_on(run, known, out, *PLACE, "--geodetic")[1]
    assert unknown == pytest.approx(np.hypot(sharp, 6.0), rel=0.05)


def test_valid_days_and_the_turn_that_is_known(known, run, tmp_path):
    out = tmp_path / "mine.yaml"
    one = known.frames[:2]
    args = ("calibrate", *one, *known.tilt, *OPTICS, *AIR, *PLACE, "-o", out, "--valid-days", 2)
    status, said, _ = run(*args, "--misalignment", 1.5, -2, 129.5, "--turn-stddev", 0.5)
    assert status == 0
    c = instrument_file.read(out).calibration
    assert c.valid_days == 2
    assert np.sqrt(np.linalg.eigvalsh(c.covariance_arcsec2)[-1]) == pytest.approx(1800, rel=0.01)
    assert "known to 0.5 deg" in said and "leans of some degrees" not in said
    assert "has the plumb line 0." in said.splitlines()[-1]
    # 5 deg further north
    moved = ("--site", LAT + 5, LON)
    said = run(*args, *moved, "--misalignment", 1.5, -2, 129.5)[1]
    assert "given has the plumb line 5.1 deg from there: check the site if it cannot be" in said
    status, said, _ = run(*args)
    assert "to find that turn as well, calibrate with leans of some degrees" in said.splitlines()[-1]
    assert np.sqrt(np.linalg.eigvalsh(instrument_file.read(out).calibration.covariance_arcsec2)[-1]) > 1e5


REFUSED = {
    "no tilt": (("--site", "35", "51", "-o", "OUT", *OPTICS), "give --tilt CSV and -o"),
    "nowhere to write": (("--site", "35", "51", "TILT", *OPTICS), "give --tilt CSV and -o"),
    "latitude": (("--site", "91", "51", "TILT", "-o", "OUT", *OPTICS), "no place is at latitude 91"),
    "longitude": (("--site", "5", "361", "TILT", "-o", "OUT", *OPTICS), "no place is at"),
    "a latitude that is no number": (("--site", "nan", "5", "TILT", "-o", "OUT", *OPTICS), "no place is at"),
    "half a place": (("--site", "35", "TILT", "-o", "OUT", *OPTICS), "--site"),
    "-o without a site": (("-o", "OUT", "--camera", "CAMERA", "TILT", *OPTICS), "is for --site: give both"),
    "geodetic without a site": (("--geodetic", "--camera", "CAMERA", "TILT", *OPTICS), "is for --site: give both"),
    "days without a site": (("--valid-days", "3", "--camera", "CAMERA", *OPTICS), "is for --site: give both"),
    "a turn without a site": (("--turn-stddev", "3", "--camera", "CAMERA", *OPTICS), "is for --site: give both"),
    "a deflection without a site": (("--xi", "3", "--camera", "CAMERA", *OPTICS), "give --site LAT LON"),
    "a deflection by gravity": ((*PLACE, "--eta", "0", "TILT", "-o", "OUT", *OPTICS), "say --geodetic, or"),
    "a geoid by gravity": ((*PLACE, "--geoid", "x.gtx", "TILT", "-o", "OUT", *OPTICS), "say --geodetic"),
    "two deflections": ((*PLACE, "--geodetic", "--xi", "3", "--geoid", "x", "TILT", "-o", "OUT", *OPTICS), "--geoid and"),
    "no such geoid": ((*PLACE, "--geodetic", "--geoid", "none.gtx", "TILT", "-o", "OUT", *OPTICS), "none.gtx"),
    "a deflection that is no number": ((*PLACE, "--geodetic", "--xi", "nan", "TILT", "-o", "OUT", *OPTICS), "finite"),
    "a turn of nothing": ((*PLACE, "--turn-stddev", "0", "TILT", "-o", "OUT", *OPTICS), "must lie between"),
    "no days": ((*PLACE, "--valid-days", "0", "TILT", "-o", "OUT", *OPTICS), "must lie between"),
    "a folder for a file": ((*PLACE, "TILT", "-o", "FOLDER", *OPTICS), "it is there already, and no instrument file"),
    "a file for a folder": ((*PLACE, "TILT", "-o", "/dev/null/mine.yaml", *OPTICS), "the file cannot be written there"),
    "no such tilts": ((*PLACE, "--tilt", "none.csv", "-o", "OUT", *OPTICS), "none.csv"),
    "two instruments": ((*PLACE, "TILT", "-o", "OUT", *OPTICS, "--instrument", "x.yaml"), "give either"),
    "half the optics": ((*PLACE, "TILT", "-o", "OUT", "--pixel-um", "4"), "belong together"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_a_bad_call_is_refused_in_a_line(kind, known, run, tmp_path):
    options, words = REFUSED[kind]
    names = {
        "OUT": [tmp_path / "mine.yaml"],
        "CAMERA": [tmp_path / "camera.yaml"],
        "FOLDER": [tmp_path],
        "TILT": known.tilt,
    }
    options = [x for o in options for x in names.get(o, [o])]
    (tmp_path / "lists").mkdir()
    frames = [without_focal_length(Path(frame), tmp_path / "lists") for frame in known.frames]
    status, said, errors = run("calibrate", *frames, *options)
    assert (status, said) == (2, "")
    assert words in errors[-1]
    assert errors[-1].startswith("starpos calibrate: ")
    assert [path.name for path in tmp_path.iterdir()] == ["lists"]


def test_what_the_frames_do_not_tell_is_status_1_and_no_file(known, run, tmp_path):
    out = tmp_path / "mine.yaml"
    args = ("calibrate", *known.frames, *known.tilt, *AIR, *PLACE, "-o", out)
    status, said, errors = run(*args, "--focal-mm", 45, "--pixel-um", 6.4)
    assert (status, said) == (1, "")
    # a sentence after it may say which focal length fits, if the search at every scale found that in its time
    assert any("no frame has a fix to calibrate from" in line for line in errors)
    tilts = (known.folder / "tilt.csv").read_text().splitlines()
    broken = [
        ",".join([r.split(",")[0], str(float(r.split(",")[1]) + k), *r.split(",")[2:]])
        for k, r in enumerate(tilts[1:])
    ]
    (tmp_path / "tilt.csv").write_text("\n".join([tilts[0], *broken]) + "\n")
    status, said, errors = run(
        "calibrate", *known.frames, "--tilt", tmp_path / "tilt.csv", *OPTICS, *AIR, *PLACE, "-o", out
    )
    assert (status, said) == (1, "")
    assert "do not agree on one zenith" in errors[-1]
    assert not out.exists()


def test_frames_that_cannot_be_read_or_solved_are_named(known, run, tmp_path):
    (tmp_path / "empty.csv").write_text(
        Path(known.frames[0]).read_text().splitlines()[0] + "\nx,y,flux,sigma\n"
    )
    args = (*known.tilt, *OPTICS, *AIR, *PLACE, "-o", tmp_path / "mine.yaml")
    status, said, errors = run(
        "calibrate", *known.frames, tmp_path / "empty.csv", tmp_path / "none.fits", *args
    )
    # An instrument, but one frame could not be read.
    assert status == 2
    assert said.startswith("A3 of 4 frames")
    assert any("none.fits" in e for e in errors)
    assert any("empty.csv" in e for e in errors)
