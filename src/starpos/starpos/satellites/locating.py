# SPDX-License-Identifier: Apache-2.0
"""A place from trails and orbits: names, adjustment, and names again by the place, until both stay."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.gravity import enu_at, geodetic_place
from starpos.errors import SatelliteError
from starpos.frozen import at_once
from starpos.satellites.adjustment import Adjuster, KnownBefore, PlaceAdjustment
from starpos.satellites.elements import Orbit
from starpos.satellites.naming import FEWEST, Candidates, agreement, candidates, ways_of
from starpos.satellites.trails import SatelliteTrail

# chi-squared of a candidate's place on the ground, from which its trail is looked at
NEAR = 40.0
# probability of a named trail's residuals by chance
UNLIKELY = 1e-4
# by how much (log) a satellite has to fit a trail better than any other
AHEAD = 4.6
ROUNDS = 4
# Share of the named trails that has to fit within the stated errors.
FITTING = 0.5
# m by which all claims are rounded up: light in the air, SGP4's text
FLOOR_M = 2.0


@at_once
@dataclass(frozen=True, kw_only=True)
class SatelliteFix:
    """A place from satellites.

    Attributes
    ----------
    latitude, longitude, height_m : rad, rad, m, on WGS 84
    covariance : (3, 3) east, north, up, m2
    clock_s, clock_stddev_s : s, to be added to the stamps, and its error
    named : for each trail its orbit, or None
    adjusted : row of each trail in the adjustment, or -1
    satellites : number of different ones that the place stands on
    adjustment : of the trails
    headings : names of frames, and their cameras' headings there with the errors, rad

    Examples
    --------
    >>> fix = starpos.locate(["sightings.csv"], ["active.tle"], height_m=900)
    >>> fix.satellites, fix.covariance.shape
    (8, (3, 3))
    """

    latitude: float
    longitude: float
    height_m: float
    covariance: np.ndarray
    clock_s: float
    clock_stddev_s: float
    named: tuple[Orbit | None, ...]
    adjusted: np.ndarray
    satellites: int
    adjustment: PlaceAdjustment
    headings: tuple[tuple[str, float, float], ...] = ()

    @property
    def text(self) -> str:
        """The place on WGS 84 with its errors, the clock, and on how much it stands."""
        a, (east, north, up) = self.adjustment, np.sqrt(np.diag(self.covariance))
        widened = f", the covariance widened {a.scale:.1f} times" if a.scale > 1 else ""
        return (
            f"place {np.degrees(self.latitude):.5f} {np.degrees(self.longitude):.5f} (WGS 84), {self.height_m:.0f} m; +- "
            f"{east:.0f} m east, {north:.0f} m north, {up:.0f} m up; clock {self.clock_s:+.3f} s +- "
            f"{self.clock_stddev_s:.3f}; {a.used.sum()} trails of {self.satellites} satellites, chi-square "
            f"{a.chi2:.1f} of {a.degrees}{widened}"
        )


def locate(trails: Sequence[SatelliteTrail], orbits: Sequence[Orbit], prior: KnownBefore) -> SatelliteFix:
    """Name the trails and adjust the place; SatelliteError where they do not give one."""
    fewest = FEWEST if prior.near is None else FEWEST - 1
    if len(trails) < fewest:
        raise SatelliteError(f"there are {len(trails)} trails: a place takes {fewest} or more")
    found = candidates(trails, orbits, prior)
    near = prior.near
    agreed = agreement(found if near is None else found.and_place(near, prior.height_m))
    place, clock_s, rows = agreed.place, 0.0, agreed.members[agreed.members < len(found.trail)]
    seen_before: list[list[int]] = []
    while len(seen_before) < ROUNDS and rows.tolist() not in seen_before:
        seen_before.append(rows.tolist())
        if len(rows) < fewest:
            raise SatelliteError(
                f"of {len(trails)} trails {len(rows)} fit a satellite at one place: a place takes {fewest}: give orbits "
                "of that day, or more trails"
            )
        adjuster = Adjuster(ways_of(trails, found, rows), [orbits[k] for k in found.orbit[rows]], prior)
        answer = adjuster.solve(place, clock_s)
        place, clock_s = answer.place, answer.clock_s
        rows = _named(trails, orbits, found, answer, prior)
    return _fix(trails, orbits, found, np.array(seen_before[-1], int), answer, fewest)


def _named(
    trails: Sequence[SatelliteTrail],
    orbits: Sequence[Orbit],
    found: Candidates,
    at: PlaceAdjustment,
    prior: KnownBefore,
) -> np.ndarray:
    """Rows of the candidates that fit their trails at a place, one a trail, where no other fits nearly as well."""
    plane = enu_at(at.place)[:2]
    off = (found.places - at.place) @ plane.T
    spread = plane @ found.covariance @ plane.T + at.covariance[:2, :2]
    near = np.flatnonzero(np.einsum("ki,kij,kj->k", off, np.linalg.inv(spread), off) < NEAR)
    if not len(near):
        return near
    # each candidate as a satellite of its own, so that none pulls another
    own = [replace(orbits[k], number=n) for n, k in enumerate(found.orbit[near])]
    density, probability = Adjuster(ways_of(trails, found, near), own, prior).fits(at)
    stated = np.array([trails[k].satellite is not None for k in found.trail[near]])
    chosen = []
    for trail in np.unique(found.trail[near]):
        mine = np.flatnonzero((found.trail[near] == trail) & ((probability > UNLIKELY) | stated))
        mine = mine[np.argsort(-density[mine])]
        if len(mine) and (len(mine) == 1 or density[mine[0]] > density[mine[1]] + AHEAD):
            chosen.append(near[mine[0]])
    return np.array(chosen, int)


def _fix(
    trails: Sequence[SatelliteTrail],
    orbits: Sequence[Orbit],
    found: Candidates,
    rows: np.ndarray,
    answer: PlaceAdjustment,
    fewest: int,
) -> SatelliteFix:
    used = answer.used
    satellites = {orbits[found.orbit[k]].number for k, fits in zip(rows, used, strict=True) if fits}
    if used.sum() < FITTING * len(used):
        raise SatelliteError(
            f"of {len(used)} trails with a satellite only {used.sum()} fit one place within the stated errors: check the "
            "times, the exposures and the errors of the sightings"
        )
    if used.sum() < fewest or len(satellites) < 2:
        raise SatelliteError(
            f"only {used.sum()} trails of {len(satellites)} satellites agree: a place takes {fewest} of two or more"
        )
    latitude, longitude, height = geodetic_place(answer.place)
    adjusted = np.full(len(trails), -1)
    named: list[Orbit | None] = [None] * len(trails)
    for k, row in enumerate(rows):
        adjusted[found.trail[row]] = k
        named[found.trail[row]] = orbits[found.orbit[row]]
    return SatelliteFix(
        latitude=float(latitude),
        longitude=float(longitude),
        height_m=float(height),
        covariance=answer.covariance[:3, :3] + FLOOR_M**2 * np.eye(3),
        clock_s=answer.clock_s,
        clock_stddev_s=float(np.sqrt(answer.covariance[3, 3])),
        named=tuple(named),
        adjusted=adjusted,
        satellites=len(satellites),
        adjustment=answer,
    )
