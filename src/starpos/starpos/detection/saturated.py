# SPDX-License-Identifier: Apache-2.0
"""Saturated stars that no PSF fits: flat discs, and small images clipped to one height."""

import cv2
import numpy as np
from scipy import spatial

from starpos.detection._pixels import third_highest
from starpos.detection.background import SkyPlane
from starpos.detection.vet import MEASURED
from starpos.frames.frame import SATURATED

# Pixels above this share of the frame's brightest discs belong to a disc: a plate or a JPEG has no sharp limit.
FLAT = 0.8
# Minimum radius of a disc over the FWHM of the stars (smaller ones are fitted by their wings), and in px.
WIDER, MIN_PX = 1.3, 4.0
# A disc's radius is at most this share of the frame's shorter side: larger ones are lamps, roofs or the Moon.
WIDEST = 0.05
# Minimum height of the disc's top above the sky, in sigma of a pixel's noise.
CLEAR = 20.0
# The squared axes of an ellipse of the disc's moments differ at most by this factor; it has that share of its area.
LONGEST, FULLEST = 3.0, 0.8
# Maximum number of discs; the largest are kept.
MOST = 500
# The centre of a disc is known to this share of its radius.
OFF_CENTRE = 0.04
# Light grows with this power of the area, as the wings of stars fall.
GROWTH = 2.0


def find_discs(sky: SkyPlane, fwhm_px: float, highest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Discs far wider than its stars of fwhm_px: as measured stars (N,), and their radii (N,) px.

    highest (h,) int32: the brightest pixel of each row.
    """
    level, noise = sky.typical
    least = max(WIDER * fwhm_px, MIN_PX)
    # any disc of this radius has a sample whose neighbours to the right, below and between lie on it too
    step = int(np.sqrt(2) * (least - np.sqrt(0.5)))
    # no single hot pixel
    lit = np.flatnonzero(highest[:-1:step] > level + CLEAR * noise) * step
    y, x = np.nonzero(sky.plane[lit, :-1:step] > level + CLEAR * noise)
    y, x = lit[y], x * step
    height = np.min([sky.plane[y + down, x + right] for down, right in np.ndindex(2, 2)], axis=0)
    if height.max(initial=0) < level + CLEAR * noise:
        return measured_discs([], fwhm_px, 0.0)
    top = float(height.max())
    limit = level + FLAT * (top - level)
    bright = height >= limit
    boxes = _groups(y[bright] // step, x[bright] // step)
    most = WIDEST * min(sky.plane.shape)
    fits = boxes[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(1) * step < 2 * most
    discs = [_disc(sky.plane, box[:4] * step, 2 * step, limit, least) for box in boxes[fits][:MOST]]
    return measured_discs([d for d in discs if d is not None and d[2] < most], fwhm_px, top - level)


def _groups(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Boxes (left, top, width, height) of the groups of places row, column (N,) side by side, the largest group first.

    Only neighbours of rows and columns with a place are looked at: most frames have a few places.
    """
    kept = [np.unique(np.stack([place, place + 1])) for place in (row, column)]
    mask = np.zeros([len(places) for places in kept], np.uint8)
    mask[np.searchsorted(kept[0], row), np.searchsorted(kept[1], column)] = 1
    _, _, boxes, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    boxes = boxes[1:][np.argsort(-boxes[1:, cv2.CC_STAT_AREA], kind="stable")]
    boxes[:, cv2.CC_STAT_LEFT] = kept[1][boxes[:, cv2.CC_STAT_LEFT]]
    boxes[:, cv2.CC_STAT_TOP] = kept[0][boxes[:, cv2.CC_STAT_TOP]]
    return boxes


def _disc(
    plane: np.ndarray, box: np.ndarray, around: int, limit: float, least: float
) -> tuple[float, float, float] | None:
    """Centre x, y and radius (px) of the disc of pixels above the limit in a box (left, top, width, height) px.

    None if it is not round, not wider than the least radius, or goes on beyond the box and `around` px more.
    """
    left, top = (max(0, int(v) - around) for v in box[:2])
    right, bottom = (int(v + size) + around for v, size in zip(box[:2], box[2:], strict=True))
    window = (plane[top:bottom, left:right] >= limit).astype(np.uint8)
    number, _, boxes, _ = cv2.connectedComponentsWithStats(window, connectivity=8)
    if number < 2:
        return None
    k = 1 + int(boxes[1:, cv2.CC_STAT_AREA].argmax())
    x0, y0, width, height, _ = boxes[k]
    if x0 == 0 or y0 == 0 or x0 + width == window.shape[1] or y0 + height == window.shape[0]:
        return None
    if width * height <= np.pi * least**2:
        return None
    outline, _ = cv2.findContours(
        window[y0 : y0 + height, x0 : x0 + width], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    found = round_shape(max(outline, key=len), LONGEST, FULLEST)
    if found is None or found[2] <= least:
        return None
    return left + x0 + found[0], top + y0 + found[1], found[2]


def round_shape(outline: np.ndarray, longest: float, fullest: float) -> tuple[float, float, float] | None:
    """Middle x, y and radius (px) of the pixels within an outline of OpenCV's; None if they are not round.

    Holes, as some sensors have where they overflow, count.  longest: ratio of the squared axes of the ellipse of their
    moments; fullest: share of its area that they cover.
    """
    left, top, width, height = cv2.boundingRect(outline)
    filled = np.zeros((height, width), np.uint8)
    cv2.drawContours(filled, [outline], -1, 1, cv2.FILLED, offset=(-left, -top))
    rows, columns = np.nonzero(filled)
    if len(rows) < 2:
        return None
    low, high = np.linalg.eigvalsh(np.cov(columns, rows))
    if low <= 0 or high > longest * low or len(rows) < fullest * 4 * np.pi * np.sqrt(low * high):
        return None
    return left + float(columns.mean()), top + float(rows.mean()), float(np.sqrt(len(rows) / np.pi))


def measured_discs(
    discs: list[tuple[float, float, float]], fwhm_px: float, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """Discs as measured stars (N,) and their radii (N,) px; height: of their tops above the sky, DN.

    One as wide as a star's FWHM has that star's flux.
    """
    x, y, radius = np.array(discs, float).reshape(-1, 3).T
    stars = np.zeros(len(discs), MEASURED)
    stars["x"], stars["y"], stars["flags"], stars["chi2"] = x, y, SATURATED, 1.0
    stars["flux"] = 1.133 * fwhm_px**2 * height * (2 * radius / fwhm_px) ** (2 * GROWTH)
    stars["snr"] = np.sqrt(stars["flux"])
    stars["covariance"] = (OFF_CENTRE * radius[:, None, None]) ** 2 * np.eye(2)
    return stars, radius


def with_discs(stars: np.ndarray, discs: np.ndarray, radius: np.ndarray, fwhm_px: float) -> np.ndarray:
    """The measured stars and the discs of these radii (N,) px, brightest first.

    A star measured by its wings, near a disc's middle, keeps its place. All else on the disc and its rim is its light.
    """
    if not len(discs):
        return stars
    apart = np.hypot(stars["x"][:, None] - discs["x"], stars["y"][:, None] - discs["y"])
    middle = (apart < 0.5 * radius) & ((stars["flags"] & SATURATED) != 0)[:, None]
    known = middle.any(0)
    if known.any():
        fitted = stars[np.argmin(np.where(middle, apart, np.inf), axis=0)[known]]
        for name in ("x", "y", "covariance", "chi2"):
            discs[name][known] = fitted[name]
        discs["flux"][known] = np.maximum(discs["flux"][known], fitted["flux"])
    rest = ~(apart < radius + fwhm_px).any(1)
    stars = np.concatenate([discs, stars[rest]])
    return stars[np.argsort(-stars["flux"], kind="stable")]


# Maximum relative error at which a fit gives a clipped star's light, and maximum chi2 at which it gives another's.
KNOWN, STRANGE = 0.1, 3.0
# px. A star measured so near a peak is the peak's.
NEAR = 2.0
# Minimum share of the light above sky that belongs to the source itself.
OWN = 0.5
# Minimum number of pixels of a clipped image, and its share of the pixels of a star that is just not clipped.
FEWEST, NARROWER = 4, 0.8
# Reach of the window around the peak, in widths of a star, and its minimum in px.
REACH, MIN_REACH = 6.0, 12


def with_clipped(
    stars: np.ndarray, sky: SkyPlane, x: np.ndarray, y: np.ndarray, fwhm_px: float
) -> np.ndarray:
    """The measured stars and the clipped ones among the peaks x, y (N,) int px, brightest first.

    A saturated star is measured anew if its wings constrain its light weakly, and so is what seems to be several stars in
    one flat image.
    """
    saturated = (stars["flags"] & SATURATED) != 0
    constrained = np.sqrt(np.maximum(stars["chi2"], 1.0)) < KNOWN * stars["snr"]
    constrained |= ~saturated & (stars["chi2"] < STRANGE)
    # the third highest pixel, because hot ones may exceed saturation
    level, top = sky.near(x, y)[0].mean(1), third_highest(sky.plane, x, y, 1)[0]
    typical = sky.typical[0]
    lost = top - typical > FLAT * (top.max() - typical)
    peaks, own = np.stack([x, y], 1), np.stack([stars["x"], stars["y"]], 1)
    lost[lost] = ~_any_near(own[constrained], peaks[lost])
    if (saturated & ~constrained).any():
        lost |= _any_near(own[saturated & ~constrained], peaks)
    # what stands on a roof is the roof's
    lost = (lost & (top - level > OWN * (top - typical))).nonzero()[0][:MOST]
    reach = max(MIN_REACH, round(REACH * fwhm_px))
    images = [_image(sky.plane, x[k], y[k], level[k], top[k], reach) for k in lost.tolist()]
    least = max(FEWEST, NARROWER * np.pi / 4 * fwhm_px**2)
    # several peaks may belong to one image
    clipped = [
        image for image in dict.fromkeys(images) if image is not None and np.pi * image[2] ** 2 >= least
    ]
    if not clipped:
        return stars
    discs, radius = measured_discs(clipped, fwhm_px, float(top.max()) - typical)
    apart = np.hypot(stars["x"][:, None] - discs["x"], stars["y"][:, None] - discs["y"])
    known = constrained | ~(apart < radius).any(1)
    return with_discs(stars[known], discs, radius, fwhm_px)


def _any_near(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Whether one of the points (N, 2) is NEAR each of others (M, 2): (M,) bool."""
    return spatial.cKDTree(points).query(to, distance_upper_bound=NEAR)[0] < NEAR


def _image(
    plane: np.ndarray, x: int, y: int, level: float, highest: float, reach: int
) -> tuple[float, float, float] | None:
    """Centre x, y and radius (px) of the pixels around a peak above half its height; None if they are not round."""
    left, top, half = max(0, x - reach), max(0, y - reach), (highest - level) / 2
    signal = plane[top : y + reach + 1, left : x + reach + 1] - (level + half)
    _, group, boxes, _ = cv2.connectedComponentsWithStats((signal > 0).astype(np.uint8), connectivity=8)
    k = group[y - top, x - left]
    x0, y0, across, down, area = boxes[k]
    if k == 0 or min(x0, y0) == 0 or x0 + across == signal.shape[1] or y0 + down == signal.shape[0]:
        return None
    rows, columns = np.nonzero(group == k)
    # with a pixel's own width
    low, high = np.linalg.eigvalsh(np.cov(columns, rows, bias=True) + np.eye(2) / 12)
    if high > LONGEST * low or area < FULLEST * 4 * np.pi * np.sqrt(low * high):
        return None
    weight = np.minimum(signal[rows, columns], half)
    centre = np.average(columns, weights=weight), np.average(rows, weights=weight)
    return left + float(centre[0]), top + float(centre[1]), float(np.sqrt(area / np.pi))
