# SPDX-License-Identifier: Apache-2.0
"""Stars clipped to a few pixels of one height without wings: of a stretched picture, or bright ones on sharp lenses.

No PSF fits them, and they are too small to be looked for as discs, but each is a peak. Place and light are given by the
pixels above half its height.
"""

import cv2
import numpy as np

from starpos.detection._neighbours import any_near
from starpos.detection._sparse import thirds
from starpos.detection.background import Background
from starpos.detection.discs import FLAT, FULLEST, LONGEST, MOST, columns_of, with_discs
from starpos.frames.stars import SATURATED

# Maximum relative error at which a fit gives a clipped star's light, and maximum chi2 at which it gives another's.
TOLD, STRANGE = 0.1, 3.0
# px. A star measured so near a peak is the peak's.
NEAR = 2.0
# Minimum share of the light above sky that belongs to the source itself.
OWN = 0.5
# Minimum number of pixels of a clipped image, and its share of the pixels of a star that is just not clipped.
FEWEST, NARROWER = 4, 0.8
# Reach of the window around the peak, in widths of a star, and its minimum in px.
REACH, MIN_REACH = 6.0, 12


def with_clipped(
    stars: dict[str, np.ndarray],
    plane: np.ndarray,
    background: Background,
    x: np.ndarray,
    y: np.ndarray,
    fwhm_px: float,
) -> dict[str, np.ndarray]:
    """The columns of measured stars and of clipped ones among the peaks x, y (N,) int px, brightest first.

    A saturated star is measured anew if its wings constrain its light weakly, and so is what seems to be several stars in
    one flat image.
    """
    saturated = (stars["flags"] & SATURATED) != 0
    told = np.sqrt(np.maximum(stars["chi2"], 1.0)) < TOLD * stars["snr"]
    told |= ~saturated & (stars["chi2"] < STRANGE)
    # the third highest pixel, because hot ones may exceed saturation
    level, top = background.near(x, y)[0].mean(1), thirds(plane, x, y)
    sky = background.typical[0]
    lost = top - sky > FLAT * (top.max() - sky)
    at_x, at_y, own_x, own_y, untold = (
        x.astype(float),
        y.astype(float),
        stars["x"],
        stars["y"],
        saturated & ~told,
    )
    lost[lost] = ~any_near(own_x[told], own_y[told], at_x[lost], at_y[lost], NEAR)
    lost |= any_near(own_x[untold], own_y[untold], at_x, at_y, NEAR)
    # what stands on a roof is the roof's
    lost = (lost & (top - level > OWN * (top - sky))).nonzero()[0][:MOST]
    reach = max(MIN_REACH, round(REACH * fwhm_px))
    images = [_image(plane, x[k], y[k], level[k], top[k], reach) for k in lost.tolist()]
    least = max(FEWEST, NARROWER * np.pi / 4 * fwhm_px**2)
    # several peaks may belong to one image
    clipped = [
        image for image in dict.fromkeys(images) if image is not None and np.pi * image[2] ** 2 >= least
    ]
    if not clipped:
        return stars
    discs = columns_of(clipped, fwhm_px, float(top.max()) - sky)
    apart = np.hypot(own_x[:, None] - discs["x"], own_y[:, None] - discs["y"])
    known = told | ~(apart < discs["radius"]).any(1)
    return with_discs({name: column[known] for name, column in stars.items()}, discs, fwhm_px)


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
