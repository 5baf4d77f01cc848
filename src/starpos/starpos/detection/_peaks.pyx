# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Peaks of a smoothed frame, in one pass over its 8- or 16-bit pixels: a few rows at a time, which stay in the cache."""

from libc.math cimport INFINITY, fabs
from libc.stdlib cimport free, realloc
from libc.string cimport memset

import numpy as np

from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport fused_void, wide_void

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short

cdef enum:
    # Pairs of rows that are added at once, and pixels of a row that are compared, and smoothed along it, at once.
    TOGETHER = 3
    BLOCK = 128


# Of the single precision in which rows are smoothed, with a margin.
cdef float ROUNDING = 1e-5


cdef struct Group:
    # Pixels side by side that are all peaks, as in a saturated disc, are one group; `into`: the group that this one joined.
    int into
    double x
    double y
    double value
    double count


cdef struct Groups:
    Group *each
    int count
    int room
    # Of each pixel of this row and of the one above, its group, or -1; the last row that has any.
    int *here
    int *above
    Py_ssize_t last


cdef struct Smoother:
    # Weights from the middle outwards, with 0 up to whole triples.
    float *weight
    int reach
    int padded
    # A row with its margins.
    Py_ssize_t stride
    # Rows of the plane around the last one that was smoothed, row % slots at its place; `end` is the row after these.
    float *plain
    int slots
    Py_ssize_t last
    Py_ssize_t end
    # Of each row of the plane that has been taken the highest pixel; NULL if nobody asked.
    int *highest
    # A smoothed pixel is at most over / 2 times the highest sum of two neighbours under the kernel.
    float over


cdef struct Window:
    # Rows, row % kept at its place: smoothed across, with margins, and of these the blocks that are smoothed along too.
    int kept
    Py_ssize_t width
    Py_ssize_t blocks
    float *across
    float *smooth
    unsigned char *known
    # Of a strip the limit of each pixel, and of each block what a sum of two neighbours must exceed.
    float *limit
    float *least


cdef bytearray _allocate(Smoother *s, Py_ssize_t width, const float[::1] weight):
    """The memory of smoothing rows."""
    cdef int k
    cdef double share = 0.0
    s.reach = weight.shape[0] - 1
    if s.reach < 1:
        raise ValueError("a kernel of a single pixel smooths nothing")
    s.padded = max(3, (s.reach + 2) // 3 * 3)
    s.stride, s.slots, s.last, s.end = width + 2 * s.padded, 2 * s.reach + 1, 0, 0
    s.highest = NULL
    room = room_for((s.slots * width + s.padded + 1) * sizeof(float))
    s.plain = <float *>start_of(room)
    s.weight, s.over = s.plain + s.slots * width, 1.0
    for k in range(s.padded, -1, -1):
        s.weight[k] = weight[k] if k <= s.reach else 0.0
        # the kernel is a sum of pairs of neighbours, each with a share of the weight, and a rest in the middle
        share = 2 * s.weight[k] - share if k else share
        s.over = s.over if share >= 0 else INFINITY
    s.over = s.over * (1 + fabs(s.weight[0] - share)) * (1 + ROUNDING)
    return room


def smooth_rows(const pixel_t[:, ::1] plane, const float[::1] weight, const Py_ssize_t[::1] rows, int step):
    """Some rows (R,) of a plane (h, w), and of these every `step`-th pixel, smoothed along both axes.

    weight  (reach + 1,): from the middle outwards

    Beyond its edges the plane continues as in a mirror.
    """
    cdef Py_ssize_t width = plane.shape[1], k, x
    cdef Smoother s
    if step < 1 or not width or np.min(rows, initial=0) < 0 or np.max(rows, initial=-1) >= plane.shape[0]:
        raise ValueError(f"rows and steps of {step} px beyond the {width} x {plane.shape[0]} px of the frame")
    out = np.empty((rows.shape[0], (width + step - 1) // step), np.float32)
    cdef float[:, ::1] smooth = out
    of_smoother = _allocate(&s, width, weight)
    room = room_for((s.stride + width) * sizeof(float))
    cdef float *across = <float *>start_of(room)
    cdef float *whole = across + s.stride
    with nogil:
        for k in range(rows.shape[0]):
            _smooth_across(plane, &s, rows[k], across)
            _smooth_along(&s, across + s.padded, width, whole)
            for x in range(smooth.shape[1]):
                smooth[k, x] = whole[x * step]
    return out


def find_maxima(
    const pixel_t[:, ::1] plane, const float[::1] weight, int flat, const float[:, ::1] limit, int strip, int first,
    int last,
):
    """Peaks of a plane (h, w) smoothed as in `smooth_rows`: pixels above a limit, of which none within `flat` px is higher.

    limit        (strips, C): of each strip of so many rows, in cells that cover its width evenly, with one more beyond each
                 end; linear between them
    first, last  the rows in which peaks are looked for

    Peaks side by side are one. Returns x, y (N,) px, their means, the smoothed value (N,), and the highest pixel of each row.
    """
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1]
    cdef int row, done = max(first - flat, 0)
    cdef Groups g
    cdef Smoother s
    cdef Window w
    highest_ = np.zeros(height, np.int32)
    cdef int[::1] highest = highest_
    if limit.shape[1] < 3 or not 0 <= first <= last <= height or limit.shape[0] * strip < last:
        raise ValueError(f"limits of {limit.shape[0]} strips of {strip} rows, in {limit.shape[1]} cells, for rows {first} to {last}")
    w.kept, w.width, w.blocks = 2 * flat + 1, width, (width + BLOCK - 1) // BLOCK
    g.each, g.count, g.room, g.last = NULL, 0, 0, -3
    of_smoother = _allocate(&s, width, weight)
    s.highest = &highest[0]
    room = room_for((w.kept * (s.stride + width) + width + w.blocks) * sizeof(float) + 2 * (width + 2) * sizeof(int) + w.kept * w.blocks)
    w.across = <float *>start_of(room)
    w.smooth = w.across + w.kept * s.stride
    w.limit = w.smooth + w.kept * width
    w.least = w.limit + width
    cdef int *marks = <int *>(w.least + w.blocks)
    w.known = <unsigned char *>(marks + 2 * (width + 2))
    g.here, g.above = marks, marks + width + 2
    try:
        with nogil:
            memset(marks, 0xFF, 2 * (width + 2) * sizeof(int))
            for row in range(first, last):
                while done < min(row + flat + 1, <int>height):
                    _smooth_across(plane, &s, done, w.across + (done % w.kept) * s.stride)
                    memset(w.known + (done % w.kept) * w.blocks, 0, w.blocks)
                    done += 1
                if row == first or row % strip == 0:
                    _spread(&limit[row // strip, 0], limit.shape[1], &s, &w)
                _find_in_row(&s, &w, height, row, flat, &g)
        return *_columns(&g), highest_[first:last]
    finally:
        free(g.each)


cdef void _spread(const float *cell, Py_ssize_t cells, const Smoother *s, Window *w) noexcept nogil:
    """Spread limits in cells over the pixels of a row."""
    cdef Py_ssize_t x, left, block
    cdef double place, step = (cells - 2) / <double>w.width
    cdef float least
    for block in range(w.blocks):
        least = INFINITY
        for x in range(block * BLOCK, min((block + 1) * BLOCK, w.width)):
            place = (x + 0.5) * step + 0.5
            left = <int>place
            w.limit[x] = cell[left] + <float>(place - left) * (cell[left + 1] - cell[left])
            least = min(least, w.limit[x])
        w.least[block] = 2 * least / s.over


cdef inline Py_ssize_t _mirrored(Py_ssize_t k, Py_ssize_t n) noexcept nogil:
    """The row that stands for row k, which may lie beyond the edges."""
    while n > 1 and not 0 <= k < n:
        k = -k if k < 0 else 2 * (n - 1) - k
    return k if n > 1 else 0


cdef wide_void _load_row(const pixel_t *row, Py_ssize_t n, float *out, int *highest) noexcept nogil:
    """Take a row of n pixels, and its highest."""
    cdef pixel_t most = 0
    cdef Py_ssize_t k
    for k in range(n):
        most = row[k] if row[k] > most else most
    for k in range(n):
        out[k] = row[k]
    highest[0] = most


cdef fused_void _weighted(
    float *out, int first, const float *weight, Py_ssize_t n, const float *middle, const float **p
) noexcept nogil:
    """Add three pairs of rows, each times its weight from the first on, to `out`; with the first pairs also the middle row."""
    cdef float s = weight[0], t = weight[first], u = weight[first + 1], v = weight[first + 2]
    cdef const float *a = p[0]
    cdef const float *b = p[1]
    cdef const float *c = p[2]
    cdef const float *d = p[3]
    cdef const float *e = p[4]
    cdef const float *f = p[5]
    cdef Py_ssize_t k
    if first == 1:
        for k in range(n):
            out[k] = s * middle[k] + (t * (a[k] + b[k]) + u * (c[k] + d[k]) + v * (e[k] + f[k]))
    else:
        for k in range(n):
            out[k] += t * (a[k] + b[k]) + u * (c[k] + d[k]) + v * (e[k] + f[k])


cdef wide_void _any_pair(const float *row, float limit, Py_ssize_t n, bint *found) noexcept nogil:
    """Whether the sum of one of n pixels and the next is above the limit."""
    cdef int any_ = 0
    cdef Py_ssize_t k
    for k in range(n):
        any_ |= row[k] + row[k + 1] > limit
    found[0] = any_


cdef wide_void _any_above(const float *row, const float *limit, Py_ssize_t n, bint *found) noexcept nogil:
    """Whether one of n pixels is above its limit."""
    cdef int any_ = 0
    cdef Py_ssize_t k
    for k in range(n):
        any_ |= row[k] > limit[k]
    found[0] = any_


cdef void _smooth_across(const pixel_t[:, ::1] plane, Smoother *s, Py_ssize_t row, float *out) noexcept nogil:
    """Set `out` (stride,) to a row smoothed with those above and below it, and its margins."""
    cdef const float *pair[2 * TOGETHER]
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1]
    cdef float *smooth = out + s.padded
    cdef int k, j, near, highest
    # no row of use is there before a row above the last one, or far below it
    if row < s.last or row - s.reach > s.end:
        s.end = max(row - s.reach, 0)
    s.last = row
    while s.end < min(row + s.reach + 1, height):
        _load_row(&plane[s.end, 0], width, s.plain + (s.end % s.slots) * width, &highest)
        if s.highest != NULL:
            s.highest[s.end] = highest
        s.end += 1
    for k in range(1, s.padded + 1, 3):
        for j in range(TOGETHER):
            # a weight of 0 takes any row
            near = k + j if k + j <= s.reach else 0
            pair[2 * j] = s.plain + (_mirrored(row - near, height) % s.slots) * width
            pair[2 * j + 1] = s.plain + (_mirrored(row + near, height) % s.slots) * width
        _weighted(smooth, k, s.weight, width, s.plain + (row % s.slots) * width, pair)
    for k in range(1, s.padded + 1):
        smooth[-k], smooth[width - 1 + k] = smooth[_mirrored(-k, width)], smooth[_mirrored(width - 1 + k, width)]


cdef void _smooth_along(const Smoother *s, const float *row, Py_ssize_t n, float *out) noexcept nogil:
    """Smooth n pixels of a row, which has margins, along it."""
    cdef const float *pair[2 * TOGETHER]
    cdef int k, j
    for k in range(1, s.padded + 1, 3):
        for j in range(TOGETHER):
            pair[2 * j], pair[2 * j + 1] = row - (k + j), row + (k + j)
        _weighted(out, k, s.weight, n, row, pair)


cdef void _finish(const Smoother *s, Window *w, Py_ssize_t row, Py_ssize_t block) noexcept nogil:
    """Smooth a block of a row along the row too, unless it has been."""
    cdef Py_ssize_t place = row % w.kept, first = block * BLOCK
    if not w.known[place * w.blocks + block]:
        w.known[place * w.blocks + block] = True
        _smooth_along(
            s, w.across + place * s.stride + s.padded + first, min(BLOCK, w.width - first), w.smooth + place * w.width + first
        )


cdef int _find_in_row(const Smoother *s, Window *w, Py_ssize_t height, Py_ssize_t row, int flat, Groups *g) except -1 nogil:
    """Add the peaks of a row to their groups. Most blocks are too dark for a peak: they are not smoothed along the row."""
    cdef const float *own = w.smooth + (row % w.kept) * w.width
    # the first pixel that the row's first one is made of
    cdef const float *across = w.across + (row % w.kept) * s.stride + s.padded - s.reach
    cdef Py_ssize_t top = max(row - flat, 0), bottom = min(row + flat + 1, height), block, first, count, x, y, k
    cdef bint found
    g.here, g.above = g.above, g.here
    if g.last >= row - 2:
        memset(g.here, 0xFF, (w.width + 2) * sizeof(int))
    for block in range(w.blocks):
        first = block * BLOCK
        count = min(BLOCK, w.width - first)
        _any_pair(across + first, w.least[block], count + 2 * s.reach - 1, &found)
        if not found:
            continue
        _finish(s, w, row, block)
        _any_above(own + first, w.limit + first, count, &found)
        if not found:
            continue
        for y in range(top, bottom):
            for k in range(max(first - flat, 0) // BLOCK, (min(first + count + flat, w.width) - 1) // BLOCK + 1):
                _finish(s, w, y, k)
        for x in range(first, first + count):
            if own[x] > w.limit[x] and _is_highest(w, top, bottom, max(x - flat, 0), min(x + flat + 1, w.width), own[x]):
                _join(g, x, row, own[x])
    return 0


cdef bint _is_highest(const Window *w, Py_ssize_t top, Py_ssize_t bottom, Py_ssize_t left, Py_ssize_t right, float value) noexcept nogil:
    """Whether no pixel in a box is above the value."""
    cdef const float *other
    cdef Py_ssize_t y, x
    for y in range(top, bottom):
        other = w.smooth + (y % w.kept) * w.width
        for x in range(left, right):
            if other[x] > value:
                return False
    return True


cdef int _join(Groups *g, Py_ssize_t x, Py_ssize_t y, float value) except -1 nogil:
    """Add a peak to the group of its neighbours, or to a new one."""
    cdef int k, other, group = -1
    cdef Group *more
    # one to the left, three above; the places are shifted by one
    for k in range(4):
        other = g.here[x] if k == 3 else g.above[x + k]
        if other < 0:
            continue
        while g.each[other].into != other:
            other = g.each[other].into
        if group < 0:
            group = other
        elif other != group:
            g.each[other].into = group
            g.each[group].x += g.each[other].x
            g.each[group].y += g.each[other].y
            g.each[group].value += g.each[other].value
            g.each[group].count += g.each[other].count
    if group < 0:
        if g.count == g.room:
            g.room = max(1024, 2 * g.room)
            more = <Group *>realloc(g.each, g.room * sizeof(Group))
            if more == NULL:
                with gil:
                    raise MemoryError
            g.each = more
        group = g.count
        g.count += 1
        g.each[group].into = group
        g.each[group].x = g.each[group].y = g.each[group].value = g.each[group].count = 0.0
    g.each[group].x += x
    g.each[group].y += y
    g.each[group].value += value
    g.each[group].count += 1
    g.here[x + 1], g.last = group, y
    return 0


cdef _columns(const Groups *g):
    """Mean x, y and value (N,) of the groups."""
    cdef int k, count = 0
    out = np.empty((3, g.count))
    cdef double[:, ::1] column = out
    for k in range(g.count):
        if g.each[k].into == k:
            column[0, count] = g.each[k].x / g.each[k].count
            column[1, count] = g.each[k].y / g.each[k].count
            column[2, count] = g.each[k].value / g.each[k].count
            count += 1
    return out[0, :count], out[1, :count], out[2, :count]
