# SPDX-License-Identifier: Apache-2.0
"""A third axis that contradicts the other two is in the claim of a fix."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration


def with_third(tilt, off_deg):
    """A tilt as a sensor with three axes has it, whose third is off."""
    sines = np.sin(tilt.theta)
    third = np.arcsin(np.sqrt(1 - sines @ sines)) + np.radians(off_deg)
    return Tilt(tilt.theta_x, tilt.theta_y, tilt.covariance, utc_unix_s=tilt.utc_unix_s, theta_z=third)


def off_sigma(scene, fix):
    """Error of the place over its claim."""
    phi = np.radians(scene.site.latitude_deg)
    prime, meridian = curvature_radii_m(phi)
    east = (fix.longitude - np.radians(scene.site.longitude_deg)) * prime * np.cos(phi)
    moved = np.array([east, (fix.latitude - phi) * meridian])
    return np.sqrt(moved @ np.linalg.solve(fix.covariance[:2, :2], moved))


def told(night, **more):
    """The solver of a night whose A3 is known to an arcsecond."""
    scene, _, _, solver = night
    calibration = replace(Calibration.of(scene.instrument.calibration.misalignment_deg, (1.0,) * 3), **more)
    instrument = replace(solver.instrument, calibration=calibration, inclinometer=InclinometerErrors())
    return replace(solver, instrument=instrument)


@pytest.mark.parametrize("off_deg", [-0.8, 0.3, 1.0])
def test_a_third_axis_that_contradicts_the_others_widens_the_claim(night, off_deg):
    scene, stars, tilt, _ = night
    assert off_sigma(scene, told(night).solve(stars, with_third(tilt, off_deg)).fix) < 3


def test_axes_that_agree_or_stand_as_at_the_calibration_widen_nothing(night):
    """There A3 holds the sensor's zeros."""
    _, stars, tilt, _ = night
    agree, off = with_third(tilt, 0.0), with_third(tilt, 1.0)

    def response_m(solver, read):
        terms = solver.solve(stars, read).fix.terms
        return np.sqrt(np.trace(next(t for t in terms if t.name == "tilt response").covariance[:2, :2]))

    lean = tuple(np.degrees(off.theta).tolist())
    assert response_m(told(night), agree) < 200
    assert response_m(told(night), off) > 2000
    assert response_m(told(night, tilt_deg=lean, utc_unix_s=tilt.utc_unix_s), off) < 1
