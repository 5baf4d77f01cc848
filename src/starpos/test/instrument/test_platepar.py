# SPDX-License-Identifier: Apache-2.0
"""Platepars of RMS, read and written: compared with RMS's formulas in angles, and with values that RMS's code gave."""

import json
from math import acos, asin, atan2, cos, degrees, pi, radians, sin, tan

import numpy as np
import pytest

from starpos import rotation
from starpos.errors import InstrumentError
from starpos.instrument import instrument_file, platepar
from starpos.instrument.camera import EQUIDISTANT, Camera

FISHEYE = Camera(
    width=1200,
    height=1000,
    fx=382.0,
    fy=381.5,
    cx=603.0,
    cy=496.0,
    distortion=(-0.02, 0.003, -1e-3, 1e-4),
    model=EQUIDISTANT,
)
NARROW = Camera(
    width=1280, height=720, fx=1500.0, fy=1501.0, cx=650.0, cy=350.0, distortion=(-0.1, 0.02, 0, 0, 0)
)
UTC, LATITUDE, LONGITUDE = 1.72e9, 0.8, 0.3


def seen_with(camera, altitude_deg):
    """Pixels of a camera facing azimuth 200 deg, and the places that they show above 20 deg under RMS's own sky."""
    xy = np.stack(
        np.meshgrid(np.linspace(100, camera.width - 100, 12), np.linspace(60, camera.height - 60, 12)), -1
    )
    xy = xy.reshape(-1, 2)
    azimuth, altitude = radians(200), radians(altitude_deg)
    axis = np.array([sin(azimuth) * cos(altitude), cos(azimuth) * cos(altitude), sin(altitude)])
    right = np.array([cos(azimuth), -sin(azimuth), 0.0])
    local = (
        camera.directions(*xy.T)
        @ rotation.about_axis(2, 0.7)
        @ np.stack([right, np.cross(axis, right), axis])
    )
    high = local[:, 2] > sin(radians(20))
    places = [true_of(*v) for v in local[high]]
    return xy[high], np.array(places)


JD = 2440587.5 + UTC / 86400


def sidereal(jd):
    t = (jd - 2451545) / 36525
    return radians(
        (280.46061837 + 360.98564736629 * (jd - 2451545) + 0.000387933 * t**2 - t**3 / 38710000) % 360
    )


def precessed(ra, dec, start, end):
    """Meeus, chapter 21."""
    s, t = (start - 2451545) / 36525, (end - start) / 36525
    one = (2306.2181 + 1.39656 * s - 0.000139 * s**2) * t
    zeta = one + (0.30188 - 0.000344 * s) * t**2 + 0.017998 * t**3
    z = one + (1.09468 + 0.000066 * s) * t**2 + 0.018203 * t**3
    theta = (2004.3109 - 0.8533 * s - 0.000217 * s**2) * t - (0.42665 + 0.000217 * s) * t**2 - 0.041833 * t**3
    zeta, z, theta = (radians(v / 3600) for v in (zeta, z, theta))
    a = cos(dec) * sin(ra + zeta)
    b = cos(theta) * cos(dec) * cos(ra + zeta) - sin(theta) * sin(dec)
    c = sin(theta) * cos(dec) * cos(ra + zeta) + cos(theta) * sin(dec)
    return atan2(a, b) + z, asin(c)


def raised(altitude):
    deg = degrees(altitude)
    return altitude + radians(1.02 / 60 / tan(radians(deg + 10.3 / (deg + 5.11))))


def true_of(east, north, up):
    """The J2000 direction whose light RMS has at a direction that is seen."""
    seen = low = asin(up)
    for _ in range(20):
        low -= raised(low) - seen
    azimuth = atan2(east, north)
    dec = asin(sin(LATITUDE) * sin(low) + cos(LATITUDE) * cos(low) * cos(azimuth))
    hour = atan2(-sin(azimuth) * cos(low), cos(LATITUDE) * sin(low) - sin(LATITUDE) * cos(low) * cos(azimuth))
    ra, dec = precessed(sidereal(JD) + LONGITUDE - hour, dec, JD, 2451545)
    return cos(dec) * cos(ra), cos(dec) * sin(ra), sin(dec)


def refracted(ra, dec):
    ra, dec = precessed(ra, dec, 2451545, JD)
    hour = sidereal(JD) + LONGITUDE - ra
    altitude = raised(asin(sin(LATITUDE) * sin(dec) + cos(LATITUDE) * cos(dec) * cos(hour)))
    azimuth = pi + atan2(sin(hour), cos(hour) * sin(LATITUDE) - tan(dec) * cos(LATITUDE))
    dec = asin(sin(LATITUDE) * sin(altitude) + cos(LATITUDE) * cos(altitude) * cos(azimuth))
    hour = atan2(-sin(azimuth), tan(altitude) * cos(LATITUDE) - cos(azimuth) * sin(LATITUDE))
    return precessed(sidereal(JD) + LONGITUDE - hour, dec, JD, 2451545)


def pixel_of(plate, centre, place):
    """Where RMS sees a place (3,), about a centre (RA, dec, position angle): a radial distortion of odd powers."""
    (ra0, dec0, turn), (ra, dec) = centre, refracted(atan2(place[1], place[0]), asin(place[2]))
    far = acos(sin(dec0) * sin(dec) + cos(dec0) * cos(dec) * cos(ra - ra0))
    across, along = (
        cos(dec) * sin(ra - ra0) / sin(far),
        (sin(dec) - sin(dec0) * cos(far)) / cos(dec0) / sin(far),
    )
    angle = -atan2(across, along) + turn - pi / 2
    half, (x0, y0, xy, *k) = plate["X_res"] / 2, plate["x_poly_rev"]
    r = degrees(far) * plate["F_scale"] / half
    r *= 1 - sum(c * r ** (2 * n + 2) for n, c in enumerate(k))
    x, y = half * r * cos(angle), half * r * sin(angle) / (1 + xy)
    return x + (x0 + 1) * half, y + (y0 + 1) * plate["Y_res"] / 2


@pytest.mark.parametrize(("camera", "altitude", "near"), [(FISHEYE, 80, 0.01), (NARROW, 45, 0.02)])
def test_rms_sees_each_star_where_the_camera_does(camera, altitude, near, tmp_path):
    seen_xy, icrs = seen_with(camera, altitude)
    plate, worst = platepar.platepar_of(camera, seen_xy, icrs, UTC, (LATITUDE, LONGITUDE, 120.0))
    plate = json.loads(json.dumps(plate))
    pointing = np.radians([plate[k] for k in ("RA_d", "dec_d", "pos_angle_ref")])
    # the one formula that is not simple in angles is compared with RMS's own values below
    centre = platepar._seen_pointing(pointing, JD, LATITUDE, LONGITUDE)
    off = [
        np.hypot(*np.subtract(pixel_of(plate, centre, v), xy)) for v, xy in zip(icrs, seen_xy, strict=True)
    ]
    assert max(off) < near and worst == pytest.approx(max(off), abs=1e-5)
    # back to a lens: the polynomial of RMS's other way
    path = tmp_path / "platepar_cmn2010.cal"
    path.write_text(json.dumps(plate))
    read = instrument_file.read(path).camera
    assert np.abs(read.project(camera.directions(*seen_xy.T)) - seen_xy).max() < 0.05


def test_a_pointing_is_turned_as_rms_turns_it():
    # cyTrue..., eqRefractionTrueToApparent and equatorialCoordAndRotPrecession of RMS f441ef15, compiled
    got = platepar._seen_pointing(
        np.radians([120.0, 35.0, 50.0]), 2460500.3, np.radians(45.5), np.radians(14.25)
    )
    np.testing.assert_allclose(np.degrees(got), RMS_POINTING, rtol=0, atol=1e-9)


RMS_POINTING = [119.66067271914, 35.11873431037, 49.85451454785]


def test_all_types_of_distortion_are_understood():
    # angles from the centre in deg by RMS's cyXYToRADec of f441ef15, compiled, of pixels (100, 80) and (1000, 500)
    for kind, (x, y, flags, angles) in RMS_ANGLES.items():
        plate = PLATE | flags | {"distortion_type": kind, "x_poly_fwd": x, "y_poly_fwd": y}
        _, off = platepar._undistorted(plate, np.array([[100.0, 80.0], [1000.0, 500.0]]))
        np.testing.assert_allclose(np.hypot(*off.T) / plate["F_scale"], angles, rtol=0, atol=1e-9)


PLATE = {"X_res": 1280, "Y_res": 720, "F_scale": 20.0, "lat": 45.5, "lon": 14.25, "elev": 300.0}
RMS_ANGLES = {
    "poly3+radial5": (
        [0.5, 0.001, 0.002, 1e-06, -2e-06, 3e-06, 1e-09, 2e-09, -1e-09, 1e-09, 1e-05, 2e-05, 1e-11, 1e-17],
        [0.4, -0.001, 0.002, 2e-06, -1e-06, 1e-06, 2e-09, 1e-09, -1e-09, 1e-09, 2e-05, -1e-05, 2e-11, -1e-17],
        {},
        [30.83049729544, 19.50919581827],
    ),
    "radial5-all": (
        [0.02, 0.01, 0.003, 0.002, 0.3, 0.01, -0.02, 0.015, 0.005],
        [0.5],
        {"equal_aspect": False, "force_distortion_centre": False, "asymmetry_corr": True},
        [31.36757162279, 18.7071491025],
    ),
    "radial9-odd": (
        [0.01, -0.02, 0.015, 0.005],
        [0.5],
        {"equal_aspect": True, "force_distortion_centre": True, "asymmetry_corr": False},
        [30.66521671401, 19.31553831192],
    ),
    "radial3-odd": (
        [0.02, 0.01, 0.003, -0.05],
        [0.5],
        {"equal_aspect": False, "force_distortion_centre": False, "asymmetry_corr": False},
        [29.61799035147, 18.3418802477],
    ),
}


def test_config_has_the_field_and_the_place(tmp_path):
    path = tmp_path / ".config"
    path.write_text(
        "[System]\nlatitude: 45.5 ; WGS84 +N\nlongitude: -14.25\nelevation: 300\n"
        "[Capture]\nwidth: 1280\nheight: 720\nfps: 25.0\nfov_w: 88\nfov_h: 45\n"
    )
    station = platepar.read(path)
    assert (station.latitude_deg, station.longitude_deg, station.height_m) == (45.5, -14.25, 300)
    assert station.instrument.camera.fx == pytest.approx(1280 / radians(88))


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "[1]",
        "45.1 14.2 100\n01 01 2020",
        json.dumps({"X_res": 9, "Y_res": "?"}),
        "\0",
        '{"lat": ' * 500,
    ],
)
def test_other_files_are_refused_with_a_sentence(text, tmp_path):
    for name in ("a.cal", "b.config"):
        (tmp_path / name).write_text(text)
        with pytest.raises(InstrumentError, match=r"not a platepar|its "):
            platepar.read(tmp_path / name)
