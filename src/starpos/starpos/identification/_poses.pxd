# SPDX-License-Identifier: Apache-2.0
from starpos.identification._frame cimport FrameStars
from starpos.identification._matching cimport Matching
from starpos.identification._sky cimport Visible


cdef enum:
    ERRORS = 4


cdef class Chances:
    cdef double[ERRORS] errors_px
    cdef double[ERRORS] log_shares
    cdef double double_px


cdef class Rules:
    cdef int rounds, fewest, steps, per_detection, more_stars, most_stars
    cdef double small_step, floor_px, per_mad, least, gate_sigma, gate_px, edge_px, inside_px, blend_px, bent_px


cdef struct Settled:
    # The pose, and the pairs: rows in the frame and among the catalogue's stars there.
    double[9] attitude
    double focal
    int count
    Py_ssize_t *star
    Py_ssize_t *near
    # Of the residuals (px): spread by their median, rms with the weights of the fit, mean square.
    double spread
    double rms
    double mean_square


cdef void settle(
    FrameStars frame, bint mirrored, int n, const Visible *stars, Rules rules, double *radius, Matching *m, double *pixel,
    double *work, Settled *out,
) noexcept nogil
cdef void gates(FrameStars frame, Rules rules, double spread, int n, double *radius) noexcept nogil
cdef void count_alike(
    FrameStars frame, bint mirrored, const Visible *stars, Rules rules, double *pixel, double *work, Settled *out
) noexcept nogil
cdef double weighed(
    const double *xy, const double *sigma_px, int n, double area_px2, const double *attitude, double focal_px,
    const double *width, const Py_ssize_t *star, const Py_ssize_t *rank, const double *w, const Py_ssize_t *row, int many,
    Chances chances,
) except? -1
