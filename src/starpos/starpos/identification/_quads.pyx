# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Quads of the sky that look like quads of a frame, looked up in the bins of their shapes and sizes."""

import numpy as np

cdef enum:
    # Sides of a shape, and those of them that have bins.
    ALL_SIDES = 5
    BINNED = 4


cdef inline int _bin(double share, int bins) noexcept nogil:
    """The bin of a value from 0 to 1; of one beyond, the first or last."""
    return <int>(max(0.0, min(share * bins, bins - 1.0)))


def near(
    const int[::1] bin_start, const unsigned short[:, ::1] shape, const float[::1] log_size,
    const double[:, ::1] wanted, const double[::1] tolerance, const double[::1] wanted_size, double size_tolerance,
    int codes, int bins, int size_bins, double smallest, double largest, Py_ssize_t most,
):
    """Pairs of query and quad (2, M) that are alike: shape and size within their tolerances; at most so many.

    bin_start, shape, log_size  of a `QuadCatalogue`, and how its shapes and sizes are kept: codes, bins, size_bins,
                                smallest and largest logarithm of a size
    wanted, tolerance           (N, 5) shapes, as shares of the longest side, and how far off (N,) each side may be
    wanted_size, size_tolerance (N,) logarithms of the longest sides, and how far off they may be
    """
    cdef Py_ssize_t n = len(wanted), q, run, count = 0
    cdef int[BINNED] low, high
    cdef double[ALL_SIDES] least, greatest
    cdef int a, b, c, d, i, k, first, last
    cdef double per_bin = 1 / (largest - smallest)
    if not (wanted.shape[1] == shape.shape[1] == ALL_SIDES and len(tolerance) == len(wanted_size) == n):
        raise ValueError("shapes, tolerances and sizes of different lengths")
    if len(bin_start) != bins**BINNED * size_bins + 1 or not len(shape) == len(log_size) == bin_start[len(bin_start) - 1]:
        raise ValueError("the bins do not fit the quads")
    found = np.empty((2, most), np.intp)
    cdef Py_ssize_t[:, ::1] pair = found
    with nogil:
        for q in range(n):
            for i in range(ALL_SIDES):
                least[i], greatest[i] = (wanted[q, i] - tolerance[q]) * codes, (wanted[q, i] + tolerance[q]) * codes
            for i in range(BINNED):
                low[i], high[i] = _bin(least[i] / codes, bins), _bin(greatest[i] / codes, bins)
            first = _bin((wanted_size[q] - size_tolerance - smallest) * per_bin, size_bins)
            last = _bin((wanted_size[q] + size_tolerance - smallest) * per_bin, size_bins)
            for a in range(low[0], high[0] + 1):
                for b in range(low[1], high[1] + 1):
                    for c in range(low[2], high[2] + 1):
                        for d in range(low[3], high[3] + 1):
                            run = <Py_ssize_t>(((a * bins + b) * bins + c) * bins + d) * size_bins
                            for k in range(bin_start[run + first], bin_start[run + last + 1]):
                                if count < most and _alike(&shape[k, 0], least, greatest) and (
                                    -size_tolerance <= log_size[k] - wanted_size[q] <= size_tolerance
                                ):
                                    pair[0, count], pair[1, count] = q, k
                                    count += 1
            if count == most:
                break
    return found[:, :count]


cdef inline bint _alike(const unsigned short *shape, const double *least, const double *greatest) noexcept nogil:
    """Whether all sides lie within their bounds."""
    cdef int i
    for i in range(ALL_SIDES):
        if not least[i] <= shape[i] <= greatest[i]:
            return False
    return True
