# SPDX-License-Identifier: Apache-2.0
"""The deflection without the tide, at the mark, and at the geoid below it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.gravity import itrs_place
from starpos.earth.tides import plumb_tide
from starpos.earth.vertical import plumb_curvature_arcsec_per_m
from starpos.units import ARCSEC
from starpos.zenith.adjustment import Adjusted
from starpos.zenith.sighting import Mark, ZenithSighting


@dataclass(frozen=True, eq=False, kw_only=True)
class Reduced:
    """A deflection's reductions, arcsec: xi, eta each.

    tide_arcsec (2,): what Moon and Sun added, on the mean of the session.
    curvature_arcsec: what the normal plumb line's curvature between geoid and mark added to xi.
    mark_arcsec, geoid_arcsec (2,): the deflection without the tide, at the mark and at the geoid.
    """

    tide_arcsec: np.ndarray
    curvature_arcsec: float
    mark_arcsec: np.ndarray
    geoid_arcsec: np.ndarray


def reduced(found: Adjusted, sightings: Sequence[ZenithSighting], mark: Mark) -> Reduced:
    """The reductions of a session.

    The mark's height above the ellipsoid stands for that above the geoid: 50 m between them are 0.009 arcsec at most.
    What mountains add to the curvature no formula of the latitude has.
    """
    place = itrs_place(mark.latitude, mark.longitude, mark.height_m)
    t = np.array([s.utc_unix_s for s in sightings])
    number = np.bincount(found.faces)
    middles = np.bincount(found.faces, t) / number
    tides = np.array([plumb_tide(middle, place, mark.enu) for middle in middles.tolist()])
    tide = (number @ tides / number.sum())[::-1] / ARCSEC
    curvature = plumb_curvature_arcsec_per_m(mark.latitude) * mark.height_m
    at_mark = np.array([found.xi_arcsec, found.eta_arcsec]) - tide
    return Reduced(
        tide_arcsec=tide,
        curvature_arcsec=float(curvature),
        mark_arcsec=at_mark,
        geoid_arcsec=at_mark - [curvature, 0.0],
    )
