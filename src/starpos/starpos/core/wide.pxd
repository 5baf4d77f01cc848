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
    """
