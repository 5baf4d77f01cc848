# SPDX-License-Identifier: Apache-2.0
"""Planets among the detections of a frame whose stars are identified: bright lights that no star catalogue has."""

import numpy as np

from starpos.earth.orientation import earth_state
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
    seen = camera.scaled(found.focal_scale)
    try:
        state = earth_state(stars.mid_unix_s)
        rays = seen.directions(stars.x[others], stars.y[others])
    except StarposError:
        return ()
    # rays are compared, not pixels: distortion's formula has no place for a planet far outside the frame
    sky = rays @ found.attitude @ state.gcrs_to_itrs.T
    named = []
    for name in BRIGHT:
        body = body_at(name, state)
        off = np.linalg.norm(sky - body.itrs, axis=1)
        near = int(np.argmin(off))
        if off[near] < NEAR_PX / seen.fx + NEAR_SIGMAS * body.sigma + body.radius:
            named.append((name, int(others[near])))
    return tuple(named)
