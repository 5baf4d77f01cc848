# SPDX-License-Identifier: Apache-2.0
"""Find a second sky on a frame: a double exposure, or a camera that was moved while it exposed.

The bright stars that an identification leaves over are mostly few. If they are not, two things are looked for. The first
is a constant offset: every star is there twice, which shows whatever the lens does and however few stars were matched.
The second is another pose of the same camera: what is left over is identified as any frame is, and accepted by the same
evidence. In both the second sky must be about as bright as the first: ghosts and glare are much fainter.

Two skies a few pixels apart may be identified as one between them. Then the residuals of neighbouring stars differ by
much more than their errors, and as much as the residuals of distant stars, which no lens does. And each
residual is one of two opposite ones, half of the offset, which centroids that err by more than they claim are not.
"""

import math

import numpy as np

from starpos.identification._frame import FrameStars
from starpos.identification.evidence import DOUBLE_PX, MIN_LOG_ODDS, Explained, Identification
from starpos.identification.pose import TEST_STARS, Pose, close_pairs
from starpos.identification.prior import PointingPrior
from starpos.identification.search import STAGES, near_or_lost
from starpos.identification.sky import Sky

# Minimum number and share of the TEST_STARS brightest that a second sky leaves unidentified.
MIN_LEFT, MIN_SHARE_LEFT = 4, 0.12
# Number of the brightest stars searched for twins, and of the leftover ones searched for another pose.
MAX_STARS = 2 * TEST_STARS
# Maximum ratio of the two skies' exposures, in magnitudes (2.5 mag: 1 to 10).
MAX_FAINTER_MAG = 2.5
# Maximum deviation of a star's magnitude offset between the two skies.
SAME_MAG = 1.0
# Offsets of twins agree to one of these: the widest is for a camera that was turned too, or a lens that bends.
OFFSETS_PX = 0.5, 2.0, 8.0
# Minimum length of an offset, in px and in tolerances, or the twins are one image with a tail; maximum length as a share
# of the frame.
NEAREST_PX, NEAREST, FARTHEST = 4.0, 2.0, 0.25
# Chance pairs are counted around the offset, out to this many tolerances: the companions of stars lie in a ring.
AROUND = 4
# Minimum share of twins among the bright stars, minimum spread of twins as a share of the frame in every direction, and
# maximum share of twins on both sides, which a row or a lattice of lights has.
MIN_SHARE, MIN_SPREAD, MAX_IN_ROWS = 0.25, 0.05, 0.25
# Minimum number of twins with one identified and one unidentified star.
MIN_LINKED = 3
# Stages of the search for another pose; the poor ones are for lenses that the first identification has dealt with.
QUICK_STAGES = STAGES[:2]
# Maximum difference of the other pose's focal length (share); maximum residuals over the first pose's (factor, px).
SAME_FOCAL, WORSE, WORSE_PX = 0.01, 2.0, 0.5
# Minimum share of equally bright leftovers that the second sky must explain.
MIN_SHARE_SECOND = 0.5
# From a star of the first sky to its neighbour, what a lens bends changes by at most this share of their distance.
STEEPEST_BEND = 0.2
# Minimum difference of neighbours' residuals between two skies: in px; in their errors, times the first number plus the
# second over the square root of the number of stars; and as a share of the difference of distant stars.
MIXED_PX, MIXED, MIXED_BY_CHANCE, MIXED_EVERYWHERE = 1.2, 1.4, 2.0, 0.3
# Maximum share of the residuals' mean square that two opposite offsets leave: 0.68 of normally distributed errors remain.
MAX_LEFT_BY_OFFSETS = 0.35
# With a smaller mean square of all residuals no two skies are mixed.
MIN_MIXED_PX2 = MIXED_PX**2 * MIXED_EVERYWHERE
# Minimum error of centroids (px), for errors that are not stated.
MIN_ERROR_PX = 0.1
# From this number of stars on, only this share of them, the best-fitting ones, is compared.
FEW_WRONG, ROBUST = 32, 0.9
# Minimum number of stars, and number of terms of the polynomial of the lens's distortion.
BENDS = (12, 3), (20, 6), (32, 10)


def two_skies(
    field: FrameStars, flux: np.ndarray, sky: Sky, found: Identification, explained: Explained
) -> bool:
    """Whether the stars that an identification has left over are a sky of their own.

    flux (N,): of the field's stars, in any unit, brightest first.
    explained: how much of the field it explains.
    """
    if found.mean_square_px2 >= MIN_MIXED_PX2 and _between_two(field, sky, found):
        return True
    bright = explained.bright
    if bright - explained.explained < max(MIN_LEFT, MIN_SHARE_LEFT * bright):
        return False
    left = np.ones(len(flux), bool)
    left[found.star] = False
    mag = -2.5 * np.log10(np.maximum(flux, np.finfo(float).tiny))
    return _every_star_twice(field.xy[0], mag, left, 2 * field.half) or _another_pose(
        field, mag, left, sky, found
    )


def _between_two(field: FrameStars, sky: Sky, found: Identification) -> bool:
    """Whether the residuals of neighbouring stars differ by more than one sky can explain."""
    stars = len(found.star)
    xy, error2 = field.xy[int(found.mirrored)][found.star], field.sigma[found.star] ** 2 + MIN_ERROR_PX**2
    residual = xy - Pose.of(field, found).project(sky.directions(found.catalogue))
    u, v = ((xy - field.middle) / field.half.max()).T
    powers = np.stack([u**0, u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3], 1)
    terms = powers[:, : max([1, *(k for n, k in BENDS if stars >= n)])]
    residual = residual - terms @ np.linalg.lstsq(terms, residual, rcond=None)[0]
    kept: np.ndarray = np.arange(stars)
    if stars >= FEW_WRONG:
        # where a lens bends much, some stars are matched wrongly
        kept = np.sort(np.argsort(np.square(residual).sum(1))[: int(ROBUST * stars)])
        residual = residual - terms @ np.linalg.lstsq(terms[kept], residual[kept], rcond=None)[0]
    # slow to import, and seldom needed
    from scipy.spatial import cKDTree

    nearest = cKDTree(xy[kept]).query(xy[kept], 2)[1][:, 1]
    residual, error2 = residual[kept], error2[kept]
    # mean squares along an axis, of one star
    near2 = np.square(residual - residual[nearest]).mean() / 2
    far2 = np.square(residual).sum() / (2 * max(len(kept) - terms.shape[1], 1))
    expected2 = (error2 + error2[nearest]).mean() / 2
    return bool(
        near2 > MIXED_PX**2
        and near2 > (MIXED + MIXED_BY_CHANCE / math.sqrt(stars)) ** 2 * expected2
        and near2 > MIXED_EVERYWHERE * far2
        and _share_beyond_offsets(residual, terms[kept, :3]) < MAX_LEFT_BY_OFFSETS
    )


def _share_beyond_offsets(residual: np.ndarray, plane: np.ndarray) -> float:
    """Share of the mean square of residuals (N, 2) that an offset of either sign leaves.

    plane (N, 1 or 3): 1 and the place on the frame, over which the offset may change, as where the camera was turned.
    """
    along = np.linalg.eigh(residual.T @ residual)[1][:, 1]
    offset = np.where(residual @ along < 0, -1.0, 1.0)[:, None] * plane
    left = residual - offset @ np.linalg.lstsq(offset, residual, rcond=None)[0]
    free = 1 - offset.shape[1] / len(residual)
    return float(np.square(left).sum() / (np.square(residual).sum() * free))


def _every_star_twice(xy: np.ndarray, mag: np.ndarray, left: np.ndarray, size: np.ndarray) -> bool:
    """Whether the brightest of the stars xy (N, 2), on a frame of size (2,) px, have twins at one offset.

    left (N,): which of them are not identified.
    """
    xy, mag, left = xy[:MAX_STARS], mag[:MAX_STARS], left[:MAX_STARS]
    one, other = np.triu_indices(len(xy), 1)
    farthest = FARTHEST * size.max() + AROUND * max(OFFSETS_PX)
    offset = xy[other] - xy[one]
    near = (mag[other] - mag[one] < MAX_FAINTER_MAG + SAME_MAG) & (np.square(offset).sum(1) < farthest**2)
    one, other, offset = one[near], other[near], offset[near]
    # from left to right
    swap = offset[:, 0] < 0
    one, other, offset = (
        np.where(swap, other, one),
        np.where(swap, one, other),
        np.where(swap[:, None], -offset, offset),
    )
    for within_px in OFFSETS_PX:
        twin, log_chance = _most_alike(offset, mag[other] - mag[one], within_px, FARTHEST * size.max())
        if log_chance < -MIN_LOG_ODDS and _are_a_sky(xy, left, one[twin], other[twin], size):
            return True
    return False


def _most_alike(
    offset: np.ndarray, fainter: np.ndarray, within_px: float, farthest_px: float
) -> tuple[np.ndarray, float]:
    """Pairs of stars with nearly the same offset, and the logarithm of the probability that chance makes as many.

    offset, fainter  (P, 2) px, (P,): of all pairs; how much fainter the second star of each is
    """
    none, apart2 = np.zeros(0, int), np.square(offset).sum(1)
    votes = np.bincount(np.concatenate(close_pairs(offset, within_px)), minlength=len(offset))
    votes[(apart2 < max(NEAREST_PX, NEAREST * within_px) ** 2) | (apart2 > farthest_px**2)] = 0
    if not votes.any():
        return none, 0.0
    centre = offset[votes.argmax()]
    centre = np.median(offset[np.square(offset - centre).sum(1) < within_px**2], axis=0)
    away2 = np.square(offset - centre).sum(1)
    twin = np.flatnonzero(away2 < within_px**2)
    share = np.median(fainter[twin])
    twin = twin[np.abs(fainter[twin] - share) < SAME_MAG]
    if abs(share) > MAX_FAINTER_MAG or len(twin) < 2:
        return none, 0.0
    # each pair counts in both directions
    nearest2 = np.minimum(away2, np.square(offset + centre).sum(1))
    around = np.sum(nearest2 < (AROUND * within_px) ** 2) - len(twin)
    expected, others = (around + 1) / (AROUND**2 - 1), len(twin) - 1
    # this number of others around any one of the offsets, by Poisson's distribution
    return twin, math.log(len(offset)) + others * math.log(expected) - math.lgamma(others + 1)


def _are_a_sky(
    xy: np.ndarray, left: np.ndarray, one: np.ndarray, other: np.ndarray, size: np.ndarray
) -> bool:
    """Whether twins, the rows `one` and `other` (K,) of xy (N, 2), are many, spread out, and partly identified."""
    linked, known = np.sum(left[one] != left[other]), np.sum(~left[one] & ~left[other])
    return bool(
        2 * len(one) >= MIN_SHARE * len(xy)
        and len(np.intersect1d(one, other)) <= MAX_IN_ROWS * len(one)
        and linked >= max(MIN_LINKED, known)
        and np.linalg.eigvalsh(np.cov(xy[one].T))[0] > (MIN_SPREAD * size.min()) ** 2
    )


def _another_pose(
    field: FrameStars, mag: np.ndarray, left: np.ndarray, sky: Sky, found: Identification
) -> bool:
    """Whether the stars of the field that are left over (N,) fit another pose of the same camera."""
    row, first = np.flatnonzero(left)[:MAX_STARS], Pose.of(field, found)
    while len(row) >= MIN_LEFT:
        rest = field.of_rows(row).but(focal_px=first.focal_px)
        second = _same_camera(rest, sky, first, WORSE * found.residual_px + WORSE_PX)
        if second is None:
            return False
        new = _new(field, mag, row[second.star], sky, found, second)
        if new.all():
            # a pose that is slightly wrong still puts companions near catalogue stars
            bright = int(np.median(second.star)) + 1
            return bool(np.sum(second.star < bright) >= MIN_SHARE_SECOND * bright)
        # the evidence must do without the others
        row = np.delete(row, second.star[~new])
    return False


def _same_camera(rest: FrameStars, sky: Sky, first: Pose, most_residual_px: float) -> Identification | None:
    """Identify the rest of a frame's stars near the first pose, or anywhere, with its parity and focal length."""
    # a prior is for frames that are not mirrored
    priors = () if first.mirrored else (PointingPrior(first.attitude, first.focal_px),)
    for second in near_or_lost(rest, sky, priors, QUICK_STAGES):
        if (
            second.mirrored == first.mirrored
            and abs(math.log(second.focal_scale)) < SAME_FOCAL
            and second.residual_px < most_residual_px
        ):
            return second
    return None


def _new(
    field: FrameStars,
    mag: np.ndarray,
    row: np.ndarray,
    sky: Sky,
    found: Identification,
    second: Identification,
) -> np.ndarray:
    """Which stars (M,) of a second identification, of the field's stars `row`, are not the first sky's, bent by the lens.

    New is a star that is seen in its place in the first sky as well, or is farther from there than a lens bends that
    has its neighbours in place.
    """
    share = _zero(mag[row], sky, second) - _zero(mag[found.star], sky, found)
    if abs(share) > MAX_FAINTER_MAG:
        return np.zeros(len(row), bool)
    first, xy = Pose.of(field, found), field.xy[int(found.mirrored)]
    away = np.linalg.norm(xy[row][:, None] - xy[found.star], axis=2).min(1)
    bend, their_bend = (
        np.linalg.norm(xy[star] - first.project(sky.directions(index)), axis=1)
        for star, index in ((found.star, found.catalogue), (row, second.catalogue))
    )
    new = their_bend > 2 * bend.max() + STEEPEST_BEND * away
    _, here, there = np.intersect1d(second.catalogue, found.catalogue, return_indices=True)
    one, other = found.star[there], row[here]
    alike = np.abs(mag[other] - mag[one] - share) < SAME_MAG
    new[here] |= alike & (np.linalg.norm(xy[one] - xy[other], axis=1) > DOUBLE_PX)
    return new


def _zero(mag: np.ndarray, sky: Sky, found: Identification) -> float:
    """Median of the magnitudes (M,) of identified stars, less the catalogue's magnitudes."""
    return float(np.median(mag - sky.catalogue.vmag(found.catalogue)))
