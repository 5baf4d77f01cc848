# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False
# Whether numbers and shapes that come from Python are as they must be (a library takes longer to begin than to look), and what
# is on a frame.

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


cdef inline int check_stamps(const Py_ssize_t *stamps, int number, const Py_ssize_t **others) except -1:
    """Raise ValueError unless arrays of pixels, so many of them, have the shape (N, S, S) of stamps."""
    cdef int k
    cdef const Py_ssize_t *shape
    for k in range(number):
        shape = others[k]
        if not (stamps[1] and shape[0] == stamps[0] and shape[1] == shape[2] == stamps[1] == stamps[2]):
            raise ValueError(
                f"pixels {(shape[0], shape[1], shape[2])} of stamps {(stamps[0], stamps[1], stamps[2])}: squares, as many, are needed"
            )
    return 0
