# SPDX-License-Identifier: Apache-2.0

cdef class Identification:
    cdef readonly double focal_scale, residual_px, mean_square_px2, log_odds
    cdef readonly bint mirrored
    # M and E; `star`, `catalogue` and `expected` one behind the other, and room behind; `attitude` and `blend_px`
    cdef Py_ssize_t matched, due
    cdef object rows, reals
    cdef Py_ssize_t *row
    cdef double *turn


cdef int hold(Identification found, Py_ssize_t matched, rows, reals) except -1
