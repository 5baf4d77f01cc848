# SPDX-License-Identifier: Apache-2.0
# cython: cdivision=True

cdef enum:
    # Pixels that are evaluated together, and in one step, and terms of a series along one axis.
    BLOCK = 64
    LANES = 8
    ORDERS = 32


cdef inline int blocks(int pixels) noexcept nogil:
    """How many blocks hold so many pixels."""
    return (pixels + BLOCK - 1) // BLOCK


cdef inline int whole(int pixels) noexcept nogil:
    """So many pixels, or some more, are evaluated in whole steps."""
    return (pixels + LANES - 1) // LANES * LANES


cdef struct Local:
    # The PSF at a star's place, as `detection.psf.LocalPsf` has it: axes (2, 2), series (rows, columns), and the Gaussian's peak.
    double[4] axes
    double peak
    const double *series
    int rows
    int columns


cdef void local_of(const double[:, :, ::1] axes, const double[:, :, ::1] series, int k, Local *out) noexcept nogil
cdef int sound(const double[:, :, ::1] axes, const double[:, :, ::1] series, int n) except -1
cdef void evaluate(
    const Local *psf, const double *dx, const double *dy, int n, double *value, double *by_x, double *by_y
) noexcept nogil
cdef void values(const Local *psf, const double *dx, const double *dy, int n, double *value) noexcept nogil
cdef void scaled(const Local *psf, const double *dx, const double *dy, int n, double *u, double *v, double *gauss) noexcept nogil
cdef void terms_at(
    const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out
) noexcept nogil
