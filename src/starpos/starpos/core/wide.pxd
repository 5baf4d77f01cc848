# SPDX-License-Identifier: Apache-2.0
# Loops over pixels with wider registers where the machine that runs has them, for the other modules here.

cdef extern from *:
    """
    /* Chosen when the module is loaded, with the same results. */
    #if defined(__x86_64__) && defined(__GLIBC__) && defined(__GNUC__) && !defined(__clang__)
    #define STARPOS_WIDE __attribute__((target_clones("avx2", "default")))
    #else
    #define STARPOS_WIDE
    #endif
    #include <string.h>
    /* e to the power of x, to 3e-16 of it; beyond +-700 as there. Unlike libm's, loops over it take wide registers. */
    static inline double starpos_exp(double x) {
        /* added to a number it leaves a whole one, in the lowest bits */
        const double rounds = 6755399441055744.0;
        x = x < -700 ? -700 : x > 700 ? 700 : x;
        const double shifted = x * 1.4426950408889634 + rounds, twos = shifted - rounds;
        /* the logarithm of 2 in two parts, the first of few bits */
        const double r = (x - twos * 0.693145751953125) - twos * 1.4286068203094172e-06;
        double sum = 1.0 / 6227020800, power;
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
        unsigned long long bits;
        memcpy(&bits, &shifted, sizeof bits);
        bits = (bits + 1023) << 52;
        memcpy(&power, &bits, sizeof power);
        return sum * power;
    }
    """
