# SPDX-License-Identifier: Apache-2.0
# cython: cdivision=True

cdef enum:
    # Pixels that are evaluated together, and terms of a series along one axis.
    BLOCK = 64
    ORDERS = 32
    # Monomials that describe a variation over the field.
    MONOMIALS = 6


cdef inline int blocks(int pixels) noexcept nogil:
    """How many blocks hold so many pixels."""
    return (pixels + BLOCK - 1) // BLOCK


cdef struct Local:
    # The PSF at a star's place, as `detection.psf.LocalPsf` has it: axes (2, 2), the Gaussian's peak, and the series
    # (rows, columns) by its terms other than 0, row after row: of each row the first, and of each term its column, its
    # coefficient, and that times the square root of the column + 1.
    double[4] axes
    double peak
    int rows
    int columns
    int[ORDERS + 1] first
    int[ORDERS * ORDERS] column
    double[ORDERS * ORDERS] term
    double[ORDERS * ORDERS] slope


cdef void local_of(const double[:, :, ::1] axes, const double[:, :, ::1] series, int k, Local *out) noexcept nogil
cdef int sound(const double[:, :, ::1] axes, const double[:, :, ::1] series, int n) except -1
cdef void evaluate(
    const Local *psf, const double *dx, const double *dy, int n, double *value, double *by_x, double *by_y
) noexcept nogil
cdef void values(const Local *psf, const double *dx, const double *dy, int n, double *value) noexcept nogil
cdef void scaled(const Local *psf, const double *dx, const double *dy, int n, double *u, double *v, double *gauss) noexcept nogil
cdef void terms_at(
    const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out, int apart
) noexcept nogil
