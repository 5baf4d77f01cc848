# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Moments of images through elliptical Gaussian windows."""

from libc.math cimport NAN, exp, rint

import numpy as np

# A window is as good as closed where it lets less through.
cdef double CLOSED = 1e-30


cdef struct Sums:
    # Of a row: of its light, and of the light times the distance and its square.
    double light
    double x
    double xx


cdef inline void _add_side(
    const float *row, int first, int step, int count, double dx, double through, double ratio, double change, Sums *sums
) noexcept nogil:
    """Add pixels first, first + step ...: neighbours in a Gaussian have a ratio, which changes by a constant factor."""
    cdef double light
    cdef int i
    for i in range(count):
        light = through * row[first + i * step]
        sums.light += light
        sums.x += light * dx
        sums.xx += light * dx * dx
        dx += step
        through *= ratio
        ratio *= change


def windowed(
    const float[:, :, ::1] signal, const double[::1] left, const double[::1] top, const double[:, :, ::1] inverse
):
    """Moments of N images (N, S, S) through windows about points.

    left, top  (N,) px: of the first column and the first row from each point
    inverse    (N, 2, 2) or (1, 2, 2): inverse covariances of the windows, 1/px2

    Returns the sum (N,), the mean (N, 2) px from the points, and the covariance (N, 2, 2) px2; NaN without light.
    """
    cdef int n = signal.shape[0], height = signal.shape[1], width = signal.shape[2], k, j, middle, w
    cdef double xx, xy, yy, dx, dy, through, change, mass, x, y, cxx, cxy, cyy
    cdef Sums row
    masses, means, shapes = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    cdef double[::1] out = masses
    cdef double[:, ::1] mean = means
    cdef double[:, :, ::1] shape = shapes
    for k in range(n):
        w = k if inverse.shape[0] > 1 else 0
        xx, xy, yy = inverse[w, 0, 0], inverse[w, 0, 1], inverse[w, 1, 1]
        change = exp(-xx)
        mass = x = y = cxx = cxy = cyy = 0.0
        for j in range(height):
            dy = top[k] + j
            # from the pixel of the row where the window is most open to both sides
            middle = <int>max(0.0, min(rint(-left[k] - xy * dy / xx), width - 1.0))
            dx = left[k] + middle
            through = exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
            if through < CLOSED:
                continue
            row.light = row.x = row.xx = 0.0
            _add_side(
                &signal[k, j, 0], middle, 1, width - middle, dx, through, exp(-0.5 * (xx * (2 * dx + 1) + 2 * xy * dy)),
                change, &row,
            )
            through *= exp(-0.5 * (xx * (1 - 2 * dx) - 2 * xy * dy))
            _add_side(
                &signal[k, j, 0], middle - 1, -1, middle, dx - 1, through,
                exp(-0.5 * (xx * (3 - 2 * dx) - 2 * xy * dy)), change, &row,
            )
            mass += row.light
            x += row.x
            y += row.light * dy
            cxx += row.xx
            cxy += row.x * dy
            cyy += row.light * dy * dy
        out[k] = mass
        if not mass > 0:
            mean[k, 0] = mean[k, 1] = shape[k, 0, 0] = shape[k, 0, 1] = shape[k, 1, 0] = shape[k, 1, 1] = NAN
            continue
        x, y = x / mass, y / mass
        mean[k, 0], mean[k, 1] = x, y
        shape[k, 0, 0], shape[k, 1, 1] = cxx / mass - x * x, cyy / mass - y * y
        shape[k, 0, 1] = shape[k, 1, 0] = cxy / mass - x * y
    return masses, means, shapes
