# SPDX-License-Identifier: Apache-2.0
cdef class Lens:
    cdef double[8] d
    cdef void seen(self, const double *v, double *place) noexcept nogil
    cdef void seen_slopes(self, const double *v, double *slope) noexcept nogil
    cdef void ray(self, const double *place, double *v) noexcept nogil
