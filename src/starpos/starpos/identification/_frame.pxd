# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False

from libc.math cimport fabs, sqrt


cdef class FrameStars:
    cdef readonly double focal_px
    cdef readonly double area_px2
    cdef readonly int tested
    # `xy` and `sigma` of so many stars, one behind the other, in the array `numbers`
    cdef int count
    cdef object numbers
    cdef const double *pixel
    cdef const double *error
    # the middle, as it is and with the rows flipped; the radius (rad) of a cone about it that contains the frame
    cdef double[2][2] centre
    cdef double[2] reach
    cdef double radius


cdef inline const double *pixels_of(FrameStars frame, bint mirrored) noexcept nogil:
    """Pixels (N, 2) of a frame's stars, with its rows flipped if mirrored."""
    return frame.pixel + 2 * frame.count * mirrored


cdef inline bint on_frame(FrameStars frame, bint mirrored, const double *pixel, double margin) noexcept nogil:
    """Whether a pixel (2,) lies on a frame, with its rows flipped if mirrored, or within a margin (px) of it."""
    cdef const double *centre = frame.centre[mirrored]
    return (fabs(pixel[0] - centre[0]) < frame.reach[0] + margin) & (
        fabs(pixel[1] - centre[1]) < frame.reach[1] + margin
    )


cdef inline bint seen_on(FrameStars frame, bint mirrored, const double *u, double focal, double margin) noexcept nogil:
    """Whether `on_frame` holds for the pixel of a direction (3,) in C; nothing behind the camera is on a frame."""
    cdef const double *centre = frame.centre[mirrored]
    return (fabs(u[0] * focal - centre[0] * u[2]) < (frame.reach[0] + margin) * u[2]) & (
        fabs(u[1] * focal - centre[1] * u[2]) < (frame.reach[1] + margin) * u[2]
    )


cdef inline void axis_of(FrameStars frame, bint mirrored, const double *attitude, double *axis) noexcept nogil:
    """Set axis (3,) to the direction, of any length, of a frame's middle, flipped if mirrored, in an attitude (3, 3)."""
    cdef const double *centre = frame.centre[mirrored]
    cdef int i
    for i in range(3):
        axis[i] = (centre[0] * attitude[i] + centre[1] * attitude[3 + i]) / frame.focal_px + attitude[6 + i]


cdef inline void direction_of(double x, double y, double focal, double *v) noexcept nogil:
    """Set v (3,) to the unit vector in C of a pixel from the principal point."""
    cdef double norm = 1 / sqrt(x * x + y * y + focal * focal)
    v[0], v[1], v[2] = x * norm, y * norm, focal * norm


cdef inline void pixel_of(const double *u, double focal, double *pixel) noexcept nogil:
    """Set pixel (2,) to that of a direction (3,) in C; behind the camera it is far away."""
    cdef double scale = focal / max(u[2], 1e-6)
    pixel[0], pixel[1] = u[0] * scale, u[1] * scale
