# SPDX-License-Identifier: Apache-2.0
"""Circles of equal altitude: where on the Earth a direction has the elevation that one frame and its level show."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos import rotation
from starpos.earth.orientation import EarthState
from starpos.earth.refraction import MIN_COS_ZENITH
from starpos.errors import FixError
from starpos.fix.budget import Circumstances, tilt_terms
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.tables import Pointing
from starpos.frozen import at_once
from starpos.instrument.inclinometer import Tilt

# so near the zenith a direction has hardly an elevation to speak of
MIN_SINE = 0.01


@at_once
@dataclass(frozen=True, kw_only=True)
class Circle:
    """A circle of equal altitude.

    itrs (3,): geocentric apparent direction of what is seen along ray (3,) in C.  parallax: its equatorial horizontal
    parallax, rad.
    zenith_distance (rad): as it is without refraction.
    sigma (rad): of the direction, across the circle.  terms: errors of the zenith distance, with factors (1, m) in rad.
    clock_stddev_s, stamp_stddev_s: as in a fix.
    instead: the same disc as the Moon's, which it may be as well; None where it cannot be.
    up (3,): in S, as the inclinometer shows it; axes: their number, 2 or 3.
    """

    utc_unix_s: float
    itrs: np.ndarray
    ray: np.ndarray
    up: np.ndarray
    axes: int
    zenith_distance: float
    sigma: float
    terms: tuple[ErrorTerm, ...]
    earth: EarthState
    clock_stddev_s: float
    stamp_stddev_s: float
    parallax: float = 0.0
    instead: "Circle | None" = None


def circle_of(pointing: Pointing, tilt: Tilt, about: Circumstances) -> Circle:
    """The circle of one frame's centre; FixError if its direction does not determine an altitude."""
    itrs = about.earth.to_itrs(rotation.unit_vector([pointing.ra], [pointing.dec]))[0]
    return circle_along(about.camera.centre_ray, itrs, pointing.place, tilt, about, sigma=pointing.sigma)


def circle_along(
    ray: np.ndarray, itrs: np.ndarray, place: str, tilt: Tilt, about: Circumstances, **known: Any
) -> Circle:
    """The circle of what is seen along a ray (3,) in C and stands at itrs (3,); known: further fields of the Circle.

    place: the frame's name, for messages.
    """
    instrument, atmosphere, earth = about.instrument, about.atmosphere, about.earth
    level = instrument.level(tilt)
    seen = level.camera @ ray
    sine = np.hypot(seen[0], seen[1])
    if sine < MIN_SINE or seen[2] < MIN_COS_ZENITH:
        raise FixError(
            f"{place}: the camera looks {np.degrees(np.arctan2(sine, seen[2])):.1f} deg from the "
            f"zenith; an elevation determines a place only between 0.6 and 87: lean it"
        )
    # up that errs by a small rotation of L lies nearer to the axis, or further
    rows = np.array([[-seen[1], seen[0], 0.0]]) / sine
    terms = tilt_terms(rows, level, tilt, instrument, earth.utc_unix_s)
    true = atmosphere.refraction().unbend(seen)
    z = float(np.arctan2(np.hypot(true[0], true[1]), true[2]))
    bent = (z - np.arctan2(sine, seen[2])) * atmosphere.relative_sigma
    return Circle(
        utc_unix_s=earth.utc_unix_s,
        itrs=itrs,
        ray=ray,
        up=level.up,
        axes=tilt.axes,
        zenith_distance=z,
        terms=(*terms, ErrorTerm("refraction", np.array([[bent]]), shared=ALWAYS)),
        earth=earth,
        clock_stddev_s=about.clock_stddev_s,
        stamp_stddev_s=about.stamp_stddev_s,
        **known,
    )
