# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The stars of a frame in pixels from the principal point, as the other modules here take them."""

from libc.math cimport atan, hypot, isfinite, rint, sqrt

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

    def __init__(self, *, xy, sigma, middle, half, double focal_px, double area_px2, int tested):
        _centre(self, middle[0], middle[1], middle[1])
        self.reach[0], self.reach[1] = half
        self.focal_px, self.area_px2, self.tested = focal_px, area_px2, tested
        _hold(self, xy, sigma)

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
    if np.shape(xy) != (2, n, 2) or np.shape(sigma) != (n,):
        raise ValueError(f"{n} errors for pixels of shape {np.shape(xy)}: (2, {n}, 2) is expected")
    _take(f, n, np.concatenate([np.ravel(xy), sigma], dtype=float))
    return _measured(f)


cdef double *_take(FrameStars f, Py_ssize_t n, numbers) except NULL:
    """Let f keep its n stars in `numbers` (5 n,); the first of these."""
    cdef double *first = <double *>numbers_of(numbers, 5 * n * sizeof(double))
    f.count, f.numbers, f.pixel, f.error = n, numbers, first, first + 4 * n
    return first


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


def ideal_frame(across_px, down_px, covariance, camera, double edge_px, double least_sigma, int tested):
    """FrameStars of pixels (N,), (N,), with covariances (N, 2, 2), of a pinhole camera without distortion.

    edge_px      so far beyond the frame they may be: None if one is farther
    least_sigma  px; smaller errors become it
    """
    cdef double fx = camera.fx, squeeze = fx / <double>camera.fy, cx = camera.cx, cy = camera.cy
    cdef double width = camera.width, height = camera.height, across, down
    cdef Py_ssize_t n = len(across_px), k
    cdef const double *x = <const double *>numbers_of(across_px, n * sizeof(double))
    cdef const double *y = <const double *>numbers_of(down_px, n * sizeof(double))
    cdef const double *variance = <const double *>numbers_of(covariance, 4 * n * sizeof(double))
    cdef FrameStars out = FrameStars.__new__(FrameStars)
    cdef double *xy = _take(out, n, np.empty(5 * n))
    # as a camera with square pixels sees them
    cdef double rows = max(1.0, rint(height * squeeze))
    for k in range(n):
        if not (-edge_px < x[k] < width - 1 + edge_px and -edge_px < y[k] < height - 1 + edge_px):
            return None
        across, down = x[k] - cx, (y[k] - cy) * squeeze
        xy[2 * k] = xy[2 * (n + k)] = across
        xy[2 * k + 1], xy[2 * (n + k) + 1] = down, rows - 1 - 2 * cy * squeeze - down
        xy[4 * n + k] = max(sqrt((variance[4 * k] + variance[4 * k + 3]) / 2), least_sigma)
    _centre(out, (width - 1) / 2 - cx, (rows - 1) / 2 - cy * squeeze, (rows - 1) / 2 - cy * squeeze)
    out.reach[0], out.reach[1] = width / 2, rows / 2
    out.focal_px, out.area_px2, out.tested = fx, width * rows, tested
    return _measured(out)


def projected(
    const double[:, ::1] v, const double[::1] sigma, double focal_px, double centre_x, double centre_y, int width,
    int height, double least_sigma,
):
    """Project unit vectors v (N, 3) in C with an ideal camera.

    sigma                       (N,) px
    centre_x, centre_y          px of the principal point
    width, height               px of the frame
    least_sigma                 px; smaller errors become it

    Returns pixels (2, N, 2) from the principal point, as they are and with the frame's rows flipped; the errors (N,); and
    how far (px) the farthest star lies beyond the frame. ValueError if one is behind the camera or not a finite number.
    """
    cdef Py_ssize_t n = v.shape[0], k
    cdef double x, y, beyond = 0.0
    cdef bint sound = sigma.shape[0] == n
    pixels, errors = np.empty((2, n, 2)), np.empty(n)
    cdef double[:, :, ::1] xy = pixels
    cdef double[::1] error = errors
    for k in range(n if sound else 0):
        x, y = v[k, 0] / v[k, 2] * focal_px, v[k, 1] / v[k, 2] * focal_px
        sound = sound and v[k, 2] > 0 and isfinite(x) and isfinite(y) and isfinite(sigma[k])
        xy[0, k, 0] = xy[1, k, 0] = x
        xy[0, k, 1], xy[1, k, 1] = y, height - 1 - 2 * centre_y - y
        error[k] = max(sigma[k], least_sigma)
        beyond = max(beyond, max(-x - centre_x, x + centre_x - (width - 1)))
        beyond = max(beyond, max(-y - centre_y, y + centre_y - (height - 1)))
    if not sound:
        raise ValueError("stars to be identified need finite pixels and errors: leave the others out")
    return pixels, errors, beyond


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
