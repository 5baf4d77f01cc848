# SPDX-License-Identifier: Apache-2.0
"""Turning on the spot: place, heading and the angle between camera and plumb line from frames at several headings."""

from collections.abc import Callable, Sequence

from starpos.calibration import Calibrated, calibrate
from starpos.inclinometer import Tilt
from starpos.plumb import level
from starpos.progress import Progress, quiet
from starpos.solve import Solver
from starpos.stars import Stars


def turn(
    solver: Solver,
    frames: Sequence[Stars],
    tilt: Callable[[float, float], Tilt],
    progress: Progress = quiet,
) -> Calibrated:
    """A3 and the place of frames of one place at several headings; the solver's A3 need not be near.

    tilt: of (mid_unix_s, exposure_s).  From fewer than two fixes A3 stays what it was.  The `average` of the fixes is the
    place, and its covariance says how well the headings tell it and A3 apart.  FixError where the instrument leans and
    the headings do not tell which way, or the frames have no one zenith.
    """
    return calibrate(
        solver, frames, tilt, lambda readings, a3, _: level(readings, a3), fewest=2, progress=progress
    )
