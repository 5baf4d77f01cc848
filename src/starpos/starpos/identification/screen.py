# SPDX-License-Identifier: Apache-2.0
"""Find which of many poses are worth a fit, by the frame's bright stars that coincide with bright catalogue stars."""

import numpy as np

from starpos.identification.pose import FrameStars, Poses
from starpos.identification.sky import Sky
from starpos.sky.zones import rows_near

# A star lies within so many sigma of its place.
MATCH_SIGMA = 3.5
# Logarithm of the share of detections that may be false.
LOG_FALSE = np.log(0.35)
# Log-odds.
WORTH_A_FIT = 4.0
# So many of the brightest catalogue stars on the frame are looked at.
MOST_STARS = 440
# A coordinate (px) where no star is.
FAR = 1e7


def promising(field: FrameStars, sky: Sky, poses: Poses, star: np.ndarray, sigma_px: np.ndarray) -> list[int]:
    """Rows of those of the K poses that are worth a fit, best first.

    star      (K, 3): the field's stars from which each pose was made
    sigma_px  (K, n): how well each pose places the n = min(N, field.tested) brightest stars
    """
    predicted, count = _expected(field, sky, poses)
    xy = field.xy[poses.mirrored.astype(int), : sigma_px.shape[1]]
    apart2 = np.square(xy[:, :, None, 0] - predicted[:, None, :, 0])
    apart2 += np.square(xy[:, :, None, 1] - predicted[:, None, :, 1])
    nearest = apart2.argmin(2)
    each, n = np.arange(len(xy))[:, None], np.arange(xy.shape[1])
    # one catalogue star answers one detection: the one nearest to it
    mutual = apart2.argmin(1)[each, nearest] == n
    variance = sigma_px * sigma_px
    distance2 = apart2[each, n, nearest] / variance
    by_chance = 2 * np.pi * variance * np.maximum(count, 1)[:, None] / field.whole_px2
    odds = np.where(mutual & (distance2 < MATCH_SIGMA**2), -0.5 * distance2 - np.log(by_chance), LOG_FALSE)
    # the stars from which a pose was made are no evidence for it
    odds[each, star] = 0.0
    # the sum from the brightest star down to the one where it is largest
    worth = odds.cumsum(1).max(1)
    return [k for k in np.argsort(-worth, kind="stable").tolist() if worth[k] > WORTH_A_FIT]


def _expected(field: FrameStars, sky: Sky, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Bright catalogue stars on K frames: pixels (K, S, 2), FAR beyond each frame's count (K,)."""
    axis = np.append(field.middle / field.focal_px, 1.0)
    rows = [rows_near(sky.triangles.cell_start, axis @ a, field.radius_rad) for a in poses.attitude]
    frame, row = np.repeat(np.arange(len(rows)), [len(r) for r in rows]), np.concatenate(rows)
    u = np.einsum("mij,mj->mi", poses.attitude[frame], sky.bright(row))
    pixel = u[:, :2] * (poses.focal_px[frame] / np.maximum(u[:, 2], 1e-6))[:, None]
    on = np.flatnonzero(field.holds(pixel))
    on = on[np.lexsort((sky.triangles.rank[row[on]], frame[on]))]
    frame = frame[on]
    count = np.bincount(frame, minlength=len(poses))
    place = np.arange(len(on)) - (np.cumsum(count) - count)[frame]
    keep = place < MOST_STARS
    on, frame, place, count = on[keep], frame[keep], place[keep], np.minimum(count, MOST_STARS)
    pixels = np.full((len(poses), max(1, int(count.max(initial=0))), 2), FAR)
    pixels[frame, place] = pixel[on]
    return pixels, count
