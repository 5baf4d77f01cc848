# SPDX-License-Identifier: Apache-2.0
"""The work on one frame, as small objects and functions that can be sent to any process, where `Reader.on` calls them."""

import math
import time
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starpos.calibration.camera import hour_by_lens, lens_of_frame
from starpos.earth.place import Places
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError, InstrumentError, StarposError
from starpos.fix import searching
from starpos.fix.blind import SEARCH_S, BlindSolver
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, placed
from starpos.frames.frame import Frame, Stars
from starpos.frames.reading import read_frame
from starpos.identification.prior import Hint
from starpos.instrument import instrument_file
from starpos.instrument.instrument import ByGravity, Instrument, with_frame_size
from starpos.instrument.tilt_log import Tilts
from starpos.night.reading import Instruments, stars_of
from starpos.progress import Progress, quiet
from starpos.sky import catalogue
from starpos.sky.bodies import ERFA, SolarSystem

if TYPE_CHECKING:
    from starpos.detection import Detection

# Share by which a photograph's focal length may differ from its EXIF's, rounded to 1 mm of a 35 mm film's: 4 % of 13 mm.
CUT_OUT = 0.06


def detected(item: Frame | Stars) -> tuple["Detection | Stars", float]:
    """The Detection of a frame, or the Stars of a list, and the CPU time in ms."""
    from starpos.detection.second_look import detect_dark_too

    begin = time.process_time()
    found = item if isinstance(item, Stars) else detect_dark_too(item)
    return found, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Solving:
    """Answers a frame: its Sight, identified by every way there is, with its fix and its heading as far as asked for.

    tilts: for a fix; not used for a camera fixed to the ground; None if no fix is asked for.
    places: where the instrument is known to be, for its heading there; None if unknown.
    search_s: CPU time of the search at every scale for a frame of unknown focal length; None to refuse that frame.
    progress: of building tables, and of the search at every scale.
    """

    instruments: Instruments
    _: KW_ONLY
    atmosphere: Atmosphere = field(default_factory=lambda: Atmosphere.measured(None, None))
    ephemeris: SolarSystem = ERFA
    tilts: Tilts | None = None
    places: Places | None = None
    search_s: float | None = None
    progress: Progress = quiet
    # focal length in px by size and EXIF's focal length of frames that state none
    _found_px: dict = field(default_factory=dict, compare=False)
    # the solver of the latest instrument: frames of one camera share what it has made for them
    _latest: list[Solver] = field(default_factory=list, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        """What a worker is given: it makes its own solver."""
        return vars(self) | {"_latest": []}

    def __call__(self, item: Frame | Stars) -> searching.Sight:
        """The sight of a frame; InstrumentError if its focal length is unknown, and must not be."""
        if isinstance(self.tilts, ByGravity) and not self.tilts.has(item):
            begin, stars = time.process_time(), stars_of(item)
            sight = searching.Sight(stars, Solution.refused(stars, self.tilts.missing(item)))
        elif self.instruments.cameras and self.instruments.of(item) is None:
            # the frames of the cameras' sizes go on
            begin, stars = time.process_time(), stars_of(item)
            why = f"{item.place}: no camera_info is of its {item.width} x {item.height} px: state its instrument"
            sight = searching.Sight(stars, Solution.refused(stars, InstrumentError(why)))
        elif self.instruments.sought and item.focal_px is None:
            begin = time.process_time()
            sight = self._by_sought_focal_length(item)
        elif self.search_s is not None and self.instruments.of(item) is None:
            blind = BlindSolver(catalogue.load_catalogue(), self.progress, search_s=self.search_s)
            blind.prepare()
            begin = time.process_time()
            sight = searching.identify_blind_every_way(blind, item, stars_of(item))
        else:
            solver = self.solver(item)
            # the frame reports the error
            with suppress(StarposError):
                solver.prepare(item.width, item.height, item.origin_px)
            begin = time.process_time()
            question = searching.Question(
                item=item, stars=stars_of(item), tilts=self.tilts, places=self.places
            )
            if self.instruments.by_header:
                sight = searching.answer_by_header(solver, question, self.progress)
            else:
                sight = searching.answer_frame(solver, question)
        return replace(sight, cpu_ms=1000 * (time.process_time() - begin))

    def _by_sought_focal_length(self, item: Frame | Stars) -> searching.Sight:
        """The answer with the focal length of an earlier frame of this lens, else with the one that the stars give."""
        stars, lens = stars_of(item), (item.width, item.height, item.rough_focal_px)
        question = searching.Question(item=item, stars=stars, tilts=self.tilts, places=self.places)
        if lens in self._found_px:
            sight = self._answer_at(self._found_px[lens], question)
            if sight.found is not None or not sight.solution.lost:
                return sight
        blind = BlindSolver(catalogue.load_catalogue(), self.progress, search_s=self.search_s or SEARCH_S)
        found = searching.identify_blind_every_way(blind, item, stars)
        if found.solution.pointing is None:
            return found
        focal_px, model = found.solution.pointing.focal_px, found.solution.pointing.model
        rough_px = item.rough_focal_px or focal_px
        if self._by_phone(item) and abs(focal_px / rough_px - 1) > CUT_OUT:
            cut = FrameError(
                f"{item.place}: its stars give a focal length of {focal_px:.0f} px, its EXIF {rough_px:.0f} px: it is a "
                "part of a photograph, whose optical axis is unknown, or its EXIF is wrong: give the whole one"
            )
            return searching.Sight(found.stars, Solution.refused(found.stars, cut))
        sight = self._answer_at((focal_px, model), question)
        if sight.found is None:
            return sight
        self._found_px[lens] = focal_px, model
        told = "no focal length is stated"
        if item.rough_focal_px is not None:
            told = f"its EXIF gives a focal length of about {item.rough_focal_px:.0f} px"
        remark = f"{item.place}: {told}: its stars give {focal_px:.0f} px"
        return replace(sight, solution=sight.solution.with_remark(remark))

    def _by_phone(self, item: Frame | Stars) -> bool:
        """Whether the level is in the camera that took a photograph."""
        return item.gravity is not None or (isinstance(self.tilts, ByGravity) and self.tilts.has(item))

    def _answer_at(self, lens: tuple[float, str], question: searching.Question) -> searching.Sight:
        """The answer with this focal length in px and model of a lens."""
        known = self.instruments.instrument
        assert known is not None
        known, doubt = with_frame_size(replace(known, focal_px=lens[0], model=lens[1]), question.stars)
        solver = self._solver(known)
        sight = searching.answer_frame(solver, question)
        if self._by_phone(question.item) and sight.found is not None and known.camera is None and not doubt:
            # the lens of a telephone bends the field's corners by up to 100 px
            camera, _, _ = solver.view(sight.stars.width, sight.stars.height)
            bent, left_rad = lens_of_frame(
                sight.stars, sight.found, camera, solver.catalogue, self.atmosphere
            )
            known = replace(known, camera=bent, focal_px=bent.fx, lens_stddev_rad=left_rad)
            if bent is camera:
                question = replace(question, stars=sight.stars, known=sight.found)
            again = searching.answer_frame(replace(solver, instrument=known), question)
            sight = sight if again.found is None else again
        if sight.solution.at_place is not None and known.axis_stddev_rad:
            doubt = (
                f"{question.item.place}: the picture is cut out of a larger one: its optical axis may be "
                f"{math.degrees(known.axis_stddev_rad):.1g} deg from its centre, which the error contains: find it "
                "with starpos calibrate --camera --site"
            )
        return replace(sight, solution=sight.solution.with_remark(doubt), instrument=known)

    def solver(self, item: Frame | Stars) -> Solver:
        """The solver of a frame; InstrumentError if its focal length is unknown."""
        instrument = self.instruments.of(item)
        if self.instruments.sought:
            instrument = instrument or self.instruments.instrument
        if instrument is None:
            raise InstrumentError(
                f"{item.place}: its header has no focal length: give instrument=Instrument(focal_px)"
            )
        if not self._latest or self._latest[0].instrument != instrument:
            self._latest[:] = [self._solver(instrument)]
        return self._latest[0]

    def _solver(self, instrument: Instrument) -> Solver:
        return Solver(
            instrument,
            catalogue.load_catalogue(),
            self.atmosphere,
            progress=self.progress,
            ephemeris=self.ephemeris,
            hour_by_lens=hour_by_lens,
        )

    def after(self, sight: searching.Sight, hint: Hint) -> searching.Sight:
        """The sight of a frame that was not identified, if it looks where an earlier one did; else as it was."""
        if self.tilts is None or not sight.solution.lost or self.instruments.sought:
            return sight
        solver = self.solver(sight.stars)
        answer = solver.solve(sight.stars, self.tilts, known=hint)
        if answer.found is None:
            return sight
        if self.places is not None:
            answer = placed(solver, sight.stars, answer, self.places)
        return replace(sight, solution=answer)

    def fitting(self, lost: Stars) -> str:
        """Say which focal length fits a frame that was not identified with the given one; '' if none is known."""
        instrument = self.instruments.of(lost)
        # without its header's focal length a frame was searched already
        if instrument is None or self.instruments.by_header:
            return ""
        focal_px = searching.focal_px_that_fits(self.solver(lost), lost)
        return "" if focal_px is None else searching.other_focal_length(lost.place, focal_px)


def identify(
    frame: str | Path | Frame | Stars,
    instrument: Instrument | str | Path | None = None,
    *,
    search_s: float = SEARCH_S,
    progress: Progress = quiet,
) -> Solution:
    """Where a frame looks, from its stars alone, lost in space.

    Parameters
    ----------
    frame : path of a frame (FITS, TIFF, PNG, JPEG, HEIF, camera raw) or of a list of stars; or a Frame, or Stars
    instrument : an Instrument, or the path of its file (YAML); None: the focal length is taken from the frame's header as
        a hint, and without one all scales are searched
    search_s : CPU time in s of the search at every scale
    progress : is called with the share of long work that is done

    Returns
    -------
    Solution
        `attitude` has right ascension, declination and roll of the frame's centre in rad, `names` the stars; `ok` is
        False where nothing was identified, and `message` says why

    Raises
    ------
    FrameError
        the file cannot be read

    Examples
    --------
    >>> found = starpos.identify("night/stars_0000.csv")
    >>> found.ok, len(found.names) > 10
    (True, True)
    """
    item = read_frame(frame) if isinstance(frame, (str, Path)) else frame
    known = instrument_file.read(instrument) if isinstance(instrument, (str, Path)) else instrument
    given = Instruments(known, by_header=known is None)
    return Solving(given, search_s=search_s, progress=progress)(item).solution


def prepare(given: Instruments, about: Stars, progress: Progress = quiet) -> str:
    """Put the tables of a field, or of any, into the cache, for all processes; a sentence on what the catalogue lacks."""
    stars = catalogue.load_catalogue()
    if given.instrument is None or given.sought:
        BlindSolver(stars, progress).prepare()
        return ""
    # the frames report the error
    with suppress(StarposError):
        solver = Solver(given.instrument, stars, progress=progress)
        return solver.prepare(about.width, about.height, about.origin_px)
    return ""
