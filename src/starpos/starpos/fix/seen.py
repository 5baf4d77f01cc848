# SPDX-License-Identifier: Apache-2.0
"""Which of a frame's stars its lens shows, in which directions, and which of them are high enough for a fix."""

import math

import numpy as np

from starpos.frames.stars import EDGE_PX, Stars
from starpos.identification._frame import FrameStars, all_within, ideal_frame, unit_vectors
from starpos.identification.pose import MIN_SIGMA_PX, TEST_STARS
from starpos.identification.search import through
from starpos.instrument.camera import Camera
from starpos.instrument.lens import EQUIDISTANT

# A fisheye's lower stars are not used: no model describes refraction near the horizon.
MIN_ALTITUDE_RAD = math.radians(10)


def inside(stars: Stars, camera: Camera) -> np.ndarray | None:
    """Rows of the stars that lie on their frame and in its lens's picture; None if all do, as is usual."""
    if camera.model != EQUIDISTANT and all_within(stars.x, stars.y, stars.width, stars.height, EDGE_PX):
        return None
    on = stars.on_frame & camera.sees(stars.x, stars.y)
    return None if on.all() else np.flatnonzero(on)


def directions_of(camera: Camera, stars: Stars) -> np.ndarray:
    """Unit vectors (N, 3) in C of the stars' pixels."""
    if not camera.is_ideal:
        return camera.directions(stars.x, stars.y)
    return unit_vectors(stars.x, stars.y, camera.fx, camera.fy, camera.cx, camera.cy)


def as_seen(camera: Camera, stars: Stars) -> FrameStars | None:
    """The stars as `identify_frame` takes them, refracted; None unless all lie on the frame of an ideal camera.

    For such a camera this is quicker than by their directions.
    """
    if not camera.is_ideal:
        return None
    field = ideal_frame(stars.x, stars.y, stars.covariance, camera, EDGE_PX, MIN_SIGMA_PX, TEST_STARS)
    return None if field is None else through(field, camera, stars.window)


def high_enough(sines: np.ndarray) -> np.ndarray:
    """Whether stars are above the worst of the air, by the sines (N,) of their altitudes."""
    return sines > math.sin(MIN_ALTITUDE_RAD)
