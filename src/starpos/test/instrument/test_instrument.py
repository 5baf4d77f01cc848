# SPDX-License-Identifier: Apache-2.0
"""A3 with its covariance, the base link, the camera: what an Instrument holds and refuses to hold."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.errors import InstrumentError
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument, focal_px_of
from starpos.units import ARCSEC


def test_misalignment_is_r3_r2_r1():
    """A3 = R3(rz) R2(ry) R1(rx), active, C into S."""
    np.testing.assert_allclose(Calibration(misalignment_deg=(90, 0, 0)).a3 @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(Calibration(misalignment_deg=(0, 90, 0)).a3 @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(Calibration(misalignment_deg=(0, 0, 90)).a3 @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    # R1 acts first: y -> z -> (R2) x -> (R3) y
    np.testing.assert_allclose(
        Calibration(misalignment_deg=(90, 90, 90)).a3 @ [0, 1, 0], [0, 1, 0], atol=1e-15
    )


def test_the_link_looks_along_the_top_of_the_frame():
    link = np.array(Instrument(1.0).link_to_camera)
    np.testing.assert_array_equal(link @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(link @ [0, 0, 1], [0, 0, 1])
    assert np.linalg.det(link) == pytest.approx(1)


def test_intrinsics_of_another_frame_size():
    camera = Camera(width=1392, height=1040, fx=5200.5, fy=5201.5, cx=700.25, cy=520.0)
    assert Instrument(5200.5, camera=camera).camera_for(1392, 1040) is camera
    with pytest.raises(InstrumentError, match="1392 x 1040"):
        Instrument(5200.5, camera=camera).camera_for(1392, 1041)


@pytest.mark.parametrize("ry", [-90.0, -89.9999999, 30.0, 90.0])
def test_angles_hold_a3_where_its_x_axis_is_the_cameras_z(ry, rng):
    """At 90 deg two of the three angles are about one axis, and the sine of the third shows only half of the digits."""
    a3 = Calibration(misalignment_deg=(20.0, ry, -130.0)).a3 @ rotation.from_vector(rng.normal(0, 1e-16, 3))
    np.testing.assert_allclose(Calibration().turned_to(a3).a3, a3, atol=1e-15)


@pytest.mark.parametrize(
    "angles", [(1.5, -2.0, 130.0), (0.0, 0.0, 0.0), (-20.0, 60.0, 179.99), (5.0, -80.0, -10.0)]
)
def test_the_covariance_of_the_angles_is_that_of_turned_a3s(angles, rng):
    """Against A3s turned at random about S's axes."""
    root = rng.normal(size=(3, 3)) * [[30.0], [50.0], [400.0]]
    c = Calibration(misalignment_deg=angles, covariance_arcsec2=tuple(map(tuple, (root @ root.T).tolist())))
    turned = rng.normal(size=(4000, 3)) @ root.T * ARCSEC
    found = np.array([c.turned_to(rotation.from_vector(w) @ c.a3).misalignment_deg for w in turned])
    off = (found - angles + 180) % 360 - 180
    sigma = np.sqrt(np.diag(c.angle_covariance_deg2))
    np.testing.assert_allclose(off.T @ off / 4000 / np.outer(sigma, sigma),
                               c.angle_covariance_deg2 / np.outer(sigma, sigma), atol=4 * np.sqrt(2 / 4000))  # fmt: skip


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"misalignment_deg": (0.0, 0.0)}, "three numbers"),
        ({"misalignment_deg": (0.0, np.nan, 0.0)}, "within 360 deg"),
        ({"misalignment_deg": (0.0, 1e300, 0.0)}, "within 360 deg"),
        ({"covariance_arcsec2": ((1.0, 0.0), (0.0, 1.0))}, "3 x 3"),
        ({"covariance_arcsec2": ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "symmetric"),
        ({"covariance_arcsec2": ((1.0, 2.0, 0.0), (2.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "negative"),
        ({"covariance_arcsec2": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "negative"),
        (
            {"covariance_arcsec2": ((1e308, 1e308, 0.0), (1e308, 1e308, 0.0), (0.0, 0.0, 1.0))},
            "beyond any turn",
        ),
        ({"tilt_deg": (0.0,)}, "two or three axes"),
        ({"tilt_deg": (80.0, 80.0)}, "is impossible: give the elevations"),
        ({"tilt_deg": (np.inf, 0.0)}, "is impossible"),
        ({"temperature_c": np.inf}, "temperature_c"),
        ({"temperature_c": -1e300}, "temperature_c"),
        ({"valid_days": 0.0}, "valid_days is 0.0: must be positive"),
        ({"valid_days": np.nan}, "valid_days is nan"),
    ],
)
def test_a_calibration_that_is_none(given, words):
    with warnings.catch_warnings(), pytest.raises(InstrumentError, match=words):
        # A warning of numpy would make a user wonder.
        warnings.simplefilter("error")
        Calibration(**given)


@pytest.mark.parametrize("stddev", [(1.0, 1.0), (1.0, -1.0, 1.0), (1.0, np.nan, 1.0), (1e200, 1.0, 1.0)])
def test_errors_of_a3_that_are_none(stddev):
    with warnings.catch_warnings(), pytest.raises(InstrumentError, match="calibration_stddev_arcsec"):
        warnings.simplefilter("error")
        Calibration.of((0.0, 0.0, 0.0), stddev)


@pytest.mark.parametrize("value", [-1e-9, np.nan, np.inf, 1.6])
@pytest.mark.parametrize("name", list(vars(InclinometerErrors())))
def test_errors_of_an_inclinometer_that_are_none(name, value):
    with pytest.raises(InstrumentError, match=name):
        InclinometerErrors(**{name: value})


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 1e300])
def test_a_clock_that_is_none(value):
    with pytest.raises(InstrumentError, match="clock_stddev"):
        Instrument(1.0, clock_stddev_s=value)


@pytest.mark.parametrize(
    "link", [np.full((3, 3), 1e300), np.diag([1, 1, -1.0]), np.eye(2), np.full((3, 3), np.nan)]
)
def test_a_link_that_is_no_rotation(link):
    with warnings.catch_warnings(), pytest.raises(InstrumentError, match="link_to_camera"):
        warnings.simplefilter("error")
        Instrument(1.0, link_to_camera=link)


def test_age():
    c = Calibration(utc_unix_s=1e9, valid_days=10.0)
    c.check_age(1e9 + 9.9 * 86400)
    c.check_age(1e9 - 9.9 * 86400)
    for off in (10.1, -10.1):
        with pytest.raises(InstrumentError, match=r"2001-09-09T01:46:40\.000Z is 10 days .* holds for 10"):
            c.check_age(1e9 + off * 86400)
    replace(c, valid_days=float("inf")).check_age(1e12)
    # Its age is unknown.
    Calibration(valid_days=1.0).check_age(1e9)


def test_focal_length_in_pixels():
    assert focal_px_of(600.0, 6.4) == 93750.0
    for focal, pixel in (
        (0.0, 6.4),
        (600.0, 0.0),
        (-600.0, -6.4),
        (float("nan"), 6.4),
        (600.0, float("inf")),
    ):
        with pytest.raises(InstrumentError, match="both must be positive"):
            focal_px_of(focal, pixel)


@pytest.mark.parametrize("wrong", [((0, 0, 0), 5), ((0, 0, 0), (1, 2)), (5,), ("abc",), ((1, 2),)])
def test_a_calibration_of_other_than_three_numbers_is_refused(wrong):
    with pytest.raises(InstrumentError, match="is three numbers, one for each axis: give three"):
        Calibration.of(*wrong)


def test_what_is_unknown_of_two_calibrations_makes_them_no_different():
    """From Python 3.13 on a dataclass compares field by field, and a NaN is unlike itself."""
    unknown, also = Calibration(), Calibration(utc_unix_s=float("nan"), temperature_c=np.float64("nan"))
    assert unknown == also and hash(unknown) == hash(also) and Instrument(1.0) == Instrument(1.0)
    assert unknown != replace(unknown, temperature_c=20.0) and unknown != replace(also, frames=1)
    assert unknown != unknown.covariance_arcsec2
