# SPDX-License-Identifier: Apache-2.0
"""The one driver of a night, for command, library and report: it goes through the frames' sights, and answers each.

Frames are solved one by one, or all together: by turning, or compared with GNSS.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError
from starpos.fix.attitude import heading_of
from starpos.fix.budget import local_north
from starpos.fix.fix import Fix
from starpos.fix.glows import Glow
from starpos.fix.searching import Sight, of_one_camera
from starpos.frames.frame import Frame, Stars
from starpos.identification.prior import Hint
from starpos.instrument.inclinometer import level_of
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import NO_TILTS
from starpos.night.night import Night, Shot, Truth, why_none
from starpos.night.together import FrameAnswer, Gathered, TurnedNight, together, turned
from starpos.night.work import Solving
from starpos.progress import Progress, quiet
from starpos.rotation import half_turns, normalised

if TYPE_CHECKING:
    from starpos.gnss.receiver import GnssTrack
    from starpos.gnss.states import Learned
    from starpos.night.beside_gnss import WatchedNight

# if readings are further from their median than this, the camera was moved
STILL_SIGMA = 8.0

# the names of frames, and what a work made of each, or why it cannot be read
Worked = Iterator[tuple[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """The exposures of a night, and what is asked of each.

    each: goes through all `count` of them with a work.
    remarks: what looks wrong.
    """

    name: str
    origin: str
    count: int
    each: Callable[[Callable[[Frame | Stars], Any]], Worked]
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


@dataclass(frozen=True, eq=False)
class NightAnswers:
    """The answers of a night; each: one for each frame, in order, as soon as it is there.

    instrument: on which they rest; None without a frame.
    given: the instrument whose A3 was used unchanged; None where it was found, or taught by GNSS.
    """

    each: Iterable[FrameAnswer]
    instrument: Instrument | None = None
    given: Instrument | None = None
    turned: TurnedNight | None = None
    watched: "WatchedNight | None" = None


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
        return NightAnswers(_without_lamps(_one_by_one(sights, asked)), known, known)
    rows = list(sights)
    seen = [sight for _, sight in rows if isinstance(sight, Sight)]
    if not seen:
        return NightAnswers(_in_order(rows, ()))
    first = next((s for s in seen if asked.instruments.of(s.stars) is not None), seen[0])
    solver = replace(asked.solver(first.stars), progress=progress)
    solver, alike = of_one_camera(solver, seen)
    if how.gnss is not None:
        from starpos.night.beside_gnss import watched_night

        watched = watched_night(solver, alike, asked.tilts, how.gnss, how.learned, vertical)
        answers = [
            FrameAnswer("", a.solution, s.stars, a) for a, s in zip(watched.answers, alike, strict=True)
        ]
        return NightAnswers(_in_order(rows, answers), solver.instrument, watched=watched)
    assert how.turn_stddev_deg is not None
    found = turned(solver, alike, asked.tilts or NO_TILTS, how.turn_stddev_deg)
    answers = [FrameAnswer("", a, s.stars) for a, s in zip(found.solutions, alike, strict=True)]
    instrument = solver.instrument if found.calibrated is None else found.calibrated.instrument
    return NightAnswers(_in_order(rows, answers), instrument, turned=found)


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
        if glow is None:
            held.append(answer)
        else:
            before = [a.solution.glow for a in held if a.solution.glow is not None]
            first = lamp or next(iter(before), None)
            stood = [g.stood_still(glow) for g in ([first, *before[-1:]] if first else [])]
            still = next((s for s in stood if s is not None), None)
            if still and first is not None:
                lamp = first
                answer = replace(answer, solution=answer.solution.as_lamp(first.utc_unix_s))
                held = [replace(a, solution=a.solution.as_lamp(glow.utc_unix_s)) for a in held]
            elif still is False:
                yield from held
                held, lamp, proven = [], None, True
            held.append(answer)
        if lamp is not None or all(a.solution.glow is None for a in held):
            yield from held
            held = []
    for answer in held:
        yield replace(answer, solution=answer.solution if proven else answer.solution.unproven())


def _in_order(
    rows: Iterable[tuple[str, Sight | FrameError]], answers: Iterable[FrameAnswer]
) -> Iterator[FrameAnswer]:
    """The answer to each frame; answers: to those that can be read, in order."""
    following = iter(answers)
    for name, sight in rows:
        if isinstance(sight, FrameError):
            yield FrameAnswer.unreadable(name, sight)
            continue
        answer = replace(next(following), name=name)
        # a header's wrong focal length was noticed when the frame was identified
        remark = answer.solution.remark or sight.solution.remark
        yield replace(answer, solution=replace(answer.solution, remark=remark))


def solved_night(exposures: Exposures, how: How = ONE_BY_ONE, progress: Progress = quiet) -> Night:
    """The night of these exposures; raises InstrumentError if there is no instrument for a frame."""
    work = replace(exposures.work, progress=progress)
    answers = answers_of(exposures.each(how.work(work)), work, exposures.vertical, how, progress)
    shots, of_frames, gathered = [], [], Gathered()
    for done, answer in enumerate(answers.each, 1):
        gathered.gather(answer)
        shots.append(Shot.of(answer.name, answer.solution, answer.stars))
        of_frames.append(answer.solution.remark)
        progress(exposures.name[:20], done / exposures.count)
    whole = together(gathered, answers.given)
    said = [
        remark for part in (answers.turned, answers.watched) if part is not None for remark in part.remarks
    ]
    if gathered.lost is not None and not gathered.solved:
        of_frames.append(work.fitting(gathered.lost))
    night = Night(
        name=exposures.name,
        origin=exposures.origin,
        shots=shots,
        combined=whole.average,
        why_not=whole.why_not if gathered.solved or gathered.circles else why_none(shots),
        vertical=exposures.vertical,
        atmosphere=exposures.work.atmosphere,
        truth=exposures.truth,
        watched=answers.watched,
        remarks=(*exposures.remarks, *said, *filter(None, of_frames), *whole.remarks),
    )
    if night.combined is None or answers.instrument is None:
        return night
    return replace(night, steady=_steady(night, answers.instrument))


def _steady(night: Night, instrument: Instrument) -> np.ndarray | None:
    """Places (N, 3) for Night.steady, each with the mean tilt of the night; None if the camera was moved."""
    tilts = np.array([s.tilt for _, s in night.fixed])
    headings = np.array([p.heading for p in night.places])
    own = np.array([p.own for p in night.places])
    attitudes = [s.camera_to_itrs for _, s in night.fixed if s.camera_to_itrs is not None]
    moved = np.abs(tilts - np.median(tilts, axis=0)).max() * EARTH_RADIUS_M
    noise = np.sqrt(np.median(np.trace(own[:, :2, :2], axis1=1, axis2=2) / 2))
    turned = np.abs(half_turns(headings - headings[0])).max()
    if len(tilts) < 3 or moved > STILL_SIGMA * noise + 1.0 or turned > np.radians(1.0):
        return None
    # not by two angles, of which a sensor that hangs has the same as one that stands
    up = np.mean([p.tilt.up for p in night.places if isinstance(p, Fix)], axis=0)
    g = level_of(normalised(up)) @ instrument.mounting.a3
    steady = []
    for camera_to_itrs in attitudes:
        place = local_north(g @ camera_to_itrs.T)
        link_to_enu = place.local_to_enu @ g @ instrument.mounting.link_to_camera
        steady.append((place.latitude, place.longitude, heading_of(link_to_enu)))
    return np.array(steady)
