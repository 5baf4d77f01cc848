# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Angles of spherical triangles and the numbers that shapes are kept as, for the other modules here.

from libc.math cimport M_PI, atan2, sin, sqrt

cdef enum:
    # Shapes are kept to 1/65536 of their ranges; the highest bits of the three are a triangle's bin.
    CODES = 65536
    # How far the codes are shifted for their bins, and where the bins stand in the number of all three.
    SHIFT_0 = 8
    SHIFT_1 = 9
    SHIFT_2 = 10
    BITS_1 = 7
    BITS_2 = 6


cdef inline int bin_of(int code_0, int code_1, int code_2) noexcept nogil:
    """The bin of a shape in CODES."""
    return (code_0 >> SHIFT_0 << BITS_1 | code_1 >> SHIFT_1) << BITS_2 | code_2 >> SHIFT_2


cdef inline int code_of(double value, double least, double per_unit) noexcept nogil:
    """A number of a shape in CODES, limited to its range."""
    value = (value - least) * per_unit
    if value < 0:
        return 0
    return <int>value if value < CODES - 1 else CODES - 1


cdef inline void angles_of(const double *side, double *angle) noexcept nogil:
    """The angles (3,) of a spherical triangle of sides (3,), each opposite its angle, as `triangles.angles` has them."""
    cdef double s = (side[0] + side[1] + side[2]) / 2, whole = sin(s)
    cdef double a = sin(max(s - side[0], 0.0)), b = sin(max(s - side[1], 0.0)), c = sin(max(s - side[2], 0.0))
    angle[0] = 2 * atan2(sqrt(b * c), sqrt(whole * a))
    angle[1] = 2 * atan2(sqrt(a * c), sqrt(whole * b))
    angle[2] = 2 * atan2(sqrt(a * b), sqrt(whole * c))


cdef inline bint is_counter_clockwise(const double *a, const double *b, const double *c) noexcept nogil:
    """Whether three directions are counter-clockwise, seen from within the sphere."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    ) < 0
