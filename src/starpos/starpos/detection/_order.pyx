# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Medians and quantiles of a few numbers, which a library takes longer to begin than to do."""

from libc.math cimport NAN, isnan
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.algebra cimport middle


def median(const double[::1] values):
    """The median of values (n,), as np.median has it; NaN of none, or if one is NaN."""
    cdef int n = values.shape[0], k
    cdef double found = NAN
    cdef double *copy = <double *>malloc(max(n, 1) * sizeof(double))
    if copy == NULL:
        raise MemoryError
    for k in range(n):
        copy[k] = values[k]
        if isnan(copy[k]):
            break
    else:
        if n:
            found = middle(copy, n)
    free(copy)
    return found


def quantile(const double[::1] values, double share):
    """The quantile of values (n,), n > 0, that has this share of them below it, as np.quantile has it."""
    cdef double place = share * (values.shape[0] - 1)
    cdef Py_ssize_t low
    if not (values.shape[0] and 0 <= share <= 1):
        raise ValueError(f"the quantile {share} of {values.shape[0]} values: there is none")
    low = <Py_ssize_t>place
    cdef double[::1] order = np.sort(values)
    return order[low] + (place - low) * (order[min(low + 1, values.shape[0] - 1)] - order[low])
