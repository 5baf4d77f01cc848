# SPDX-License-Identifier: Apache-2.0
"""Drives of a robot with GNSS: readings of camera, inclinometer and receiver, drawn from stated laws; no stars are drawn.

The laws are written down here anew, so that they hold starpos.gnss to account.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes
from starpos.earth.place import Place
from starpos.fix.attitude import CAMERA, ITRS, Attitude
from starpos.fix.fix import Fix
from starpos.fix.terms import ErrorTerm
from starpos.gnss.receiver import gnss_place
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.rotation import about_axis, from_vector
from starpos.units import ARCSEC

# 1 sigma of each axis of the stars' attitude
STARS_RAD = 0.05 * ARCSEC
READINGS = 5
WHITE_M, SLOW_M, SLOW_S = 2.0, 1.5, 300.0
STATED_M = float(np.hypot(WHITE_M, SLOW_M))


@dataclass(frozen=True, eq=False)
class DriveFrame:
    """A frame of a drive: the sighting, GNSS's place, and the true one (latitude, longitude in rad)."""

    sighting: Fix
    gnss: Place
    place: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class GnssDrive:
    """A robot that stands every `every_s`, newly turned and leaning, for `frames` frames, and drives on.

    deflection_arcsec: 1 sigma a component of the deflection, half of its variance the same all along, half forgotten over
    field_m.  unmeasured: whether the tilt of a frame, by its number from 0, has no temperature.
    """

    stops: int = 40
    frames: int = 3
    every_s: float = 120.0
    cadence_s: float = 6.0
    step_m: float = 250.0
    lean_deg: float = 4.0
    cooling_c_per_hour: float = 4.0
    errors: InclinometerErrors = field(default_factory=InclinometerErrors)
    deflection_arcsec: float = 6.0
    field_m: float = 37_000.0
    unmeasured: Callable[[int], bool] = lambda k: False

    @property
    def instrument(self) -> Instrument:
        """The instrument as its file states it: of A3 nothing."""
        return Instrument(93750.0, inclinometer=self.errors, calibration=Calibration(), clock_stddev_s=0.001)

    def moments(self, rng: np.random.Generator, astray=lambda t: np.zeros(2)) -> Iterator[DriveFrame]:
        """The frames of a drive; astray: error of GNSS, east and north in m, by the time in s."""
        errors = self.errors
        latitude, longitude = np.radians([rng.uniform(-65, 65), rng.uniform(-180, 180)])
        a3 = about_axis(2, rng.uniform(0, 2 * np.pi)) @ from_vector([*np.radians(rng.normal(0, 1.0, 2)), 0.0])
        scale, warmth = rng.normal(0, errors.scale, 2), rng.normal(0, errors.temperature_rad_per_c, 2)
        half = self.deflection_arcsec * ARCSEC / np.sqrt(2)
        constant, local = rng.normal(0, half, 2), rng.normal(0, half, 2)
        walk, slow, course, then_s = np.zeros(2), rng.normal(0, SLOW_M, 2), rng.uniform(0, 2 * np.pi), 0.0
        radii = np.array(curvature_radii_m(latitude))
        for stop in range(self.stops):
            if stop:
                course += rng.normal(0, 0.35)
                way = self.step_m * np.array([np.sin(course), np.cos(course)])
                longitude, latitude = np.array([longitude, latitude]) + way / radii / [np.cos(latitude), 1.0]
                kept = np.exp(-self.step_m / self.field_m)
                local = local * kept + rng.normal(0, half, 2) * np.sqrt(1 - kept**2)
            axes = enu_axes(latitude, longitude)
            east_north = constant + local
            plumb = axes[2] + east_north @ axes[:2]
            lean = rng.normal(0, np.radians(self.lean_deg), 2)
            camera_to_itrs = axes.T @ from_vector([*lean, 0.0]) @ about_axis(2, rng.uniform(0, 2 * np.pi))
            pose = rng.normal(0, errors.pose_rad, 2) if errors.pose_rad else np.zeros(2)
            for k in range(self.frames):
                t = stop * self.every_s + k * self.cadence_s
                celsius = 20 - self.cooling_c_per_hour * t / 3600
                walk = walk + rng.normal(0, errors.drift_rad_per_sqrt_hour, 2) * np.sqrt((t - then_s) / 3600)
                kept = np.exp(-(t - then_s) / SLOW_S)
                slow, then_s = slow * kept + rng.normal(0, SLOW_M, 2) * np.sqrt(1 - kept**2), t
                up = a3 @ camera_to_itrs.T @ plumb
                theta = (
                    np.arcsin(up[:2] / np.linalg.norm(up)) * (1 + scale)
                    + walk
                    + pose
                    + warmth * (celsius - 15)
                )
                noise = errors.noise_rad / np.sqrt(READINGS)
                theta = theta + rng.normal(0, noise, 2)
                seen = camera_to_itrs @ from_vector(rng.normal(0, STARS_RAD, 3))
                error_m = slow + rng.normal(0, WHITE_M, 2) + astray(t)
                off = error_m / radii / [np.cos(latitude), 1.0]
                tilt = Tilt(
                    theta[0],
                    theta[1],
                    np.eye(2) * noise**2,
                    utc_unix_s=1.7e9 + t,
                    samples=READINGS,
                    temperature_c=np.nan if self.unmeasured(stop * self.frames + k) else celsius,
                )
                yield DriveFrame(
                    _fix(seen, tilt, latitude, longitude),
                    gnss_place(1.7e9 + t, latitude + off[1], longitude + off[0], np.eye(2) * STATED_M**2),
                    (latitude, longitude),
                )


def _fix(camera_to_itrs: np.ndarray, tilt: Tilt, latitude: float, longitude: float) -> Fix:
    """A fix of which only attitude, tilt, rough place and the stars' errors count."""
    radii = np.diag(curvature_radii_m(latitude)) * STARS_RAD
    return Fix(
        utc_unix_s=tilt.utc_unix_s,
        camera=Attitude(camera_to_itrs, np.eye(3) * STARS_RAD**2, of=CAMERA, into=ITRS),
        tilt=tilt,
        latitude=latitude,
        longitude=longitude,
        heading=0.0,
        terms=(ErrorTerm("centroids", np.vstack([radii, np.zeros((4, 2))])),),
        link_to_enu=np.eye(3),
        levelling=np.zeros((6, 2)),
        used=np.zeros(0, int),
        residual_px=np.zeros((0, 2)),
        residual_arcsec=0.0,
        jitter_px=0.0,
        focal_scale=1.0,
        zenith_distance=0.0,
        refraction_arcsec=0.0,
        diurnal_aberration_arcsec=0.0,
        ut1_minus_utc_s=0.0,
    )
