# SPDX-License-Identifier: Apache-2.0
"""`starpos calibrate --camera`: the file it writes, what it prints, what it refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from cli_calls import without_focal_length

from starpos.frames.tables import write_star_list
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Calibration
from starpos.units import utc_text
from starpos_testing.skies.lenses import FIELDS, night, random_camera, values

AIR = ("--pressure-hpa", "880", "--temperature-c", "12")
INSTRUMENT = (
    "starpos_instrument: 1\nmisalignment_deg: [-45, 0, 0]\ncalibration_stddev_arcsec: [5, 5, 5]\ncamera: {}\n"
)
# 2750 px: 25 deg.
OPTICS = ("--focal-mm", "27.5", "--pixel-um", "10")

NAMES = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"]
A3_TOO = "starpos calibrate: an A3 belongs to the camera it was found with: find it again with this one"


@pytest.fixture(scope="module")
def skies(tmp_path_factory, catalogue):
    """A camera that looks 45 deg up from a level inclinometer, the folder of four star lists of it, of their tilts and of
    the instrument as it is said to be."""
    rng = np.random.default_rng(26)
    true = random_camera(25, rng)
    lists, levels = night(true, 4, catalogue, rng, FIELDS[25][2], altitude=(43, 47), roll=(-5, 5))
    a3 = Calibration(misalignment_deg=(-45.0, 0.0, 0.0)).a3
    folder = tmp_path_factory.mktemp("skies")
    tilts = ["utc_unix_s,theta_x_deg,theta_y_deg"]
    for k, (stars, level) in enumerate(zip(lists, levels, strict=True)):
        write_star_list(
            folder / f"{k}.csv", stars, utc_text(stars.mid_unix_s - stars.exposure_s / 2).rstrip("Z")
        )
        x, y = np.degrees(np.arcsin((a3 @ level[2])[:2]))
        tilts.append(f"{stars.mid_unix_s},{x:.7f},{y:.7f}")
    (folder / "tilt.csv").write_text("\n".join(tilts) + "\n")
    (folder / "instrument.yaml").write_text(INSTRUMENT.format("{focal_mm: 27.5, pixel_um: 10}"))
    return true, folder


def frames(folder: Path) -> list[Path]:
    return sorted(folder.glob("?.csv"))


def level(folder: Path, instrument="instrument.yaml") -> tuple:
    return "--tilt", folder / "tilt.csv", "--instrument", folder / instrument, *AIR


def test_the_file_holds_the_camera_the_table_says_how_well(skies, run, tmp_path):
    true, folder = skies
    out = tmp_path / "new" / "camera.yaml"
    status, said, errors = run(
        "calibrate", *frames(folder), *level(folder), "--camera", out, "--map",
        tmp_path / "map.png",
    )  # fmt: skip
    assert (status, errors) == (0, [A3_TOO])
    camera = instrument_file.read_camera(out)
    first, *table, last = said.splitlines()
    assert first.startswith("4 frames, ")
    assert [line.split()[0] for line in table] == NAMES
    sigma = np.array([float(line.split()[3]) for line in table])
    shown = np.array([float(line.split()[1]) for line in table])
    assert (np.abs(shown - values(camera)) < 0.6 * sigma).all()
    assert (np.abs(values(camera) - values(true)) < 4.2 * sigma).all()
    assert all(line.endswith("from the stars") for line in table)
    assert "px at worst" in last
    comment = [line for line in out.read_text().splitlines() if line.startswith("#")]
    rows = np.array([[float(v) for v in line[1:].split()] for line in comment[-9:]])
    np.testing.assert_allclose(np.sqrt(np.diag(rows)), sigma, rtol=0.06)
    assert cv2.imread(str(tmp_path / "map.png")) is not None


def test_json_and_the_camera_in_an_instrument_file(skies, run, tmp_path):
    true, folder = skies
    status, said, errors = run(
        "calibrate", *frames(folder), *level(folder), "--camera",
        tmp_path / "camera.yaml", "--json",
    )  # fmt: skip
    assert (status, errors) == (0, [A3_TOO])
    answer = json.loads(said)
    camera = instrument_file.read_camera(tmp_path / "camera.yaml")
    found = [*(answer[k] for k in ("fx", "fy", "cx", "cy")), *answer["distortion"]]
    np.testing.assert_array_equal(found, values(camera))
    covariance = np.array(answer["covariance"])
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [answer["sigma"][p] for p in NAMES])
    z = np.linalg.solve(np.linalg.cholesky(covariance), found - values(true))
    assert (z @ z) < 40
    assert answer["told"] == NAMES
    assert answer["frames"] == 4
    assert answer["stars"] > 200
    assert answer["rms_px"] < 0.3 * answer["rms_before_px"]

    instrument = tmp_path / "instrument.yaml"
    instrument.write_text(INSTRUMENT.format("{calibration: camera.yaml}"))
    status, said, _ = run(
        "solve", *frames(folder), "--tilt", folder / "tilt.csv", "--instrument", instrument, *AIR, "--json"
    )
    assert status == 0
    ideal = run(
        "solve",
        *frames(folder),
        "--tilt",
        folder / "tilt.csv",
        "--instrument",
        folder / "instrument.yaml",
        *AIR,
        "--json",
    )[1]
    better, worse = (json.loads(text.splitlines()[0])["residual_arcsec"] for text in (said, ideal))
    assert better < 0.5 * worse
    # and to begin with, where it stays what it is
    status, said, _ = run(
        "calibrate", *frames(folder), "--tilt", folder / "tilt.csv", "--instrument", instrument, *AIR, "--camera",
        tmp_path / "again.yaml", "--json",
    )  # fmt: skip
    again = values(instrument_file.read_camera(tmp_path / "again.yaml"))
    assert (np.abs(again - found) < 0.3 * np.sqrt(np.diag(covariance))).all()


def test_without_tilts_it_says_what_that_costs(skies, run, tmp_path):
    true, folder = skies
    out = tmp_path / "camera.yaml"
    status, said, errors = run("calibrate", *frames(folder), *OPTICS, *AIR, "--camera", out, "--json")
    assert status == 0
    line, more = errors
    assert more == A3_TOO
    assert line.startswith(
        "starpos calibrate: without --tilt how refraction shrinks the field is not known: "
    )
    assert "ppm" in line
    answer = json.loads(said)
    assert abs(answer["fx"] - true.fx) < 4 * answer["sigma"]["fx"]
    assert answer["sigma"]["fx"] > 5e-5 * true.fx


def test_a_frame_without_a_tilt_and_one_that_is_none(skies, run, tmp_path):
    _, folder = skies
    tilts = tmp_path / "tilt.csv"
    tilts.write_text("\n".join((folder / "tilt.csv").read_text().splitlines()[:-1]) + "\n")
    args = ("--tilt", tilts, *OPTICS, *AIR, "--camera", tmp_path / "camera.yaml")
    status, said, errors = run("calibrate", *frames(folder), tmp_path / "none.fits", *args)
    # A camera, but one frame could not be read.
    assert status == 2
    assert said.startswith("3 frames, ")
    assert len(errors) == 3 and errors[-1] == A3_TOO
    assert "none.fits: there is no such file" in errors[0]
    assert "3.csv is left out: no tilt reading" in errors[1]
    status, said, errors = run("calibrate", frames(folder)[-1], *args)
    assert (status, said) == (1, "")
    assert "no frame has a tilt" in errors[-1]


REFUSED = {
    "nothing": ((), 2, "give --camera OUT.yaml"),
    "half a focal length": (("--camera", "OUT", "--focal-mm", "40"), 2, "belong together"),
    "wrong focal length": (("--camera", "OUT", "--focal-mm", "40", "--pixel-um", "10"), 1, "no part of the sky matches"),
    "two instruments": (("--camera", "OUT", *OPTICS, "--instrument", "x.yaml"), 2, "give either"),
    "no such instrument": (("--camera", "OUT", "--instrument", "x.yaml"), 2, "x.yaml: not a readable"),
    "no such tilts": (("--camera", "OUT", *OPTICS, "--tilt", "x.csv"), 2, "x.csv"),
    "no place for it": (("--camera", "/dev/null/camera.yaml", *OPTICS), 2, "cannot be written there"),
    "no place for the map": (("--camera", "OUT", *OPTICS, "--map", "/dev/null/map.png"), 2, "map.png: the map cannot"),
    "no kind of map": (("--camera", "OUT", *OPTICS, "--map", "OUT.docx"), 2, "docx: the map cannot"),
    "air beyond air": (("--camera", "OUT", *OPTICS, "--pressure-hpa", "1e9"), 2, "pressure"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_in_a_line(kind, skies, run, tmp_path):
    _, folder = skies
    options, expected, words = REFUSED[kind]
    options = [o.replace("OUT", str(tmp_path / "camera.yaml")) for o in options]
    status, said, errors = run(
        "calibrate", *(without_focal_length(frame, tmp_path) for frame in frames(folder)), *options
    )
    assert (status, said) == (expected, "")
    assert any(words in line for line in errors)
    assert errors[-1].startswith("starpos calibrate: ")
    assert kind != "wrong focal length" or " px fits: give that one" in errors[-1]


def test_no_calibration_no_file(skies, run, tmp_path):
    _, folder = skies
    out = tmp_path / "camera.yaml"
    status, _, _ = run("calibrate", *frames(folder), "--focal-mm", "40", "--pixel-um", "10", "--camera", out)
    assert status == 1
    assert not out.exists()
