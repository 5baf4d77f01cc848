# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Which of many points are near each other."""

import numpy as np

from starpos._numeric.limits cimport within


def near_pairs(const double[::1] x, const double[::1] y, double reach):
    """All pairs (M, 2) of the points x, y (N,) that are not farther from each other than the reach, the lower number first.

    The points are sorted by y, so that each meets only those of a strip below it. What is not a number is near nothing.
    """
    if y.shape[0] != x.shape[0]:
        raise ValueError(f"{x.shape[0]} columns and {y.shape[0]} rows of points: as many are needed")
    cdef const Py_ssize_t[::1] order = np.argsort(y)
    cdef Py_ssize_t[:, ::1] pairs = None
    out = np.empty((_pairs(x, y, reach, order, pairs), 2), np.intp)
    pairs = out
    _pairs(x, y, reach, order, pairs)
    return out


cdef Py_ssize_t _pairs(
    const double[::1] x, const double[::1] y, double reach, const Py_ssize_t[::1] order, Py_ssize_t[:, ::1] pairs
) noexcept:
    """Write the pairs, unless they are None; how many there are."""
    cdef Py_ssize_t n = x.shape[0], count = 0, i, j, k, m
    cdef bint written = pairs is not None
    cdef double dx, dy
    for i in range(n):
        k = order[i]
        for j in range(i + 1, n):
            m = order[j]
            dx, dy = x[m] - x[k], y[m] - y[k]
            if not dy <= reach:
                break
            if not dx * dx + dy * dy <= reach * reach:
                continue
            if written:
                pairs[count, 0], pairs[count, 1] = min(k, m), max(k, m)
            count += 1
    return count


def group_points(const Py_ssize_t[:, ::1] pairs, Py_ssize_t n):
    """The number (N,) of each of n points' group: those that pairs (M, 2) of them join. Groups are numbered by their first point.

    As scipy's `connected_components`, which takes longer to begin, in every frame, than this does to end.
    """
    cdef Py_ssize_t k, a, b, count = 0
    if pairs.shape[1] != 2 or not within[Py_ssize_t](&pairs[0, 0], 2 * pairs.shape[0], 0, n - 1):
        raise ValueError(f"a pair is not of two of the {n} points")
    out = np.arange(n)
    cdef Py_ssize_t[::1] root = out
    with nogil:
        # the root of a group is its first point
        for k in range(pairs.shape[0]):
            a, b = _root(root, pairs[k, 0]), _root(root, pairs[k, 1])
            root[max(a, b)] = min(a, b)
        # by now what a point leads to has its number
        for k in range(n):
            if root[k] == k:
                root[k] = count
                count += 1
            else:
                root[k] = root[root[k]]
    return out


cdef Py_ssize_t _root(Py_ssize_t[::1] root, Py_ssize_t k) noexcept nogil:
    """The first point of a point's group; the way there is halved."""
    while root[k] != k:
        root[k] = root[root[k]]
        k = root[k]
    return k


def any_near(const double[::1] x, const double[::1] y, const double[::1] to_x, const double[::1] to_y, double reach):
    """Whether one of the points x, y (N,) is nearer than the reach to each of others (M,): (M,) bool.

    What is not a number is near nothing.
    """
    cdef Py_ssize_t n = x.shape[0], m = to_x.shape[0], k, low, high, half
    cdef double dx, dy
    if y.shape[0] != n or to_y.shape[0] != m:
        raise ValueError(f"{n} and {m} columns, {y.shape[0]} and {to_y.shape[0]} rows of points: as many are needed")
    out = np.zeros(m, np.uint8)
    cdef unsigned char[::1] found = out
    cdef const Py_ssize_t[::1] order = np.argsort(y)
    for k in range(m):
        # the first point that is not too far above
        low, high = 0, n
        while low < high:
            half = (low + high) // 2
            if not y[order[half]] <= to_y[k] - reach:
                high = half
            else:
                low = half + 1
        while low < n and y[order[low]] < to_y[k] + reach and not found[k]:
            dx, dy = x[order[low]] - to_x[k], y[order[low]] - to_y[k]
            found[k] = dx * dx + dy * dy < reach * reach
            low += 1
    return out.view(bool)
