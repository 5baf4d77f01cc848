# SPDX-License-Identifier: Apache-2.0
"""Compare the GNSS position with the star fix and never fuse them, so that each can expose an error in the other."""

import numpy as np

from starpos.earth.vertical import Geodetic
from starpos.gnss.place import GnssPlace

# 1 sigma of a fix that states no error, m an axis
UNSTATED_M = 30.0
# places that differ by more, in sigma, contradict each other
SIGMAS = 5.0
# maximum age of a GNSS place in a comparison, s
OLDEST_S = 5.0


def contradiction(gnss: GnssPlace, ground: Geodetic, utc_unix_s: float, speed: float) -> tuple[float, str]:
    """How far GNSS's place lies from ours of a time, m, and a sentence where the two cannot both be right.

    speed: of the vehicle, m/s, which goes on between the two times.
    """
    off = gnss.from_place_m(ground.latitude, ground.longitude)
    on_the_way = speed * (utc_unix_s - gnss.utc_unix_s)
    claim = ground.covariance[:2, :2] + gnss.covariance + np.eye(2) * on_the_way**2
    apart, sigmas = float(np.linalg.norm(off)), float(np.sqrt(off @ np.linalg.solve(claim, off)))
    if sigmas < SIGMAS:
        return apart, ""
    return apart, (
        f"GNSS has a place {apart:.3g} m from here, {sigmas:.2g} times their stated errors: one of them is "
        f"wrong"
    )
