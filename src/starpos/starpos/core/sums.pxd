# SPDX-License-Identifier: Apache-2.0
# Sums over the pixels of a star that is fitted, four at once, for the fit.

cimport starpos.core.wide

cdef extern from *:
    """
    typedef double starpos_four __attribute__((vector_size(32)));
    typedef double starpos_fours __attribute__((vector_size(32), aligned(8)));
    /* What a star of this flux leaves of n pixels, and their weights over the variance of sky and light. */
    STARPOS_FUSED static void starpos_weigh(const double *restrict signal, const double *restrict noise2,
                                           const double *restrict value, double flux, double dn_per_photon, double misfit2,
                                           int n, double *restrict weight, double *restrict residual) {
        for (int p = 0; p < n; p++) {
            const double light = flux * value[p], some = light > 0 ? light : 0;
            residual[p] = signal[p] - light;
            weight[p] /= noise2[p] + dn_per_photon * some + misfit2 * some * some;
        }
    }
    /* Products with the weights, summed over n pixels: xx, xy, yy, xf, yf, ff, xr, yr, fr. */
    STARPOS_FUSED static void starpos_products(const double *weight, const double *x, const double *y, const double *f,
                                              const double *r, int n, double *out) {
        starpos_four xx = {0}, xy = {0}, yy = {0}, xf = {0}, yf = {0}, ff = {0}, xr = {0}, yr = {0}, fr = {0};
        for (int p = 0; p + 4 <= n; p += 4) {
            const starpos_four w = *(const starpos_fours *)(weight + p), a = *(const starpos_fours *)(x + p);
            const starpos_four b = *(const starpos_fours *)(y + p), c = *(const starpos_fours *)(f + p);
            const starpos_four wr = w * *(const starpos_fours *)(r + p), wa = w * a, wb = w * b;
            xx += wa * a;
            xy += wa * b;
            yy += wb * b;
            xf += wa * c;
            yf += wb * c;
            ff += w * c * c;
            xr += wr * a;
            yr += wr * b;
            fr += wr * c;
        }
        const starpos_four *sums[9] = {&xx, &xy, &yy, &xf, &yf, &ff, &xr, &yr, &fr};
        for (int k = 0; k < 9; k++)
            out[k] = ((*sums[k])[0] + (*sums[k])[1]) + ((*sums[k])[2] + (*sums[k])[3]);
        for (int p = n / 4 * 4; p < n; p++) {
            const double w = weight[p], wr = w * r[p], wa = w * x[p], wb = w * y[p];
            const double last[9] = {wa * x[p], wa * y[p], wb * y[p], wa * f[p], wb * f[p], w * f[p] * f[p],
                                    wr * x[p], wr * y[p], wr * f[p]};
            for (int k = 0; k < 9; k++)
                out[k] += last[k];
        }
    }
    """
    void weigh "starpos_weigh"(
        const double *signal, const double *noise2, const double *value, double flux, double dn_per_photon, double misfit2,
        int n, double *weight, double *residual,
    ) noexcept nogil
    void products "starpos_products"(
        const double *weight, const double *x, const double *y, const double *f, const double *r, int n, double *out
    ) noexcept nogil
