# SPDX-License-Identifier: Apache-2.0
cdef class Air:
    cdef double a, b, least_up
    cdef void bend(self, const double *v, double *out) noexcept nogil
    cdef void unbend(self, const double *u, double *out) noexcept nogil
    cdef void bend_slopes(self, const double *v, const double *u, double *slope) noexcept nogil
