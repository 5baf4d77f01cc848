# SPDX-License-Identifier: Apache-2.0
# cython: cdivision=True

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


cdef int sound_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1
