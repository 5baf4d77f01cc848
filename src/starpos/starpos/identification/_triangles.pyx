# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Look up a frame's triangles of bright stars among those of the sky, by their shape."""

from libc.limits cimport INT_MAX
from libc.math cimport M_PI, asin, atan2, fabs, sqrt
from libc.stdlib cimport abs, free, malloc, realloc
from libc.string cimport memset

import numpy as np

from starpos._numeric.algebra cimport fetch, length
from starpos._numeric.memory cimport room_for, start_of
from starpos.identification._frame cimport FrameStars, direction_of

cdef enum:
    # Sides of triangles for each star of a crowd.
    ROUNDS = 3
    # Shapes in a piece of memory that comes at once.
    LINE = 10
    # Logarithm of the size of a table that fits into a processor's cache.
    LOG_MARKS = 18
    # Of fewer candidates each one's support is counted at once.
    MANY = 2000
    # Candidates whose sides are asked for before they are counted.
    SLOTS_AHEAD = 16

# Tolerances of smallest and largest angles that are too wide to tell anything, rad.
cdef double WORST_SMALLEST = 0.1, WORST_LARGEST = 0.2
cdef double MIN_SIDE = 1e-9

ctypedef unsigned long long key_t


cdef class TriangleTable:
    """Columns of a `TriangleCatalogue`, and how its shapes are looked up.

    crowded          density of shapes where they are looked up, over the mean density
    scale_tolerance  the share by which the focal length may be off
    sigmas           a triangle may be off by so many sigma of its stars
    """

    def __init__(self, table, double crowded, double scale_tolerance, double sigmas):
        self.corners = np.ascontiguousarray(table.corners, np.int32)
        self.turn = np.ascontiguousarray(table.counter_clockwise, bool).view(np.uint8)
        self.shape = np.ascontiguousarray(table.shape, np.uint16)
        self.bin_start = np.ascontiguousarray(table.bin_start, np.int32)
        self.crowded, self.scale_tolerance, self.sigmas = crowded, scale_tolerance, sigmas
        self.codes[0], self.codes[1] = CODES / (2 * M_PI / 3), CODES / (M_PI / 3)
        self.codes[2] = CODES / table.longest_allowed[0]

    def candidates(
        self, FrameStars frame, int first, int last, double error_px, double most_expected, int most, bint loose
    ):
        """The candidates of `best` as arrays: star (K, 3), corner (K, 3) and mirrored (K,)."""
        cdef int k, count
        room = room_for(most * sizeof(Candidate))
        cdef Candidate *found = <Candidate *>start_of(room)
        count = self.best(frame, first, last, error_px, most_expected, most, loose, found)
        rows = [(list(found[k].star[:3]), found[k].corner, found[k].mirrored) for k in range(count)]
        star, corner, mirrored = zip(*rows) if rows else ((), (), ())
        return np.array(star, int).reshape(-1, 3), np.array(corner, int).reshape(-1, 3), np.array(mirrored, bool)

    cdef int best(
        self, FrameStars frame, int first, int last, double error_px, double most_expected, int most, bint loose, Candidate *out
    ) except -1:
        """Write candidates for triangles of a frame's stars whose faintest is first .. last - 1, brightest first.

        error_px       of all stars, beside their own
        most_expected  no more triangles are looked up once chance makes so many candidates
        most           so many are written: best supported first, then those of the likeliest size
        loose          only those that another one supports

        Returns how many there are.
        """
        cdef Search s
        cdef Shape shape
        cdef double expected = 0.0
        cdef int a, b, c, total
        try:
            _begin(&s, frame, last, error_px)
            # triangles of the brightest stars come first
            for c in range(first, s.stars):
                for total in range(1, 2 * c - 2):
                    for a in range(max(0, total - c + 1), (total + 1) // 2):
                        b = total - a
                        self._measure(&s, a, b, c, &shape)
                        if shape.usable and expected < most_expected:
                            self._ask(&s, &shape)
                            expected += self._expected(&shape)
            self._answer(&s)
            return _best(&s, most, 1 if loose else 0, True, out)
        finally:
            free(s.found)
            free(s.v)

    cdef int supported(
        self, FrameStars frame, int stars, double error_px, int most_looked_up, double most_expected, int most,
        Candidate *out
    ) except -1:
        """Write candidates as `best` does, those that at least two others support, in a crowd of false stars.

        Where most of these stars are false, nearly all candidates are chance, but chance supports few. All triangles on
        one side support each other if that side is of true stars. So a side is taken after another, with all triangles on
        it that are on none before: first those of two stars next to each other in brightness, the faintest of them first,
        because false stars mostly are brighter. It ends after most_looked_up triangles, or those of ROUNDS sides for each
        star if these are more, and where chance makes so many candidates.
        """
        cdef Search s
        cdef Shape shape
        cdef int a, b, c, apart, looked_up = 0
        cdef double expected = 0.0
        try:
            _begin(&s, frame, stars, error_px)
            most_looked_up = max(most_looked_up, ROUNDS * s.stars * s.stars)
            for apart in range(1, s.stars):
                for a in range(s.stars - apart - 1, -1, -1):
                    b = a + apart
                    if looked_up >= most_looked_up or expected >= most_expected:
                        break
                    for c in range(s.stars):
                        if not (_later(a, c, a, b) and _later(b, c, a, b)):
                            continue
                        self._measure(&s, min(a, c), max(a, min(b, c)), max(b, c), &shape)
                        if shape.usable:
                            self._ask(&s, &shape)
                            expected += self._expected(&shape)
                            looked_up += 1
            self._answer(&s)
            return _best(&s, most, 2, False, out)
        finally:
            free(s.found)
            free(s.v)

    cdef void _measure(self, const Search *s, int a, int b, int c, Shape *out) noexcept nogil:
        """Set the sides and the tolerances of the triangle of three stars, in ascending order."""
        cdef double error, x, y, z
        cdef int i, j
        out.star[0], out.star[1], out.star[2] = a, b, c
        out.side[0] = s.side[b * s.stars + c]
        out.side[1] = s.side[a * s.stars + c]
        out.side[2] = s.side[a * s.stars + b]
        # the largest angle lies opposite the longest side
        for i in range(2):
            for j in range(2 - i):
                if out.side[j] < out.side[j + 1]:
                    out.side[j], out.side[j + 1] = out.side[j + 1], out.side[j]
                    out.star[j], out.star[j + 1] = out.star[j + 1], out.star[j]
        x, y, z = out.side[0], max(out.side[1], MIN_SIDE), max(out.side[2], MIN_SIDE)
        error = self.sigmas * max(s.error[a], max(s.error[b], s.error[c]))
        out.tolerance[0] = error * sqrt(1 / (y * y) + 1 / (z * z) + (x / (y * z)) ** 2)
        x = max(x, MIN_SIDE)
        out.tolerance[1] = error * sqrt(1 / (x * x) + 1 / (y * y) + (z / (x * y)) ** 2)
        out.tolerance[2] = self.scale_tolerance * x + error
        out.usable = out.tolerance[1] < WORST_SMALLEST and out.tolerance[0] < WORST_LARGEST

    cdef double _expected(self, const Shape *shape) noexcept nogil:
        """Approximate number of the sky's triangles within the tolerance of a shape."""
        cdef double share = 1.0
        cdef int i
        for i in range(3):
            share *= min(2 * shape.tolerance[i] * self.codes[i] / CODES, 1.0)
        return self.crowded * self.corners.shape[0] * share

    cdef int _ask(self, Search *s, const Shape *shape) except -1 nogil:
        """Ask for a triangle, in both orders of two corners whose angles are alike."""
        cdef double[3] angle
        cdef double[3] middle
        cdef double[3] least
        cdef int i, swap, row, column, run
        cdef bint turn = False
        cdef Query *q
        least[0], least[1], least[2] = M_PI / 3, 0.0, 0.0
        for i in range(3):
            turn = _angle(s, shape.star[i], shape.star[(i + 1) % 3], shape.star[(i + 2) % 3], &angle[i])
        middle[0], middle[1], middle[2] = angle[0], angle[2], max(shape.side[0], MIN_SIDE)
        for swap in range(3):
            if swap > 0 and not angle[swap - 1] - angle[swap] < 2 * shape.tolerance[0]:
                continue
            q = &s.waiting[s.queries]
            s.queries += 1
            for i in range(3):
                q.star[i] = shape.star[i]
                q.low[i] = code_of(middle[i] - shape.tolerance[i], least[i], self.codes[i])
                q.high[i] = code_of(middle[i] + shape.tolerance[i], least[i], self.codes[i])
            if swap > 0:
                q.star[swap - 1], q.star[swap] = q.star[swap], q.star[swap - 1]
            q.longest, q.turn = middle[2], turn ^ (swap > 0)
            for row in range(q.low[0] >> SHIFT_0, (q.high[0] >> SHIFT_0) + 1):
                for column in range(q.low[1] >> SHIFT_1, (q.high[1] >> SHIFT_1) + 1):
                    run = (row << BITS_1 | column) << BITS_2
                    fetch(&self.bin_start[run + (q.low[2] >> SHIFT_2)])
                    fetch(&self.bin_start[run + (q.high[2] >> SHIFT_2) + 1])
        if s.queries >= AHEAD:
            self._answer(s)
        return 0

    cdef int _answer(self, Search *s) except -1 nogil:
        """Add the candidates of all queries that wait."""
        cdef const Query *q
        cdef Candidate *c
        cdef int k, row, column, run, t, end, stop, before = s.count
        for k in range(s.queries):
            q = &s.waiting[k]
            for row in range(q.low[0] >> SHIFT_0, (q.high[0] >> SHIFT_0) + 1):
                for column in range(q.low[1] >> SHIFT_1, (q.high[1] >> SHIFT_1) + 1):
                    run = (row << BITS_1 | column) << BITS_2
                    t, end = self.bin_start[run + (q.low[2] >> SHIFT_2)], self.bin_start[run + (q.high[2] >> SHIFT_2) + 1]
                    while t < end:
                        fetch(&self.shape[t, 0])
                        t += LINE
                    fetch(&self.shape[end, 0])
        for k in range(s.queries):
            q = &s.waiting[k]
            for row in range(q.low[0] >> SHIFT_0, (q.high[0] >> SHIFT_0) + 1):
                for column in range(q.low[1] >> SHIFT_1, (q.high[1] >> SHIFT_1) + 1):
                    run = (row << BITS_1 | column) << BITS_2
                    t = self.bin_start[run + (q.low[2] >> SHIFT_2)]
                    end = self.bin_start[run + (q.high[2] >> SHIFT_2) + 1]
                    while t < end:
                        stop = min(t + ALIKE, end)
                        self._add(s, q, t, stop)
                        t = stop
        # what `_add` has left open, now that memory has had time
        for k in range(before, s.count):
            c = &s.found[k]
            t = c.corner[0]
            c.corner[0], c.corner[1], c.corner[2] = self.corners[t, 0], self.corners[t, 1], self.corners[t, 2]
            c.mirrored = self.turn[t] != c.mirrored
        s.queries = 0
        return 0

    cdef int _add(self, Search *s, const Query *q, int first, int end) except -1 nogil:
        """Add the candidates of a query among the triangles first .. end - 1, at most ALIKE.

        For now the first corner is the triangle's row, and `mirrored` whether the query's turn is counter-clockwise.
        """
        cdef int[ALIKE] alike
        cdef Candidate *c
        cdef int t, k, i, count = 0
        # without a jump for each number, whose outcome no processor can guess
        for t in range(first, end):
            alike[count] = t
            count += (
                (q.low[0] <= self.shape[t, 0]) & (self.shape[t, 0] <= q.high[0])
                & (q.low[1] <= self.shape[t, 1]) & (self.shape[t, 1] <= q.high[1])
                & (q.low[2] <= self.shape[t, 2]) & (self.shape[t, 2] <= q.high[2])
            )
        while s.count + count > s.room:
            _grow(s)
        for k in range(count):
            t = alike[k]
            c = &s.found[s.count]
            s.count += 1
            for i in range(3):
                c.star[i] = q.star[i]
            c.corner[0], c.mirrored = t, q.turn
            fetch(&self.corners[t, 0])
            fetch(&self.turn[t])
            c.size = (self.shape[t, 2] + 0.5) / self.codes[2] / q.longest
        return 0


cdef inline bint _later(int x, int y, int a, int b) noexcept nogil:
    """Whether `supported` takes the side of stars x, y after that of a, b, where a < b."""
    cdef int apart = abs(x - y)
    return apart > b - a or apart == b - a and min(x, y) < a


cdef inline bint _angle(const Search *s, int a, int b, int c, double *angle) noexcept nogil:
    """Set the angle at a of three stars; whether they are counter-clockwise, seen from within the sphere."""
    cdef double turn = s.bearing[a * s.stars + c] - s.bearing[a * s.stars + b]
    turn += 2 * M_PI if turn < -M_PI else 0.0
    turn -= 2 * M_PI if turn > M_PI else 0.0
    angle[0] = fabs(turn)
    return turn < 0


cdef int _begin(Search *s, FrameStars frame, int stars, double error_px) except -1:
    """Take directions, errors, distances and bearings of a frame's brightest stars."""
    cdef int a, b
    cdef double x, y, z
    cdef const double *v
    cdef const double *w
    s.found, s.count, s.room, s.queries = NULL, 0, 0, 0
    s.stars = stars = min(stars, frame.count)
    s.v = <double *>malloc((4 * stars + 2 * stars * stars + 1) * sizeof(double))
    if s.v == NULL:
        raise MemoryError
    s.error = s.v + 3 * stars
    s.side = s.error + stars
    s.bearing = s.side + stars * stars
    for b in range(stars):
        direction_of(frame.pixel[2 * b], frame.pixel[2 * b + 1], frame.focal_px, &s.v[3 * b])
        s.error[b] = length(error_px, frame.error[b]) / frame.focal_px
        for a in range(b):
            x, y, z = s.v[3 * a] - s.v[3 * b], s.v[3 * a + 1] - s.v[3 * b + 1], s.v[3 * a + 2] - s.v[3 * b + 2]
            s.side[a * stars + b] = 2 * asin(min(1.0, 0.5 * sqrt(x * x + y * y + z * z)))
    for a in range(stars):
        # two directions across v, as long as each other, to the right and down
        v = &s.v[3 * a]
        for b in range(stars):
            w = &s.v[3 * b]
            x = v[2] * w[0] - v[0] * w[2]
            y = (v[0] * v[0] + v[2] * v[2]) * w[1] - v[1] * (v[0] * w[0] + v[2] * w[2])
            s.bearing[a * stars + b] = atan2(y, x)
    return 0


cdef int _grow(Search *s) except -1 nogil:
    """Make room for more candidates."""
    cdef Candidate *more = NULL
    if s.room <= INT_MAX // 2:
        s.room = max(256, 2 * s.room)
        more = <Candidate *>realloc(s.found, s.room * sizeof(Candidate))
    if more == NULL:
        with gil:
            raise MemoryError
    s.found = more
    return 0


cdef inline key_t _mixed(int star, int corner) noexcept nogil:
    """A scrambled number of a detection and its identity."""
    cdef key_t key = ((<key_t>star << 40 | <key_t>corner) + 1) * <key_t>0x9E3779B97F4A7C15
    key ^= key >> 29
    return key * <key_t>0xBF58476D1CE4E5B9


cdef inline void _sides(const Candidate *c, key_t *side) noexcept nogil:
    """Set the keys (3,) of a candidate's sides: of two stars with their identities, in either order."""
    cdef key_t[3] mixed
    cdef int i
    for i in range(3):
        mixed[i] = _mixed(c.star[i], c.corner[i])
    for i in range(3):
        # 0 stands for an empty slot
        side[i] = (mixed[i] + mixed[(i + 1) % 3] + 2 * <key_t>c.mirrored) | 1


cdef int _drop_lonely(Search *s) except -1:
    """Drop most of the candidates that share no side: mark each side in a small table, as seen once or more often."""
    cdef key_t[3] side
    cdef int k, i, kept = 0
    cdef unsigned char *mark
    room = room_for(1 << LOG_MARKS)
    cdef unsigned char *marks = <unsigned char *>start_of(room)
    memset(marks, 0, 1 << LOG_MARKS)
    for k in range(s.count):
        _sides(&s.found[k], side)
        for i in range(3):
            mark = &marks[side[i] >> (64 - LOG_MARKS)]
            mark[0] = min(mark[0] + 1, 2)
    for k in range(s.count):
        _sides(&s.found[k], side)
        for i in range(3):
            if marks[side[i] >> (64 - LOG_MARKS)] > 1:
                s.found[kept] = s.found[k]
                kept += 1
                break
    s.count = kept
    return 0


cdef struct Slot:
    # How many candidates have a side; 0 in place of its key if none has.
    key_t side
    long long count


cdef int _support(Search *s) except -1:
    """Count for each candidate how many others share a side with it."""
    cdef int k, i, others
    cdef Py_ssize_t slots = 64, slot, count = s.count
    cdef key_t *side
    while slots < 4 * count:
        slots *= 2
    room = room_for(slots * sizeof(Slot) + 3 * count * sizeof(key_t))
    cdef Slot *table = <Slot *>start_of(room)
    # the sides of each candidate, and later the slots of these
    cdef key_t *sides = <key_t *>(table + slots)
    memset(table, 0, slots * sizeof(Slot))
    for k in range(s.count + SLOTS_AHEAD):
        if k < s.count:
            _sides(&s.found[k], sides + 3 * k)
            for i in range(3):
                fetch(&table[(sides[3 * k + i] >> 20) & (slots - 1)])
        if k < SLOTS_AHEAD:
            continue
        side = sides + 3 * (k - SLOTS_AHEAD)
        for i in range(3):
            slot = (side[i] >> 20) & (slots - 1)
            while table[slot].side != 0 and table[slot].side != side[i]:
                slot = (slot + 1) & (slots - 1)
            table[slot].side = side[i]
            table[slot].count += 1
            side[i] = slot
    for k in range(s.count):
        others = -3
        for i in range(3):
            fetch(&table[sides[3 * min(k + SLOTS_AHEAD, s.count - 1) + i]])
            others += <int>table[sides[3 * k + i]].count
        s.found[k].support = others
    return 0


cdef int _best(Search *s, int most, int least_support, bint by_size, Candidate *out) except -1:
    """Write the `most` candidates with most support, equal ones by their size or in their order; how many."""
    cdef int k, j, kept = 0
    cdef Candidate *c
    room = room_for((most + 1) * sizeof(int))
    cdef int *order = <int *>start_of(room)
    if least_support > 0 and s.count > MANY:
        _drop_lonely(s)
    _support(s)
    for k in range(s.count):
        c = &s.found[k]
        if c.support < least_support:
            continue
        j = kept
        while j > 0 and _precedes(c, &s.found[order[j - 1]], by_size):
            order[j] = order[j - 1]
            j -= 1
        if j < most:
            order[j] = k
            kept = min(kept + 1, most)
    for k in range(kept):
        out[k] = s.found[order[k]]
    return kept


cdef inline bint _precedes(const Candidate *one, const Candidate *other, bint by_size) noexcept nogil:
    if one.support != other.support:
        return one.support > other.support
    return by_size and max(one.size, 1 / one.size) < max(other.size, 1 / other.size)
