# SPDX-License-Identifier: Apache-2.0
"""Where something starlike stands out of the noise: a smoothed frame's peaks. One pass, strip by strip."""

import cv2
import numpy as np
from scipy import ndimage, sparse, spatial

STRIP = 64  # rows: small enough to stay in the processor's cache
SIGMA = 1.2  # px of the smoothing Gaussian: near the best for FWHM 1.2 to 5 px, within 40 % of it at 8 px
REACH = 3  # px: half the kernel
KERNEL_NORM = 1 / (4 * np.pi * SIGMA**2) ** 0.5  # what smoothing leaves of white noise
FLAT = 2  # px: a peak is the highest within this


def find_peaks(plane, background, threshold, limit):
    """x, y (N,) int and height (N,) in sigma of the smoothed noise, highest first, at most `limit`.

    The kernel's response vanishes at the Nyquist frequency, so a colour mosaic, a pattern of exactly that
    frequency, leaves no trace in the smoothed frame; being odd it is centred on its pixel.
    """
    level, noise = background.level.mean(0), np.sqrt((background.noise**2).mean(0))
    noise = noise * KERNEL_NORM * background.correlation
    wanted = (level + threshold * noise).astype(np.float32)
    lowest = _columns(wanted, background)
    found = []
    for top in range(0, plane.shape[0], STRIP):
        bottom = min(top + STRIP, plane.shape[0])
        smooth, offset = _smooth(plane, top, bottom)
        # every row of the strip against the lowest threshold of the mesh rows it touches; exactly further down
        (first, last), _ = background.cell(0, np.array([top, bottom - 1]))
        above = smooth > lowest[int(first) : int(last) + 2].min(0)
        if not above.any():
            continue
        above &= smooth == cv2.dilate(smooth, np.ones((2 * FLAT + 1, 2 * FLAT + 1), np.uint8))
        place = np.flatnonzero(above[offset : offset + bottom - top])  # faster than nonzero in two dimensions
        y, x = np.divmod(place, plane.shape[1])
        found.append(np.stack([x, y + top, smooth[y + offset, x]]))
    if not found:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    x, y, value = np.concatenate(found, 1)
    local, sigma = (ndimage.map_coordinates(m, background.cell(x, y), order=1) for m in (level, noise))
    height = (value - local) / sigma
    keep = np.flatnonzero(height > _above_tail(height, threshold))
    keep = keep[np.argsort(-height[keep], kind="stable")][: 4 * limit]
    x, y, height = _join_plateaus(x[keep], y[keep], height[keep])
    return x[:limit], y[:limit], height[:limit]


def _smooth(plane, top, bottom):
    """Rows top-FLAT .. bottom+FLAT of the smoothed frame, and the index of row `top` in them."""
    first, last = max(0, top - FLAT - REACH), min(plane.shape[0], bottom + FLAT + REACH)
    smooth = cv2.GaussianBlur(
        plane[first:last].astype(np.float32), (2 * REACH + 1,) * 2, SIGMA, borderType=cv2.BORDER_REFLECT_101
    )
    start = max(first, top - FLAT)
    return smooth[start - first : min(last, bottom + FLAT) - first], top - start


def noise_of_smooth(plane, background):
    """How many times more noise a smoothed frame has than if its pixels' noise were independent: two factors >= 1.

    The first is of pixels tied to their neighbours, by demosaicing, resampling or lossy compression: a star then has
    less SNR than its pixels claim. The second is of a sky less even than its cells, as with clouds: a peak then means
    less.
    """
    height = plane.shape[0]
    scores, steps = [], []
    for top in np.linspace(0, max(0, height - 16), 8).astype(int):
        smooth, offset = _smooth(plane, top, min(top + 16, height))
        y, x = np.mgrid[offset : len(smooth) : 4, 0 : smooth.shape[1] : 4]
        level, noise = background.at(x.ravel(), y.ravel() - offset + top)
        score = (smooth[y, x] - level.mean(1).reshape(y.shape)) / np.sqrt((noise**2).mean(1)).reshape(y.shape)
        scores.append(score.ravel())
        steps.append((score[:, 2:-2] - 0.5 * (score[:, :-4] + score[:, 4:])).ravel() / 1.5**0.5)
    # stars widen the scatter upwards; where they are many, only the far side is free of them
    low, sigma_below, median = np.quantile(np.concatenate(scores), (0.0228, 0.1587, 0.5))
    whole = tied = min(median - sigma_below, sigma_below - low) / KERNEL_NORM
    # clouds hardly change from a pixel to those 8 px to its left and right
    steps = np.concatenate(steps)
    if len(steps):
        tied = min(whole, 1.4826 * np.median(np.abs(steps)) / KERNEL_NORM)
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


def _join_plateaus(x, y, height):
    """A saturated star is a plateau of equal peaks: one peak at its middle stands for it."""
    pairs = spatial.cKDTree(np.stack([x, y], 1)).query_pairs(FLAT + 0.5, output_type="ndarray")
    if len(pairs) == 0:
        return x.astype(int), y.astype(int), height
    n = len(x)
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), (n, n))
    groups, group = sparse.csgraph.connected_components(graph, directed=False)
    count = np.bincount(group, minlength=groups)
    x, y = (np.rint(np.bincount(group, v, groups) / count).astype(int) for v in (x, y))
    height = np.bincount(group, height, groups) / count
    order = np.argsort(-height, kind="stable")
    return x[order], y[order], height[order]
