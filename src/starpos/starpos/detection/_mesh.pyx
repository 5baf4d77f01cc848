# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Meshes of the sky: evened out, and how far a smoothed frame is above them."""

from libc.math cimport fabs, nextafter, sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.limits cimport within

cdef enum:
    # Cells that a mesh is continued by before it is evened out.
    AROUND = 2


cdef inline double _second(double a, double b, double c) noexcept nogil:
    """The median of three."""
    return max(min(a, b), min(max(a, b), c))


cdef inline double _fifth(const double *m, Py_ssize_t stride) noexcept nogil:
    """The median of the 3 x 3 values around m: of the lowest of each row the highest, and so on, the median."""
    cdef double lows = -1e300, highs = 1e300
    cdef double[3] mid
    cdef const double *row
    cdef int k
    for k in range(3):
        row = m + (k - 1) * stride - 1
        lows = max(lows, min(min(row[0], row[1]), row[2]))
        highs = min(highs, max(max(row[0], row[1]), row[2]))
        mid[k] = _second(row[0], row[1], row[2])
    return _second(lows, _second(mid[0], mid[1], mid[2]), highs)


cdef void _go_on(double *first, Py_ssize_t n, Py_ssize_t step, int beyond, bint level) noexcept nogil:
    """Continue n values, `step` apart, by so many on both sides: so that a gradient goes on, or ends in a level."""
    cdef double *last = first + (n - 1) * step
    cdef int k
    for k in range(1, beyond + 1):
        if n == 1 or level:
            first[-k * step], last[k * step] = first[0], last[0]
        elif k < n:
            first[-k * step], last[k * step] = 2 * first[0] - first[k * step], 2 * last[0] - last[-k * step]
        else:
            first[-k * step] = 2 * first[(1 - k) * step] - first[(2 - k) * step]
            last[k * step] = 2 * last[(k - 1) * step] - last[(k - 2) * step]


cdef void _around(double *mesh, Py_ssize_t rows, Py_ssize_t columns, Py_ssize_t stride, int beyond, bint level) noexcept nogil:
    """Continue a mesh beyond its edges."""
    cdef Py_ssize_t i, j
    for j in range(columns):
        _go_on(mesh + j, rows, stride, beyond, level)
    for i in range(-beyond, rows + beyond):
        _go_on(mesh + i * stride, columns, 1, beyond, level)


def evened(const double[:, :, ::1] mesh, const double[::1] steep, bint level):
    """Meshes (P, rows, columns) evened out: (P, rows + 2, columns + 2), with one more cell beyond each edge.

    A median of 3 x 3 cells replaces those that something bright covers, then a mean evens out their noise.

    steep  (P,): the mean is left out where it differs by more from the median, across an edge (of a roof)
    level  whether a gradient ends at the edge; else it goes on
    """
    cdef Py_ssize_t rows = mesh.shape[1], columns = mesh.shape[2], stride = columns + 2 * AROUND, p, i, j
    cdef double mean
    if steep.shape[0] != mesh.shape[0] or not (rows and columns):
        raise ValueError(f"{steep.shape[0]} limits for {mesh.shape[0]} meshes of {rows} x {columns} cells: one each is needed")
    out = np.empty((mesh.shape[0], rows + 2, columns + 2))
    cdef double[:, :, ::1] even = out
    cdef double *room = <double *>malloc(2 * (rows + 2 * AROUND) * stride * sizeof(double))
    if room == NULL:
        raise MemoryError
    # the first cells of the mesh and of its medians
    cdef double *own = room + AROUND * stride + AROUND
    cdef double *typical = own + (rows + 2 * AROUND) * stride
    cdef double *at
    with nogil:
        for p in range(mesh.shape[0]):
            for i in range(rows):
                for j in range(columns):
                    own[i * stride + j] = mesh[p, i, j]
            _around(own, rows, columns, stride, AROUND, False)
            for i in range(-1, rows + 1):
                for j in range(-1, columns + 1):
                    typical[i * stride + j] = _fifth(own + i * stride + j, stride)
            for i in range(rows):
                for j in range(columns):
                    at = typical + i * stride + j
                    mean = (_down(at - 1, stride) + _down(at, stride) + _down(at + 1, stride)) / 3
                    even[p, i + 1, j + 1] = mean if fabs(mean - at[0]) < steep[p] else at[0]
            _around(&even[p, 1, 1], rows, columns, columns + 2, 1, level)
    free(room)
    return out


cdef inline double _down(const double *m, Py_ssize_t stride) noexcept nogil:
    """The mean of three cells of a column."""
    return (m[-stride] + m[0] + m[stride]) / 3


cdef bint _inside(const double[::1] place, Py_ssize_t cells) noexcept nogil:
    """Whether all places are between the first and the last of so many cells."""
    return within[double](&place[0], place.shape[0], 0, nextafter(cells - 1, 0))


def above(
    const float[:, ::1] value, const double[:, :, ::1] level, const double[:, :, ::1] noise, const double[::1] row,
    const double[::1] column,
):
    """How far values (R, C) are above the mean level, in units of the rms noise, of P meshes (P, rows, columns), float32.

    row, column  (R,), (C,): where the values are in the meshes, as in `background.between`, within the edges
    """
    cdef Py_ssize_t tall = value.shape[0], wide = value.shape[1], i, j, p, y, x
    cdef double sky, noise2, one, share, down
    if row.shape[0] != tall or column.shape[0] != wide:
        raise ValueError(f"{row.shape[0]} rows and {column.shape[0]} columns of {tall} x {wide} values: as many are needed")
    if not (_inside(row, level.shape[1]) and _inside(column, level.shape[2])):
        raise ValueError(f"a row or a column beyond a mesh of {level.shape[1]} x {level.shape[2]} cells")
    if level.shape[0] != noise.shape[0] or level.shape[1] != noise.shape[1] or level.shape[2] != noise.shape[2]:
        raise ValueError("as many cells of noise as of level are needed")
    cdef Py_ssize_t cells = level.shape[2], phases = level.shape[0]
    out = np.empty((tall, wide), np.float32)
    cdef float[:, ::1] score = out
    # level and noise of each phase along a row
    cdef double *along = <double *>malloc(2 * phases * cells * sizeof(double))
    if along == NULL:
        raise MemoryError
    cdef double *own
    with nogil:
        for i in range(tall):
            y, down = <Py_ssize_t>row[i], row[i] - <Py_ssize_t>row[i]
            for p in range(phases):
                own = along + 2 * p * cells
                for x in range(cells):
                    own[x] = (1 - down) * level[p, y, x] + down * level[p, y + 1, x]
                    own[cells + x] = (1 - down) * noise[p, y, x] + down * noise[p, y + 1, x]
            for j in range(wide):
                x = <Py_ssize_t>column[j]
                share, sky, noise2 = column[j] - x, 0.0, 0.0
                for p in range(phases):
                    own = along + 2 * p * cells + x
                    sky += (1 - share) * own[0] + share * own[1]
                    one = (1 - share) * own[cells] + share * own[cells + 1]
                    noise2 += one * one
                one = one if phases == 1 else sqrt(noise2 / phases)
                score[i, j] = (value[i, j] - <float>(sky / phases)) / <float>one
    free(along)
    return out
