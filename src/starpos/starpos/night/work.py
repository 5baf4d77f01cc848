# SPDX-License-Identifier: Apache-2.0
"""The work on one frame, as small objects that can be sent to any process or machine, where `OnFile` calls them."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from starpos.earth.known_place import Places
from starpos.earth.refraction import Atmosphere
from starpos.errors import InstrumentError, StarposError
from starpos.fix.blind import SEARCH_S, BlindSolver
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame
from starpos.frames.stars import Stars
from starpos.identification.hint import Hint
from starpos.instrument.tilts import NO_TILTS, Tilts
from starpos.night import searching
from starpos.night.hints import without_hint
from starpos.night.reading import Instruments, Reader, TiltFile, stars_of
from starpos.night.remarks import Remark, of_focal_length
from starpos.night.searching import Sight
from starpos.progress import Progress, quiet
from starpos.sky import catalogue

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
    from starpos.detection.negative import detect_dark_too

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
            sight = searching.identify_blind_every_way(blind, item, stars_of(item))
        else:
            solver = Solver(instrument, stars_known)
            # the frame reports the error
            with suppress(StarposError):
                solver.prepare(item.width, item.height, item.origin_px)
            begin = time.process_time()
            sight = self._by_focal_length(solver, item)
        return sight, 1000 * (time.process_time() - begin)

    def _by_focal_length(self, solver: Solver, item: Frame | Stars) -> Sight:
        stars = stars_of(item)

        def work(solver: Solver) -> Sight:
            return searching.identify_every_way(solver, item, stars)

        sight = work(solver)
        return (
            without_hint(solver, item, stars, sight, work, self.progress)
            if self.instruments.hinted
            else sight
        )


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
        focal_px = searching.focal_px_that_fits(solver, stars_of(item))
        return () if focal_px is None else (of_focal_length(item.place, focal_px),)


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
        solver, stars = self.solver(item), stars_of(item)

        def work(solver: Solver) -> Sight:
            return searching.answer_frame(solver, item, stars, self.tilts, self.places, hint)

        sight = work(solver)
        return (
            without_hint(solver, item, stars, sight, work, self.progress)
            if self.instruments.hinted
            else sight
        )
