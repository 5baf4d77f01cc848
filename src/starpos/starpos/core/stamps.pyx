# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The pixels around stars, above the sky and in its noise."""

import numpy as np

ctypedef fused pixel_t:
    unsigned char
    unsigned short


cdef inline Py_ssize_t _inside(Py_ssize_t k, Py_ssize_t n) noexcept nogil:
    """The row or column of n that is nearest to k."""
    return max(0, min(k, n - 1))


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
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row, column
    cdef int size = 2 * reach + 1, phases = level.shape[1], phase
    cdef pixel_t value
    cdef bint on
    if not (y.shape[0] == level.shape[0] == noise.shape[0] == n and noise.shape[1] == phases and phases in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    skies, marks = np.empty((2, n, size, size), np.float32), np.empty((3, n, size, size), np.uint8)
    cdef float[:, :, :, ::1] sky = skies
    cdef unsigned char[:, :, :, ::1] mark = marks
    with nogil:
        for k in range(n):
            for i in range(size):
                row = y[k] - reach + i
                for j in range(size):
                    column = x[k] - reach + j
                    on = 0 <= row < height and 0 <= column < width
                    phase = <int>(2 * (row & 1) + (column & 1)) if phases > 1 else 0
                    value = plane[_inside(row, height), _inside(column, width)]
                    sky[0, k, i, j], sky[1, k, i, j] = <float>value - level[k, phase], noise[k, phase]
                    mark[0, k, i, j], mark[1, k, i, j] = on and value < saturation, on and value >= saturation
                    mark[2, k, i, j] = phase
    good, full = marks[:2].view(bool)
    return skies[0], skies[1], good, full, marks[2]
