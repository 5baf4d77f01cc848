# SPDX-License-Identifier: Apache-2.0
"""Doubt about a table of tilts: whether its degrees are radians."""

import numpy as np

from starpos.instrument.tilt_log import BRACKET_S, TiltLog, white_noise

# The noise of readings in radians that are taken for degrees is 57.3 times too small. Number of differences that
# determine it, and to which factor.
ENOUGH_STEPS, ALIKE_NOISE = 8, 3.0


def like_radians(log: TiltLog) -> str:
    """Say that a table of tilts looks like radians; '' if it does not.

    The noise shows it: radians taken for degrees have 57 times less than the sensor's.
    """
    order = np.argsort(log.utc_unix_s, kind="stable")
    apart = np.diff(log.utc_unix_s[order])
    every = np.diff(log.theta[order, :2], axis=0)
    sound = (apart > 0) & np.isfinite(every).all(1)
    steps = every[sound & (apart < BRACKET_S)]
    if len(steps) < ENOUGH_STEPS:
        # one reading a frame: an instrument that stands differs from frame to frame by its noise alone
        steps = every[sound]
    if len(steps) < ENOUGH_STEPS or np.nanmax(np.abs(np.degrees(log.theta[:, :2]))) > np.pi / 2:
        return ""
    noise = float(np.degrees(white_noise(steps).mean()))
    stated_rad = float(np.sqrt(np.nanmean(log.variance)))
    if not stated_rad / ALIKE_NOISE < noise < stated_rad * ALIKE_NOISE:
        return ""
    return (
        f"the tilts look like radians: none is above pi/2, and their noise of {noise:.2g} would be the "
        f"inclinometer's ({stated_rad:.2g} rad): write them in deg, or state the inclinometer's noise if it "
        f"is so quiet"
    )
