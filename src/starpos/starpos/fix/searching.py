# SPDX-License-Identifier: Apache-2.0
"""Identify or solve a frame by every way there is, one after another, until one succeeds or time is up.

First its stars as they are, then a second look at the frame; then both with smaller triangles, in case stars fill only a
part of the frame; then the same with stars from other detections. A list of stars has no other detections. No way is
tried again on the same stars. A focal length that only a header states is a hint: if it fits nothing, the search goes on
without it.
"""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from starpos.earth.place import Places
from starpos.errors import FieldError, StarposError
from starpos.fix.blind import BlindSolver
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver, focal_that_fits, placed
from starpos.fix.sun import by_sun
from starpos.frames.frame import Frame, Stars
from starpos.frames.header import focal_mm
from starpos.frozen import at_once
from starpos.identification import Identification, blind, quads
from starpos.identification.blind import STAGES
from starpos.identification.prior import Hint
from starpos.identification.search import MIN_LOG_ODDS_WITH_LOOK, Priors
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import Tilts
from starpos.progress import CpuLimit, Progress

if TYPE_CHECKING:
    from starpos.detection.second_look import SecondLook

# Maximum number of other detections of a frame. Each is another try, with a second look of its own, and needs log-odds of
# MIN_LOG_ODDS_OTHERWISE: together they add 0.01 wrong answers in 1e9 frames.
MAX_WAYS = 3
MIN_LOG_ODDS_OTHERWISE = MIN_LOG_ODDS_WITH_LOOK + math.log(10 * MAX_WAYS)
# If stars fill only a part of a frame (a roof, clouds, a white half), triangles of a field of this relative size help.
PART = 0.6
# stages of the search at every scale, for stars from other detections
QUICK, QUICK_FISHEYE = STAGES[:2], blind.FISHEYE_STAGES[:1]
# statuses that were found before any identification
UNASKED = (Status.NO_TILT, Status.TILT_OUT_OF_RANGE)
# a deadline, by time.monotonic, that is never reached
NEVER_S = math.inf


@at_once
@dataclass(frozen=True, eq=False, kw_only=True)
class Question:
    """A frame, what is asked of it, and what is known beforehand.

    item: the frame, for a second look and for other detections, or its list of stars.
    stars: the detected ones, or the list.
    tilts: for a fix; None if only an identification, or a heading, is asked for.
    places: where the instrument is known to be, for its heading there; None if unknown.
    predicted, hint: where to look first, the latter of an earlier solution.
    until_s: by time.monotonic, when no further way is begun.
    known: an identification of `stars`, with which nothing is searched for a fix; None without one.
    """

    item: Frame | Stars
    stars: Stars
    tilts: Tilts | None = None
    places: Places | None = None
    predicted: Priors = ()
    hint: Hint | None = None
    until_s: float = NEVER_S
    known: Identification | None = None


@at_once
@dataclass(frozen=True, eq=False)
class Sight:
    """A detection of a frame: its stars, and their solution.

    instrument: with the focal length that fits, if the frame header's does not; else None.
    cpu_ms: CPU time of detection and search; NaN where it was not measured.
    """

    stars: Stars
    solution: Solution
    instrument: Instrument | None = None
    cpu_ms: float = math.nan

    @property
    def found(self) -> Identification | None:
        """The identification; None without one."""
        return self.solution.found


def answer_frame(solver: Solver, question: Question) -> Sight:
    """The fix of a frame by its tilt, and its heading where the place is known; without both its identification.

    A disc counts only where no stars are found: else it is the Moon, a lamp, or no disc at all.
    Its stars are identified by every way there is, each tried once on the same stars.
    """
    q, disc = question, question.stars.disc
    if disc is None or (q.tilts is None and q.places is None):
        return _by_stars(solver, q)
    searched = solver.identify(q.stars, q.predicted)
    if not searched.lost:
        return _by_stars(solver, replace(q, known=searched.found), searched)
    by_day = Sight(q.stars, by_sun(solver, q.stars, disc, q.tilts, q.places))
    if by_day.solution.ok:
        return by_day
    by_night = _by_stars(solver, q, searched)
    return by_day if by_night.solution.lost else by_night


def _by_stars(solver: Solver, question: Question, searched: Solution | None = None) -> Sight:
    """The answer to a frame by its stars; searched: as of `identify_every_way`."""
    q = question
    sight = identify_every_way(solver, q, searched) if q.tilts is None else _solved(solver, q, q.tilts)
    if q.places is None:
        return sight
    answer = sight.solution
    if answer.found is None and answer.status in UNASKED:
        sight = identify_every_way(solver, q, searched)
        if sight.found is None:
            return sight
        answer = replace(sight.solution, status=answer.status, message=answer.message)
    return replace(sight, solution=placed(solver, sight.stars, answer, q.places))


def identify_every_way(solver: Solver, question: Question, searched: Solution | None = None) -> Sight:
    """Identify a frame; its stars that identified it, or the given ones with the first answer if none did.

    searched: what the search among the given stars has answered; None before it.
    """
    first = searched or solver.identify(question.stars, question.predicted)
    return _otherwise(solver, question, Sight(question.stars, first))


def identify_blind_every_way(solver: BlindSolver, item: Frame | Stars, stars: Stars) -> Sight:
    """Identify a frame or a list of any scale, as `identify_every_way` does for a known scale.

    All ways together have the CPU time that the solver has for a search.
    """
    limit = CpuLimit.of(solver.search_s)

    def ways(seen: Stars) -> Iterator[Solution]:
        if seen is not stars:
            quick = replace(solver, stages=QUICK, fisheye_stages=QUICK_FISHEYE, search_s=limit.left_s)
            yield quick.identify(seen)

    return _another(item, Sight(stars, solver.identify(stars)), ways, lambda: limit.reached)


def _solved(solver: Solver, q: Question, tilts: Tilts) -> Sight:
    """The fix of a frame, whose stars are searched with refraction removed first."""
    answer = solver.solve(q.stars, tilts, q.hint, q.predicted, q.known)
    sight = _otherwise(solver, q, Sight(q.stars, answer))
    if sight.solution is answer:
        return sight
    again = solver.solve(sight.stars, tilts, known=sight.found)
    return replace(sight, solution=replace(again, identify_s=answer.identify_s + again.identify_s))


def _otherwise(solver: Solver, q: Question, first: Sight) -> Sight:
    """The sight of a frame by all ways but the search among its stars, which has given `first`."""
    return _another(q.item, first, lambda seen: _ways(solver, q, seen), lambda: time.monotonic() >= q.until_s)


def _ways(solver: Solver, q: Question, seen: Stars) -> Iterator[Solution]:
    """Yield the answers to these stars of a frame, by one way after another; its own were searched already."""
    look = look_at(q.item, seen)
    for part in (1.0, PART):
        if seen is not q.stars or part != 1.0:
            yield solver.identify(seen, q.predicted, part)
        if look is not None:
            yield solver.identify(seen, q.predicted, part, look)


def focal_px_that_fits(solver: Solver, stars: Stars) -> float | None:
    """A focal length in px at which stars are identified after the given one failed; None if none is found.

    Near the given one, or wherever the first stage of the search at every scale finds it, if its quads are built.
    """
    found = focal_that_fits(solver, stars)
    if found is None and quads.is_built(solver.catalogue):
        answer = BlindSolver(solver.catalogue, stages=STAGES[:1], fisheye_stages=()).identify(stars)
        found = None if answer.pointing is None else answer.pointing.focal_px
    return found


def other_focal_length(place: str, focal_px: float) -> str:
    """A sentence that says which focal length fits a frame that was not identified with the given one."""
    return f"{place}: a focal length of {focal_px:.0f} px fits: give that one"


def look_at(item: Frame | Stars, stars: Stars) -> "SecondLook | None":
    """A second look at the frame of the stars; None for a list."""
    if isinstance(item, Stars):
        return None
    from starpos.detection.second_look import SecondLook, negative_of

    return SecondLook(negative_of(item) if stars.negative else item, stars.window, stars.fwhm_px)


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
    for seen, enough in _detections(item, first.stars):
        for answer in ways(seen):
            if answer.pointing is not None and answer.pointing.log_odds >= enough:
                return Sight(seen, answer)
            if is_over():
                return first
    return first


def _detections(item: Frame | Stars, stars: Stars) -> Iterator[tuple[Stars, float]]:
    """Yield the stars of a frame, then of its other detections, each with its minimum log-odds."""
    yield stars, -math.inf
    if isinstance(item, Stars):
        return
    # slow to import, and seldom needed
    from starpos.detection.second_look import negative_of, other_views

    seen = other_views(negative_of(item) if stars.negative else item, stars.window)
    for others in itertools.islice(seen, MAX_WAYS):
        yield replace(others, negative=stars.negative), MIN_LOG_ODDS_OTHERWISE


# CPU time, s, of the search at every scale for a frame with a header: under clouds each frame of a night takes it.
HINT_SEARCH_S = 5.0


def answer_by_header(solver: Solver, question: Question, progress: Progress) -> Sight:
    """The answer to a frame with its header's focal length, or if that identifies nothing, with the one that fits.

    solver: with the header's focal length.
    """
    sight, item = answer_frame(solver, question), question.item
    fitting = _fitting(solver, question, progress) if _misled(solver, item, sight) else None
    if fitting is None:
        return sight
    again = answer_frame(replace(solver, instrument=fitting), question)
    if again.solution.pointing is None:
        return sight
    remark = wrong_header(item, again.solution.pointing.focal_px)
    return replace(again, solution=again.solution.with_remark(remark), instrument=fitting)


def of_one_camera(solver: Solver, sights: Sequence[Sight]) -> tuple[Solver, list[Sight]]:
    """A solver with the focal length of a night's frames, and each frame's sight by this solver.

    solver: with the header's focal length, which holds unless a frame was identified with another one.
    """
    other = next((s.instrument for s in sights if s.instrument is not None), None)
    if other is None:
        return solver, list(sights)
    by_other = replace(solver, instrument=other)
    return by_other, [
        s if s.instrument is other else identify_every_way(by_other, Question(item=s.stars, stars=s.stars))
        for s in sights
    ]


def wrong_header(item: Frame | Stars, focal_px: float) -> str:
    """A sentence that says which focal length fits a frame in place of its header's."""
    told = "" if item.focal_px is None else f": it makes a focal length of {item.focal_px:.0f} px"
    fits = f"{focal_px:.0f} px"
    if item.focal_px is not None and item.pixel_um is not None:
        told += f" ({focal_mm(item.focal_px, item.pixel_um):.4g} mm, pixels of {item.pixel_um:g} um)"
        fits += f", {focal_mm(focal_px, item.pixel_um):.4g} mm for such pixels,"
    return f"{item.place}: its header is wrong{told}; {fits} fits"


def _misled(solver: Solver, item: Frame | Stars, sight: Sight) -> bool:
    """Whether another focal length may identify a frame that is not identified."""
    if sight.solution.status is Status.NOT_IDENTIFIED:
        return True
    if sight.solution.status is not Status.BAD_INPUT:
        return False
    try:
        solver.view(item.width, item.height, item.origin_px)
    except FieldError:
        return True
    # the solution has the sentence
    except StarposError:
        return False
    return False


def _fitting(solver: Solver, q: Question, progress: Progress) -> Instrument | None:
    """The solver's instrument with the focal length, and the lens, that a frame's stars fit; None if none is found."""
    focal_px = focal_that_fits(solver, q.stars)
    if focal_px is not None:
        return replace(solver.instrument, focal_px=focal_px)
    blind = BlindSolver(solver.catalogue, progress, search_s=HINT_SEARCH_S)
    seen = identify_blind_every_way(blind, q.item, q.stars).solution.pointing
    return None if seen is None else replace(solver.instrument, focal_px=seen.focal_px, model=seen.model)
