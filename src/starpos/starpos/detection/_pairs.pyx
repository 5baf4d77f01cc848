# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Weighted least-squares fit of two stars to one stamp: places, fluxes and gains of both, by Gauss-Newton."""

from libc.math cimport NAN, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memset

import numpy as np

from starpos._numeric.wide cimport fused_void, lanes, sum_of
from starpos.detection._equations cimport invert, invert_scaled, scaled_factor, solve_scaled
from starpos.detection._psf cimport BLOCK, Local, blocks, evaluate, local_of, sound, values
from starpos.detection._rules cimport MOST, PHASES, Rules, first_of_phase, is_settled, rows_within, sound_stamps
from starpos.detection._sums cimport chi_square, products, weigh

cdef enum:
    # Parameters of both stars.
    ALL = 2 * MOST
    # Numbers kept of each pixel: of each star 5, 5 of their light, and row and column.
    COLUMNS = 17

# One step moves a star so far (px) at most.
cdef double FARTHEST = 0.5


cdef struct Image:
    # Of one of the stars, at the pixels one after the other: offsets px, and the PSF and its derivatives times the gain.
    double *dx
    double *dy
    double *value
    double *by_x
    double *by_y


cdef struct Pixels:
    # First those that are fitted, phase after phase, then, at last, the others.
    int count
    int all
    int[PHASES + 1] first
    int *place
    # Of each row of the stamp the first column within reach, and the one after the last: of the star, of the other.
    int *bound
    int *other
    double *row
    double *column
    double *signal
    double *noise2
    double *light
    double *weight
    double *residual
    Image[2] of


cdef struct Star:
    double x
    double y
    double flux
    double[PHASES] gain
    double[PHASES] colour


cdef struct Stamp:
    double left
    double top
    int size
    const float *signal
    const float *noise
    const unsigned char *good
    const unsigned char *phase


cdef int _begin(Pixels *p, int area) except -1:
    """Take memory for so many pixels, and for whole blocks of them."""
    # the last step of a block may begin anywhere
    cdef int room = (blocks(area) + 1) * BLOCK, k
    cdef double *columns = <double *>malloc(COLUMNS * room * sizeof(double))
    p.place = <int *>malloc((room + 4 * area) * sizeof(int))
    if columns == NULL or p.place == NULL:
        free(columns)
        free(p.place)
        raise MemoryError
    p.bound, p.other = p.place + room, p.place + room + 2 * area
    p.signal, p.noise2, p.light = columns, columns + room, columns + 2 * room
    p.weight, p.residual = columns + 3 * room, columns + 4 * room
    p.row, p.column = columns + 15 * room, columns + 16 * room
    for k in range(2):
        columns += 5 * room
        p.of[k].dx, p.of[k].dy, p.of[k].value = columns, columns + room, columns + 2 * room
        p.of[k].by_x, p.of[k].by_y = columns + 3 * room, columns + 4 * room
    return 0


cdef void _gather(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the good pixels of a stamp within reach of a star, to be fitted with the weight 1."""
    cdef int place, phase, row, column, last, k, n = 0, step = 2 if rules.own else 1
    rows_within(psf.axes, s.left - star[0].x, s.top - star[0].y, s.size, rules.widths2, p.bound)
    rows_within(psf.axes, s.left - star[1].x, s.top - star[1].y, s.size, rules.widths2, p.other)
    for phase in range(rules.phases):
        p.first[phase] = n
        for row in range(s.size):
            column, last = _both_within(p, row)
            if rules.own:
                column = first_of_phase(s.phase + row * s.size, column, last, phase)
            while column < last:
                place = row * s.size + column
                if s.good[place] and _within(p, row, column):
                    p.place[n], p.row[n], p.column[n] = place, row, column
                    p.signal[n], p.noise2[n], p.weight[n] = s.signal[place], <double>s.noise[place] * s.noise[place], 1.0
                    n += 1
                column += step
    p.count = p.all = p.first[rules.phases] = n
    for k in range(2):
        _offset(s, &star[k], p, &p.of[k], 0)
        evaluate(psf, p.of[k].dx, p.of[k].dy, n, p.of[k].value, p.of[k].by_x, p.of[k].by_y)
        if rules.own:
            _by_own_gain(s, &star[k], p, &p.of[k], 0)


cdef void _gather_rest(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the other pixels too, with the weight 0."""
    cdef int row, column, place, k, n = p.count
    for row in range(s.size):
        for column in range(s.size):
            place = row * s.size + column
            if not (s.good[place] and _within(p, row, column)):
                p.place[n], p.row[n], p.column[n] = place, row, column
                p.signal[n], p.weight[n] = s.signal[place], 0.0
                n += 1
    p.all = n
    for k in range(2):
        _offset(s, &star[k], p, &p.of[k], p.count)
        values(psf, p.of[k].dx + p.count, p.of[k].dy + p.count, n - p.count, p.of[k].value + p.count)
        if rules.own:
            _by_own_gain(s, &star[k], p, &p.of[k], p.count)
    for k in range(p.count, n):
        p.residual[k] = p.signal[k] - star[0].flux * p.of[0].value[k] - star[1].flux * p.of[1].value[k]


cdef inline bint _within(const Pixels *p, int row, int column) noexcept nogil:
    """Whether a pixel is within reach of one of the stars."""
    return p.bound[2 * row] <= column < p.bound[2 * row + 1] or p.other[2 * row] <= column < p.other[2 * row + 1]


cdef inline (int, int) _both_within(const Pixels *p, int row) noexcept nogil:
    """The first column of a row within reach of one of the stars, and the one after the last."""
    if p.bound[2 * row] == p.bound[2 * row + 1]:
        return p.other[2 * row], p.other[2 * row + 1]
    if p.other[2 * row] == p.other[2 * row + 1]:
        return p.bound[2 * row], p.bound[2 * row + 1]
    return min(p.bound[2 * row], p.other[2 * row]), max(p.bound[2 * row + 1], p.other[2 * row + 1])


cdef void _offset(const Stamp *s, const Star *star, const Pixels *p, Image *of, int first) noexcept nogil:
    """Set the offsets of the pixels from a star, from a pixel on."""
    cdef int k
    for k in range(first, p.all):
        of.dx[k], of.dy[k] = s.left + p.column[k] - star.x, s.top + p.row[k] - star.y


cdef void _by_own_gain(const Stamp *s, const Star *star, const Pixels *p, Image *of, int first) noexcept nogil:
    """Multiply a star's image, and where it is fitted the derivatives, by its gains, from a pixel on."""
    cdef double gain
    cdef int k
    for k in range(first, p.all):
        gain = star.gain[s.phase[p.place[k]]]
        of.value[k] *= gain
        if k < p.count:
            of.by_x[k], of.by_y[k] = of.by_x[k] * gain, of.by_y[k] * gain


cdef void _first_fluxes(const Pixels *p, Star *star) noexcept nogil:
    """Set the fluxes that explain the light at the first places, weighted by the sky's noise, and at least the given ones."""
    cdef double aa = 0.0, ab = 0.0, bb = 0.0, sa = 0.0, sb = 0.0, a, b, w, volume
    cdef int k
    for k in range(p.count):
        a, b, w = p.of[0].value[k], p.of[1].value[k], p.weight[k] / p.noise2[k]
        aa, ab, bb = aa + w * a * a, ab + w * a * b, bb + w * b * b
        sa, sb = sa + w * a * p.signal[k], sb + w * b * p.signal[k]
    volume = max(aa * bb - ab * ab, 1e-12)
    star[0].flux = max((bb * sa - ab * sb) / volume, star[0].flux)
    star[1].flux = max((aa * sb - ab * sa) / volume, star[1].flux)


cdef void _weigh(const Star *star, Rules rules, Pixels *p) noexcept nogil:
    """Set residuals and weights by the model."""
    cdef int k
    for k in range(p.count):
        p.light[k] = star[0].flux * p.of[0].value[k] + star[1].flux * p.of[1].value[k]
    weigh(p.signal, p.noise2, p.light, 1.0, rules.dn_per_photon, rules.misfit2, p.count, p.weight, p.residual)


cdef fused_void _crossed(const double *weight, const double **one, const double **other, int n, double *out) noexcept nogil:
    """Products of three columns with three others and the weights, summed over n pixels: ad, ae, af, bd, be, bf, cd, ce, cf."""
    cdef lanes[9] sums
    cdef lanes wa
    cdef int a, b, p
    memset(sums, 0, sizeof(sums))
    for p in range(0, n - 3, 4):
        for a in range(3):
            wa = (<const lanes *>(weight + p))[0] * (<const lanes *>(one[a] + p))[0]
            for b in range(3):
                sums[3 * a + b] += wa * (<const lanes *>(other[b] + p))[0]
    for a in range(3):
        for b in range(3):
            out[3 * a + b] = sum_of(&sums[3 * a + b])
            for p in range(n // 4 * 4, n):
                out[3 * a + b] += weight[p] * one[a][p] * other[b][p]


cdef void _products(const Pixels *p, int first, int n, double *square, double *right) noexcept nogil:
    """Sums over n pixels of the products (6, 6), lower half, of both stars' derivatives and values, and with the residuals (6,)."""
    cdef const double *column[6]
    cdef double[9] sums
    cdef int k, a, b
    for k in range(2):
        column[3 * k], column[3 * k + 1] = p.of[k].by_x + first, p.of[k].by_y + first
        column[3 * k + 2] = p.of[k].value + first
        products(p.weight + first, column[3 * k], column[3 * k + 1], column[3 * k + 2], p.residual + first, n, sums)
        a = 21 * k
        square[a], square[a + 6], square[a + 7] = sums[0], sums[1], sums[2]
        square[a + 12], square[a + 13], square[a + 14] = sums[3], sums[4], sums[5]
        right[3 * k], right[3 * k + 1], right[3 * k + 2] = sums[6], sums[7], sums[8]
    _crossed(p.weight + first, column + 3, column, n, sums)
    for a in range(3):
        for b in range(3):
            square[6 * (3 + a) + b] = sums[3 * a + b]


cdef void _sum_up(const Star *star, Rules rules, const Pixels *p, double *normal, double *right) noexcept nogil:
    """Set the normal equations of both stars, normal (K, K), lower half, and right (K,).

    A pixel knows of each star the place, the flux and the gain of its own phase, which is held near the frame's.
    """
    # of each unknown: what a column is multiplied by, which one, and the unknown's row
    cdef double[8] slope
    cdef int[8] column
    cdef int[8] row
    cdef double[36] square
    cdef double[6] with_residual
    cdef int n = 2 * rules.parameters, each = 4 if rules.own else 3, k, a, b, phase
    memset(normal, 0, n * n * sizeof(double))
    memset(right, 0, n * sizeof(double))
    for phase in range(rules.phases):
        _products(p, p.first[phase], p.first[phase + 1] - p.first[phase], square, with_residual)
        for k in range(2):
            for a in range(each):
                column[k * each + a], row[k * each + a] = 3 * k + min(a, 2), k * rules.parameters + a
                slope[k * each + a] = star[k].flux if a < 2 else 1.0
            if rules.own:
                a = k * each + 3
                slope[a], row[a] = star[k].flux * rules.gain[phase] / star[k].gain[phase], k * rules.parameters + 3 + phase
                normal[row[a] * n + row[a]], right[row[a]] = rules.held, -star[k].colour[phase] * rules.held
        for a in range(2 * each):
            right[row[a]] += slope[a] * with_residual[column[a]]
            for b in range(a + 1):
                normal[row[a] * n + row[b]] += slope[a] * slope[b] * square[6 * column[a] + column[b]]


cdef void _move(Star *star, Rules rules, const double *step, double least) noexcept nogil:
    """Move both stars by a step (K,).

    A flux keeps the share `least` in one step: a star without light could not move any more, its place changes nothing.
    """
    cdef int k, a
    for k in range(2):
        star[k].x += max(-FARTHEST, min(step[0], FARTHEST))
        star[k].y += max(-FARTHEST, min(step[1], FARTHEST))
        star[k].flux = max(star[k].flux + step[2], least * star[k].flux)
        for a in range(rules.own):
            star[k].colour[a] = max(-0.9, min(star[k].colour[a] + step[3 + a], 3.0))
            star[k].gain[a] = rules.gain[a] * (1 + star[k].colour[a])
        step += rules.parameters


cdef void _fit(
    const Stamp *s, const Local *psf, Rules rules, int rounds, double least, Pixels *p, Star *star, double *covariance,
    double *sigma, double *step,
) noexcept nogil:
    """Fit two stars that have first places, and least fluxes; the pixels are at last all of the stamp.

    Sets covariance (K, K), each flux's sigma at known gains, and a last step (K,), so short that pixels need not follow it.
    """
    cdef double[ALL * ALL] normal
    cdef double[ALL] scale
    cdef double[ALL] right
    cdef double[36] known
    cdef double[36] inverse
    cdef double length2, before = 0.0
    cdef int round_, k, a, b, n = 2 * rules.parameters
    cdef bint solved = False
    for k in range(2):
        for a in range(rules.phases):
            star[k].colour[a], star[k].gain[a] = 0.0, rules.gain[a]
    for round_ in range(rounds + 1):
        _gather(s, star, psf, rules, p)
        if round_ == 0:
            _first_fluxes(p, star)
        _weigh(star, rules, p)
        _sum_up(star, rules, p, normal, right)
        for a in range(6):
            for b in range(6):
                known[6 * a + b] = normal[(a // 3 * rules.parameters + a % 3) * n + b // 3 * rules.parameters + b % 3]
        memset(step, 0, n * sizeof(double))
        solved = scaled_factor(normal, n, scale)
        # without a solution nothing moves any more
        if not solved or round_ == rounds:
            break
        for a in range(n):
            step[a] = right[a]
        solve_scaled(normal, n, scale, step)
        length2 = 0.0
        for a in range(n):
            length2 += step[a] * right[a]
        if is_settled(sqrt(length2), before, rules):
            break
        before = sqrt(length2)
        _move(star, rules, step, least)
    if solved:
        invert_scaled(normal, n, scale, covariance)
    else:
        for a in range(n * n):
            covariance[a] = NAN
    _gather_rest(s, star, psf, rules, p)
    invert(known, 6, inverse)
    sigma[0], sigma[1] = sqrt(inverse[14]), sqrt(inverse[35])


def fitted_pairs(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, const double[:, :, ::1] first,
    const double[::1] least_flux, const double[:, :, ::1] axes, const double[:, :, ::1] series, Rules rules, int rounds,
    double least,
):
    """Fit a pair of stars to each of N stamps (N, S, S), as `detection.blend` explains.

    x, y        (N,) px: of each stamp's middle
    first       (2, N, 2) px: first places of the stars and of their companions
    least_flux  (N,) DN: of both at the beginning
    axes        (N, 2, 2) or (1, 2, 2), and
    series      (N, I, J) or (1, I, J): as `detection.psf.LocalPsf` has them
    least       share of its flux that a star keeps in one step

    Returns the columns of `detection.blend.Pairs`, in their order. Where the equations are singular errors are NaN.
    """
    cdef int n = signal.shape[0], size = signal.shape[1], area = size * size, k, j, a, b, most
    cdef Pixels p
    cdef Local psf
    cdef Star[2] star
    cdef Stamp s
    cdef double[ALL * ALL] covariance
    cdef double[2] sigma
    cdef double[ALL] step
    sound_stamps(signal, noise, good, phase, rules)
    sound(axes, series, n)
    if not (x.shape[0] == y.shape[0] == first.shape[1] == least_flux.shape[0] == n and rounds > 0):
        raise ValueError(f"{x.shape[0]} stamps, {first.shape[1]} places, {rounds} rounds: {n} of each, 1 round or more")
    if not (first.shape[0] == first.shape[2] == 2):
        raise ValueError("places of two stars, of two numbers each, are needed")
    stars_, gains_ = np.empty((4, 2, n)), np.empty((2, n, rules.phases))
    covariances_, chi2_ = np.empty((2, n, 2, 2)), np.zeros(n)
    models_, used_ = np.zeros((2, n, size, size), np.float32), np.zeros((n, size, size), np.uint8)
    cdef double[:, :, ::1] column = stars_
    cdef double[:, :, ::1] gains = gains_
    cdef double[:, :, :, ::1] covariances = covariances_
    cdef double[::1] chi2 = chi2_
    cdef float[:, :, ::1] model = models_.reshape(2, n, area)
    cdef unsigned char[:, ::1] used = used_.reshape(n, area)
    s.size, most = size, 2 * rules.parameters
    _begin(&p, area)
    with nogil:
        for k in range(n):
            s.left, s.top, s.signal, s.noise = x[k] - size // 2, y[k] - size // 2, &signal[k, 0, 0], &noise[k, 0, 0]
            s.good, s.phase = &good[k, 0, 0], &phase[k, 0, 0]
            for j in range(2):
                star[j].x, star[j].y, star[j].flux = first[j, k, 0], first[j, k, 1], least_flux[k]
            local_of(axes, series, k, &psf)
            _fit(&s, &psf, rules, rounds, least, &p, star, covariance, sigma, step)
            for j in range(2):
                for a in range(area):
                    model[j, k, p.place[a]] = <float>(star[j].flux * p.of[j].value[a])
            _move(star, rules, step, least)
            for j in range(2):
                column[0, j, k], column[1, j, k], column[2, j, k] = star[j].x, star[j].y, star[j].flux
                column[3, j, k] = sigma[j]
                for a in range(2):
                    for b in range(2):
                        covariances[j, k, a, b] = covariance[(j * rules.parameters + a) * most + j * rules.parameters + b]
                for a in range(rules.phases):
                    gains[j, k, a] = star[j].gain[a]
            for a in range(area):
                used[k, p.place[a]] = p.weight[a] > 0
            chi2[k] = chi_square(p.weight, p.residual, p.count)
    free(p.signal)
    free(p.place)
    at_x, at_y, flux, sigmas = stars_
    return at_x, at_y, flux, sigmas, gains_, covariances_, models_, used_.view(bool), chi2_
