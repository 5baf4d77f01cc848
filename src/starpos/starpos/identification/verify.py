# SPDX-License-Identifier: Apache-2.0
"""Is a pose right?  The log-odds of all bright stars of the frame against chance, for many poses at once."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from starpos.identification.pose import Field, Pose, Poses
from starpos.identification.sky import Sky
from starpos.zones import rows_near

# A triangle was looked up within 3 sigma of two angles; one that fits better is worth that much more, what it lacks is in
# the odds of its own stars
SHAPE = 2 * np.log(6 / np.sqrt(2 * np.pi))
WORTH_A_FIT = 4.0  # log-odds of a raw hypothesis below which it is not looked at again
FALSE_FRACTION = 0.35  # of the detections that may be no catalogue star
# The n-th brightest detection is among the a + b n brightest catalogue stars, but for a share of surprises (colours,
# errors of brightness among many alike) that reach so many times deeper.
EXPECTED_RANK, SURPRISES, DEEPER = (10, 2), 0.15, 4
TEST_STARS = 50  # the brightest of a frame, which decide
MATCH_SIGMA = 3.5
SMALLER_PX = (0.0, 0.7, 1.5)  # errors besides the centroids' own at which a fitted match is judged as well
CHOICE = np.log(1 + len(SMALLER_PX))
DOUBLE_PX = 3.0  # detections this close may be one star
FAR = 1e7  # px, where no star is


@dataclass(frozen=True)
class Hypotheses:
    """K poses to be tried, for the n = min(N, TEST_STARS) brightest stars: own (K, n) which of them they were made from
    (`own_stars`), sigma_px (K, n) how far off each may be."""

    poses: Poses
    own: np.ndarray
    sigma_px: np.ndarray

    def __getitem__(self, k: slice) -> "Hypotheses":
        p = self.poses
        return Hypotheses(Poses(p.attitude[k], p.focal_px[k], p.mirrored[k]), self.own[k], self.sigma_px[k])


def own_stars(xy: np.ndarray, star: np.ndarray, sigma_px: np.ndarray) -> np.ndarray:
    """Which of xy (K, n, 2) say nothing new of poses made from star (K, m): these, and their doubles (K, n)."""
    made = xy[np.arange(len(xy))[:, None], star]
    apart2 = np.square(xy[:, :, None] - made[:, None]).sum(-1).min(2)
    return apart2 < np.square(MATCH_SIGMA * sigma_px + DOUBLE_PX)


@dataclass(frozen=True)
class Match:
    """A pose, its log-odds, and the stars that agree: rows of the field's (M,) and their directions (M, 3)."""

    pose: Pose
    log_odds: float
    star: np.ndarray
    directions: np.ndarray


@dataclass(frozen=True)
class Expected:
    """Catalogue stars on K frames, brightest first: pixel (K, S, 2), FAR beyond a frame's count (K,); place (K, S) of
    each in directions (M, 3)."""

    pixel: np.ndarray
    count: np.ndarray
    place: np.ndarray
    directions: np.ndarray

    @classmethod
    def on(cls, field: Field, sky: Sky, poses: Poses) -> "Expected":
        tested = min(len(field), TEST_STARS)
        axis = np.append(field.middle / field.focal_px, 1.0)
        centre = np.einsum("i,kij->kj", axis / np.sqrt(axis @ axis), poses.attitude)
        frame, row = rows_near(sky.triangles.cell_start, centre, field.radius_rad)
        w = sky.bright(row)
        u = np.einsum("mij,mj->mi", poses.attitude[frame], w)
        pixel = u[:, :2] * (poses.focal_px[frame] / np.maximum(u[:, 2], 1e-6))[:, None]
        on = np.flatnonzero(field.holds(pixel))
        on = on[np.lexsort((sky.triangles.rank[row[on]], frame[on]))]
        frame = frame[on]
        count = np.bincount(frame, minlength=len(poses))
        place = np.arange(len(on)) - (np.cumsum(count) - count)[frame]
        most = DEEPER * (EXPECTED_RANK[0] + EXPECTED_RANK[1] * tested)
        keep = place < most
        on, frame, place, count = on[keep], frame[keep], place[keep], np.minimum(count, most)
        shape = len(poses), max(1, int(count.max(initial=0)))
        pixels, places = np.full((*shape, 2), FAR), np.zeros(shape, int)
        pixels[frame, place], places[frame, place] = pixel[on], on
        return cls(pixels, count, places, w)


def matches(field: Field, sky: Sky, h: Hypotheses, error_px: float, enough: float) -> Iterator[Match]:
    """The hypotheses that are worth it, best first, fitted to the stars that agree unless their log-odds are `enough`."""
    if not len(h.poses):
        return
    tested = h.own.shape[1]
    expected = Expected.on(field, sky, h.poses)
    xy = field.xy[h.poses.mirrored.astype(int), :tested]
    log_odds, hit, nearest = _log_odds(field, xy, expected.pixel, expected.count, h.sigma_px, h.own)
    log_odds += SHAPE
    for k in np.argsort(-log_odds, kind="stable").tolist():
        if log_odds[k] < WORTH_A_FIT:
            return
        w = expected.directions[expected.place[k, : expected.count[k]]]
        match = Match(h.poses[k], float(log_odds[k]), np.flatnonzero(hit[k]), w[nearest[k][hit[k]]])
        if match.log_odds <= enough:
            pose = match.pose.fitted(xy[k, match.star], match.directions)
            match = judged(field, pose, w, h.own[k], error_px, enough - SHAPE)
            match = replace(match, log_odds=match.log_odds + SHAPE)
        yield match


def judged(field: Field, pose: Pose, w: np.ndarray, own: np.ndarray, error_px: float, enough: float) -> Match:
    """A pose's match with stars w (S, 3), brightest first, at error_px or a smaller one; own (n,) as Hypotheses has it.

    A looser error than the pose needs hides what the match is worth, so that smaller ones are judged until the log-odds
    are `enough`; to choose among errors costs their number.
    """
    tested = len(own)
    xy, pixel = field.xy[int(pose.mirrored), :tested], pose.project(w)
    best = None
    for error in (error_px, *(e for e in SMALLER_PX if e < error_px)):
        sigma = np.hypot(field.sigma[:tested], error)
        log_odds, hit, nearest = _log_odds(
            field, xy[None], pixel[None], np.array([len(w)]), sigma[None], own[None]
        )
        worth = float(log_odds[0]) - (CHOICE if best else 0.0)
        if best is None or worth > best.log_odds:
            best = Match(pose, worth, np.flatnonzero(hit[0]), w[nearest[0][hit[0]]])
        if best.log_odds > enough:
            break
    return best


def _log_odds(field: Field, xy, predicted, count, sigma, own):
    """Log-odds (K,) of all the stars; which agree and the catalogue star nearest to each (K, n)."""
    apart2 = np.square(xy[:, :, None, 0] - predicted[:, None, :, 0])
    apart2 += np.square(xy[:, :, None, 1] - predicted[:, None, :, 1])
    nearest = apart2.argmin(2)
    each, n = np.arange(len(xy))[:, None], np.arange(xy.shape[1])
    distance2 = apart2[each, n, nearest]
    # one catalogue star answers one detection: the one nearest to it
    mutual = apart2.argmin(1)[each, nearest] == n
    variance = sigma * sigma
    hit = mutual & (distance2 < MATCH_SIGMA**2 * variance)
    rank, there = EXPECTED_RANK[0] + EXPECTED_RANK[1] * n, np.maximum(count, 1)[:, None]
    expected, deepest = np.minimum(rank, there), np.minimum(DEEPER * rank, there)
    share = np.where(nearest < expected, (1 - SURPRISES) / expected, 0.0)
    share += np.where(nearest < deepest, SURPRISES / deepest, 0.0)
    area = 4 * field.half[0] * field.half[1]
    density = np.exp(-0.5 * distance2 / variance) / (2 * np.pi * variance)
    likely = np.where(hit, area * (1 - FALSE_FRACTION) * share * density, 0.0)
    # what a pose was made from cannot speak for it, only against
    against = -0.5 * np.minimum(distance2 / variance, MATCH_SIGMA**2)
    odds = np.where(own, against, np.log(FALSE_FRACTION + likely))
    # the best from the brightest down to any: under chance a likelihood ratio seldom rises high (Ville's inequality)
    return np.cumsum(odds, 1).max(1), hit, nearest
