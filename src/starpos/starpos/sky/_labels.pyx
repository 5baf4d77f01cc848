# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Names and brightnesses of the catalogue's stars."""

from libc.string cimport memcpy

import numpy as np

from starpos._numeric.algebra cimport fetch
from starpos._numeric.memory cimport numbers_of

cdef enum:
    # Letters of a name, at most.
    LETTERS = 40


cdef class Labels:
    """Names and brightnesses of a catalogue's rows.

    hip, tyc  (N,), (N, 3): the Hipparcos number, and Tycho's three where that is 0
    vmag      (N,): V in 0.01 mag
    """

    cdef const int[::1] hip
    cdef const short[:, ::1] tyc
    cdef const short[::1] vmag

    def __init__(self, hip, tyc, vmag):
        self.hip, self.tyc = np.ascontiguousarray(hip, np.int32), np.ascontiguousarray(tyc, np.int16)
        self.vmag = np.ascontiguousarray(vmag, np.int16)

    def of(self, index):
        """The names of rows (n,), of numpy's intp, as a tuple, and their V (n,) in mag."""
        cdef Py_ssize_t k, row, n = len(index)
        cdef const Py_ssize_t *rows = <const Py_ssize_t *>numbers_of(index, n * sizeof(Py_ssize_t))
        cdef char[LETTERS] text
        cdef char *end = &text[LETTERS]
        cdef char *at
        names, magnitudes = [], np.empty(n)
        cdef double *mag = <double *>numbers_of(magnitudes, n * sizeof(double))
        for k in range(n):
            if not 0 <= rows[k] < self.hip.shape[0]:
                raise IndexError(f"the star catalogue has no row {rows[k]}")
            fetch(&self.vmag[rows[k]])
            fetch(&self.hip[rows[k]])
        for k in range(n):
            mag[k] = self.vmag[rows[k]] * 0.01
            if self.hip[rows[k]] == 0:
                fetch(&self.tyc[rows[k], 0])
        for k in range(n):
            row = rows[k]
            if self.hip[row]:
                at = _before(_written(self.hip[row], end), b"HIP ", 4)
            else:
                at = _before(_written(self.tyc[row, 2], end), b"-", 1)
                at = _before(_written(self.tyc[row, 1], at), b"-", 1)
                at = _before(_written(self.tyc[row, 0], at), b"TYC ", 4)
            names.append(at[:end - at].decode("ascii"))
        return tuple(names), magnitudes


cdef inline char *_written(int number, char *end) noexcept nogil:
    """Write the digits of a number before `end`; where they begin."""
    cdef unsigned int left = number if number >= 0 else -number
    while True:
        end -= 1
        end[0] = 48 + left % 10
        left //= 10
        if left == 0:
            break
    if number < 0:
        end -= 1
        end[0] = 45
    return end


cdef inline char *_before(char *end, const char *letters, int n) noexcept nogil:
    """Write n letters before `end`; where they begin."""
    return <char *>memcpy(end - n, letters, n)
