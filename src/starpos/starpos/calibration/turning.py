# SPDX-License-Identifier: Apache-2.0
"""Turning on the spot: place, heading and the angle between camera and plumb line from frames at several headings."""

from collections.abc import Callable, Sequence

import numpy as np

from starpos.calibration.misalignment import Calibrated, calibrate
from starpos.calibration.plumb_line import PlumbLine, Readings, level
from starpos.fix.solver import Solver
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.progress import Progress, quiet


def turn(
    solver: Solver,
    frames: Sequence[Stars],
    tilt: Callable[[float, float], Tilt],
    turn_stddev_deg: float = 180.0,
    progress: Progress = quiet,
) -> Calibrated:
    """A3 and the place of frames of one place at several headings; the solver's A3 need not be near.

    tilt: of (mid_unix_s, exposure_s).  From fewer than two fixes A3 stays what it was.  The `average` of the fixes is the
    place, and its covariance says how well the headings tell it and A3 apart.  turn_stddev_deg: how well the solver's A3
    has its turn about the plumb line; it matters as far as the axis of the turn leans.  FixError where the instrument
    leans and the headings leave two places, or the frames have no one zenith.
    """

    def find(readings: Readings, a3: np.ndarray, _) -> PlumbLine:
        return level(readings, a3, np.radians(turn_stddev_deg))

    return calibrate(solver, frames, tilt, find, fewest=2, progress=progress)
