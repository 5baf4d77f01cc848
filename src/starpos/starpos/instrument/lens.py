# SPDX-License-Identifier: Apache-2.0
"""ROS's lens models by name: `plumb_bob` and `rational_polynomial` for a pinhole, `equidistant` for a fisheye.

The code is in `_lens`.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from starpos.errors import InstrumentError
from starpos.instrument._lens import Equidistant, Lens, PlumbBob

# ROS's names of the models that are understood, and the names of their coefficients.
PLUMB_BOB, EQUIDISTANT, RATIONAL = "plumb_bob", "equidistant", "rational_polynomial"
COEFFICIENTS = {
    PLUMB_BOB: ("k1", "k2", "p1", "p2", "k3"),
    EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
# numbers of a pinhole's coefficients in OpenCV: 12 and 14 include a thin prism and a tilted sensor
OPENCV_NUMBERS = (0, 4, 5, 8, 12, 14)


def lens_of(model: str, d: tuple[float, ...]) -> Lens:
    """The lens of a model with its coefficients."""
    return Equidistant(d, _reach(d)) if model == EQUIDISTANT else PlumbBob(d)


def stated_lens(model: str, d: Sequence[float], place: str) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients for a Camera, from a message's or file's as OpenCV and ROS define them.

    A pinhole's coefficients are OpenCV's by their number, under either of the two names. Without a name they are a
    pinhole's. Trailing zeros are ignored.
    InstrumentError where the model is another one or has another number of coefficients.
    """
    model = model or PLUMB_BOB
    if model == EQUIDISTANT and len(d) in (0, 4):
        return model, tuple(d)
    if model in (PLUMB_BOB, RATIONAL) and len(d) in OPENCV_NUMBERS:
        terms = [*d, *[0.0] * 14]
        if not any(terms[8:]):
            pinhole = RATIONAL if any(terms[5:8]) else PLUMB_BOB
            return pinhole, tuple(terms[: len(COEFFICIENTS[pinhole])])
    raise InstrumentError(
        f"{place}: the distortion model is {model[:40]!r} with {len(d)} terms; {PLUMB_BOB!r} and {RATIONAL!r} with 4, 5 "
        f"or 8 and {EQUIDISTANT!r} with 4 are understood (further ones must be 0): calibrate with one of them."
    )


@lru_cache(maxsize=64)
def _reach(d: tuple[float, ...]) -> float:
    """The angle off the axis, rad, out to which a fisheye has a picture; at most pi."""
    # of the slope, by the square of the angle
    roots = np.roots([9 * d[3], 7 * d[2], 5 * d[1], 3 * d[0], 1.0])
    turning = [r.real for r in roots if r.real > 0 and abs(r.imag) < 1e-9 * abs(r)]
    return min(math.sqrt(min(turning, default=math.inf)), math.pi)
