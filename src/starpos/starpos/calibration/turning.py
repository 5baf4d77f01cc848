# SPDX-License-Identifier: Apache-2.0
"""Calibration by turning on the spot: place, heading and A3 from frames at several headings."""

from collections.abc import Sequence

import numpy as np

from starpos.calibration.misalignment import NOTHING_KNOWN, Calibrated, Known, calibrate
from starpos.calibration.plumb_fit import PlumbLine
from starpos.calibration.plumb_line import level
from starpos.calibration.readings import Readings
from starpos.fix.fix import Fix
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument.tilts import Tilts
from starpos.progress import Progress, quiet


def turn(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    tilts: Tilts,
    turn_stddev_deg: float = 180.0,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """A3, and fixes, from frames of one place at several headings; the solver's A3 need not be near.

    known: the stars of frames, by the frames' numbers, that only a longer search identifies than the solver's.
    turn_stddev_deg: sigma of the turn of the solver's A3 about the plumb line; it matters if the axis of the turn leans.
    The `average` of the fixes is the place; its covariance says how well the headings separate it from A3.  With fewer
    than two fixes A3 stays as it was.
    Raises FixError if the instrument leans and the headings leave two places, or if the frames have no common zenith.
    """

    def find(readings: Readings, a3: np.ndarray, fixes: list[Fix]) -> PlumbLine:
        return level(readings, a3, np.radians(turn_stddev_deg))

    return calibrate(solver, frames, tilts, find, fewest=2, progress=progress, known=known)
