# SPDX-License-Identifier: Apache-2.0
"""Goes through a night: solves each frame, or all of them by turning, and makes a Night of the answers."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, StarposError
from starpos.fix.budget import heading_of, local_north
from starpos.fix.searching import Sight, of_one_camera
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.frame import Frame, Stars
from starpos.identification.prior import Hint
from starpos.instrument.inclinometer import level_of, up_of
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import NO_TILTS
from starpos.night.night import Night, ReportedPlace, Shot, Truth, why_none
from starpos.night.remarks import Kind, Remark
from starpos.night.together import (
    Receiver,
    Solved,
    TurnedNight,
    WatchedNight,
    together,
    turned,
    watched_night,
)
from starpos.night.work import Fitting, Identifying, Solving
from starpos.progress import Progress, quiet
from starpos.rotation import half_turns

# if readings are further from their median than this, the camera was moved
STILL_SIGMA = 8.0


@dataclass(frozen=True, kw_only=True)
class Exposures:
    """The exposures of a night: each call of `each` goes through all `count` of them, by name, or why one has no stars.

    remarks: what looks wrong.
    """

    name: str
    origin: str
    count: int
    each: Callable[[], Iterator[tuple[str, Frame | Stars | FrameError]]]
    work: Solving
    vertical: Vertical
    truth: Truth | None = None
    remarks: tuple[Remark, ...] = ()


# the name of a frame, its stars, None if it cannot be read, and its solution
_Answer = tuple[str, Stars | None, Solution]


def solved_night(
    exposures: Exposures,
    turn_stddev_deg: float | None = None,
    progress: Progress = quiet,
    receiver: Receiver | None = None,
) -> Night:
    """The night of these exposures; raises InstrumentError if there is no instrument for a frame.

    turn_stddev_deg: to calibrate by turning, the sigma of A3's turn; None to use A3 as given.
    receiver: GNSS, which teaches the instrument; None without one.
    """
    answers: Iterable[_Answer]
    said: tuple[Remark, ...] = ()
    watched: WatchedNight | None = None
    if receiver is not None:
        answers, watched, instrument = _beside(exposures, receiver, progress)
        said = watched.remarks
    elif turn_stddev_deg is None:
        answers, instrument = _one_by_one(exposures, progress), exposures.work.instruments.instrument
    else:
        answers, said, instrument = _by_turning(exposures, turn_stddev_deg, progress)
    shots, solved, of_frames = [], [], []
    lost: Stars | None = None
    for done, (name, stars, solution) in enumerate(answers, 1):
        shots.append(Shot.of(name, solution, stars))
        if solution.remark:
            of_frames.append(Remark(Kind.FOCAL_LENGTH, solution.remark))
        if solution.fix:
            solved.append(Solved.of(solution, solution.fix))
        elif solution.status is Status.NOT_IDENTIFIED:
            lost = stars if lost is None else lost
        progress(exposures.name[:20], done / exposures.count)
    as_given = turn_stddev_deg is None and receiver is None
    whole = together(solved, exposures.work.instruments.instrument if as_given else None)
    fits = Fitting(exposures.work.instruments)(lost) if lost is not None and not solved else ()
    night = Night(
        name=exposures.name,
        origin=exposures.origin,
        shots=shots,
        combined=None if whole.average is None else ReportedPlace.of(whole.average),
        why_not=whole.why_not if solved else why_none(shots),
        vertical=exposures.vertical,
        atmosphere=exposures.work.atmosphere,
        truth=exposures.truth,
        watched=watched,
        remarks=(*exposures.remarks, *said, *of_frames, *fits, *whole.remarks),
    )
    return replace(night, steady=_steady(night, instrument)) if night.combined and instrument else night


def _one_by_one(exposures: Exposures, progress: Progress) -> Iterator[_Answer]:
    """Solve each frame by itself."""
    hint: Hint | None = None
    prepared: set[tuple[int, int]] = set()
    for name, item in exposures.each():
        if isinstance(item, FrameError):
            yield name, None, Solution.unreadable(name, item)
            continue
        size = item.width, item.height
        # otherwise the time of the first frame would include the building of the triangles
        if size not in prepared:
            prepared.add(size)
            # the frame itself reports an error
            with suppress(StarposError):
                replace(exposures.work.solver(item), progress=progress).prepare(*size)
        sight = exposures.work.sight(item, hint)
        hint = sight.solution.hint or hint
        yield name, sight.stars, sight.solution


def _by_turning(
    exposures: Exposures, turn_stddev_deg: float, progress: Progress
) -> tuple[list[_Answer], tuple[Remark, ...], Instrument | None]:
    """Solve all frames together, with the A3 that they determine; returns that instrument too, None without a frame."""
    rows, solver = _identified(exposures, progress)
    found, instrument = TurnedNight(()), None
    if solver is not None:
        solver, sights = of_one_camera(solver, [s for _, s in rows if isinstance(s, Sight)])
        found = turned(solver, sights, exposures.work.tilts or NO_TILTS, turn_stddev_deg)
        instrument = solver.instrument if found.calibrated is None else found.calibrated.instrument
    return _answers(rows, found.solutions), found.remarks, instrument


def _beside(
    exposures: Exposures, receiver: Receiver, progress: Progress
) -> tuple[list[_Answer], WatchedNight, Instrument | None]:
    """Solve the frames in the order of their times, each with what GNSS taught before it."""
    rows, solver = _identified(exposures, progress)
    night = WatchedNight((), receiver.learned, ())
    if solver is not None:
        solver, sights = of_one_camera(solver, [s for _, s in rows if isinstance(s, Sight)])
        night = watched_night(solver, sights, exposures.work.tilts, receiver, exposures.vertical)
    return (
        _answers(rows, [told.solution for told in night.answers]),
        night,
        None if solver is None else solver.instrument,
    )


_Rows = list[tuple[str, Sight | FrameError]]


def _identified(exposures: Exposures, progress: Progress) -> tuple[_Rows, Solver | None]:
    """The sight of each frame, and the solver of the first that can be read, None without one."""
    work, solver = exposures.work, None
    rows: _Rows = []
    for name, item in exposures.each():
        if isinstance(item, FrameError):
            rows.append((name, item))
            continue
        solver = solver or replace(work.solver(item), progress=progress)
        rows.append((name, Identifying(work.instruments, progress=progress)(item)[0]))
    return rows, solver


def _answers(rows: _Rows, solutions: Iterable[Solution]) -> list[_Answer]:
    """The answer to each frame; solutions: of those that can be read, in order."""
    following = iter(solutions)
    return [
        (name, None, Solution.unreadable(name, s))
        if isinstance(s, FrameError)
        else (name, s.stars, next(following))
        for name, s in rows
    ]


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
    g = level_of(up_of(tilts.mean(0))) @ instrument.mounting.a3
    steady = []
    for camera_to_itrs in attitudes:
        place = local_north(g @ camera_to_itrs.T)
        link_to_enu = place.local_to_enu @ g @ instrument.mounting.link_to_camera
        steady.append((place.latitude, place.longitude, heading_of(link_to_enu)))
    return np.array(steady)
