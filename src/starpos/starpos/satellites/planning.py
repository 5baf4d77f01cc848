# SPDX-License-Identifier: Apache-2.0
"""What of the satellites can be seen from a place in a night: in sunlight, high enough, and how many in a lens."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M, enu_axes
from starpos.earth.gravity import itrs_place
from starpos.earth.orientation import earth_state
from starpos.frozen import at_once
from starpos.rotation import normalised, unit_vector
from starpos.satellites.elements import Orbit
from starpos.satellites.naming import STEP_S, OrbitsAbove
from starpos.sky.bodies import SUN, body_at
from starpos.units import HOUR_S

# Sine of the Sun's height, -6 deg, under which bright stars show: civil twilight ends.
DARK = math.sin(math.radians(-6))
# The Earth's shadow is a cylinder as wide as the Earth with the air that lets no light through, m.
SHADOW_M = 6_400_000.0
# Directions that a camera may look to: straight up, and at these distances from the zenith in 8 azimuths.
LEANS, AZIMUTHS = np.radians([30.0, 50.0]), 8


@at_once
@dataclass(frozen=True, kw_only=True)
class HourOfSatellites:
    """Satellites that pass in the dark part of an hour; it begins at utc_unix_s.

    sun_deg (2,): the Sun's height at the beginning and the end of that part.
    lit_from_km: height of the lowest orbit that is in sunlight straight up, when the Sun is highest.
    numbers: of the catalogue, of the satellites that pass above the height asked for in sunlight.
    at_once: of these, the mean number at a time.
    in_lens: the mean number in the lens, where it sees most; NaN without a lens.  towards: azimuth and height there, deg.
    """

    utc_unix_s: float
    sun_deg: np.ndarray
    lit_from_km: float
    numbers: np.ndarray
    at_once: float
    in_lens: float
    towards: tuple[float, float]


def nights_hours(
    latitude_deg: float,
    longitude_deg: float,
    begin_unix_s: float,
    orbits: Sequence[Orbit] = (),
    *,
    least_deg: float = 25.0,
    lens_deg: tuple[float, float] | None = None,
) -> list[HourOfSatellites]:
    """The dark hours of the 24 that follow a time, with what passes at a place; none where it does not get dark.

    least_deg: smallest height of a satellite.  lens_deg: width and height of the field of view.
    Raises TimeError where the Earth's orientation is unknown.
    """
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    enu, site = enu_axes(latitude, longitude), itrs_place(latitude, longitude, 0.0)
    leaning = [(lean, k) for lean in LEANS for k in range(AZIMUTHS)]
    pointings = np.array(
        [[0.0, 0.0, 1.0]]
        + [unit_vector(math.pi / 2 - 2 * math.pi * k / AZIMUTHS, math.pi / 2 - lean) for lean, k in leaning]
    )
    sky = OrbitsAbove(orbits) if orbits else None
    least = math.sin(math.radians(least_deg))
    steps = math.ceil(begin_unix_s / STEP_S) + np.arange(round(24 * HOUR_S / STEP_S))
    # by hour, for its dark moments: sine of the Sun's height, rows seen, their number by pointing
    hours: dict[int, list[tuple[float, np.ndarray, np.ndarray]]] = {}
    for t in (steps * STEP_S).tolist():
        sun = body_at(SUN, earth_state(t)).itrs
        if (sine := float(sun @ enu[2])) >= DARK:
            continue
        rows, in_lens = np.zeros(0, int), np.zeros(len(pointings))
        if sky is not None:
            r, _ = sky.at(t)
            v = normalised(r - site) @ enu.T
            rows = np.flatnonzero((v[:, 2] > least) & sunlit(r, sun))
            if lens_deg is not None:
                in_lens = _in_lens(v[rows], pointings, lens_deg)
        hours.setdefault(int(t // HOUR_S), []).append((sine, rows, in_lens))
    return [_hour(number, moments, orbits, pointings) for number, moments in hours.items()]


def _in_lens(v: np.ndarray, pointings: np.ndarray, lens_deg: tuple[float, float]) -> np.ndarray:
    """How many of the directions v (N, 3) in ENU a lens sees that looks along each of the pointings (P, 3)."""
    # the lens's width is level
    across = normalised(np.cross(pointings, [0.0, 1e-9, 1.0]))
    x, y, z = (v @ axes.T for axes in (across, np.cross(across, pointings), pointings))
    width, height = np.tan(np.radians(lens_deg) / 2)
    return ((z > 0) & (abs(x) < width * z) & (abs(y) < height * z)).sum(0)


def sunlit(r: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Whether satellites at r (N, 3) m are outside the shadow of the Earth; sun (3,): the unit vector to it."""
    behind = r @ sun
    return (behind > 0) | (np.linalg.norm(r - behind[:, None] * sun, axis=1) > SHADOW_M)


def _hour(
    number: int,
    moments: Sequence[tuple[float, np.ndarray, np.ndarray]],
    orbits: Sequence[Orbit],
    pointings: np.ndarray,
) -> HourOfSatellites:
    suns, seen, in_lens = zip(*moments, strict=True)
    mean = np.mean(in_lens, axis=0)
    best = int(mean.argmax())
    east, north, up = pointings[best]
    sines = np.array([suns[0], suns[-1]])
    return HourOfSatellites(
        utc_unix_s=number * HOUR_S,
        sun_deg=np.degrees(np.arcsin(sines)),
        lit_from_km=(SHADOW_M / math.sqrt(1 - sines.max() ** 2) - EARTH_RADIUS_M) / 1e3,
        numbers=np.array([orbits[k].number for k in np.unique(np.concatenate(seen))], int),
        at_once=float(np.mean([len(rows) for rows in seen])),
        in_lens=float(mean[best]),
        towards=(math.degrees(math.atan2(east, north)) % 360, math.degrees(math.asin(min(up, 1.0)))),
    )
