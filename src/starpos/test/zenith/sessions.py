# SPDX-License-Identifier: Apache-2.0
"""Sessions of a zenith camera whose deflection, A3, tilts and air are drawn: sightings, without frames."""

from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.orientation import EarthOrientation
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.fix.attitude import CAMERA, ITRS, Attitude
from starpos.instrument.inclinometer import EXACT, Tilt
from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC
from starpos.zenith.adjustment import adjusted
from starpos.zenith.sighting import ZenithSighting

NOISE_ARCSEC, DRIFT_ARCSEC, SCALE = 0.05, 0.05, 1e-3
TILTMETER = replace(
    EXACT, noise_rad=NOISE_ARCSEC * ARCSEC, drift_rad_per_sqrt_hour=DRIFT_ARCSEC * ARCSEC, scale=SCALE
)
INSTRUMENT = Instrument(93750.0, inclinometer=TILTMETER, clock_stddev_s=0.001)
VACUUM = Atmosphere(pressure_pa=0.0)
MARK = Place.on_ellipsoid(47.0, 8.0, height_m=500.0)
BEGIN = 1.75e9
ORIENTATION = EarthOrientation(
    ut1_minus_utc_s=0.0, ut1_sigma_s=1e-5, pole_x=0.0, pole_y=0.0, pole_sigma=1e-10
)


@dataclass(frozen=True)
class Drawn:
    """A session, and its true xi and eta in arcsec."""

    sightings: list
    xi: float
    eta: float

    def adjusted(self):
        return adjusted(self.sightings, INSTRUMENT, VACUUM, MARK)


@dataclass(frozen=True)
class Worse:
    """Factors of a tiltmeter's errors over the stated ones; jump_arcsec: of its zero, before the fourth face."""

    noise: float = 1.0
    drift: float = 1.0
    scale: float = 1.0
    jump_arcsec: float = 0.0


AS_STATED = Worse()


def drawn(
    rng,
    *,
    azimuths=(0, 90, 180, 270) * 2,
    frames=6,
    motion=0.4,
    air=0.05,
    turn_deg=4.0,
    lean=10.0,
    worse=AS_STATED,
):
    """A session of frames 5 s apart in faces at these azimuths (deg), a minute from face to face; sizes in arcsec."""
    eta, xi = rng.normal(0, 10, 2)
    astronomic = MARK.latitude + xi * ARCSEC, MARK.longitude + eta * ARCSEC / np.cos(MARK.latitude)
    up = MARK.axes @ enu_axes(*astronomic)[2]
    a3 = rotation.about_axis(2, np.radians(turn_deg)) @ rotation.from_vector([*rng.normal(0, 0.002, 2), 0.0])
    zero, scale = rng.normal(0, 60, 2) * ARCSEC, rng.normal(0, SCALE * worse.scale, 2)
    quiet = motion == 0 and air == 0
    walk, slow = np.zeros(2), rng.normal(0, 1, 2) * air
    sightings, t = [], 0.0
    for face, azimuth in enumerate(azimuths):
        zero = zero + worse.jump_arcsec * ARCSEC * (face == 3)
        level = rotation.from_vector([*rng.normal(0, lean, 2) * ARCSEC, 0.0])
        sensor = level @ rotation.about_axis(2, np.radians(azimuth + rng.normal()))
        for _ in range(frames):
            passed, t = 5.0, t + 5.0
            keep = np.exp(-passed / 1200)
            slow = slow * keep + rng.normal(0, 1, 2) * air * np.sqrt(1 - keep**2)
            walk = walk + rng.normal(0, DRIFT_ARCSEC * worse.drift, 2) * np.sqrt(passed / 3600) * (not quiet)
            seen = (slow + rng.normal(0, 1, 2) * motion) * ARCSEC
            attitude = a3.T @ sensor @ rotation.from_vector([-seen[1], seen[0], 0.0])
            theta = np.arcsin(sensor[:2] @ up) * (1 + scale * (not quiet)) + zero
            theta = theta + (walk + rng.normal(0, NOISE_ARCSEC * worse.noise, 2) * (not quiet)) * ARCSEC
            sightings.append(_sighting(len(sightings), BEGIN + t, attitude, theta))
        t += 60.0
    return Drawn(sightings, xi, eta)


def _sighting(number, utc_unix_s, attitude, theta):
    tilt = Tilt(*theta, np.eye(2) * TILTMETER.noise_rad**2, utc_unix_s=utc_unix_s, times=(utc_unix_s,))
    return ZenithSighting(
        source=f"{number}.csv",
        utc_unix_s=utc_unix_s,
        camera=Attitude.by_own(
            MARK.axes.T @ attitude.T, np.diag([0.01, 0.01, 1.0]) ** 2 * ARCSEC**2, of=CAMERA, into=ITRS
        ),
        axes=MARK.axes,
        stars=np.array([7]),
        by_star=np.zeros((3, 1, 3)),
        star_weight=np.zeros((1, 3, 3)),
        star_common=np.zeros((4, 1, 3)),
        star_pull=np.zeros((1, 3)),
        by_refraction=np.zeros(3),
        by_rows=np.zeros((3, 2)),
        residual_arcsec=np.zeros((1, 2)),
        tilt=tilt,
        orientation=ORIENTATION,
        clock_stddev_s=1e-3,
        stamp_stddev_s=0.0,
    )


def shifted(sighting, east_arcsec, north_arcsec):
    """The sighting of a frame whose stars stand that far aside."""
    turn = rotation.from_vector([-north_arcsec * ARCSEC, east_arcsec * ARCSEC, 0.0])
    return sighting.turned(sighting.enu_to_camera @ turn @ sighting.enu_to_camera.T)
