# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Which detections and which stars are nearest to each other, for the other modules here.

from libc.stdlib cimport malloc

from starpos._numeric.algebra cimport Point, Strips, sort_by_x, strip_of


cdef struct Matching:
    # Detections in the order of x; and for each detection and each star its nearest partner and their squared distance.
    Point *sorted
    Strips strips
    int *near
    int *back
    double *near2
    double *back2
    void *memory


cdef inline int begin(Matching *m, int detections, int stars) except -1 nogil:
    """Take memory for so many detections and stars."""
    cdef size_t each = detections * (2 * sizeof(Point) + sizeof(double) + sizeof(int)) + stars * (sizeof(double) + sizeof(int))
    m.memory = malloc(each + 64)
    if m.memory == NULL:
        with gil:
            raise MemoryError
    m.sorted = <Point *>m.memory
    # half of it to sort in
    m.near2 = <double *>(m.sorted + 2 * detections)
    m.back2 = m.near2 + detections
    m.near = <int *>(m.back2 + stars)
    m.back = m.near + detections
    return 0


cdef inline void order(Matching *m, const double *xy, int n) noexcept nogil:
    """Sort the first n of the detections xy (N, 2) by x."""
    cdef int i
    for i in range(n):
        m.sorted[i].x, m.sorted[i].y, m.sorted[i].row = xy[2 * i], xy[2 * i + 1], i
    sort_by_x(m.sorted, n, m.sorted + n, &m.strips)


cdef inline void match(Matching *m, int n, const double *star, int stars, const double *radius) noexcept nogil:
    """Find for each detection (n,) the star (stars, 2) within its radius (n,) px that is nearest to it, and it to that one.

    m.near of the others becomes -1.
    """
    cdef double widest = 0.0, x, y, apart2, nearest2
    cdef int i, j, s, low, nearest
    # what is written below might be these, for all that a compiler knows
    cdef const Point *at = m.sorted
    cdef const Point *end = at + n
    cdef const Point *point
    cdef const Strips *strips = &m.strips
    cdef int *near = m.near
    cdef int *back = m.back
    cdef double *near2 = m.near2
    for i in range(n):
        widest = max(widest, radius[i])
        near[i], near2[i] = -1, 1e300
    for s in range(stars):
        x, y = star[2 * s], star[2 * s + 1]
        nearest, nearest2 = -1, 1e300
        point = at + strips.first[strip_of(x - widest, strips)]
        while point < end and point.x <= x + widest:
            i = point.row
            apart2 = (point.x - x) ** 2 + (point.y - y) ** 2
            if apart2 < near2[i]:
                near[i], near2[i] = s, apart2
            if apart2 < nearest2 or apart2 == nearest2 and i < nearest:
                nearest, nearest2 = i, apart2
            point += 1
        back[s] = nearest
    for i in range(n):
        j = near[i]
        if j >= 0 and not (near2[i] < radius[i] * radius[i] and back[j] == i):
            near[i] = -1
