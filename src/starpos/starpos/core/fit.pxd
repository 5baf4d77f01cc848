# SPDX-License-Identifier: Apache-2.0
# cython: cdivision=True

cdef enum:
    # Parameters: x, y, flux, and a gain for each phase of a mosaic.
    MOST = 7
    PHASES = 4


cdef class Rules:
    cdef int phases, own, parameters
    cdef double[PHASES] gain
    cdef double held, dn_per_photon, misfit2, widths2, outlier2, faint


cdef int sound_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1
