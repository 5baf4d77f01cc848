# SPDX-License-Identifier: Apache-2.0
"""The sentence for a frame that is not identified distinguishes the causes."""

import numpy as np

from starpos.fix.checks import why_unidentified
from starpos.fix.solution import Status
from starpos.fix.solver import Solver
from starpos.frames.frame import SATURATED, Stars, no_stars
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import Instrument
from starpos.sky import deeper

WIDE, NARROW = 4000.0, 95000.0


def points(n, rng, flags=0, fwhm_px=2.5):
    """Random points, which are no part of the sky."""
    return Stars(
        x=rng.uniform(0, 999, n),
        y=rng.uniform(0, 799, n),
        flux=np.arange(n, 0, -1.0),
        snr=np.full(n, 20.0),
        covariance=np.broadcast_to(0.01 * np.eye(2), (n, 2, 2)),
        flags=np.full(n, flags),
        width=1000,
        height=800,
        fwhm_px=fwhm_px,
        source="a.fits",
    )


def said_of(stars, catalogue, focal_px=WIDE):
    s = Solver(Instrument(focal_px), catalogue).identify(stars)
    assert not s.ok
    return s.status, s.message


def test_no_stars(catalogue):
    status, message = said_of(no_stars(1000, 800), catalogue)
    assert status is Status.TOO_FEW_STARS
    assert message == "the frame: 0 stars detected, at least 4 are needed: check clouds, focus and exposure"


def test_few_stars_and_how_wide_they_are(catalogue, rng):
    status, message = said_of(points(3, rng, fwhm_px=14.2), catalogue)
    assert status is Status.TOO_FEW_STARS
    assert "3 stars detected, at least 4 are needed: they are 14 px wide (FWHM): focus" in message


def test_many_stars_that_are_too_wide(catalogue, rng):
    status, message = said_of(points(25, rng, fwhm_px=11.0), catalogue)
    assert status is Status.NOT_IDENTIFIED
    assert "25 stars: its stars are 11 px wide (FWHM)" in message and "catalogue" not in message


def test_a_field_with_too_few_stars_of_the_catalogue(catalogue, rng, monkeypatch):
    monkeypatch.setattr(deeper, "kept", lambda: None)
    message = why_unidentified(points(25, rng), Camera.from_focal(1000, 800, NARROW), catalogue)
    assert (
        "a field of 0.6 x 0.48 deg holds only 6.7 stars" in message and "starpos catalogue deepen" in message
    )
    assert "wide (FWHM)" not in message


def test_an_order_of_brightness_that_says_little(catalogue, rng):
    _, message = said_of(points(25, rng, SATURATED), catalogue)
    assert "20 of its 20 brightest are saturated" in message


def test_nothing_but_the_focal_length_and_the_weather_where_nothing_else_can_be_told(catalogue, rng):
    _, message = said_of(points(25, rng), catalogue)
    assert message.startswith(
        "a.fits: no part of the sky matches its 25 stars: check the focal length (4000 px given"
    )
