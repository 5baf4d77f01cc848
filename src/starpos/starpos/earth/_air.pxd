# SPDX-License-Identifier: Apache-2.0
cdef class Refraction:
    cdef readonly double a, b
    cdef double least_up
    cdef void raise_one(self, const double *v, double *out) noexcept nogil
    cdef void lower_one(self, const double *u, double *out) noexcept nogil
    cdef void bend_slopes(self, const double *v, const double *u, double *slope) noexcept nogil
