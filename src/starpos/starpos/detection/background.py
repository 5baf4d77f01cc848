# SPDX-License-Identifier: Apache-2.0
"""The plane that detection works on, the part of it that shows the sky, and its background and noise."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product

import cv2
import numpy as np
from scipy import ndimage

from starpos.detection._pixels import any_flat
from starpos.detection._sky import median, sample_sky, sky_at
from starpos.frames.frame import Frame, Window
from starpos.units import SIGMA_PER_MAD

# Minimum noise of measured pixels over the noise of interpolated ones.
NATIVE = 1.1


def plane_of(frame: Frame) -> tuple[np.ndarray, bool | None]:
    """The pixels (h, w) of a Frame as they were measured, and whether they are a mosaic.

    The second value is True, False, or None if the file does not say: then only the pixels can show it. In colours made
    from a mosaic two thirds of the numbers are interpolated. That correlates the noise of neighbours and spreads a hot
    pixel to a star's width, so only the measured third is taken. Other colours are added, as uint16.
    """
    pixels = frame.pixels
    if pixels.ndim == 2:
        return np.ascontiguousarray(pixels), True if frame.pattern else None
    measured = _measured(pixels)
    if measured is None:
        blue, green, red = cv2.split(pixels)
        return cv2.add(cv2.add(blue, green, dtype=cv2.CV_16U), red, dtype=cv2.CV_16U), False
    plane = np.empty(pixels.shape[:2], np.uint8)
    for row, column in np.ndindex(2, 2):
        colour = measured[:, row, column].argmax()
        plane[row::2, column::2] = pixels[row::2, column::2, colour]
    return plane, True


def halved(plane: np.ndarray) -> tuple[np.ndarray, int]:
    """The plane (h // 2, w // 2), uint16, of sums over squares of 2 x 2 px, and the flux of 1 DN in it.

    Sums that would not fit into 16 bits are means, rounded. A mosaic becomes grey.
    """
    height, width = (n // 2 * 2 for n in plane.shape)
    four = plane[:height, :width].reshape(height // 2, 2, width // 2, 2).sum((1, 3), dtype=np.uint32)
    gain = 1 if plane.dtype == np.uint8 or four.max(initial=0) < 1 << 16 else 4
    return ((four + gain // 2) // gain).astype(np.uint16), gain


def _measured(pixels: np.ndarray) -> np.ndarray | None:
    """Whether each colour was measured at (row, column) modulo 2, (3, 2, 2) bool; None if no mosaic is seen.

    An average is less noisy than the values it is made of, so each colour is noisiest where it was measured.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 32:
        return None
    # 200 rows of a phase are enough
    step = 2 * max(1, height // 400)
    noise = np.empty((3, 2, 2))
    for row, column in np.ndindex(2, 2):
        phase = pixels[row::step, column::2].astype(np.int16)
        noise[:, row, column] = np.abs(np.diff(phase, axis=1)).mean((0, 1))
    noise /= np.maximum(noise.mean((1, 2), keepdims=True), 1e-9)
    for row, column in np.ndindex(2, 2):
        measured = np.zeros((3, 2, 2), bool)
        measured[2, row, column] = measured[0, 1 - row, 1 - column] = True
        measured[1] = ~(measured[0] | measured[2])
        low, high = np.where(measured, noise, np.inf).min((1, 2)), np.where(measured, 0, noise).max((1, 2))
        if np.all(low > high) and noise[measured].mean() > NATIVE * noise[~measured].mean():
            return measured
    return None


# A row or a column is white where this share of its pixels is.
WHITE_SIDE = 0.9
# Number of pixels of a side that are looked at first.
FEW = 32


def window_of(plane: np.ndarray, highest: int, sky_dn: float) -> Window | None:
    """The Window of plane (h, w) between the white rows and columns along its sides; None if it has none, as is usual.

    White is the frame's largest value, highest. Rows and columns as dark as sky_dn may be a sky that is cut off at 0.
    """
    sides = plane[0], plane[-1], plane[:, 0], plane[:, -1]
    if highest <= sky_dn or not any(_is_white(side, highest) for side in sides):
        return None
    white = plane == highest
    columns = np.flatnonzero(white.mean(0) < WHITE_SIDE)
    if len(columns) == 0:
        return None
    left, right = int(columns[0]), int(columns[-1]) + 1
    rows = np.flatnonzero(white[:, left:right].mean(1) < WHITE_SIDE)
    if len(rows) == 0:
        return None
    window = left, int(rows[0]), right, int(rows[-1]) + 1
    return None if window == (0, 0, plane.shape[1], plane.shape[0]) else window


def _is_white(side: np.ndarray, highest: int) -> bool:
    """Whether most pixels (N,) along a side are white; a few of them, far apart, are enough to recognise a dark side."""
    few = side[:: len(side) // FEW + 1]
    if 2 * np.count_nonzero(few == highest) <= len(few):
        return False
    return bool(np.count_nonzero(side == highest) >= WHITE_SIDE * len(side))


# Maximum difference of neighbouring cells of continuous sky, in sigmas of a cell.
STEEP = 5
# DN rms. Rounding to whole numbers adds this noise, so no pixel has less.
QUANTISATION = 12**-0.5
# The sky is all pixels within 3.5 sigma of a cell's median, which keeps 0.9969 of a Gaussian's rms. Sigma comes from the
# median of the differences, or, if most pixels are equal (a sky cut off at 0), from the 75 and 90 % quantiles.
CLIP = (SIGMA_PER_MAD, 1 / 0.607, 3.5, 0.9969)
# A cell is partly white where this share of its pixels has the frame's largest value.
WHITE_CELL = 0.03
# A JPEG has smoothed the sky where this share of blocks is flat; a block of the smallest step is then a peak of 4 sigma.
FLAT, FAINTEST, BLOCK_NOISE = 0.1, 0.1, 2.0
# Rows and columns of blocks that are looked at.
MAX_BLOCKS = 40


@dataclass(frozen=True, eq=False, kw_only=True)
class SkyPlane:
    """A plane of pixels, and the sky's level and noise in cells that cover it evenly.

    plane         (h, w) uint8 or uint16
    level, noise  (P, rows + 2, columns + 2) DN, with one more cell beyond each edge. P is 1, or 4 on a colour mosaic,
                  where each colour sees another sky: the phases (0, 0), (0, 1), (1, 0), (1, 1) of (row, column) modulo 2
    correlation   noise of the smoothed frame, over what independent pixels would give; 1 or more
    streaks       the satellite trails on the frame, as Streaks
    saturation    DN from which a pixel is saturated
    """

    plane: np.ndarray
    level: np.ndarray
    noise: np.ndarray
    correlation: float = 1.0
    streaks: tuple = ()
    saturation: float = np.inf

    @property
    def height(self) -> int:
        return self.plane.shape[0]

    @property
    def width(self) -> int:
        return self.plane.shape[1]

    @property
    def is_mosaic(self) -> bool:
        return len(self.level) > 1

    @cached_property
    def typical(self) -> tuple[float, float]:
        """Level and noise, DN: medians over the cells."""
        return median(self.level.ravel()), median(self.noise.ravel())

    def cell(self, x: np.ndarray | int, y: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
        """Row and column in the meshes, with fractions, of the pixels x, y."""
        row = (np.asarray(y) + 0.5) * (self.level.shape[1] - 2) / self.height + 0.5
        column = (np.asarray(x) + 0.5) * (self.level.shape[2] - 2) / self.width + 0.5
        return row, column

    def near(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Level and noise (N, P) float32, DN, for sums over pixels around the pixels x, y (N,): with the correlation."""
        x, y = (np.ascontiguousarray(v, np.intp) for v in (x, y))
        return sky_at(self.level, self.noise, x, y, self.width, self.height, self.correlation)

    def of_pixels(
        self, x: np.ndarray, y: np.ndarray, rows: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Level and noise, DN, of the pixels rows, columns (N, ...): those `near` the points x, y (N,)."""
        level, noise = self.near(x, y)
        each = np.arange(len(x)).reshape(-1, *[1] * (rows.ndim - 1))
        phase = (2 * (rows & 1) + (columns & 1)) % len(self.level)
        return level[each, phase], noise[each, phase]


def measure_sky(plane: np.ndarray, cell_px: int = 64, mosaic: bool | None = None) -> SkyPlane:
    """Measure the sky of plane (h, w), h and w >= 2, in cells of about cell_px.

    mosaic says whether the plane is a colour mosaic; None: it is one if the four phases see different skies.
    """
    rows, columns = (_sample(n, cell_px) for n in plane.shape)
    level, noise, highest, count = sample_sky(plane, rows, columns, *CLIP)
    samples = rows.shape[1] * columns.shape[1] // 4
    level, noise = _beside_lamps(np.where(highest == highest.max(), count, 0).mean(0) / samples, level, noise)
    if mosaic is None:
        mosaic = _phases_differ(level, noise, samples)
    if not mosaic:
        level, noise = level.mean(0, keepdims=True), np.sqrt((noise**2).mean(0, keepdims=True))
    error = np.maximum(noise, QUANTISATION) * samples**-0.5
    # cells that differ by more lie at an edge, of a roof for example
    steep = STEEP * np.array(2 * [median(e) for e in error.reshape(len(error), -1)])
    even = _evened(np.concatenate([level, noise]), steep)
    # a gradient of the level goes on beyond the edge
    level, noise = _beyond(even[: len(level)], 1), _beyond(even[len(noise) :], 1, 0.0)
    noise = np.maximum(noise, max(QUANTISATION, _lost_noise(plane)))
    return SkyPlane(plane=plane, level=level, noise=noise)


def _evened(mesh: np.ndarray, steep: np.ndarray) -> np.ndarray:
    """Meshes (P, rows, columns), evened out.

    A median of 3 x 3 cells replaces those that something bright covers, then a mean evens out their noise. The mean is
    left out where it differs from the median by more than steep (P,), across an edge (of a roof).
    """
    base = mesh.mean((1, 2), keepdims=True)
    around = _beyond(mesh - base, 2).astype(np.float32)
    typical = np.stack([cv2.medianBlur(one, 3) for one in around])
    mean = np.stack([cv2.blur(one, (3, 3)) for one in typical])
    even = np.where(np.abs(mean - typical) < steep[:, None, None], mean, typical)
    return even[:, 2:-2, 2:-2] + base


def _beyond(mesh: np.ndarray, cells: int, slope: float = 1.0) -> np.ndarray:
    """Meshes (P, rows, columns) with more cells beyond each edge, where so much of a gradient goes on.

    A mesh is reflected about its first and last cells, as np.pad does, which takes longer to begin.
    """
    for cell, axis in product(range(cells), (1, 2)):
        place = np.arange(-1, mesh.shape[axis] + 1)
        nearest = np.minimum(np.maximum(place, cell), mesh.shape[axis] - 1 - cell)
        edge = mesh.take(nearest, axis)
        mesh = edge + slope * (edge - mesh.take(2 * nearest - place, axis, mode="clip"))
    return mesh


def between(mesh: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The values (..., R, C) of meshes at rows (R,) and columns (C,), with fractions, as `SkyPlane.cell` gives them."""
    # quick where there are fewer rows than columns
    for place in (rows, columns):
        low = place.astype(int)
        share = (place - low).astype(mesh.dtype)[:, None]
        mesh = ((1 - share) * mesh.take(low, -2) + share * mesh.take(low + 1, -2)).swapaxes(-1, -2)
    return mesh


def _beside_lamps(white: np.ndarray, level: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Level and noise (P, rows, columns); cells that are partly white get the values of the nearest dark cell.

    white (rows, columns): the share of pixels with the frame's largest value. Else the sky next to a white wall would be
    too bright, and its stars lost.
    """
    if white.mean() < WHITE_CELL or not (white < WHITE_CELL).any():
        return level, noise
    row, column = ndimage.distance_transform_edt(
        white >= WHITE_CELL, return_distances=False, return_indices=True
    )
    level, noise = (np.ascontiguousarray(mesh[:, row, column]) for mesh in (level, noise))
    return level, noise


def _lost_noise(plane: np.ndarray) -> float:
    """Noise (DN) that a JPEG may have smoothed away: BLOCK_NOISE times the light of its faintest blocks; 0 without such.

    A JPEG stores the waves in each block of 8 x 8 px in coarse steps. Noise of less than half a step leaves most blocks
    flat, and a few with a bump of one step that looks like a star.
    """
    height, width = (n // 8 for n in plane.shape)
    if not (height and width):
        return 0.0
    rows, columns = (_spread(n) for n in (height, width))
    if not any_flat(plane, rows, columns):
        return 0.0
    blocks = plane[: 8 * height, : 8 * width].reshape(height, 8, width, 8)[rows[:, None], :, columns]
    blocks = blocks.reshape(-1, 64)
    low, high = blocks.min(1), blocks.max(1)
    # a sky cut off at 0 and a lamp are flat in any file
    grey = (low > 0) & (high < high.max())
    flat, bumpy = grey & (low == high), grey & (low < high)
    if not bumpy.any() or flat.sum() < FLAT * grey.sum():
        return 0.0
    return BLOCK_NOISE * float(np.quantile(blocks[bumpy].astype(np.float32).std(1), FAINTEST))


def _spread(count: int) -> np.ndarray:
    """At most MAX_BLOCKS of the numbers 0 to count - 1, evenly."""
    most = min(count, MAX_BLOCKS)
    return np.arange(most) * (count - 1) // max(most - 1, 1)


# the frames of a camera have one size
@lru_cache(maxsize=16)
def _sample(length: int, cell_px: int) -> np.ndarray:
    """Row numbers (cells, samples): each cell's samples are pairs of neighbours, and the first of a pair is even."""
    cells = max(1, round(length / cell_px))
    size = min(cell_px, length) // 2 * 2
    starts = np.round(np.linspace(0, length - size, cells)).astype(int) // 2 * 2
    pairs = np.arange(0, size, 8 if size >= 32 else 2)
    inside = (pairs[:, None] + np.arange(2)).ravel()
    return (starts[:, None] + inside).astype(np.int32)


def _phases_differ(level: np.ndarray, noise: np.ndarray, samples: int) -> bool:
    """Whether the 2 x 2 phases see different skies, as behind a colour mosaic that the file does not declare.

    The two diagonals are compared, because a gradient of the sky leaves them equal.
    """
    contrast = median((level[0] + level[3] - level[1] - level[2]).ravel()) / 2
    typical = median(noise.ravel())
    error = typical / np.sqrt(samples * level[0].size)
    return bool(abs(contrast) > max(0.03 * typical, 6 * error, 0.1))
