# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""ROS's lens models: where directions in C are seen, in focal lengths from the principal point, and back."""

from libc.math cimport NAN, atan2, cos, fabs, fmax, hypot, sin, sqrt

import numpy as np

cdef enum:
    # Steps of Newton's method: of a pinhole's distortion, and of a fisheye's, which falls back to halves.
    STEPS = 30
    HALVING_STEPS = 60

# Where they have converged, in focal lengths and rad, and what is good enough of the first; sine of an angle off the axis
# that is as good as none.
cdef double SETTLED = 1e-14, GOOD = 1e-12, SETTLED_RAD = 1e-15, MIN_OFF = 1e-12


cdef class Lens:
    """A lens with coefficients d (n,) of its model."""

    def __init__(self, d):
        cdef int k
        for k in range(8):
            self.d[k] = d[k] if k < len(d) else 0.0

    cdef void seen(self, const double *v, double *place) noexcept nogil:
        """Set place (2,) to where v (3,) is seen; NaN where it is not."""

    cdef void seen_slopes(self, const double *v, double *slope) noexcept nogil:
        """Set slope (2, 3) to the derivatives of `seen` by v."""

    cdef void ray(self, const double *place, double *v) noexcept nogil:
        """Set v (3,) to the unit vector that is seen at place (2,); NaN if there is none."""

    def places(self, v):
        """Places (..., 2) where directions v (..., 3) are seen; NaN where they are not."""
        cdef const double[:, ::1] given = np.ascontiguousarray(v, float).reshape(-1, 3)
        out = np.empty((given.shape[0], 2))
        cdef double[:, ::1] to = out
        cdef Py_ssize_t k
        for k in range(given.shape[0]):
            self.seen(&given[k, 0], &to[k, 0])
        return out.reshape(np.shape(v)[: np.ndim(v) - 1] + (2,))

    def rays(self, places):
        """Unit vectors (..., 3) that are seen at places (..., 2); NaN where none is."""
        cdef const double[:, ::1] given = np.ascontiguousarray(places, float).reshape(-1, 2)
        out = np.empty((given.shape[0], 3))
        cdef double[:, ::1] to = out
        cdef Py_ssize_t k
        for k in range(given.shape[0]):
            self.ray(&given[k, 0], &to[k, 0])
        return out.reshape(np.shape(places)[: np.ndim(places) - 1] + (3,))


cdef inline double polynomial(double r2, double a, double b, double c) noexcept nogil:
    return 1 + r2 * (a + r2 * (b + r2 * c))


cdef inline double increase(double r2, double a, double b, double c) noexcept nogil:
    """Derivative of `polynomial` by r2."""
    return a + r2 * (2 * b + r2 * 3 * c)


cdef class PlumbBob(Lens):
    """`plumb_bob`, Brown and Conrady's distortion of a pinhole's picture, as OpenCV has it: d is k1, k2, p1, p2, k3.

    With k4, k5, k6 it is `rational_polynomial`: the radial factor is divided by 1 + k4 r^2 + k5 r^4 + k6 r^6.
    The plane is the tangent plane of the unit sphere on the optical axis. Behind the camera nothing is seen, and no ray
    leads where the distortion cannot be inverted.
    """

    cdef bint bent

    def __init__(self, d):
        super().__init__(d)
        self.bent = any(d)

    def __reduce__(self):
        return PlumbBob, (tuple(self.d),)

    cdef void seen(self, const double *v, double *place) noexcept nogil:
        cdef double[2] plane
        cdef double z = v[2] if v[2] > 0 else NAN
        plane[0], plane[1] = v[0] / z, v[1] / z
        if self.bent:
            self.distorted(plane, place)
        else:
            place[0], place[1] = plane[0], plane[1]

    cdef void seen_slopes(self, const double *v, double *slope) noexcept nogil:
        cdef double[2] plane
        cdef double[4] by = [1.0, 0.0, 0.0, 1.0]
        cdef double z = v[2] if v[2] > 0 else NAN
        cdef int i
        plane[0], plane[1] = v[0] / z, v[1] / z
        if self.bent:
            self.distorted_slopes(plane, by)
        for i in range(2):
            slope[3 * i], slope[3 * i + 1] = by[2 * i] / z, by[2 * i + 1] / z
            slope[3 * i + 2] = -(by[2 * i] * plane[0] + by[2 * i + 1] * plane[1]) / z

    cdef void ray(self, const double *place, double *v) noexcept nogil:
        cdef double[2] plane
        cdef double length
        plane[0], plane[1] = place[0], place[1]
        if self.bent and not self.undistorted(place, plane):
            plane[0] = NAN
        length = sqrt(plane[0] * plane[0] + plane[1] * plane[1] + 1)
        v[0], v[1], v[2] = plane[0] / length, plane[1] / length, 1 / length

    cdef void distorted(self, const double *plane, double *out) noexcept nogil:
        """Set `out` (2,) to the distorted place of plane (2,)."""
        cdef double p1 = self.d[2], p2 = self.d[3], x = plane[0], y = plane[1], r2 = x * x + y * y
        cdef double radial = polynomial(r2, self.d[0], self.d[1], self.d[4]) / polynomial(r2, self.d[5], self.d[6], self.d[7])
        out[0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        out[1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y

    cdef void distorted_slopes(self, const double *plane, double *slope) noexcept nogil:
        """Set slope (2, 2) to the derivatives of `distorted` by plane (2,)."""
        cdef double p1 = self.d[2], p2 = self.d[3], x = plane[0], y = plane[1], r2 = x * x + y * y
        cdef double under = polynomial(r2, self.d[5], self.d[6], self.d[7])
        cdef double radial = polynomial(r2, self.d[0], self.d[1], self.d[4]) / under
        # the radial factor grows by this times x along x
        cdef double grows = 2 / under * (
            increase(r2, self.d[0], self.d[1], self.d[4]) - radial * increase(r2, self.d[5], self.d[6], self.d[7])
        )
        slope[0] = radial + x * x * grows + 2 * p1 * y + 6 * p2 * x
        slope[1] = slope[2] = x * y * grows + 2 * p1 * x + 2 * p2 * y
        slope[3] = radial + y * y * grows + 6 * p1 * y + 2 * p2 * x

    cdef bint undistorted(self, const double *target, double *plane) noexcept nogil:
        """Set plane (2,) to what is distorted to target (2,), by Newton's method from there; False if nothing is found."""
        cdef double[2] here
        cdef double[4] by
        cdef double x = 0.0, y = 0.0, off = NAN, determinant
        cdef int step
        plane[0], plane[1] = target[0], target[1]
        for step in range(STEPS):
            self.distorted(plane, here)
            x, y = here[0] - target[0], here[1] - target[1]
            off = fmax(fabs(x), fabs(y)) if x == x and y == y else NAN
            self.distorted_slopes(plane, by)
            determinant = by[0] * by[3] - by[1] * by[2]
            if not off >= SETTLED:
                break
            plane[0] -= (by[3] * x - by[1] * y) / determinant
            plane[1] -= (by[0] * y - by[2] * x) / determinant
        # beyond a fold of the distortion solutions are wrong: they are mirrored, or lie on the other side of the axis
        return off < GOOD and determinant > 0 and plane[0] * target[0] + plane[1] * target[1] >= 0


cdef class Equidistant(Lens):
    """`equidistant`, of fisheyes: Kannala and Brandt's, as OpenCV's cv2.fisheye has it; d is k1, k2, k3, k4.

    A direction theta off the axis is seen theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) focal lengths from
    the principal point, also where theta is beyond 90 deg. Out to where that distance no longer grows, at `reach` rad, the
    lens has a picture. With p1, p2 its glasses are not on one axis: as in COLMAP's THIN_PRISM_FISHEYE each place is moved
    by 2 p1 x y + p2 (theta^2 + 2 x^2) and p1 (theta^2 + 2 y^2) + 2 p2 x y, where x, y are theta along the two axes.
    """

    cdef readonly double reach
    cdef bint centred

    def __init__(self, d, double reach):
        super().__init__(d)
        self.reach = reach
        self.centred = not any(d[4:])

    def __reduce__(self):
        return Equidistant, (tuple(self.d)[:4 if self.centred else 6], self.reach)

    @property
    def picture(self):
        """The radius of the lens's picture."""
        return self.distance(self.reach)

    def angle_at(self, double distance):
        """The angle off the axis, rad, that is seen at a distance; NaN beyond the picture."""
        return self.angle(distance)

    cdef double distance(self, double theta) noexcept nogil:
        """The distance at which an angle theta off the axis is seen."""
        cdef double t2 = theta * theta
        return theta * (1 + t2 * (self.d[0] + t2 * (self.d[1] + t2 * (self.d[2] + t2 * self.d[3]))))

    cdef double stretched(self, double theta) noexcept nogil:
        """Derivative of `distance`."""
        cdef double t2 = theta * theta
        return 1 + t2 * (3 * self.d[0] + t2 * (5 * self.d[1] + t2 * (7 * self.d[2] + t2 * 9 * self.d[3])))

    cdef void seen(self, const double *v, double *place) noexcept nogil:
        cdef double off = hypot(v[0], v[1]), theta = atan2(off, v[2])
        # straight behind has no direction on the plane
        cdef double stretch = (self.distance(theta) / off if off > 0 else 1.0) if theta < self.reach else NAN
        place[0], place[1] = v[0] * stretch, v[1] * stretch
        if not self.centred:
            self.moved(v, place)

    cdef void moved(self, const double *v, double *place) noexcept nogil:
        """Add to place (2,) how far the decentred lens moves the direction v (3,)."""
        cdef double off = fmax(hypot(v[0], v[1]), MIN_OFF), theta = atan2(off, v[2]), x = theta * v[0] / off
        cdef double y = theta * v[1] / off, p1 = self.d[4], p2 = self.d[5], t2 = theta * theta
        place[0] += 2 * p1 * x * y + p2 * (t2 + 2 * x * x)
        place[1] += p1 * (t2 + 2 * y * y) + 2 * p2 * x * y

    cdef void seen_slopes(self, const double *v, double *slope) noexcept nogil:
        cdef double off = fmax(hypot(v[0], v[1]), MIN_OFF), theta = atan2(off, v[2])
        cdef double length2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        cdef double grows = self.stretched(theta) / length2, stretch = self.distance(theta) / off
        cdef double[2] outward
        cdef int i, j
        # on the axis any azimuth will do
        outward[0] = v[0] / off if off > MIN_OFF else 1.0
        outward[1] = v[1] / off if off > MIN_OFF else 0.0
        if not theta < self.reach:
            grows = NAN
        # away from the axis the angle grows, around it the direction of the place turns
        for i in range(2):
            for j in range(2):
                slope[3 * i + j] = outward[i] * outward[j] * (v[2] * grows - stretch)
            slope[3 * i + i] += stretch
            slope[3 * i + 2] = -outward[i] * off * grows
        if self.centred:
            return
        # of x and y, and of what they move the place by
        cdef double p1 = self.d[4], p2 = self.d[5], x = theta * outward[0], y = theta * outward[1]
        cdef double[4] by = [2 * p1 * y + 6 * p2 * x, 2 * p1 * x + 2 * p2 * y, 2 * p1 * x + 2 * p2 * y, 6 * p1 * y + 2 * p2 * x]
        cdef double[6] turn
        stretch = theta / off
        for i in range(2):
            for j in range(2):
                turn[3 * i + j] = outward[i] * outward[j] * (v[2] / length2 - stretch)
            turn[3 * i + i] += stretch
            turn[3 * i + 2] = -outward[i] * off / length2
        for i in range(2):
            for j in range(3):
                slope[3 * i + j] += by[2 * i] * turn[j] + by[2 * i + 1] * turn[3 + j]

    cdef void ray(self, const double *place, double *v) noexcept nogil:
        cdef double[2] centred, move
        cdef double off
        cdef int step
        self.from_axis(place, v)
        if self.centred:
            return
        # what moves the place hardly changes over the move
        centred[0], centred[1] = place[0], place[1]
        for step in range(STEPS):
            move[0] = move[1] = 0.0
            self.moved(v, move)
            off = hypot(place[0] - move[0] - centred[0], place[1] - move[1] - centred[1])
            centred[0], centred[1] = place[0] - move[0], place[1] - move[1]
            self.from_axis(centred, v)
            if not off > SETTLED_RAD:
                break
        if not off < GOOD:
            v[0] = v[1] = v[2] = NAN

    cdef void from_axis(self, const double *place, double *v) noexcept nogil:
        """Set v (3,) to what a lens with the same distances, but centred, sees at place (2,); NaN if nothing."""
        cdef double distance = hypot(place[0], place[1]), theta = self.angle(distance)
        cdef double stretch = sin(theta) / distance if distance > 0 else 1.0
        v[0], v[1], v[2] = place[0] * stretch, place[1] * stretch, cos(theta)
        if not theta == theta:
            v[0] = v[1] = NAN

    cdef double angle(self, double distance) noexcept nogil:
        """The angle seen at a distance, by Newton's method between bounds; NaN beyond the picture."""
        cdef double low = 0.0, high = self.reach, theta = min(distance, self.reach), error, new
        cdef int step
        if not distance < self.distance(self.reach):
            return NAN
        for step in range(HALVING_STEPS):
            error = self.distance(theta) - distance
            if error > 0:
                high = theta
            else:
                low = theta
            new = theta - error / self.stretched(theta)
            if not (new >= low and new <= high):
                new = (low + high) / 2
            error, theta = fabs(new - theta), new
            if error < SETTLED_RAD:
                break
        return theta
