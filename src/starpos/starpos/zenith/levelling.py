# SPDX-License-Identifier: Apache-2.0
"""Astrogeodetic levelling: how much the geoid rises from station to station, by the deflections at both ends.

N_B - N_A = - integral of epsilon ds, with epsilon = xi cos(alpha) + eta sin(alpha) at the geoid, along the azimuth alpha
(Hofmann-Wellenhof and Moritz, Physical Geodesy (2005), equation 5-116).  Between two stations epsilon is taken to be
linear, so that the integral is the mean of both times the distance; how far it is not linear is in the error.  A geoid
grid has the shape between the stations: with one, only what the stations have more than the grid is linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from starpos.earth.geoid import Geoid
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC
from starpos.errors import StationError
from starpos.units import ARCSEC
from starpos.zenith.stations import Station, offset_m

# Correlation length of deflections over land, m, where no grid shows their field.  Deflections of UNKNOWN_STDDEV_ARCSEC
# then change by 0.75 arcsec a kilometre, as under a horizontal gradient of gravity of 36 Eotvos, which hills have; high
# mountains have more.
FIELD_LENGTH_M = 8_000.0
# points of the path at which the field is evaluated
POINTS = 65
# The mean latitude serves for distance and azimuth, to 1e-6 of the distance up to here.
MAX_STEP_M = 200_000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class GeoidStep:
    """The rise of the geoid from one station to the next.

    rise_m, stddev_m: N_B - N_A, with 1 sigma.  measured_m: its part by the deflections' errors.  between_m: by the field
    between the stations.  azimuth (rad), distance_m: from A to B.
    """

    begin: Station
    end: Station
    distance_m: float
    azimuth: float
    rise_m: float
    stddev_m: float
    measured_m: float
    between_m: float


def levelled(line: Sequence[Station], geoid: Geoid | None) -> tuple[GeoidStep, ...]:
    """The steps along a line of stations; with more than one, the last one is from the first station to the last.

    geoid: a grid whose shape is taken between the stations.  Raises StationError if it has no data there, or a step is
    too long.
    """
    steps = [_Step.of(a, b, geoid) for a, b in pairwise(line)]
    told = [_told([step]) for step in steps]
    return (*told, _told(steps)) if len(steps) > 1 else tuple(told)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Step:
    """A step, linear in the deflections.

    slope (2,): derivative of rise_m by xi, eta in arcsec at either end.  between_m: 1 sigma by the field between.
    """

    begin: Station
    end: Station
    north: float
    east: float
    rise_m: float
    slope: np.ndarray
    between_m: float

    @classmethod
    def of(cls, begin: Station, end: Station, geoid: Geoid | None) -> "_Step":
        north, east = offset_m(begin, end)
        distance = float(np.hypot(north, east))
        if distance > MAX_STEP_M:
            raise StationError(
                f"{begin.name} and {end.name} are {distance / 1000:.0f} km apart, levelling takes steps of at most "
                f"{MAX_STEP_M / 1000:.0f} km: add stations between them"
            )
        # s times the unit vector along the azimuth is (north, east)
        slope = -0.5 * ARCSEC * np.array([north, east])
        seen = begin.at_geoid + end.at_geoid
        if geoid is None:
            rise, stddev, length = 0.0, UNKNOWN_STDDEV_ARCSEC, FIELD_LENGTH_M
        else:
            grids = [geoid.at(s.latitude, s.longitude) for s in (begin, end)]
            heights = [geoid.undulation_m(s.latitude, s.longitude) for s in (begin, end)]
            if not (np.isfinite(heights).all() and all(g.known for g in grids)):
                raise StationError(f"{begin.name} to {end.name}: the geoid grid has no data at both of them")
            seen = seen - np.sum([[g.xi_arcsec, g.eta_arcsec] for g in grids], 0)
            rise = heights[1] - heights[0]
            # what the grid does not resolve changes within its spacing
            stddev, length = max(g.stddev_arcsec for g in grids), geoid.node_m(begin.latitude)
        return cls(
            begin=begin,
            end=end,
            north=north,
            east=east,
            rise_m=float(rise + slope @ seen),
            slope=slope,
            between_m=between_m(distance, stddev, length),
        )


def _told(steps: Sequence[_Step]) -> GeoidStep:
    north, east = sum(s.north for s in steps), sum(s.east for s in steps)
    # a station between two steps counts in both; what all stations share, along the whole way
    slopes: dict[int, np.ndarray] = {}
    stations: dict[int, Station] = {}
    for step in steps:
        for station in (step.begin, step.end):
            slopes[id(station)] = slopes.get(id(station), np.zeros(2)) + step.slope
            stations[id(station)] = station
    own = sum(float(slopes[k] @ (s.covariance - s.common) @ slopes[k]) for k, s in stations.items())
    whole = np.sum(list(slopes.values()), 0)
    common = max(float(whole @ s.common @ whole) for s in stations.values())
    measured = float(np.sqrt(own + common))
    between = float(np.sqrt(sum(s.between_m**2 for s in steps)))
    return GeoidStep(
        begin=steps[0].begin,
        end=steps[-1].end,
        distance_m=float(np.hypot(north, east)),
        azimuth=float(np.arctan2(east, north) % (2 * np.pi)),
        rise_m=sum(s.rise_m for s in steps),
        stddev_m=float(np.hypot(measured, between)),
        measured_m=measured,
        between_m=between,
    )


def between_m(distance_m: float, stddev_arcsec: float, length_m: float) -> float:
    """1 sigma (m) of the mean of both ends times the distance, for the integral of a random field between them.

    The field is a Gauss-Markov process of second order with that standard deviation and correlation length.
    """
    at = np.linspace(0, distance_m, POINTS)
    far = np.abs(at[:, None] - at) / length_m
    field = (1 + far) * np.exp(-far)
    weight = np.full(POINTS, distance_m / (POINTS - 1))
    weight[[0, -1]] /= 2
    weight[[0, -1]] -= distance_m / 2
    return float(stddev_arcsec * ARCSEC * np.sqrt(max(weight @ field @ weight, 0.0)))
