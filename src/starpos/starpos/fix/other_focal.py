# SPDX-License-Identifier: Apache-2.0
"""The focal length at which a frame is identified after the given one failed."""

import math
import time

from starpos.errors import StarposError
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.identification import MIN_STARS, Sky, identify_directions

# Ratio of successive tries, each of which tolerates an error of 3 %; number of tries on either side.
STEP, TRIES = 1.055, 6


def focal_that_fits(solver: Solver, stars: Stars, until_s: float = math.inf) -> float | None:
    """The focal length in px at which a frame is identified, from 0.7 to 1.4 times the solver's; None without one.

    No try is begun after until_s (time.monotonic).
    Triangles are found by their angles, which hardly depend on the focal length, so the given field's triangles serve.
    """
    on = stars.take(stars.on_frame.nonzero()[0])
    if len(on) < MIN_STARS:
        return None
    try:
        given, catalogue, triangles = solver.view(on.width, on.height, on.origin_px)
        sky = Sky.at(catalogue, triangles, on.mid_unix_s)
        for k in sorted(range(-TRIES, TRIES + 1), key=abs):
            if time.monotonic() >= until_s:
                break
            camera = given.scaled(STEP**k)
            seen = on.take(camera.sees(on.x, on.y).nonzero()[0])
            found = identify_directions(camera.directions(seen.x, seen.y), seen.sigma, camera, sky)
            if found is not None:
                return camera.fx * found.focal_scale
    except StarposError:
        # the frame's own sentence says it
        return None
    return None
