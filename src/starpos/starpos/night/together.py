# SPDX-License-Identifier: Apache-2.0
"""What a night's frames give together: an average, A3 by turning, a place from elevations; and doubts."""

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.averaging.altitudes import MIN_JUDGED, Directions, place_of_circles, place_of_discs
from starpos.averaging.average import Average, average
from starpos.averaging.elevation_axis import MIN_WITHOUT_SITE, FoundAxis, find_axis
from starpos.averaging.poses import MeanAttitude
from starpos.averaging.sights import SextantSight, circle_of_sight, place_of_sights, read_sights
from starpos.calibration.misalignment import Calibrated, turn
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.errors import FixError, FrameError, StarposError
from starpos.fix.checks import unknown_a3, unnamed_inclinometer
from starpos.fix.circle import Circle, circle_of
from starpos.fix.fix import IDEAL, Fix, PlaceFix
from starpos.fix.searching import Sight
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Stars
from starpos.frames.tables import Pointing
from starpos.instrument.instrument import UNKNOWN_CLOCK_S, Calibration, Instrument
from starpos.instrument.tilt_log import Tilts
from starpos.night import remarks
from starpos.night.remarks import Near, doubts
from starpos.sky.bodies import ERFA, SolarSystem
from starpos.sky.catalogue import load_catalogue

if TYPE_CHECKING:
    from starpos.gnss.solving import Watched

# elevations that have A3's axis further from where it was given, in sigma of both, deny the given one
DENIED_SIGMA = 6.0


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """The answer to a frame of a night.

    stars: that gave it; None for a pointing, and for a file that cannot be read.
    watched: compared with GNSS; None without it.
    """

    name: str
    solution: Solution
    stars: Stars | None = None
    watched: "Watched | None" = None
    readable: bool = True

    @classmethod
    def unreadable(cls, name: str, error: FrameError) -> "FrameAnswer":
        """The answer to a file that holds no frame."""
        return cls(name, Solution.unreadable(name, error), readable=False)


class Gathered:
    """What is needed of a night's answers at its end, gathered one after another.

    solved: those with a fix, without the details of each star; headings: those with a heading at a known place;
    circles: of those that saw the Sun, which serve where nothing is solved; warnings: of all, each once.
    mark, site: of the first with a fix that has one: where GPS put it by its file, and the site of its header.
    lost: the stars of the first frame that was not identified; None without one.
    unreadable: whether a file was.
    """

    def __init__(self) -> None:
        self.solved: list[Solution] = []
        self.mark: Near | None = None
        self.site: Near | None = None
        self.headings: list[Solution] = []
        self.circles: list[Circle] = []
        self.warnings: set[str] = set()
        self.lost: Stars | None = None
        self.unreadable = False

    def gather(self, answer: FrameAnswer) -> None:
        """Keep what is needed of an answer."""
        s = answer.solution
        self.unreadable |= not answer.readable
        self.warnings |= set(s.warnings)
        if s.fix:
            light = replace(s.fix, used=np.zeros(0, int), residual_px=np.zeros((0, 2)))
            self.solved.append(replace(s, fix=light, star=None, found=None, hint=None, at_place=None))
            stars = answer.stars
            if stars is not None and stars.gps_deg is not None and self.mark is None:
                self.mark = Near(*np.radians(stars.gps_deg).tolist())
            if stars is not None and stars.site_deg is not None and self.site is None:
                latitude, longitude = np.radians(stars.site_deg).tolist()
                stated_by = f"the header's {stars.site_cards}"
                self.site = Near(latitude, longitude, stated_by=stated_by, either_sign=True)
        if s.at_place:
            self.headings.append(s)
        if s.circle is not None:
            self.circles.append(s.circle)
        if s.status is Status.NOT_IDENTIFIED and self.lost is None:
            self.lost = answer.stars

    @property
    def fixes(self) -> list[Fix]:
        """The fixes of those with one."""
        return [s.fix for s in self.solved if s.fix is not None]


@dataclass(frozen=True, kw_only=True)
class Together:
    """The average of a night's fixes, None if it is missing, as why_not says; and remarks on it.

    axis: A3's, which elevations determined too; None if A3 was known well enough or they do not determine it.
    mean: attitude at a known place; None without one.  gathered: of the answers; nothing of elevations alone.
    """

    average: Average | None = None
    why_not: str = ""
    remarks: tuple[str, ...] = ()
    axis: FoundAxis | None = None
    mean: MeanAttitude | None = None
    gathered: Gathered = field(default_factory=Gathered)

    @property
    def where(self) -> PlaceFix | None:
        """The average, or else the last fix; None without any."""
        return self.average or next(reversed(self.gathered.fixes), None)

    @classmethod
    def by_circles(cls, place: Average, near: Near | None) -> "Together":
        """The place where circles meet, and what looks wrong with it."""
        said = *remarks.of_average(place), *doubts((), place, None, near)
        return cls(average=place, remarks=tuple(filter(None, said)))


def together(gathered: Gathered, given: Instrument | None, near: Near | None = None) -> Together:
    """Average the fixes of a night, and check them; of a day, find where the Sun's circles meet.

    given: the instrument whose A3 was used unchanged; None if A3 was found by turning.
    near: where the instrument should be.
    """
    fixes = gathered.fixes
    if not fixes:
        return _by_day(gathered.circles, near) if gathered.circles else Together()
    whole, why_not = None, ""
    try:
        whole = average(fixes)
    except FixError as error:
        why_not = str(error)
    place = fixes[-1] if whole is None else whole
    said = [remarks.of_extrapolation(gathered.solved)]
    said += [] if whole is None else remarks.of_average(whole, gathered.solved)
    a3 = None
    if given is not None:
        said += [unnamed_inclinometer(given), unknown_a3(given.calibration, place.covariance, place.terms)]
        if given.vertical is None and not given.calibration.unknown:
            a3 = given.calibration.a3
        said += [] if whole is None else [remarks.of_table(fixes, whole, given)]
        said += [remarks.of_copies(fixes)] if given.has_level_inside else []
    said += [] if gathered.mark is None else [remarks.of_mark(place, gathered.mark)]
    said += doubts(fixes, place, a3, near or gathered.site)
    return Together(average=whole, why_not=why_not, remarks=tuple(filter(None, said)))


def _by_day(circles: Sequence[Circle], near: Near | None) -> Together:
    """The place by the circles of the Sun, or of the Moon."""
    try:
        if Directions.of(circles).wide:
            raise FixError(
                "the Sun's elevations determine a place only where A3 is known to 6 arcmin: find it by night with "
                "starpos calibrate --site"
            )
        place, _ = place_of_discs(circles, None if near is None else near.place)
    except FixError as error:
        return Together(why_not=str(error))
    return Together.by_circles(place, near)


def turned(
    solver: Solver, frames: Sequence[Sight | Pointing], tilts: Tilts, turn_stddev_deg: float
) -> tuple[Calibrated, tuple[str, ...]]:
    """Find A3 and the fixes of a night's frames, which are identified already; and remarks on how well it was found.

    One that was not identified keeps its solution. Where the frames do not agree, nothing is known of the plumb line.
    turn_stddev_deg: sigma of the turn of the solver's A3 about the plumb line.
    """

    def all_of(solved: Iterable[Solution]) -> tuple[Solution, ...]:
        following = iter(solved)
        return tuple(
            f.solution if isinstance(f, Sight) and f.found is None else next(following) for f in frames
        )

    used = [f for f in frames if isinstance(f, Pointing) or f.found is not None]
    items = [f if isinstance(f, Pointing) else f.stars for f in used]
    known = {k: f.found for k, f in enumerate(used) if isinstance(f, Sight) and f.found is not None}
    try:
        found = turn(solver, items, tilts, turn_stddev_deg, solver.progress, known)
    except FixError as error:
        none = all_of(Solution.failed(item, Status.POOR_FIT, str(error)) for item in items)
        return Calibrated(solver.instrument, math.inf, none), ()
    said = list(remarks.of_turn(found))
    if any(s.fix is not None for s in found.solutions):
        said.append(unnamed_inclinometer(solver.instrument))
    return replace(found, solutions=all_of(found.solutions)), tuple(filter(None, said))


def from_elevations(
    solver: Solver,
    pointings: Sequence[Pointing],
    tilts: Tilts,
    near: Near | None = None,
    self_calibrate: bool = False,
) -> tuple[list[Circle | StarposError], Together]:
    """Each pointing's circle, or the error, and their place; A3's axis where it is not known to a few arcmin.

    near: selects between two places that the elevations leave. self_calibrate: treat A3 as unknown.
    """
    if self_calibrate:
        unknown = Calibration.of(solver.instrument.calibration.misalignment_deg)
        solver = replace(solver, instrument=replace(solver.instrument, calibration=unknown))
    circles = circles_of(solver, pointings, tilts)
    sound = [c for c in circles if isinstance(c, Circle)]
    if not sound:
        return circles, Together()
    there, axis = None if near is None else near.place, None
    try:
        directions = Directions.of(sound)
        if self_calibrate or (directions.wide and len(directions.circles) >= MIN_WITHOUT_SITE):
            axis = axis_of(solver, pointings, tilts, there)
            # A3's error is counted from the given A3, or from the one found if none was given
            sound = axis.about(axis.a3 if self_calibrate else solver.instrument.calibration.a3)
        place = place_of_circles(sound, there)
        if axis is not None:
            place = replace(place, left_out=place.left_out + axis.left_out)
        said = (
            *remarks.of_elevations(place),
            unnamed_inclinometer(solver.instrument),
            *doubts((), place, None, near),
        )
        whole = Together(average=place, remarks=tuple(filter(None, said)), axis=axis)
    except FixError as error:
        whole = Together(why_not=str(error), axis=axis)
    if self_calibrate or axis is not None or not remarks.beyond_stated(whole.average):
        return circles, whole
    # residuals beyond the stated errors may come from a wrong A3, which no scatter covers
    given = solver.instrument.calibration
    _, free = from_elevations(solver, pointings, tilts, near, self_calibrate=True)
    if free.axis is None or free.axis.directions < MIN_JUDGED or free.axis.sigma_from(given) < DENIED_SIGMA:
        return circles, whole
    return circles, replace(free, remarks=(remarks.of_denied_a3(free.axis, given), *free.remarks))


def from_sights(
    sights: Sequence[SextantSight],
    atmosphere: Atmosphere,
    clock_stddev_s: float,
    near: Near | None = None,
    ephemeris: SolarSystem = ERFA,
) -> tuple[list[Circle | StarposError], Together]:
    """Each sight's circle, or the error, and their place; near: selects between two places that two sights leave."""
    circles: list[Circle | StarposError] = []
    for sight in sights:
        try:
            circles.append(circle_of_sight(sight, load_catalogue(), atmosphere, clock_stddev_s, ephemeris))
        except StarposError as error:
            circles.append(error)
    sound = [(s, c) for s, c in zip(sights, circles, strict=True) if isinstance(c, Circle)]
    if not sound:
        return circles, Together()
    try:
        used, seen = zip(*sound, strict=True)
        place = place_of_sights(used, seen, None if near is None else near.place)
    except StarposError as error:
        return circles, Together(why_not=str(error))
    return circles, Together.by_circles(place, near)


def sights(
    path: str | Path,
    *,
    atmosphere: Atmosphere | None = None,
    clock_stddev_s: float = UNKNOWN_CLOCK_S,
    near: tuple[float, float] | None = None,
) -> Average:
    """The place by altitudes that were measured by hand, as with a sextant.

    Parameters
    ----------
    path : of the CSV: body, utc, altitude_deg, and what was read off the instrument
    atmosphere : of refraction; None: not measured
    clock_stddev_s : error of the clock, s
    near : latitude, longitude in deg, of which two places that two sights leave the nearer one is taken

    Returns
    -------
    Average
        astronomic latitude and longitude in rad, with their covariance; where the last sight was taken

    Raises
    ------
    FixError
        the sights do not give a place
    FrameError
        the table cannot be used

    Examples
    --------
    >>> air = starpos.Atmosphere(pressure_pa=101_000.0, temperature_c=10.0)
    >>> place = starpos.sights("sights.csv", atmosphere=air, clock_stddev_s=1.0)
    >>> np.degrees([place.latitude, place.longitude]).round(1)
    array([ 41.9, -87.6])
    """
    air = Atmosphere.measured(None, None) if atmosphere is None else atmosphere
    around = None if near is None else Near(*np.radians(near).tolist())
    circles, whole = from_sights(read_sights(path), air, clock_stddev_s, around)
    if whole.average is None:
        raise FixError(whole.why_not or str(circles[0]))
    return whole.average


def axis_of(
    solver: Solver,
    pointings: Sequence[Pointing],
    tilts: Tilts,
    near: tuple[float, float] | None = None,
    site: Place | None = None,
) -> FoundAxis:
    """A3's axis from pointings at a site, or at an unknown place; FixError if they do not determine it."""

    levelled = []
    for pointing in pointings:
        # `circles_of` reports why a pointing has no circle
        with suppress(StarposError):
            levelled.append((pointing, *solver.levelled(pointing, tilts)))

    camera, given = solver.instrument.camera or IDEAL, solver.instrument.calibration

    def with_a3(a3: np.ndarray) -> list[Circle]:
        turned = replace(solver, instrument=replace(solver.instrument, calibration=given.turned_to(a3)))
        circles = []
        for pointing, state, tilt in levelled:
            with suppress(FixError):
                circles.append(circle_of(pointing, tilt, turned.circumstances(pointing, camera, state)))
        return circles

    return find_axis(with_a3, given, camera.centre_ray, site, near)


def circles_of(solver: Solver, pointings: Sequence[Pointing], tilts: Tilts) -> list[Circle | StarposError]:
    """Each pointing's circle, or the error."""
    circles: list[Circle | StarposError] = []
    camera = solver.instrument.camera or IDEAL
    for pointing in pointings:
        try:
            state, tilt = solver.levelled(pointing, tilts)
            circles.append(circle_of(pointing, tilt, solver.circumstances(pointing, camera, state)))
        except StarposError as error:
            circles.append(error)
    return circles
