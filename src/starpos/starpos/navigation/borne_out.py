# SPDX-License-Identifier: Apache-2.0
"""Check a law of motion against a record: how much wind and gusts change from one minute to the next.

Only the motion across the nose shows it, since the speed along the nose is unknown.  A trend, steady from end to end of
the record, looks like an error of the place, so it cannot be used.  Minutes reveal it as far as a wind is a random walk.
A slow swing, half a wave or two over the record, hides a trend of its own size.  Calm air may drift without either, so
the record may widen how fast the drift changes, and never narrows it.
"""

from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import enu_axes
from starpos.earth.gravity import geodetic_place, zenith_at
from starpos.navigation.laws import MotionLaw
from starpos.navigation.motion import Motion

# duration of the means, longer in a long record; minimum and maximum number of means
MEAN_S, FEWEST, MOST = 60.0, 5, 40
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
    number = int(min(t[-1] // MEAN_S, MOST))
    if number < FEWEST:
        return law
    side, across = _sideways(motion)
    latitude, longitude, _ = (float(x) for x in geodetic_place(motion.place[len(motion) // 2]))
    means = independent_means(t, side @ enu_axes(latitude, longitude)[:2].T, across, number)
    rest, trend = law.rest_at(float(np.median(np.diff(t)))), law.drift_walk / t[-1] ** 0.5
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


def _sideways(motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Level directions (K, 3) across the nose at each node, and the velocity (K,) along them."""
    side = np.cross(zenith_at(motion.place), motion.attitude[:, :, 0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return side, np.einsum("ki,ki->k", side, motion.velocity)


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
