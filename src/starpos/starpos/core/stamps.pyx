# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The pixels around stars, above the sky and in its noise."""

from libc.math cimport ceil, fabs
from libc.stdlib cimport free, malloc

import numpy as np

from starpos.core.algebra cimport middle

cdef enum:
    # No pixel is as bright.
    BEYOND = 65536

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
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row, place
    cdef int size = 2 * reach + 1, phases = level.shape[1], phase
    cdef int limit = <int>ceil(saturation) if saturation < BEYOND else BEYOND, value
    cdef const pixel_t *line
    cdef bint on, full
    if not (y.shape[0] == level.shape[0] == noise.shape[0] == n and noise.shape[1] == phases and phases in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    skies, marks = np.empty((2, n, size, size), np.float32), np.empty((3, n, size, size), np.uint8)
    cdef float[:, :, ::1] sky = skies.reshape(2, n, size * size)
    cdef unsigned char[:, :, ::1] mark = marks.reshape(3, n, size * size)
    with nogil:
        for k in range(n):
            for i in range(size):
                row, place = y[k] - reach + i, i * size
                line = &plane[_inside(row, height), 0]
                for j in range(x[k] - reach, x[k] + reach + 1):
                    on = 0 <= row < height and 0 <= j < width
                    phase = <int>(2 * (row & 1) + (j & 1)) if phases > 1 else 0
                    value = line[_inside(j, width)]
                    sky[0, k, place], sky[1, k, place] = <float>value - level[k, phase], noise[k, phase]
                    full = value >= limit
                    mark[0, k, place], mark[1, k, place], mark[2, k, place] = on and not full, on and full, phase
                    place += 1
    good, white = marks[:2].view(bool)
    return skies[0], skies[1], good, white, marks[2]


def scatter(const float[:, ::1] signal, const float[:, ::1] noise, double per_mad):
    """Median (N,) and scatter (N,) of signal over noise, of K pixels each: (N, K).

    per_mad: sigma over the median of the absolute differences.
    """
    cdef Py_ssize_t n = signal.shape[0], k
    cdef int many = signal.shape[1], j
    if noise.shape[0] != n or noise.shape[1] != many or many < 1:
        raise ValueError(f"{n} x {many} pixels, {noise.shape[0]} x {noise.shape[1]} noises: as many are needed, at least one")
    out = np.empty((2, n))
    cdef double[:, ::1] found = out
    cdef double *score = <double *>malloc(many * sizeof(double))
    if score == NULL:
        raise MemoryError
    with nogil:
        for k in range(n):
            for j in range(many):
                score[j] = <double>signal[k, j] / noise[k, j]
            found[0, k] = middle(score, many)
            for j in range(many):
                score[j] = fabs(score[j] - found[0, k])
            found[1, k] = per_mad * middle(score, many)
    free(score)
    return out[0], out[1]
