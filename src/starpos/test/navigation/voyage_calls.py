# SPDX-License-Identifier: Apache-2.0
"""Voyages that are made and navigated, and how far the answers are from the truth."""

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.navigation.vessel import Vessel
from starpos.navigation.voyage import adjust_voyage
from starpos_testing.voyages import CAMERA_TO_BODY, INDUSTRIAL

EARTH_M = 6.37e6


def vessel(vehicle="rover", model=INDUSTRIAL, mount_deg=1.0, **more):
    return Vessel(
        vehicle=vehicle,
        model=model,
        camera_to_body=CAMERA_TO_BODY,
        mount_stddev=np.radians(mount_deg),
        atmosphere=Atmosphere(pressure_pa=0.0),
        clock_stddev_s=1e-4,
        **more,
    )


def errors(voyage, made):
    """East m, north m, heading rad (F, 3) of each fix less the truth."""
    off = [
        (
            wrapped(fix.longitude - lam) * EARTH_M * np.cos(phi),
            (fix.latitude - phi) * EARTH_M,
            wrapped(fix.heading - heading),
        )
        for fix, phi, lam, heading in zip(
            voyage.fixes, made.latitude, made.longitude, made.heading, strict=True
        )
    ]
    return np.array(off)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def nees(voyage, made):
    """Squared error of place and heading at the last frame in units of the claim; 3 on average."""
    off = errors(voyage, made)[-1]
    return float(off @ np.linalg.solve(voyage.fixes[-1].covariance, off))


def sigma_m(voyage):
    """The claim of the last frame's place, m, one axis."""
    return float(np.sqrt(np.trace(voyage.fixes[-1].covariance[:2, :2]) / 2))


def navigated(made, vehicle="rover", velocity=True, **about):
    return adjust_voyage(made.frames, made.imu, made.velocity if velocity else None, vessel(vehicle, **about))
