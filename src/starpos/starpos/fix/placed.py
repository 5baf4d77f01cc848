# SPDX-License-Identifier: Apache-2.0
"""The answer to a frame at a known place: its heading, or a sentence that the stars contradict the place."""

import math
from dataclasses import replace

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.known_place import KnownPlace, Places
from starpos.errors import PlaceError, StarposError
from starpos.fix.fix import Fix
from starpos.fix.readable import length_text
from starpos.fix.solution import Solution, status_of
from starpos.fix.solver import Solver, check_explained
from starpos.frames.stars import Stars

# a correct place lies further from the stars' own once in 1e6 frames
SIGMAS = 5.3


def placed(solver: Solver, stars: Stars, answer: Solution, places: Places) -> Solution:
    """The answer to a frame with heading, pitch and roll at its known place, if its stars are identified.

    Where there is a fix, a place that contradicts it gives no heading, and the remark says so. Without a fix the status
    says why there is no heading.
    """
    if answer.found is None or stars.mid_unix_s is None:
        return answer
    try:
        check_explained(answer)
        place = places.at(stars.mid_unix_s)
        if answer.fix is not None:
            check_agrees(answer.fix, place)
        attitude = solver.attitude_at(stars, answer.found, place)
        alone = answer.ok and answer.fix is None
        return replace(answer, at_place=attitude, message=attitude.text if alone else answer.message)
    except StarposError as e:
        if answer.fix is not None:
            return replace(answer, remark=f"{stars.place}: no heading at the known place: {e}")
        return replace(answer, status=status_of(stars, e), message=str(e))


def check_agrees(fix: Fix, place: KnownPlace) -> None:
    """Raise PlaceError if the stars' own place is further from a known one than their errors allow."""
    latitude, longitude = place.plumb
    prime, meridian = radii = np.array(curvature_radii_m(latitude))
    east = math.remainder(fix.longitude - longitude, 2 * math.pi) * prime * math.cos(latitude)
    off = np.array([east, (fix.latitude - latitude) * meridian])
    claim = fix.covariance[:2, :2] + place.covariance + np.diag((radii * place.plumb_stddev) ** 2)
    sigmas = math.sqrt(off @ np.linalg.solve(claim, off))
    if sigmas > SIGMAS:
        raise PlaceError(
            f"stars and tilt give a position {length_text(float(np.linalg.norm(off)))} from the given one, "
            f"{sigmas:.0f} times their stated errors: check latitude and longitude, their order and signs, "
            f"the tilts, A3 and the clock"
        )
