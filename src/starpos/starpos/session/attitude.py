# SPDX-License-Identifier: Apache-2.0
"""The camera's attitude among the stars, of each frame that is identified, whether there is a tilt or not."""

import traceback

from starpos.earth.orientation import earth_state
from starpos.errors import StarposError
from starpos.fix.camera_attitude import CameraAttitude
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.identification import wide
from starpos.identification.search import Priors
from starpos.navigation.sightings import sighted
from starpos.night.searching import NEVER_S, UNASKED, identify_every_way
from starpos.session.gyro import Gyro
from starpos.session.log import Log


def asked(
    solver: Solver, stars: Stars, answer: Solution, predicted: Priors = (), until_s: float = NEVER_S
) -> Solution:
    """The solver's answer to a frame; if it stopped before identification, identify the stars now."""
    if answer.found is None and answer.status in UNASKED:
        return identify_every_way(solver, stars, stars, predicted, until_s).solution
    return answer


def camera_attitude_of(
    solver: Solver, stars: Stars, answer: Solution, frame_id: str
) -> CameraAttitude | None:
    """The attitude of a frame whose stars a solver has identified; None without one.

    An identification in doubt, a fisheye and a mirrored frame give no attitude.
    """
    found = answer.found
    if found is None or answer.warnings or found.mirrored or stars.mid_unix_s is None:
        return None
    try:
        camera, catalogue, _ = solver.view(stars.width, stars.height, stars.origin_px)
        if wide.is_wide(camera):
            return None
        state = earth_state(stars.mid_unix_s)
        seen = sighted(stars, found, (camera, catalogue), state).placeless()
    except StarposError:
        return None
    return CameraAttitude(
        utc_unix_s=stars.mid_unix_s,
        stamp_stddev_s=stars.stamp_stddev_s,
        clock_stddev_s=solver.clock_stddev_s(stars),
        frame_id=frame_id,
        camera_to_gcrs=state.gcrs_to_itrs.T @ seen.camera_to_itrs,
        covariance=seen.covariance,
        stars=len(found.star),
        log_odds=found.log_odds,
    )


def attitude_seen(
    solver: Solver | None,
    stars: Stars,
    answer: Solution,
    frame_id: str,
    predicted: Priors,
    until_s: float,
    gyro: Gyro,
    log: Log,
) -> CameraAttitude | None:
    """The attitude of an answered frame, also given to the gyro; None without a solver or identified stars."""
    if solver is None:
        return None
    try:
        answer = asked(solver, stars, answer, predicted, until_s)
        attitude = camera_attitude_of(solver, stars, answer, frame_id)
        if attitude is not None and answer.found is not None:
            gyro.saw(stars, answer.found, solver)
        return attitude
    except Exception:
        # A defect loses only this attitude.
        log.error(traceback.format_exc())
        return None
