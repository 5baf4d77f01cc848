# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Moments of images through elliptical Gaussian windows, and the places of images by them."""

from libc.math cimport NAN, exp, rint
from libc.stdlib cimport free, malloc

import numpy as np

cimport starpos.core.wide

cdef extern from *:
    """
    /* Columns that are summed at once, in quadruples: left to itself a compiler takes them one by one. */
    #define STARPOS_LANES 8
    #define STARPOS_FOURS 2
    typedef double starpos_four __attribute__((vector_size(32)));
    typedef double starpos_anywhere __attribute__((vector_size(32), aligned(8)));
    /* Sums of columns side by side: of their light through a window, and of it times the distance in y and its square.
       A column's neighbours in a Gaussian have a ratio, which changes by a constant factor from row to row. */
    STARPOS_WIDE static void starpos_columns(const double *light, int rows, int stride, int middle, double dx, double dy,
                                             double xx, double xy, double yy, double change, double *out) {
        starpos_four sum[STARPOS_FOURS] = {{0}}, sum_y[STARPOS_FOURS] = {{0}}, sum_yy[STARPOS_FOURS] = {{0}};
        starpos_four first[STARPOS_FOURS], down[STARPOS_FOURS], up[STARPOS_FOURS];
        for (int p = 0; p < STARPOS_LANES; p++) {
            const double x = dx + p;
            ((double *)first)[p] = -0.5 * (xx * x * x + 2 * xy * x * dy + yy * dy * dy);
            ((double *)down)[p] = -(xy * x + yy * (dy + 0.5));
        }
        starpos_exps((double *)first, STARPOS_LANES);
        starpos_exps((double *)down, STARPOS_LANES);
        for (int k = 0; k < STARPOS_FOURS; k++)
            up[k] = change / down[k];
        for (int side = 0; side < 2; side++) {
            const int step = side ? -1 : 1, count = side ? middle : rows - middle;
            const double *from = light + (side ? middle - 1 : middle) * stride;
            starpos_four through[STARPOS_FOURS], ratio[STARPOS_FOURS];
            double y = side ? dy - 1 : dy;
            for (int k = 0; k < STARPOS_FOURS; k++) {
                through[k] = side ? first[k] * up[k] : first[k];
                ratio[k] = side ? up[k] * change : down[k];
            }
            for (int j = 0; j < count; j++) {
                const starpos_anywhere *row = (const starpos_anywhere *)from;
                for (int k = 0; k < STARPOS_FOURS; k++) {
                    const starpos_four some = through[k] * row[k], lever = some * y;
                    sum[k] += some;
                    sum_y[k] += lever;
                    sum_yy[k] += lever * y;
                    through[k] *= ratio[k];
                    ratio[k] *= change;
                }
                y += step;
                from += step * stride;
            }
        }
        for (int p = 0; p < STARPOS_LANES; p++) {
            const double x = dx + p, some = sum[p / 4][p % 4], lever = sum_y[p / 4][p % 4];
            out[0] += some;
            out[1] += some * x;
            out[2] += lever;
            out[3] += some * x * x;
            out[4] += lever * x;
            out[5] += sum_yy[p / 4][p % 4];
        }
    }
    """
    void add_columns "starpos_columns"(
        const double *light, int rows, int stride, int middle, double dx, double dy, double xx, double xy, double yy,
        double change, double *out,
    ) noexcept nogil


cdef enum:
    LANES = 8


cdef struct Image:
    # In rows of whole lanes, beyond its own columns dark.
    double *light
    int size
    int stride


cdef int _begin(Image *image, int size) except -1:
    """Take memory for an image (size, size)."""
    image.size, image.stride = size, (size + LANES - 1) // LANES * LANES
    image.light = <double *>malloc(max(size * image.stride, 1) * sizeof(double))
    if image.light == NULL:
        raise MemoryError
    return 0


cdef void _take(Image *image, const float *signal) noexcept nogil:
    """Take the pixels (S, S) of an image."""
    cdef int j, i
    for j in range(image.size):
        for i in range(image.size):
            image.light[j * image.stride + i] = signal[j * image.size + i]
        for i in range(image.size, image.stride):
            image.light[j * image.stride + i] = 0.0


cdef void _moments(const Image *image, const double *window, double left, double top, double *out) noexcept nogil:
    """Set `out` (6,) to sum, mean x, y and covariance xx, xy, yy through a window (2, 2) px2; NaN without light."""
    cdef double volume = window[0] * window[3] - window[1] * window[2]
    cdef double xx = window[3] / volume, xy = -window[1] / volume, yy = window[0] / volume, change = exp(-yy)
    # from the row nearest to the window's middle to both sides
    cdef int middle = <int>max(0.0, min(rint(-top), image.size - 1.0)), block, first, k
    for k in range(6):
        out[k] = 0.0
    for block in range(image.stride // LANES):
        first = block * LANES
        add_columns(
            image.light + first, image.size, image.stride, middle, left + first, top + middle, xx, xy, yy, change, out
        )
    if not out[0] > 0:
        for k in range(1, 6):
            out[k] = NAN
        return
    for k in range(1, 6):
        out[k] /= out[0]
    out[3] -= out[1] * out[1]
    out[4] -= out[1] * out[2]
    out[5] -= out[2] * out[2]


cdef int _sound(const float[:, :, ::1] signal, int places, int rows, const double[:, :, ::1] windows) except -1:
    """Raise ValueError unless there are a place and a window for each square image."""
    cdef Py_ssize_t n = signal.shape[0]
    if places != n or rows != n or signal.shape[1] != signal.shape[2] or windows.shape[0] not in (1, n):
        raise ValueError(f"{places} places and {windows.shape[0]} windows for {n} square images: a place each is needed")
    if windows.shape[1] != 2 or windows.shape[2] != 2:
        raise ValueError(f"windows of {windows.shape[1]} x {windows.shape[2]} numbers: 2 x 2 are needed")
    return 0


def windowed(
    const float[:, :, ::1] signal, const double[::1] left, const double[::1] top, const double[:, :, ::1] window
):
    """Moments of N images (N, S, S) through windows about points.

    left, top  (N,) px: of the first column and the first row from each point
    window     (N, 2, 2) or (1, 2, 2): covariances of the windows, px2

    Returns the sum (N,), the mean (N, 2) px from the points, and the covariance (N, 2, 2) px2; NaN without light.
    """
    cdef int n = signal.shape[0], k
    cdef Image image
    cdef double[6] found
    _sound(signal, left.shape[0], top.shape[0], window)
    masses, means, shapes = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    cdef double[::1] mass = masses
    cdef double[:, ::1] mean = means
    cdef double[:, :, ::1] shape = shapes
    _begin(&image, signal.shape[1])
    with nogil:
        for k in range(n):
            _take(&image, &signal[k, 0, 0])
            _moments(&image, &window[k if window.shape[0] > 1 else 0, 0, 0], left[k], top[k], found)
            mass[k], mean[k, 0], mean[k, 1] = found[0], found[1], found[2]
            shape[k, 0, 0], shape[k, 1, 1] = found[3], found[5]
            shape[k, 0, 1] = shape[k, 1, 0] = found[4]
    free(image.light)
    return masses, means, shapes


def centred(
    const float[:, :, ::1] signal, const Py_ssize_t[::1] column, const Py_ssize_t[::1] row,
    const double[:, :, ::1] window, const double[:, :, ::1] gain, int rounds, double farthest,
):
    """Places x, y (N,) px of N images (N, S, S) by the means of their light through windows, which go with the places.

    column, row  (N,) of each image's middle, where it begins
    window       (N, 2, 2) or (1, 2, 2): covariances of the windows, px2
    gain         as many: a step over the mean through the window; at most 1 px
    farthest     px from the beginning
    """
    cdef int n = signal.shape[0], half = signal.shape[1] // 2, k, w, i, round_
    cdef Image image
    cdef double[6] found
    cdef double[2] place
    cdef double[2] begin
    cdef double step
    _sound(signal, column.shape[0], row.shape[0], window)
    _sound(signal, column.shape[0], row.shape[0], gain)
    if gain.shape[0] != window.shape[0]:
        raise ValueError(f"{window.shape[0]} windows and {gain.shape[0]} gains: as many are needed")
    out = np.empty((2, n))
    cdef double[:, ::1] places = out
    _begin(&image, signal.shape[1])
    with nogil:
        for k in range(n):
            w = k if window.shape[0] > 1 else 0
            _take(&image, &signal[k, 0, 0])
            begin[0], begin[1] = column[k], row[k]
            place[0], place[1] = begin[0], begin[1]
            for round_ in range(rounds):
                _moments(&image, &window[w, 0, 0], begin[0] - half - place[0], begin[1] - half - place[1], found)
                # without light it stays where it is
                if not found[0] > 0:
                    break
                for i in range(2):
                    step = max(-1.0, min(gain[w, i, 0] * found[1] + gain[w, i, 1] * found[2], 1.0))
                    place[i] = max(begin[i] - farthest, min(place[i] + step, begin[i] + farthest))
            places[0, k], places[1, k] = place[0], place[1]
    free(image.light)
    return out[0], out[1]
