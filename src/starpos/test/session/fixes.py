# SPDX-License-Identifier: Apache-2.0
"""Fixes, tilts and frames as the solver would have them, made by hand."""

import math
from dataclasses import replace

import numpy as np

from starpos import rotation
from starpos.fix.attitude import CAMERA, ITRS, Attitude, heading_of
from starpos.fix.fix import Fix
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.frame import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.session.calibrating import Seen
from starpos.sky.site import Site, camera_to_enu

T0 = 1_793_642_400.0
NOISE = math.radians(0.0035)


def tilt_at(seconds: float, x_deg=1.0, y_deg=-2.0, sigma=NOISE, samples=5) -> Tilt:
    covariance = np.eye(2) * sigma**2 / samples
    return Tilt(
        math.radians(x_deg), math.radians(y_deg), covariance, utc_unix_s=T0 + seconds, samples=samples
    )


def seen_at(seconds: float, stars=3, **tilt) -> Seen:
    """A frame whose stars are nothing of the sky."""
    xy = np.arange(stars, dtype=float)
    covariance = np.tile(np.eye(2) * 0.01, (stars, 1, 1))
    flux = np.arange(stars, 0, -1.0)
    made = Stars(
        x=xy,
        y=xy,
        flux=flux,
        snr=flux,
        covariance=covariance,
        flags=np.zeros(stars),
        width=100,
        height=80,
        mid_unix_s=T0 + seconds,
        exposure_s=0.5,
        source="stars",
    )
    return Seen(made, tilt_at(seconds, **tilt))


def fix_at(seconds: float, azimuth_deg=40.0, latitude_deg=40.0, noise_m=100.0, calibration_m=10.0) -> Fix:
    """Fix of an instrument at longitude 10 deg that stands exactly as it says."""
    site = Site(latitude_deg, 10.0)
    attitude = camera_to_enu(azimuth_deg, 80.0, 0.0)
    link = attitude @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rows = np.array([1.0, 1.0, 1e-6, 1e-7, 1e-7, 1e-6])
    # A slip of the mount turns with the instrument.
    turn = rotation.about_axis(2, -math.radians(azimuth_deg))[:2, :2]
    slip = np.zeros((6, 2))
    slip[:2] = turn * calibration_m
    terms = (ErrorTerm("tilt", np.diag(rows * noise_m)), ErrorTerm("calibration", slip, shared=ALWAYS))
    return Fix(
        utc_unix_s=T0 + seconds,
        tilt=tilt_at(seconds),
        latitude=math.radians(latitude_deg),
        longitude=math.radians(10.0),
        heading=heading_of(link),
        link_to_enu=link,
        terms=terms,
        levelling=np.vstack([np.eye(2) * 6.371e6, np.zeros((4, 2))]),
        used=np.arange(3),
        residual_px=np.zeros((3, 2)),
        residual_arcsec=0.2,
        jitter_px=0.1,
        focal_scale=1.0,
        zenith_distance=0.2,
        refraction_arcsec=12.0,
        diurnal_aberration_arcsec=0.3,
        ut1_minus_utc_s=-0.05,
        camera=Attitude(site.enu.T @ attitude, np.eye(3) * 1e-12, of=CAMERA, into=ITRS),
    )


def north_of(fix: Fix, metres: float) -> Fix:
    """Fix as it is if the inclinometer errs by so much."""
    return replace(fix, latitude=fix.latitude + metres / 6.371e6)
