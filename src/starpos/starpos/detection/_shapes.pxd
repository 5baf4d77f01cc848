# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# A covariance of two dimensions, for the modules here that work on many.

from libc.math cimport NAN, fabs, hypot, isfinite, pow


cdef struct Shape:
    double xx
    double xy
    double yy


cdef inline Shape shape_of(const double[:, :, ::1] each, Py_ssize_t k) noexcept nogil:
    """The matrix of star k; a single one serves any star."""
    cdef Py_ssize_t j = k if each.shape[0] > 1 else 0
    return Shape(each[j, 0, 0], (each[j, 0, 1] + each[j, 1, 0]) / 2, each[j, 1, 1])


cdef inline double volume_of(Shape s) noexcept nogil:
    return s.xx * s.yy - s.xy * s.xy


cdef inline Shape inverse(Shape s) noexcept nogil:
    cdef double volume = volume_of(s)
    return Shape(s.yy / volume, -s.xy / volume, s.xx / volume)


cdef inline (double, double) sides(Shape s) noexcept nogil:
    """The eigenvalues, the smaller first."""
    cdef double middle = (s.xx + s.yy) / 2, half = hypot((s.xx - s.yy) / 2, s.xy)
    return middle - half, middle + half


cdef inline Shape with_sides(Shape s, double narrow, double wide) noexcept nogil:
    """The matrix with the same eigenvectors and these eigenvalues."""
    cdef double half = hypot((s.xx - s.yy) / 2, s.xy), middle = (narrow + wide) / 2, scale
    if half == 0:
        return Shape(narrow, 0.0, wide)
    scale = (wide - narrow) / (2 * half)
    return Shape(middle + scale * (s.xx - s.yy) / 2, scale * s.xy, middle - scale * (s.xx - s.yy) / 2)


cdef inline void put_shape(double[:, :, ::1] out, Py_ssize_t k, Shape s) noexcept nogil:
    out[k, 0, 0], out[k, 0, 1], out[k, 1, 0], out[k, 1, 1] = s.xx, s.xy, s.xy, s.yy


cdef inline Shape clipped_to(Shape s, double least, double most, double exponent) noexcept nogil:
    """The matrix with eigenvalues of at least and at most so much, to a power."""
    cdef double narrow, wide
    narrow, wide = sides(s)
    narrow, wide = max(least, min(narrow, most)), max(least, min(wide, most))
    if exponent != 1:
        narrow, wide = pow(narrow, exponent), pow(wide, exponent)
    return with_sides(s, narrow, wide)


cdef inline Shape shape_before(Shape seen, Shape window) noexcept nogil:
    """The covariance of a star whose image through a window is seen; NaN where none is."""
    cdef Shape a, b = inverse(window)
    if isfinite(seen.xx + seen.xy + seen.yy) and fabs(volume_of(seen)) > 1e-6:
        a = inverse(seen)
        a = Shape(a.xx - b.xx, a.xy - b.xy, a.yy - b.yy)
        if fabs(volume_of(a)) > 1e-9:
            return inverse(a)
    return Shape(NAN, NAN, NAN)
