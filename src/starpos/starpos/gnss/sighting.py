# SPDX-License-Identifier: Apache-2.0
"""A frame as the filter takes it: its place by the learned states, and its equations with a GNSS place."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, place_of_zenith
from starpos.earth.vertical import Vertical
from starpos.fix.budget import Origin, total_covariance
from starpos.fix.fix import Fix
from starpos.gnss.place import GnssPlace
from starpos.gnss.states import Learned
from starpos.instrument.inclinometer import Tilt

# Origin of the terms of a fix that the states replace.
LEARNED_ORIGINS = (Origin.A3, Origin.INCLINOMETER)


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelSight:
    """Attitude of the camera by the stars, camera_to_itrs (3, 3), and the tilt of a frame.

    camera_covariance (3, 3): as in a Fix.
    zenith_covariance (3, 3): of a zenith in ITRS by the errors of the stars, the air and the time, rad2.
    latitude, longitude (rad): of the fix, whose A3 may be wrong.
    """

    utc_unix_s: float
    camera_to_itrs: np.ndarray
    camera_covariance: np.ndarray
    tilt: Tilt
    zenith_covariance: np.ndarray
    latitude: float
    longitude: float

    @classmethod
    def of(cls, fix: Fix, tilt: Tilt) -> "LevelSight":
        """The sighting of a fix."""
        stars = [t for t in fix.terms if t.origin is Origin.OTHER]
        radii = np.array(curvature_radii_m(fix.latitude))
        axes = enu_axes(fix.latitude, fix.longitude)[:2]
        covariance = total_covariance(stars)[:2, :2] / np.outer(radii, radii)
        return cls(
            utc_unix_s=fix.utc_unix_s,
            camera_to_itrs=fix.camera_to_itrs,
            camera_covariance=fix.camera_covariance,
            tilt=tilt,
            zenith_covariance=axes.T @ covariance @ axes,
            latitude=fix.latitude,
            longitude=fix.longitude,
        )


def zenith_of_stars(sighting: LevelSight, learned: Learned) -> np.ndarray:
    """Up (3,) in ITRS by the plumb line, as camera and inclinometer have it with what was learned."""
    up_in_camera = learned.rotation.T @ learned.up(sighting.tilt)
    return sighting.camera_to_itrs @ up_in_camera


def zenith_rows(sighting: LevelSight, learned: Learned, up: np.ndarray) -> np.ndarray:
    """Derivatives (3, n) of `zenith_of_stars` by the states; up (3,): in S."""
    rows = learned.tilted(sighting.tilt)
    rows[:, learned.layout.a3] = rotation.cross_matrix(up)
    return sighting.camera_to_itrs @ learned.rotation.T @ rows


@dataclass(frozen=True, eq=False)
class Innovation:
    """What a frame with a GNSS place says of the states: value (2,) = rows (2, n) @ (true - state) + noise (2, 2).

    offset (2, 2): change of `value` for an error of the GNSS place, east and north as angles at the Earth's centre.
    """

    value: np.ndarray
    rows: np.ndarray
    noise: np.ndarray
    offset: np.ndarray


def innovation(
    sighting: LevelSight,
    gnss: GnssPlace,
    learned: Learned,
    vertical: Vertical,
    up_in_camera: np.ndarray | None = None,
) -> Innovation:
    """Compare the plumb line that GNSS and the deflection expect with the one by the stars and the tilt.

    up_in_camera (3,): about which the comparison is linear; None: as GNSS has it at this frame.
    """
    at, axes = learned.layout, gnss.axes
    east_north = learned.state[at.gnss]
    deflection = learned.deflection_rad(vertical, gnss.latitude, gnss.longitude)
    expected = rotation.normalised(axes[2] + (deflection - east_north) @ axes[:2])
    # along two directions at the place
    seen = axes[:2] @ (zenith_of_stars(sighting, learned) - expected)
    # the stars' plumb line has no noise of the tilts, by which an unknown turn of A3 would seem to be determined
    up = learned.rotation @ (sighting.camera_to_itrs.T @ expected if up_in_camera is None else up_in_camera)
    rows = -axes[:2] @ zenith_rows(sighting, learned, up)
    rows[:, at.constant] += np.eye(2)
    rows[:, at.field] += np.eye(2)
    rows[:, at.gnss] -= np.eye(2)
    radii = np.array(curvature_radii_m(gnss.latitude))
    noise = axes[:2] @ (sighting.zenith_covariance + tilt_noise(sighting, learned)) @ axes[:2].T
    return Innovation(seen, rows, noise + gnss.covariance / np.outer(radii, radii), -np.eye(2))


def tilt_noise(sighting: LevelSight, learned: Learned) -> np.ndarray:
    """Covariance (3, 3) of the zenith in ITRS by the noise of the readings."""
    back = sighting.camera_to_itrs @ learned.rotation.T @ sighting.tilt.slope
    return back @ sighting.tilt.noise @ back.T


def place_of_stars(
    sighting: LevelSight, learned: Learned, vertical: Vertical
) -> tuple[float, float, np.ndarray]:
    """Geodetic latitude, longitude (rad) by the stars alone, and its covariance (2, 2) of east, north, m2."""
    zenith = zenith_of_stars(sighting, learned)
    latitude, longitude = place_of_zenith(zenith)
    axes = enu_axes(latitude, longitude)
    east_north = learned.deflection_rad(vertical, latitude, longitude)
    rows = axes[:2] @ zenith_rows(sighting, learned, learned.up(sighting.tilt))
    at = learned.layout
    rows[:, at.constant] -= np.eye(2)
    rows[:, at.field] -= np.eye(2)
    noise = axes[:2] @ (sighting.zenith_covariance + tilt_noise(sighting, learned)) @ axes[:2].T
    covariance = rows @ learned.covariance @ rows.T + noise
    radii = np.array(curvature_radii_m(latitude))
    latitude, longitude = place_of_zenith(rotation.normalised(axes[2] - east_north @ axes[:2]))
    return latitude, longitude, covariance * np.outer(radii, radii)
