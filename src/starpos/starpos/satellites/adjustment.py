# SPDX-License-Identifier: Apache-2.0
"""Place, height and clock from named trails, by least squares and an unknown offset of satellites from their orbits.

Errors of elements stay the same all night, so all sightings of a satellite share one offset along its motion, one across
and one radially. Each has a prior by its class and age, and is eliminated from the normal equations of the place.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from starpos.earth.gravity import enu_at, geodetic_place, itrs_place
from starpos.earth.place import Place
from starpos.frozen import at_once
from starpos.satellites.elements import Orbit
from starpos.satellites.orbits import Moments, along_axes, observed, raised, states
from starpos.satellites.trails import SatelliteTrail

STEPS = 6
# m from which a step no longer matters
STILL_M = 0.05
# a trail or satellite is left out where chance makes it so unlikely
REFUSED = 1e-4
# Share of the stated error of sightings by hand that all of a night have in common: charts and setting circles are off
# alike all night.
SHARED_BY_HAND = 0.15
# the scatter widens the covariance where chance makes it so unlikely
SCATTER = 0.01


# of any inhabited place, with its error
UNKNOWN_HEIGHT_M = 500.0, 700.0


class KnownBefore(NamedTuple):
    """What is known before: height and clock (1 sigma), and a place on the ellipsoid near by, or None."""

    height_m: float
    height_stddev_m: float
    clock_stddev_s: float
    near: Place | None = None

    @classmethod
    def at_height(cls, height_m: float, stddev_m: float, clock_stddev_s: float) -> "KnownBefore":
        """A height, NaN where it is unknown: then any inhabited one."""
        if math.isnan(height_m):
            height_m, stddev_m = UNKNOWN_HEIGHT_M
        return cls(height_m, stddev_m, clock_stddev_s)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    """The equations of one satellite's trails.

    trails (n,).  of_row (m,): which trail each row is of.  residual (m,) against the orbit without its offset; by_place
    (m, 6): by what all share; by_offset (m, 3); prior (3, 3); total (m, m): the covariance with the offset's.
    """

    trails: np.ndarray
    of_row: np.ndarray
    residual: np.ndarray
    by_place: np.ndarray
    by_offset: np.ndarray
    prior: np.ndarray
    total: np.ndarray

    @cached_property
    def weight(self) -> np.ndarray:
        return np.linalg.inv(self.total)

    def offset(self, step: np.ndarray) -> np.ndarray:
        """The satellite's offset (3,) after a step (6,) of all unknowns."""
        return self.prior @ self.by_offset.T @ self.weight @ (self.residual - self.by_place @ step)

    def chance(self, trails: np.ndarray, step: np.ndarray, covariance: np.ndarray) -> float:
        """Probability of some trails' residuals by chance, all others held: Baarda's test (1968) of a group."""
        weight, rows = self.weight, np.isin(self.of_row, trails)
        weighted = (weight @ (self.residual - self.by_place @ step))[rows]
        left = weight - weight @ self.by_place @ covariance @ self.by_place.T @ weight
        statistic = weighted @ np.linalg.pinv(left[np.ix_(rows, rows)], hermitian=True) @ weighted
        return float(special.chdtrc(int(rows.sum()), statistic))


@at_once
@dataclass(frozen=True, kw_only=True)
class PlaceAdjustment:
    """A place (3,) in ITRS, m, with the clock, by named trails.

    covariance (6, 6): of east, north, up (m), the clock (s), and the errors that sightings by hand share; widened by
    `scale`, a factor of variances.
    offset_m (T, 3): each trail's satellite against its orbit: radial, along, across (left from above);
    NaN of a trail that is not used.
    used (T,); probability (T,): of so large a residual by chance.
    """

    place: np.ndarray
    clock_s: float
    covariance: np.ndarray
    offset_m: np.ndarray
    used: np.ndarray
    probability: np.ndarray
    chi2: float
    degrees: int
    scale: float


class Adjuster:
    """The equations of named trails, from which `solve` computes a place."""

    def __init__(self, trails: Sequence[SatelliteTrail], orbits: Sequence[Orbit], prior: KnownBefore) -> None:
        ends = [len(t.directions) for t in trails]
        self.prior = prior
        self.trail = np.repeat(np.arange(len(trails)), ends)
        self.orbits = [orbits[k] for k in self.trail.tolist()]
        numbers = [o.number for o in orbits]
        _, self.satellite = np.unique(numbers, return_inverse=True)
        self.utc = np.concatenate([t.utc_unix_s for t in trails])
        self.directions = np.concatenate([t.directions for t in trails])
        self.axes = np.concatenate([t.axes for t in trails])
        self.covariance = np.concatenate([t.covariance for t in trails])
        # rad
        alone = np.repeat([not t.moves for t in trails], ends)
        self.by_hand = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2) * alone
        self.time_stddev = np.array([t.time_stddev_s for t in trails])
        self.moments = Moments.at(self.utc)
        self.sigma = np.array(
            [o.errors.sigma(o.age_days(t.utc_unix_s[0])) for o, t in zip(orbits, trails, strict=True)]
        )

    def equations(
        self, place: np.ndarray, clock_s: float, offsets: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals (E, 2), derivatives by what all share (E, 2, 6) and by the offsets (E, 2, 3).

        All share east, north, up, the clock, and two directions in units of the errors of sightings by hand.
        offsets (T, 3): of each trail's satellite, m.
        """
        o = offsets[self.trail]
        earth, enu = self.moments, enu_at(place)
        _, v = states(self.orbits, earth, np.full(len(o), clock_s))
        # an offset along the orbit is a delay
        r, v = states(self.orbits, earth, clock_s + o[:, 1] / np.linalg.norm(v, axis=1))
        ways = along_axes(r, v)
        r = r + ways[:, 0] * o[:, :1] + ways[:, 2] * o[:, 2:]
        site, moving = earth.site(place, clock_s)
        above = np.einsum("eji,j->ei", earth.gcrs_to_itrs, enu[2])
        lift = raised(place, np.einsum("eij,ej->ei", earth.gcrs_to_itrs, self.directions))
        u, distance = observed(r, v, site + above * lift[:, None], earth.velocity)
        across = self.axes / distance[:, None, None]
        residual = np.einsum("eki,ei->ek", self.axes, self.directions - u)
        by_place = -np.einsum("eki,eji,lj->ekl", across, earth.gcrs_to_itrs, enu)
        by_clock = np.einsum("eki,ei->ek", across, v - moving)
        by_offset = np.einsum("eki,eli->ekl", across, ways)
        by_hand = self.by_hand[:, None, None] * np.eye(2)
        return residual, np.concatenate([by_place, by_clock[..., None], by_hand], -1), by_offset

    def solve(self, start: np.ndarray, clock_s: float = 0.0) -> PlaceAdjustment:
        """Adjust from a place (3,) in ITRS near the truth, and leave out what does not fit."""
        used = np.ones(len(self.time_stddev), bool)
        while True:
            answer, chance, worst = self._adjusted(start, clock_s, used)
            if not chance < REFUSED or used.sum() - len(worst) < 2:
                return answer
            used = used & ~np.isin(np.arange(len(used)), worst)

    def _adjusted(
        self, place: np.ndarray, clock_s: float, used: np.ndarray
    ) -> tuple[PlaceAdjustment, float, np.ndarray]:
        """The place by the used trails; the trail, or the satellite's trails, that fits least, after its probability."""
        offsets = np.zeros((len(used), 3))
        for _ in range(STEPS):
            enu = enu_at(place)
            normal, right, chi2, known = self._known_before(place, clock_s, enu)
            blocks = self._blocks(self.equations(place, clock_s, offsets), offsets, used)
            for block in blocks:
                weighted = block.by_place.T @ block.weight
                normal = normal + weighted @ block.by_place
                right = right + weighted @ block.residual
                chi2 += float(block.residual @ block.weight @ block.residual)
            covariance = np.linalg.inv(normal)
            step = covariance @ right
            for block in blocks:
                offsets[block.trails] = block.offset(step)
            place, clock_s = place + enu.T @ step[:3], clock_s + float(step[3])
            if np.linalg.norm(step[:3]) < STILL_M:
                break
        degrees = sum(len(block.residual) for block in blocks) + known - len(step)
        chi2 = max(chi2 - float(step @ right), 0.0)
        scale = max(chi2 / degrees, 1.0) if degrees > 0 and special.chdtrc(degrees, chi2) < SCATTER else 1.0
        probability, groups = np.full(len(used), np.nan), []
        for block in blocks:
            for trail in block.trails:
                probability[trail] = block.chance(trail, step, covariance)
                groups.append((probability[trail], np.array([trail])))
            if len(block.trails) > 1:
                groups.append((block.chance(block.trails, step, covariance), block.trails))
        offsets[~used] = np.nan
        answer = PlaceAdjustment(
            place=place,
            clock_s=clock_s,
            covariance=covariance * scale,
            offset_m=offsets,
            used=used,
            probability=probability,
            chi2=chi2,
            degrees=degrees,
            scale=scale,
        )
        return answer, *min(groups, key=lambda group: group[0])

    def fits(self, at: PlaceAdjustment) -> tuple[np.ndarray, np.ndarray]:
        """Log densities (T,) of the trails at a place that others gave, and their probabilities by chance."""
        none = np.zeros((len(self.time_stddev), 3))
        density, probability = np.full((2, len(none)), -np.inf)
        for block in self._blocks(self.equations(at.place, at.clock_s, none), none, np.ones(len(none), bool)):
            total = block.total + block.by_place @ at.covariance @ block.by_place.T
            chi2 = float(block.residual @ np.linalg.solve(total, block.residual))
            density[block.trails] = -0.5 * (chi2 + np.linalg.slogdet(total)[1])
            probability[block.trails] = special.chdtrc(len(total), chi2)
        return density, probability

    def _known_before(
        self, place: np.ndarray, clock_s: float, enu: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float, int]:
        """Normal equations (6, 6), right side (6,) and chi-squared of what is known before, and how much that is."""
        prior = self.prior
        shared = SHARED_BY_HAND**-2
        normal = np.diag([0.0, 0.0, prior.height_stddev_m**-2, prior.clock_stddev_s**-2, shared, shared])
        off = np.array([0.0, 0.0, prior.height_m - geodetic_place(place)[2], -clock_s, 0.0, 0.0])
        if (near := prior.near) is not None:
            normal[:2, :2] = np.linalg.inv(near.covariance)
            off[:2] = enu[:2] @ (itrs_place(near.latitude, near.longitude, prior.height_m) - place)
        return normal, normal @ off, float(off @ normal @ off), 4 if near is None else 6

    def _blocks(
        self, equations: tuple[np.ndarray, np.ndarray, np.ndarray], offsets: np.ndarray, used: np.ndarray
    ) -> list[_Block]:
        """The equations of the used trails, a block a satellite."""
        residual, by_place, by_offset = equations
        blocks = []
        for satellite in np.unique(self.satellite[used]):
            trails = np.flatnonzero(used & (self.satellite == satellite))
            ends = np.flatnonzero(np.isin(self.trail, trails))
            rows = by_offset[ends].reshape(-1, 3)
            total = np.zeros((len(rows), len(rows)))
            for k, end in enumerate(ends):
                total[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = self.covariance[end]
            of_row = np.repeat(self.trail[ends], 2)
            # the time's own error moves both ends of a trail
            late = by_place[ends][..., 3].ravel() * self.time_stddev[of_row]
            total += np.where(of_row[:, None] == of_row, np.outer(late, late), 0.0)
            prior = np.diag(self.sigma[trails[0]] ** 2)
            blocks.append(
                _Block(
                    trails=trails,
                    of_row=of_row,
                    residual=residual[ends].ravel() + rows @ offsets[trails[0]],
                    by_place=by_place[ends].reshape(-1, 6),
                    by_offset=rows,
                    prior=prior,
                    total=total + rows @ prior @ rows.T,
                )
            )
        return blocks
