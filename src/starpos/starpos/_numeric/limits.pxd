# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False
# Whether numbers that come from Python lie where they must (a library takes longer to begin than to look), and what is on a frame.

ctypedef unsigned char unsigned_char

ctypedef fused number_t:
    unsigned_char
    int
    Py_ssize_t
    double


cdef inline bint within(const number_t *v, Py_ssize_t n, number_t least, number_t most) noexcept nogil:
    """Whether all of n numbers are from the least to the most."""
    cdef bint all_ = True
    cdef Py_ssize_t k
    for k in range(n):
        all_ &= least <= v[k] <= most
    return all_


cdef inline Py_ssize_t inside(Py_ssize_t k, Py_ssize_t n) noexcept nogil:
    """The row or column of n that is nearest to k."""
    return max(0, min(k, n - 1))
