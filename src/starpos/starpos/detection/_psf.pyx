# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The PSF of stars: at places of the field, over which it may vary, and at pixels: a Gauss-Hermite series (`detection.psf`)."""

from libc.math cimport M_PI, fabs, isnan, sqrt

import numpy as np

from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport fused_void
from starpos.detection._shapes cimport Shape, clipped_to

cdef extern from *:
    """
    /* In C because Cython has no constants of several numbers: pixels one by one take 2.5 times the instructions here, a sixth more
       in all for a frame of 5 megapixels with 315 stars, and a third more for one with 1500. */
    #define STARPOS_ORDERS 32
    /* Pixels that are summed in a register, which a compiler left to itself takes one by one; steps of these in a block, and
       of these so many side by side. */
    #define STARPOS_LANES 4
    #define STARPOS_STEPS 16
    #define STARPOS_ABREAST 2
    typedef double starpos_four __attribute__((vector_size(32)));
    typedef double starpos_fours __attribute__((vector_size(32), aligned(8)));
    /* Of 0, 1, 2 ..., and 1 over them; set when the module is loaded. */
    static double starpos_root[STARPOS_ORDERS + 2], starpos_over_root[STARPOS_ORDERS + 2];
    /* Hermite polynomials over sqrt(k!), k = 0 .. order, of so many steps of numbers u. */
    static inline void starpos_hermites(const starpos_four *u, int steps, int order, starpos_four (*out)[STARPOS_STEPS]) {
        const starpos_four one = {1, 1, 1, 1};
        for (int s = 0; s < steps; s++) {
            out[0][s] = one;
            out[1][s] = u[s];
        }
        for (int k = 1; k < order; k++) {
            const double before = starpos_root[k], over = starpos_over_root[k + 1];
            for (int s = 0; s < steps; s++)
                out[k + 1][s] = (u[s] * out[k][s] - before * out[k - 1][s]) * over;
        }
    }
    /* n offsets, at most a block, in widths, and the Gaussian there; the last steps abreast are filled up with the star's
       middle. How many steps they are. */
    static inline int starpos_places(const double *axes, double peak, const double *dx, const double *dy, int n, double *u,
                                     double *v, double *gauss) {
        const int abreast = STARPOS_ABREAST * STARPOS_LANES, whole = (n + abreast - 1) / abreast * abreast;
        for (int p = 0; p < n; p++) {
            u[p] = axes[0] * dx[p] + axes[1] * dy[p];
            v[p] = axes[2] * dx[p] + axes[3] * dy[p];
        }
        for (int p = n; p < whole; p++)
            u[p] = v[p] = 0;
        for (int p = 0; p < whole; p++)
            gauss[p] = -0.5 * (u[p] * u[p] + v[p] * v[p]);
        starpos_exps(gauss, whole);
        for (int p = 0; p < whole; p++)
            gauss[p] *= peak;
        return whole / STARPOS_LANES;
    }
    STARPOS_FUSED static void starpos_scaled(const double *axes, double peak, const double *dx, const double *dy, int n,
                                            double *u, double *v, double *gauss) {
        starpos_places(axes, peak, dx, dy, n, u, v, gauss);
    }
    /* The sum of term[t] h_i(u) h_j(v) times the Gaussian, and its derivatives by the star's x and y. Those of row i are the
       terms from first[i] on, j is column[t], and slope[t] is term[t] sqrt(j + 1). */
    STARPOS_FUSED static void starpos_evaluate(const double *axes, double peak, int rows, int columns, const int *first,
                                              const int *column, const double *term, const double *slope, const double *dx,
                                              const double *dy, int n, double *value, double *by_x, double *by_y) {
        starpos_four u[STARPOS_STEPS], v[STARPOS_STEPS], gauss[STARPOS_STEPS];
        starpos_four fu[STARPOS_ORDERS + 1][STARPOS_STEPS], fv[STARPOS_ORDERS + 1][STARPOS_STEPS];
        const int steps = starpos_places(axes, peak, dx, dy, n, (double *)u, (double *)v, (double *)gauss);
        starpos_hermites(u, steps, rows, fu);
        starpos_hermites(v, steps, columns, fv);
        for (int s = 0; s < steps; s += STARPOS_ABREAST) {
            starpos_four sum[STARPOS_ABREAST] = {{0}}, by_u[STARPOS_ABREAST] = {{0}}, by_v[STARPOS_ABREAST] = {{0}};
            for (int i = 0; i < rows; i++) {
                starpos_four across[STARPOS_ABREAST] = {{0}}, steeper[STARPOS_ABREAST] = {{0}};
                if (first[i] == first[i + 1])
                    continue;
                for (int t = first[i]; t < first[i + 1]; t++)
                    for (int k = 0; k < STARPOS_ABREAST; k++) {
                        across[k] += term[t] * fv[column[t]][s + k];
                        steeper[k] += slope[t] * fv[column[t] + 1][s + k];
                    }
                for (int k = 0; k < STARPOS_ABREAST; k++) {
                    sum[k] += fu[i][s + k] * across[k];
                    by_u[k] += starpos_root[i + 1] * fu[i + 1][s + k] * across[k];
                    by_v[k] += fu[i][s + k] * steeper[k];
                }
            }
            for (int k = 0; k < STARPOS_ABREAST; k++) {
                ((starpos_fours *)value)[s + k] = sum[k] * gauss[s + k];
                ((starpos_fours *)by_x)[s + k] = (axes[0] * by_u[k] + axes[2] * by_v[k]) * gauss[s + k];
                ((starpos_fours *)by_y)[s + k] = (axes[1] * by_u[k] + axes[3] * by_v[k]) * gauss[s + k];
            }
        }
    }
    """
    double[ORDERS + 2] root "starpos_root"
    double[ORDERS + 2] over_root "starpos_over_root"
    void scaled_at "starpos_scaled"(
        const double *axes, double peak, const double *dx, const double *dy, int n, double *u, double *v, double *gauss
    ) noexcept nogil
    void evaluate_at "starpos_evaluate"(
        const double *axes, double peak, int rows, int columns, const int *first, const int *column, const double *term,
        const double *slope, const double *dx, const double *dy, int n, double *value, double *by_x, double *by_y,
    ) noexcept nogil

for order in range(ORDERS + 2):
    root[order] = sqrt(order)
    over_root[order] = 1 / sqrt(max(order, 1))


cdef int sound(const double[:, :, ::1] axes, const double[:, :, ::1] series, int n) except -1:
    """Raise ValueError unless axes (n or 1, 2, 2) and series (n or 1, I, J) have the shapes that `evaluate` needs."""
    if axes.shape[0] not in (1, n) or axes.shape[1] != 2 or axes.shape[2] != 2 or series.shape[0] not in (1, n):
        raise ValueError(f"{axes.shape[0]} axes and {series.shape[0]} series for {n} stars: each must be one or as many")
    if not (0 < series.shape[1] <= ORDERS and 0 < series.shape[2] <= ORDERS):
        raise ValueError(f"{series.shape[1]} x {series.shape[2]} terms of a PSF: at most {ORDERS} along an axis")
    return 0


cdef void local_of(const double[:, :, ::1] axes, const double[:, :, ::1] series, int k, Local *out) noexcept nogil:
    """Set `out` to the PSF of star k; a single PSF serves any star."""
    cdef int a = k if axes.shape[0] > 1 else 0, s = k if series.shape[0] > 1 else 0, i, j, count = 0
    out.axes[0], out.axes[1], out.axes[2], out.axes[3] = axes[a, 0, 0], axes[a, 0, 1], axes[a, 1, 0], axes[a, 1, 1]
    out.peak = fabs(out.axes[0] * out.axes[3] - out.axes[1] * out.axes[2]) / (2 * M_PI)
    out.rows, out.columns = <int>series.shape[1], <int>series.shape[2]
    for i in range(out.rows):
        out.first[i] = count
        for j in range(out.columns):
            # most are 0
            if series[s, i, j] != 0:
                out.column[count], out.term[count], out.slope[count] = j, series[s, i, j], series[s, i, j] * root[j + 1]
                count += 1
    out.first[out.rows] = count


cdef void scaled(const Local *psf, const double *dx, const double *dy, int n, double *u, double *v, double *gauss) noexcept nogil:
    """Offsets (n,) px in widths of the PSF, and the Gaussian there; the rest of a block is finite."""
    cdef int p
    scaled_at(psf.axes, psf.peak, dx, dy, n, u, v, gauss)
    for p in range(n, BLOCK):
        u[p] = v[p] = gauss[p] = 0.0


cdef void evaluate(
    const Local *psf, const double *dx, const double *dy, int n, double *value, double *by_x, double *by_y
) noexcept nogil:
    """The PSF at n offsets (px) from a star, and its derivatives by the star's x and y; room for whole blocks."""
    cdef int block, first
    for block in range(blocks(n)):
        first = block * BLOCK
        evaluate_at(
            psf.axes, psf.peak, psf.rows, psf.columns, psf.first, psf.column, psf.term, psf.slope, dx + first, dy + first,
            min(BLOCK, n - first), value + first, by_x + first, by_y + first,
        )


cdef void values(const Local *psf, const double *dx, const double *dy, int n, double *value) noexcept nogil:
    """The PSF at n offsets (px) from a star; room for whole blocks."""
    cdef int block, first
    cdef double[BLOCK] by_x
    cdef double[BLOCK] by_y
    for block in range(blocks(n)):
        first = block * BLOCK
        evaluate(psf, dx + first, dy + first, min(BLOCK, n - first), value + first, by_x, by_y)


def evaluated(
    const double[:, :, ::1] axes, const double[:, :, ::1] series, const double[::1] left, const double[::1] top, int size
):
    """The PSFs of N stars at the pixels of their stamps: (N, size, size) float32.

    axes       (N, 2, 2) or (1, 2, 2), and
    series     (N, I, J) or (1, I, J): as `detection.psf.LocalPsf` has them
    left, top  (N,) px: of the first column and the first row from each star's centre
    """
    cdef int stars = left.shape[0], area = size * size, k, row, column, n
    cdef Local psf
    sound(axes, series, stars)
    if top.shape[0] != stars or size < 1:
        raise ValueError(f"{stars} stars, {top.shape[0]} rows, stamps of {size} px: as many rows as stars, and at least a pixel")
    out = np.empty((stars, size, size), np.float32)
    cdef float[:, ::1] image = out.reshape(stars, area)
    cdef int room = blocks(area) * BLOCK
    columns = room_for(3 * room * sizeof(double))
    cdef double *dx = <double *>start_of(columns)
    cdef double *dy = dx + room
    cdef double *value = dx + 2 * room
    with nogil:
        for k in range(stars):
            local_of(axes, series, k, &psf)
            n = 0
            for row in range(size):
                for column in range(size):
                    dx[n], dy[n] = left[k] + column, top[k] + row
                    n += 1
            values(&psf, dx, dy, area, value)
            for n in range(area):
                image[k, n] = <float>value[n]
    return out


cdef inline void _hermites(const double *u, int order, double *out) noexcept nogil:
    """Hermite polynomials over sqrt(k!), k = 0 .. order, of a block of numbers u: (order + 1, BLOCK)."""
    cdef int k, p
    cdef double before, over
    cdef double *own
    for p in range(BLOCK):
        out[p], out[BLOCK + p] = 1.0, u[p]
    for k in range(1, order):
        own, before, over = out + k * BLOCK, root[k], over_root[k + 1]
        for p in range(BLOCK):
            own[BLOCK + p] = (u[p] * own[p] - before * own[p - BLOCK]) * over


cdef fused_void _terms(
    const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out, int apart
) noexcept nogil:
    """What `terms_at` does."""
    cdef double[(ORDERS + 1) * BLOCK] fu
    cdef double[(ORDERS + 1) * BLOCK] fv
    cdef const double *a
    cdef const double *b
    cdef int t, p
    _hermites(u, highest, fu)
    _hermites(v, highest, fv)
    for t in range(count):
        a, b = fu + orders[2 * t] * BLOCK, fv + orders[2 * t + 1] * BLOCK
        for p in range(BLOCK):
            out[t * apart + p] = <float>(a[p] * b[p] * gauss[p])


cdef void terms_at(
    const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out, int apart
) noexcept nogil:
    """Set rows of `out`, so far apart, to terms h_i(u) h_j(v) of a block's pixels times the Gaussian; (i, j) in orders (T, 2)."""
    _terms(orders, count, highest, u, v, gauss, out, apart)


cdef inline double _in_box(double place, double low, double high) noexcept nogil:
    """A coordinate from -1 to 1 over the box, and beyond it as on its edge; 0 for what is not a number."""
    cdef double scaled = 2 * (place - low) / max(high - low, 1.0) - 1
    return 0.0 if isnan(scaled) else max(-1.0, min(scaled, 1.0))


cdef inline void _monomials(double x, double y, const double[:, ::1] box, double *out) noexcept nogil:
    cdef double p = _in_box(x, box[0, 0], box[1, 0]), q = _in_box(y, box[0, 1], box[1, 1])
    out[0], out[1], out[2], out[3], out[4], out[5] = 1.0, p, q, p * p - 1.0 / 3, p * q, q * q - 1.0 / 3


cdef int _check_box(const double[::1] x, const double[::1] y, const double[:, ::1] box) except -1:
    if y.shape[0] != x.shape[0] or box.shape[0] != 2 or box.shape[1] != 2:
        raise ValueError(f"{x.shape[0]} columns and {y.shape[0]} rows in a box of {box.shape[0]} corners: as many, and 2")
    return 0


def monomials(const double[::1] x, const double[::1] y, const double[:, ::1] box):
    """Monomials (N, 6) of x, y (N,) scaled to -1..1 over the box (2, 2); all but the first have zero mean over it."""
    cdef Py_ssize_t k
    _check_box(x, y, box)
    out = np.empty((x.shape[0], MONOMIALS))
    cdef double[:, ::1] each = out
    with nogil:
        for k in range(x.shape[0]):
            _monomials(x[k], y[k], box, &each[k, 0])
    return out


def psf_at(
    const double[::1] x, const double[::1] y, const double[:, ::1] box, const double[:, ::1] axes,
    const double[:, :, ::1] widths, const double[:, :, ::1] series, double least, double most,
):
    """Axes (N, 2, 2) and series (N, I, J) of a PSF at the places x, y (N,), as `detection.psf.Psf` has them.

    What is the same everywhere comes once, (1, ...). Squared widths are at least and at most so much.
    """
    cdef Py_ssize_t n = x.shape[0], k, j, m, terms = series.shape[1] * series.shape[2]
    cdef double[MONOMIALS] here
    cdef Shape s
    _check_box(x, y, box)
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
