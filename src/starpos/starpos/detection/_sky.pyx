# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The sky: a median, clipped means of a sample of the 8- or 16-bit pixels in the cells of a mesh, and the mesh at pixels."""

from libc.limits cimport UINT_MAX
from libc.math cimport NAN, isnan, sqrt

import numpy as np

from starpos._numeric.algebra cimport middle
from starpos._numeric.limits cimport within
from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport wide_void

ctypedef fused pixel_t:
    unsigned char
    unsigned short

cdef enum:
    # Numbers of which a count fits into 16 bits.
    BLOCK = 32768


def median(const double[::1] values):
    """The median of values (n,), as np.median has it; NaN of none, or if one is NaN."""
    cdef int n = values.shape[0], k
    cdef double found = NAN
    room = room_for(n * sizeof(double))
    cdef double *copy = <double *>start_of(room)
    for k in range(n):
        copy[k] = values[k]
        if isnan(copy[k]):
            break
    else:
        if n:
            found = middle(copy, n)
    return found


cdef struct Clip:
    # Sigma over the median of absolute differences, and over the distance of the 75 and 90 % quantiles; what lies within so
    # many sigma is the sky, and has this share of a Gaussian's rms.
    double per_mad
    double per_tail
    double sigmas
    double share


cdef inline int _at_most(const unsigned short *v, int n, unsigned short limit) noexcept nogil:
    """How many of n numbers are at most `limit`."""
    cdef int count = 0, first = 0, k
    # of 16 bits too, so that wide registers hold as many as of the numbers
    cdef unsigned short some
    while first < n:
        some = 0
        for k in range(first, min(first + BLOCK, n)):
            some += v[k] <= limit
        count += some
        first += BLOCK
    return count


cdef wide_void _ranked(const unsigned short *v, int n, int k, int *out) noexcept nogil:
    """Set `out` to the number at place k of n if they were sorted: halving the range takes few looks at whole numbers."""
    cdef unsigned short least = 65535, most = 0
    cdef int low, high, i, middle
    for i in range(n):
        least = v[i] if v[i] < least else least
        most = v[i] if v[i] > most else most
    low, high = least, most
    while low < high:
        middle = (low + high) // 2
        if _at_most(v, n, <unsigned short>middle) > k:
            high = middle
        else:
            low = middle + 1
    out[0] = low


cdef wide_void _sums(const unsigned short *v, int n, int middle, int limit, long long *out) noexcept nogil:
    """Sum up the n numbers within a limit of the middle: how many, their differences from it, and the squares of these."""
    # the sum of so many squares has 32 bits
    cdef int some = max(<int>(UINT_MAX // (<unsigned int>limit * <unsigned int>limit + 1)), 1) if limit < 65536 else 1
    cdef int first = 0, k, off, kept, count, total
    cdef unsigned int squares
    out[0] = out[1] = out[2] = 0
    while first < n:
        count, total, squares = 0, 0, 0
        for k in range(first, min(first + min(some, n), n)):
            off = v[k] - middle
            kept = <unsigned int>(off + limit) <= 2 * <unsigned int>limit
            off *= kept
            count += kept
            total += off
            squares += <unsigned int>off * <unsigned int>off
        out[0] += count
        out[1] += total
        out[2] += squares
        first += min(some, n)


cdef wide_void _highest(const unsigned short *v, int n, int *highest) noexcept nogil:
    """Set `highest` to the highest of n numbers, and how many are as high."""
    cdef unsigned short most = 0
    cdef int k, count = 0
    for k in range(n):
        most = v[k] if v[k] > most else most
    for k in range(n):
        count += v[k] == most
    highest[0], highest[1] = most, count


cdef double _quantile(const unsigned short *v, int n, double share) noexcept nogil:
    """A quantile of values (n,), linear between them."""
    cdef double place = share * (n - 1)
    cdef int k = <int>place
    cdef int low, high
    _ranked(v, n, k, &low)
    _ranked(v, n, min(k + 1, n - 1), &high)
    return low + (place - k) * (high - low)


cdef wide_void _clipped(
    const unsigned short *v, int n, const Clip *clip, unsigned short *away, double *level, double *noise
) noexcept nogil:
    """Mean and rms of values (n,) without stars and defects; away (n,): to work in.

    If more than half of them are equal (a sky cut off at 0), sigma comes from the quantiles above.
    """
    cdef int middle, scatter, k
    cdef long long[3] sums
    cdef double spread, mean
    _ranked(v, n, n // 2, &middle)
    for k in range(n):
        away[k] = <unsigned short>(v[k] - middle if v[k] > middle else middle - v[k])
    _ranked(away, n, n // 2, &scatter)
    spread = clip.per_mad * scatter
    if spread == 0:
        spread = clip.per_tail * (_quantile(v, n, 0.9) - _quantile(v, n, 0.75))
    _sums(v, n, middle, <int>max(clip.sigmas * spread, 1.0), sums)
    mean = sums[1] / <double>sums[0]
    level[0] = middle + mean
    noise[0] = sqrt(max(sums[2] / <double>sums[0] - mean * mean, 0.0) * sums[0] / max(sums[0] - 1, 1)) / clip.share


def sample_sky(
    const pixel_t[:, ::1] plane, const int[:, ::1] rows, const int[:, ::1] columns, double per_mad, double per_tail,
    double sigmas, double share,
):
    """The sky's level and noise in cells of a plane (h, w), for each phase of its 2 x 2 pattern, from a sample.

    rows     (cells down, rows of each), and
    columns  (cells across, columns of each): pairs of neighbours, the first even
    per_mad  sigma of a Gaussian over the median of the absolute differences, and
    per_tail  over the distance of its 75 and 90 % quantiles
    sigmas   within which a pixel is of the sky
    share    of a Gaussian's rms that these pixels have

    Returns level and noise, and the sample's highest value and how many pixels have it, (4, cells down, cells across).
    """
    cdef int down = rows.shape[0], across = columns.shape[0], tall = rows.shape[1], wide = columns.shape[1]
    cdef int n = tall // 2 * (wide // 2), i, j, phase, y, x
    cdef int[2] top
    cdef const pixel_t *row
    cdef Clip clip = Clip(per_mad, per_tail, sigmas, share)
    if not n or tall % 2 or wide % 2:
        raise ValueError("a cell's rows and columns must be pairs")
    if not (
        within[int](&rows[0, 0], down * tall, 0, <int>plane.shape[0] - 1)
        and within[int](&columns[0, 0], across * wide, 0, <int>plane.shape[1] - 1)
    ):
        raise ValueError(f"a cell lies beyond the {plane.shape[1]} x {plane.shape[0]} px of the frame")
    found, tops = np.empty((2, 4, down, across)), np.empty((2, 4, down, across), np.int32)
    cdef double[:, :, :, ::1] sky = found
    cdef int[:, :, :, ::1] highest = tops
    room = room_for(5 * n * sizeof(unsigned short))
    cdef unsigned short *value = <unsigned short *>start_of(room)
    cdef unsigned short *own
    with nogil:
        for i in range(down):
            for j in range(across):
                for y in range(tall):
                    row, own = &plane[rows[i, y], 0], value + y % 2 * 2 * n + y // 2 * (wide // 2)
                    for x in range(wide // 2):
                        own[x], own[n + x] = row[columns[j, 2 * x]], row[columns[j, 2 * x + 1]]
                for phase in range(4):
                    own = value + phase * n
                    _clipped(own, n, &clip, value + 4 * n, &sky[0, phase, i, j], &sky[1, phase, i, j])
                    _highest(own, n, top)
                    highest[0, phase, i, j], highest[1, phase, i, j] = top[0], top[1]
    return found[0], found[1], tops[0], tops[1]


cdef inline double _interpolated(const double[:, :, ::1] mesh, Py_ssize_t p, double row, double column) noexcept nogil:
    """The value of mesh p at a place, bilinear; beyond the edges as on them."""
    # what is not a number is 0
    cdef double y = min(row if row > 0 else 0.0, mesh.shape[1] - 1.0), x = min(column if column > 0 else 0.0, mesh.shape[2] - 1.0)
    cdef Py_ssize_t i = min(<Py_ssize_t>y, mesh.shape[1] - 2), j = min(<Py_ssize_t>x, mesh.shape[2] - 2)
    y, x = y - i, x - j
    return (
        (1 - y) * ((1 - x) * mesh[p, i, j] + x * mesh[p, i, j + 1])
        + y * ((1 - x) * mesh[p, i + 1, j] + x * mesh[p, i + 1, j + 1])
    )


def sky_at(
    const double[:, :, ::1] level, const double[:, :, ::1] noise, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y,
    int width, int height, float correlation,
):
    """Level and noise (N, P) float32 at the pixels x, y (N,) of a frame that meshes (P, rows + 2, columns + 2) cover.

    correlation  factor of the noise
    """
    cdef Py_ssize_t n = x.shape[0], k, p
    cdef double row, column
    if y.shape[0] != n or level.shape[1] < 3 or level.shape[2] < 3 or width < 1 or height < 1:
        raise ValueError(f"{n} columns, {y.shape[0]} rows, {width} x {height} px: as many are needed, on cells that cover them")
    if not (level.shape[0] == noise.shape[0] and level.shape[1] == noise.shape[1] and level.shape[2] == noise.shape[2]):
        raise ValueError("as many cells of noise as of level are needed")
    out = np.empty((2, n, level.shape[0]), np.float32)
    cdef float[:, :, ::1] sky = out
    with nogil:
        for k in range(n):
            row = (y[k] + 0.5) * (level.shape[1] - 2) / height + 0.5
            column = (x[k] + 0.5) * (level.shape[2] - 2) / width + 0.5
            for p in range(level.shape[0]):
                sky[0, k, p] = <float>_interpolated(level, p, row, column)
                sky[1, k, p] = <float>_interpolated(noise, p, row, column) * correlation
    return out[0], out[1]
