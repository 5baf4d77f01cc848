# SPDX-License-Identifier: Apache-2.0
"""How much frames scatter beyond what they state, and what that makes of the answer of all.

An inclinometer may have an error that is new at each pose (hysteresis, flexure, a soft footing), or one that wanders
(wind, soft ground, warming up), or more noise than stated, and its axes may err with the lean. Nobody need have stated
any of it; the frames tell. Every kind and size is tried, weighted by its evidence, and the answer is the mean over all,
so that few frames make a wide claim and many a narrow one.
"""

from dataclasses import dataclass

import numpy as np

from starpos.units import ARCSEC

# sizes: from a share of a frame's own error to the most that any sensor has
LEAST_SHARE, MOST_RAD, SIZES = 0.5, 3600 * ARCSEC, 12
# times in which an error forgets itself, and the most that frames may be alike on average: what hardly changes in the
# whole time cannot be told from a constant
FORGETS_S, MOST_ALIKE = (15.0, 60.0, 240.0, 1000.0, 4000.0), 0.75
# the response errs more than stated where that is so probable
SHOWN = 0.75
# the scatter is evident where it is so improbable that all is as stated
EVIDENT = 0.25
# sizes of the coefficients of the response, beside what is stated
RESPONSES = (0.0, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
# prior probability that all is as stated; a larger error is the less likely, in proportion
AS_STATED = 0.7
# with fewer degrees of freedom the frames, or the poses, do not tell
FEWEST_FREE = 2.5
# so many frames or means of frames are looked at; more are averaged before
MOST_ROWS = 64


@dataclass(frozen=True, kw_only=True)
class Frames:
    """What K frames say of n parameters that they share, all per axis of two.

    utc_unix_s (K,).  pose (K,): number of each one's pose, from 0.
    residual (K, 2) in rad, where the parameters are 0, and its derivatives design (K, 2, n) by them.
    sigma (K,) in rad: own error of each frame.  pose_sigma (rad): stated error that is new at each pose.
    prior_sigma (n,): of the parameters about 0.  response (n,): mask of those that are coefficients of a response.
    """

    utc_unix_s: np.ndarray
    pose: np.ndarray
    residual: np.ndarray
    design: np.ndarray
    sigma: np.ndarray
    pose_sigma: float
    prior_sigma: np.ndarray
    response: np.ndarray

    def blocks(self) -> np.ndarray:
        """Weights (B, K) that average frames next to each other in a pose, so that at most about MOST_ROWS are left."""
        order = np.lexsort((self.utc_unix_s, self.pose))
        number = np.bincount(self.pose)
        rank = np.empty(len(order), int)
        rank[order] = np.concatenate([np.arange(n) for n in number])
        size = -(-len(order) // MOST_ROWS)
        block = np.unique(self.pose * len(order) + rank // size, return_inverse=True)[1]
        weight = np.zeros((block.max() + 1, len(order)))
        weight[block, np.arange(len(order))] = 1 / self.sigma**2
        return weight / weight.sum(1)[:, None]


@dataclass(frozen=True, kw_only=True)
class Scatter:
    """What the frames tell, as means over all hypotheses.

    pose_sigma (rad): root of the mean variance of what does not average away within a pose; frame_sigma (rad): the same
    of all that a frame has beside its own stated error.
    evident: whether it is improbable that all is as stated.
    moved (n,), covariance (n, n): of the parameters.  stated (n, n): their covariance if all is as stated.
    """

    pose_sigma: float
    frame_sigma: float
    evident: bool
    moved: np.ndarray
    covariance: np.ndarray
    stated: np.ndarray


@dataclass(frozen=True)
class _Kind:
    """A hypothesis: the covariance (B, B) of an error of unit size, and its means over poses and over frames."""

    kernel: np.ndarray
    of_pose: float
    of_frame: float


def scatter_of(frames: Frames) -> Scatter:
    """What frames tell of their scatter and of the parameters that they share."""
    share = frames.blocks()
    poses = _pose_means(frames)
    y, j = share @ frames.residual, np.einsum("bk,kin->bin", share, frames.design)
    own = np.diag(share**2 @ frames.sigma**2)
    same_pose = _Kind(share @ (frames.pose[:, None] == frames.pose) @ share.T, 1.0, 1.0)
    stated = own + frames.pose_sigma**2 * same_pose.kernel
    normal, pull, bare = _sums(y, j, stated)
    kinds: list[_Kind] = []
    sizes: np.ndarray = np.zeros(0)
    if 2 * len(y) - _told(normal, frames.prior_sigma) >= FEWEST_FREE:
        kinds = _wandering(frames, share, poses)
        of_poses = np.einsum("pk,kin->pin", poses, frames.design)
        told, _, _ = _sums(poses @ frames.residual, of_poses, np.diag(poses**2 @ frames.sigma**2))
        if 2 * len(poses) - _told(told, frames.prior_sigma) >= FEWEST_FREE:
            kinds = [same_pose, *kinds]
        least = LEAST_SHARE * float(np.sqrt(np.median(frames.sigma**2)))
        sizes = np.geomspace(least, max(MOST_RAD, 10 * least), SIZES)
    prior = np.append(
        AS_STATED, np.tile((1 - AS_STATED) * _shrinking(sizes), len(kinds)) / max(len(kinds), 1)
    )
    number = len(RESPONSES) if frames.response.any() else 1
    wide_prior = np.append(AS_STATED, (1 - AS_STATED) * _shrinking(np.array(RESPONSES[1:])))[:number]
    variances = np.array([(0.0, 0.0)] + [(k.of_pose * s**2, k.of_frame * s**2) for k in kinds for s in sizes])
    sums = [(normal, pull, bare)] + [_sums(y, j, stated + s**2 * k.kernel) for k in kinds for s in sizes]
    # each hypothesis of the scatter with each of the response, one after another
    wide = np.tile(RESPONSES[:number], len(sums))[:, None]
    prior_sigma = np.where(frames.response, np.hypot(frames.prior_sigma, wide), frames.prior_sigma)
    normals, pulls, bares = (np.repeat(np.array(each), number, axis=0) for each in zip(*sums, strict=True))
    moved, spread, evidence = _answers(normals, pulls, bares, prior_sigma)
    log_weight = evidence + np.log(np.outer(prior, wide_prior).ravel())
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    # nobody's word against a sensor is enough to doubt its response: the frames have to show it
    wider = np.arange(len(weight)) % number > 0
    if weight[wider].sum() < SHOWN:
        weight[wider] = 0.0
        weight /= weight.sum()
    mean = weight @ moved
    off = moved - mean
    pose2, frame2 = weight @ np.repeat(variances, number, axis=0)
    return Scatter(
        pose_sigma=float(np.sqrt(pose2 + frames.pose_sigma**2)),
        frame_sigma=float(np.sqrt(frame2 + frames.pose_sigma**2)),
        evident=bool(weight[0] < EVIDENT),
        moved=mean,
        covariance=np.tensordot(weight, spread, 1) + (weight * off.T) @ off,
        stated=spread[0],
    )


def _pose_means(frames: Frames) -> np.ndarray:
    """Weights (P, K) that average the frames of each pose."""
    weight = (np.arange(frames.pose.max() + 1)[:, None] == frames.pose) / frames.sigma**2
    return weight / weight.sum(1)[:, None]


def _wandering(frames: Frames, share: np.ndarray, poses: np.ndarray) -> list[_Kind]:
    """Errors that are noise, walk away from 0, grow, or wander and forget themselves in a time (Ornstein, Uhlenbeck)."""
    t = frames.utc_unix_s - frames.utc_unix_s.min()
    apart, longest = np.abs(t[:, None] - t), float(t.max())
    kinds = [_kind(share, poses, np.eye(len(t)))]
    if longest:
        kinds.append(_kind(share, poses, np.minimum(t[:, None], t) / longest))
        kinds.append(_kind(share, poses, np.outer(t, t) / longest**2))
    alike = [np.exp(-apart / forgets_s) for forgets_s in FORGETS_S]
    return kinds + [_kind(share, poses, a) for a in alike if a.mean() < MOST_ALIKE]


def _kind(share: np.ndarray, poses: np.ndarray, covariance: np.ndarray) -> _Kind:
    """A hypothesis from its covariance (K, K) of the frames."""
    of_pose = float(np.mean(np.einsum("pk,kl,pl->p", poses, covariance, poses)))
    return _Kind(share @ covariance @ share.T, of_pose, float(np.mean(np.diag(covariance))))


def _shrinking(sizes: np.ndarray) -> np.ndarray:
    """Prior of sizes in even steps of their logarithm: one of four times the size is half as likely."""
    return sizes**-0.5 / np.sum(sizes**-0.5)


def _sums(y: np.ndarray, j: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal matrix, right-hand side, and -2 log likelihood of data (B, 2) with a covariance (B, B) for either axis."""
    lower = np.linalg.cholesky(covariance)
    n = j.shape[2]
    white = np.linalg.solve(lower, np.concatenate([y, j.reshape(len(y), -1)], 1))
    y, j = white[:, :2].ravel(), white[:, 2:].reshape(-1, n)
    return j.T @ j, -j.T @ y, float(y @ y + 4 * np.log(np.diag(lower)).sum())


def _told(normal: np.ndarray, prior_sigma: np.ndarray) -> float:
    """Number of parameters that the data tell rather than the prior."""
    told = np.maximum(np.linalg.eigvalsh(normal * np.outer(prior_sigma, prior_sigma)), 0.0)
    return float(np.sum(told / (1 + told)))


def _answers(
    normal: np.ndarray, pull: np.ndarray, bare: np.ndarray, prior_sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (H, n), their covariances, and the logarithms (H,) of the evidence, of H hypotheses."""
    # in units of the prior, so that the loose and the tight are of one size
    scale = prior_sigma[:, :, None] * prior_sigma[:, None]
    whole = normal * scale + np.eye(pull.shape[1])
    inverse, pull = np.linalg.inv(whole), pull * prior_sigma
    moved = (inverse @ pull[..., None])[..., 0]
    evidence = (np.sum(moved * pull, axis=1) - bare - np.linalg.slogdet(whole)[1]) / 2
    return prior_sigma * moved, scale * inverse, evidence
