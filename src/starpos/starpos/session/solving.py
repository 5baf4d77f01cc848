# SPDX-License-Identifier: Apache-2.0
"""How a session solves a frame: the ways to identify it, as long as the next frame need not wait, and its attitude."""

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from starpos.earth.orientation import earth_state
from starpos.errors import StarposError
from starpos.fix import searching
from starpos.fix.attitude import CameraAttitude
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver, focal_that_fits
from starpos.fix.sun import sun_alone
from starpos.frames.frame import Stars
from starpos.navigation.sightings import sighting_of
from starpos.session.driver import Now
from starpos.session.gyro import Gyro
from starpos.sky.bodies import SUN

# Share of the time between frames in which one may be searched.
MAX_OF_INTERVAL = 0.5
# a deadline in the past: one search only
AT_ONCE_S = 0.0


class Search:
    """Solves frames, and ends with each in time; values: the parameters."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        # since the last frame, and when that came, by the clock in which waiting is counted
        self._interval_s, self._came_s = math.inf, -math.inf
        self.other_camera()

    def other_camera(self) -> None:
        """Note that the camera is another one."""
        # whether a frame of this camera was identified
        self._identified = False

    def note_frame(self, now: Now) -> None:
        """Note that a frame has come."""
        self._interval_s, self._came_s = now.waiting_s - self._came_s, now.waiting_s

    def until_s(self, now: Now | None, others_wait: bool) -> float:
        """Time, by time.monotonic, until which another way to identify a frame may be begun.

        now: None for a frame that somebody asks for.  In recorded data no time passes, so all ways are tried.
        """
        most_s = self._values["search_time"]
        if now is not None and now.played:
            return searching.NEVER_S if most_s > 0 else AT_ONCE_S
        if now is not None:
            most_s = min(most_s, 0.0 if others_wait else MAX_OF_INTERVAL * self._interval_s)
        return time.monotonic() + most_s

    def solve(self, solver: Solver, question: searching.Question) -> Solution:
        """Solve a list by `answer_frame`; while none is identified, say which focal length fits."""
        answer = searching.answer_frame(solver, question).solution
        self._identified |= answer.found is not None
        if self._identified or answer.status is not Status.NOT_IDENTIFIED:
            return answer
        focal_px = focal_that_fits(solver, question.stars, question.until_s)
        if focal_px is None:
            return answer
        return replace(answer, message=searching.other_focal_length(question.stars.place, focal_px))


def camera_attitude_of(
    solver: Solver, stars: Stars, answer: Solution, frame_id: str
) -> CameraAttitude | None:
    """The attitude of a frame whose stars a solver has identified; None without one.

    An identification in doubt, a fisheye and a mirrored frame give no attitude.
    """
    found = answer.found
    try:
        frame = sighting_of(stars, solver, answer)
    except StarposError:
        return None
    assert found is not None
    gcrs_to_itrs = earth_state(frame.utc_unix_s).gcrs_to_itrs
    return CameraAttitude(
        utc_unix_s=frame.utc_unix_s,
        stamp_stddev_s=stars.stamp_stddev_s,
        clock_stddev_s=solver.clock_stddev_s(stars),
        frame_id=frame_id,
        camera_to_gcrs=gcrs_to_itrs.T @ frame.camera.rotation,
        covariance=frame.camera.covariance_about_own,
        stars=len(found.star),
        log_odds=found.log_odds,
    )


def attitude_beside(
    solver: Solver, question: searching.Question, answer: Solution, frame_id: str, gyro: Gyro
) -> CameraAttitude | None:
    """The attitude of a frame that was asked about, also given to the gyro; None without identified stars or the Sun.

    Where the solver stopped before identification, the stars are identified now.  The Sun's limb counts without a heading
    too: under way the level does not show where up is.  A glow, which may be a lamp's, counts with one alone.
    """
    disc = question.stars.disc
    if disc is not None and answer.found is None and (disc.sharp or answer.ok):
        return (
            sun_alone(solver, question.stars, disc, frame_id) if answer.bodies[:1] in ((), (SUN,)) else None
        )
    if answer.found is None and answer.status in searching.UNASKED:
        answer = searching.identify_every_way(solver, replace(question, tilts=None, places=None)).solution
    attitude = camera_attitude_of(solver, question.stars, answer, frame_id)
    if attitude is not None and answer.found is not None:
        gyro.learn_from(question.stars, answer.found, solver)
    return attitude
