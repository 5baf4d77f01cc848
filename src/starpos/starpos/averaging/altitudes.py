# SPDX-License-Identifier: Apache-2.0
"""The place, and the camera's axis in the inclinometer, from elevations alone: of frames whose centre is known but not
their roll.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.averaging.average import SCATTER, Average
from starpos.earth.ellipsoid import EQUATOR_RADIUS_M, curvature_radii_m, enu_axes, ground_m, place_of_zenith
from starpos.earth.orientation import station_velocity
from starpos.earth.place import Place
from starpos.errors import FixError
from starpos.fix.budget import time_terms
from starpos.fix.circle import Circle
from starpos.fix.terms import ALWAYS, EACH_POSE, ErrorTerm
from starpos.frozen import at_once
from starpos.instrument.instrument import UNKNOWN_ARCSEC, Calibration
from starpos.instrument.mounting import angles_at
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
# outliers: their distance, minimum number of directions, maximum number of rounds
OUTLIER_SIGMA, MIN_JUDGED, JUDGED = 6.0, 6, 6
WITHIN = 0.95
# three directions that contradict each other by more have errors of unknown size
CONTRADICT_SIGMA = 5.0


def place_of_circles(circles: Sequence[Circle], near: tuple[float, float] | None = None) -> Average:
    """The place where circles of several directions meet; its heading is NaN.

    near: latitude, longitude (rad) that selects one of two places, where the circles meet in two.
    `poses` is the number of directions, `left_out` the frames of those that disagree.
    Raises FixError if there are fewer than three directions, or two without `near`, or if they leave two places.
    """
    whole = Directions.of(sorted(circles, key=lambda c: c.utc_unix_s))
    number = len(whole.covariance)
    if number < 2 or (number == 2 and near is None):
        raise FixError(
            f"{len(circles)} elevations in {number} {'direction' if number == 1 else 'directions'} do not "
            f"determine a place: without a roll it takes three (frames of a camera that stands still are one)"
            + (", or two and --near LAT LON, because two circles meet in two places" if number == 2 else "")
        )
    part = whole.subset(_sound(whole))
    return _average(part, _answer(part, near), len(circles))


@at_once
@dataclass(frozen=True)
class Directions:
    """D directions: the circles of each, and by source the covariance (D, D) in rad2 of their mean zenith distances."""

    circles: list[list[Circle]]
    sources: dict[str, np.ndarray]

    @classmethod
    def of(cls, circles: Sequence[Circle]) -> "Directions":
        """Directions of circles in order of time; FixError if they are too many."""
        groups: list[list[Circle]] = []
        for c in circles:
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
        return np.sum(list(self.sources.values()), axis=0)

    @staticmethod
    def east_north(zenith: np.ndarray) -> np.ndarray:
        """East and north (2, 3) in ITRS at a zenith (3,), along which the derivatives of `residual` are."""
        return _enu(zenith)[:2]

    @property
    def wide(self) -> bool:
        """Whether A3 is known too badly for a linear error."""
        return any(g[0].terms[0].covariance[0, 0] > LINEAR_A3_RAD**2 for g in self.circles)

    def subset(self, rows: np.ndarray) -> "Directions":
        """Some of the directions."""
        return Directions(
            [self.circles[k] for k in rows], {n: c[np.ix_(rows, rows)] for n, c in self.sources.items()}
        )

    def residual(self, zenith: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean zenith distances minus those measured (D,) at a zenith (3,), and their derivatives (D, 2).

        They are by the zenith's steps east and north, in rad.
        """
        rows = np.repeat(np.arange(len(self.circles)), [len(g) for g in self.circles])
        every = [c for g in self.circles for c in g]
        nearer = np.array([c.parallax for c in every])[:, None] * ground_m(zenith) / EQUATOR_RADIUS_M
        v = rotation.normalised(np.array([c.itrs for c in every]) - nearer + station_velocity(zenith))
        axes = _enu(zenith)
        local = v @ axes.T
        sine = np.hypot(local[:, 0], local[:, 1])
        off = np.arctan2(sine, local[:, 2]) - [c.zenith_distance for c in every]
        slope = -local[:, :2] / np.maximum(sine, 1e-12)[:, None]
        number = np.bincount(rows)

        def mean(values: np.ndarray) -> np.ndarray:
            return np.bincount(rows, values) / number

        return mean(off), np.stack([mean(slope[:, 0]), mean(slope[:, 1])], -1)


def _alike(a: Circle, b: Circle) -> bool:
    """Whether two circles are of a camera that was not turned in between."""
    angle = np.linalg.norm(np.cross(a.itrs, b.itrs))
    return bool(a.itrs @ b.itrs > 0 and angle < max(SAME_RAD, SAME_SIGMA * np.hypot(a.sigma, b.sigma)))


def _poses(groups: list[list[Circle]]) -> np.ndarray:
    """Number (D,) of each direction's pose: what moves over a camera at rest moves as far in it as on the Earth."""
    seen = np.array([g[0].ray for g in groups]), np.array([g[0].itrs for g in groups])
    in_camera, on_earth = (np.arctan2(*_apart(v[:-1], v[1:])) for v in seen)
    return np.append(0, np.cumsum(np.abs(in_camera - on_earth) > SAME_POSE_RAD))


def _apart(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sines and cosines (N,) of the angles between unit vectors (N, 3)."""
    return np.linalg.norm(np.cross(a, b), axis=-1), np.einsum("ni,ni->n", a, b)


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
        usual = SIGMA_PER_MAD * (1 + 5 / (number - 2)) * float(np.median(off))
        agree = np.flatnonzero(off < OUTLIER_SIGMA * max(usual, 1.0))
        if len(agree) <= number // 2:
            return every
        if np.array_equal(agree, rows):
            break
        rows, part = agree, whole.subset(agree)
        found = _refined(part, np.linalg.inv(part.covariance), zenith)
        zenith = None if found is None else found.zenith
    return rows


def _answer(part: Directions, near: tuple[float, float] | None) -> _Answer:
    """The one place that fits; FixError if no place fits, or two do."""
    weight = np.linalg.inv(part.covariance)
    found: list[_Answer] = []
    for start in starts(part):
        one = _refined(part, weight, start)
        if one is not None and all(np.linalg.norm(one.zenith - f.zenith) > ALIKE for f in found):
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
            f"{lat:+.4f} {lon:+.4f}" for lat, lon in map(_degrees, (left[0].zenith, left[1].zenith))
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
        zenith = rotation.normalised(zenith + step @ _enu(zenith)[:2])
    return None


def _average(part: Directions, answer: _Answer, frames: int) -> Average:
    latitude, longitude = np.radians(_degrees(answer.zenith))
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
        latitude=float(latitude),
        longitude=float(longitude),
        heading=float("nan"),
        terms=tuple(terms),
        frames=len(every),
        poses=len(part.circles),
        left_out=frames - len(every),
        began_unix_s=min(times),
        moved=0,
    )


def f_quantile(free: int, share: float) -> float:
    """Quantile of the F distribution with 2 and `free` degrees of freedom; to import scipy.special takes 80 ms."""
    return free / 2 * float((1 - share) ** (-2 / free) - 1)


def excess(chi2: float, free: int) -> float:
    """Variance beyond the stated one, as a share of it, for residuals that scatter more than stated.

    A few of them determine it poorly; Student's t allows for this. A single one counts as two.
    """
    if free < 1 or chi2 <= free:
        return 0.0
    # the ellipse that holds a share WITHIN, over the ellipse of a known scatter
    wide = f_quantile(max(free, 2), WITHIN) / -np.log(1 - WITHIN)
    return float((chi2 / free - 1) * wide)


def _degrees(zenith: np.ndarray) -> tuple[float, float]:
    """Latitude, longitude in deg of a zenith (3,)."""
    latitude = np.degrees(np.arctan2(zenith[2], np.hypot(zenith[0], zenith[1])))
    return float(latitude), float(np.degrees(np.arctan2(zenith[1], zenith[0])))


def _enu(zenith: np.ndarray) -> np.ndarray:
    """East, north and up (3, 3) in ITRS at a zenith (3,)."""
    return enu_axes(*place_of_zenith(zenith))


AXIS_ROUNDS, SETTLED_CHI2, FIRST_DAMPING, LAST_DAMPING = 80, 1e-6, 1e-3, 1e9
# an axis that is known better than this (rad) is known
MIN_RAD = 1e-9
# number of zeniths that are tried, the ones that fit best at first
TRIED = 4
# minimum number of directions that determine an axis, with the zenith known and unknown
FEWEST, MIN_WITHOUT_SITE = 2, 4
# how long A3 may be used
VALID_DAYS = 365.0
# the term of the circles that holds A3's error, which is fitted here
OF_A3 = "calibration"

# the circles of all frames with an A3 (3, 3)
CirclesOf = Callable[[np.ndarray], Sequence[Circle]]


@at_once
@dataclass(frozen=True, kw_only=True)
class FoundAxis:
    """A3 whose axis the elevations determined.

    a3 (3, 3).  ray (3,): the frame's centre in C.  zenith (3,) in ITRS.
    covariance (2, 2) in rad2: of the axis along `across` (2, 3) in S, with the scatter of the directions.
    scatter2: variance beyond the stated, as a share of it.  directions, frames: numbers.
    """

    a3: np.ndarray
    ray: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    covariance: np.ndarray
    scatter2: float
    directions: int
    circles: Sequence[Circle]

    @property
    def stddev_arcsec(self) -> float:
        """Sigma of the axis on the worse of two axes."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]) / ARCSEC)

    def calibration(self, given: Calibration, turn_stddev_deg: float) -> Calibration:
        """The calibration, whose turn about the axis is as `given`, to turn_stddev_deg."""
        axis = self.a3 @ self.ray
        turns = np.cross(axis, self.across)
        turn = min(np.radians(turn_stddev_deg), UNKNOWN_ARCSEC[2] * ARCSEC)
        covariance = turns.T @ self.covariance @ turns + turn**2 * np.outer(axis, axis)
        up = rotation.normalised(np.sum([c.up for c in self.circles], axis=0))
        return replace(
            given.turned_to(self.a3),
            covariance_arcsec2=tuple(map(tuple, (covariance / ARCSEC**2).tolist())),
            utc_unix_s=float(np.mean([c.utc_unix_s for c in self.circles])),
            tilt_deg=tuple(np.degrees(angles_at(up, self.circles[0].axes)).tolist()),
            frames=len(self.circles),
            valid_days=VALID_DAYS,
            response=(),
            response_covariance=(),
        )

    def about(self, a3: np.ndarray) -> list[Circle]:
        """The circles with the zenith distances of another A3 (3, 3), as far as they are linear in its error here."""
        moved = self.across @ a3 @ self.ray
        return [
            replace(c, zenith_distance=c.zenith_distance + float(_slope(c, self.across) @ moved))
            for c in self.circles
        ]


def find_axis(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    site: Place | None = None,
    near: tuple[float, float] | None = None,
) -> FoundAxis:
    """Fit A3's axis, and the zenith unless a site is given; `given` counts as well as it is known.

    ray (3,): the frame's centre in C.  near: latitude, longitude (rad) that selects one of two answers.
    Raises FixError if the directions are too few, or leave two answers.
    """
    first = Directions.of(sorted(circles_of(given.a3), key=lambda c: c.utc_unix_s))
    number, fewest = len(first.circles), MIN_WITHOUT_SITE if site is None else FEWEST
    if number < fewest:
        raise FixError(
            f"elevations in {number} {'direction' if number == 1 else 'directions'} do not determine A3: without a roll "
            f"it takes {fewest} or more (frames of a camera that stands still are one)"
        )
    if site is not None:
        zeniths = [site.plumb_axes[2]]
    else:
        tried = sorted(starts(first), key=lambda z: float(np.median(np.abs(first.residual(z)[0]))))
        zeniths = [*_round(first), *tried[:TRIED]]
    found: list[tuple[float, FoundAxis]] = []
    for zenith in zeniths:
        one = _fitted(circles_of, given, ray, zenith, None if site is None else site.plumb_stddev)
        if one is not None:
            found.append(one)
    if not found:
        raise FixError(
            "the elevations do not determine A3: check the tilts, the clock and that nothing was moved"
        )
    found.sort(key=lambda f: f[0])
    best = found[0][1]
    left = [f for chi2, f in found if chi2 - found[0][0] < EXCLUDED_SIGMA**2 * (1 + best.scatter2)]
    if near is not None:
        there = rotation.unit_vector(near[1], near[0])
        return max(left, key=lambda f: float(f.zenith @ there))
    if max(np.linalg.norm(f.zenith - best.zenith) for f in left) > 2 * EXCLUDED_SIGMA * _wide(best):
        raise FixError(
            "the elevations leave two places and two A3: turn the camera to directions of other altitudes too, state A3 "
            "better, or say where it is with --near LAT LON"
        )
    return best


def _wide(found: FoundAxis) -> float:
    """How far (rad) a zenith may be from another that is the same answer."""
    return float(max(np.sqrt(np.linalg.eigvalsh(found.covariance)[-1]), 1e-6))


def _round(part: Directions) -> list[np.ndarray]:
    """Zeniths (3,) about which all directions lie on a circle, as they do where the sensor leans alike in all."""
    axes = np.array([group[0].itrs for group in part.circles])
    if len(axes) < 3:
        return []
    normal = np.linalg.svd(axes - axes.mean(0))[2][-1]
    return [normal, -normal]


def _slope(circle: Circle, across: np.ndarray) -> np.ndarray:
    """Change (2,) of a circle's measured zenith distance by a move of the axis along `across` (2, 3) in S."""
    return -(across @ circle.up) / max(np.sin(circle.zenith_distance), 1e-9)


@at_once
@dataclass(frozen=True, kw_only=True)
class _Normal:
    """The least-squares problem at an A3 (3, 3) and a zenith (3,): its unknowns are the axis, and perhaps the zenith."""

    a3: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    matrix: np.ndarray
    pull: np.ndarray
    prior: np.ndarray
    chi2: float
    part: Directions
    circles: Sequence[Circle]


def _fitted(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    zenith: np.ndarray,
    zenith_sigma: float | None,
) -> tuple[float, FoundAxis] | None:
    """The answer near a zenith, by Levenberg and Marquardt's method, with its chi-square; None if it does not converge.

    Axis and zenith together lie in a narrow, bent valley where the sensor leans about alike in all directions.
    """
    damping, now = FIRST_DAMPING, _normal(circles_of, given, ray, given.a3, zenith, zenith_sigma)
    if now is None:
        return None
    for _ in range(AXIS_ROUNDS):
        damped = now.matrix + damping * np.diag(np.diag(now.matrix))
        step = -np.linalg.solve(damped, now.pull)
        moved = rotation.normalised(now.a3 @ ray + step[:2] @ now.across)
        a3 = rotation.shortest_turn(now.a3 @ ray, moved) @ now.a3
        there = now.zenith
        if zenith_sigma is None:
            there = rotation.normalised(there + step[2:] @ now.part.east_north(there))
        tried = _normal(circles_of, given, ray, a3, there, zenith_sigma)
        if tried is None or tried.chi2 > now.chi2:
            damping *= 10
            if damping > LAST_DAMPING:
                break
            continue
        gain, now, damping = now.chi2 - tried.chi2, tried, damping / 10
        if gain < SETTLED_CHI2:
            break
    spread = np.linalg.inv(now.matrix)
    told = len(spread) - float(np.trace(now.prior @ spread[:2, :2]))
    number = len(now.part.circles)
    scatter2 = excess(now.chi2, int(number - np.floor(told + 1e-6)))
    answer = FoundAxis(
        a3=now.a3,
        ray=ray,
        zenith=now.zenith,
        across=now.across,
        covariance=spread[:2, :2] * (1 + scatter2),
        scatter2=scatter2,
        directions=number,
        circles=now.circles,
    )
    return now.chi2, answer


def _normal(
    circles_of: CirclesOf,
    given: Calibration,
    ray: np.ndarray,
    a3: np.ndarray,
    zenith: np.ndarray,
    zenith_sigma: float | None,
) -> _Normal | None:
    """Linearise at an A3 and a zenith; None for an axis that some frames cannot have.

    zenith_sigma: None if the zenith is unknown.
    """
    circles = sorted(circles_of(a3), key=lambda c: c.utc_unix_s)
    if len(circles) < len(circles_of(given.a3)):
        return None
    part, axis = Directions.of(circles), a3 @ ray
    left, of_zenith = part.residual(zenith)
    across = np.linalg.svd(axis[None])[2][1:]
    of_axis = -np.array([np.mean([_slope(c, across) for c in g], axis=0) for g in part.circles])
    stated = np.sum([c for name, c in part.sources.items() if name != OF_A3], axis=0)
    slope = of_axis
    if zenith_sigma is None:
        slope = np.hstack([of_axis, of_zenith])
    else:
        stated = stated + zenith_sigma**2 * of_zenith @ of_zenith.T
    # how far the axis is from where it was given, in units of what is known of it
    turns = np.cross(axis, across)
    about = np.asarray(given.covariance_arcsec2, float) * ARCSEC**2
    prior = np.linalg.inv(turns @ about @ turns.T + MIN_RAD**2 * np.eye(2))
    off = across @ (axis - given.a3 @ ray)
    weighted = np.linalg.solve(stated, np.column_stack([left, slope]))
    matrix, pull = slope.T @ weighted[:, 1:], slope.T @ weighted[:, 0]
    matrix[:2, :2] += prior
    pull[:2] += prior @ off
    return _Normal(
        a3=a3,
        zenith=zenith,
        across=across,
        matrix=matrix,
        pull=pull,
        prior=prior,
        chi2=float(left @ weighted[:, 0] + off @ prior @ off),
        part=part,
        circles=circles,
    )
