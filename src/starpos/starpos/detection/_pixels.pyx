# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The 8- or 16-bit pixels of a plane (h, w): stamps around stars, hot pixels and the sky around peaks.

A pixel beyond the frame is the nearest one on it. level, noise (N, P) DN are of the sky at each of N stars or peaks x, y (N,)
px, P = 1, or 4 for the phases of a colour mosaic.
"""

from libc.math cimport ceil, sqrt
from libc.string cimport memcpy, memset

import numpy as np

from starpos._numeric.algebra cimport fetch, level_and_scatter
from starpos._numeric.limits cimport inside, within
from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport wide_void

cdef enum:
    # No pixel is as bright.
    BEYOND = 65536

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short


cdef inline int _phase(Py_ssize_t row, Py_ssize_t column, int phases) noexcept nogil:
    """The number of a pixel in the mosaic's pattern."""
    return <int>(2 * (row & 1) + (column & 1)) if phases > 1 else 0


cdef void _fetch_rows(const pixel_t[:, ::1] plane, Py_ssize_t x, Py_ssize_t y, int reach) noexcept nogil:
    """Ask for the ends of the rows around a peak, because peaks are in no order."""
    cdef Py_ssize_t row
    cdef int i
    for i in range(-reach, reach + 1):
        row = inside(y + i, plane.shape[0])
        fetch(&plane[row, inside(x - reach, plane.shape[1])])
        fetch(&plane[row, inside(x + reach, plane.shape[1])])


cdef int _check_sky(
    const Py_ssize_t *size, Py_ssize_t n, Py_ssize_t rows, const Py_ssize_t *level, const Py_ssize_t *noise
) except -1:
    if not (rows == level[0] == noise[0] == n and level[1] == noise[1] and level[1] in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a peak")
    if not (size[0] and size[1]):
        raise ValueError(f"peaks of a frame of {size[1]} x {size[0]} px: there is nothing to see")
    return 0


def sum_squares(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const float[:, ::1] level,
    const float[:, ::1] noise, int reach,
):
    """The light of the squares of (2 reach + 1) px around peaks: (4, N).

    Rows are the sum, the light of the brightest pixel and of the second, and 1 sigma of the sum in the sky's noise.
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column
    cdef int phases = level.shape[1], i, j, phase
    cdef double light, first, second, total, variance
    _check_sky(plane.shape, n, y.shape[0], level.shape, noise.shape)
    out = np.empty((4, n))
    cdef double[:, ::1] found = out
    with nogil:
        for k in range(n):
            if k + 1 < n:
                _fetch_rows(plane, x[k + 1], y[k + 1], reach)
            first = second = -1e300
            total = variance = 0.0
            for i in range(-reach, reach + 1):
                row = inside(y[k] + i, plane.shape[0])
                for j in range(-reach, reach + 1):
                    column, phase = inside(x[k] + j, plane.shape[1]), _phase(y[k] + i, x[k] + j, phases)
                    light = plane[row, column] - level[k, phase]
                    total += light
                    second = max(second, min(light, first))
                    first = max(first, light)
                    variance += <double>noise[k, phase] * noise[k, phase]
            found[0, k], found[1, k], found[2, k], found[3, k] = total, first, second, sqrt(variance)
    return out


def measure_rims(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const float[:, ::1] level,
    const float[:, ::1] noise, int reach, double per_mad, double raised, double uneven,
):
    """Median (N,) and scatter (N,), over the noise, of the light along the edges of squares, reach px from peaks (N,).

    per_mad         sigma over the median of the absolute differences
    raised, uneven  median and scatter are 0 and 1 where they are not above these
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column
    cdef int side = 2 * reach, phases = level.shape[1], i, j, phase
    cdef double sky, spread
    _check_sky(plane.shape, n, y.shape[0], level.shape, noise.shape)
    if reach < 1:
        raise ValueError(f"squares of {reach} px have no edge: give 1 or more")
    out = np.empty((2, n))
    cdef double[:, ::1] found = out
    room = room_for(4 * side * sizeof(double))
    cdef double *score = <double *>start_of(room)
    with nogil:
        for k in range(n):
            if k + 1 < n:
                _fetch_rows(plane, x[k + 1], y[k + 1], reach)
            for j in range(4 * side):
                # from corner to corner: along the top, down the right side, and back
                i = j % side - reach
                if j // side == 0:
                    row, column = y[k] - reach, x[k] + i
                elif j // side == 1:
                    row, column = y[k] + i, x[k] + reach
                elif j // side == 2:
                    row, column = y[k] + reach, x[k] - i
                else:
                    row, column = y[k] - i, x[k] - reach
                row, column = inside(row, plane.shape[0]), inside(column, plane.shape[1])
                phase = _phase(row, column, phases)
                score[j] = <double>(<float>plane[row, column] - level[k, phase]) / noise[k, phase]
            sky, spread = level_and_scatter(score, 4 * side, per_mad, uneven)
            found[0, k], found[1, k] = sky if sky > raised else 0.0, spread
    return out[0], out[1]


cdef wide_void _copy_row(const pixel_t *line, int n, const float *level, float *signal, int *highest) noexcept nogil:
    """Set the light of n pixels above the sky, and `highest` to the highest pixel if it is higher."""
    cdef int j, most = highest[0]
    for j in range(n):
        signal[j] = <float>line[j] - level[j]
        most = max(most, <int>line[j])
    highest[0] = most


def cut_stamps(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach, const float[:, ::1] level,
    const float[:, ::1] noise, double saturation,
):
    """Stamps of (2 reach + 1) px around the pixels x, y (N,) of a plane (h, w).

    level, noise  (N, P) DN of the sky at each star, P = 1, or 4 for the phases of a colour mosaic
    saturation    DN from which a pixel is saturated

    Returns signal, noise, good, full and phase, as `detection.stamps.Stamps` has them. A pixel beyond the frame is as
    the nearest one on it, but neither good nor full.
    """
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row, column, odd
    cdef int size = 2 * reach + 1, phases = level.shape[1], phase, highest
    cdef int limit = <int>ceil(saturation) if saturation < BEYOND else BEYOND
    cdef const pixel_t *line
    cdef bint whole, on
    if not (y.shape[0] == level.shape[0] == noise.shape[0] == n and noise.shape[1] == phases and phases in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    skies, marks = np.empty((2, n, size, size), np.float32), np.zeros((3, n, size, size), np.uint8)
    cdef float[:, :, ::1] sky = skies.reshape(2, n, size * size)
    cdef unsigned char[:, :, ::1] mark = marks.reshape(3, n, size * size)
    # level and noise of the pixels of an even row and of an odd one, their phases, and pixels of a row that leaves the frame
    room = room_for(4 * size * sizeof(float) + size * sizeof(pixel_t) + 2 * size)
    cdef float *level_of = <float *>start_of(room)
    cdef float *noise_of = level_of + 2 * size
    cdef pixel_t *pixels = <pixel_t *>(noise_of + 2 * size)
    cdef unsigned char *phase_of = <unsigned char *>(pixels + size)
    with nogil:
        for k in range(n):
            whole, highest = reach <= x[k] < width - reach, 0
            # peaks are in no order: the next one's rows are far away
            for i in range(size if k + 1 < n else 0):
                fetch(&plane[inside(y[k + 1] - reach + i, height), inside(x[k + 1] - reach, width)])
            for i in range(2):
                for j in range(size):
                    phase = <int>(2 * i + (x[k] - reach + j & 1)) if phases > 1 else 0
                    phase_of[i * size + j] = <unsigned char>phase
                    level_of[i * size + j], noise_of[i * size + j] = level[k, phase], noise[k, phase]
            for i in range(size):
                row, odd = y[k] - reach + i, (y[k] - reach + i & 1) * size
                line = &plane[inside(row, height), 0]
                if whole:
                    line += x[k] - reach
                else:
                    for j in range(size):
                        pixels[j] = line[inside(x[k] - reach + j, width)]
                    line = pixels
                _copy_row(line, size, level_of + odd, &sky[0, k, i * size], &highest)
                if phases > 1:
                    memcpy(&sky[1, k, i * size], noise_of + odd, size * sizeof(float))
                    memcpy(&mark[2, k, i * size], phase_of + odd, size)
            for j in range(size * size if phases == 1 else 0):
                sky[1, k, j] = noise_of[0]
            # most stars are on the frame and none of their pixels is saturated
            if whole and reach <= y[k] < height - reach and highest < limit:
                memset(&mark[0, k, 0], True, size * size)
                continue
            for i in range(size):
                for j in range(size):
                    row, column = y[k] - reach + i, x[k] - reach + j
                    on = 0 <= row < height and 0 <= column < width
                    mark[1, k, i * size + j] = on and plane[row, column] >= limit
                    mark[0, k, i * size + j] = on and not plane[row, column] >= limit
    good, white = marks[:2].view(bool)
    return skies[0], skies[1], good, white, marks[2]


def smooth_mosaic(const float[:, :, ::1] signal):
    """Images (N, S, S) smoothed along both axes by 1/4, 1/2, 1/4, which removes a mosaic's pattern; they end as in a level."""
    cdef Py_ssize_t n = signal.shape[0], rows = signal.shape[1], columns = signal.shape[2], k, i, j
    cdef const float *above
    cdef const float *own
    cdef const float *below
    cdef float *to
    out = np.empty((n, rows, columns), np.float32)
    if not columns:
        return out
    cdef float[:, :, ::1] smooth = out
    room = room_for((columns + 2) * sizeof(float))
    cdef float *line = <float *>start_of(room)
    with nogil:
        for k in range(n):
            for i in range(rows):
                above, own, below = &signal[k, max(i - 1, 0), 0], &signal[k, i, 0], &signal[k, min(i + 1, rows - 1), 0]
                to = &smooth[k, i, 0]
                for j in range(columns):
                    line[j + 1] = <float>0.5 * own[j] + <float>0.25 * (above[j] + below[j])
                line[0], line[columns + 1] = line[1], line[columns]
                for j in range(columns):
                    to[j] = <float>0.5 * line[j + 1] + <float>0.25 * (line[j] + line[j + 2])
    return out


def any_flat(const pixel_t[:, ::1] plane, const Py_ssize_t[::1] rows, const Py_ssize_t[::1] columns):
    """Whether a block of 8 x 8 equal pixels above 0 is among some of a plane's blocks: those in these rows and columns of them."""
    cdef Py_ssize_t i, j
    if not (
        within[Py_ssize_t](&rows[0], rows.shape[0], 0, plane.shape[0] // 8 - 1)
        and within[Py_ssize_t](&columns[0], columns.shape[0], 0, plane.shape[1] // 8 - 1)
    ):
        raise ValueError(f"a block lies beyond the {plane.shape[1]} x {plane.shape[0]} px of the frame")
    for i in range(rows.shape[0]):
        for j in range(columns.shape[0]):
            if _is_flat(&plane[8 * rows[i], 8 * columns[j]], plane.shape[1]):
                return True
    return False


cdef bint _is_flat(const pixel_t *block, Py_ssize_t width) noexcept nogil:
    cdef int y, x
    if block[0] == 0:
        return False
    for y in range(8):
        for x in range(8):
            if block[y * width + x] != block[0]:
                return False
    return True


def third_highest(const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach):
    """The third highest value (N,) of the squares around pixels x, y (N,), and how many pixels of a square share it, (N,).

    A square reaches so far (px); beyond the frame it holds 0.
    """
    cdef Py_ssize_t n = x.shape[0], k, row, column, height = plane.shape[0], width = plane.shape[1], left, right
    cdef int value
    cdef int[3] top
    cdef const pixel_t *line
    if y.shape[0] != n or reach < 1:
        raise ValueError(f"{n} columns and {y.shape[0]} rows of squares of {reach} px: as many are needed, of 1 px or more")
    out = np.zeros((2, n), np.intp)
    cdef Py_ssize_t[:, ::1] found = out
    with nogil:
        for k in range(n):
            top[0] = top[1] = top[2] = 0
            left, right = max(x[k] - reach, 0), min(x[k] + reach + 1, width)
            for row in range(max(y[k] - reach, 0), min(y[k] + reach + 1, height)):
                line = &plane[row, 0]
                for column in range(left, right):
                    value = line[column]
                    if value > top[2]:
                        top[2] = value
                        if top[2] > top[1]:
                            top[1], top[2] = top[2], top[1]
                        if top[1] > top[0]:
                            top[0], top[1] = top[1], top[0]
            for row in range(max(y[k] - reach, 0), min(y[k] + reach + 1, height)):
                line = &plane[row, 0]
                for column in range(left, right):
                    found[1, k] += line[column] == top[2]
            found[0, k] = top[2]
    return out[0], out[1]
