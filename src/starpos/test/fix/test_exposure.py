# SPDX-License-Identifier: Apache-2.0
"""Exposure times that the stars refute, and long exposures whose stars really trail."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import FixError
from starpos.fix.checks import check_exposure
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
