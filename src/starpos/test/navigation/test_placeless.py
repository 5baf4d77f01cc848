# SPDX-License-Identifier: Apache-2.0
"""An attitude without a known place, under a zenith: as from the stars there."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starpos import rotation
from starpos.earth.orientation import earth_state, station_velocity
from starpos.earth.refraction import Atmosphere
from starpos.fix.attitude import CameraAttitude
from starpos.instrument.camera import Camera
from starpos.navigation.sightings import PlacelessFrame, placeless
from starpos.units import ARCSEC

AIR = Atmosphere()
FOCAL_PX, HALF_PX, STARS = 4266.0, (968.0, 608.0), 25
BEGIN_S = 1.7937e9


def stars_at(zenith_distance_deg, seed):
    """Stars of a 25 mm lens that looks so far from the zenith: pixels in the air, directions (N, 3), camera, zenith."""
    rng = np.random.default_rng(seed)
    camera = Rotation.random(random_state=seed).as_matrix()
    zenith = camera @ Rotation.from_euler("x", zenith_distance_deg, degrees=True).as_matrix()[:, 2]
    itrs = rotation.normalised(
        np.column_stack([rng.uniform(-1, 1, (STARS, 2)) * HALF_PX, np.full(STARS, FOCAL_PX)])
    )
    itrs = itrs @ camera.T
    seen = bent(itrs, zenith) @ camera
    return seen[:, :2] / seen[:, 2:] * FOCAL_PX, itrs, camera, zenith


def bent(itrs, zenith, factor=1.0):
    """The directions (N, 3) in which stars are seen under a zenith, through air that is so much stronger."""
    level = rotation.shortest_turn(zenith, np.array([0.0, 0.0, 1.0]))
    apparent = rotation.normalised(itrs + station_velocity(zenith))
    return AIR.refraction(factor).bend(apparent @ level.T) @ level


def fitted(xy, itrs):
    return placeless(
        xy,
        np.tile(np.eye(2) * 0.1**2, (STARS, 1, 1)),
        Camera(width=1, height=1, fx=FOCAL_PX, fy=FOCAL_PX, cx=0.0, cy=0.0),
        itrs,
    )


def told(seen):
    """The frame as given by an attitude."""
    return PlacelessFrame.of(
        CameraAttitude(
            utc_unix_s=BEGIN_S,
            stamp_stddev_s=0.0,
            clock_stddev_s=0.0,
            frame_id="camera",
            camera_to_gcrs=earth_state(BEGIN_S).gcrs_to_itrs.T @ seen.rotation,
            covariance=seen.covariance_about_own,
            stars=STARS,
            log_odds=50.0,
        )
    )


def apart(a, b):
    return Rotation.from_matrix(a.T @ b).as_rotvec()


@pytest.mark.parametrize(("zenith_distance_deg", "limit_arcsec"), [(0, 0.1), (15, 0.1), (30, 0.3), (45, 1.0)])
def test_it_is_the_attitude_by_the_stars_within_its_claim(zenith_distance_deg, limit_arcsec):
    """The mean counts, of where the camera looks: that moves the place."""
    turns = []
    for seed in range(6):
        xy, itrs, camera, zenith = stars_at(zenith_distance_deg, seed)
        seen = fitted(xy, itrs)
        by_attitude, _ = told(seen).under(zenith, AIR)
        off = apart(camera, by_attitude.rotation)
        turns.append(off)
        assert off @ np.linalg.solve(by_attitude.covariance_about_own, off) < 16
        # without it the camera would be off by all of the refraction
        if zenith_distance_deg:
            assert np.linalg.norm(apart(camera, seen.rotation)) > 10 * ARCSEC
    assert np.linalg.norm(np.mean(turns, 0)[:2]) < limit_arcsec * ARCSEC


def test_stronger_air_turns_it_as_it_turns_the_stars():
    xy, itrs, camera, zenith = stars_at(30.0, 1)
    stronger = fitted(xy, bent(itrs, zenith, 1.01)).rotation
    by_stars = apart(camera, stronger) / 0.01
    found, bent_by = told(fitted(xy, itrs)).under(zenith, AIR)
    by_attitude = found.rotation.T @ bent_by
    # about the camera's own axes: about the optical axis a frame without stars knows less
    assert np.linalg.norm(by_stars) > 25 * ARCSEC
    assert np.linalg.norm((by_stars - by_attitude)[:2]) < 1 * ARCSEC
