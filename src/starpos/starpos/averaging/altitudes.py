# SPDX-License-Identifier: Apache-2.0
"""The place from elevations alone: of frames whose centre is known but not their roll."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from operator import attrgetter

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.averaging.average import SCATTER, Average
from starpos.earth.ellipsoid import (
    EQUATOR_RADIUS_M,
    curvature_radii_m,
    enu_at_zenith,
    ground_m,
    place_of_zenith,
    zenith_of,
)
from starpos.earth.orientation import station_velocity
from starpos.errors import FixError
from starpos.fix.budget import time_terms
from starpos.fix.circle import Circle
from starpos.fix.terms import ALWAYS, EACH_POSE, ErrorTerm
from starpos.frozen import at_once
from starpos.sky.bodies import MOON, SUN
from starpos.units import ARCSEC, SIGMA_PER_MAD

# with a worse A3 the circles are no longer what a linear error makes of them: its axis is fitted first
LINEAR_A3_RAD = 360 * ARCSEC
# maximum distance of frames that look in one direction, in rad and in sigma
SAME_RAD, SAME_SIGMA = 60 * ARCSEC, 6.0
# the same for the Sun's way over a camera at rest, which the air bends
SAME_POSE_RAD = 300 * ARCSEC
MAX_DIRECTIONS = 1000
# number of directions that give the first places to try
STARTS = 8
ROUNDS, SETTLED = 30, 1e-12
# maximum distance (rad) of equal answers
ALIKE = 1e-7
# an answer is excluded if its fit is worse by this
EXCLUDED_SIGMA = 6.0
# outliers: their distance, minimum number of directions, maximum share left out where A3 is fitted too, number of rounds
OUTLIER_SIGMA, MIN_JUDGED, MAX_OUTLIERS, JUDGED = 6.0, 6, 1 / 3, 6
WITHIN = 0.95
# 1 sigma of --near where it chooses between the Sun and the Moon
NEAR_RAD = 500 / 6371
# three directions that contradict each other by more have errors of unknown size
CONTRADICT_SIGMA = 5.0


def place_of_circles(circles: Sequence[Circle], near: tuple[float, float] | None = None) -> Average:
    """The place where circles of several directions meet; its heading is NaN.

    near: latitude, longitude (rad) that selects one of two places, where the circles meet in two.
    `poses` is the number of directions, `left_out` the frames of those that disagree.
    Raises FixError if there are fewer than three directions, or two without `near`, or if they leave two places.
    """
    return _solved(circles, near)[0]


def _solved(circles: Sequence[Circle], near: tuple[float, float] | None) -> tuple[Average, float]:
    """The place as `place_of_circles` has it, and how badly circles, and a way from near, fit: in sigma, squared."""
    whole = Directions.of(circles)
    number = len(whole.covariance)
    if number < 2 or (number == 2 and near is None):
        raise FixError(
            f"{len(circles)} elevations in {number} {'direction' if number == 1 else 'directions'} do not "
            f"determine a place: without a roll it takes three (frames of a camera that stands still are one)"
            + (", or two and --near LAT LON, because two circles meet in two places" if number == 2 else "")
        )
    part = whole.subset(_sound(whole))
    answer = _answer(part, near)
    away = 0.0 if near is None else np.arccos(np.clip(answer.zenith @ zenith_of(*near), -1, 1)) / NEAR_RAD
    misfit = answer.chi2 + (number - len(part.circles)) * OUTLIER_SIGMA**2 + away**2
    return _average(part, answer, len(circles)), float(misfit)


def place_of_discs(circles: Sequence[Circle], near: tuple[float, float] | None = None) -> tuple[Average, str]:
    """The place by discs that may all be the Sun's or all the Moon's, and the name of the body whose circles meet.

    As `place_of_circles`.  Raises FixError where both bodies' do: they move by half a degree an hour against each other.
    """
    found, why = [], None
    for name, choice in ((SUN, circles), (MOON, [c.instead for c in circles if c.instead is not None])):
        if len(choice) == len(circles):
            try:
                found.append((*_solved(choice, near), name))
            except FixError as error:
                why = why or error
    if not found:
        assert why is not None
        raise why
    found.sort(key=lambda f: f[1])
    if len(found) > 1 and found[1][1] - found[0][1] < EXCLUDED_SIGMA**2:
        raise FixError(
            "the discs may be the Sun's or the Moon's, whose circles meet both: go on for some hours, or say where you "
            "are with --near LAT LON"
        )
    return found[0][0], found[0][2]


@at_once
@dataclass(frozen=True)
class Directions:
    """D directions: the circles of each, and by source the covariance (D, D) in rad2 of their mean zenith distances."""

    circles: list[list[Circle]]
    sources: dict[str, np.ndarray]

    @classmethod
    def of(cls, circles: Sequence[Circle]) -> "Directions":
        """Directions of circles in any order; FixError if they are too many."""
        groups: list[list[Circle]] = []
        for c in sorted(circles, key=attrgetter("utc_unix_s")):
            if groups and _alike(groups[-1][0], c):
                groups[-1].append(c)
            else:
                groups.append([c])
        if len(groups) > MAX_DIRECTIONS:
            raise FixError(
                f"{len(groups)} directions, of which {MAX_DIRECTIONS} can be worked: split the table"
            )
        own = np.diag([sum(c.sigma**2 for c in g) / len(g) ** 2 for g in groups])
        return cls(groups, {"pointing": own} | _tilt_sources(groups))

    @property
    def covariance(self) -> np.ndarray:
        return self.without()

    def without(self, source: str = "") -> np.ndarray:
        """The covariance (D, D) without the one of one source."""
        return np.sum([c for name, c in self.sources.items() if name != source], axis=0)

    @property
    def wide(self) -> bool:
        """Whether A3 is known too badly for a linear error."""
        return any(g[0].terms[0].covariance[0, 0] > LINEAR_A3_RAD**2 for g in self.circles)

    def subset(self, rows: np.ndarray) -> "Directions":
        """Some of the directions."""
        return Directions(
            [self.circles[k] for k in rows], {n: c[np.ix_(rows, rows)] for n, c in self.sources.items()}
        )

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Mean (D, ...) over the circles of each direction of values (N, ...)."""
        number = [len(g) for g in self.circles]
        starts = np.cumsum([0, *number[:-1]])
        return (np.add.reduceat(values, starts).T / number).T

    def residual(
        self, zenith: np.ndarray, measured: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean zenith distances minus those measured (D,) at a zenith (3,), and their derivatives (D, 2).

        They are by the zenith's steps east and north, in rad.  measured (N,): in place of the circles' own.
        """
        every = [c for g in self.circles for c in g]
        if measured is None:
            measured = np.array([c.zenith_distance for c in every])
        nearer = np.array([c.parallax for c in every])[:, None] * ground_m(zenith) / EQUATOR_RADIUS_M
        v = rotation.normalised(np.array([c.itrs for c in every]) - nearer + station_velocity(zenith))
        axes = enu_at_zenith(zenith)
        local = v @ axes.T
        sine = np.hypot(local[:, 0], local[:, 1])
        slope = -local[:, :2] / np.maximum(sine, 1e-12)[:, None]
        return self.mean(np.arctan2(sine, local[:, 2]) - measured), self.mean(slope)


def _alike(a: Circle, b: Circle) -> bool:
    """Whether two circles are of a camera that was not turned in between."""
    angle = np.linalg.norm(np.cross(a.itrs, b.itrs))
    return bool(a.itrs @ b.itrs > 0 and angle < max(SAME_RAD, SAME_SIGMA * np.hypot(a.sigma, b.sigma)))


def _poses(groups: list[list[Circle]]) -> np.ndarray:
    """Number (D,) of each direction's pose: what moves over a camera at rest moves as far in it as on the Earth."""
    seen = np.array([g[0].ray for g in groups]), np.array([g[0].itrs for g in groups])
    in_camera, on_earth = (rotation.angle(v[:-1], v[1:]) for v in seen)
    return np.append(0, np.cumsum(np.abs(in_camera - on_earth) > SAME_POSE_RAD))


def _tilt_sources(groups: list[list[Circle]]) -> dict[str, np.ndarray]:
    """Covariance (D, D) in rad2 of the mean zenith distances of each direction, for each term of the circles."""
    poses = _poses(groups)
    first = groups[0][0].utc_unix_s
    since = np.array([np.mean([c.utc_unix_s for c in g]) for g in groups]) - first
    sources: dict[str, np.ndarray] = {}
    for k, like in enumerate(groups[0][0].terms):
        terms = [[c.terms[k] for c in g] for g in groups]
        if like.shared in (ALWAYS, EACH_POSE):
            mean = np.array([np.mean([t.factor[0] for t in ts], axis=0) for ts in terms])
            if like.shared == EACH_POSE:
                sources[like.name] = mean @ mean.T * like.variance * (poses[:, None] == poses)
                continue
            # what wanders has gone on together until the earlier of two times
            variance = terms[0][0].variance + like.walk_s * np.minimum(since[:, None], since)
            sources[like.name] = mean @ mean.T * variance
        else:
            sources[like.name] = np.diag([_mean_variance(ts) for ts in terms])
    return sources


def _mean_variance(terms: list[ErrorTerm]) -> float:
    """Variance of the mean of an error over the frames of a direction, from the readings that they share."""
    each = np.array([t.covariance[0, 0] for t in terms])
    if terms[0].shared is None:
        return float(each.sum()) / len(terms) ** 2
    keys = [t.shared or () for t in terms]
    different = len(set().union(*keys))
    return float(np.mean([v * len(k) for v, k in zip(each, keys, strict=True)])) / max(different, 1)


@at_once
@dataclass(frozen=True)
class _Answer:
    """A zenith (3,), the gain (2, D) of the fit there and its chi-square."""

    zenith: np.ndarray
    gain: np.ndarray
    chi2: float


def _sound(whole: Directions) -> np.ndarray:
    """The directions that agree, as rows; all if they are too few to judge, or too many disagree.

    They are judged from the place with the least median of residuals, in units of what is usual (Rousseeuw and Leroy,
    Robust Regression and Outlier Detection, 1987): a mean would hide several wrong ones behind each other.
    """
    number = len(whole.circles)
    every = np.arange(number)
    if number < MIN_JUDGED:
        return every
    sigma = np.sqrt(np.diag(whole.covariance))

    def size(zenith: np.ndarray) -> np.ndarray:
        return np.abs(whole.residual(zenith)[0]) / sigma

    zenith = min(starts(whole), key=lambda start: float(np.median(size(start))), default=None)
    rows: np.ndarray = every
    for _ in range(JUDGED):
        if zenith is None:
            return every
        off = size(zenith)
        agree = np.flatnonzero(off < OUTLIER_SIGMA * max(usual_sigma(off, number - 2), 1.0))
        if len(agree) <= number // 2:
            return every
        if np.array_equal(agree, rows):
            break
        rows, part = agree, whole.subset(agree)
        found = _refined(part, np.linalg.inv(part.covariance), zenith)
        zenith = None if found is None else found.zenith
    return rows


def usual_sigma(off: np.ndarray, free: int) -> float:
    """Sigma by the median of residuals, of which a fit that is robust leaves as many as `free` other than 0."""
    return SIGMA_PER_MAD * (1 + 5 / free) * float(np.median(np.sort(off)[-free:]))


def _answer(part: Directions, near: tuple[float, float] | None) -> _Answer:
    """The one place that fits; FixError if no place fits, or two do."""
    weight = np.linalg.inv(part.covariance)
    found: list[_Answer] = []
    for start in starts(part):
        one = _refined(part, weight, start)
        if one is None or any(c.itrs @ one.zenith < 0 for g in part.circles for c in g):
            continue
        if all(np.linalg.norm(one.zenith - f.zenith) > ALIKE for f in found):
            found.append(one)
    if not found:
        raise FixError(
            "the elevations do not agree on one place: check A3, the clock, and that nothing was moved "
            "between them"
        )
    found.sort(key=lambda f: f.chi2)
    scatter2 = max(found[0].chi2 / max(len(part.circles) - 2, 1), 1.0)
    left = [f for f in found if f.chi2 - found[0].chi2 <= EXCLUDED_SIGMA**2 * scatter2]
    if near is not None:
        there = rotation.unit_vector(near[1], near[0])
        left.sort(key=lambda f: -f.zenith @ there)
    elif len(left) > 1:
        first, second = (
            f"{lat:+.4f} {lon:+.4f}" for lat, lon in (np.degrees(place_of_zenith(f.zenith)) for f in left[:2])
        )
        raise FixError(
            f"the elevations leave two places, {first} and {second}: turn the camera to directions that do not lie in "
            "one plane with the zenith, or say which it is with --near LAT LON"
        )
    return left[0]


def starts(part: Directions) -> list[np.ndarray]:
    """Zeniths (3,) in which two circles meet, or where they are nearest to each other."""
    some = np.unique(np.linspace(0, len(part.circles) - 1, STARTS).astype(int))
    firsts = [part.circles[k][0] for k in some]
    zeniths = []
    for a, b in combinations(firsts, 2):
        normal = np.cross(a.itrs, b.itrs)
        across2 = normal @ normal
        if across2 < 1e-12:
            continue
        ca, cb, c = np.cos(a.zenith_distance), np.cos(b.zenith_distance), a.itrs @ b.itrs
        flat = ((ca - c * cb) * a.itrs + (cb - c * ca) * b.itrs) / across2
        height = np.sqrt(max(1 - flat @ flat, 1e-6) / across2) * normal
        zeniths += [rotation.normalised(flat + height), rotation.normalised(flat - height)]
    return zeniths


def _refined(part: Directions, weight: np.ndarray, zenith: np.ndarray) -> _Answer | None:
    """The answer near a zenith, by Gauss-Newton; None if it does not converge."""
    for _ in range(ROUNDS):
        left, slope = part.residual(zenith)
        normal = slope.T @ weight @ slope
        if np.linalg.cond(normal) > 1e12:
            return None
        gain = np.linalg.solve(normal, slope.T @ weight)
        step = -gain @ left
        if np.linalg.norm(step) < SETTLED:
            return _Answer(zenith, gain, float(left @ weight @ left))
        step *= min(1.0, 0.3 / np.linalg.norm(step))
        zenith = rotation.normalised(zenith + step @ enu_at_zenith(zenith)[:2])
    return None


def _average(part: Directions, answer: _Answer, frames: int) -> Average:
    latitude, longitude = place_of_zenith(answer.zenith)
    prime, meridian = curvature_radii_m(latitude)
    metres = answer.gain * np.array([[prime], [meridian]])
    every = [c for g in part.circles for c in g]

    def term(name: str, covariance: np.ndarray, shared: tuple | None = None) -> ErrorTerm:
        factor = np.full((6, 2), np.nan)
        factor[:2] = symmetric_root(covariance)
        return ErrorTerm(name, factor, shared=shared)

    terms = [term(name, metres @ source @ metres.T) for name, source in part.sources.items()]
    worst = max(every, key=lambda c: c.clock_stddev_s)
    stamp_s = max(c.stamp_stddev_s for c in every)
    for t in time_terms(latitude, worst.earth, worst.clock_stddev_s, stamp_s):
        terms.append(term(t.name, t.covariance[:2, :2], ALWAYS))
    free = len(part.circles) - 2
    if free == 1 and answer.chi2 > CONTRADICT_SIGMA**2:
        raise FixError(
            f"the elevations of three directions contradict each other by {np.sqrt(answer.chi2):.0f} sigma: "
            f"one is wrong, or their errors are larger than stated: add directions, or state larger errors"
        )
    beyond = excess(answer.chi2, free)
    terms.append(term(SCATTER, beyond * metres @ part.covariance @ metres.T))
    times = [c.utc_unix_s for c in every]
    return Average(
        utc_unix_s=float(np.mean(times)),
        latitude=latitude,
        longitude=longitude,
        heading=float("nan"),
        terms=tuple(terms),
        frames=len(every),
        poses=len(part.circles),
        left_out=frames - len(every),
        began_unix_s=min(times),
        moved=0,
    )


def excess(chi2: float, free: int) -> float:
    """Variance beyond the stated one, as a share of it, for residuals that scatter more than stated.

    A few of them determine it poorly; Student's t allows for this. A single one counts as two.
    """
    if free < 1 or chi2 <= free:
        return 0.0
    beyond, free = chi2 / free - 1, max(free, 2)
    # the ellipse that holds a share WITHIN, by the F distribution with 2 and `free`, over the ellipse of a known scatter
    wide = free / 2 * ((1 - WITHIN) ** (-2 / free) - 1) / -np.log(1 - WITHIN)
    return float(beyond * wide)
