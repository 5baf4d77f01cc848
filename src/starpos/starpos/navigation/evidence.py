# SPDX-License-Identifier: Apache-2.0
"""What a record itself shows of its assumptions: where the vehicle stands, and how well a law of motion holds.

docs/navigation.md, how it works, says which signs have to agree and why.  Of a law of motion a trend, steady from end to
end, cannot be used, since it looks like an error of the place; a slow swing hides a trend of its own size.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from starpos.earth.gravity import enu_at, zenith_at
from starpos.frozen import ArrayRows
from starpos.navigation.chain import Smoothed
from starpos.navigation.equations import Motion, Residuals, StarAttitudes
from starpos.navigation.preintegration import Pieces
from starpos.navigation.vessel import MotionLaw
from starpos.rotation import normalised
from starpos.units import ARCSEC

# turn rate (rad/s) above which it surely moves, and minimum time (s) between the frames that show it
TURNING, TOLD_S = 5e-4, 1.0
# minimum time (s) of motion before its motion is known, and maximum percentage of quiet seconds in it
LEARNT_S, QUIET_PERCENT = 60.0, 5.0
# maximum scatter of a standstill over the scatter of these quiet seconds; time (s) before and after that it covers
QUIETER, AROUND_S = 0.5, 1.0
# minimum number of frames of a standstill, and minimum time (s) from the first to the last
MIN_FRAMES, SHORTEST_S = 4, 8.0
# maximum error (rad) of a fine frame's two axes; maximum ratio of the variances of their attitudes to the stated ones
FINE, STEADY = 10 * ARCSEC, 2.0
# forces add up to no more, in m/s, than their mean
LEAP = 0.02
# maximum error (m/s an axis) of the velocity from the rest of the record, for a check; value of a chi-squared of three
# degrees of freedom that one in a thousand exceeds; minimum number of standstills that agree beyond chance
CHECKED, ONE_IN_1000, MIN_STANDSTILLS = 0.1, 16.3, 3
# of a residual's variance such a share is left at least: less is rounding
MIN_LEFT = 1e-5


@dataclass(frozen=True, eq=False, kw_only=True)
class Standstills(ArrayRows):
    """J standstills: the nodes first to last (J,) of each, both included."""

    first: np.ndarray
    last: np.ndarray

    def __len__(self) -> int:
        return len(self.first)

    @property
    def middle(self) -> np.ndarray:
        """A node (J,) of each."""
        return (self.first + self.last) // 2

    @property
    def nodes(self) -> np.ndarray:
        """All nodes (F,) of them."""
        return np.concatenate([np.zeros(0, int), *map(np.arange, self.first, self.last + 1)])

    def links(self, count: int) -> np.ndarray:
        """Mask (count - 1,) of the intervals between `count` nodes that lie within standstills."""
        edges = np.zeros(count, int)
        edges[self.first] += 1
        edges[self.last] -= 1
        return np.cumsum(edges)[:-1] > 0


NOWHERE = Standstills(first=np.zeros(0, int), last=np.zeros(0, int))


def standstills(stars: StarAttitudes, pieces: Pieces) -> Standstills:
    """The stretches in which the vehicle seems to stand, by attitudes and readings alone."""
    fine = (np.linalg.eigvalsh(stars.covariance)[:, 1] < FINE**2) & stars.whole
    if fine.sum() < MIN_FRAMES:
        return NOWHERE
    index, attitude = stars.index[fine], Rotation.from_matrix(stars.camera_to_itrs[fine])
    t = np.append(0.0, np.cumsum(pieces.span_s))
    scatter = _scatter(pieces, t)
    moving = _turning(index, attitude, t) & np.isfinite(scatter)
    if pieces.span_s[moving].sum() < LEARNT_S:
        return NOWHERE
    quiet = scatter < QUIETER * np.percentile(scatter[moving], QUIET_PERCENT)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], quiet, [0]])))
    found = []
    for first, last in edges.reshape(-1, 2):
        inside = (index >= first) & (index <= last)
        if inside.sum() < MIN_FRAMES:
            continue
        begin, end = index[inside][[0, -1]]
        if (
            t[end] - t[begin] >= SHORTEST_S
            and _steady(attitude[inside], stars.covariance[fine][inside])
            and _level(pieces, slice(begin, end))
        ):
            found.append((begin, end))
    first, last = np.array(found, int).reshape(-1, 2).T
    return Standstills(first=first, last=last)


def by_the_rest(trial: Residuals, sigma: float, solution: Smoothed) -> tuple[np.ndarray, np.ndarray]:
    """Velocities (J, 3) of standstills by the rest of a record, m/s along ITRS's axes, and covariances (J, 3, 3).

    trial: the equation of each standstill, within sigma m/s an axis, with which the record was solved.
    """
    slope, short = trial.rows[..., :-1], trial.rows[..., -1]
    constants = np.tile(solution.constants, (len(short), 1))
    unknowns = np.concatenate([solution.nodes[trial.index], constants], 1)
    left = short - np.einsum("jki,ji->jk", slope, unknowns)
    told = slope @ solution.covariance[trial.index] @ slope.transpose(0, 2, 1)
    # the errors of the residuals: where they nearly vanish, only the equation itself determines the velocity
    size, axes = np.linalg.eigh(np.eye(3) - told / sigma**2)
    inverse = (axes / np.maximum(size, MIN_LEFT)[:, None]) @ axes.transpose(0, 2, 1)
    return -np.einsum("jik,jk->ji", inverse, left), sigma**2 * (inverse - np.eye(3))


def judged_by(velocity: np.ndarray, covariance: np.ndarray, sigma: float) -> tuple[np.ndarray, bool]:
    """Mask (J,) of standstills where a vehicle that rolls would have shown, and whether any cannot be one.

    velocity, covariance: `by_the_rest`.
    """
    scaled = np.linalg.solve(covariance + sigma**2 * np.eye(3), velocity[..., None])[..., 0]
    contradicted = bool((np.einsum("ji,ji->j", velocity, scaled) > ONE_IN_1000).any())
    return np.linalg.eigvalsh(covariance)[:, -1] < CHECKED**2, contradicted


def noise_density2(pieces: Pieces, standing: Standstills) -> float:
    """Density of the force's noise within standstills, (m/s2)2/Hz an axis, by how intervals' means scatter.

    Not from reading to reading: a fan shakes those, and its shaking does not add up.  0 without standstills to use.
    """
    square, free = 0.0, 0
    for begin, end in zip(standing.first, standing.last, strict=True):
        whole = begin + np.flatnonzero(pieces.missing_s[begin:end] == 0)
        if len(whole) > 1:
            span = pieces.span_s[whole, None]
            push = (pieces.force[whole] * pieces.length_s[whole][..., None]).sum(1)
            off = push - push.sum(0) / span.sum() * span
            square, free = square + float((off**2 / span).sum()), free + 3 * (len(whole) - 1)
    return square / max(free, 1)


def _scatter(pieces: Pieces, t: np.ndarray) -> np.ndarray:
    """Scatter (K - 1,) of the forces from one reading to the next about each interval; of gaps, infinite."""
    there = (pieces.length_s[:, 1:] > 0) & (pieces.length_s[:, :-1] > 0)
    square = (np.diff(pieces.force, axis=1) ** 2).sum(2) * there
    total, count = (np.append(0.0, np.cumsum(part.sum(1))) for part in (square, there))
    middle = (t[1:] + t[:-1]) / 2
    total, count = (
        np.interp(middle + AROUND_S, t, part) - np.interp(middle - AROUND_S, t, part)
        for part in (total, count)
    )
    whole = (count > 0) & (pieces.missing_s == 0)
    return np.where(whole, np.sqrt(total / np.maximum(count, 1)), np.inf)


def _turning(index: np.ndarray, attitude: Rotation, t: np.ndarray) -> np.ndarray:
    """Mask (K - 1,) of the intervals between frames from one to the next of which it turns."""
    near = np.unique(np.searchsorted(t[index], np.arange(t[index[0]], t[index[-1]], TOLD_S)))
    if len(near) < 2:
        return np.zeros(len(t) - 1, bool)
    index, attitude = index[near], attitude[near]
    turn = (attitude[:-1].inv() * attitude[1:]).magnitude()
    turning = np.concatenate([[False], turn > TURNING * np.diff(t[index]), [False]])
    return turning[np.searchsorted(index, np.arange(len(t) - 1), "right")]


def _steady(attitude: Rotation, covariance: np.ndarray) -> bool:
    """Whether attitudes scatter about one by no more than their errors, covariances (F, 3, 3), say."""
    off = (attitude[len(attitude) // 2].inv() * attitude).as_rotvec()
    weight = np.linalg.inv(covariance)
    off = off - np.linalg.solve(weight.sum(0), np.einsum("kij,kj->i", weight, off))
    return float(np.einsum("ki,kij,kj", off, weight, off)) < STEADY * 3 * (len(off) - 1)


def _level(pieces: Pieces, part: slice) -> bool:
    """Whether the forces of a part push evenly from its begin to its end."""
    push = (pieces.force[part] * pieces.length_s[part][..., None]).sum(1)
    span = pieces.span_s[part][:, None]
    return bool(np.abs(np.cumsum(push - push.sum(0) / span.sum() * span, axis=0)).max() < LEAP)


# duration of the means, longer in a long record; minimum and maximum number of means
MEAN_S, MIN_MEANS, MAX_MEANS = 60.0, 5, 40
# factors of the law that are tried; the law is believed within a factor of e, 1 sigma
WALKS, RESTS = 2.0 ** np.arange(0, 5.1, 0.5), 2.0 ** np.arange(-6, 4.1, 0.5)
# of the trend that a walk as the law has it leaves: sizes of swings of SWINGS half waves, and how probable each is
TRENDS, SWINGS = np.append(0.0, 2.0 ** np.arange(0, 6.1, 0.5)), 4
PROBABLE = np.append(0.9, np.full(len(TRENDS) - 1, 0.1 / (len(TRENDS) - 1)))
# minimum certainty of a direction of means over the surest; less certain ones are dropped
RANK = 1e-6


def borne_out(law: MotionLaw, motion: Motion) -> MotionLaw:
    """The law with walk of the drift and size of the rest by the posterior mean of their variances, given a voyage."""
    t = motion.utc_unix_s - motion.utc_unix_s[0]
    number = int(min(t[-1] // MEAN_S, MAX_MEANS))
    if number < MIN_MEANS:
        return law
    # level, across the nose, and the velocity along it
    side = normalised(np.cross(zenith_at(motion.place), motion.attitude[:, :, 0]))
    across = np.einsum("ki,ki->k", side, motion.velocity)
    means = independent_means(t, side @ enu_at(motion.place[len(motion) // 2])[:2].T, across, number)
    rest = law.rest_stddev * law.longer(float(np.median(np.diff(t))))
    trend = law.drift_walk / t[-1] ** 0.5
    white = (WALKS[:, None, None] * law.drift_walk) ** 2 * means.walks + (RESTS[:, None] * rest) ** 2
    likely = np.stack([means.log_likelihood(white, trend * size) for size in TRENDS])
    likely += np.log(PROBABLE)[:, None, None] - (np.log(WALKS)[:, None] ** 2 + np.log(RESTS) ** 2) / 2
    weight = np.exp(likely - likely.max())
    weight /= weight.sum()
    walk2, rest2, trend2 = (
        weight.sum(others) @ factors**2
        for others, factors in (((0, 2), WALKS), ((0, 1), RESTS), ((1, 2), TRENDS))
    )
    # gusts that cancel in a minute still disturb each node
    gusts = float(np.std(across - np.einsum("ki,ki->k", side, motion.drift)))
    return replace(
        law,
        drift_walk=law.drift_walk * float(np.sqrt(walk2 + trend2)),
        rest_stddev=law.rest_stddev * max(float(np.sqrt(rest2)), gusts / rest),
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class Means:
    """D combinations of the means of velocities across the nose, independent of each other.

    values (D,): which white noise of 1 m/s at the nodes makes scatter by 1.  walks (D,): variances that a drift adds
    which walks by 1 m/s/sqrt(s).  swings (D, S): what drifts add whose change swings by 1 m/s2.
    """

    values: np.ndarray
    walks: np.ndarray
    swings: np.ndarray

    def log_likelihood(self, variance: np.ndarray, swing: float) -> np.ndarray:
        """Logarithms (...) of how likely the values are, by variances (..., D) and swings in m/s2, 1 sigma."""
        seen = self.swings * swing
        normal = np.eye(seen.shape[1]) + np.einsum("di,...d,dj->...ij", seen, 1 / variance, seen)
        right = (self.values / variance) @ seen
        told = np.einsum("...i,...i", right, np.linalg.solve(normal, right[..., None])[..., 0])
        scatter = (np.log(variance) + self.values**2 / variance).sum(-1)
        return -(scatter + np.linalg.slogdet(normal)[1] - told) / 2


def independent_means(t: np.ndarray, side: np.ndarray, across: np.ndarray, number: int) -> Means:
    """The Means of the parts of a record, free of a steady drift and of its steady change.

    t (K,) from 0, side (K, 2) level, across (K,) m/s.
    """
    block = np.minimum((t / t[-1] * number).astype(int), number - 1)
    here = block == np.arange(number)[:, None]
    means = (here[:, None, :] * side.T).reshape(2 * number, -1) / np.repeat(here.sum(1), 2)[:, None]
    # a step of the drift is in all that comes after it
    steps = np.cumsum((means[:, :, None] * side)[:, ::-1], 1)[:, ::-1]
    begin, change = steps[:, 0], (means * t) @ side
    steps = (steps * np.sqrt(np.diff(t, prepend=0.0))[:, None]).reshape(2 * number, -1)
    rate = np.arange(1, SWINGS + 1) * np.pi / t[-1]
    swings = np.hstack([(means * (np.sin(r * t) / r)) @ side for r in rate])
    # whitened, without directions that nothing was seen of
    axes, size, _ = np.linalg.svd(means, full_matrices=False)
    seen = size > RANK * size[0]
    white = (axes[:, seen] / size[seen]).T
    told = white @ np.hstack([begin, change])
    left, share, _ = np.linalg.svd(told)
    free = left[:, int((share > RANK * share[0]).sum()) :].T @ white
    walks, turn = np.linalg.eigh(free @ steps @ steps.T @ free.T)
    free = turn.T @ free
    return Means(values=free @ (means @ across), walks=np.maximum(walks, 0.0), swings=free @ swings)
