# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Peaks of a smoothed frame, in one pass over its 8- or 16-bit pixels: a few rows at a time, which stay in the cache."""

from libc.stdlib cimport free, malloc, realloc
from libc.string cimport memset

import numpy as np

cimport starpos.core.wide

cdef extern from *:
    """
    /* Set `out` to a row times its weight and three pairs of others, each times its weight; or add three pairs. */
    #define STARPOS_SMOOTH(kind, pixel, sum) \\
        STARPOS_WIDE static void starpos_begin_##kind( \\
                float *restrict out, const float *w, Py_ssize_t n, const pixel *m, const pixel *const *p) { \\
            const float s = w[0], t = w[1], u = w[2], v = w[3]; \\
            const pixel *a = p[0], *b = p[1], *c = p[2], *d = p[3], *e = p[4], *f = p[5]; \\
            for (Py_ssize_t i = 0; i < n; i++) \\
                out[i] = s * m[i] + (t * ((sum)a[i] + b[i]) + u * ((sum)c[i] + d[i]) + v * ((sum)e[i] + f[i])); \\
        } \\
        STARPOS_WIDE static void starpos_add_##kind( \\
                float *restrict out, const float *w, Py_ssize_t n, const pixel *const *p) { \\
            const float t = w[0], u = w[1], v = w[2]; \\
            const pixel *a = p[0], *b = p[1], *c = p[2], *d = p[3], *e = p[4], *f = p[5]; \\
            for (Py_ssize_t i = 0; i < n; i++) \\
                out[i] += t * ((sum)a[i] + b[i]) + u * ((sum)c[i] + d[i]) + v * ((sum)e[i] + f[i]); \\
        }
    STARPOS_SMOOTH(8, unsigned char, int)
    STARPOS_SMOOTH(16, unsigned short, int)
    STARPOS_SMOOTH(float, float, float)
    /* Whether a pixel of the row is above its limit. */
    STARPOS_WIDE static int starpos_any_above(const float *restrict row, const float *restrict limit, Py_ssize_t n) {
        int any = 0;
        for (Py_ssize_t i = 0; i < n; i++)
            any |= row[i] > limit[i];
        return any;
    }
    """
    void begin_8 "starpos_begin_8"(float *out, const float *w, Py_ssize_t n, const unsigned char *middle, const unsigned char **p) noexcept nogil
    void add_8 "starpos_add_8"(float *out, const float *w, Py_ssize_t n, const unsigned char **p) noexcept nogil
    void begin_16 "starpos_begin_16"(float *out, const float *w, Py_ssize_t n, const unsigned short *middle, const unsigned short **p) noexcept nogil
    void add_16 "starpos_add_16"(float *out, const float *w, Py_ssize_t n, const unsigned short **p) noexcept nogil
    void begin_float "starpos_begin_float"(float *out, const float *w, Py_ssize_t n, const float *middle, const float **p) noexcept nogil
    void add_float "starpos_add_float"(float *out, const float *w, Py_ssize_t n, const float **p) noexcept nogil
    bint any_above "starpos_any_above"(const float *row, const float *limit, Py_ssize_t n) noexcept nogil

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short

cdef enum:
    # Pairs of rows that are added at once, and pixels of a row that are compared at once.
    TOGETHER = 3
    BLOCK = 256


cdef struct Group:
    # Of pixels side by side that are all peaks, as in a saturated disc: one of them stands for those it is merged into.
    int into
    double x
    double y
    double value
    double count


cdef struct Groups:
    Group *each
    int count
    int room
    # Of each pixel of this row and of the one above, its group, or -1.
    int *here
    int *above


cdef struct Smoother:
    # Weights from the middle outwards, with 0 up to whole triples; a row with margins.
    float *weight
    int reach
    int padded
    float *margined


cdef int _begin(Smoother *s, Py_ssize_t width, const float[::1] weight) except -1:
    """Take memory for smoothing rows."""
    cdef int k
    s.reach = weight.shape[0] - 1
    s.padded = max(3, (s.reach + 2) // 3 * 3)
    s.margined = <float *>malloc((width + 3 * s.padded + 1) * sizeof(float))
    if s.margined == NULL:
        raise MemoryError
    s.weight = s.margined + width + 2 * s.padded
    for k in range(s.padded + 1):
        s.weight[k] = weight[k] if k <= s.reach else 0.0
    return 0


cdef void _smooth_row(const pixel_t[:, ::1] plane, const Smoother *s, Py_ssize_t row, float *out) noexcept nogil:
    """Set `out` (w,) to a row of the smoothed plane."""
    _across_rows(plane, s, row, s.margined + s.padded)
    _along_row(s, plane.shape[1], out)


def smoothed(const pixel_t[:, ::1] plane, const float[::1] weight, const Py_ssize_t[::1] rows, int step):
    """Some rows (R,) of a plane (h, w), and of these every so manieth pixel, smoothed along both axes.

    weight  (reach + 1,): from the middle outwards

    Beyond its edges the plane continues as in a mirror.
    """
    cdef Py_ssize_t width = plane.shape[1], k, x
    cdef Smoother s
    if step < 1 or not width or np.min(rows, initial=0) < 0 or np.max(rows, initial=-1) >= plane.shape[0]:
        raise ValueError(f"rows and steps of {step} px beyond the {width} x {plane.shape[0]} px of the frame")
    out = np.empty((rows.shape[0], (width + step - 1) // step), np.float32)
    cdef float[:, ::1] smooth = out
    cdef float *whole = <float *>malloc(width * sizeof(float))
    if whole == NULL:
        raise MemoryError
    try:
        _begin(&s, width, weight)
    except MemoryError:
        free(whole)
        raise
    with nogil:
        for k in range(rows.shape[0]):
            _smooth_row(plane, &s, rows[k], whole)
            for x in range(smooth.shape[1]):
                smooth[k, x] = whole[x * step]
    free(s.margined)
    free(whole)
    return out


def peaks(
    const pixel_t[:, ::1] plane, const float[::1] weight, int flat, const float[:, ::1] limit, int strip, int first,
    int last,
):
    """Peaks of a plane (h, w) smoothed as in `smoothed`: pixels above a limit, of which none within `flat` px is higher.

    limit        (strips, C): of each strip of so many rows, in cells that cover its width evenly, with one more beyond each
                 end; linear between them
    first, last  the rows in which peaks are looked for

    Peaks side by side are one. Returns x, y (N,) px, their means, and the smoothed value (N,).
    """
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1]
    cdef int kept = 2 * flat + 1, row, done = max(first - flat, 0)
    cdef Groups g
    cdef Smoother s
    g.each, g.count, g.room = NULL, 0, 0
    _begin(&s, width, weight)
    cdef float *smooth = <float *>malloc(kept * width * sizeof(float))
    cdef int *marks = <int *>malloc(2 * (width + 2) * sizeof(int))
    cdef float *wanted = <float *>malloc(width * sizeof(float))
    try:
        if smooth == NULL or marks == NULL or wanted == NULL:
            raise MemoryError
        if limit.shape[1] < 3 or not 0 <= first <= last <= height or limit.shape[0] * strip < last:
            raise ValueError(f"limits of {limit.shape[0]} strips of {strip} rows, in {limit.shape[1]} cells, for rows {first} to {last}")
        g.here, g.above = marks, marks + width + 2
        with nogil:
            memset(marks, 0xFF, 2 * (width + 2) * sizeof(int))
            for row in range(first, last):
                while done < min(row + flat + 1, <int>height):
                    _smooth_row(plane, &s, done, smooth + (done % kept) * width)
                    done += 1
                if row == first or row % strip == 0:
                    _spread(&limit[row // strip, 0], limit.shape[1], width, wanted)
                _take_peaks(smooth, kept, width, height, row, flat, wanted, &g)
        return _columns(&g)
    finally:
        free(smooth)
        free(marks)
        free(wanted)
        free(s.margined)
        free(g.each)


cdef void _spread(const float *cell, Py_ssize_t cells, Py_ssize_t width, float *out) noexcept nogil:
    """Spread values in cells over a row of pixels."""
    cdef Py_ssize_t x, left
    cdef double place
    for x in range(width):
        place = (x + 0.5) * (cells - 2) / width + 0.5
        left = <Py_ssize_t>place
        out[x] = cell[left] + <float>(place - left) * (cell[left + 1] - cell[left])


cdef inline Py_ssize_t _mirrored(Py_ssize_t k, Py_ssize_t n) noexcept nogil:
    """The row that stands for row k, which may lie beyond the edges."""
    while n > 1 and not 0 <= k < n:
        k = -k if k < 0 else 2 * (n - 1) - k
    return k if n > 1 else 0


cdef void _across_rows(const pixel_t[:, ::1] plane, const Smoother *s, Py_ssize_t row, float *out) noexcept nogil:
    """Smooth a row with those above and below it."""
    cdef const pixel_t *pair[2 * TOGETHER]
    cdef Py_ssize_t height = plane.shape[0], width = plane.shape[1]
    cdef int k, j, near
    for k in range(1, s.padded + 1, 3):
        for j in range(TOGETHER):
            # a weight of 0 takes any row
            near = k + j if k + j <= s.reach else 0
            pair[2 * j] = &plane[_mirrored(row - near, height), 0]
            pair[2 * j + 1] = &plane[_mirrored(row + near, height), 0]
        if pixel_t is unsigned_char:
            if k == 1:
                begin_8(out, s.weight, width, &plane[row, 0], pair)
            else:
                add_8(out, &s.weight[k], width, pair)
        else:
            if k == 1:
                begin_16(out, s.weight, width, &plane[row, 0], pair)
            else:
                add_16(out, &s.weight[k], width, pair)


cdef void _along_row(const Smoother *s, Py_ssize_t width, float *out) noexcept nogil:
    """Smooth along itself the row in s.margined."""
    cdef const float *pair[2 * TOGETHER]
    cdef float *row = s.margined + s.padded
    cdef int k, j
    for k in range(1, s.padded + 1):
        row[-k], row[width - 1 + k] = row[_mirrored(-k, width)], row[_mirrored(width - 1 + k, width)]
    for k in range(1, s.padded + 1, 3):
        for j in range(TOGETHER):
            pair[2 * j], pair[2 * j + 1] = row - (k + j), row + (k + j)
        if k == 1:
            begin_float(out, s.weight, width, row, pair)
        else:
            add_float(out, &s.weight[k], width, pair)


cdef int _take_peaks(
    const float *smooth, int kept, Py_ssize_t width, Py_ssize_t height, Py_ssize_t row, int flat, const float *limit,
    Groups *g,
) except -1 nogil:
    """Add the peaks of a row to their groups."""
    cdef const float *own = smooth + (row % kept) * width
    cdef const float *other
    cdef Py_ssize_t block, first, x, i, y
    cdef float value
    cdef bint highest
    g.here, g.above = g.above, g.here
    memset(g.here, 0xFF, (width + 2) * sizeof(int))
    for block in range((width + BLOCK - 1) // BLOCK):
        first = block * BLOCK
        if not any_above(own + first, limit + first, min(BLOCK, width - first)):
            continue
        for x in range(first, min(first + BLOCK, width)):
            value = own[x]
            if not value > limit[x]:
                continue
            highest = True
            for y in range(max(row - flat, 0), min(row + flat + 1, height)):
                other = smooth + (y % kept) * width
                for i in range(max(x - flat, 0), min(x + flat + 1, width)):
                    if other[i] > value:
                        highest = False
                        break
                if not highest:
                    break
            if highest:
                _join(g, x, row, value)
    return 0


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
    g.here[x + 1] = group
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
