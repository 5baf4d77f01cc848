# SPDX-License-Identifier: Apache-2.0
# The pixels of a star that is fitted, and sums over them, four at once.

cimport starpos._numeric.wide

cdef extern from *:
    """
    typedef double starpos_four __attribute__((vector_size(32)));
    typedef double starpos_fours __attribute__((vector_size(32), aligned(8)));
    /* Take n pixels of a row, each `step` (1 or 2) after the one before: light, squared noise, whether
       it is good and no outlier, place in the stamp from `place` on, and offset. */
    #define STARPOS_TAKE(step, k) {(k)[0], (k)[step], (k)[2 * step], (k)[3 * step]}
    #define STARPOS_TAKE_PIXELS(step) \
        for (; j + 4 <= n; j += 4) { \
            const int k = j * step; \
            const starpos_four light = STARPOS_TAKE(step, signal + k), sky = STARPOS_TAKE(step, noise + k); \
            const starpos_four sound = STARPOS_TAKE(step, good + k), far = STARPOS_TAKE(step, outlier + k); \
            *(starpos_fours *)(own_signal + j) = light; \
            *(starpos_fours *)(noise2 + j) = sky * sky; \
            *(starpos_fours *)(weight + j) = sound - sound * far; \
            *(starpos_fours *)(dx + j) = x + k + (starpos_four){0, step, 2 * step, 3 * step}; \
            *(starpos_fours *)(dy + j) = y + (starpos_four){0}; \
        } \
        for (int i = 0; i < n; i++) \
            places[i] = place + i * step;
    STARPOS_WIDE static void starpos_take(const float *signal, const float *noise, const unsigned char *good,
                                          const unsigned char *outlier, int place, int n, int step, double x, double y,
                                          int *places, double *dx, double *dy, double *own_signal, double *noise2,
                                          double *weight) {
        int j = 0;
        if (step == 1) {
            STARPOS_TAKE_PIXELS(1)
        } else {
            STARPOS_TAKE_PIXELS(2)
        }
        for (; j < n; j++) {
            const int k = j * step;
            own_signal[j] = signal[k];
            noise2[j] = (double)noise[k] * noise[k];
            weight[j] = good[k] & ~outlier[k];
            dx[j] = x + k;
            dy[j] = y;
        }
    }
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
    /* Sums over n pixels of their PSF squared and times the signal, with the weights over the sky's variance. */
    STARPOS_FUSED static void starpos_of_sky(const double *weight, const double *noise2, const double *f, const double *signal,
                                            int n, double *out) {
        starpos_four ff = {0}, fs = {0};
        for (int p = 0; p + 4 <= n; p += 4) {
            const starpos_four c = *(const starpos_fours *)(f + p);
            const starpos_four wc = *(const starpos_fours *)(weight + p) / *(const starpos_fours *)(noise2 + p) * c;
            ff += wc * c;
            fs += wc * *(const starpos_fours *)(signal + p);
        }
        out[0] = (ff[0] + ff[1]) + (ff[2] + ff[3]);
        out[1] = (fs[0] + fs[1]) + (fs[2] + fs[3]);
        for (int p = n / 4 * 4; p < n; p++) {
            out[0] += weight[p] / noise2[p] * f[p] * f[p];
            out[1] += weight[p] / noise2[p] * f[p] * signal[p];
        }
    }
    STARPOS_FUSED static double starpos_chi_square(const double *weight, const double *residual, int n) {
        starpos_four sums = {0};
        for (int p = 0; p + 4 <= n; p += 4) {
            const starpos_four r = *(const starpos_fours *)(residual + p);
            sums += *(const starpos_fours *)(weight + p) * r * r;
        }
        double sum = (sums[0] + sums[1]) + (sums[2] + sums[3]);
        for (int p = n / 4 * 4; p < n; p++)
            sum += weight[p] * residual[p] * residual[p];
        return sum;
    }
    /* Whether one of n pixels has no weight, or is above the model by more than so many squared sigmas. */
    STARPOS_WIDE static int starpos_any_bright(const double *weight, const double *residual, double limit2, int n) {
        long long any = 0;
        for (int p = 0; p < n; p++)
            any |= (weight[p] == 0) | ((residual[p] > 0) & (residual[p] * residual[p] * weight[p] > limit2));
        return any != 0;
    }
    /* Of each of n pixels the weight times a quadratic form xx, xy, yy, xf, yf, ff. */
    STARPOS_FUSED static void starpos_squares(const double *weight, const double *x, const double *y, const double *f,
                                             const double *form, int n, double *restrict out) {
        const double xx = form[0], xy = 2 * form[1], yy = form[2], xf = 2 * form[3], yf = 2 * form[4], ff = form[5];
        for (int p = 0; p < n; p++)
            out[p] = weight[p] * (x[p] * (xx * x[p] + xy * y[p] + xf * f[p]) + y[p] * (yy * y[p] + yf * f[p]) + ff * f[p] * f[p]);
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
    void take "starpos_take"(
        const float *signal, const float *noise, const unsigned char *good, const unsigned char *outlier, int place, int n,
        int step, double x, double y, int *places, double *dx, double *dy, double *own_signal, double *noise2, double *weight,
    ) noexcept nogil
    void weigh "starpos_weigh"(
        const double *signal, const double *noise2, const double *value, double flux, double dn_per_photon, double misfit2,
        int n, double *weight, double *residual,
    ) noexcept nogil
    void products "starpos_products"(
        const double *weight, const double *x, const double *y, const double *f, const double *r, int n, double *out
    ) noexcept nogil
    void of_sky "starpos_of_sky"(
        const double *weight, const double *noise2, const double *f, const double *signal, int n, double *out
    ) noexcept nogil
    double chi_square "starpos_chi_square"(const double *weight, const double *residual, int n) noexcept nogil
    bint any_bright "starpos_any_bright"(const double *weight, const double *residual, double limit2, int n) noexcept nogil
    void squares "starpos_squares"(
        const double *weight, const double *x, const double *y, const double *f, const double *form, int n, double *out
    ) noexcept nogil
