# SPDX-License-Identifier: Apache-2.0
"""The work on one frame, as small objects that can be sent to any process or machine, where `OnFile` calls them."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starpos.earth.place import Place, Places
from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError, StarposError
from starpos.fix.blind import SEARCH_S, BlindSolver
from starpos.fix.searching import (
    Question,
    Sight,
    answer_by_header,
    answer_frame,
    focal_px_that_fits,
    identify_blind_every_way,
    other_focal_length,
)
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, check_explained
from starpos.frames.frame import Frame, Stars
from starpos.identification.prior import Hint
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.night.reading import Instruments, Reader, TiltFile, stars_of
from starpos.night.remarks import Kind, Remark
from starpos.progress import Progress, quiet
from starpos.sky import catalogue
from starpos.zenith.sighting import ZenithSighting, sighting

if TYPE_CHECKING:
    from starpos.detection import Detection


@dataclass(frozen=True)
class OnFile:
    """Does a work on the frame or list in a file."""

    read: Reader
    work: Callable[[Frame | Stars], Any]

    @property
    def files(self) -> tuple[str, ...]:
        """Files that it reads besides the frame."""
        tilts = getattr(self.work, "tilts", None)
        return (tilts.path,) if isinstance(tilts, TiltFile) else ()

    def __call__(self, path: str) -> Any:
        return self.work(self.read(path))


def detected(item: Frame | Stars) -> tuple["Detection | Stars", float]:
    """The Detection of a frame, or the Stars of a list, and the CPU time in ms."""
    from starpos.detection.second_look import detect_dark_too

    begin = time.process_time()
    found = item if isinstance(item, Stars) else detect_dark_too(item)
    return found, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Identifying:
    """Identifies a frame by every way there is, at any scale if its focal length is unknown.

    Gives its Sight, and the CPU time in ms.
    search_s: CPU time after which the search at every scale ends.
    progress: of that search.
    """

    instruments: Instruments
    search_s: float = SEARCH_S
    progress: Progress = quiet

    def __call__(self, item: Frame | Stars) -> tuple[Sight, float]:
        instrument, stars_known = self.instruments.of(item), catalogue.load_catalogue()
        if instrument is None:
            blind = BlindSolver(stars_known, self.progress, search_s=self.search_s)
            blind.prepare()
            begin = time.process_time()
            sight = identify_blind_every_way(blind, item, stars_of(item))
        else:
            solver = Solver(instrument, stars_known)
            # the frame reports the error
            with suppress(StarposError):
                solver.prepare(item.width, item.height, item.origin_px)
            begin = time.process_time()
            sight = _answered(self, solver, Question(item=item, stars=stars_of(item)))
        return sight, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Fitting:
    """Says which focal length fits a frame that was not identified with the given one."""

    instruments: Instruments

    def __call__(self, item: Frame | Stars) -> tuple[Remark, ...]:
        instrument = self.instruments.of(item)
        # without its header's focal length a frame was searched already
        if instrument is None or self.instruments.hinted:
            return ()
        solver = Solver(instrument, catalogue.load_catalogue())
        focal_px = focal_px_that_fits(solver, stars_of(item))
        return (
            () if focal_px is None else (Remark(Kind.FOCAL_LENGTH, other_focal_length(item.place, focal_px)),)
        )


@dataclass(frozen=True)
class Solving:
    """Solves a frame, identified by every way there is: its Solution.

    tilts: not used for a camera fixed to the ground; None if only headings are wanted.
    places: where the instrument is known to be, for its heading there; None if unknown.
    progress: of the search for a focal length.
    """

    instruments: Instruments
    atmosphere: Atmosphere
    tilts: Tilts | None = NO_TILTS
    places: Places | None = None
    progress: Progress = quiet

    def __call__(self, item: Frame | Stars) -> Solution:
        return self.sight(item).solution

    def solver(self, item: Frame | Stars) -> Solver:
        """The solver of a frame; InstrumentError if its focal length is unknown."""
        instrument = self.instruments.of(item)
        if instrument is None:
            raise InstrumentError(
                f"{item.place}: its header has no focal length: give instrument=Instrument(focal_px)"
            )
        return Solver(instrument, catalogue.load_catalogue(), self.atmosphere)

    def sight(self, item: Frame | Stars, hint: Hint | None = None) -> Sight:
        """The solution of a frame, and the stars that gave it; hint: of the frame before."""
        question = Question(item=item, stars=stars_of(item), tilts=self.tilts, places=self.places, hint=hint)
        return _answered(self, self.solver(item), question)


def _answered(work: Identifying | Solving, solver: Solver, question: Question) -> Sight:
    if work.instruments.hinted:
        return answer_by_header(solver, question, work.progress)
    return answer_frame(solver, question)


@dataclass(frozen=True)
class ZenithSighted:
    """Makes the ZenithSighting of a frame at a mark; a frame's fault is a Solution that gives the reason."""

    instruments: Instruments
    atmosphere: Atmosphere
    tilts: Tilts
    mark: Place

    def __call__(self, item: Frame | Stars) -> ZenithSighting | Solution:
        """The sighting of a frame, identified by every way there is."""
        sight, _ = Identifying(self.instruments)(item)
        instrument = sight.instrument or self.instruments.of(item)
        if sight.found is None or instrument is None:
            return sight.solution
        solver = Solver(instrument, catalogue.load_catalogue(), self.atmosphere)
        try:
            check_explained(sight.solution)
            return sighting(solver, sight.stars, sight.found, self.mark, self.tilts)
        except StarposError as error:
            return Solution.refused(sight.stars, error)
