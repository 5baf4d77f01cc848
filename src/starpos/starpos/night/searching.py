# SPDX-License-Identifier: Apache-2.0
"""Identify a frame by every way there is, one after another, until one succeeds or time is up.

First its stars as they are, with a second look at the frame; then smaller triangles, in case stars fill only a part of
the frame; then the same with stars from other detections. A list of stars has no other detections.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from starpos.budget import Budget
from starpos.earth.known_place import Places
from starpos.fix.blind import BlindSolver
from starpos.fix.other_focal import focal_that_fits
from starpos.fix.placed import placed
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.identification import Identification, blind_fisheye, quad_cache
from starpos.identification.blind import STAGES
from starpos.identification.hint import Hint
from starpos.identification.search import Priors
from starpos.identification.second_look import MIN_LOG_ODDS_WITH_LOOK
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilts import Tilts

if TYPE_CHECKING:
    from starpos.detection.second_look import SecondLook

# Maximum number of other detections of a frame. Each is another try, with a second look of its own, and needs log-odds of
# MIN_LOG_ODDS_OTHERWISE: together they add 0.01 wrong answers in 1e9 frames.
MAX_WAYS = 3
MIN_LOG_ODDS_OTHERWISE = MIN_LOG_ODDS_WITH_LOOK + math.log(10 * MAX_WAYS)
# If stars fill only a part of a frame (a roof, clouds, a white half), triangles of a field of this relative size help.
PART = 0.6
# stages of the search at every scale, for stars from other detections
QUICK, QUICK_FISHEYE = STAGES[:2], blind_fisheye.STAGES[:1]
# statuses that were found before any identification
UNASKED = (Status.NO_TILT, Status.TILT_OUT_OF_RANGE)
# a deadline, by time.monotonic, that is never reached
NEVER_S = math.inf


@dataclass(frozen=True, eq=False)
class Sight:
    """A detection of a frame: its stars, and their solution.

    instrument: with the focal length that fits, if the frame header's does not; else None.
    """

    stars: Stars
    solution: Solution
    instrument: Instrument | None = None

    @property
    def found(self) -> Identification | None:
        """The identification; None without one."""
        return self.solution.found


def identify_every_way(
    solver: Solver, item: Frame | Stars, stars: Stars, predicted: Priors = (), until_s: float = NEVER_S
) -> Sight:
    """Identify a frame or a list with these stars; no way is begun after until_s (time.monotonic).

    Returns the stars that identified it, or the given ones with the first answer if none did.
    """

    first = Sight(stars, solver.identify(stars, predicted, look_at(item, stars)))
    if not first.solution.lost:
        return first

    def ways(seen: Stars) -> Iterator[Solution]:
        look = look_at(item, seen)
        if seen is not stars:
            yield solver.identify(seen, predicted, look)
        yield solver.identify(seen, predicted, look, part=PART)

    return _another(item, first, ways, lambda: time.monotonic() >= until_s)


def identify_blind_every_way(solver: BlindSolver, item: Frame | Stars, stars: Stars) -> Sight:
    """Identify a frame or a list of any scale, as `identify_every_way` does for a known scale.

    All ways together have the CPU time that the solver has for a search.
    """
    budget = Budget.of(solver.search_s)

    def ways(seen: Stars) -> Iterator[Solution]:
        if seen is not stars:
            quick = replace(solver, stages=QUICK, fisheye_stages=QUICK_FISHEYE, search_s=budget.left_s)
            yield quick.identify(seen)

    return _another(item, Sight(stars, solver.identify(stars)), ways, lambda: budget.spent)


def solve_every_way(
    solver: Solver,
    item: Frame | Stars,
    stars: Stars,
    tilts: Tilts,
    hint: Hint | None = None,
    predicted: Priors = (),
    until_s: float = NEVER_S,
    known: Identification | None = None,
) -> Sight:
    """The fix of a frame or a list with these stars, identified by every way there is until until_s.

    known: the identification of these stars, if there is one already.
    """
    answer = solver.solve(stars, tilts, hint, predicted, known)
    if answer.lost and time.monotonic() < until_s:
        sight = identify_every_way(solver, item, stars, predicted, until_s)
        if sight.found is not None:
            again = solver.solve(sight.stars, tilts, hint, predicted, known=sight.found)
            return Sight(sight.stars, replace(again, identify_s=answer.identify_s + again.identify_s))
    return Sight(stars, answer)


def answer_frame(
    solver: Solver,
    item: Frame | Stars,
    stars: Stars,
    tilts: Tilts | None,
    places: Places | None,
    hint: Hint | None = None,
    predicted: Priors = (),
    until_s: float = NEVER_S,
    known: Identification | None = None,
) -> Sight:
    """The fix of a frame or a list by its tilt, as `solve_every_way` has it, and its heading where the place is known.

    tilts: None if only headings are wanted.
    """
    if tilts is None:
        sight = identify_every_way(solver, item, stars, predicted, until_s)
    else:
        sight = solve_every_way(solver, item, stars, tilts, hint, predicted, until_s, known)
    if places is None:
        return sight
    answer = sight.solution
    if answer.found is None and answer.status in UNASKED:
        sight = identify_every_way(solver, item, stars, predicted, until_s)
        if sight.found is None:
            return sight
        answer = replace(sight.solution, status=answer.status, message=answer.message)
    return replace(sight, solution=placed(solver, sight.stars, answer, places))


def focal_px_that_fits(solver: Solver, stars: Stars) -> float | None:
    """A focal length in px at which stars are identified after the given one failed; None if none is found.

    Near the given one, or wherever the first stage of the search at every scale finds it, if its quads are built.
    """
    found = focal_that_fits(solver, stars)
    if found is None and quad_cache.is_built(solver.catalogue):
        answer = BlindSolver(solver.catalogue, stages=STAGES[:1], fisheye_stages=()).identify(stars)
        found = None if answer.attitude is None else answer.attitude.focal_px
    return found


def look_at(item: Frame | Stars, stars: Stars) -> "SecondLook | None":
    """A second look at the frame of the stars; None for a list."""
    if isinstance(item, Stars):
        return None
    from starpos.detection.negative import negative_of
    from starpos.detection.second_look import SecondLook

    return SecondLook.of(negative_of(item) if stars.negative else item, stars)


def _another(
    item: Frame | Stars,
    first: Sight,
    ways: Callable[[Stars], Iterator[Solution]],
    is_over: Callable[[], bool],
) -> Sight:
    """The next sight of a frame that is identified beyond doubt, by any way and detection; else the first.

    A first sight that is not lost is the answer. No way is begun once time is up.
    """
    if not first.solution.lost or is_over():
        return first
    for seen, enough in _seen(item, first.stars):
        for answer in ways(seen):
            if answer.attitude is not None and answer.attitude.log_odds >= enough:
                return Sight(seen, answer)
            if is_over():
                return first
    return first


def _seen(item: Frame | Stars, stars: Stars) -> Iterator[tuple[Stars, float]]:
    """Yield the stars of a frame, then of its other detections, each with its minimum log-odds."""
    yield stars, -math.inf
    if isinstance(item, Stars):
        return
    # slow to import, and seldom needed
    from starpos.detection.negative import negative_of
    from starpos.detection.otherwise import otherwise

    seen = otherwise(negative_of(item) if stars.negative else item, stars.window)
    for others in itertools.islice(seen, MAX_WAYS):
        yield replace(others, negative=stars.negative), MIN_LOG_ODDS_OTHERWISE
