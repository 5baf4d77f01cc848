# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# The numbers that shapes of triangles are kept as, and what a look-up finds, for the other modules here.

from starpos.identification._frame cimport FrameStars

cdef enum:
    # Shapes are kept to 1/65536 of their ranges; the highest bits of the three are a triangle's bin.
    CODES = 65536
    # How far the codes are shifted for their bins, and where the bins stand in the number of all three.
    SHIFT_0 = 8
    SHIFT_1 = 9
    SHIFT_2 = 10
    BITS_1 = 7
    BITS_2 = 6
    # Queries that are prepared before the first of them is answered, so that memory has time.
    AHEAD = 16
    # Triangles that are compared with a query at once.
    ALIKE = 64


cdef struct Candidate:
    # Longest side, over that of the frame's triangle.
    double size
    # Rows of the catalogue's stars, and of the frame's that they may be: less than 256.
    int[3] corner
    int support
    unsigned char[3] star
    unsigned char mirrored


cdef struct Shape:
    # The corners, and the sides opposite to them: the longest first.
    int[3] star
    double[3] side
    # Of the largest and the smallest angle and of the longest side.
    double[3] tolerance
    bint usable


cdef struct Query:
    int[3] star
    # of the shape in CODES
    int[3] low
    int[3] high
    double longest
    bint turn


cdef struct Search:
    # Of the frame's stars: directions, errors (rad), the distance (rad) of star b from a brighter one a at [a, b], and the
    # angle at a, from any direction on, under which b is seen, at [a, b] too.
    int stars
    double *v
    double *error
    double *side
    double *bearing
    Query[2 * AHEAD] waiting
    int queries
    Candidate *found
    int count
    int room


cdef class TriangleTable:
    cdef const int[:, ::1] corners
    cdef const unsigned char[::1] turn
    cdef const unsigned short[:, ::1] shape
    cdef const int[::1] bin_start
    cdef double crowded, scale_tolerance, sigmas
    cdef double[3] codes

    cdef int best(
        self, FrameStars frame, int first, int last, double error_px, double most_expected, int most, bint loose, Candidate *out
    ) except -1
    cdef int supported(
        self, FrameStars frame, int stars, double error_px, int most_looked_up, double most_expected, int most,
        Candidate *out
    ) except -1
    cdef void _measure(self, const Search *s, int a, int b, int c, Shape *out) noexcept nogil
    cdef double _expected(self, const Shape *shape) noexcept nogil
    cdef int _ask(self, Search *s, const Shape *shape) except -1 nogil
    cdef int _answer(self, Search *s) except -1 nogil
    cdef int _add(self, Search *s, const Query *q, int first, int end) except -1 nogil


cdef inline int bin_of(int code_0, int code_1, int code_2) noexcept nogil:
    """The bin of a shape in CODES."""
    return (code_0 >> SHIFT_0 << BITS_1 | code_1 >> SHIFT_1) << BITS_2 | code_2 >> SHIFT_2


cdef inline int code_of(double value, double least, double per_unit) noexcept nogil:
    """A number of a shape in CODES, limited to its range."""
    value = (value - least) * per_unit
    if value < 0:
        return 0
    return <int>value if value < CODES - 1 else CODES - 1


cdef inline bint is_counter_clockwise(const double *a, const double *b, const double *c) noexcept nogil:
    """Whether three directions are counter-clockwise, seen from within the sphere."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    ) < 0
