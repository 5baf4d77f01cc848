# SPDX-License-Identifier: Apache-2.0
from starpos.identification._frame cimport FrameStars
from starpos.identification._matching cimport Matching
from starpos.identification._sky cimport Visible


cdef enum:
    ERRORS = 4


cdef struct Chances:
    # Errors beside the centroids' own, and the logarithms of their probabilities; a closer detection says nothing new.
    double[ERRORS] errors_px
    double[ERRORS] log_shares
    double double_px


cdef struct Rules:
    # Stars are matched and a pose fitted so often; with fewer pairs there is none. Most steps of a fit, and the last one (rad).
    int rounds, fewest_stars, steps
    double small_step
    # Error beside each star's own; the spread of residuals over their median, and its least value. A star may be so many times
    # the spread from its place, and so far beyond. Where the residuals spread more, the lens bends, and all stars count alike.
    double floor_px, sigma_per_mad, least_spread_px, gate_sigma, gate_px, bent_px
    # A star so far beyond the frame is on it, one so near its edge may be cut off, and closer ones make one image.
    double edge_px, inside_px, blend_px
    # So many catalogue stars are taken for each detection, and so many more; so many of the brightest detections take part.
    int per_detection, more_stars, most_stars


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
    FrameStars frame, bint mirrored, int n, const Visible *stars, const Rules *rules, double *radius, Matching *m, double *pixel,
    double *work, Settled *out,
) noexcept nogil
cdef void gates(FrameStars frame, const Rules *rules, double spread, int n, double *radius) noexcept nogil
cdef void count_alike(
    FrameStars frame, bint mirrored, const Visible *stars, const Rules *rules, double *pixel, double *work, Settled *out
) noexcept nogil
cdef double weighed(
    const double *xy, const double *sigma_px, int n, double area_px2, const double *attitude, double focal_px,
    const double *width, const Py_ssize_t *star, const Py_ssize_t *rank, const double *w, const Py_ssize_t *row, int many,
    const Chances *chances,
) except? -1
