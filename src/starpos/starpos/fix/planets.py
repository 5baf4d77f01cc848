# SPDX-License-Identifier: Apache-2.0
"""Planets among the detections of a frame whose stars are identified: bright lights that no star catalogue has."""

import numpy as np

from starpos.earth.orientation import EarthState, earth_state
from starpos.errors import StarposError
from starpos.frames.frame import Stars
from starpos.identification import Identification
from starpos.instrument.camera import Camera
from starpos.sky.bodies import body_at

# of a planet from its predicted place: px, and sigma of the ephemeris
NEAR_PX, NEAR_SIGMAS = 6.0, 3.0
# Planets that outshine most stars, and the number of a frame's brightest detections that are looked at.
BRIGHTEST = 12
BRIGHT = "mercury", "venus", "mars", "jupiter", "saturn"


def planets_among(stars: Stars, found: Identification, camera: Camera) -> tuple[tuple[str, int], ...]:
    """Names of planets on a frame and the rows of `stars` that they are; () without a time, and for a mirrored frame."""
    if stars.mid_unix_s is None or found.mirrored:
        return ()
    known = set(found.star[:BRIGHTEST].tolist())
    others = np.array([row for row in range(min(len(stars), BRIGHTEST)) if row not in known])
    if not len(others):
        return ()
    try:
        state = earth_state(stars.mid_unix_s)
    except StarposError:
        return ()
    seen = camera.scaled(found.focal_scale)
    xy = np.stack([stars.x, stars.y], 1)[others]
    named = []
    for name in BRIGHT:
        body = body_at(name, state)
        expected = _pixel(body.itrs, state, found, seen)
        off = np.hypot(*(xy - expected).T)
        near = int(np.argmin(off))
        if off[near] < NEAR_PX + (NEAR_SIGMAS * body.sigma + body.radius) * seen.fx:
            named.append((name, int(others[near])))
    return tuple(named)


def _pixel(itrs: np.ndarray, state: EarthState, found: Identification, camera: Camera) -> np.ndarray:
    """Place (2,) px of an apparent direction (3,) in ITRS; far away if it is not in front of the camera."""
    ray = found.attitude @ (itrs @ state.gcrs_to_itrs)
    xy = camera.project(ray[None])[0]
    # what lies behind the camera has an image in formulas only
    ahead = np.isfinite(xy).all() and camera.directions(xy[:1], xy[1:])[0] @ ray > 0.999
    return xy if ahead else np.full(2, np.inf)
