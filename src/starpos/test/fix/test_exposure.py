# SPDX-License-Identifier: Apache-2.0
"""Exposure times that the stars refute, and long exposures whose stars really trail."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import FixError
from starpos.fix.checks import check_exposure, check_trails
from starpos.instrument.camera import Camera

CAMERA = Camera.from_focal(640, 480, 5208.0)
# at a declination of 60 deg a second is 0.19 px
SKY = np.array([[0.5, 0.0, np.sqrt(0.75)]])


def stars(fwhm_px, exposure_s, longer=None):
    """Stars of a width, whose errors are this many times as large along as across, obliquely; None: not known."""
    more = 0.0 if longer is None else (longer**2 - 1) / 2
    covariance = np.array([[[1 + more, more], [more, 1 + more]]]) * 1e-4
    return SimpleNamespace(fwhm_px=fwhm_px, exposure_s=exposure_s, covariance=covariance, place="frame")


@pytest.mark.parametrize(("fwhm_px", "exposure_s"), [(2.5, 60.0), (2.5, 300.0), (4.0, 500.0), (1.5, 45.0)])
def test_points_after_a_long_exposure_are_refused(fwhm_px, exposure_s):
    with pytest.raises(FixError, match="exposure time is wrong"):
        check_exposure(stars(fwhm_px, exposure_s), CAMERA, SKY)


@pytest.mark.parametrize(
    ("fwhm_px", "exposure_s"),
    # the detector's widths on simulated trails of such lengths, of stars of 2.4 px, are the last four
    [(2.5, 20.0), (None, 300.0), (2.5, None), (2.68, 10.0), (3.84, 30.0), (5.44, 60.0), (9.18, 120.0)],
)
def test_stars_that_trail_or_have_no_width_are_believed(fwhm_px, exposure_s):
    check_exposure(stars(fwhm_px, exposure_s), CAMERA, SKY)


def test_near_the_pole_stars_hardly_trail():
    check_exposure(stars(2.5, 200.0), CAMERA, np.array([[0.02, 0.0, np.sqrt(1 - 0.0004)]]))


# s, px, and their lengths over widths as the detector measures them on simulated trails of stars of 2.4 and 1.6 px
TRAILED = [
    *((10.0, 2.61, 1.10), (20.0, 2.96, 1.40), (20.0, 2.33, 1.72), (40.0, 3.85, 2.12), (40.0, 3.13, 2.58)),
    *((80.0, 5.31, 3.06), (80.0, 4.5, 4.31)),
]


@pytest.mark.parametrize(("exposure_s", "fwhm_px", "longer"), TRAILED)
def test_shapes_tell_trails_from_points(exposure_s, fwhm_px, longer):
    check_exposure(stars(fwhm_px, exposure_s, longer), CAMERA, SKY)
    if longer > 1.2:
        with pytest.raises(FixError, match="exposure time is wrong"):
            check_exposure(stars(fwhm_px, exposure_s, 1.03), CAMERA, SKY)


# the sky's motion in pixels, of which the camera looks at a declination of 60 deg at the meridian, along its rows
AXES = np.array([[0.0, 1.0, 0.0], [np.sqrt(0.75), 0.0, -0.5], [-0.5, 0.0, -np.sqrt(0.75)]])
SEEN = np.array([[0.5, 0.001 * k, np.sqrt(0.75)] for k in range(8)]) * [-1, 1, -1]


def trailed(turned_deg, exposure_s, fwhm_px, longer, scatter_deg=3.0):
    """Eight stars whose images are this many times as long as wide, at this angle to the sky's motion."""
    v = AXES @ np.cross([0.0, 0.0, 1.0], SEEN[0])
    angles = np.arctan2(v[1], v[0]) + np.radians(turned_deg + scatter_deg * np.array([-1, 1] * 4))
    c, s = np.cos(angles), np.sin(angles)
    along = np.stack([c, s], -1)
    covariance = (np.eye(2) + (longer**2 - 1) * along[:, :, None] * along[:, None, :]) * 1e-4
    return SimpleNamespace(fwhm_px=fwhm_px, exposure_s=exposure_s, covariance=covariance, place="frame")


def check(frame):
    check_trails(frame, np.arange(8), CAMERA, AXES, SEEN)


@pytest.mark.parametrize(
    ("exposure_s", "fwhm_px", "longer"),
    # of the exposures above, stated in minutes or in ks
    [(s / unit, width, longer) for s, width, longer in TRAILED if longer > 1.7 for unit in (60, 1000)],
)
def test_trails_of_a_longer_exposure_than_stated_are_refused(exposure_s, fwhm_px, longer):
    with pytest.raises(FixError, match=r"trails .* along the sky's motion.* exposure time is wrong"):
        check(trailed(0.0, exposure_s, fwhm_px, longer))
    with pytest.raises(FixError, match="along the sky's motion"):
        check(trailed(180.0, exposure_s, fwhm_px, longer))


@pytest.mark.parametrize(
    "frame",
    [
        *(trailed(0.0, exposure_s, fwhm_px, longer) for exposure_s, fwhm_px, longer in TRAILED),
        # shaken, or a lens that draws lines: across the sky's motion, or each star its own way
        trailed(40.0, 0.5, 4.5, 4.3),
        trailed(90.0, 0.5, 4.5, 4.3),
        trailed(0.0, 0.5, 4.5, 4.3, 45.0),
        # out of focus, slightly long
        trailed(0.0, 0.5, 3.0, 1.15),
        # a list has no shapes
        trailed(0.0, 0.5, 4.5, 1.0),
    ],
)
def test_long_images_that_are_no_longer_exposure_are_believed(frame):
    check(frame)
