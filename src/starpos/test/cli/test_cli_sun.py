# SPDX-License-Identifier: Apache-2.0
"""`starpos solve` on a frame of the Sun: a heading at a known place, and what it says without one."""

import json

import numpy as np
import pytest
from astropy.io import fits

from starpos.cli import main
from starpos_testing.skies.suns import disc_frame

INSTRUMENT = """starpos_instrument: 1
camera: {focal_mm: 25, pixel_um: 11.72, width: 968, height: 608}
misalignment_deg: [-45, 0, 0]
calibration_stddev_arcsec: [60, 60, 60]
tilt_noise_deg: 0.01
tilt_pose_arcsec: 72
clock_stddev_s: 0.02
"""
# of the Sun in the middle of the frame at 52.84 deg, as test_sun.py of fix has it: the camera leans 7.84 deg back
HEADER = {"DATE-OBS": "2025-06-01T08:59:59.9995", "EXPTIME": 0.001, "FOCALLEN": 25.0, "XPIXSZ": 11.72}
AZIMUTH, ALTITUDE = 122.261538, 52.840143


def solved(tmp_path, capsys, *more):
    fits.PrimaryHDU(disc_frame(483.5, 303.5, 9.9, (608, 968)), fits.Header(HEADER)).writeto(
        tmp_path / "sun.fits"
    )
    times = 1748768400.0 + np.linspace(-1, 1, 5)
    wobble = 0.003 * np.array([1, -1, 0, 2, -2])
    rows = [f"{t:.3f},{w:.5f},{ALTITUDE - 45 + w:.5f}" for t, w in zip(times, wobble, strict=True)]
    (tmp_path / "tilt.csv").write_text("utc_unix_s,theta_x_deg,theta_y_deg\n" + "\n".join(rows))
    (tmp_path / "instrument.yaml").write_text(INSTRUMENT)
    status = main(
        ["solve", str(tmp_path / "sun.fits"), "--tilt", str(tmp_path / "tilt.csv"), "--json", "--pressure-hpa", "900",
         "--instrument", str(tmp_path / "instrument.yaml"), *more]
    )  # fmt: skip
    out = capsys.readouterr()
    return status, [json.loads(line) for line in out.out.splitlines()], out.err


def test_a_frame_of_the_sun_has_a_heading_at_a_known_place(tmp_path, capsys):
    status, (frame, *_), _ = solved(tmp_path, capsys, "--site", "48", "11", "0", "--geodetic")
    assert status == 0
    assert frame["bodies"] == ["sun"]
    assert abs(frame["heading"] - (AZIMUTH + 180)) < 4 * frame["sigma_heading_deg"]
    assert 0.02 < frame["sigma_heading_deg"] < 0.1
    assert {"disc", "ephemeris", "calibration", "tilt pose", "clock"} <= set(frame["budget"])


def test_a_frame_of_the_sun_alone_gives_its_zenith_distance_and_no_place(tmp_path, capsys):
    status, (frame, *_), said = solved(tmp_path, capsys)
    assert status == 1
    assert abs(frame["zenith_distance_deg"] - (90 - ALTITUDE)) < 0.1
    assert "do not determine a place" in said


def test_what_is_no_ephemeris_is_a_bad_call(tmp_path, capsys):
    pytest.importorskip("jplephem")
    (tmp_path / "de.bsp").write_text("nothing")
    status, frames, said = solved(
        tmp_path, capsys, "--site", "48", "11", "0", "--ephemeris", str(tmp_path / "de.bsp")
    )
    assert (status, frames) == (2, [])
    assert "de.bsp: this is no ephemeris in SPICE's format" in said
