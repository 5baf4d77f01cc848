# SPDX-License-Identifier: Apache-2.0
"""Another try for a frame that was not identified: by smaller triangles, then by stars that are detected otherwise."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

from starpos.fix.solution import Solution, Status
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.identification.second_look import ENOUGH

# Each of at most so many other ways to see a frame is another try, with a second look of its own: together they add 0.01
# wrong answers in 1e9 frames.
MOST_WAYS = 3
ENOUGH_OTHERWISE = ENOUGH + math.log(10 * MOST_WAYS)
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
    # slow to import, and seldom needed
    from starpos.detection.negative import negative_of
    from starpos.detection.otherwise import otherwise

    seen = otherwise(negative_of(item) if stars.negative else item, stars.window)
    for others in itertools.islice(seen, MOST_WAYS):
        found = identify(replace(others, negative=stars.negative))
        if found.attitude is not None and found.attitude.log_odds >= ENOUGH_OTHERWISE:
            return found
    return answer
