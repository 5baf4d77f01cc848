# SPDX-License-Identifier: Apache-2.0
# Loops over pixels with wider registers where the machine that runs has them, for the other modules here.

cdef extern from *:
    """
    /* Chosen when the module is loaded: WIDE with the same results, FUSED with products and sums rounded once, not twice.
       Of those that stand in a .pxd a module may use a few. */
    #if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
    #define STARPOS_WIDE __attribute__((unused, target_clones("avx2", "default")))
    #elif defined(__GNUC__)
    #define STARPOS_WIDE __attribute__((unused))
    #else
    #define STARPOS_WIDE
    #endif
    #if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
    #define STARPOS_FUSED __attribute__((unused, target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
    #else
    #define STARPOS_FUSED STARPOS_WIDE
    #endif
    /* Numbers that are added and multiplied at once. */
    typedef double starpos_lanes __attribute__((vector_size(32), aligned(8)));
    typedef float starpos_eights __attribute__((vector_size(32), aligned(4)));
    /* Put e to the power of each of n numbers in its place, to 3e-16 of it; beyond +-700 as there.
       Unlike libm's it takes wide registers. */
    static inline void starpos_exps(double *x, int n) {
        /* added to a number it leaves a whole one, in the lowest bits */
        const double rounds = 6755399441055744.0;
        /* a loop of its own: else the compiler makes branches of it */
        for (int p = 0; p < n; p++) {
            x[p] = x[p] < -700 ? -700 : x[p];
            x[p] = x[p] > 700 ? 700 : x[p];
        }
        for (int p = 0; p < n; p++) {
            const double shifted = x[p] * 1.4426950408889634 + rounds, twos = shifted - rounds;
            /* the logarithm of 2 in two parts, the first of few bits */
            const double r = (x[p] - twos * 0.693145751953125) - twos * 1.4286068203094172e-06;
            double sum = 1.0 / 6227020800, power;
            unsigned long long bits;
            sum = sum * r + 1.0 / 479001600;
            sum = sum * r + 1.0 / 39916800;
            sum = sum * r + 1.0 / 3628800;
            sum = sum * r + 1.0 / 362880;
            sum = sum * r + 1.0 / 40320;
            sum = sum * r + 1.0 / 5040;
            sum = sum * r + 1.0 / 720;
            sum = sum * r + 1.0 / 120;
            sum = sum * r + 1.0 / 24;
            sum = sum * r + 1.0 / 6;
            sum = sum * r + 0.5;
            sum = sum * r + 1;
            sum = sum * r + 1;
            memcpy(&bits, &shifted, sizeof bits);
            bits = (bits + 1023) << 52;
            memcpy(&power, &bits, sizeof power);
            x[p] = sum * power;
        }
    }
    """
    # What functions return whose loops take wide registers: nothing.
    ctypedef void wide_void "STARPOS_WIDE void"
    ctypedef void fused_void "STARPOS_FUSED void"
    # Sums of several pixels side by side, which a compiler left to itself takes one by one. To Cython a number, to C four or eight.
    ctypedef double lanes "starpos_lanes"
    ctypedef float eights "starpos_eights"


cdef inline double sum_of(const lanes *v) noexcept nogil:
    """The sum of four lanes."""
    cdef const double *x = <const double *>v
    return (x[0] + x[1]) + (x[2] + x[3])
