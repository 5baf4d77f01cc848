# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Moments of images through elliptical Gaussian windows, and covariances of two dimensions, many at once.

The latter are closed forms of what takes a library longer to begin than to do.
"""

from libc.math cimport INFINITY, NAN, exp, isfinite, isnan, rint, sqrt
from libc.string cimport memcpy, memset

import numpy as np

cimport starpos._numeric.wide
from starpos._numeric.memory cimport room_for, start_of
from starpos.detection._shapes cimport Shape, clipped_to, inverse, put_shape, shape_before, shape_of, sides, with_sides

cdef extern from *:
    """
    /* In C because Cython has no constants of several numbers: columns one by one take 2.6 times the instructions here, a tenth
       more in all for a frame of 5 megapixels with 315 stars.
       Columns that are summed side by side, and groups of these whose Gaussians are made at once: left to itself a compiler
       takes them one by one, and of wider vectors than registers it keeps most in memory. */
    #define STARPOS_LANES 4
    #define STARPOS_GROUPS 16
    typedef double starpos_four __attribute__((vector_size(32)));
    typedef float starpos_pixels __attribute__((vector_size(16), aligned(4)));
    #define STARPOS_LIGHT(pixels) __builtin_convertvector(*(const starpos_pixels *)(pixels), starpos_four)
    /* Sums over groups of columns of their light through a window, and of it times x, y, xx, xy and yy.
       A column's neighbours in a Gaussian have a ratio, which changes by a constant factor from row to row: up and down from
       the middle one, whose distances to both sides are the same. */
    STARPOS_FUSED static void starpos_columns(const float *light, int rows, int stride, int groups, int middle, double dx,
                                             double dy, double xx, double xy, double yy, double change, double *out) {
        const starpos_four lanes = {0, 1, 2, 3};
        const int below = rows - 1 - middle, both = below < middle ? below : middle, longer = below + middle - both;
        starpos_four total[6] = {{0}}, power[2 * STARPOS_GROUPS];
        for (int g = 0; g < groups; g++) {
            const starpos_four x = dx + g * STARPOS_LANES + lanes;
            const int at = g % STARPOS_GROUPS;
            if (at == 0) {
                const int some = groups - g < STARPOS_GROUPS ? groups - g : STARPOS_GROUPS;
                for (int k = 0; k < some; k++) {
                    const starpos_four off = x + k * STARPOS_LANES;
                    power[2 * k] = -0.5 * (xx * off * off + 2 * xy * dy * off + yy * dy * dy);
                    power[2 * k + 1] = -(xy * off + yy * (dy + 0.5));
                }
                starpos_exps((double *)power, 2 * some * STARPOS_LANES);
            }
            const float *row = light + middle * stride + g * STARPOS_LANES, *down = row, *up = row;
            starpos_four to_down = power[2 * at + 1], to_up = change / to_down, of_down = power[2 * at], of_up = of_down;
            starpos_four sum = of_down * STARPOS_LIGHT(row), by_y = {0}, by_yy = {0}, y = {0};
            for (int j = 0; j < both; j++) {
                of_down *= to_down;
                of_up *= to_up;
                to_down *= change;
                to_up *= change;
                down += stride;
                up -= stride;
                y += 1;
                const starpos_four a = of_down * STARPOS_LIGHT(down), b = of_up * STARPOS_LIGHT(up), pair = a + b;
                sum += pair;
                by_y += (a - b) * y;
                by_yy += pair * y * y;
            }
            const int step = below > middle ? stride : -stride;
            starpos_four of_next = below > middle ? of_down : of_up, to_next = below > middle ? to_down : to_up;
            const double side = below > middle ? 1 : -1;
            row = below > middle ? down : up;
            for (int j = both; j < longer; j++) {
                of_next *= to_next;
                to_next *= change;
                row += step;
                y += 1;
                const starpos_four some = of_next * STARPOS_LIGHT(row), lever = some * y;
                sum += some;
                by_y += lever * side;
                by_yy += lever * y;
            }
            by_yy += 2 * dy * by_y + dy * dy * sum;
            by_y += dy * sum;
            total[0] += sum;
            total[1] += sum * x;
            total[2] += by_y;
            total[3] += sum * x * x;
            total[4] += by_y * x;
            total[5] += by_yy;
        }
        for (int k = 0; k < 6; k++)
            out[k] = (total[k][0] + total[k][1]) + (total[k][2] + total[k][3]);
    }
    """
    void sum_columns "starpos_columns"(
        const float *light, int rows, int stride, int groups, int middle, double dx, double dy, double xx, double xy,
        double yy, double change, double *out,
    ) noexcept nogil


cdef enum:
    LANES = 4

# A window's Gaussian is nothing (4e-6 of its peak) beyond so many of its widths.
cdef double WIDTHS = 5.0


cdef struct Image:
    # In rows of whole lanes, beyond its own columns dark.
    float *light
    int size
    int stride


cdef bytearray _allocate(Image *image, int size):
    """The memory of an image (size, size)."""
    image.size, image.stride = size, (size + LANES - 1) // LANES * LANES
    room = room_for(size * image.stride * sizeof(float))
    image.light = <float *>start_of(room)
    return room


cdef void _load(Image *image, const float *signal) noexcept nogil:
    """Take the pixels (S, S) of an image."""
    cdef int j
    for j in range(image.size):
        memcpy(image.light + j * image.stride, signal + j * image.size, image.size * sizeof(float))
        memset(image.light + j * image.stride + image.size, 0, (image.stride - image.size) * sizeof(float))


cdef inline int _within(double place, int most) noexcept nogil:
    """The whole number below a place, from 0 to so many; what is not a number is 0."""
    return <int>max(0.0, min(place, <double>most))


cdef void _moments(const Image *image, Shape window, double left, double top, double *out) noexcept nogil:
    """Set `out` (6,) to sum, mean x, y and covariance xx, xy, yy through a window, px2; NaN without light."""
    cdef Shape over = inverse(window)
    cdef double change = exp(-over.yy)
    # from the row nearest to the window's middle to both sides
    cdef int middle = <int>max(0.0, min(rint(-top), image.size - 1.0)), k
    cdef int begin = _within(-top - WIDTHS * sqrt(window.yy), middle), end
    cdef int first = _within(-left - WIDTHS * sqrt(window.xx), image.size), last
    end = 1 + _within(-top + WIDTHS * sqrt(window.yy) + 1, image.size - 1)
    last = 1 + _within(-left + WIDTHS * sqrt(window.xx) + 1, image.size - 1)
    # in whole lanes
    last = first + (max(last - first, 1) + LANES - 1) // LANES * LANES
    first -= max(last - image.stride, 0)
    sum_columns(
        image.light + begin * image.stride + first, end - begin, image.stride, (min(last, image.stride) - first) // LANES,
        middle - begin, left + first, top + middle, over.xx, over.xy, over.yy, change, out,
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


cdef int _check_images(const float[:, :, ::1] signal, int places, int rows, const double[:, :, ::1] windows) except -1:
    """Raise ValueError unless there are a place and a window for each square image."""
    cdef Py_ssize_t n = signal.shape[0]
    if places != n or rows != n or signal.shape[1] != signal.shape[2] or windows.shape[0] not in (1, n):
        raise ValueError(f"{places} places and {windows.shape[0]} windows for {n} square images: a place each is needed")
    if windows.shape[1] != 2 or windows.shape[2] != 2:
        raise ValueError(f"windows of {windows.shape[1]} x {windows.shape[2]} numbers: 2 x 2 are needed")
    return 0


def window_moments(
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
    _check_images(signal, left.shape[0], top.shape[0], window)
    masses, means, shapes = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    cdef double[::1] mass = masses
    cdef double[:, ::1] mean = means
    cdef double[:, :, ::1] shape = shapes
    room = _allocate(&image, signal.shape[1])
    with nogil:
        for k in range(n):
            _load(&image, &signal[k, 0, 0])
            _moments(&image, shape_of(window, k), left[k], top[k], found)
            mass[k], mean[k, 0], mean[k, 1] = found[0], found[1], found[2]
            shape[k, 0, 0], shape[k, 1, 1] = found[3], found[5]
            shape[k, 0, 1] = shape[k, 1, 0] = found[4]
    return masses, means, shapes


def centroids(
    const float[:, :, ::1] signal, const Py_ssize_t[::1] column, const Py_ssize_t[::1] row,
    const double[:, :, ::1] shape, double narrowest_window, int rounds, double farthest,
):
    """Places x, y (N,) px of N images (N, S, S) by the means of their light through windows, which go with the places.

    column, row       (N,) of each image's middle, where it begins
    shape             (N, 2, 2) or (1, 2, 2): covariances of the stars, px2, and of their windows
    narrowest_window  px2, of a window
    farthest          px from the beginning
    """
    cdef int n = signal.shape[0], k
    cdef Image image
    cdef double[2] begin
    _check_images(signal, column.shape[0], row.shape[0], shape)
    out = np.empty((n, 2))
    cdef double[:, ::1] places = out
    room = _allocate(&image, signal.shape[1])
    with nogil:
        for k in range(n):
            _load(&image, &signal[k, 0, 0])
            begin[0], begin[1] = column[k], row[k]
            _centre(&image, shape_of(shape, k), narrowest_window, begin, rounds, farthest, &places[k, 0])
    return np.ascontiguousarray(out.T)


cdef Shape _centre(
    const Image *image, Shape own, double narrowest_window, const double *begin, int rounds, double farthest, double *place
) noexcept nogil:
    """Set place (2,) px by the mean of an image's light, as `centroids` explains; the window."""
    cdef Shape window = clipped_to(own, narrowest_window, INFINITY, 1.0), over = inverse(window)
    cdef double[6] found
    cdef double half = image.size // 2, x, y
    cdef int round_
    place[0], place[1] = begin[0], begin[1]
    for round_ in range(rounds):
        _moments(image, window, begin[0] - half - place[0], begin[1] - half - place[1], found)
        # without light it stays where it is
        if not found[0] > 0:
            break
        # through the window an offset looks smaller than it is
        x, y = over.xx * found[1] + over.xy * found[2], over.xy * found[1] + over.yy * found[2]
        x, y = found[1] + own.xx * x + own.xy * y, found[2] + own.xy * x + own.yy * y
        place[0] = max(begin[0] - farthest, min(place[0] + max(-1.0, min(x, 1.0)), begin[0] + farthest))
        place[1] = max(begin[1] - farthest, min(place[1] + max(-1.0, min(y, 1.0)), begin[1] + farthest))
    return window


def own_shapes(
    const float[:, :, ::1] signal, double first, double narrowest_window, double narrowest, double widest, int rounds,
    int centring, double farthest,
):
    """Covariances (N, 2, 2) px2 of N images (N, S, S), each through a window of its own shape.

    first                px2 along any axis, where it begins
    narrowest_window     px2, of a window
    narrowest, widest    px2: limits of the covariances; where nothing can be measured they are the widest
    rounds               of windows; in each but the first, which is wide, so many rounds of centring, at most `farthest` px
                         from the middle

    Returns also their squared widths (N, 2) px2, the smaller first unless only that could not be measured.
    """
    cdef int n = signal.shape[0], k, round_
    cdef double half = signal.shape[1] // 2, low, high
    cdef Image image
    cdef Shape own, through
    cdef double[2] begin
    cdef double[2] place
    cdef double[6] found
    if signal.shape[1] != signal.shape[2]:
        raise ValueError(f"images of {signal.shape[2]} x {signal.shape[1]} px: they must be square")
    out, widths = np.empty((n, 2, 2)), np.empty((n, 2))
    cdef double[:, :, ::1] shape = out
    cdef double[:, ::1] width = widths
    low = high = first
    begin[0] = begin[1] = half
    room = _allocate(&image, signal.shape[1])
    with nogil:
        for k in range(n):
            _load(&image, &signal[k, 0, 0])
            own = Shape(first, 0.0, first)
            for round_ in range(rounds):
                through = _centre(&image, own, narrowest_window, begin, centring if round_ else 0, farthest, place)
                _moments(&image, through, -place[0], -place[1], found)
                own = shape_before(Shape(found[3], found[4], found[5]), through)
                if isnan(own.xx):
                    own = Shape(widest, 0.0, widest)
                low, high = sides(own)
                low = max(narrowest, min(low, widest)) if low > 0 else widest
                high = max(narrowest, min(high, widest)) if high > 0 else widest
                own = with_sides(own, low, high)
            width[k, 0], width[k, 1] = low, high
            put_shape(shape, k, own)
    return out, widths


cdef Py_ssize_t _count(const double[:, :, ::1] one, const double[:, :, ::1] other, const double[:, :, ::1] more) except -1:
    """How many matrices (2, 2) there are; ValueError unless all are as many, or one."""
    cdef Py_ssize_t n = max(one.shape[0], other.shape[0], more.shape[0])
    if 0 in (one.shape[0], other.shape[0], more.shape[0]):
        n = 0
    for count, rows, columns in (
        (one.shape[0], one.shape[1], one.shape[2]),
        (other.shape[0], other.shape[1], other.shape[2]),
        (more.shape[0], more.shape[1], more.shape[2]),
    ):
        if count not in (1, n) or (rows, columns) != (2, 2):
            raise ValueError(f"{count} matrices of {rows} x {columns}: {n} of 2 x 2 are needed, or one")
    return n


def squared_widths(const double[:, :, ::1] shape):
    """Eigenvalues (N, 2) of covariances (N, 2, 2), the smaller first."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    out = np.empty((n, 2))
    cdef double[:, ::1] width = out
    with nogil:
        for k in range(n):
            width[k, 0], width[k, 1] = sides(shape_of(shape, k))
    return out


def clip_widths(const double[:, :, ::1] shape, double least, double most, double exponent):
    """Covariances (N, 2, 2) with eigenvalues of at least and at most so much, to a power."""
    cdef Py_ssize_t n = _count(shape, shape, shape), k
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            put_shape(found, k, clipped_to(shape_of(shape, k), least, most, exponent))
    return out


def without_window(const double[:, :, ::1] seen, const double[:, :, ::1] window):
    """Covariances (N, 2, 2) of stars whose images through windows are seen; NaN where none is."""
    cdef Py_ssize_t n = _count(seen, window, window), k
    out = np.empty((n, 2, 2))
    cdef double[:, :, ::1] found = out
    with nogil:
        for k in range(n):
            put_shape(found, k, shape_before(shape_of(seen, k), shape_of(window, k)))
    return out


def relative_widths(const double[:, :, ::1] seen, const double[:, :, ::1] shape, const double[:, :, ::1] window):
    """The smaller and the larger squared width (N, 2) of images through windows, over the widths of stars of this shape.

    Both are 1 for a star of that shape and near 0 for a hot pixel. Along a streak the larger reaches 2 if the window is
    the shape. NaN counts as 0.
    """
    cdef Py_ssize_t n = _count(seen, shape, window), k
    cdef double a, b, c
    cdef Shape s, e, w
    out = np.zeros((n, 2))
    cdef double[:, ::1] width = out
    with nogil:
        for k in range(n):
            s, e, w = shape_of(seen, k), inverse(shape_of(shape, k)), inverse(shape_of(window, k))
            e = inverse(Shape(e.xx + w.xx, e.xy + w.xy, e.yy + w.yy))
            # by the Cholesky factor of the expected one, a 0, b c
            a = sqrt(e.xx)
            b = e.xy / a
            c = sqrt(e.yy - b * b)
            s.xx, s.xy = s.xx / (a * a), (s.xy - b * s.xx / a) / (a * c)
            s.yy = (s.yy - 2 * b * c * s.xy - b * b * s.xx) / (c * c)
            if isfinite(s.xx + s.xy + s.yy):
                width[k, 0], width[k, 1] = sides(s)
    return out
