# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What a sparse look at the 8- or 16-bit pixels of a frame shows: flat blocks, and bright squares."""

import numpy as np

from starpos._numeric.limits cimport within

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short


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


def bright_squares(const pixel_t[:, ::1] plane, const int[::1] highest, int step, int limit):
    """Pixels of every `step`-th row and column of a plane that are above a limit, with one more to the right and below.

    highest (h,): of each row the highest pixel

    Returns their rows and columns (N,), px, and the lowest of the 2 x 2 pixels of which each is the first, (N,).
    """
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1], count = 0, i, j, x
    cdef Py_ssize_t down, across
    cdef const pixel_t *line
    if step < 1 or not (height and width) or highest.shape[0] != height:
        raise ValueError(f"steps of {step} px, {highest.shape[0]} rows in a frame of {width} x {height} px: there is nothing to see")
    down, across = (height + step - 2) // step, (width + step - 2) // step
    with nogil:
        for i in range(down):
            line = &plane[i * step, 0]
            # most rows hold nothing bright
            for j in range(across if highest[i * step] > limit else 0):
                count += line[j * step] > limit
    places_, lowest_ = np.empty((2, count), np.intp), np.empty(count)
    cdef Py_ssize_t[:, ::1] place = places_
    cdef double[::1] lowest = lowest_
    count = 0
    with nogil:
        for i in range(down):
            line = &plane[i * step, 0]
            for j in range(across if highest[i * step] > limit else 0):
                x = j * step
                if line[x] > limit:
                    place[0, count], place[1, count] = i * step, x
                    lowest[count] = min(min(line[x], line[x + 1]), min(line[width + x], line[width + x + 1]))
                    count += 1
    return places_[0], places_[1], lowest_


def third_highest(const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach):
    """The highest third value of the squares around pixels x, y (N,), N > 0, and how many pixels of one square share it.

    A square reaches so far (px); beyond the frame it holds 0.
    """
    cdef Py_ssize_t k, row, column, height = plane.shape[0], width = plane.shape[1]
    cdef int value, highest = -1, count, most = 0
    cdef int[3] top
    cdef const pixel_t *line
    if not x.shape[0] or y.shape[0] != x.shape[0] or reach < 1:
        raise ValueError(f"{x.shape[0]} columns and {y.shape[0]} rows of squares of {reach} px: as many are needed, at least one")
    with nogil:
        for k in range(x.shape[0]):
            top[0] = top[1] = top[2] = count = 0
            for row in range(max(y[k] - reach, 0), min(y[k] + reach + 1, height)):
                line = &plane[row, 0]
                for column in range(max(x[k] - reach, 0), min(x[k] + reach + 1, width)):
                    value = line[column]
                    if value > top[2]:
                        top[2] = value
                        if top[2] > top[1]:
                            top[1], top[2] = top[2], top[1]
                        if top[1] > top[0]:
                            top[0], top[1] = top[1], top[0]
            if top[2] < highest:
                continue
            for row in range(max(y[k] - reach, 0), min(y[k] + reach + 1, height)):
                for column in range(max(x[k] - reach, 0), min(x[k] + reach + 1, width)):
                    count += plane[row, column] == top[2]
            most = count if top[2] > highest else max(most, count)
            highest = top[2]
    return highest, most


def thirds(const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y):
    """The third highest (N,) of the nine pixels around x, y (N,); beyond the frame are those of its edge."""
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j
    cdef int value
    cdef int[3] top
    cdef const pixel_t *line
    if y.shape[0] != n or not (height and width):
        raise ValueError(f"{n} columns and {y.shape[0]} rows of pixels on a frame of {width} x {height} px: as many are needed")
    out = np.empty(n)
    cdef double[::1] third = out
    with nogil:
        for k in range(n):
            top[0] = top[1] = top[2] = -1
            for i in range(-1, 2):
                line = &plane[max(0, min(y[k] + i, height - 1)), 0]
                for j in range(-1, 2):
                    value = line[max(0, min(x[k] + j, width - 1))]
                    top[2] = max(top[2], min(value, top[1]))
                    top[1] = max(top[1], min(value, top[0]))
                    top[0] = max(top[0], value)
            third[k] = top[2]
    return out
