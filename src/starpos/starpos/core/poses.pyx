# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Poses of a camera among the stars: fitted to stars that are matched meanwhile, and weighed against chance."""

from libc.math cimport M_PI, exp, fabs, hypot, log, sqrt
from libc.stdlib cimport free, malloc

import numpy as np

from starpos.core.algebra cimport best_rotation, factored, solved, turn_by, turned
from starpos.core.frame cimport Frame, direction_of, on_frame, pixel_of
from starpos.core.matching cimport Matching, begin, match, order

cdef enum:
    NONE = -1
    DOUBLED = -2


cdef void _project(const double *attitude, double focal, const double[:, ::1] w, double *pixel) noexcept nogil:
    """Pixels (S, 2) of directions w (S, 3)."""
    cdef double[3] u
    cdef int s
    for s in range(w.shape[0]):
        turned(attitude, &w[s, 0], u)
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
    const double[:, ::1] xy, const double[:, ::1] w, const double *sigma, const Py_ssize_t *star, const Py_ssize_t *near,
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
            turned(attitude, &w[near[k], 0], u)
            _slopes(u, focal[0], pixel, slope)
            weight = 1 / (sigma[k] * sigma[k])
            for axis in range(2):
                off = (xy[star[k], axis] - pixel[axis]) * weight
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
    const double[:, ::1] xy, const double[:, ::1] w, const double *sigma, const Py_ssize_t *star, const Py_ssize_t *near,
    int n, int steps, double small_step, double *attitude, double *focal,
) noexcept nogil:
    """As `_fit`, from the rotation that is best with the given focal length: the result depends on no starting pose."""
    cdef double[9] b
    cdef double[3] v
    cdef int k, i, j
    for i in range(9):
        b[i] = 0.0
    for k in range(n):
        direction_of(xy[star[k], 0], xy[star[k], 1], focal[0], v)
        for i in range(3):
            for j in range(3):
                b[3 * i + j] += v[i] * w[near[k], j]
    best_rotation(b, attitude)
    _fit(xy, w, sigma, star, near, n, steps, small_step, attitude, focal)


def fitted(
    const double[:, ::1] xy, const double[:, ::1] w, const double[::1] sigma_px, attitude, double focal_px, bint alone,
    int steps, double small_step,
):
    """Fit attitude (3, 3) and focal length to pixels xy (N, 2), with errors sigma_px (N,), of directions w (N, 3).

    alone: without the given attitude, so that the result does not depend on it.
    """
    cdef int k, n = xy.shape[0]
    both = np.arange(n)
    out = np.array(attitude, float)
    cdef Py_ssize_t[::1] rows = both
    cdef double[:, ::1] turned_to = out
    if n == 0:
        return out, focal_px
    if alone:
        _fit_alone(xy, w, &sigma_px[0], &rows[0], &rows[0], n, steps, small_step, &turned_to[0, 0], &focal_px)
    else:
        _fit(xy, w, &sigma_px[0], &rows[0], &rows[0], n, steps, small_step, &turned_to[0, 0], &focal_px)
    return out, focal_px


cdef double _median(double *values, int n) noexcept nogil:
    """The value (n,) that would stand at n // 2 if they were sorted (Hoare's selection); it disturbs their order."""
    cdef int low = 0, high = n - 1, k = n // 2, i, j
    cdef double pivot
    while low < high:
        pivot = values[k]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return values[k]


def settled(
    Frame frame, bint mirrored, int n, const double[:, ::1] w, const double[:, ::1] attitude, double focal_px,
    const double[::1] radius_px, rules,
):
    """Match a frame's n brightest stars with stars w (S, 3), fit the pose, and match again until no pair changes.

    mirrored            whether the frame's rows are flipped
    attitude, focal_px  the pose to begin with; the fit begins with the frame's focal length
    radius_px           (n,): how far from their places stars may be at first
    rules               `full.RULES`

    Returns attitude (3, 3), focal length, the rows of the pairs in the frame and in w (M,), whether each of the stars is
    well inside the frame (S,), and of the residuals: the spread (px) that their median shows, the rms (px) along one axis
    with the weights of the fit, and their mean square (px2); None if there are too few pairs.
    """
    cdef const double[:, ::1] xy = frame.xy[mirrored]
    cdef int stars = w.shape[0], most = min(n, stars), k, i, count = 0, turn
    cdef int rounds = rules.rounds, fewest = rules.fewest_stars, steps = rules.steps
    cdef double floor_px = rules.floor_px, per_mad = rules.sigma_per_mad, least = rules.least_spread_px
    cdef double gate_sigma = rules.gate_sigma, gate_px = rules.gate_px, small_step = rules.small_step
    cdef double inside_px = rules.inside_px
    cdef double focal = focal_px, spread = 0.0, square, whole = 0.0, weighted = 0.0, weights = 0.0
    cdef bint same
    if most < fewest:
        return None
    out, pair, within = np.empty((3, 3)), np.empty((2, most), np.intp), np.empty(stars, bool)
    cdef unsigned char[::1] inside = within.view(np.uint8)
    cdef double[:, ::1] turned_to = out
    cdef Py_ssize_t[:, ::1] rows = pair
    cdef Matching m
    m.memory = NULL
    cdef double *memory = <double *>malloc((2 * stars + n + 3 * most) * sizeof(double))
    cdef double *pixel = memory
    cdef double *radius = pixel + 2 * stars
    cdef double *sigma = radius + n
    cdef double *off = sigma + most
    try:
        if memory == NULL:
            raise MemoryError
        begin(&m, n, stars)
        with nogil:
            order(&m, xy, n)
            for i in range(n):
                radius[i] = radius_px[i]
            _project(&attitude[0, 0], focal, w, pixel)
            match(&m, n, pixel, stars, radius)
            for turn in range(rounds):
                same, k = turn > 0, 0
                for i in range(n):
                    if m.near[i] < 0:
                        continue
                    same = same and k < count and rows[0, k] == i and rows[1, k] == m.near[i]
                    rows[0, k], rows[1, k], sigma[k] = i, m.near[i], hypot(frame.sigma[i], floor_px)
                    k += 1
                if same and k == count:
                    break
                count = k
                if count < fewest:
                    break
                focal = frame.focal
                _fit_alone(
                    xy, w, sigma, &rows[0, 0], &rows[1, 0], count, steps, small_step, &turned_to[0, 0], &focal
                )
                _project(&turned_to[0, 0], focal, w, pixel)
                whole = weighted = weights = 0.0
                for k in range(count):
                    for i in range(2):
                        off[2 * k + i] = fabs(xy[rows[0, k], i] - pixel[2 * rows[1, k] + i])
                        square = off[2 * k + i] * off[2 * k + i]
                        whole += square
                        weighted += square / (sigma[k] * sigma[k])
                        weights += 1 / (sigma[k] * sigma[k])
                spread = per_mad * _median(off, 2 * count)
                for i in range(n):
                    radius[i] = gate_sigma * hypot(max(spread, least), frame.sigma[i]) + gate_px
                if turn + 1 < rounds:
                    match(&m, n, pixel, stars, radius)
        if count < fewest:
            return None
        for i in range(stars):
            inside[i] = on_frame(frame, &pixel[2 * i], -inside_px)
        star, near = pair[0, :count], pair[1, :count]
        return out, focal, star, near, within, spread, sqrt(weighted / weights), whole / (2 * count)
    finally:
        free(memory)
        free(m.memory)


def log_ratio(
    const double[:, ::1] xy, const double[::1] sigma_px, double area_px2, const double[:, ::1] attitude, double focal_px,
    const double[::1] width, const Py_ssize_t[::1] star, const Py_ssize_t[::1] rank, const double[:, ::1] w,
    const double[::1] errors_px, const double[::1] log_shares, double double_px,
):
    """The logarithm of the evidence of `evidence.log_evidence`, without the prior's density.

    width (4,): of the prior.  errors_px, log_shares (E,): errors beside the centroids' own, and their probabilities.
    """
    cdef int n = xy.shape[0], many = star.shape[0], e, i, j, k, passed, hits = 0
    cdef double best = -1e300, total, most, odds, least = 1e300, variance, volume
    cdef double[16] information
    cdef double[16] normal
    cdef double[8] slope
    cdef double[2] pixel
    cdef double[3] u
    cdef double *chance = <double *>malloc((n + 2 * many) * sizeof(double))
    cdef double *apart2 = chance + n
    cdef double *gain = apart2 + many
    # the row of the match of each detection; or none, or one that says nothing
    cdef int *hit = <int *>malloc((n + 1) * sizeof(int))
    if chance == NULL or hit == NULL:
        free(chance)
        free(hit)
        raise MemoryError
    with nogil:
        for i in range(16):
            normal[i] = 0.0
        for i in range(n):
            hit[i] = NONE
        for k in range(many):
            turned(&attitude[0, 0], &w[k, 0], u)
            _slopes(u, focal_px, pixel, slope)
            for i in range(4):
                for j in range(i + 1):
                    normal[4 * i + j] += slope[i] * slope[j] + slope[4 + i] * slope[4 + j]
            apart2[k] = (xy[star[k], 0] - pixel[0]) ** 2 + (xy[star[k], 1] - pixel[1]) ** 2
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
                if (xy[i, 0] - xy[j, 0]) ** 2 + (xy[i, 1] - xy[j, 1]) ** 2 < double_px * double_px:
                    hit[i] = DOUBLED
        for e in range(errors_px.shape[0]):
            total, most = 0.0, -1e300
            for i in range(n):
                odds = 1.0 if hit[i] == DOUBLED else chance[i]
                if hit[i] >= 0:
                    variance = sigma_px[i] * sigma_px[i] + errors_px[e] * errors_px[e]
                    odds += gain[hit[i]] * exp(-0.5 * apart2[hit[i]] / variance) / variance
                total += log(odds)
                most = max(most, total)
            for i in range(16):
                information[i] = normal[i] / (least + errors_px[e] * errors_px[e])
            for i in range(4):
                information[5 * i] += 2 * M_PI / (width[i] * width[i])
            volume = 0.5 * (4 * log(2 * M_PI) - factored(information, 4))
            best = max(best, most + volume + log_shares[e])
    free(chance)
    free(hit)
    return best
