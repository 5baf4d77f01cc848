# SPDX-License-Identifier: Apache-2.0
"""The one driver of a night, for command, library and report: it goes through the frames' sights, and answers each.

Frames are solved one by one, or all together: by turning, or compared with GNSS.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from starpos.averaging.poses import mean_attitude
from starpos.calibration.misalignment import Calibrated
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.vertical import Vertical
from starpos.errors import FixError, FrameError, GnssError
from starpos.fix.attitude import heading_of
from starpos.fix.budget import local_north
from starpos.fix.checks import unnamed_inclinometer
from starpos.fix.fix import Fix
from starpos.fix.glows import Glow
from starpos.fix.searching import Sight, of_one_camera
from starpos.fix.solution import Solution
from starpos.fix.solver import Solver, placed
from starpos.frames.tables import Pointing
from starpos.identification.prior import Hint
from starpos.instrument.inclinometer import level_of
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import NO_TILTS, Tilts
from starpos.night.night import Night, Shot, Truth, WatchedNight, why_none
from starpos.night.reading import Each
from starpos.night.remarks import Near
from starpos.night.together import FrameAnswer, Gathered, Together, together, turned
from starpos.night.work import Solving
from starpos.progress import Progress, quiet
from starpos.rotation import half_turns, normalised

if TYPE_CHECKING:
    from starpos.gnss.receiver import GnssTrack
    from starpos.gnss.solving import Watched
    from starpos.gnss.states import Learned

# if readings are further from their median than this, the camera was moved
STILL_SIGMA = 8.0


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """The exposures of a night, and what is asked of each.

    each: goes through all `count` of them with a work.
    remarks: what looks wrong.
    """

    name: str
    origin: str
    count: int
    each: Each
    work: Solving
    vertical: Vertical
    truth: Truth | None = None
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class How:
    """How a night is solved.

    turn_stddev_deg: to find A3 by turning, the sigma of its turn about the plumb line; None to use A3 as given.
    gnss: places of a receiver, which teach the instrument; learned: what they taught on earlier nights.
    """

    turn_stddev_deg: float | None = None
    gnss: "GnssTrack | None" = None
    learned: "Learned | None" = None

    @property
    def one_by_one(self) -> bool:
        """Whether each frame is solved by itself."""
        return self.turn_stddev_deg is None and self.gnss is None

    def work(self, asked: Solving) -> Solving:
        """The work on one frame: all that is asked, or only to identify it, where all are solved together."""
        return asked if self.one_by_one else replace(asked, tilts=None, places=None)


ONE_BY_ONE = How()


@dataclass(frozen=True, eq=False, kw_only=True)
class NightAnswers:
    """The answers of a night: one for each frame, in order, as soon as it is there; then what they come to `together`.

    work: that was asked for; None for pointings.
    instrument: on which they rest; None without a frame.
    given: the instrument whose A3 was used unchanged; None where it was found, or taught by GNSS.
    turned: A3 found by turning.  remarks: on what was found or taught.
    """

    each: Iterable[FrameAnswer]
    work: Solving | None = None
    instrument: Instrument | None = None
    given: Instrument | None = None
    turned: Calibrated | None = None
    watched: WatchedNight | None = None
    remarks: tuple[str, ...] = ()
    _gathered: Gathered = field(default_factory=Gathered)

    def __iter__(self) -> Iterator[FrameAnswer]:
        for answer in self.each:
            self._gathered.gather(answer)
            yield answer

    def together(self, near: Near | None = None) -> Together:
        """What the answers come to, after the last one; near: where the instrument should be."""
        gathered = self._gathered
        whole, mean = together(gathered, self.given, near), None
        said = list(whole.remarks)
        if gathered.fixes and self.watched is not None and self.instrument is not None:
            said.insert(0, unnamed_inclinometer(self.instrument))
        if gathered.headings and self.work is not None and self.work.places is not None:
            try:
                mean = mean_attitude([s.at_place for s in gathered.headings if s.at_place])
            except FixError as error:
                said.append(str(error))
        whole = replace(whole, mean=mean, gathered=gathered)
        if gathered.lost is not None and not (whole.where or gathered.headings) and self.work is not None:
            said.append(self.work.fitting(gathered.lost))
        return replace(whole, remarks=tuple(filter(None, said)))


def answers_of(
    sights: Iterable[tuple[str, Sight | FrameError]],
    asked: Solving,
    vertical: Vertical,
    how: How = ONE_BY_ONE,
    progress: Progress = quiet,
) -> NightAnswers:
    """Answer the frames of a night, by name; sights: what `how.work(asked)` gave of each."""
    if how.one_by_one:
        known = asked.instruments.instrument
        each = _without_lamps(_one_by_one(sights, asked))
        return NightAnswers(each=each, work=asked, instrument=known, given=known)
    rows = list(sights)
    seen = [sight for _, sight in rows if isinstance(sight, Sight)]
    if not seen:
        return NightAnswers(each=_in_order(rows, ()), work=asked)
    first = next((s for s in seen if asked.instruments.of(s.stars) is not None), seen[0])
    solver = replace(asked.solver(first.stars), progress=progress)
    solver, alike = of_one_camera(solver, seen)
    if how.gnss is not None:
        watched = _watched_night(solver, alike, asked.tilts, how.gnss, how.learned, vertical)
        return NightAnswers(
            each=_in_order(rows, ((a.solution, a) for a in watched.answers)),
            work=asked,
            instrument=solver.instrument,
            watched=watched,
            remarks=watched.remarks,
        )
    assert how.turn_stddev_deg is not None
    found, said = turned(solver, alike, asked.tilts or NO_TILTS, how.turn_stddev_deg)
    each = _in_order(rows, ((s, None) for s in found.solutions))
    return NightAnswers(each=each, work=asked, instrument=found.instrument, turned=found, remarks=said)


def answers_of_pointings(
    solver: Solver, pointings: Sequence[Pointing], tilts: Tilts, turn_stddev_deg: float | None = None
) -> NightAnswers:
    """Answer pointings, some of which have a roll; turn_stddev_deg: as of `How`."""
    if turn_stddev_deg is None:
        each = (FrameAnswer(p.source, solver.solve_pointing(p, tilts)) for p in pointings)
        return NightAnswers(each=each, given=solver.instrument)
    found, said = turned(solver, [p for p in pointings if p.has_roll], tilts, turn_stddev_deg)
    following = iter(found.solutions)
    solutions = (next(following) if p.has_roll else solver.solve_pointing(p) for p in pointings)
    each = (FrameAnswer(p.source, s) for p, s in zip(pointings, solutions, strict=True))
    return NightAnswers(each=each, turned=found, remarks=said)


def _one_by_one(sights: Iterable[tuple[str, Sight | FrameError]], asked: Solving) -> Iterator[FrameAnswer]:
    """The answers as they come; a frame that was not identified is looked for where the last one looked."""
    hint: Hint | None = None
    for name, sight in sights:
        if isinstance(sight, FrameError):
            yield FrameAnswer.unreadable(name, sight)
            continue
        if hint is not None:
            sight = asked.after(sight, hint)
        hint = sight.solution.hint or hint
        yield FrameAnswer(name, sight.solution, sight.stars)


def _without_lamps(answers: Iterable[FrameAnswer]) -> Iterator[FrameAnswer]:
    """The answers, of which one by a glow is held back until a later glow shows that it moves with the Sun.

    A glow that stands still meanwhile is a lamp's, and those before it too.  One that is not seen to move has no answer.
    """
    held: list[FrameAnswer] = []
    lamp: Glow | None = None
    proven = False
    for answer in answers:
        glow = answer.solution.glow
        before = [a.solution.glow for a in held if a.solution.glow is not None]
        first = lamp or next(iter(before), None)
        stood = [] if glow is None or first is None else [g.stood_still(glow) for g in (first, *before[-1:])]
        still = next((s for s in stood if s is not None), None)
        if still and glow is not None and first is not None:
            lamp = first
            for a in held:
                yield replace(a, solution=a.solution.as_lamp(glow.utc_unix_s))
            held = []
            yield replace(answer, solution=answer.solution.as_lamp(first.utc_unix_s))
        elif still is False:
            yield from held
            held, lamp, proven = [answer], None, True
        elif glow is None and not held:
            yield answer
        else:
            held.append(answer)
    for answer in held:
        yield replace(answer, solution=answer.solution if proven else answer.solution.unproven())


def _in_order(
    rows: Iterable[tuple[str, Sight | FrameError]], answers: Iterable[tuple[Solution, "Watched | None"]]
) -> Iterator[FrameAnswer]:
    """The answer to each frame; answers: to those that can be read, in order, and how they compare with GNSS."""
    following = iter(answers)
    for name, sight in rows:
        if isinstance(sight, FrameError):
            yield FrameAnswer.unreadable(name, sight)
            continue
        solution, watched = next(following)
        # a header's wrong focal length was noticed when the frame was identified
        solution = replace(solution, remark=solution.remark or sight.solution.remark)
        yield FrameAnswer(name, solution, sight.stars, watched)


def _watched_night(
    solver: Solver,
    sights: Sequence[Sight],
    tilts: Tilts | None,
    track: "GnssTrack",
    before: "Learned | None",
    vertical: Vertical,
) -> WatchedNight:
    """Solve a night's frames, which are identified already, in the order of their times.

    tilts: None where headings alone are wanted.  before: what earlier nights learned of the instrument.
    """
    from starpos.gnss.solving import watched
    from starpos.gnss.watch import GnssWatch

    watch = GnssWatch(solver.instrument, vertical, before)
    said: Counter[str] = Counter()
    answers: dict[int, Watched] = {}
    for k in sorted(range(len(sights)), key=lambda k: sights[k].stars.mid_unix_s or 0.0):
        stars, rough, gnss = sights[k].stars, sights[k].solution, None
        if stars.mid_unix_s is not None:
            try:
                gnss = track.at(stars.mid_unix_s)
            except GnssError as error:
                said[str(error)] += 1
        if rough.found is not None and tilts is not None:
            solved = solver.solve(stars, tilts, known=rough.found)
            refused = replace(rough, status=solved.status, message=solved.message)
            rough = refused if solved.found is None else solved
        if gnss is not None:
            rough = placed(solver, stars, rough, gnss.deflected(vertical))
        answers[k] = watched(solver, stars, rough, gnss, watch)
    remarks = tuple(f"{number} frames: {why}" for why, number in said.items())
    return WatchedNight(tuple(answers[k] for k in range(len(sights))), watch.learned, remarks)


def solved_night(exposures: Exposures, how: How = ONE_BY_ONE, progress: Progress = quiet) -> Night:
    """The night of these exposures; raises InstrumentError if there is no instrument for a frame."""
    work = replace(exposures.work, progress=progress)
    answers = answers_of(exposures.each(how.work(work)), work, exposures.vertical, how, progress)
    shots, of_frames = [], []
    for done, answer in enumerate(answers, 1):
        shots.append(Shot.of(answer.name, answer.solution, answer.stars))
        of_frames.append(answer.solution.remark)
        progress(exposures.name[:20], done / exposures.count)
    whole = answers.together()
    return Night(
        name=exposures.name,
        origin=exposures.origin,
        shots=shots,
        combined=whole.average,
        why_not=whole.why_not or ("" if whole.average else why_none(shots)),
        vertical=exposures.vertical,
        atmosphere=exposures.work.atmosphere,
        truth=exposures.truth,
        steady=_steady(shots, answers.instrument) if whole.average and answers.instrument else None,
        watched=answers.watched,
        remarks=(*exposures.remarks, *answers.remarks, *filter(None, of_frames), *whole.remarks),
    )


def _steady(shots: Sequence[Shot], instrument: Instrument) -> np.ndarray | None:
    """Places (N, 3) for Night.steady, each with the mean tilt of the night; None if the camera was moved."""
    tilts = np.array([s.tilt for s in shots if s.place])
    headings = np.array([s.place.heading for s in shots if s.place])
    own = np.array([s.place.own for s in shots if s.place])
    attitudes = [s.camera_to_itrs for s in shots if s.camera_to_itrs is not None]
    moved = np.abs(tilts - np.median(tilts, axis=0)).max() * EARTH_RADIUS_M
    noise = np.sqrt(np.median(np.trace(own[:, :2, :2], axis1=1, axis2=2) / 2))
    turned = np.abs(half_turns(headings - headings[0])).max()
    if len(tilts) < 3 or moved > STILL_SIGMA * noise + 1.0 or turned > np.radians(1.0):
        return None
    # not by two angles, of which a sensor that hangs has the same as one that stands
    up = np.mean([s.place.tilt.up for s in shots if isinstance(s.place, Fix)], axis=0)
    g = level_of(normalised(up)) @ instrument.calibration.a3
    steady = []
    for camera_to_itrs in attitudes:
        place = local_north(g @ camera_to_itrs.T)
        link_to_enu = place.local_to_enu @ g @ instrument.link_to_camera
        steady.append((place.latitude, place.longitude, heading_of(link_to_enu)))
    return np.array(steady)
