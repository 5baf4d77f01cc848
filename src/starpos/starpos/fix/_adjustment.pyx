# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The least-squares problem of a frame's stars: an attitude and the plate scale, and what errors of stars do to them."""

from libc.math cimport fabs, isfinite, sqrt

import numpy as np

from starpos._numeric.algebra cimport best_rotation, factored, solved, turn_by, turned
from starpos.earth._air cimport Refraction
from starpos.instrument._lens cimport Lens

cdef enum:
    # Parameters: a small rotation about L's axes, and a relative change of the scale.
    P = 4


cdef struct Stance:
    # ITRS into L, the factor on the focal length, and the velocity of the ground.
    double[9] a4
    double scale
    double[3] ground


cdef class Adjustment:
    """Stars that a camera on the ground sees, and where an estimate of its attitude has them.

    xy (N, 2)          px, where they are seen
    itrs (N, 3)        their geocentric apparent directions
    g (3, 3)           C into L
    lens, intrinsics   the camera's, and its fx, fy, cx, cy in px
    air                their refraction
    equator, e2        velocity of the ground at the equator in units of c, and the square of the ellipsoid's eccentricity

    An estimate is A4 (3, 3), ITRS into L, and the factor on the focal length.
    """

    cdef readonly object xy, itrs, g
    cdef Refraction air
    cdef const double[:, ::1] places, stars, to_level
    cdef Lens lens
    cdef double fx, fy, cx, cy, equator, e2

    def __init__(self, xy, itrs, g, Lens lens not None, intrinsics, Refraction air not None, double equator, double e2):
        self.xy, self.itrs, self.g = (np.ascontiguousarray(part, float) for part in (xy, itrs, g))
        n = len(self.xy)
        if self.xy.shape != (n, 2) or self.itrs.shape != (n, 3) or self.g.shape != (3, 3):
            raise ValueError(f"stars at {self.xy.shape} px in directions {self.itrs.shape}: (N, 2) and (N, 3) are understood")
        self.places, self.stars, self.to_level = self.xy, self.itrs, self.g
        self.lens, self.air, self.equator, self.e2 = lens, air, equator, e2
        self.fx, self.fy, self.cx, self.cy = intrinsics

    def closed_form(self, const double[:, ::1] local):
        """A4 that turns the stars into their unrefracted directions local (N, 3) in L, in one step (Horn 1987)."""
        cdef Stance s
        cdef double[9] b
        cdef int k, i, j, turn
        expect(local.shape[0] == self.stars.shape[0] and local.shape[1] == 3)
        s.ground[0] = s.ground[1] = s.ground[2] = 0.0
        # the diurnal aberration depends on the place that is sought
        for turn in range(2):
            for i in range(9):
                b[i] = 0.0
            for k in range(local.shape[0]):
                for i in range(3):
                    for j in range(3):
                        b[3 * i + j] += local[k, i] * (self.stars[k, j] + s.ground[j])
            best_rotation(b, s.a4)
            self.carry(&s)
        return matrix(s.a4)

    def predict(self, const double[:, ::1] a4, double scale, Refraction air=None):
        """Pixels (N, 2) where an estimate has the stars, under another air if that is given."""
        out = np.empty((self.stars.shape[0], 2))
        cdef double[:, ::1] to = out
        cdef Stance s
        cdef int k
        self.take(a4, scale, &s)
        air = self.air if air is None else air
        for k in range(self.stars.shape[0]):
            self.pixel(k, &s, air, &to[k, 0])
        return out

    def jacobian(self, const double[:, ::1] a4, double scale):
        """Derivatives (N, 2, 4) of `predict` by a small rotation of A4 about L's axes and a relative change of the scale.

        Left out is how the ground's velocity depends on the place: 1.5e-6 of them.
        """
        out = np.empty((self.stars.shape[0], 2, P))
        cdef double[:, :, ::1] to = out
        cdef Stance s
        cdef double[3] v
        cdef double[3] u
        cdef double[3] c
        cdef double[9] bent
        cdef double[9] by_turn
        cdef double[6] by_ray
        cdef double[2] place
        cdef int k, i, j
        self.take(a4, scale, &s)
        for k in range(self.stars.shape[0]):
            self.upward(k, &s, v)
            self.air.raise_one(v, u)
            self.air.bend_slopes(v, u, bent)
            self.ray_of(u, c)
            for i in range(3):
                for j in range(3):
                    by_turn[3 * i + j] = (
                        self.to_level[0, i] * bent[j] + self.to_level[1, i] * bent[3 + j] + self.to_level[2, i] * bent[6 + j]
                    )
            self.lens.seen(c, place)
            self.lens.seen_slopes(c, by_ray)
            for i in range(2):
                for j in range(3):
                    to[k, i, j] = s.scale * (self.fx if i == 0 else self.fy) * (
                        by_ray[3 * i] * by_turn[j] + by_ray[3 * i + 1] * by_turn[3 + j] + by_ray[3 * i + 2] * by_turn[6 + j]
                    )
                to[k, i, 3] = s.scale * (self.fx if i == 0 else self.fy) * place[i]
        return out

    def refine(
        self, const double[:, ::1] a4, double scale, const double[:, :, ::1] slope, const double[:, :, ::1] covariance,
        const unsigned char[::1] keep, double settled, int most_steps,
    ):
        """The best estimate near one, by Gauss-Newton with derivatives slope (N, 2, 4).

        covariance (N, 2, 2) in px2 and keep (N,): of the stars' places, and which of them count.
        settled: where a step, in rad and as a share of the scale, is the last.
        Returns also the residuals (N, 2), predicted minus seen px, before the last step; None if it did not converge.
        """
        cdef Stance s
        cdef double[P * P] normal
        cdef double[P] step
        cdef double most
        cdef int n = self.stars.shape[0], k, i, j, turn
        cdef bint done = False
        expect(of_stars(slope, n, P) and of_stars(covariance, n, 2) and keep.shape[0] == n)
        weighted, residual = np.zeros((n, 2, P)), np.empty((n, 2))
        cdef double[:, :, ::1] w = weighted
        cdef double[:, ::1] off = residual
        self.take(a4, scale, &s)
        for i in range(P * P):
            normal[i] = 0.0
        for k in range(n):
            if not keep[k]:
                continue
            weigh(slope[k], covariance[k], w[k])
            for i in range(P):
                for j in range(P):
                    normal[P * i + j] += slope[k, 0, i] * w[k, 0, j] + slope[k, 1, i] * w[k, 1, j]
        if isfinite(factored(normal, P)):
            for turn in range(most_steps):
                most = 0.0
                for i in range(P):
                    step[i] = 0.0
                for k in range(n):
                    self.pixel(k, &s, self.air, &off[k, 0])
                    off[k, 0] -= self.places[k, 0]
                    off[k, 1] -= self.places[k, 1]
                    if keep[k]:
                        for i in range(P):
                            step[i] -= w[k, 0, i] * off[k, 0] + w[k, 1, i] * off[k, 1]
                solved(normal, step, P)
                for i in range(P):
                    most = max(most, fabs(step[i])) if isfinite(step[i]) else 1e300
                if not most < 1e300:
                    break
                turn_by(step, s.a4)
                s.scale *= 1 + step[3]
                self.carry(&s)
                if most < settled:
                    done = True
                    break
        return matrix(s.a4), s.scale, residual if done else None

    cdef int take(self, const double[:, ::1] a4, double scale, Stance *s) except -1:
        cdef int i, j
        expect(a4.shape[0] == 3 and a4.shape[1] == 3)
        for i in range(3):
            for j in range(3):
                s.a4[3 * i + j] = a4[i, j]
        s.scale = scale
        self.carry(s)
        return 0

    cdef void carry(self, Stance *s) noexcept nogil:
        """Set the velocity of the ground to that of the place."""
        cdef double speed = self.equator / sqrt(1 - self.e2 * s.a4[8] * s.a4[8])
        s.ground[0], s.ground[1], s.ground[2] = -speed * s.a4[7], speed * s.a4[6], 0.0

    cdef void upward(self, int k, const Stance *s, double *v) noexcept nogil:
        """Set v (3,) to the unrefracted direction of star k in L."""
        cdef double[3] w
        cdef double norm
        cdef int i
        for i in range(3):
            w[i] = self.stars[k, i] + s.ground[i]
        norm = 1 / sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        for i in range(3):
            w[i] *= norm
        turned(s.a4, w, v)

    cdef void ray_of(self, const double *u, double *c) noexcept nogil:
        """Set c (3,) to the direction in C of u (3,) in L."""
        cdef int i
        for i in range(3):
            c[i] = self.to_level[0, i] * u[0] + self.to_level[1, i] * u[1] + self.to_level[2, i] * u[2]

    cdef void pixel(self, int k, const Stance *s, Refraction air, double *out) noexcept nogil:
        """Set `out` (2,) to the pixel where star k should be."""
        cdef double[3] v
        cdef double[3] u
        cdef double[3] c
        self.upward(k, s, v)
        air.raise_one(v, u)
        self.ray_of(u, c)
        self.lens.seen(c, out)
        out[0] = self.cx + s.scale * self.fx * out[0]
        out[1] = self.cy + s.scale * self.fy * out[1]


def gain_of(const double[:, :, ::1] slope, const double[:, :, ::1] covariance):
    """Change (3, N, 2) of the first three parameters of a weighted fit for an error of one pixel of each star.

    slope (N, 2, 4): derivatives by the parameters.  covariance (N, 2, 2) px2.  NaN if they cannot be told apart.
    """
    cdef int n = slope.shape[0], k, i, j, side
    cdef double[P * P] normal
    cdef double[P] column
    expect(of_stars(slope, n, P) and of_stars(covariance, n, 2))
    out, weighted = np.full((3, n, 2), np.nan), np.empty((n, 2, P))
    cdef double[:, :, ::1] gain = out, w = weighted
    for i in range(P * P):
        normal[i] = 0.0
    for k in range(n):
        weigh(slope[k], covariance[k], w[k])
        for i in range(P):
            for j in range(P):
                normal[P * i + j] += slope[k, 0, i] * w[k, 0, j] + slope[k, 1, i] * w[k, 1, j]
    if isfinite(factored(normal, P)):
        for k in range(n):
            for side in range(2):
                for i in range(P):
                    column[i] = w[k, side, i]
                solved(normal, column, P)
                for i in range(3):
                    gain[i, k, side] = column[i]
    return out


def spread(const double[:, :, ::1] gain, const double[:, :, ::1] covariance):
    """Covariance (3, 3) that independent errors of covariance (N, 2, 2) make by a gain (3, N, 2)."""
    out = np.zeros((3, 3))
    cdef double[:, ::1] to = out
    cdef double x, y
    cdef int k, i, j
    expect(gain.shape[0] == 3 and gain.shape[2] == 2 and of_stars(covariance, gain.shape[1], 2))
    for k in range(covariance.shape[0]):
        for i in range(3):
            x = gain[i, k, 0] * covariance[k, 0, 0] + gain[i, k, 1] * covariance[k, 1, 0]
            y = gain[i, k, 0] * covariance[k, 0, 1] + gain[i, k, 1] * covariance[k, 1, 1]
            for j in range(3):
                to[i, j] += x * gain[j, k, 0] + y * gain[j, k, 1]
    return out


cdef bint of_stars(const double[:, :, ::1] array, Py_ssize_t n, int last) noexcept:
    """Whether an array is (n, 2, last)."""
    return array.shape[0] == n and array.shape[1] == 2 and array.shape[2] == last


cdef int expect(bint fits) except -1:
    """Raise ValueError unless arrays fit to each other."""
    if not fits:
        raise ValueError("arrays of stars do not fit to each other: as many rows are needed in each, of the shapes stated")
    return 0


cdef void weigh(const double[:, ::1] slope, const double[:, ::1] covariance, double[:, ::1] out) noexcept nogil:
    """Set `out` (2, 4) to the inverse of covariance (2, 2) times slope (2, 4)."""
    cdef double xx = covariance[0, 0], xy = covariance[0, 1], yy = covariance[1, 1], determinant = xx * yy - xy * xy
    cdef int i
    for i in range(P):
        out[0, i] = (yy * slope[0, i] - xy * slope[1, i]) / determinant
        out[1, i] = (xx * slope[1, i] - xy * slope[0, i]) / determinant


cdef matrix(const double *rows):
    """Nine numbers as an array (3, 3)."""
    out = np.empty((3, 3))
    cdef double[:, ::1] to = out
    cdef int i
    for i in range(9):
        to[i // 3, i % 3] = rows[i]
    return out
