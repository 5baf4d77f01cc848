# SPDX-License-Identifier: Apache-2.0
"""Which satellite a trail is, without a prior place: from where each candidate would be seen so, and where trails agree.

A direction and a height above the ellipsoid give a place on the ground for each satellite. The motion along the trail
leaves few of them, and the places that several trails share are where the observer stands.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import ECCENTRICITY2, EQUATOR_RADIUS_M
from starpos.earth.gravity import SPIN, enu_at, itrs_place
from starpos.earth.place import Place
from starpos.errors import SatelliteError
from starpos.frozen import at_once
from starpos.rotation import normalised
from starpos.satellites.adjustment import KnownBefore
from starpos.satellites.elements import Orbit, OrbitErrors
from starpos.satellites.orbits import Moments, along_axes
from starpos.satellites.trails import SatelliteTrail
from starpos.units import DAY_S, UNIX_EPOCH_JD

# s between computed states; Hermite's cubic is within 6 m in low orbits
STEP_S = 120.0
# Maximum change (m) of a satellite's distance along a direction, or of its horizon's distance, in half a step.
MOST_WAY_M = 1.5e6
# a motion may differ by this share, and by this of its distance from the elements over the Earth's radius
RATE_SHARE, RATE_TURN = 0.01, 4.0
ENOUGH_SIGMA = 5.0
# Sine of the smallest elevation.
LOWEST = math.sin(math.radians(5))
# m of the unmodelled: light time, the air
FLOOR_M = 200.0
# m2 from which chance candidates come: the ground that sees a low satellite
GROUND_M2 = math.pi * 2.5e6**2
# chi-squared of two degrees, probability 1e-4
GATE = 18.4
MOST_STARTS, FUSED = 400, 40
# natural logarithms: by how much the trails' agreement has to exceed chance, and another place's agreement
ENOUGH, AHEAD = 14.0, 7.0
FEWEST = 3


@at_once
@dataclass(frozen=True, kw_only=True)
class Candidates:
    """Satellites that trails may be (K,): indices of trail, of its way and of the orbit.

    places (K, 3): where the trail would be seen from, ITRS, m.  covariance (K, 3, 3): of it, horizontally, m2.
    """

    trail: np.ndarray
    way: np.ndarray
    orbit: np.ndarray
    places: np.ndarray
    covariance: np.ndarray

    def and_place(self, place: Place, height_m: float) -> "Candidates":
        """These, and a place that is known, as if a trail more had given it."""
        east_north = place.axes[:2]
        covariance = east_north.T @ place.covariance @ east_north
        itrs = itrs_place(place.latitude, place.longitude, height_m)
        return Candidates(
            trail=np.append(self.trail, self.trail.max(initial=0) + 1),
            way=np.append(self.way, 0),
            orbit=np.append(self.orbit, -1),
            places=np.concatenate([self.places, itrs[None]]),
            covariance=np.concatenate([self.covariance, covariance[None]]),
        )


class OrbitsAbove:
    """All orbits between two computed times, in axes that turn with the Earth."""

    def __init__(self, orbits: Sequence[Orbit]) -> None:
        from sgp4.api import SatrecArray

        self._ephemerides = [(k, o.ephemeris) for k, o in enumerate(orbits) if o.ephemeris is not None]
        self._of_elements = np.array([k for k, o in enumerate(orbits) if o.ephemeris is None], int)
        self._records = SatrecArray([o.record for o in orbits if o.ephemeris is None])
        self.count = len(orbits)
        self._epochs = np.array([o.epoch_unix_s for o in orbits])
        self._errors = np.array([o.errors for o in orbits], float).reshape(-1, len(OrbitErrors._fields))
        self._nodes: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def sigma(self, rows: np.ndarray, utc_unix_s: float) -> np.ndarray:
        """Prior errors (K, 3) of some orbits, m: radial, along, across."""
        return OrbitErrors(*self._errors[rows].T).sigma((utc_unix_s - self._epochs[rows]) / DAY_S)

    def toward(self, direction: np.ndarray, utc_unix_s: float) -> np.ndarray:
        """Rows (K,) of the orbits that may stand in a direction (3,) in ITRS from the ground, and some more."""
        first = self._computed_from(utc_unix_s)
        r, _ = self._nodes[first + round(utc_unix_s / STEP_S - first)]
        beyond = np.sqrt(np.maximum(np.einsum("ki,ki->k", r, r) - EQUATOR_RADIUS_M**2, 0.0))
        return np.flatnonzero(r @ direction > beyond - MOST_WAY_M)

    def at(self, utc_unix_s: float, which: np.ndarray | slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (S, 3), ITRS, m and m/s; NaN where there is no satellite."""
        first = self._computed_from(utc_unix_s)
        (r0, v0), (r1, v1) = ((r[which], v[which]) for r, v in (self._nodes[first], self._nodes[first + 1]))
        x, h = utc_unix_s / STEP_S - first, STEP_S
        y = 1 - x
        place = (1 + 2 * x) * y**2 * r0 + (3 - 2 * x) * x**2 * r1 + h * x * y * (y * v0 - x * v1)
        speed = 6 * x * y / h * (r1 - r0) + (1 - 4 * x + 3 * x**2) * v0 + (3 * x**2 - 2 * x) * v1
        return place, speed

    def _computed_from(self, utc_unix_s: float) -> int:
        """Have the states at the computed times around a time; returns the number of the one before."""
        first = math.floor(utc_unix_s / STEP_S)
        self._nodes = {k: self._nodes[k] for k in (first, first + 1) if k in self._nodes}
        for k in (first, first + 1):
            if k not in self._nodes:
                self._nodes[k] = self._computed(k * STEP_S)
        return first

    def _computed(self, utc_unix_s: float) -> tuple[np.ndarray, np.ndarray]:
        moment = Moments.at(np.array([utc_unix_s]))
        r, v = np.full((2, self.count, 3), np.nan)
        if len(self._of_elements):
            whole, part = divmod(utc_unix_s / DAY_S, 1.0)
            error, places, speeds = self._records.sgp4(np.array([UNIX_EPOCH_JD + whole]), np.array([part]))
            turn = moment.gcrs_to_itrs[0] @ moment.teme_to_gcrs[0]
            good = self._of_elements[error[:, 0] == 0]
            r[good] = places[error[:, 0] == 0, 0] @ turn.T * 1e3
            v[good] = speeds[error[:, 0] == 0, 0] @ turn.T * 1e3
        for k, ephemeris in self._ephemerides:
            r[k], v[k] = (moment.gcrs_to_itrs[0] @ x for x in ephemeris.at(utc_unix_s))
        return r, v - np.cross(SPIN, r)


def candidates(trails: Sequence[SatelliteTrail], orbits: Sequence[Orbit], prior: KnownBefore) -> Candidates:
    """All satellites that each trail may be by its direction and motion; of a named one that satellite.

    A trail with one end and no name has no motion, and no candidates.
    """
    sky = OrbitsAbove(orbits)
    row_of = {orbit.number: k for k, orbit in enumerate(orbits)}
    order = sorted(range(len(trails)), key=lambda k: trails[k].utc_unix_s[0])
    found: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]] = []
    for k in order:
        trail = trails[k]
        if trail.satellite in row_of:
            only: np.ndarray | None = np.array([row_of[trail.satellite]])
        elif trail.satellite is None and trail.moves:
            only = None
        else:
            continue
        for way, one in enumerate(trail.ways):
            index, places, covariance = _of_trail(one, sky, only, prior)
            found.append((k, way, index, places, covariance))
    counts = [len(index) for _, _, index, _, _ in found]
    return Candidates(
        trail=np.repeat(np.array([f[0] for f in found], int), counts),
        way=np.repeat(np.array([f[1] for f in found], int), counts),
        orbit=np.concatenate([np.zeros(0, int), *(f[2] for f in found)]),
        places=np.concatenate([np.zeros((0, 3)), *(f[3] for f in found)]),
        covariance=np.concatenate([np.zeros((0, 3, 3)), *(f[4] for f in found)]),
    )


def _of_trail(
    trail: SatelliteTrail, sky: OrbitsAbove, only: np.ndarray | None, prior: KnownBefore
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of orbits (K,) that a trail of a known way may be, places (K, 3) and covariances (K, 3, 3)."""
    moments = Moments.at(trail.utc_unix_s)
    geometric = normalised(trail.directions + moments.velocity)
    directions = np.einsum("eij,ej->ei", moments.gcrs_to_itrs, geometric)
    d = directions[0]
    rows = sky.toward(d, trail.utc_unix_s[0]) if only is None else only
    r, v = sky.at(trail.utc_unix_s[0], rows)
    # the ellipsoid at that height, stretched to a sphere
    radius = EQUATOR_RADIUS_M + prior.height_m
    polar = EQUATOR_RADIUS_M * math.sqrt(1 - ECCENTRICITY2) + prior.height_m
    stretch = np.array([1.0, 1.0, radius / polar])
    s, e = r * stretch, d * stretch
    a, b = e @ e, s @ e
    discriminant = b**2 - a * (np.einsum("ki,ki->k", s, s) - radius**2)
    with np.errstate(invalid="ignore"):
        hit = np.flatnonzero((discriminant > 0) & (b > 0))
    distance = (b[hit] - np.sqrt(discriminant[hit])) / a
    places = r[hit] - distance[:, None] * d
    up = normalised(places * stretch**2)
    sine = up @ d
    good = (distance > 0) & (sine > LOWEST)
    hit, distance, places, up, sine = (x[good] for x in (hit, distance, places, up, sine))
    r, v, rows = r[hit], v[hit] + np.cross(SPIN, r[hit]), rows[hit]
    sigma = sky.sigma(rows, trail.utc_unix_s[0])
    sigma[:, 1] = np.hypot(
        sigma[:, 1], np.linalg.norm(v, axis=1) * math.hypot(prior.clock_stddev_s, trail.time_stddev_s)
    )
    measured = math.sqrt(np.trace(trail.covariance[0]) / 2)
    until = trail.unseen_utc_unix_s if trail.towards is not None else trail.utc_unix_s[-1]
    if until is not None and until != trail.utc_unix_s[0]:
        r1, _ = sky.at(until, rows)
        worse = math.sqrt(np.trace(trail.covariance, axis1=1, axis2=2).max() / 2)
        other = normalised(r1 - places) - d
        share = RATE_SHARE + RATE_TURN * sigma[:, 1] / EQUATOR_RADIUS_M
        if trail.towards is None:
            motion = directions[-1] - d
            off = np.linalg.norm(other - motion, axis=1)
        else:
            # it goes on beyond the edge of the frame, by no one knows how much
            motion = moments.gcrs_to_itrs[0] @ normalised(trail.towards + moments.velocity[0]) - d
            reached = np.maximum(other @ motion / (motion @ motion), 1.0)
            off = np.linalg.norm(other / reached[:, None] - motion, axis=1)
        near = off < share * np.linalg.norm(motion) + ENOUGH_SIGMA * 2 * worse
        r, v, rows, distance, places, up, sine, sigma = (
            x[near] for x in (r, v, rows, distance, places, up, sine, sigma)
        )
    # an error of the satellite's place moves the ground's along the line of sight
    slide = np.eye(3) - d[:, None] * (up / sine[:, None])[:, None, :]
    axes = along_axes(r, v)
    by_orbit = slide @ np.swapaxes(axes, 1, 2) * sigma[:, None, :]
    by_height = (d - sine[:, None] * up) / sine[:, None] * prior.height_stddev_m
    by_angle = slide * (distance * measured)[:, None, None]
    covariance = by_orbit @ np.swapaxes(by_orbit, 1, 2) + by_angle @ np.swapaxes(by_angle, 1, 2)
    covariance += by_height[:, :, None] * by_height[:, None, :] + FLOOR_M**2 * np.eye(3)
    return rows, places, covariance


@at_once
@dataclass(frozen=True, kw_only=True)
class Agreement:
    """A place (3,) in ITRS, m, where trails agree, and which candidates (n,) they are; score: logarithm over chance."""

    place: np.ndarray
    members: np.ndarray
    score: float


def agreement(found: Candidates) -> Agreement:
    """The place on which most trails agree; SatelliteError if no place, or more than one, is far above chance."""
    trails = len(np.unique(found.trail))
    if trails < FEWEST:
        raise SatelliteError(
            f"of the trails {trails} can be satellites of the orbits: a place takes {FEWEST}: give orbits of that "
            "day, or more trails"
        )
    counts = np.bincount(found.trail)[found.trail]
    chance = np.log(GROUND_M2 / counts)
    spread = np.linalg.eigvalsh(found.covariance)
    starts = np.lexsort((spread[:, 1] * spread[:, 2], counts))[:MOST_STARTS]
    tried = sorted(starts.tolist(), key=lambda k: -_fused(found, chance, k, steps=0).score)
    better = sorted((_fused(found, chance, k, steps=3) for k in tried[:FUSED]), key=lambda a: -a.score)
    best = better[0]
    # a known place counts as one
    satellites = set(found.orbit[best.members].tolist())
    if len(best.members) < FEWEST or len(satellites) < 2 or best.score < ENOUGH + math.log(len(starts)):
        raise SatelliteError(
            f"no place agrees with {FEWEST} trails: {trails} trails can be satellites of the orbits, but from different "
            "places: give orbits of that day, the height, or more trails"
        )
    for other in better[1:]:
        apart = float(np.linalg.norm(other.place - best.place))
        if other.score > best.score - AHEAD and satellites.isdisjoint(found.orbit[other.members].tolist()):
            raise SatelliteError(
                f"the trails agree with two places, {apart / 1e3:.0f} km apart: give --near, or more trails"
            )
    return best


def _fused(found: Candidates, chance: np.ndarray, start: int, steps: int) -> Agreement:
    """The agreement about one candidate's place; each step takes the mean of all that agree."""
    place = found.places[start]
    plane = enu_at(place)[:2]
    points = (found.places - place) @ plane.T
    covariance = plane @ found.covariance @ plane.T
    mean, own = points[start], covariance[start]
    for step in range(steps + 1):
        score, chi2 = _scores(points - mean, covariance + own, chance)
        members = _best_of_trails(found.trail, score, chi2)
        if step < steps:
            weights = np.linalg.inv(covariance[members])
            if len(members):
                own = np.linalg.inv(weights.sum(0))
                mean = own @ np.einsum("kij,kj->i", weights, points[members])
    score = score[members[members != start]].sum()
    return Agreement(place=place + plane.T @ mean, members=members, score=float(score))


def _scores(off: np.ndarray, covariance: np.ndarray, chance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log density over chance (K,), and chi-squared (K,), of differences (K, 2) of places."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    det = a * c - b**2
    x, y = off.T
    chi2 = (c * x**2 - 2 * b * x * y + a * y**2) / det
    return chance - 0.5 * chi2 - np.log(2 * math.pi) - 0.5 * np.log(det), chi2


def _best_of_trails(trail: np.ndarray, score: np.ndarray, chi2: np.ndarray) -> np.ndarray:
    """The row of each trail that agrees best, of those within the gate and above chance."""
    good = np.flatnonzero((chi2 < GATE) & (score > 0))
    order = good[np.lexsort((-score[good], trail[good]))]
    return order[np.unique(trail[order], return_index=True)[1]]


def ways_of(trails: Sequence[SatelliteTrail], found: Candidates, rows: Iterable[int]) -> list[SatelliteTrail]:
    """The trails of some candidates, each flown in its candidate's way."""
    return [list(trails[found.trail[k]].ways)[found.way[k]] for k in rows]
