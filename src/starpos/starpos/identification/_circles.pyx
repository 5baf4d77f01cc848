# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Build a catalogue of triangles: those of the brightest stars of circles over the sky, measured and put in bins."""

from libc.math cimport M_PI, asin, atan2, cos, fabs, floor, sin, sqrt

import numpy as np

from starpos._numeric.algebra cimport fetch
from starpos.identification._triangles cimport CODES, bin_of, code_of, is_counter_clockwise


cdef enum:
    MAX_TAKEN = 32
    # Triangles whose places in memory are asked for before they are written.
    AHEAD = 16


cdef class Cells:
    """Stars in cells: zones of declination, each parted in right ascension; and a radius (rad) about points."""

    cdef const double[:, ::1] v
    cdef double radius, chord2
    cdef int zones
    # first cell of each zone, first place of each cell in `row`
    cdef int[::1] zone
    cdef int[::1] start
    cdef int[::1] row

    def __init__(self, const double[:, ::1] v, double radius):
        cdef int k, n = v.shape[0]
        # no more cells than a few for each star
        cdef double width = max(radius, 2.0 / sqrt(max(n, 4)))
        self.v, self.radius, self.chord2 = v, radius, (2 * sin(radius / 2)) ** 2
        self.zones = max(1, <int>(M_PI / width))
        middles = (np.arange(self.zones) + 0.5) * np.pi / self.zones - np.pi / 2
        parts = np.maximum(1, (2 * np.pi * np.cos(middles) / width).astype(np.int32))
        self.zone = np.concatenate([[0], np.cumsum(parts)]).astype(np.int32)
        of = np.empty(n, np.int32)
        cdef int[::1] cell = of
        for k in range(n):
            cell[k] = self._cell(self._zone(asin(max(-1.0, min(1.0, v[k, 2])))), atan2(v[k, 1], v[k, 0]))
        # within a cell in their order, brightest first
        self.row = np.argsort(of, kind="stable").astype(np.int32)
        self.start = np.searchsorted(of[self.row], np.arange(self.zone[self.zones] + 1)).astype(np.int32)

    cdef int _zone(self, double dec) noexcept nogil:
        return max(0, min(<int>floor((dec / M_PI + 0.5) * self.zones), self.zones - 1))

    cdef int _cell(self, int zone, double ra) noexcept nogil:
        cdef int parts = self.zone[zone + 1] - self.zone[zone]
        return self.zone[zone] + min(<int>((ra / (2 * M_PI) + 0.5) * parts), parts - 1)

    cdef int brightest(self, const double *centre, int most, int *taken) noexcept nogil:
        """Set `taken` to the rows of the `most` first stars within the circle about a centre, ascending; how many."""
        cdef double dec = asin(max(-1.0, min(1.0, centre[2]))), ra = atan2(centre[1], centre[0]), wide = M_PI
        cdef int zone, first, last, cell, parts, k, j, row, count = 0
        # half the circle's width in right ascension; if a pole is inside, it has all of it
        if fabs(dec) + self.radius < M_PI / 2 - 1e-9:
            wide = asin(min(sin(self.radius) / cos(dec), 1.0)) + 1e-9
        for zone in range(self._zone(dec - self.radius), self._zone(dec + self.radius) + 1):
            parts = self.zone[zone + 1] - self.zone[zone]
            first = <int>floor(((ra - wide) / (2 * M_PI) + 0.5) * parts)
            last = <int>floor(((ra + wide) / (2 * M_PI) + 0.5) * parts)
            for k in range(first, min(last, first + parts - 1) + 1):
                cell = self.zone[zone] + (k + 2 * parts) % parts
                for j in range(self.start[cell], self.start[cell + 1]):
                    row = self.row[j]
                    # the others of the cell are fainter
                    if count == most and row > taken[count - 1]:
                        break
                    if (
                        (self.v[row, 0] - centre[0]) ** 2 + (self.v[row, 1] - centre[1]) ** 2
                        + (self.v[row, 2] - centre[2]) ** 2
                    ) <= self.chord2:
                        count = _inserted(taken, count, most, row)
        return count


cdef inline int _inserted(int *rows, int count, int most, int row) noexcept nogil:
    """Insert a row into ascending ones, of which the `most` lowest are kept; how many there are."""
    cdef int j = count if count < most else most - 1
    while j > 0 and rows[j - 1] > row:
        rows[j] = rows[j - 1]
        j -= 1
    rows[j] = row
    return min(count + 1, most)


def well_apart(const double[:, ::1] v, double nearest):
    """Rows of the stars v (N, 3), brightest first, that have no brighter star within `nearest` rad.

    Close groups make no triangles among themselves, but would use up the stars of a circle.
    """
    cdef Cells cells = Cells(v, nearest)
    cdef int k, first = 0
    rows = np.empty(len(v), np.intp)
    cdef Py_ssize_t[::1] row = rows
    cdef int kept = 0
    for k in range(v.shape[0]):
        cells.brightest(&v[k, 0], 1, &first)
        if first == k:
            row[kept] = k
            kept += 1
    return rows[:kept]


def triples_of_circles(const double[:, ::1] v, const double[:, ::1] centres, double radius, int most):
    """The triples a < b < c among the `most` first of the stars v (n, 3) in each circle: a (T,), and b, c as one number (T,)."""
    cdef Cells cells = Cells(v, radius)
    cdef int[MAX_TAKEN] taken
    cdef int count, i, j, k
    cdef Py_ssize_t circle, place = 0
    if not 3 <= most <= MAX_TAKEN:
        raise ValueError(f"{most} stars of each circle: it must be 3 to {MAX_TAKEN}")
    room = len(centres) * (most * (most - 1) * (most - 2) // 6)
    brightest, others = np.empty(room, np.int32), np.empty(room, np.int64)
    cdef int[::1] a = brightest
    cdef long long[::1] pair = others
    for circle in range(centres.shape[0]):
        count = cells.brightest(&centres[circle, 0], most, taken)
        for i in range(count):
            for j in range(i + 1, count):
                for k in range(j + 1, count):
                    a[place], pair[place] = taken[i], <long long>taken[j] << 32 | taken[k]
                    place += 1
    return brightest[:place], others[:place]


def distinct(const int[::1] brightest, const long long[::1] others, Py_ssize_t n):
    """The distinct ones of triples of n stars, as `triples_of_circles` returns them, sorted.

    Returns start (n + 1,) and others: those whose brightest star is a are others[start[a]:start[a + 1]]. One key of 64 bits for
    all three stars would overflow beyond two million stars.
    """
    cdef Py_ssize_t k, begin = 0, end, kept = 0, count = brightest.shape[0]
    cdef int a
    starts, ordered = np.zeros(n + 1, np.intp), np.empty(count, np.int64)
    cdef Py_ssize_t[::1] start = starts
    cdef long long[::1] pair = ordered
    for k in range(count):
        start[brightest[k] + 1] += 1
    np.cumsum(starts, out=starts)
    with nogil:
        for k in range(count):
            # the places are far from each other
            fetch(&start[brightest[min(k + 2 * AHEAD, count - 1)]])
            fetch(&pair[min(start[brightest[min(k + AHEAD, count - 1)]], count - 1)])
            a = brightest[k]
            pair[start[a]] = others[k]
            start[a] += 1
        # by now start[a] is the end of star a's
        for a in range(n):
            end, start[a] = start[a], kept
            _sort(&pair[begin], end - begin)
            for k in range(begin, end):
                if k == begin or pair[k] != pair[kept - 1]:
                    pair[kept] = pair[k]
                    kept += 1
            begin = end
    start[n] = kept
    return starts, ordered[:kept]


cdef void _sort(long long *v, Py_ssize_t n) noexcept nogil:
    """Sort up to a few hundred numbers, by Shell's method: a library's sort is called too slowly for so few."""
    cdef Py_ssize_t gap = 1, i, j
    cdef long long x
    while gap < n // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, n):
            x, j = v[i], i
            while j >= gap and v[j - gap] > x:
                v[j] = v[j - gap]
                j -= gap
            v[j] = x
        gap //= 3


def binned(
    const double[:, ::1] v, const int[::1] rows, const Py_ssize_t[::1] first, const long long[::1] others, double shortest,
    double longest, int bins,
):
    """The triangles of triples whose sides are longer than `shortest` and shorter than `longest`, rad, in bins of their shape.

    v, rows        directions (S, 3) of all stars, and the rows (n,) of those that the triples number
    first, others  the triples, as `distinct` returns them

    Returns corners (T, 3), counter_clockwise (T,), shape (T, 3) and bin_start, as `TriangleCatalogue` has them.
    """
    cdef Py_ssize_t k, kept = 0, n = rows.shape[0], count = others.shape[0]
    cdef long long a, b, c
    cdef int i, j
    cdef int[3] corner
    cdef double[3] sine
    cdef double[2] angle
    cdef double[3] per_unit
    cdef int[3] code
    cdef double least = sin(shortest / 2), most = sin(longest / 2)
    per_unit[0], per_unit[1], per_unit[2] = CODES / (2 * M_PI / 3), CODES / (M_PI / 3), CODES / longest
    of = np.empty(count, np.int32)
    made = np.empty((count, 3), np.uint16), np.empty((count, 3), np.int32), np.empty(count, np.uint8)
    cdef int[::1] bin = of
    cdef unsigned short[:, ::1] shape = made[0]
    cdef int[:, ::1] corners = made[1]
    cdef unsigned char[::1] turns = made[2]
    with nogil:
        for a in range(n):
            for k in range(first[a], first[a + 1]):
                b, c = others[k] >> 32, <unsigned int>others[k]
                corner[0], corner[1], corner[2] = rows[a], rows[b], rows[c]
                for i in range(3):
                    sine[i] = _half_chord(&v[corner[(i + 1) % 3], 0], &v[corner[(i + 2) % 3], 0])
                # the largest angle lies opposite the longest side
                for i in range(2):
                    for j in range(2 - i):
                        if sine[j] < sine[j + 1]:
                            sine[j], sine[j + 1] = sine[j + 1], sine[j]
                            corner[j], corner[j + 1] = corner[j + 1], corner[j]
                if not (sine[0] < most and sine[2] > least):
                    continue
                _largest_and_smallest(sine, angle)
                code[0] = code_of(angle[0], M_PI / 3, per_unit[0])
                code[1] = code_of(angle[1], 0.0, per_unit[1])
                code[2] = code_of(2 * asin(sine[0]), 0.0, per_unit[2])
                for i in range(3):
                    corners[kept, i], shape[kept, i] = corner[i], <unsigned short>code[i]
                turns[kept] = is_counter_clockwise(&v[corner[0], 0], &v[corner[1], 0], &v[corner[2], 0])
                bin[kept] = bin_of(code[0], code[1], code[2])
                kept += 1
    of = of[:kept]
    starts = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=bins))]).astype(np.int32)
    order = np.argsort(of, kind="stable")
    # each column is dropped once it is in order: a node has little memory
    columns = [made[1], made[2], made[0]]
    made = of = bin = shape = corners = turns = None
    for i in range(3):
        columns[i] = columns[i][order]
    return columns[0], columns[1].view(bool), columns[2], starts


cdef inline double _half_chord(const double *a, const double *b) noexcept nogil:
    """Half the chord between two directions, the sine of half the angle between them."""
    cdef double x = a[0] - b[0], y = a[1] - b[1], z = a[2] - b[2]
    return min(1.0, 0.5 * sqrt(x * x + y * y + z * z))


cdef inline void _largest_and_smallest(const double *sine, double *angle) noexcept nogil:
    """The largest and the smallest angle (2,) of a spherical triangle by the sines (3,) of its half sides, longest first.

    As `triangles.angles`, by sums of half sides: without a sine of them, or an arc for each.
    """
    cdef double p = sine[0], q = sine[1], r = sine[2]
    cdef double p_, q_, r_
    p_, q_, r_ = sqrt(1 - p * p), sqrt(1 - q * q), sqrt(1 - r * r)
    cdef double sum_sine = q * r_ + q_ * r, sum_cosine = q_ * r_ - q * r
    cdef double off_sine = r * q_ - r_ * q, off_cosine = r_ * q_ + r * q
    cdef double whole = sum_sine * p_ + sum_cosine * p, a = max(sum_sine * p_ - sum_cosine * p, 0.0)
    cdef double b = max(p * off_cosine + p_ * off_sine, 0.0), c = max(p * off_cosine - p_ * off_sine, 0.0)
    angle[0] = 2 * atan2(sqrt(b * c), sqrt(whole * a))
    angle[1] = 2 * atan2(sqrt(a * b), sqrt(whole * c))
