# SPDX-License-Identifier: Apache-2.0
"""Day or night by a frame: whether it is overexposed or dark, and the exposure that the next one should have."""

import numpy as np

from starpos.frames.frame import Disc, Frame

# pixels that are looked at; the share of the type's largest value from which one is saturated
LOOKED_AT, FULL = 1 << 16, 0.97
# By day this share of a frame is saturated. Of a dark frame all pixels but a share are below a share of full.
OVEREXPOSED, BRIGHTEST, DARK = 0.02, 0.001, 0.05
# One step, which leaves what was dark far below full, and the shortest exposure that is asked for, s.
STEP, SHORTEST_S = 8.0, 1e-5


def next_exposure_s(frame: Frame, disc: Disc | None, longest_s: float) -> float | None:
    """The exposure in s that suits what a frame shows; None to leave it, or if the frame does not state its own.

    disc: what looks like the Sun on it.  longest_s: the night's exposure, which is not exceeded.
    """
    if not frame.exposure_s:
        return None
    limit = FULL * np.iinfo(frame.pixels.dtype).max
    some = frame.pixels.reshape(-1)[:: max(1, frame.pixels.size // LOOKED_AT)]
    full = float(np.mean(some >= limit))
    if disc is not None and disc.sharp:
        # behind a filter all is dark but the disc
        row, column = (
            round(min(max(v, 0), n - 1)) for v, n in ((disc.y, frame.height), (disc.x, frame.width))
        )
        if full <= OVEREXPOSED and np.max(frame.pixels[row, column]) < limit:
            return None
        full = 1.0
    wanted = frame.exposure_s
    if full > OVEREXPOSED:
        wanted = max(wanted / STEP, SHORTEST_S)
    elif disc is None and wanted < longest_s and np.quantile(some, 1 - BRIGHTEST) < DARK * limit:
        wanted = min(wanted * STEP, longest_s)
    return None if wanted == frame.exposure_s else wanted
