# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Refraction of directions in the local level, both ways, and how it turns with them."""

from libc.math cimport cos, sin

import numpy as np

from starpos._numeric.algebra cimport length


cdef class Refraction:
    """Refraction a tan z + b tan^3 z, in rad, at the observed zenith distance z (ERFA's eraRefco).

    least_up: cosine of the zenith distance beyond which it does not grow.
    """

    def __init__(self, double a, double b, double least_up):
        self.a, self.b, self.least_up = a, b, least_up

    def __reduce__(self):
        return Refraction, (self.a, self.b, self.least_up)

    def bend(self, v):
        """Observed directions (..., 3) of unrefracted ones v (..., 3), both in L."""
        cdef const double[:, ::1] given = np.ascontiguousarray(v, float).reshape(-1, 3)
        out = np.empty((given.shape[0], 3))
        cdef double[:, ::1] to = out
        cdef Py_ssize_t k
        for k in range(given.shape[0]):
            self.raise_one(&given[k, 0], &to[k, 0])
        return out.reshape(np.shape(v))

    def unbend(self, u):
        """Unrefracted directions (..., 3) of observed ones u (..., 3), both in L."""
        cdef const double[:, ::1] given = np.ascontiguousarray(u, float).reshape(-1, 3)
        out = np.empty((given.shape[0], 3))
        cdef double[:, ::1] to = out
        cdef Py_ssize_t k
        for k in range(given.shape[0]):
            self.lower_one(&given[k, 0], &to[k, 0])
        return out.reshape(np.shape(u))

    cdef void raise_one(self, const double *v, double *out) noexcept nogil:
        """Set `out` (3,) to the observed direction of v (3,) in L: one step of Newton's method, as ERFA's eraAtioq."""
        cdef double flat = max(length(v[0], v[1]), 1e-12), up = max(v[2], self.least_up), tan = flat / up
        cdef double w = self.b * tan * tan
        raised(v, flat, (self.a + w) * tan / (1 + (self.a + 3 * w) / (up * up)), out)

    cdef void lower_one(self, const double *u, double *out) noexcept nogil:
        """Set `out` (3,) to the unrefracted direction of u (3,) in L."""
        cdef double flat = max(length(u[0], u[1]), 1e-12), tan = flat / max(u[2], self.least_up)
        raised(u, flat, -(self.a + self.b * tan * tan) * tan, out)

    cdef void bend_slopes(self, const double *v, const double *u, double *slope) noexcept nogil:
        """Set slope (3, 3) to the derivatives of u (3,), what v (3,) is bent to, by small rotations of v about L's axes."""
        cdef double flat = max(length(v[0], v[1]), 1e-12), up = max(v[2], self.least_up), tan = flat / up
        cdef double w = self.b * tan * tan, above = (self.a + w) * tan, below = 1 + (self.a + 3 * w) / (up * up)
        # by the zenith distance
        cdef double up_falls = flat if v[2] > self.least_up else 0.0
        cdef double tan_grows = (v[2] * up + flat * up_falls) / (up * up)
        cdef double above_grows = (self.a + 3 * w) * tan_grows
        cdef double below_grows = 6 * self.b * tan * tan_grows / (up * up) + 2 * (below - 1) / up * up_falls
        cdef double nearer = 1 - (above_grows * below - above * below_grows) / (below * below)
        cdef double seen = length(u[0], u[1]), shrink = max(seen, 1e-12) / flat
        # at the zenith any azimuth will do
        cdef double x = v[0] / flat if flat > 1e-9 else 1.0, y = v[1] / flat if flat > 1e-9 else 0.0
        cdef double[3] moved
        cdef double away, aside
        cdef int k
        for k in range(3):
            # the axis times v
            moved[0] = v[2] if k == 1 else -v[1] if k == 2 else 0.0
            moved[1] = -v[2] if k == 0 else v[0] if k == 2 else 0.0
            moved[2] = v[1] if k == 0 else -v[0] if k == 1 else 0.0
            away = (x * moved[0] + y * moved[1]) * v[2] - moved[2] * flat
            aside = x * moved[1] - y * moved[0]
            slope[k] = x * u[2] * away * nearer - y * aside * shrink
            slope[3 + k] = y * u[2] * away * nearer + x * aside * shrink
            slope[6 + k] = -seen * away * nearer


cdef inline void raised(const double *v, double flat, double angle, double *out) noexcept nogil:
    """Set `out` (3,) to v (3,), of horizontal length `flat`, turned by an angle toward +Z within its vertical plane."""
    cdef double angle2 = angle * angle, c, s, shrink
    if angle2 < 1e-4:
        # to 1e-17, and four times as quick
        c = 1 - angle2 * (0.5 - angle2 * (1 / 24.0 - angle2 / 720))
        s = angle * (1 - angle2 * (1 / 6.0 - angle2 * (1 / 120.0 - angle2 / 5040)))
    else:
        c, s = cos(angle), sin(angle)
    shrink = c - s * v[2] / flat
    out[0], out[1], out[2] = v[0] * shrink, v[1] * shrink, c * v[2] + s * flat
