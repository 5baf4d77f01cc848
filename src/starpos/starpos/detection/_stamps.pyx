# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The pixels around stars, above the sky and in its noise."""

from libc.math cimport ceil
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy

import numpy as np

from starpos._numeric.algebra cimport fetch
from starpos._numeric.limits cimport inside
from starpos._numeric.wide cimport wide_void

cdef enum:
    # No pixel is as bright.
    BEYOND = 65536

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short


cdef wide_void _take_row(const pixel_t *line, int n, const float *level, float *signal, int *highest) noexcept nogil:
    """Take the light of n pixels above the sky, and the highest of them if it is higher than what is there."""
    cdef int j, most = highest[0]
    for j in range(n):
        signal[j] = <float>line[j] - level[j]
        most = max(most, <int>line[j])
    highest[0] = most


cdef wide_void _mark_row(const pixel_t *line, int n, int limit, unsigned char *good, unsigned char *full) noexcept nogil:
    """Mark the pixels of a row that are saturated, and those that are not."""
    cdef int j
    for j in range(n):
        full[j] = line[j] >= limit
    for j in range(n):
        good[j] = full[j] ^ 1


def around(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach, const float[:, ::1] level,
    const float[:, ::1] noise, double saturation,
):
    """Stamps of (2 reach + 1) px around the pixels x, y (N,) of a plane (h, w).

    level, noise  (N, P) DN of the sky at each star, P = 1, or 4 for the phases of a colour mosaic
    saturation    DN from which a pixel is saturated

    Returns signal, noise, good, full and phase, as `detection.stamps.Stamps` has them. A pixel beyond the frame is as
    the nearest one on it, but neither good nor full.
    """
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row, place, odd
    cdef int size = 2 * reach + 1, phases = level.shape[1], phase, highest = 0
    cdef int limit = <int>ceil(saturation) if saturation < BEYOND else BEYOND
    cdef const pixel_t *line
    cdef bint whole
    if not (y.shape[0] == level.shape[0] == noise.shape[0] == n and noise.shape[1] == phases and phases in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    skies, marks = np.empty((2, n, size, size), np.float32), np.empty((3, n, size, size), np.uint8)
    cdef float[:, :, ::1] sky = skies.reshape(2, n, size * size)
    cdef unsigned char[:, :, ::1] mark = marks.reshape(3, n, size * size)
    # level and noise of the pixels of an even row and of an odd one, their phases, and pixels of a row that leaves the frame
    cdef float *level_of = <float *>malloc(4 * size * sizeof(float))
    cdef float *noise_of = level_of + 2 * size
    cdef unsigned char *phase_of = <unsigned char *>malloc(2 * size)
    cdef pixel_t *pixels = <pixel_t *>malloc(size * sizeof(pixel_t))
    if level_of == NULL or phase_of == NULL or pixels == NULL:
        free(level_of)
        free(phase_of)
        free(pixels)
        raise MemoryError
    with nogil:
        for k in range(n):
            whole = reach <= x[k] < width - reach
            # peaks are in no order: the next one's rows are far away
            for i in range(size if k + 1 < n else 0):
                fetch(&plane[inside(y[k + 1] - reach + i, height), inside(x[k + 1] - reach, width)])
            for i in range(2):
                for j in range(size):
                    phase = <int>(2 * i + (x[k] - reach + j & 1)) if phases > 1 else 0
                    phase_of[i * size + j] = <unsigned char>phase
                    level_of[i * size + j], noise_of[i * size + j] = level[k, phase], noise[k, phase]
            for i in range(size):
                row, place, odd = y[k] - reach + i, i * size, (y[k] - reach + i & 1) * size
                line = &plane[inside(row, height), 0]
                if whole:
                    line += x[k] - reach
                else:
                    for j in range(size):
                        pixels[j] = line[inside(x[k] - reach + j, width)]
                    line = pixels
                _take_row(line, size, level_of + odd, &sky[0, k, place], &highest)
                _mark_row(line, size, limit, &mark[0, k, place], &mark[1, k, place])
                memcpy(&sky[1, k, place], noise_of + odd, size * sizeof(float))
                memcpy(&mark[2, k, place], phase_of + odd, size)
                for j in range(0 if whole and 0 <= row < height else size):
                    if not (0 <= row < height and 0 <= x[k] - reach + j < width):
                        mark[0, k, place + j] = mark[1, k, place + j] = False
    free(level_of)
    free(phase_of)
    free(pixels)
    good, white = marks[:2].view(bool)
    return skies[0], skies[1], good, white, marks[2]


def light_around(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach, const float[:, ::1] level,
    double saturation,
):
    """The signal alone (N, S, S) of stamps as in `around`, and whether one of their pixels is saturated, (N,) bool.

    Pixels beyond the frame count too: of a star on the frame they are as others on its stamp.
    """
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row
    cdef int size = 2 * reach + 1, phases = level.shape[1], highest
    cdef const pixel_t *line
    if not (y.shape[0] == level.shape[0] == n and phases in (1, 4)):
        raise ValueError("a row, and a level for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    light, white = np.empty((n, size, size), np.float32), np.empty(n, np.uint8)
    cdef float[:, :, ::1] signal = light
    cdef unsigned char[::1] full = white
    # of the columns of an even row and of an odd one, and pixels where a row is not on the frame
    cdef float *skies = <float *>malloc(2 * size * sizeof(float))
    cdef pixel_t *pixels = <pixel_t *>malloc(size * sizeof(pixel_t))
    if skies == NULL or pixels == NULL:
        free(skies)
        free(pixels)
        raise MemoryError
    with nogil:
        for k in range(n):
            for i in range(size if k + 1 < n else 0):
                fetch(&plane[inside(y[k + 1] - reach + i, height), inside(x[k + 1] - reach, width)])
            for i in range(2):
                for j in range(size):
                    skies[i * size + j] = level[k, 2 * i + (x[k] - reach + j & 1)] if phases > 1 else level[k, 0]
            highest = 0
            for i in range(size):
                row = y[k] - reach + i
                line = &plane[inside(row, height), 0]
                if reach <= x[k] < width - reach:
                    line += x[k] - reach
                else:
                    for j in range(size):
                        pixels[j] = line[inside(x[k] - reach + j, width)]
                    line = pixels
                _take_row(line, size, skies + (row & 1) * size, &signal[k, i, 0], &highest)
            full[k] = highest >= saturation
    free(skies)
    free(pixels)
    return light, white.view(bool)


def greyed(const float[:, :, ::1] signal):
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
    cdef float *line = <float *>malloc((columns + 2) * sizeof(float))
    if line == NULL:
        raise MemoryError
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
    free(line)
    return out
