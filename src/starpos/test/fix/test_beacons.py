# SPDX-License-Identifier: Apache-2.0
"""A kind of sighting that starpos has not, made by the guide of docs/architecture.md: beacons in known directions."""

import numpy as np

from starpos import rotation
from starpos.averaging.poses import slip_s
from starpos.earth.geoid import Deflection
from starpos.earth.place import Place
from starpos.fix.attitude import CAMERA, ITRS, Attitude
from starpos.fix.sighting import Sighting
from starpos.fix.star_fit import fit_seen
from starpos.instrument.camera import Camera
from starpos.sky.site import camera_to_enu

CAMERA_PX = Camera(width=1000, height=700, fx=2000.0, fy=2000.0, cx=499.5, cy=349.5)
PLACE = Place.on_ellipsoid(47.0, 8.0, Deflection(0, 0, 1))
SIGMA_PX = 0.3


def beacons_seen(xy, directions, utc_unix_s) -> Sighting:
    """The sighting of beacons at xy (N, 2) px in directions (N, 3): east, north, up by the plumb line."""
    stated = np.tile(SIGMA_PX**2 * np.eye(2), (len(xy), 1, 1))
    seen = fit_seen(xy, stated, CAMERA_PX, directions @ PLACE.plumb_axes)
    to_camera, errors = seen.fit.a4, seen.own
    camera = Attitude(to_camera.T, to_camera.T @ errors @ to_camera, of=CAMERA, into=ITRS)
    return Sighting(utc_unix_s=utc_unix_s, camera=camera)


def test_the_attitude_by_beacons_errs_as_it_claims(rng):
    truth, nees = camera_to_enu(100.0, 5.0, 2.0), []
    for _ in range(60):
        xy = rng.uniform([50, 50], [950, 650], (60, 2))
        noisy = xy + rng.normal(0, SIGMA_PX, xy.shape)
        found = beacons_seen(noisy, CAMERA_PX.directions(*xy.T) @ truth.T, 1.79e9).camera
        off = rotation.to_small_vector(found.rotation @ (PLACE.plumb_axes.T @ truth).T)
        nees.append(off @ np.linalg.solve(found.covariance, off))
    # three degrees of freedom; the fit allows for some scatter that is not there
    assert 1.7 < np.mean(nees) < 3.9


def test_beacons_show_whether_the_camera_was_touched(rng):
    level = camera_to_enu(100.0, 5.0, 2.0)
    nudged = level @ rotation.from_vector([0.0, 0.002, 0.0])
    xy = rng.uniform([50, 50], [950, 650], (60, 2))
    first, still, touched = (
        beacons_seen(
            xy + rng.normal(0, SIGMA_PX, xy.shape), CAMERA_PX.directions(*xy.T) @ truth.T, 1.79e9
        ).camera
        for truth in (level, level, nudged)
    )
    assert slip_s(still, first, PLACE.latitude) == 0.0
    assert slip_s(touched, first, PLACE.latitude) is None
