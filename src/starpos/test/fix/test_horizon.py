# SPDX-License-Identifier: Apache-2.0
"""Tilts by which the camera looks through the ground make no fix."""

from dataclasses import replace

import numpy as np
import pytest
from solved_night import refused

from starpos.fix.solution import Status
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Calibration


def upside_down(tilt):
    """A tilt as a sensor with three axes has it whose Z' points downwards."""
    third = -np.arcsin(np.sqrt(1 - np.sin(tilt.theta) @ np.sin(tilt.theta)))
    return Tilt(tilt.theta_x, tilt.theta_y, tilt.covariance, utc_unix_s=tilt.utc_unix_s, theta_z=third)


@pytest.mark.parametrize(("sigma_arcsec", "sees"), [((5.0,) * 3, False), (None, True)])
def test_a_camera_does_not_see_through_the_ground(night, sigma_arcsec, sees):
    """It is unknown while A3 is not known, as before it is found by turning."""
    scene, stars, tilt, solver = night
    angles = scene.instrument.calibration.misalignment_deg
    calibration = Calibration.of(angles, sigma_arcsec) if sigma_arcsec else Calibration.of(angles)
    told = replace(solver, instrument=replace(solver.instrument, calibration=calibration))
    assert told.solve(stars, tilt).ok
    answer = told.solve(stars, upside_down(tilt))
    if sees:
        assert answer.ok
    else:
        message = refused(answer, Status.POOR_FIT)
        assert "deg below the horizon" in message
        assert "signs" in message
