# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# What fits of one star and of two have in common.

from libc.math cimport sqrt

cdef enum:
    # Parameters: x, y, flux, and a gain for each phase of a mosaic.
    MOST = 7
    PHASES = 4


cdef class Rules:
    cdef int phases, own, parameters
    cdef double[PHASES] gain
    cdef double held, dn_per_photon, misfit2, widths2, outlier2, faint, settled


cdef inline bint is_settled(double length, double before, Rules rules) noexcept nogil:
    """Whether a step of this length (sigmas) after another one is the last: the next ones are shorter by the same factor."""
    # the first steps may shrink faster than later ones
    return length < 0.05 and length * length < rules.settled * before


cdef inline void rows_within(const double *axes, double left, double top, int size, double widths2, int *bound) noexcept nogil:
    """Set of each row of a stamp the first column within so many squared widths of a star, and the one after the last.

    axes (2, 2) of the PSF; left, top: of the stamp's first pixel from the star, px
    """
    cdef double xx = axes[0] * axes[0] + axes[2] * axes[2], yy = axes[1] * axes[1] + axes[3] * axes[3]
    cdef double lean = (axes[0] * axes[1] + axes[2] * axes[3]) / xx, middle, reach2, reach, first, last
    cdef int row
    for row in range(size):
        middle, reach2 = -lean * (top + row), (widths2 - yy * (top + row) * (top + row)) / xx
        reach2 += middle * middle
        if not reach2 > 0:
            bound[2 * row] = bound[2 * row + 1] = 0
            continue
        reach = sqrt(reach2)
        first, last = max(0.0, min(middle - reach - left, size)), max(0.0, min(middle + reach - left + 1, size))
        bound[2 * row], bound[2 * row + 1] = <int>first, <int>last
        bound[2 * row] += bound[2 * row] < first


cdef inline int first_of_phase(const unsigned char *phase, int column, int last, int wanted) noexcept nogil:
    """The first column of a row that has this phase, from one on; `last` if none before it has. Phases alternate."""
    if column < last and phase[column] != wanted:
        column += 1
    return column if column < last and phase[column] == wanted else last


cdef int sound_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1
