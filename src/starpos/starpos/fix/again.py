# SPDX-License-Identifier: Apache-2.0
"""Another try for a frame that was not identified: by smaller triangles, then by stars that are detected otherwise."""

import math
from collections.abc import Callable
from dataclasses import replace

from starpos.detection.negative import negative_of
from starpos.detection.otherwise import WAYS, otherwise
from starpos.fix.solution import Solution, Status
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.identification.second_look import ENOUGH

# Each other way to see a frame is another try, with a second look of its own: together they add 0.01 wrong answers in
# 1e9 frames.
ENOUGH_OTHERWISE = ENOUGH + math.log(10 * len(WAYS))
# Where stars fill a part of a frame only (a roof, clouds, a white half), triangles of a field this share as large are.
PART = 0.6


def identified_otherwise(
    item: Frame | Stars, stars: Stars, answer: Solution, identify: Callable[[Stars], Solution]
) -> Solution:
    """The answer to a frame's stars or, where these identify nothing, to those that are detected otherwise.

    A list of stars has no other way to be seen.
    """
    if isinstance(item, Stars) or answer.status not in (Status.NOT_IDENTIFIED, Status.TOO_FEW_STARS):
        return answer
    for others in otherwise(negative_of(item) if stars.negative else item, stars.window):
        found = identify(replace(others, negative=stars.negative))
        if found.attitude is not None and found.attitude.log_odds >= ENOUGH_OTHERWISE:
            return found
    return answer
