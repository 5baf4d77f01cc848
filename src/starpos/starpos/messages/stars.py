# SPDX-License-Identifier: Apache-2.0
"""Stars, and the shutter that they were seen through, from a StarArray."""

from typing import Any

import numpy as np

from starpos.errors import FrameError
from starpos.frames.shutter import Shutter
from starpos.frames.stars import Stars
from starpos.messages.stamp import stamp_to_unix

# a detector publishes no more
MAX_STARS = 100_000


def message_to_stars(message: Any, source: str = "stars") -> Stars:
    """Stars from a StarArray; raises FrameError if sizes, values, order or covariances cannot be right."""
    rows = message.stars
    if len(rows) > MAX_STARS:
        raise FrameError(f"{source}: {len(rows)} stars are more than {MAX_STARS}: send the brightest.")
    return Stars(
        x=np.array([s.x for s in rows]),
        y=np.array([s.y for s in rows]),
        flux=np.array([s.flux for s in rows]),
        snr=np.array([s.snr for s in rows]),
        covariance=np.array([s.covariance for s in rows], float).reshape(-1, 2, 2),
        flags=np.array([s.flags for s in rows], np.uint8),
        width=message.width,
        height=message.height,
        mid_unix_s=stamp_to_unix(message.header.stamp),
        exposure_s=message.exposure or None,
        source=source,
        stamp_stddev_s=message.stamp_stddev,
        # older bags do not have it
        clock_stddev_s=getattr(message, "clock_stddev", 0.0),
        shutter=message_to_shutter(message),
    )


def message_to_shutter(message: Any) -> Shutter | None:
    """Shutter stated in a StarArray or a Capture, None if unknown; FrameError if impossible."""
    # older bags do not have it
    if not getattr(message, "shutter_known", False):
        return None
    return Shutter(message.readout, message.readout_stddev)
