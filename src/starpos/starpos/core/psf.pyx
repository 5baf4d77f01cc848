# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The PSF of stars at pixels: a Gauss-Hermite series (`detection.psf`), its derivatives, and its single terms."""

from libc.math cimport M_PI, fabs, sqrt

import numpy as np

cimport starpos.core.wide

cdef extern from *:
    """
    #define STARPOS_BLOCK 64
    #define STARPOS_ORDERS 32
    /* Pixels that are summed in registers. */
    #define STARPOS_LANES 8
    /* Of 0, 1, 2 ...; set when the module is loaded. */
    static double starpos_root[STARPOS_ORDERS + 2];
    /* Hermite polynomials over sqrt(k!), k = 0 .. order, of n of a block's numbers u. */
    static inline void starpos_hermites(const double *u, int n, int order, double (*out)[STARPOS_BLOCK]) {
        for (int p = 0; p < n; p++) {
            out[0][p] = 1;
            out[1][p] = u[p];
        }
        for (int k = 1; k < order; k++) {
            const double before = starpos_root[k], over = 1 / starpos_root[k + 1];
            for (int p = 0; p < n; p++)
                out[k + 1][p] = (u[p] * out[k][p] - before * out[k - 1][p]) * over;
        }
    }
    /* The Gaussian of a peak at n of a block's places. */
    STARPOS_FUSED static void starpos_gauss(const double *u, const double *v, int n, double peak, double *restrict out) {
        for (int p = 0; p < n; p++)
            out[p] = -0.5 * (u[p] * u[p] + v[p] * v[p]);
        starpos_exps(out, n);
        for (int p = 0; p < n; p++)
            out[p] *= peak;
    }
    /* The sum of series[i, j] h_i(u) h_j(v) without the Gaussian, and what its derivatives by -u and -v are with it. */
    STARPOS_FUSED static void starpos_series(const double *series, int rows, int columns, const double *u, const double *v, int n,
                                            double *restrict value, double *restrict by_u, double *restrict by_v) {
        double fu[STARPOS_ORDERS + 1][STARPOS_BLOCK], fv[STARPOS_ORDERS + 1][STARPOS_BLOCK];
        starpos_hermites(u, n, rows, fu);
        starpos_hermites(v, n, columns, fv);
        for (int first = 0; first < n; first += STARPOS_LANES) {
            double sum[STARPOS_LANES] = {0}, sum_u[STARPOS_LANES] = {0}, sum_v[STARPOS_LANES] = {0};
            for (int i = 0; i < rows; i++) {
                double across[STARPOS_LANES] = {0}, steeper[STARPOS_LANES] = {0};
                for (int j = 0; j < columns; j++) {
                    const double c = series[i * columns + j], d = c * starpos_root[j + 1];
                    if (c == 0)
                        continue;
                    for (int p = 0; p < STARPOS_LANES; p++) {
                        across[p] += c * fv[j][first + p];
                        steeper[p] += d * fv[j + 1][first + p];
                    }
                }
                for (int p = 0; p < STARPOS_LANES; p++) {
                    sum[p] += fu[i][first + p] * across[p];
                    sum_u[p] += starpos_root[i + 1] * fu[i + 1][first + p] * across[p];
                    sum_v[p] += fu[i][first + p] * steeper[p];
                }
            }
            for (int p = 0; p < STARPOS_LANES; p++) {
                value[first + p] = sum[p];
                by_u[first + p] = sum_u[p];
                by_v[first + p] = sum_v[p];
            }
        }
    }
    /* The sum alone. */
    STARPOS_FUSED static void starpos_sum(const double *series, int rows, int columns, const double *u, const double *v, int n,
                                         double *restrict value) {
        double fu[STARPOS_ORDERS + 1][STARPOS_BLOCK], fv[STARPOS_ORDERS + 1][STARPOS_BLOCK];
        starpos_hermites(u, n, rows - 1, fu);
        starpos_hermites(v, n, columns - 1, fv);
        for (int first = 0; first < n; first += STARPOS_LANES) {
            double sum[STARPOS_LANES] = {0};
            for (int i = 0; i < rows; i++) {
                double across[STARPOS_LANES] = {0};
                for (int j = 0; j < columns; j++) {
                    const double c = series[i * columns + j];
                    if (c == 0)
                        continue;
                    for (int p = 0; p < STARPOS_LANES; p++)
                        across[p] += c * fv[j][first + p];
                }
                for (int p = 0; p < STARPOS_LANES; p++)
                    sum[p] += fu[i][first + p] * across[p];
            }
            for (int p = 0; p < STARPOS_LANES; p++)
                value[first + p] = sum[p];
        }
    }
    /* One term h_i(u) h_j(v) for each of so many orders (i, j), times the Gaussian. */
    STARPOS_WIDE static void starpos_terms(const int *orders, int count, int highest, const double *u, const double *v,
                                           const double *gauss, float *out) {
        double fu[STARPOS_ORDERS + 1][STARPOS_BLOCK], fv[STARPOS_ORDERS + 1][STARPOS_BLOCK];
        starpos_hermites(u, STARPOS_BLOCK, highest, fu);
        starpos_hermites(v, STARPOS_BLOCK, highest, fv);
        for (int t = 0; t < count; t++) {
            const double *a = fu[orders[2 * t]], *b = fv[orders[2 * t + 1]];
            for (int p = 0; p < STARPOS_BLOCK; p++)
                out[t * STARPOS_BLOCK + p] = (float)(a[p] * b[p] * gauss[p]);
        }
    }
    """
    double[ORDERS + 2] root "starpos_root"
    void gauss_at "starpos_gauss"(const double *u, const double *v, int n, double peak, double *out) noexcept nogil
    void series_at "starpos_series"(
        const double *series, int rows, int columns, const double *u, const double *v, int n, double *value,
        double *by_u, double *by_v,
    ) noexcept nogil
    void sum_at "starpos_sum"(
        const double *series, int rows, int columns, const double *u, const double *v, int n, double *value
    ) noexcept nogil
    void each_at "starpos_terms"(
        const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out
    ) noexcept nogil

for order in range(ORDERS + 2):
    root[order] = sqrt(order)


cdef int sound(const double[:, :, ::1] axes, const double[:, :, ::1] series, int n) except -1:
    """Raise ValueError unless axes (n or 1, 2, 2) and series (n or 1, I, J) have the shapes that `evaluate` needs."""
    if axes.shape[0] not in (1, n) or axes.shape[1] != 2 or axes.shape[2] != 2 or series.shape[0] not in (1, n):
        raise ValueError(f"{axes.shape[0]} axes and {series.shape[0]} series for {n} stars: each must be one or as many")
    if not (0 < series.shape[1] <= ORDERS and 0 < series.shape[2] <= ORDERS):
        raise ValueError(f"{series.shape[1]} x {series.shape[2]} terms of a PSF: at most {ORDERS} along an axis")
    return 0


cdef void local_of(const double[:, :, ::1] axes, const double[:, :, ::1] series, int k, Local *out) noexcept nogil:
    """Set `out` to the PSF of star k; a single PSF serves any star."""
    cdef int a = k if axes.shape[0] > 1 else 0, s = k if series.shape[0] > 1 else 0
    out.axes[0], out.axes[1], out.axes[2], out.axes[3] = axes[a, 0, 0], axes[a, 0, 1], axes[a, 1, 0], axes[a, 1, 1]
    out.peak = fabs(out.axes[0] * out.axes[3] - out.axes[1] * out.axes[2]) / (2 * M_PI)
    out.series, out.rows, out.columns = &series[s, 0, 0], <int>series.shape[1], <int>series.shape[2]


cdef void scaled(const Local *psf, const double *dx, const double *dy, int n, double *u, double *v, double *gauss) noexcept nogil:
    """Offsets (n,) px in widths of the PSF, and the Gaussian there; the rest of a block is finite."""
    cdef int p
    for p in range(n):
        u[p], v[p] = psf.axes[0] * dx[p] + psf.axes[1] * dy[p], psf.axes[2] * dx[p] + psf.axes[3] * dy[p]
    for p in range(n, BLOCK):
        u[p] = v[p] = gauss[p] = 0.0
    gauss_at(u, v, whole(n), psf.peak, gauss)


cdef void evaluate(
    const Local *psf, const double *dx, const double *dy, int n, double *value, double *by_x, double *by_y
) noexcept nogil:
    """The PSF at n offsets (px) from a star, and its derivatives by the star's x and y; room for whole blocks."""
    cdef double[BLOCK] u
    cdef double[BLOCK] v
    cdef double[BLOCK] gauss
    cdef double[BLOCK] by_u
    cdef double[BLOCK] by_v
    cdef int block, first, some, p
    for block in range(blocks(n)):
        first = block * BLOCK
        some = min(BLOCK, n - first)
        scaled(psf, dx + first, dy + first, some, u, v, gauss)
        series_at(psf.series, psf.rows, psf.columns, u, v, whole(some), value + first, by_u, by_v)
        for p in range(whole(some)):
            value[first + p] *= gauss[p]
            by_x[first + p] = (psf.axes[0] * by_u[p] + psf.axes[2] * by_v[p]) * gauss[p]
            by_y[first + p] = (psf.axes[1] * by_u[p] + psf.axes[3] * by_v[p]) * gauss[p]


cdef void values(const Local *psf, const double *dx, const double *dy, int n, double *value) noexcept nogil:
    """The PSF at n offsets (px) from a star; room for whole blocks."""
    cdef double[BLOCK] u
    cdef double[BLOCK] v
    cdef double[BLOCK] gauss
    cdef int block, first, some, p
    for block in range(blocks(n)):
        first = block * BLOCK
        some = min(BLOCK, n - first)
        scaled(psf, dx + first, dy + first, some, u, v, gauss)
        sum_at(psf.series, psf.rows, psf.columns, u, v, whole(some), value + first)
        for p in range(some):
            value[first + p] *= gauss[p]


cdef inline int _offsets(double left, double top, int size, int first, double *dx, double *dy) noexcept nogil:
    """Set the offsets (px) of a stamp's pixels from the first on, at most a block; how many."""
    cdef int n = min(BLOCK, size * size - first), p
    for p in range(n):
        dx[p], dy[p] = left + (first + p) % size, top + (first + p) // size
    return n


def evaluated(
    const double[:, :, ::1] axes, const double[:, :, ::1] series, const double[::1] left, const double[::1] top, int size
):
    """The PSFs of N stars at the pixels of their stamps, and the derivatives by the stars' x and y: (N, size, size) each.

    axes       (N, 2, 2) or (1, 2, 2), and
    series     (N, I, J) or (1, I, J): as `detection.psf.LocalPsf` has them
    left, top  (N,) px: of the first column and the first row from each star's centre
    """
    cdef int stars = left.shape[0], area = size * size, n, k, block, first, p, place
    cdef double[BLOCK] dx
    cdef double[BLOCK] dy
    cdef double[3][BLOCK] found
    cdef Local psf
    sound(axes, series, stars)
    if top.shape[0] != stars or size < 1:
        raise ValueError(f"{stars} stars, {top.shape[0]} rows, stamps of {size} px: as many rows as stars, and at least a pixel")
    out = np.empty((3, stars, size, size), np.float32)
    cdef float[:, :, ::1] image = out.reshape(3, stars, area)
    with nogil:
        for k in range(stars):
            local_of(axes, series, k, &psf)
            for block in range(blocks(area)):
                first = block * BLOCK
                n = _offsets(left[k], top[k], size, first, dx, dy)
                evaluate(&psf, dx, dy, n, found[0], found[1], found[2])
                for place in range(3):
                    for p in range(n):
                        image[place, k, first + p] = <float>found[place][p]
    return out[0], out[1], out[2]


cdef void terms_at(
    const int *orders, int count, int highest, const double *u, const double *v, const double *gauss, float *out
) noexcept nogil:
    """Set `out` (T, BLOCK) to single terms h_i(u) h_j(v) of a block's pixels, (i, j) in orders (T, 2), times the Gaussian."""
    each_at(orders, count, highest, u, v, gauss, out)
