# SPDX-License-Identifier: Apache-2.0
"""Estimate how much frames scatter beyond their stated errors, and the effect on their common answer.

An inclinometer may have an error of each pose, or one that wanders (wind, soft ground, warming up), or more noise than
stated, and its axes may err with the lean. None of this need be stated; the frames show it. Every kind and size is
tried, weighted by its evidence, and the answer is the mean over all (Bayesian model averaging), so that few frames make
a wide claim and many a narrow one.

The error of a pose may be new at each pose (hysteresis, a soft footing). Or it is a smooth function of the camera's lean
(a mount that bends, a sensor that is not linear), or of its whole attitude (cables that pull, a bearing). This is a
Gaussian process of unknown length (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section
4.2). Then poses near each other are alike, and many of them add little to one. docs/error_budget.md has the model in
words.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.frozen import at_once
from starpos.units import ARCSEC

# sizes: from a share of a frame's own error to the most that any sensor has
MIN_SHARE, MAX_RAD, SIZES = 0.5, 3600 * ARCSEC, 12
# correlation times of an error, and maximum mean correlation of the frames: an error that hardly changes in the whole
# time looks like a constant
FORGETS_S, MAX_ALIKE = (15.0, 60.0, 240.0, 1000.0, 4000.0), 0.75
# lengths in rad over which an error of the pose changes with the lean, and with the attitude
LEAN_RAD, ATTITUDE_RAD = (0.05, 0.15, 0.5), (0.2, 0.6, 1.5)
# share of its variance that is new at each pose all the same
ROUGH = (0.03, 0.3)
# excess noise of readings in addition to another error: sizes of that noise over the scatter of the frames of a pose
NOISES, NOISY_SIGMA = (0.7, 1.0, 1.4), 4.0
# probability above which we report that the sensor's response error is understated
SHOWN = 0.75
# probability that all is as stated, below which the scatter is evident
EVIDENT = 0.25
# sizes of the coefficients of the response, in addition to the stated ones
RESPONSES = (0.0, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
# prior probability that all is as stated; a larger error is the less likely, in proportion
AS_STATED = 0.7
# minimum degrees of freedom of frames or poses; MIN_FREE_CONTRADICTING if they contradict the stated errors by
# CONTRADICT_SIGMA
MIN_FREE, MIN_FREE_CONTRADICTING, CONTRADICT_SIGMA = 2.5, 0.5, 4.0
# maximum number of frames or means of frames; more are averaged first
MAX_ROWS = 64


@at_once
@dataclass(frozen=True, kw_only=True)
class Frames:
    """The data of K frames on n parameters that they share, all per axis of two.

    utc_unix_s (K,).  pose (K,): number of each one's pose, from 0.
    attitude (K, 3, 3): takes axes of the ground (ITRS) into the camera's axes.  up (K, 3): in axes of the instrument.
    residual (K, 2) in rad, where the parameters are 0, and its derivatives design (K, 2, n) by them.
    sigma (K,) in rad: own error of each frame.  pose_sigma (rad): stated error of a pose.
    prior_sigma (n,): of the parameters about 0.  response (n,): mask of the coefficients of a response.
    zero_free: whether the parameters hold an error that is the same at all poses, as an A3 that is being found does.
    """

    utc_unix_s: np.ndarray
    pose: np.ndarray
    attitude: np.ndarray
    up: np.ndarray
    residual: np.ndarray
    design: np.ndarray
    sigma: np.ndarray
    pose_sigma: float
    prior_sigma: np.ndarray
    response: np.ndarray
    zero_free: bool

    def blocks(self) -> np.ndarray:
        """Weights (B, K) that average frames next to each other in a pose, so that at most about MAX_ROWS are left."""
        order = np.lexsort((self.utc_unix_s, self.pose))
        number = np.bincount(self.pose)
        rank = np.empty(len(order), int)
        rank[order] = np.concatenate([np.arange(n) for n in number])
        size = -(-len(order) // MAX_ROWS)
        block = np.unique(self.pose * len(order) + rank // size, return_inverse=True)[1]
        weight = np.zeros((block.max() + 1, len(order)))
        weight[block, np.arange(len(order))] = 1 / self.sigma**2
        return weight / weight.sum(1)[:, None]


@at_once
@dataclass(frozen=True, kw_only=True)
class Scatter:
    """The result of the frames, as means over all hypotheses.

    pose_sigma (rad): root of the mean variance of errors that do not average out within a pose. frame_sigma (rad): the
    same of all errors of a frame in addition to its own stated error. noise_sigma (rad): of errors new in each frame.
    evident: whether it is improbable that the frames scatter as stated; response_evident: that the response
    errs as stated.
    moved (n,), covariance (n, n): of the parameters.  stated (n, n): their covariance if all is as stated, and the
    stated error of a pose new at each.
    """

    pose_sigma: float
    frame_sigma: float
    noise_sigma: float
    evident: bool
    response_evident: bool
    moved: np.ndarray
    covariance: np.ndarray
    stated: np.ndarray


@at_once
@dataclass(frozen=True)
class _Kind:
    """An error of unit size: its covariance (B, B), and mean variances (3,) over poses, over frames, and as noise."""

    kernel: np.ndarray
    means: np.ndarray


def scatter_of(frames: Frames) -> Scatter:
    """Estimate the frames' scatter and the parameters that they share."""
    share, poses = frames.blocks(), _pose_means(frames)
    y, j = share @ frames.residual, np.einsum("bk,kin->bin", share, frames.design)
    own = np.diag(share**2 @ frames.sigma**2)
    shapes = _shapes(frames, share, poses)
    stated = own + frames.pose_sigma**2 * shapes[0].kernel
    # each hypothesis: its prior, its covariance, and its mean variances beyond what is stated
    many = 1 if frames.pose_sigma == 0 else len(shapes)
    tried = [
        (AS_STATED / many, own + frames.pose_sigma**2 * shape.kernel, np.zeros(3)) for shape in shapes[:many]
    ]
    few = False
    if _freedom(y, j, stated, frames.prior_sigma)[1]:
        of_poses = np.einsum("pk,kin->pin", poses, frames.design)
        each = np.diag(poses**2 @ frames.sigma**2 + frames.pose_sigma**2)
        free, tell = _freedom(poses @ frames.residual, of_poses, each, frames.prior_sigma)
        few = tell and free < MIN_FREE
        wandering, posed = _wandering(frames, share, poses), shapes if tell else []
        least = MIN_SHARE * float(np.sqrt(np.median(frames.sigma**2)))
        sizes = np.geomspace(least, max(MAX_RAD, 10 * least), SIZES)
        prior = (1 - AS_STATED) * _shrinking(sizes) / (len(wandering) + len(posed))
        tried += _sized(stated, wandering, sizes, prior)
        noises = _noises(frames)
        for shape in posed:
            # the whole error of the pose has one shape
            beside = own + frames.pose_sigma**2 * shape.kernel
            tried += _sized(beside, [shape], sizes, prior)
            # and frames of a pose may have more noise too
            for noise in noises:
                more = _sized(beside + noise**2 * wandering[0].kernel, [shape], sizes, prior / len(noises))
                means: np.ndarray = noise**2 * wandering[0].means
                tried += [(w, c, v + means) for w, c, v in more]
    weights, covariances, shares = zip(*tried, strict=True)
    normals, pulls, bares = _sums(y, j, np.array(covariances))
    # each hypothesis of the scatter with each of the response, one after another
    number = len(RESPONSES) if frames.response.any() else 1
    wide_prior = np.append(AS_STATED, (1 - AS_STATED) * _shrinking(np.array(RESPONSES[1:])))[:number]
    wide = np.tile(RESPONSES[:number], len(weights))[:, None]
    prior_sigma = np.where(frames.response, np.hypot(frames.prior_sigma, wide), frames.prior_sigma)
    normals, pulls, bares = (np.repeat(each, number, axis=0) for each in (normals, pulls, bares))
    moved, spread, evidence = _answers(normals, pulls, bares, prior_sigma)
    log_weight = evidence + np.log(np.outer(weights, wide_prior).ravel())
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    # the response is doubted only if the frames show an error; few poses that contradict each other leave it open
    wider = np.arange(len(weight)) % number > 0
    if not few and weight[wider].sum() < SHOWN:
        weight[wider] = 0.0
        weight /= weight.sum()
    mean = weight @ moved
    off = moved - mean
    pose2, frame2, noise2 = weight @ np.repeat(np.array(shares), number, axis=0)
    return Scatter(
        pose_sigma=float(np.sqrt(pose2 + frames.pose_sigma**2)),
        frame_sigma=float(np.sqrt(frame2 + frames.pose_sigma**2)),
        noise_sigma=float(np.sqrt(noise2)),
        evident=bool(weight[: many * number].sum() < EVIDENT),
        response_evident=bool(weight[wider].sum() > 1 - EVIDENT),
        moved=mean,
        covariance=np.tensordot(weight, spread, 1) + (weight * off.T) @ off,
        stated=spread[0],
    )


def _pose_means(frames: Frames) -> np.ndarray:
    """Weights (P, K) that average the frames of each pose."""
    weight = (np.arange(frames.pose.max() + 1)[:, None] == frames.pose) / frames.sigma**2
    return weight / weight.sum(1)[:, None]


def _freedom(y: np.ndarray, j: np.ndarray, stated: np.ndarray, prior_sigma: np.ndarray) -> tuple[float, bool]:
    """Degrees of freedom of data (B, 2), and whether these show that they scatter more than (B, B) states."""
    normal, pull, _ = _sums(y, j, stated[None])
    free = 2 * len(y) - _determined(normal[0], prior_sigma)
    if free >= MIN_FREE:
        return free, True
    scaled, pulled = normal[0] * np.outer(prior_sigma, prior_sigma), pull[0] * prior_sigma
    fitted = pulled @ np.linalg.solve(scaled + np.eye(len(scaled)), pulled)
    chi2 = np.sum(y * np.linalg.solve(stated, y)) - fitted
    return free, bool(free >= MIN_FREE_CONTRADICTING and chi2 > free + CONTRADICT_SIGMA * np.sqrt(2 * free))


def _shapes(frames: Frames, share: np.ndarray, poses: np.ndarray) -> list[_Kind]:
    """Errors of a pose: new at each, and smooth functions of the lean and of the attitude, over each length.

    The first is new at each pose.  Smooth errors that are about equal at all poses are left out: they act as a zero.
    """
    leans2 = np.sum((frames.up[:, None] - frames.up) ** 2, axis=2)
    # half the squared norm is the squared angle where that is small; it keeps the kernel positive
    turns2 = np.sum((frames.attitude[:, None] - frames.attitude) ** 2, axis=(2, 3)) / 2
    alike = [np.exp(-leans2 / (2 * length**2)) for length in LEAN_RAD]
    alike += [np.exp(-turns2 / (2 * length**2)) for length in ATTITUDE_RAD]
    new = (frames.pose[:, None] == frames.pose).astype(float)
    smooth = [a for a in alike if a.mean() < MAX_ALIKE]
    if frames.zero_free:
        # what is left of a smooth function once its mean over the poses is part of the zero
        mean = poses.mean(0)
        smooth = [a - a @ mean - (a @ mean)[:, None] + mean @ a @ mean for a in smooth]
    return [_kind(share, poses, a) for a in (new, *(r * new + (1 - r) * a for a in smooth for r in ROUGH))]


def _noises(frames: Frames) -> list[float]:
    """Sizes (rad) of noise beyond that stated, if frames of one pose differ by clearly more than that."""
    poses = frames.pose.max() + 1
    free = 2 * (len(frames.pose) - poses)
    if not free:
        return []
    off = frames.residual - (_pose_means(frames) @ frames.residual)[frames.pose]
    excess = np.sum(off**2 / frames.sigma[:, None] ** 2) / free
    if excess < 1 + NOISY_SIGMA * np.sqrt(2 / free):
        return []
    size = float(np.sqrt((excess - 1) * np.mean(frames.sigma**2)))
    return [n * size for n in NOISES]


def _wandering(frames: Frames, share: np.ndarray, poses: np.ndarray) -> list[_Kind]:
    """Errors that are noise, walk away from 0, grow, or wander and forget themselves in a time (Ornstein, Uhlenbeck)."""
    t = frames.utc_unix_s - frames.utc_unix_s.min()
    apart, longest = np.abs(t[:, None] - t), float(t.max())
    kinds = [_kind(share, poses, np.eye(len(t)), 1.0)]
    if longest:
        kinds.append(_kind(share, poses, np.minimum(t[:, None], t) / longest))
        kinds.append(_kind(share, poses, np.outer(t, t) / longest**2))
    alike = [np.exp(-apart / forgets_s) for forgets_s in FORGETS_S]
    return kinds + [_kind(share, poses, a) for a in alike if a.mean() < MAX_ALIKE]


def _kind(share: np.ndarray, poses: np.ndarray, covariance: np.ndarray, noise: float = 0.0) -> _Kind:
    """An error from its covariance (K, K) of the frames; noise: the variance of it that is noise."""
    of_pose = float(np.mean(np.einsum("pk,kl,pl->p", poses, covariance, poses)))
    return _Kind(
        share @ covariance @ share.T, np.array([of_pose, float(np.mean(np.diag(covariance))), noise])
    )


def _sized(
    beside: np.ndarray, kinds: Sequence[_Kind], sizes: np.ndarray, prior: np.ndarray
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Hypotheses of errors of each size (S,), with their priors (S,), added to errors of covariance `beside` (B, B)."""
    return [
        (float(w), beside + size**2 * kind.kernel, size**2 * kind.means)
        for kind in kinds
        for size, w in zip(sizes, prior, strict=True)
    ]


def _shrinking(sizes: np.ndarray) -> np.ndarray:
    """Prior of sizes in even steps of their logarithm: one of four times the size is half as likely."""
    return sizes**-0.5 / np.sum(sizes**-0.5)


def _sums(y: np.ndarray, j: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normal matrices, right-hand sides, and -2 log likelihoods of data (B, 2) with covariances (H, B, B) an axis."""
    lower = np.linalg.cholesky(covariance)
    n = j.shape[2]
    # one more axis: numpy before 2 takes a matrix combined with a stack of matrices for a stack of vectors
    white = np.linalg.solve(lower, np.concatenate([y, j.reshape(len(y), -1)], 1)[None])
    seen, slope = white[..., :2].reshape(len(lower), -1), white[..., 2:].reshape(len(lower), -1, n)
    turned = slope.swapaxes(1, 2)
    log_determinant = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(1)
    return (
        turned @ slope,
        -(turned @ seen[..., None])[..., 0],
        np.sum(seen**2, axis=1) + 4 * log_determinant,
    )


def _determined(normal: np.ndarray, prior_sigma: np.ndarray) -> float:
    """Number of parameters that the data determine rather than the prior."""
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
