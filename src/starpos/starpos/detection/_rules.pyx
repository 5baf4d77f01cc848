# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What fits of stars go by, and what their stamps must be."""

import numpy as np

from starpos._numeric.limits cimport unsigned_char, within


cdef class Rules:
    """What fits go by: `detection.fit` explains each.

    gain                             (P,): of each phase, P = 1 or 4
    colour_spread                    of a star's gains, 1 sigma
    dn_per_photon, misfit            of the light's noise
    widths                           within which pixels are fitted
    outlier, faint                   sigmas, and the share of the star's brightest pixel, above which a pixel is one
    settled                          sigmas that a star may still be from where more rounds would bring it; 0: all are made
    """

    def __init__(
        self, gain, double colour_spread, double dn_per_photon, double misfit, double widths, double outlier, double faint,
        double settled,
    ):
        cdef int k
        if len(gain) not in (1, PHASES):
            raise ValueError(f"{len(gain)} gains: a frame has 1, a colour mosaic {PHASES}")
        self.phases, self.own = len(gain), len(gain) if len(gain) > 1 else 0
        self.parameters = 3 + self.own
        for k in range(self.phases):
            self.gain[k] = gain[k]
        self.held, self.dn_per_photon, self.misfit2 = colour_spread**-2, dn_per_photon, misfit * misfit
        self.widths2, self.outlier2, self.faint, self.settled = widths * widths, outlier * outlier, faint, settled


cdef int sound_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1:
    """Raise ValueError unless shapes and phases of stamps (N, S, S) are what a fit reads."""
    cdef Py_ssize_t n = signal.shape[0], size = signal.shape[1]
    for name, shape in (
        ("signal", (n, size, signal.shape[2])),
        ("noise", (noise.shape[0], noise.shape[1], noise.shape[2])),
        ("good", (good.shape[0], good.shape[1], good.shape[2])),
        ("phase", (phase.shape[0], phase.shape[1], phase.shape[2])),
    ):
        if shape != (n, size, size):
            raise ValueError(f"{name} has the shape {shape}; {(n, size, size)} is needed")
    if not within[unsigned_char](&phase[0, 0, 0], n * size * size, 0, rules.phases - 1):
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {rules.phases}")
    if rules.own and not _alternate(phase):
        raise ValueError("phases of a mosaic alternate along each row of a stamp")


cdef bint _alternate(const unsigned char[:, :, ::1] phase) noexcept nogil:
    """Whether each pixel has the phase of the next but one in its row."""
    cdef Py_ssize_t k, row, column
    cdef bint all_ = True
    for k in range(phase.shape[0]):
        for row in range(phase.shape[1]):
            for column in range(phase.shape[2] - 2):
                all_ &= phase[k, row, column] == phase[k, row, column + 2]
    return all_
