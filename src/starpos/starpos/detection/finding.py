# SPDX-License-Identifier: Apache-2.0
"""Peaks of the smoothed frame, where something like a star stands out of the noise, and satellite trails."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage, spatial

from starpos.detection._peaks import find_maxima, smooth_rows
from starpos.detection._sky import median
from starpos.detection.background import SkyPlane, between
from starpos.detection.stamps import are_alone, are_dots, surroundings
from starpos.units import SIGMA_PER_MAD

# px. Peaks along a trail are never farther apart.
CELL = 8
# Minimum number of peaks of a line,
FEWEST = 12
# and its minimum length, px.
SHORTEST = 100
# Cells along a line without any peak, at most.
GAP = 2
# px. A wider band is not a trail.
HALF_WIDTH = 12
# px along a trail over which its light is taken as constant.
BLOCK = 64
# Over a pixel's sigma: five times the error of a block's median.
SIGNIFICANT = 5 * 1.25 / BLOCK**0.5


@dataclass(frozen=True, eq=False)
class Streak:
    """A straight band of light from point (2,) px along the unit vector direction (2,), both (x, y).

    length        px from the point to the streak's other end
    level, noise  (blocks, 2 HALF_WIDTH + 1) DN above the sky and DN rms, in equal blocks along the band and at whole px
                  across it; 0 where the streak has no light
    """

    point: np.ndarray
    direction: np.ndarray
    length: float
    level: np.ndarray
    noise: np.ndarray

    def at(self, rows: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Level and noise (DN) of the streak at pixels; 0 off it."""
        dx, dy = columns - self.point[0], rows - self.point[1]
        along_x, along_y = self.direction
        along, across = dx * along_x + dy * along_y, dy * along_x - dx * along_y
        block = np.clip(along / self.length * len(self.level), 0, len(self.level) - 1).astype(int)
        offset = np.rint(across).astype(int) + HALF_WIDTH
        on = np.abs(along / self.length - 0.5) <= 0.5 + 2 * HALF_WIDTH / self.length
        on &= (offset >= 0) & (offset <= 2 * HALF_WIDTH)
        offset = np.where(on, offset, 0)
        return on * self.level[block, offset], on * self.noise[block, offset]


def find_streaks(sky: SkyPlane, x: np.ndarray, y: np.ndarray) -> tuple[Streak, ...]:
    """The Streaks on which peaks x, y (N,) int px lie. A row of stars without light between them is not a streak."""
    if len(x) < FEWEST:
        return ()
    found: list[Streak] = []
    if not _may_be_a_line(x, y):
        return ()
    grid = np.zeros((sky.height // CELL + 1, sky.width // CELL + 1), np.uint8)
    grid[y // CELL, x // CELL] = 255
    lines = cv2.HoughLinesP(grid, 1, np.pi / 360, FEWEST, minLineLength=SHORTEST / CELL, maxLineGap=GAP)
    points, free = np.stack([x, y], 1).astype(float), np.ones(len(x), bool)
    for ends in [] if lines is None else lines.reshape(-1, 2, 2)[:50] * CELL + CELL / 2:
        line = _through(points[free], ends)
        if line is None:
            continue
        streak = _measured(sky, *line)
        if streak is not None:
            found.append(streak)
            free &= streak.at(y, x)[0] == 0
    return tuple(found)


def _may_be_a_line(x: np.ndarray, y: np.ndarray) -> bool:
    """Whether enough peaks x, y (N,) int px have neighbours within the gaps that a line may have."""
    pairs = spatial.cKDTree(np.stack([x, y], 1)).query_pairs(
        np.sqrt(2) * (GAP + 2) * CELL, output_type="ndarray"
    )
    # all but the ends of a line have two neighbours
    return bool(np.count_nonzero(np.bincount(pairs.ravel()) > 1) >= FEWEST - 2)


def _through(points: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Point and unit direction of the line through those points (N, 2) that lie near the segment with these ends (2, 2).

    None if too few points lie there.
    """
    point, direction = ends[0], ends[1] - ends[0]
    length = np.hypot(*direction)
    direction = direction / length
    for reach in (1.5 * CELL, 0.5 * CELL, 3):
        along, across = (points - point) @ direction, (points - point) @ [-direction[1], direction[0]]
        near = (np.abs(across) < reach) & (along > -CELL) & (along < length + CELL)
        if near.sum() < FEWEST:
            return None
        dx, dy, px, py = (
            cv2.fitLine(points[near].astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(float)
        )
        along = (ends - [px, py]) @ [dx, dy]
        point, direction = np.array([px, py]) + along.min() * np.array([dx, dy]), np.array([dx, dy])
        length = np.ptp(along)
    return point, direction


def _measured(sky: SkyPlane, point: np.ndarray, direction: np.ndarray) -> Streak | None:
    """The Streak along a line from edge to edge of the frame, or None if there is no light along it."""
    size = np.array([sky.width, sky.height])
    slope = np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    walls = np.stack([-point / slope, (size - 1 - point) / slope])
    first, last = walls.min(0).max(), walls.max(0).min()
    if last - first < SHORTEST:
        return None
    blocks = round((last - first) / BLOCK)
    start = point + first * direction
    along = np.linspace(0, last - first, blocks * BLOCK).reshape(blocks, 1, BLOCK)
    across = np.arange(-HALF_WIDTH, HALF_WIDTH + 1)[:, None]
    column = np.rint(start[0] + along * direction[0] - across * direction[1]).astype(int)
    row = np.rint(start[1] + along * direction[1] + across * direction[0]).astype(int)
    centre = column[:, HALF_WIDTH, BLOCK // 2], row[:, HALF_WIDTH, BLOCK // 2]
    row, column = np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)
    level, noise = sky.of_pixels(*centre, row, column)
    signal, sigma = sky.plane[row, column] - level, np.median(noise, axis=-1)
    middle = np.median(signal, axis=-1)
    # residuals of neighbouring pixels along the streak are correlated, so the noise is measured on sums of three
    rest = signal - middle[..., None]
    rest = (rest[..., :-2] + rest[..., 1:-1] + rest[..., 2:]) / 3**0.5
    scatter, most = np.quantile(np.abs(rest), (0.9, 0.97), axis=-1)
    lit = middle > SIGNIFICANT * sigma
    on = lit[:, HALF_WIDTH - 2 : HALF_WIDTH + 3].any(1) & ~lit[:, 0] & ~lit[:, -1]
    if on.sum() * BLOCK < SHORTEST:
        return None
    # one more pixel on each side, because the edges lie between pixels; the end blocks may be filled only in part
    lit, whole = on[:, None] & lit, ndimage.binary_erosion(on)[:, None]
    level = middle * ndimage.binary_dilation(lit, np.ones((1, 3)))
    noise = np.where(whole, scatter / 1.645, most) * ndimage.binary_dilation(lit, np.ones((3, 3)))
    return Streak(start, direction, last - first, level, noise)


# Rows of a strip, which has one limit.
STRIP = 64
# Parts of a strip in which the sky is compared, and maximum unevenness of the whole frame over the typical strip's.
PARTS, UNEVENEST = 4, 1.4
# With fewer values in a part its quantiles are chance; a smaller factor may be chance too.
SAMPLES, CORRELATED = 32, 1.1
# Diameter of the widest defocused star, px.
CROWD = 14
# Number of the brightest peaks that decide whether the frame's stars are rings,
LEADERS = 100
# and number of sharp peaks near a wide one that decide what it is.
NEAREST = 24
# Two neighbours lie on opposite sides of a peak, as on a line, if the cosine between their directions is below this.
OPPOSITE = -0.95


@dataclass(frozen=True)
class Kernel:
    """A Gaussian of sigma px, cut off at reach px, that smooths the frame; a peak is the highest pixel within flat px."""

    sigma: float
    reach: int
    flat: int

    @cached_property
    def weight(self) -> np.ndarray:
        """Weights (reach + 1,) along one axis, from the middle outwards."""
        weight = np.exp(-0.5 * (np.arange(self.reach + 1) / self.sigma) ** 2)
        return (weight / (2 * weight.sum() - weight[0])).astype(np.float32)

    @property
    def norm(self) -> float:
        """Share of white noise that remains after smoothing."""
        return 1 / (4 * np.pi * self.sigma**2) ** 0.5


# Near the best for a FWHM of 1.2 to 5 px, within 40 % of it at 8 px.
SHARP = Kernel(1.2, 3, 2)
# Fills the hole of a defocused star.
WIDE = Kernel(4.0, 10, 7)


@dataclass(frozen=True, eq=False, kw_only=True)
class Peaks:
    """Peaks of the smoothed frame, highest first: x, y (N,) int px and height (N,) in sigma of the smoothed noise.

    correlation  noise of the smoothed frame, over what independent pixels would give; 1 or more
    highest      (h,) int32: the frame's brightest pixel in each row
    left_out     how many lower peaks there were besides
    """

    x: np.ndarray
    y: np.ndarray
    height: np.ndarray
    correlation: float
    highest: np.ndarray
    left_out: int = 0

    @property
    def points(self) -> np.ndarray:
        """Places (N, 2) px."""
        return np.stack([self.x, self.y], 1)


def find_peaks(sky: SkyPlane, threshold: float, limit: int, threads: int = 1) -> Peaks:
    """Find at most `limit` Peaks that stand out of the sky by `threshold` sigma.

    A star through a defocused telescope with a central obstruction is a ring, with several peaks close together. If
    most bright peaks have such neighbours, a wider kernel is tried, and its peaks are taken if most of them are rings.
    The peaks along a streak or a twig are close together too, but continue to both sides; the peaks of a pair of
    stars are higher than the wide peak.
    """
    sharp = _peaks_of(sky, SHARP, threshold, limit, threads)
    bright = _no_dots(sky, sharp)
    if not _crowded(bright):
        return sharp
    wide = _peaks_of(sky, WIDE, threshold, limit, threads)
    if not _are_rings(sky.plane.shape, bright, _no_dots(sky, wide)):
        return sharp
    return _with_others(wide, bright, limit)


def _no_dots(sky: SkyPlane, peaks: Peaks) -> Peaks:
    """The Peaks without hot pixels."""
    keep = ~are_dots(sky, peaks.x, peaks.y)
    return replace(peaks, x=peaks.x[keep], y=peaks.y[keep], height=peaks.height[keep])


def _crowded(peaks: Peaks) -> bool:
    """Whether most of the brightest peaks have a similar one within CROWD px."""
    if len(peaks.x) < 2:
        return False
    leaders = min(len(peaks.x), LEADERS)
    alike = peaks.height > 0.5 * peaks.height[leaders - 1]
    pairs = spatial.cKDTree(peaks.points[alike]).query_pairs(CROWD, output_type="ndarray")
    return bool(np.count_nonzero(np.bincount(pairs[pairs < leaders])) > leaders / 2)


def _are_rings(size: tuple[int, ...], sharp: Peaks, wide: Peaks) -> bool:
    """Whether most of the brightest wide peaks are rings: several sharp peaks, lower in white noise than the wide one.

    Peaks on a line do not count. Nor do those at the edge of the frame, size (height, width) px, where a line ends.
    """
    points, centres = sharp.points, wide.points
    apart, near = spatial.cKDTree(points).query(centres, NEAREST, distance_upper_bound=2 * CROWD)
    height = np.append(sharp.height, 0)[near]
    inside = apart < 0.7 * CROWD
    highest = height.max(1, where=inside, initial=0)
    alike = height > 0.25 * highest[:, None]
    # in units of the same noise: correlated noise lowers the wide peaks more
    ring = (highest * sharp.correlation < wide.height * wide.correlation) & (
        np.count_nonzero(inside & alike, axis=1) > 1
    )
    beyond = alike & ~inside & np.isfinite(apart)
    way = (np.append(points, [[0, 0]], 0)[near] - centres[:, None]) / np.maximum(apart, 1)[..., None]
    way *= beyond[..., None]
    on_line = np.einsum("nik,njk->nij", way, way).min((1, 2), initial=0) < OPPOSITE
    at_edge = np.minimum(centres, np.array(size[::-1]) - 1 - centres).min(1) < 2 * CROWD
    rings = ring[~on_line & ~at_edge][:LEADERS]
    return bool(np.count_nonzero(rings) > 0.5 * len(rings))


def _with_others(wide: Peaks, sharp: Peaks, limit: int) -> Peaks:
    """The wide peaks, and the highest sharp one of each group that is far from them: of rings that the noise hides."""
    points, centres = sharp.points, wide.points
    far = spatial.cKDTree(centres).query(points)[0] > CROWD
    pairs = spatial.cKDTree(points).query_pairs(CROWD, output_type="ndarray")
    # the peaks are sorted: the second of a pair is the lower one
    far[pairs.max(1)] = False
    columns = [
        np.concatenate([own, others[far]])
        for own, others in ((wide.x, sharp.x), (wide.y, sharp.y), (wide.height, sharp.height))
    ]
    order = np.argsort(-columns[2], kind="stable")
    x, y, height = (column[order[:limit]] for column in columns)
    return replace(wide, x=x, y=y, height=height)


def _peaks_of(sky: SkyPlane, kernel: Kernel, threshold: float, limit: int, threads: int) -> Peaks:
    """The Peaks of the frame smoothed by a Kernel.

    A colour mosaic leaves no trace in the smoothed frame: it is a pattern at the Nyquist frequency, where the kernel's
    response vanishes.
    """
    level, noise = mesh = np.stack([sky.level.mean(0), np.sqrt((sky.noise**2).mean(0))]).astype(np.float32)
    correlation, unevenness = _noise_of_smooth(sky, kernel, mesh)
    threshold = threshold * unevenness
    norm = kernel.norm * correlation
    # each strip against the lowest threshold of its mesh rows; the exact threshold follows below
    strips = np.arange(0, sky.height, STRIP)
    (first, last), _ = sky.cell(0, np.stack([strips, np.minimum(strips + STRIP, sky.height) - 1]))
    first, last = first.astype(int), last.astype(int) + 1
    rows = np.minimum(first[:, None] + np.arange((last - first).max() + 1), last[:, None])
    floor = (level + threshold * norm * noise)[rows].min(1)
    x, y, value, highest = _in_parts(sky.plane, kernel, floor, threads)
    x, y = np.rint(x).astype(int), np.rint(y).astype(int)
    local, sigma = sky.near(x, y)
    height = (value - local.mean(1)) / (norm * np.sqrt((sigma**2).mean(1)))
    left_out = max(0, len(height) - 4 * limit)
    keep = np.argsort(-height, kind="stable")[: 4 * limit]
    x, y, height = x[keep], y[keep], height[keep]
    starlike = ~are_alone(sky, x, y)
    x, y, height = x[starlike], y[starlike], height[starlike]
    raised, uneven = surroundings(sky, x, y, round(6.7 * kernel.sigma))
    height = (height - raised / norm) / uneven
    keep = (height > _above_tail(height, threshold)).nonzero()[0]
    keep = keep[np.argsort(-height[keep], kind="stable")]
    x, y, height = x[keep], y[keep], height[keep]
    left_out += max(0, len(x) - limit)
    return Peaks(
        x=x[:limit],
        y=y[:limit],
        height=height[:limit],
        correlation=correlation,
        highest=highest,
        left_out=left_out,
    )


def _in_parts(plane: np.ndarray, kernel: Kernel, limit: np.ndarray, threads: int) -> tuple[np.ndarray, ...]:
    """Peaks x, y, value (N,) of the smoothed plane above the limit (strips, cells), and each row's highest pixel (h,)."""
    height, parts = plane.shape[0], min(threads, len(limit))
    ends = [len(limit) * k // parts * STRIP for k in range(parts)] + [height]

    def search_part(k: int) -> tuple[np.ndarray, ...]:
        return find_maxima(plane, kernel.weight, kernel.flat, limit, STRIP, ends[k], ends[k + 1])

    if parts == 1:
        return search_part(0)
    with ThreadPoolExecutor(parts) as pool:
        return tuple(
            np.concatenate(column) for column in zip(*pool.map(search_part, range(parts)), strict=True)
        )


def _noise_of_smooth(sky: SkyPlane, kernel: Kernel, mesh: np.ndarray) -> tuple[float, float]:
    """Two factors, 1 or more each, by which a smoothed frame is noisier than with independent pixels.

    The first is the correlation of neighbouring pixels, from demosaicing, resampling or lossy compression: it lowers the
    SNR of a star. The second is the sky's unevenness within the background's cells, from clouds: it raises the threshold.
    """
    plane = sky.plane
    tops = np.linspace(0, max(0, len(plane) - 16), 8).astype(int)
    rows = (tops[:, None] + np.arange(0, min(16, len(plane)), 4)).ravel()
    value = smooth_rows(plane, kernel.weight, rows, 4)
    level, noise = between(mesh, *sky.cell(np.arange(0, plane.shape[1], 4), rows))
    score = (value - level) / noise
    # stars widen the scatter upwards; where they are many, only the lowest values are free of them
    low, sigma_below, usual = _low_side(score.ravel())
    scatter = min(usual - sigma_below, sigma_below - low) / kernel.norm
    if not scatter > 1:
        return 1.0, 1.0
    # a roof or a tree that covers a part of the frame must not raise the threshold elsewhere
    part_low, part_below, part_usual = np.concatenate(
        [_low_side(p) for p in _parts(score, len(tops))], axis=1
    )
    typical = median(np.minimum(part_usual - part_below, part_below - part_low))
    typical = typical if score.size > SAMPLES * part_low.size else np.inf
    whole = tied = float(min(scatter, UNEVENEST * typical / kernel.norm))
    # clouds hardly change over `lag` px, but smoothed noise is independent there: differences show the noise alone
    lag = round(1.7 * kernel.sigma)
    if whole > CORRELATED and score.shape[1] > 2 * lag:
        steps = (score[:, lag:-lag] - 0.5 * (score[:, : -2 * lag] + score[:, 2 * lag :])) / 1.5**0.5
        tied = min(whole, SIGMA_PER_MAD * float(np.median(np.abs(steps))) / kernel.norm)
    tied = tied if tied > CORRELATED else 1.0
    return tied, max(1.0, whole / tied)


def _parts(score: np.ndarray, down: int) -> list[np.ndarray]:
    """Scores (rows, columns) in parts, below each other and up to PARTS side by side: (parts, N) of each size."""
    across = min(PARTS, score.shape[1])
    width, wider = divmod(score.shape[1], across)
    sizes = (slice(wider * (width + 1)), wider), (slice(wider * (width + 1), None), across - wider)
    return [
        score[:, some].reshape(down, len(score) // down, count, -1).swapaxes(1, 2).reshape(down * count, -1)
        for some, count in sizes
        if count
    ]


def _low_side(score: np.ndarray) -> np.ndarray:
    """Quantiles (3,) or (3, R) of scores (N,) or (R, N) at -2, -1 and 0 sigma of a Gaussian.

    np.quantile has the same: it takes longer to begin.
    """
    ordered = np.sort(score, axis=-1)
    place = np.array([0.0228, 0.1587, 0.5]) * (ordered.shape[-1] - 1)
    low = place.astype(int)
    above_it = ordered[..., np.minimum(low + 1, ordered.shape[-1] - 1)]
    ordered = ordered[..., low]
    return (ordered + (place - low) * (above_it - ordered)).T


def _above_tail(height: np.ndarray, threshold: float) -> float:
    """The threshold, raised if the noise has a heavy tail, as in clipped or demosaiced 8-bit frames.

    Many stars (about two thirds) are 1.5 times higher than the threshold, but few peaks of noise are.
    """
    while (count := np.count_nonzero(height > threshold)) > 30:
        if np.count_nonzero(height > 1.5 * threshold) > 0.3 * count:
            break
        threshold *= 1.1
    return threshold
