# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""A PSF at places of the field, over which its widths and its series may vary."""

from libc.math cimport fabs, isnan, sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.algebra cimport factored, middle, solved
from starpos.detection._shapes cimport Shape, clipped_to

cdef enum:
    # How many monomials describe a variation over the field.
    MONOMIALS = 6


cdef inline double _scaled(double place, double low, double high) noexcept nogil:
    """A coordinate from -1 to 1 over the box, and beyond it as on its edge; 0 for what is not a number."""
    cdef double scaled = 2 * (place - low) / max(high - low, 1.0) - 1
    return 0.0 if isnan(scaled) else max(-1.0, min(scaled, 1.0))


cdef inline void _monomials(double x, double y, const double[:, ::1] box, double *out) noexcept nogil:
    cdef double p = _scaled(x, box[0, 0], box[1, 0]), q = _scaled(y, box[0, 1], box[1, 1])
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, p, q, p * p - 1.0 / 3, p * q, q * q - 1.0 / 3


cdef int _sound(const double[::1] x, const double[::1] y, const double[:, ::1] box) except -1:
    if y.shape[0] != x.shape[0] or box.shape[0] != 2 or box.shape[1] != 2:
        raise ValueError(f"{x.shape[0]} columns and {y.shape[0]} rows in a box of {box.shape[0]} corners: as many, and 2")
    return 0


def monomials(const double[::1] x, const double[::1] y, const double[:, ::1] box):
    """Monomials (N, 6) of x, y (N,) scaled to -1..1 over the box (2, 2); all but the first have zero mean over it."""
    cdef Py_ssize_t k
    _sound(x, y, box)
    out = np.empty((x.shape[0], MONOMIALS))
    cdef double[:, ::1] each = out
    with nogil:
        for k in range(x.shape[0]):
            _monomials(x[k], y[k], box, &each[k, 0])
    return out


def local(
    const double[::1] x, const double[::1] y, const double[:, ::1] box, const double[:, ::1] axes,
    const double[:, :, ::1] widths, const double[:, :, ::1] series, double least, double most,
):
    """Axes (N, 2, 2) and series (N, I, J) of a PSF at the places x, y (N,), as `detection.psf.Psf` has them.

    What is the same everywhere comes once, (1, ...). Squared widths are at least and at most so much.
    """
    cdef Py_ssize_t n = x.shape[0], k, j, m, terms = series.shape[1] * series.shape[2]
    cdef double[MONOMIALS] here
    cdef Shape s
    _sound(x, y, box)
    for count in (widths.shape[0], series.shape[0]):
        if count not in (1, MONOMIALS):
            raise ValueError(f"{count} monomials: they are 1 or {MONOMIALS}")
    if (axes.shape[0], axes.shape[1], widths.shape[1], widths.shape[2]) != (2, 2, 2, 2):
        raise ValueError("axes and widths of 2 x 2 numbers are needed")
    cdef bint wide = widths.shape[0] > 1, varied = series.shape[0] > 1
    out = np.empty((n if wide else 1, 2, 2))
    shapes = np.zeros((n, series.shape[1], series.shape[2])) if varied else series
    cdef double[:, :, ::1] own = out
    cdef double[:, ::1] terms_of = shapes.reshape(n, terms) if varied else np.empty((0, 0))
    if not wide:
        own[0, :, :] = axes
    with nogil:
        for k in range(n if wide or varied else 0):
            _monomials(x[k], y[k], box, here)
            if wide:
                s = Shape(0.0, 0.0, 0.0)
                for m in range(MONOMIALS):
                    s.xx += here[m] * widths[m, 0, 0]
                    s.xy += here[m] * (widths[m, 0, 1] + widths[m, 1, 0]) / 2
                    s.yy += here[m] * widths[m, 1, 1]
                s = clipped_to(s, least, most, -0.5)
                for j in range(2):
                    own[k, 0, j] = s.xx * axes[0, j] + s.xy * axes[1, j]
                    own[k, 1, j] = s.xy * axes[0, j] + s.yy * axes[1, j]
            if varied:
                for m in range(MONOMIALS):
                    for j in range(terms):
                        terms_of[k, j] += here[m] * (&series[m, 0, 0])[j]
    return out, np.asarray(shapes)


def shapes_of(const double[:, :, ::1] axes):
    """Covariances (N, 2, 2) px2 of the Gaussians of PSFs with these axes (N, 2, 2)."""
    cdef Py_ssize_t k
    cdef double a, b, c, d, volume2
    if axes.shape[1] != 2 or axes.shape[2] != 2:
        raise ValueError(f"axes of {axes.shape[1]} x {axes.shape[2]} numbers: 2 x 2 are needed")
    out = np.empty((axes.shape[0], 2, 2))
    cdef double[:, :, ::1] shape = out
    with nogil:
        for k in range(axes.shape[0]):
            a, b, c, d = axes[k, 0, 0], axes[k, 0, 1], axes[k, 1, 0], axes[k, 1, 1]
            volume2 = (a * d - b * c) * (a * d - b * c)
            shape[k, 0, 0], shape[k, 1, 1] = (b * b + d * d) / volume2, (a * a + c * c) / volume2
            shape[k, 0, 1] = shape[k, 1, 0] = -(a * b + c * d) / volume2
    return out


cdef bint _over_field(
    const double[:, ::1] field, const double[:, ::1] own, const double *weight, double[:, ::1] out
) noexcept nogil:
    """Set coefficients of the monomials (6, V) to those of weighted least squares; False if there is no solution."""
    cdef double[MONOMIALS * MONOMIALS] normal
    cdef double[MONOMIALS] right
    cdef double trace = 0.0
    cdef Py_ssize_t k, v, n = field.shape[0]
    cdef int i, j
    for i in range(MONOMIALS):
        for j in range(i + 1):
            normal[i * MONOMIALS + j] = 0.0
            for k in range(n):
                normal[i * MONOMIALS + j] += weight[k] * field[k, i] * field[k, j]
        trace += normal[i * MONOMIALS + i]
    # what the places do not tell, as on a line, is 0
    for i in range(MONOMIALS):
        normal[i * MONOMIALS + i] += 1e-12 * trace
    if isnan(factored(normal, MONOMIALS)):
        return False
    for v in range(own.shape[1]):
        for i in range(MONOMIALS):
            right[i] = 0.0
            for k in range(n):
                right[i] += weight[k] * field[k, i] * own[k, v]
        solved(normal, right, MONOMIALS)
        for i in range(MONOMIALS):
            out[i, v] = right[i]
    return True


cdef int _sound_field(const double[:, ::1] field, const double[:, ::1] own) except -1:
    if field.shape[1] != MONOMIALS or own.shape[0] != field.shape[0]:
        raise ValueError(f"{own.shape[0]} rows at {field.shape[0]} places of {field.shape[1]} monomials: as many, of {MONOMIALS}")
    return 0


def over_field(const double[:, ::1] field, const double[:, ::1] own):
    """Coefficients (6, V) of monomials, field (N, 6), that fit values (N, V) best, or None if nothing does."""
    cdef Py_ssize_t k
    _sound_field(field, own)
    out = np.empty((MONOMIALS, own.shape[1]))
    cdef double[::1] weight = np.ones(max(field.shape[0], 1))
    return out if _over_field(field, own, &weight[0], out) else None


def agreed(const double[:, ::1] field, const double[:, ::1] own, const double[::1] weight, double outlying, int least, int rounds):
    """Coefficients as in `over_field`, with weights (N,), of the rows that agree: none is so many times farther off than the median.

    Returns also chi-square of their weighted mean and of the fit, and how many they are; None if fewer than the least.
    """
    cdef Py_ssize_t n = field.shape[0], values = own.shape[1], k, v
    cdef int round_, i, count = 0
    cdef bint same
    cdef double typical, one, total, mean, before = 0.0, after = 0.0
    _sound_field(field, own)
    if weight.shape[0] != n:
        raise ValueError(f"{weight.shape[0]} weights for {n} rows: as many are needed")
    if n < least:
        return None
    out = np.empty((MONOMIALS, values))
    cdef double[:, ::1] fitted = out
    # weights of the rows that are kept, how far each is off, and that to be sorted
    cdef double *kept = <double *>malloc(3 * n * sizeof(double))
    if kept == NULL:
        raise MemoryError
    cdef double *off = kept + n
    with nogil:
        for k in range(n):
            kept[k] = weight[k]
        for round_ in range(rounds):
            if not _over_field(field, own, kept, fitted):
                count = 0
                break
            for k in range(n):
                off[k] = 0.0
                for v in range(values):
                    one = own[k, v]
                    for i in range(MONOMIALS):
                        one -= field[k, i] * fitted[i, v]
                    off[k] = max(off[k], sqrt(weight[k]) * fabs(one))
                off[n + k] = off[k]
            typical, count, same = middle(off + n, <int>n), 0, True
            for k in range(n):
                one = weight[k] if off[k] < outlying * typical else 0.0
                same, kept[k] = same and one == kept[k], one
                count += one > 0
            if count < least or same:
                break
        for v in range(values):
            mean = total = 0.0
            for k in range(n):
                mean += kept[k] * own[k, v]
                total += kept[k]
            mean /= total
            for k in range(n):
                one = own[k, v]
                for i in range(MONOMIALS):
                    one -= field[k, i] * fitted[i, v]
                before += kept[k] * (own[k, v] - mean) ** 2
                after += kept[k] * one * one
    free(kept)
    return (out, before, after, count) if count >= least else None
