# SPDX-License-Identifier: Apache-2.0
"""Calibration by headings on the spot: A3 and the place, or why they cannot be found."""

from dataclasses import dataclass

from starpos.averaging.average import Average, Averager, average
from starpos.calibration.misalignment import Calibrated
from starpos.calibration.turning import turn
from starpos.errors import FixError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solver
from starpos.session.memory import Seen, known_of, tilts_of


@dataclass(frozen=True)
class Turned:
    """Result of headings on the spot: A3 and the place."""

    calibrated: Calibrated
    place: Average


def turn_on_the_spot(solver: Solver, poses: list[Seen], turn_stddev_deg: float) -> Turned:
    """Calibrate from poses on the spot; FixError if they give no place, or more than one."""
    calibrated = turn(
        solver, [p.stars for p in poses], tilts_of(poses), turn_stddev_deg, known=known_of(poses)
    )
    if not calibrated.fixes:
        raise FixError(f"no heading has a fix: {calibrated.solutions[0].message}")
    place = average(calibrated.fixes)
    if place.moved:
        raise FixError(
            "the headings are of more than one place: call solver/reset, and turn the instrument on the spot"
        )
    if _newest_is_off(calibrated.fixes):
        raise FixError(
            "the newest heading does not fit the others: the instrument has moved, then call solver/reset, or its tilt "
            "was wrong"
        )
    return Turned(calibrated, place)


def _newest_is_off(fixes: list[Fix]) -> bool:
    averager = Averager()
    before = after = averager.average
    for fix in sorted(fixes, key=lambda f: f.utc_unix_s):
        before = after
        averager.add(fix)
        after = averager.average
    return before is not None and after is not None and after.left_out > before.left_out
