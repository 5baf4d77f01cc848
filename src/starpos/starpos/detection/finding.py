# SPDX-License-Identifier: Apache-2.0
"""Where something starlike stands out of the noise: a smoothed frame's peaks. One pass, strip by strip."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy import ndimage, sparse, spatial

from starpos.detection.stamps import are_alone, are_dots, surroundings

STRIP = 64  # rows: small enough to stay in the processor's cache
CHUNK = 4096  # peaks looked at at once
CROWD = 14  # px: the widest defocused star
LEADERS = 100  # peaks that tell whether the frame's stars are rings
NEAREST = 24  # sharp peaks that tell what a wide one is
OPPOSITE = -0.95  # cosine between the two sides to which a line goes on


@dataclass(frozen=True)
class Kernel:
    """A Gaussian of sigma px that smooths the frame, cut off at reach px; a peak is the highest within flat px."""

    sigma: float
    reach: int
    flat: int

    @property
    def norm(self) -> float:
        """What smoothing leaves of white noise."""
        return 1 / (4 * np.pi * self.sigma**2) ** 0.5


SHARP = Kernel(1.2, 3, 2)  # near the best for FWHM 1.2 to 5 px, within 40 % of it at 8 px
WIDE = Kernel(4.0, 10, 7)  # fills the hole of a defocused star


@dataclass(frozen=True, eq=False)
class Peaks:
    """x, y (N,) int and height (N,) in sigma of the smoothed noise, highest first.

    correlation  how many times noisier than independent pixels the smoothed frame is, 1 or more
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    correlation: float


def find_peaks(plane, background, threshold, limit) -> Peaks:
    """At most `limit` Peaks that stand out by `threshold` sigma.

    The light of a telescope out of focus, with an obstruction in its middle, is a ring, on which several peaks crowd:
    where most bright ones do, the frame is smoothed more widely, if most of what then stands out are rings. A streak
    or a twig is a crowd too, but goes on to both sides; the two stars of a pair stand out less.
    """
    sharp = _peaks_of(plane, background, SHARP, threshold, limit)
    bright = _no_dots(plane, background, sharp)
    if not _crowded(bright):
        return sharp
    wide = _peaks_of(plane, background, WIDE, threshold, limit)
    return wide if _are_rings(plane.shape, bright, _no_dots(plane, background, wide)) else sharp


def _no_dots(plane, background, peaks):
    """The Peaks that are no hot pixels."""
    keep = ~are_dots(plane, background, peaks.x, peaks.y)
    return replace(peaks, x=peaks.x[keep], y=peaks.y[keep], height=peaks.height[keep])


def _crowded(peaks):
    """Whether most of the brightest have one like them within CROWD px."""
    points = np.stack([peaks.x, peaks.y], 1)
    if len(points) < 2:
        return False
    leaders = points[:LEADERS]
    alike = points[peaks.height > 0.5 * peaks.height[len(leaders) - 1]]
    nearest = spatial.cKDTree(alike).query(leaders, 2)[0][:, 1]
    return bool(np.median(nearest) < CROWD)


def _are_rings(size, sharp, wide):
    """Whether most of the brightest wide peaks, but those on a line, stand for several sharp ones lower than they.

    A line ends at the edge of the frame, size (height, width) px, so nothing there tells.
    """
    points, centres = (np.stack([peaks.x, peaks.y], 1) for peaks in (sharp, wide))
    apart, near = spatial.cKDTree(points).query(centres, NEAREST, distance_upper_bound=2 * CROWD)
    height = np.append(sharp.height, 0)[near]
    inside = apart < 0.7 * CROWD
    highest = height.max(1, where=inside, initial=0)
    alike = height > 0.25 * highest[:, None]
    ring = (highest < wide.height) & (np.count_nonzero(inside & alike, axis=1) > 1)
    beyond = alike & ~inside & np.isfinite(apart)
    way = (np.append(points, [[0, 0]], 0)[near] - centres[:, None]) / np.maximum(apart, 1)[..., None]
    way *= beyond[..., None]
    on_line = np.einsum("nik,njk->nij", way, way).min((1, 2), initial=0) < OPPOSITE
    at_edge = np.minimum(centres, np.array(size[::-1]) - 1 - centres).min(1) < 2 * CROWD
    rings = ring[~on_line & ~at_edge][:LEADERS]
    return np.count_nonzero(rings) > 0.5 * len(rings)


def _peaks_of(plane, background, kernel, threshold, limit):
    """The Peaks of the frame smoothed by a Kernel.

    Its response vanishes at the Nyquist frequency, so a colour mosaic, a pattern of exactly that frequency, leaves
    no trace in the smoothed frame; being odd it is centred on its pixel.
    """
    correlation, unevenness = _noise_of_smooth(plane, background, kernel)
    threshold = threshold * unevenness
    level, noise = background.level.mean(0), np.sqrt((background.noise**2).mean(0))
    noise = noise * kernel.norm * correlation
    wanted = (level + threshold * noise).astype(np.float32)
    lowest = _columns(wanted, background)
    neighbours = np.ones((2 * kernel.flat + 1,) * 2, np.uint8)
    found = []
    for top in range(0, plane.shape[0], STRIP):
        bottom = min(top + STRIP, plane.shape[0])
        smooth, offset = _smooth(plane, kernel, top, bottom)
        # every row of the strip against the lowest threshold of the mesh rows it touches; exactly further down
        (first, last), _ = background.cell(0, np.array([top, bottom - 1]))
        above = smooth > lowest[int(first) : int(last) + 2].min(0)
        if not above.any():
            continue
        above &= smooth == cv2.dilate(smooth, neighbours)
        place = np.flatnonzero(above[offset : offset + bottom - top])  # faster than nonzero in two dimensions
        y, x = np.divmod(place, plane.shape[1])
        value = smooth[y + offset, x]
        if np.any(np.diff(place) == 1):  # a saturated disc is a plateau of as many peaks as pixels
            _, part = cv2.connectedComponents(above[offset : offset + bottom - top].astype(np.uint8))
            x, y, value = _merged(x, y, value, part[y, x] - 1)
        found.append(np.stack([x, y + top, value]))
    if not found:
        return Peaks(np.zeros(0, int), np.zeros(0, int), np.zeros(0), correlation)
    x, y, value = np.concatenate(found, 1)
    local, sigma = (ndimage.map_coordinates(m, background.cell(x, y), order=1) for m in (level, noise))
    height = (value - local) / sigma
    keep = np.argsort(-height, kind="stable")[: 4 * limit]
    x, y, height = x[keep].astype(int), y[keep].astype(int), height[keep]
    starlike = ~are_alone(plane, background, x, y)
    x, y, height = x[starlike], y[starlike], height[starlike]
    near = [
        surroundings(plane, background, x[c], y[c], round(6.7 * kernel.sigma))
        for c in (slice(i, i + CHUNK) for i in range(0, len(x), CHUNK))
    ]
    raised, uneven = np.concatenate(near, 1) if near else np.zeros((2, 0))
    height = (height - raised / (kernel.norm * correlation)) / uneven
    keep = np.flatnonzero(height > _above_tail(height, threshold))
    keep = keep[np.argsort(-height[keep], kind="stable")]
    x, y, height = _join_plateaus(x[keep], y[keep], height[keep], kernel.flat)
    return Peaks(x[:limit], y[:limit], height[:limit], correlation)


def _smooth(plane, kernel, top, bottom):
    """Rows top-flat .. bottom+flat of the smoothed frame, and the index of row `top` in them."""
    around = kernel.flat + kernel.reach
    first, last = max(0, top - around), min(plane.shape[0], bottom + around)
    smooth = cv2.GaussianBlur(
        plane[first:last].astype(np.float32),
        (2 * kernel.reach + 1,) * 2,
        kernel.sigma,
        borderType=cv2.BORDER_REFLECT_101,
    )
    start = max(first, top - kernel.flat)
    return smooth[start - first : min(last, bottom + kernel.flat) - first], top - start


def _noise_of_smooth(plane, background, kernel):
    """How many times more noise a smoothed frame has than if its pixels' noise were independent: two factors >= 1.

    The first is of pixels tied to their neighbours, by demosaicing, resampling or lossy compression: a star then has
    less SNR than its pixels claim. The second is of a sky less even than its cells, as with clouds: a peak then means
    less.
    """
    tops = np.linspace(0, max(0, len(plane) - 16), 8).astype(int)
    strips = [_smooth(plane, kernel, top, min(top + 16, len(plane))) for top in tops]
    value = np.concatenate([smooth[offset : offset + 16 : 4, ::4] for smooth, offset in strips])
    rows = (tops[:, None] + np.arange(0, min(16, len(plane)), 4)).ravel()
    x, y = np.meshgrid(np.arange(0, plane.shape[1], 4), rows)
    level, noise = background.at(x.ravel(), y.ravel())
    score = (value - level.mean(1).reshape(x.shape)) / np.sqrt((noise**2).mean(1)).reshape(x.shape)
    # stars widen the scatter upwards; where they are many, only the far side is free of them
    low, sigma_below, median = np.quantile(score, (0.0228, 0.1587, 0.5))
    whole = tied = min(median - sigma_below, sigma_below - low) / kernel.norm
    # clouds hardly change from a pixel to those 4 lag px to its left and right, where smoothed noise is independent
    lag = round(1.7 * kernel.sigma)
    if score.shape[1] > 2 * lag:
        steps = (score[:, lag:-lag] - 0.5 * (score[:, : -2 * lag] + score[:, 2 * lag :])) / 1.5**0.5
        tied = min(whole, 1.4826 * np.median(np.abs(steps)) / kernel.norm)
    tied = float(tied) if tied > 1.1 else 1.0
    return tied, max(1.0, float(whole) / tied)


def _above_tail(height, threshold):
    """The threshold, raised where noise has a heavy tail, as clipped or demosaiced 8-bit frames have.

    Stars thin out slowly, about two thirds of them are half as high again; the peaks of noise end abruptly.
    """
    while (count := np.count_nonzero(height > threshold)) > 30:
        if np.count_nonzero(height > 1.5 * threshold) > 0.3 * count:
            break
        threshold *= 1.1
    return threshold


def _columns(mesh, background):
    """A mesh (rows, columns) of a background spread over the frame's width: (rows, width), linear between cells."""
    _, place = background.cell(np.arange(background.width), 0)
    return np.stack([np.interp(place, np.arange(mesh.shape[1]), row) for row in mesh]).astype(np.float32)


def _join_plateaus(x, y, height, flat):
    """A saturated star is a plateau of equal peaks: one peak at its middle stands for it."""
    pairs = spatial.cKDTree(np.stack([x, y], 1)).query_pairs(flat + 0.5, output_type="ndarray")
    if len(pairs) == 0:
        return x.astype(int), y.astype(int), height
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (len(x), len(x)))
    x, y, height = _merged(x, y, height, sparse.csgraph.connected_components(graph, directed=False)[1])
    order = np.argsort(-height, kind="stable")
    return x[order], y[order], height[order]


def _merged(x, y, value, group):
    """The middle of each group of peaks (N,), numbered from 0, and its mean value."""
    count = np.bincount(group)
    x, y = (np.rint(np.bincount(group, v) / count).astype(int) for v in (x, y))
    return x, y, np.bincount(group, value) / count
