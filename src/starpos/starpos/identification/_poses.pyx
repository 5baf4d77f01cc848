# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Poses of a camera among the stars: fitted to stars that are matched meanwhile, and weighed against chance."""

from libc.math cimport M_PI, exp, fabs, log, sqrt

import numpy as np

from starpos._numeric.algebra cimport best_rotation, factored, length, median, solved, turn_by, turned
from starpos._numeric.memory cimport room_for, start_of
from starpos.identification._frame cimport FrameStars, direction_of, pixel_of, pixels_of
from starpos.identification._matching cimport Matching, match, order
from starpos.identification._sky cimport Visible

cdef enum:
    NONE = -1
    DOUBLED = -2


cdef void _project(const double *attitude, double focal, const double *w, int n, double *pixel) noexcept nogil:
    """Set pixel (n, 2) to those of directions w (n, 3)."""
    cdef double[3] u
    cdef int s
    for s in range(n):
        turned(attitude, &w[3 * s], u)
        pixel_of(u, focal, &pixel[2 * s])


cdef void _slopes(const double *u, double focal, double *pixel, double *slope) noexcept nogil:
    """The pixel (2,) of a direction u (3,) in C, and its derivatives (2, 4).

    They are by small rotations (rad) about C's axes and by the logarithm of the focal length.
    """
    cdef double x = u[0] / u[2], y = u[1] / u[2]
    slope[0], slope[1], slope[2], slope[3] = -x * y * focal, (1 + x * x) * focal, -y * focal, x * focal
    slope[4], slope[5], slope[6], slope[7] = (-1 - y * y) * focal, x * y * focal, x * focal, y * focal
    pixel[0], pixel[1] = slope[3], slope[7]


cdef int _fit(
    const double *xy, const double *w, const double *sigma, const Py_ssize_t *star, const Py_ssize_t *near,
    int n, int steps, double small_step, double *attitude, double *focal,
) noexcept nogil:
    """Fit attitude (3, 3) and focal length to pixels xy[star[k]] of directions w[near[k]], with errors sigma[k] px."""
    cdef double[16] normal
    cdef double[4] right
    cdef double[8] slope
    cdef double[2] pixel
    cdef double[3] u
    cdef double weight, off, largest
    cdef int step, k, axis, i, j
    for step in range(steps):
        for i in range(16):
            normal[i] = 0.0
        for i in range(4):
            right[i] = 0.0
        for k in range(n):
            turned(attitude, &w[3 * near[k]], u)
            _slopes(u, focal[0], pixel, slope)
            weight = 1 / (sigma[k] * sigma[k])
            for axis in range(2):
                off = (xy[2 * star[k] + axis] - pixel[axis]) * weight
                for i in range(4):
                    right[i] += slope[4 * axis + i] * off
                    for j in range(i + 1):
                        normal[4 * i + j] += slope[4 * axis + i] * slope[4 * axis + j] * weight
        # all stars in one place
        if not factored(normal, 4) > -1e300:
            break
        solved(normal, right, 4)
        largest = max(max(fabs(right[0]), fabs(right[1])), max(fabs(right[2]), fabs(right[3])))
        # true for NaN too
        if not largest < 1:
            break
        turn_by(right, attitude)
        focal[0] *= 1 + right[3]
        # the remaining error is about its square
        if largest < small_step:
            break
    return 0


cdef void _fit_alone(
    const double *xy, const double *w, const double *sigma, const Py_ssize_t *star, const Py_ssize_t *near,
    int n, int steps, double small_step, double *attitude, double *focal,
) noexcept nogil:
    """Fit as `_fit` does, from the rotation that is best with the given focal length: the result depends on no starting pose."""
    cdef double[9] b
    cdef double[3] v
    cdef int k, i, j
    for i in range(9):
        b[i] = 0.0
    for k in range(n):
        direction_of(xy[2 * star[k]], xy[2 * star[k] + 1], focal[0], v)
        for i in range(3):
            for j in range(3):
                b[3 * i + j] += v[i] * w[3 * near[k] + j]
    best_rotation(b, attitude)
    _fit(xy, w, sigma, star, near, n, steps, small_step, attitude, focal)


cdef void settle(
    FrameStars frame, bint mirrored, int n, const Visible *stars, const Rules *rules, double *radius, Matching *m, double *pixel,
    double *work, Settled *out,
) noexcept nogil:
    """Match a frame's n brightest stars with the catalogue's, fit the pose, and match again until no pair changes.

    radius  (n,): how far from their places stars may be at first; it changes
    pixel   room for the pixels (S, 2) of the catalogue stars, which remain
    work    room for 3 numbers a pair
    out     holds the pose to begin with; the fit begins with the frame's focal length
    """
    cdef const double *xy = pixels_of(frame, mirrored)
    cdef double *sigma = work + 2 * min(n, stars.count)
    cdef int turn, i, k
    cdef bint same
    out.count = 0
    order(m, xy, n)
    _project(out.attitude, out.focal, stars.w, stars.count, pixel)
    for turn in range(rules.rounds):
        match(m, n, pixel, stars.count, radius)
        same, k = turn > 0, 0
        for i in range(n):
            if m.near[i] < 0:
                continue
            same = same and k < out.count and out.star[k] == i and out.near[k] == m.near[i]
            out.star[k], out.near[k], sigma[k] = i, m.near[i], length(frame.error[i], rules.floor_px)
            k += 1
        if same and k == out.count:
            break
        out.count = k
        if out.count < rules.fewest_stars:
            break
        _refit(frame, xy, stars, rules, sigma, sigma, pixel, work, out)
        out.spread = rules.sigma_per_mad * median(work, 2 * out.count)
        gates(frame, rules, out.spread, n, radius)


cdef void _refit(
    FrameStars frame, const double *xy, const Visible *stars, const Rules *rules, const double *sigma, const double *floored,
    double *pixel, double *off, Settled *out,
) noexcept nogil:
    """Fit the pose to the pairs with errors sigma (M,); set pixels, offsets (M, 2) and residuals, with errors floored (M,)."""
    cdef double square, weight, whole = 0.0, weighted = 0.0, weights = 0.0
    cdef int k, i
    out.focal = frame.focal_px
    _fit_alone(
        xy, stars.w, sigma, out.star, out.near, out.count, rules.steps, rules.small_step, out.attitude, &out.focal
    )
    _project(out.attitude, out.focal, stars.w, stars.count, pixel)
    for k in range(out.count):
        weight = 1 / (floored[k] * floored[k])
        for i in range(2):
            off[2 * k + i] = fabs(xy[2 * out.star[k] + i] - pixel[2 * out.near[k] + i])
            square = off[2 * k + i] * off[2 * k + i]
            whole += square
            weighted += square * weight
            weights += weight
    out.rms, out.mean_square = sqrt(weighted / weights), whole / (2 * out.count)


cdef void gates(FrameStars frame, const Rules *rules, double spread, int n, double *radius) noexcept nogil:
    """Set how far (n,) px the n brightest stars may be from their places, where the residuals have a spread."""
    cdef int i
    for i in range(n):
        radius[i] = rules.gate_sigma * length(max(spread, rules.least_spread_px), frame.error[i]) + rules.gate_px


cdef void count_alike(
    FrameStars frame, bint mirrored, const Visible *stars, const Rules *rules, double *pixel, double *work, Settled *out
) noexcept nogil:
    """Fit the pose of pairs again, to all alike; the arguments are those of `settle`, and work for 4 numbers a pair."""
    cdef double *sigma = work + 2 * out.count
    cdef double *floored = sigma + out.count
    cdef int k
    for k in range(out.count):
        sigma[k] = length(frame.error[out.star[k]], out.spread)
        floored[k] = length(frame.error[out.star[k]], rules.floor_px)
    _refit(frame, pixels_of(frame, mirrored), stars, rules, sigma, floored, pixel, work, out)


def log_ratio(
    const double[:, ::1] xy, const double[::1] sigma_px, double area_px2, const double[:, ::1] attitude, double focal_px,
    const double[::1] width, const Py_ssize_t[::1] star, const Py_ssize_t[::1] rank, const double[:, ::1] w, Chances chances,
):
    """The logarithm of the evidence for a pose that was fitted to matched stars, without the prior's density.

    xy, sigma_px         (N, 2), (N,): the brightest detections, brightest first, on a frame of area_px2
    attitude, focal_px   of the pose
    width                (4,): of the prior
    star                 (M,): which of the detections are matched, in ascending order
    rank                 (M,): brightness rank of their catalogue stars on the frame
    w                    (M, 3): directions of these
    """
    rows = np.arange(star.shape[0])
    cdef Py_ssize_t[::1] row = rows
    cdef int n = xy.shape[0], many = star.shape[0]
    if many == 0:
        return weighed(&xy[0, 0], &sigma_px[0], n, area_px2, &attitude[0, 0], focal_px, &width[0], NULL, NULL, NULL, NULL, 0, &chances)
    return weighed(
        &xy[0, 0], &sigma_px[0], n, area_px2, &attitude[0, 0], focal_px, &width[0], &star[0], &rank[0], &w[0, 0], &row[0], many, &chances
    )


cdef double weighed(
    const double *xy, const double *sigma_px, int n, double area_px2, const double *attitude, double focal_px,
    const double *width, const Py_ssize_t *star, const Py_ssize_t *rank, const double *w, const Py_ssize_t *row, int many,
    const Chances *chances,
) except? -1:
    """What `log_ratio` returns, of the n brightest detections; w[row[k]] is the direction of the star matched with star[k]."""
    cdef int e, i, j, k, passed, hits = 0
    cdef double best = -1e300, total, most, product, largest, odds, least = 1e300, variance, volume
    cdef double[16] information
    cdef double[16] normal
    cdef double[8] slope
    cdef double[2] pixel
    cdef double[3] u
    room = room_for((n + 2 * many) * sizeof(double) + n * sizeof(int))
    cdef double *chance = <double *>start_of(room)
    cdef double *apart2 = chance + n
    cdef double *gain = apart2 + many
    # the row of the match of each detection; or none, or one that says nothing
    cdef int *hit = <int *>(gain + many)
    with nogil:
        for i in range(16):
            normal[i] = 0.0
        for i in range(n):
            hit[i] = NONE
        for k in range(many):
            turned(attitude, &w[3 * row[k]], u)
            _slopes(u, focal_px, pixel, slope)
            for i in range(4):
                for j in range(i + 1):
                    normal[4 * i + j] += slope[i] * slope[j] + slope[4 + i] * slope[4 + j]
            apart2[k] = (xy[2 * star[k]] - pixel[0]) ** 2 + (xy[2 * star[k] + 1] - pixel[1]) ** 2
            passed = <int>rank[k]
            for j in range(k):
                passed -= rank[k] > rank[j]
            gain[k] = (k + 2.0) / (star[k] + 3.0) * area_px2 / ((passed + 1.0) * (passed + 2.0)) / (2 * M_PI)
            least = min(least, sigma_px[star[k]] * sigma_px[star[k]])
            hit[star[k]] = k
        for i in range(n):
            # a false star, as often as those before it
            chance[i] = (i - hits + 1.0) / (i + 3.0)
            hits += hit[i] != NONE
        for i in range(n):
            for j in range(i):
                if (xy[2 * i] - xy[2 * j]) ** 2 + (xy[2 * i + 1] - xy[2 * j + 1]) ** 2 < chances.double_px * chances.double_px:
                    hit[i] = DOUBLED
        for e in range(ERRORS):
            # the logarithm of the largest product of the first odds; a product that gets too large or small goes into `total`
            total, most, product, largest = 0.0, -1e300, 1.0, 0.0
            for i in range(n):
                odds = 1.0 if hit[i] == DOUBLED else chance[i]
                if hit[i] >= 0:
                    variance = sigma_px[i] * sigma_px[i] + chances.errors_px[e] * chances.errors_px[e]
                    odds += gain[hit[i]] * exp(-0.5 * apart2[hit[i]] / variance) / variance
                product *= odds
                largest = max(largest, product)
                if i == n - 1 or not 1e-150 < product < 1e150:
                    most = max(most, total + log(largest))
                    total += log(product)
                    product, largest = 1.0, 0.0
            for i in range(16):
                information[i] = normal[i] / (least + chances.errors_px[e] * chances.errors_px[e])
            for i in range(4):
                information[5 * i] += 2 * M_PI / (width[i] * width[i])
            volume = 0.5 * (4 * log(2 * M_PI) - factored(information, 4))
            best = max(best, most + volume + chances.log_shares[e])
    return best
