# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The stars of a frame in pixels from the principal point, as the other modules here take them."""

from libc.math cimport atan, ceil, hypot, isfinite, rint, sqrt

import numpy as np

from starpos._numeric.memory cimport numbers_of


cdef class FrameStars:
    """N stars of a frame, brightest first.

    xy        (2, N, 2) px from the principal point, as they are and with the frame's rows flipped
    sigma     (N,) px, their errors along one axis
    middle    (2,) px, the centre of the part of the frame that shows something
    half      (2,) px, half the size of that part
    focal_px  approximate focal length
    area_px2  area over which false detections are spread; never more than the true one
    tested    so many of the brightest decide whether a pose is right
    """

    def __len__(self):
        return self.count

    @property
    def xy(self):
        return self.numbers[:4 * self.count].reshape(2, self.count, 2)

    @property
    def sigma(self):
        return self.numbers[4 * self.count:]

    @property
    def middle(self):
        return np.array([self.centre[0][0], self.centre[0][1]])

    @property
    def half(self):
        return np.array([self.reach[0], self.reach[1]])

    def of_rows(self, row):
        """The stars of these rows, in the same order."""
        return _hold(_shape_of(self), self.xy[:, row], self.sigma[row])

    def but(self, *, focal_px=None, area_px2=None, tested=None):
        """Stars as they are, with another focal length, area or number of those that decide."""
        cdef FrameStars out = _shape_of(self)
        out.focal_px = self.focal_px if focal_px is None else focal_px
        out.area_px2 = self.area_px2 if area_px2 is None else area_px2
        out.tested = self.tested if tested is None else tested
        return _hold(out, self.xy, self.sigma)

    def within(self, low, high, double share):
        """The stars of a frame of which only a share of the area, from low (2,) to high (2,) px, shows something.

        What is hidden counts neither against a pose whose stars would be there, nor as area for false detections.
        """
        cdef FrameStars out = _shape_of(self)
        # a row and the same row of flipped ones have this sum
        cdef double both = self.centre[0][1] + self.centre[1][1]
        first, last = np.maximum(low, self.middle - self.half), np.minimum(high, self.middle + self.half)
        x, y = (first + last) / 2
        _centre(out, x, y, both - y)
        out.reach[0], out.reach[1] = (last - first) / 2
        out.area_px2 = self.area_px2 * share
        return _hold(out, self.xy, self.sigma)


cdef void _centre(FrameStars f, double x, double y, double flipped) noexcept:
    """Set the middle of what a frame shows, whose row is another one if the rows are flipped."""
    f.centre[0][0], f.centre[0][1], f.centre[1][0], f.centre[1][1] = x, y, x, flipped


cdef FrameStars _hold(FrameStars f, xy, sigma):
    """Give f these stars' pixels and errors; its size and focal length are there."""
    cdef Py_ssize_t n = len(sigma)
    _take(f, n, np.concatenate([np.ravel(xy), sigma], dtype=float))
    return _measured(f)


cdef int _take(FrameStars f, Py_ssize_t n, numbers) except -1:
    """Let f keep its n stars in `numbers` (5 n,)."""
    cdef double *first = <double *>numbers_of(numbers, 5 * n * sizeof(double))
    f.count, f.numbers, f.pixel, f.error = n, numbers, first, first + 4 * n
    return 0


cdef FrameStars _measured(FrameStars f):
    """Set the radius of f, some more than that of its corners."""
    f.radius = atan(hypot(f.reach[0], f.reach[1]) / f.focal_px) * 1.05 + 2e-4
    return f


cdef FrameStars _shape_of(FrameStars f):
    """A frame of the same shape, as yet without stars."""
    cdef FrameStars out = FrameStars.__new__(FrameStars)
    cdef int i
    for i in range(2):
        out.centre[i][0], out.centre[i][1], out.reach[i] = f.centre[i][0], f.centre[i][1], f.reach[i]
    out.focal_px, out.area_px2, out.tested = f.focal_px, f.area_px2, f.tested
    return out


cdef struct Square:
    # A camera as if its pixels were square: px of its focal length, principal point and frame; px a row of its own.
    double focal, cx, cy, width, rows, squeeze


cdef Square _square(camera) except *:
    cdef Square s
    s.focal, s.cx, s.width = camera.fx, camera.cx, camera.width
    s.squeeze = s.focal / <double>camera.fy
    s.cy, s.rows = camera.cy * s.squeeze, max(1.0, rint(camera.height * s.squeeze))
    return s


cdef FrameStars _framed(const Square *s, numbers, Py_ssize_t n, double margin, int tested):
    """The n stars in `numbers` on a frame that reaches so far beyond its size."""
    cdef FrameStars out = FrameStars.__new__(FrameStars)
    _take(out, n, numbers)
    _centre(out, (s.width - 1) / 2 - s.cx, (s.rows - 1) / 2 - s.cy, (s.rows - 1) / 2 - s.cy)
    out.reach[0], out.reach[1] = s.width / 2 + margin, s.rows / 2 + margin
    out.focal_px, out.area_px2, out.tested = s.focal, s.width * s.rows, tested
    return _measured(out)


def ideal_frame(across_px, down_px, covariance, camera, double edge_px, double least_sigma, int tested):
    """FrameStars of pixels (N,), (N,), with covariances (N, 2, 2), of a pinhole camera without distortion.

    edge_px      so far beyond the frame they may be: None if one is farther
    least_sigma  px; smaller errors become it
    """
    cdef Square s = _square(camera)
    cdef double height = camera.height, across, down
    cdef Py_ssize_t n = len(across_px), k
    cdef const double *x = <const double *>numbers_of(across_px, n * sizeof(double))
    cdef const double *y = <const double *>numbers_of(down_px, n * sizeof(double))
    cdef const double *variance = <const double *>numbers_of(covariance, 4 * n * sizeof(double))
    numbers = np.empty(5 * n)
    cdef double *xy = <double *>numbers_of(numbers, 5 * n * sizeof(double))
    for k in range(n):
        if not (-edge_px < x[k] < s.width - 1 + edge_px and -edge_px < y[k] < height - 1 + edge_px):
            return None
        across, down = x[k] - s.cx, y[k] * s.squeeze - s.cy
        xy[2 * k] = xy[2 * (n + k)] = across
        xy[2 * k + 1], xy[2 * (n + k) + 1] = down, s.rows - 1 - 2 * s.cy - down
        xy[4 * n + k] = max(sqrt((variance[4 * k] + variance[4 * k + 3]) / 2), least_sigma)
    return _framed(&s, numbers, n, 0.0, tested)


def framed(
    const double[:, ::1] seen, const double[::1] sigma, camera, double least_sigma, int tested, double edge_px, double widest
):
    """FrameStars of pixels `seen` (N, 2), or of unit vectors (N, 3) in C, with errors (N,) px, as a camera without distortion.

    least_sigma      px; smaller errors become it
    edge_px, widest  for stars that lie farther than edge_px beyond the frame it gets a margin, at most this share of a side

    ValueError if one is behind the camera or not a finite number.
    """
    cdef Square s = _square(camera)
    cdef Py_ssize_t n = seen.shape[0], k
    cdef double x, y, beyond = 0.0
    cdef bint sound = sigma.shape[0] == n, rays = seen.shape[1] == 3
    numbers = np.empty(5 * n)
    cdef double[::1] xy = numbers
    for k in range(n if sound else 0):
        if rays:
            x, y = seen[k, 0] / seen[k, 2] * s.focal, seen[k, 1] / seen[k, 2] * s.focal
            sound = sound and seen[k, 2] > 0
        else:
            x, y = seen[k, 0] - s.cx, seen[k, 1] * s.squeeze - s.cy
        sound = sound and isfinite(x) and isfinite(y) and isfinite(sigma[k])
        xy[2 * k] = xy[2 * (n + k)] = x
        xy[2 * k + 1], xy[2 * (n + k) + 1] = y, s.rows - 1 - 2 * s.cy - y
        xy[4 * n + k] = max(sigma[k], least_sigma)
        beyond = max(beyond, max(-x - s.cx, x + s.cx - (s.width - 1)))
        beyond = max(beyond, max(-y - s.cy, y + s.cy - (s.rows - 1)))
    if not sound:
        raise ValueError("stars to be identified need finite pixels and errors: leave the others out")
    # without distortion, stars that a lens has drawn in may lie beyond the frame
    return _framed(
        &s, numbers, n, ceil(min(beyond - edge_px, widest * max(s.width, s.rows))) if beyond > edge_px else 0.0, tested
    )


def all_within(const double[::1] x, const double[::1] y, double width, double height, double edge_px):
    """Whether all pixels x, y (N,) lie on a frame of this size or less than edge_px beyond it."""
    cdef Py_ssize_t k
    for k in range(x.shape[0]):
        if not (-edge_px < x[k] < width - 1 + edge_px and -edge_px < y[k] < height - 1 + edge_px):
            return False
    return True


def unit_vectors(const double[::1] x, const double[::1] y, double fx, double fy, double cx, double cy):
    """Unit vectors (N, 3) in C of pixels x, y (N,) of a pinhole camera with these focal lengths and principal point."""
    cdef Py_ssize_t k
    cdef double across, down, norm
    out = np.empty((x.shape[0], 3))
    cdef double[:, ::1] v = out
    for k in range(x.shape[0]):
        across, down = (x[k] - cx) / fx, (y[k] - cy) / fy
        norm = sqrt(across * across + down * down + 1)
        v[k, 0], v[k, 1], v[k, 2] = across / norm, down / norm, 1 / norm
    return out


def mean_sigma(const double[:, :, ::1] covariance):
    """Standard deviations (N,) along one axis, averaged over directions, of covariances (N, 2, 2)."""
    cdef Py_ssize_t k
    out = np.empty(covariance.shape[0])
    cdef double[::1] sigma = out
    for k in range(covariance.shape[0]):
        sigma[k] = sqrt((covariance[k, 0, 0] + covariance[k, 1, 1]) / 2)
    return out
