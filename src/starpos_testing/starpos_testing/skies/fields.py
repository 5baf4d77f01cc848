# SPDX-License-Identifier: Apache-2.0
"""Fields of identified stars, as an instrument at a known place sees them, for the tests of fix and average."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from starpos import rotation
from starpos.earth.orientation import EarthState, earth_state, station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.fix.budget import Circumstances
from starpos.fix.fix import Fix, solve_fix
from starpos.fix.star_fit import MatchedStars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import EXACT, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.sky.site import Site, camera_to_enu

# 2026-11-02T18:00:00
UTC = 1793642400.0
PAPER = Camera.from_focal(5616, 3744, 93750.0)
NO_ERROR = np.zeros((2, 2))
# an instrument refuses a noise of 0
QUIET = replace(EXACT, noise_rad=1e-15)


@dataclass(frozen=True, kw_only=True)
class SkyField:
    """A camera somewhere, with `stars` stars spread over its frame; angles in deg."""

    latitude: float = 35.7
    longitude: float = 51.4
    azimuth: float = 40.0
    altitude: float = 78.0
    roll: float = 15.0
    misalignment: tuple = (0.0, 0.0, 0.0)
    stars: int = 40
    utc: float = UTC
    camera: Camera = PAPER
    air: Atmosphere = field(
        default_factory=lambda: Atmosphere(
            pressure_pa=88000.0,
            temperature_c=12.0,
            humidity=0.3,
            humidity_stddev=0.0,
            wavelength_stddev_um=0.0,
        )
    )

    @property
    def attitude(self) -> np.ndarray:
        return camera_to_enu(self.azimuth, self.altitude, self.roll)

    @property
    def a3(self) -> np.ndarray:
        return self.instrument().calibration.a3

    @property
    def heading(self) -> float:
        """Azimuth in rad of the top of the frame, C's -y."""
        up = -self.attitude[:, 1]
        return rotation.full_turn(np.arctan2(up[0], up[1]))

    def tilt(self, covariance=NO_ERROR) -> Tilt:
        up = self.a3 @ self.attitude[2]
        theta_x, theta_y = np.arcsin(up[:2])
        return Tilt(theta_x, theta_y, covariance, utc_unix_s=self.utc)

    def places(self, state: EarthState, rng) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (N, 2) of N stars without error, and the ICRS directions (N, 3) that a catalogue would have."""
        xy = rng.uniform(0, [self.camera.width - 1, self.camera.height - 1], (self.stars, 2))
        site = Site(self.latitude, self.longitude, self.air)
        wanted = self.camera.directions(*xy.T) @ self.attitude.T
        itrs = self.air.refraction().unbend(wanted) @ site.enu
        # directions near these will do, because the forward chain takes them to the frame
        icrs = (itrs @ state.cirs_to_itrs) @ np.asarray(state.astrom["bpn"]).reshape(3, 3)
        v = state.to_itrs(icrs) + station_velocity(site.enu[2])
        seen = self.air.refraction().bend(v / np.linalg.norm(v, axis=1, keepdims=True) @ site.enu.T)
        return self.camera.project(seen @ self.attitude), icrs

    def instrument(self, calibration=0.0, remounting=0.0) -> Instrument:
        """The instrument, with errors of its calibration and of a remounting in arcsec per axis, 1 sigma."""
        known = replace(Calibration.of(self.misalignment, (calibration,) * 3), remounted_arcsec=remounting)
        return Instrument(self.camera.fx, calibration=known, inclinometer=QUIET)

    def solve(self, xy, places, state=None, **given) -> Fix:
        """Call solve_fix with the truth of this field; `given` replaces parts of it."""
        n = len(xy)
        covariance = given.pop("covariance_px2", np.eye(2)[None].repeat(n, 0) * 0.05**2)
        stars = MatchedStars(xy, covariance, places, given.pop("place_sigma", np.full(n, 1e-9)))
        tilt = given.pop("tilt", None) or self.tilt()
        about = Circumstances(
            camera=self.camera,
            instrument=self.instrument(),
            atmosphere=self.air,
            earth=state or earth_state(self.utc),
            clock_stddev_s=0.0,
        )
        return solve_fix(stars, tilt, replace(about, **given))


def random_field(rng, **fixed) -> SkyField:
    """A field at any place and heading, up to 25 deg from the zenith, with an A3 of up to 3 deg."""
    drawn: dict[str, Any] = {
        "latitude": float(np.degrees(np.arcsin(rng.uniform(-1, 1)))),
        "longitude": float(rng.uniform(-180, 180)),
        "azimuth": float(rng.uniform(0, 360)),
        "altitude": float(rng.uniform(65, 90)),
        "roll": float(rng.uniform(-180, 180)),
        "misalignment": tuple(rng.uniform(-3, 3, 3).tolist()),
    }
    return replace(SkyField(), **drawn | fixed)
