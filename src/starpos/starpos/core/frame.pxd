# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False

from libc.math cimport fabs, sqrt


cdef class Frame:
    cdef const double[:, :, ::1] xy
    cdef const double[::1] sigma
    cdef double focal
    cdef double radius
    cdef double area
    cdef int tested
    cdef double[2][2] middle
    cdef double[2] half


cdef inline bint on_frame(Frame frame, bint mirrored, const double *pixel, double margin) noexcept nogil:
    """Whether a pixel (2,) lies on a frame, flipped if mirrored, or within a margin (px) of it."""
    return (fabs(pixel[0] - frame.middle[mirrored][0]) < frame.half[0] + margin) & (
        fabs(pixel[1] - frame.middle[mirrored][1]) < frame.half[1] + margin
    )


cdef inline void axis_of(Frame frame, bint mirrored, const double *attitude, double *axis) noexcept nogil:
    """Set axis (3,) to the direction, of any length, of the middle of a frame, flipped if mirrored, in an attitude (3, 3)."""
    cdef const double *middle = frame.middle[mirrored]
    cdef int i
    for i in range(3):
        axis[i] = (middle[0] * attitude[i] + middle[1] * attitude[3 + i]) / frame.focal + attitude[6 + i]


cdef inline void direction_of(double x, double y, double focal, double *v) noexcept nogil:
    """Set v (3,) to the unit vector in C of a pixel from the principal point."""
    cdef double norm = 1 / sqrt(x * x + y * y + focal * focal)
    v[0], v[1], v[2] = x * norm, y * norm, focal * norm


cdef inline void pixel_of(const double *u, double focal, double *pixel) noexcept nogil:
    """Set pixel (2,) to that of a direction (3,) in C; behind the camera it is far away."""
    cdef double scale = focal / max(u[2], 1e-6)
    pixel[0], pixel[1] = u[0] * scale, u[1] * scale
