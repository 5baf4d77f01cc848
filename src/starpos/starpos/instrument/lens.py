# SPDX-License-Identifier: Apache-2.0
"""ROS's lens models by name: `plumb_bob` of a pinhole, `equidistant` of a fisheye; the code is in `_lens`."""

import math
from functools import lru_cache

import numpy as np

from starpos.instrument._lens import Equidistant, Lens, PlumbBob

# ROS's names of the models that are understood, and the names of their coefficients.
PLUMB_BOB, EQUIDISTANT = "plumb_bob", "equidistant"
COEFFICIENTS = {PLUMB_BOB: ("k1", "k2", "p1", "p2", "k3"), EQUIDISTANT: ("k1", "k2", "k3", "k4")}


def lens_of(model: str, d: tuple[float, ...]) -> Lens:
    """The lens of a model with its coefficients."""
    return PlumbBob(d) if model == PLUMB_BOB else Equidistant(d, _reach(d))


@lru_cache(maxsize=64)
def _reach(d: tuple[float, ...]) -> float:
    """The angle off the axis, rad, out to which a fisheye has a picture; at most pi."""
    # of the slope, by the square of the angle
    roots = np.roots([9 * d[3], 7 * d[2], 5 * d[1], 3 * d[0], 1.0])
    turning = [r.real for r in roots if r.real > 0 and abs(r.imag) < 1e-9 * abs(r)]
    return min(math.sqrt(min(turning, default=math.inf)), math.pi)
