# SPDX-License-Identifier: Apache-2.0
"""How a session searches its frames: by every way there is, as long as the next frame need not wait."""

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from starpos.earth.known_place import Places
from starpos.fix.other_focal import focal_that_fits
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.identification.hint import Hint
from starpos.identification.search import Priors
from starpos.instrument.tilts import Tilts
from starpos.night import searching
from starpos.night.remarks import of_focal_length
from starpos.night.searching import NEVER_S
from starpos.session.now import Now

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

    def frame_came(self, now: Now) -> None:
        """Note that a frame has come."""
        self._interval_s, self._came_s = now.waiting_s - self._came_s, now.waiting_s

    def until_s(self, now: Now | None, others_wait: bool) -> float:
        """Time, by time.monotonic, until which another way to identify a frame may be begun.

        now: None for a frame that somebody asks for.  In recorded data no time passes, so all ways are tried.
        """
        most_s = self._values["search_time"]
        if now is not None and now.played:
            return NEVER_S if most_s > 0 else AT_ONCE_S
        if now is not None:
            most_s = min(most_s, 0.0 if others_wait else MAX_OF_INTERVAL * self._interval_s)
        return time.monotonic() + most_s

    def solved(
        self,
        solver: Solver,
        stars: Stars,
        tilts: Tilts,
        places: Places | None,
        hint: Hint | None,
        predicted: Priors,
        until_s: float,
        known: Identification | None,
    ) -> Solution:
        """Solve a list by `searching.answer_frame`; while none is identified, say which focal length fits."""
        # a node has no picture to look at, only the list
        seen = searching.answer_frame(
            solver,
            item=stars,
            stars=stars,
            tilts=tilts,
            places=places,
            hint=hint,
            predicted=predicted,
            until_s=until_s,
            known=known,
        )
        answer = seen.solution
        self._identified |= answer.found is not None
        if self._identified or answer.status is not Status.NOT_IDENTIFIED:
            return answer
        focal_px = focal_that_fits(solver, stars, until_s)
        if focal_px is None:
            return answer
        return replace(answer, message=str(of_focal_length(stars.place, focal_px)))
