# SPDX-License-Identifier: Apache-2.0
"""Pointings of a simulated plate solver, and the tilts of their frames, for a night whose truth is known."""

from dataclasses import dataclass, replace

import erfa
import numpy as np

from starpos import rotation
from starpos.earth.orientation import EarthState, earth_state, station_velocity
from starpos.frames.tables import Pointing
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.sensors import SCA100T_CALIBRATED
from starpos.instrument.tilt_log import TiltsByTime
from starpos.sky.site import Site, camera_to_enu
from starpos.units import ARCSEC
from starpos_testing.skies.scenes import AIR

TRUE_A3 = Calibration(misalignment_deg=(1.5, -2.0, 130.0)).a3
READINGS = 5
# directions around the axis whose rotation is the roll
RING_RAD = ((1e-3, 0.0), (0.0, 1e-3), (-1e-3, 0.0), (0.0, -1e-3))
# a tilt sensor such as the paper's
SENSOR = SCA100T_CALIBRATED


def icrs_of(site: Site, seen: np.ndarray, state: EarthState) -> np.ndarray:
    """ICRS direction (3,) of a star seen in the direction `seen` (3,) in east, north, up; reverses Site.refracted."""
    v = site.atmosphere.refraction().unbend(seen[None])[0] @ site.enu
    apparent = rotation.normalised(v - station_velocity(site.enu[2])) @ state.gcrs_to_itrs
    found = apparent
    for _ in range(6):
        again = state.to_itrs(found[None])[0] @ state.gcrs_to_itrs
        found = rotation.normalised(found + apparent - again)
    return found


def pointing_of(
    site: Site,
    attitude: np.ndarray,
    utc_unix_s: float,
    rng: np.random.Generator,
    sigma: float,
    sigma_roll: float,
) -> Pointing:
    """The pointing, with its stated errors in rad, of a camera with an attitude (3, 3), C into east, north, up."""
    state = earth_state(utc_unix_s)
    # refraction shears the field, so the roll comes from a whole ring, as with a solver that fits all stars
    ring = np.array([[0, 0, 1.0]] + [[x, y, 1.0] for x, y in RING_RAD])
    ring /= np.linalg.norm(ring, axis=1)[:, None]
    sky = np.array([icrs_of(site, attitude @ v, state) for v in ring])
    to_icrs = rotation.best_rotation(ring[1:], sky[1:])
    to_icrs = rotation.shortest_turn(to_icrs[:, 2], sky[0]) @ to_icrs
    to_icrs = to_icrs @ rotation.from_vector(rng.normal(0, 1, 3) * [sigma, sigma, sigma_roll])
    ra, dec = (float(x) for x in erfa.c2s(to_icrs[:, 2]))
    east, north = np.array([-np.sin(ra), np.cos(ra), 0.0]), rotation.unit_vector(ra, dec + np.pi / 2)
    top = -to_icrs[:, 1]
    return Pointing(
        mid_unix_s=utc_unix_s,
        ra=ra,
        dec=dec,
        roll=float(np.arctan2(top @ east, top @ north)),
        sigma=sigma,
        sigma_roll=sigma_roll,
    )


@dataclass(frozen=True)
class PointedNight:
    """Pointings and tilts (K) of a night, the place and the last heading (rad), and the instrument as stated."""

    site: Site
    heading: float
    instrument: Instrument
    pointings: list[Pointing]
    tilts: list[Tilt]

    @property
    def tilt(self) -> TiltsByTime:
        """The tilts as a solver takes them."""
        return TiltsByTime({t.utc_unix_s: t for t in self.tilts})

    def place_nees(self, answer) -> float:
        """Squared error of a fix or an average in units of its covariance, of the place alone."""
        off = self.off_m(answer)
        return float(off @ np.linalg.solve(answer.covariance[:2, :2], off))

    def off_m(self, answer) -> np.ndarray:
        """Error east, north (2,) in m."""
        east = rotation.half_turn(answer.longitude - np.radians(self.site.longitude_deg))
        north = answer.latitude - np.radians(self.site.latitude_deg)
        return np.array([east * np.cos(answer.latitude), north]) * 6.37e6


def pointed_night(
    rng: np.random.Generator,
    azimuths_deg=(0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0),
    frames: int = 2,
    sigma_arcsec: float = 5.0,
    sigma_roll_arcsec: float = 60.0,
    a3_sigma_arcsec: float = 5.0,
    noise: float = 1.0,
    errors: InclinometerErrors = SENSOR,
    spread_deg: float = 0.3,
) -> PointedNight:
    """A night at a random place, with errors as large as stated; noise: of the readings, in units of the stated.

    spread_deg: standard deviation of the altitudes.
    """
    site = Site(rng.uniform(-65, 65), rng.uniform(-180, 180), AIR)
    begin, altitude = 1.79e9 + rng.uniform(0, 2e7), rng.uniform(68, 80)
    told = Calibration.of((0.0, 0.0, 0.0), (a3_sigma_arcsec,) * 3)
    told = told.turned_to(rotation.from_vector(rng.normal(0, a3_sigma_arcsec * ARCSEC, 3)) @ TRUE_A3)
    pointings: list[Pointing] = []
    tilts: list[Tilt] = []
    for d, azimuth in enumerate(azimuths_deg):
        attitude = camera_to_enu(azimuth + rng.uniform(-5, 5), altitude + rng.normal(0, spread_deg), 15.0)
        theta = np.arcsin((TRUE_A3 @ attitude[2])[:2])
        for k in range(frames):
            now = begin + 60.0 * d + 10.0 * k
            p = pointing_of(site, attitude, now, rng, sigma_arcsec * ARCSEC, sigma_roll_arcsec * ARCSEC)
            pointings.append(replace(p, source=f"frame {len(pointings)}"))
            read = theta + rng.normal(0, errors.noise_rad * noise, (READINGS, 2)).mean(0)
            x, y = read.tolist()
            tilts.append(
                Tilt(
                    x,
                    y,
                    np.eye(2) * errors.noise_rad**2 / READINGS,
                    utc_unix_s=now,
                    samples=READINGS,
                    times=tuple(now + 0.1 * n for n in range(READINGS)),
                )
            )
    forward = -attitude[:, 1]
    heading = rotation.full_turn(np.arctan2(forward[0], forward[1]))
    instrument = Instrument(1e4, calibration=told, inclinometer=errors)
    return PointedNight(site, heading, instrument, pointings, tilts)


def without_roll(pointing: Pointing) -> Pointing:
    return replace(pointing, roll=float("nan"), sigma_roll=float("nan"))
