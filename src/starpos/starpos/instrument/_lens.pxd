# SPDX-License-Identifier: Apache-2.0
cdef class Lens:
    cdef double[8] d
    cdef void seen(self, const double *v, double *place) noexcept nogil
    cdef void seen_slopes(self, const double *v, double *slope) noexcept nogil
    cdef void ray(self, const double *place, double *v) noexcept nogil


cdef class PlumbBob(Lens):
    cdef bint bent
    cdef void distorted(self, const double *plane, double *out) noexcept nogil
    cdef void distorted_slopes(self, const double *plane, double *slope) noexcept nogil
    cdef bint undistorted(self, const double *target, double *plane) noexcept nogil


cdef class Equidistant(Lens):
    cdef readonly double reach
    cdef bint centred
    cdef double distance(self, double theta) noexcept nogil
    cdef double stretched(self, double theta) noexcept nogil
    cdef double angle(self, double distance) noexcept nogil
    cdef void from_axis(self, const double *place, double *v) noexcept nogil
    cdef void moved(self, const double *v, double *place) noexcept nogil
