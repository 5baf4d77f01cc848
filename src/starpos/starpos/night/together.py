# SPDX-License-Identifier: Apache-2.0
"""The common result of a night's frames: A3 if they are turned, the average of their fixes, and doubts about it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.averaging.average import Average, average
from starpos.calibration.misalignment import Calibrated
from starpos.calibration.turning import turn
from starpos.errors import FixError
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilts import Tilts
from starpos.night import remarks
from starpos.night.doubts import Levelled, Near, doubts
from starpos.night.remarks import Remark


@dataclass(frozen=True, kw_only=True)
class Solved:
    """The part of a Solution that is needed until the end of a night."""

    fix: Fix
    extrapolated_days: float
    stars_detected: int
    stars_matched: int
    log_odds: float
    tilt: Tilt | None = None

    @classmethod
    def of(cls, s: Solution, fix: Fix) -> "Solved":
        """The part of a solution with a fix."""
        light = replace(fix, used=np.zeros(0, int), residual_px=np.zeros((0, 2)))
        log_odds = s.attitude.log_odds if s.attitude else float("nan")
        return cls(
            fix=light,
            extrapolated_days=s.extrapolated_days,
            stars_detected=s.stars_detected,
            stars_matched=len(s.names),
            log_odds=log_odds,
            tilt=s.tilt,
        )


@dataclass(frozen=True)
class Together:
    """The average of a night's fixes, None if it is missing, as why_not says; and remarks on it."""

    average: Average | None = None
    why_not: str = ""
    remarks: tuple[Remark, ...] = ()


def together(solved: Sequence[Solved], given: Instrument | None, near: Near | None = None) -> Together:
    """Average the fixes of a night, and check them.

    given: the instrument whose A3 was used unchanged; None if A3 was found by turning.
    near: where the instrument should be.
    """
    if not solved:
        return Together()
    whole, why_not = None, ""
    try:
        whole = average([s.fix for s in solved])
    except FixError as error:
        why_not = str(error)
    place = solved[-1].fix if whole is None else whole
    said = list(extrapolated(solved))
    said += [] if whole is None else remarks.of_average(whole)
    mounting = None
    if given is not None:
        said += remarks.of_inclinometer(given)
        said += remarks.of_a3(given.calibration, place)
        if given.vertical is None and not given.calibration.unknown:
            mounting = given.mounting
    frames = [Levelled(s.fix.camera_to_itrs, s.tilt) for s in solved if s.tilt is not None]
    said += doubts(frames, place, mounting, near)
    return Together(whole, why_not, tuple(said))


def extrapolated(solved: Iterable[Solved]) -> tuple[Remark, ...]:
    """Say of the worst fix that it lies beyond the IERS table, if one does."""
    worst = max(solved, key=lambda s: s.extrapolated_days, default=None)
    return () if worst is None else remarks.of_extrapolation(worst.fix, worst.extrapolated_days)


@dataclass(frozen=True)
class TurnedNight:
    """A night whose A3 was found by turning: the solution of each frame, A3, None if it was not found, and remarks."""

    solutions: tuple[Solution, ...]
    calibrated: Calibrated | None = None
    remarks: tuple[Remark, ...] = ()

    @property
    def worth_saving(self) -> bool:
        """Whether the headings determine A3."""
        return self.calibrated is not None and (
            self.calibrated.plumb_stddev_arcsec <= remarks.WORTH_SAVING_ARCSEC
        )


def turned(
    solver: Solver,
    frames: Sequence[tuple[Stars | Pointing, Identification | None]],
    tilts: Tilts,
    turn_stddev_deg: float,
) -> TurnedNight:
    """Find A3 and the fixes of a night's frames, each with its identification so far.

    turn_stddev_deg: sigma of the turn of the solver's A3 about the plumb line.
    """
    items = [frame for frame, _ in frames]
    known = {k: found for k, (_, found) in enumerate(frames) if found is not None}
    try:
        found = turn(solver, items, tilts, turn_stddev_deg, solver.progress, known)
    except FixError as error:
        return TurnedNight(tuple(Solution.failed(item, Status.POOR_FIT, str(error)) for item in items))
    said = tuple(remarks.of_turn(found))
    if any(s.fix is not None for s in found.solutions):
        said += remarks.of_inclinometer(solver.instrument)
    return TurnedNight(found.solutions, found, said)
