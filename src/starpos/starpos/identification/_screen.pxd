# SPDX-License-Identifier: Apache-2.0
from starpos.identification._frame cimport FrameStars
from starpos.identification._sky cimport Date, StarTable
from starpos.identification._triangles cimport Candidate


cdef struct Bright:
    double x
    double y
    int rank


cdef class BrightTable:
    cdef StarTable stars
    cdef const int[::1] row
    cdef const int[::1] rank
    cdef const int[::1] cell_start

    cdef void pose(
        self, FrameStars frame, const Candidate *c, const Date *date, double error_px, double match_sigma, int n,
        double *attitude, double *focal, double *radius,
    ) noexcept nogil
    cdef double worth(
        self, FrameStars frame, const Candidate *c, const Date *date, const double *attitude, double focal_px, int n,
        const double *radius_px, int most_stars, double match_sigma, double log_false,
    ) except? -1
    cdef int _on_frame(
        self, const int *runs, int count, FrameStars frame, bint mirrored, const double *attitude, double focal_px,
        const Date *date, Bright *bright,
    ) noexcept nogil
