# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Weighted least-squares fit of a star's place, flux and gains to its stamp, by Gauss-Newton, one star after the other."""

from libc.math cimport NAN, isfinite, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from starpos.detection._equations cimport invert_scaled, scaled_factor, solve_scaled
from starpos.detection._psf cimport BLOCK, Local, blocks, evaluate, local_of, sound, values
from starpos.detection._rules cimport MOST, PHASES, Rules, first_of_phase, is_settled, rows_within, sound_stamps
from starpos.detection._sums cimport any_bright, chi_square, of_sky, products, squares, take, weigh

cdef enum:
    # Numbers kept of each pixel.
    COLUMNS = 10


cdef struct Pixels:
    # Pixels of a stamp, one after the other: first those within reach of the star, phase after phase, then, if they are
    # wanted, the others. Places in the stamp, offsets px from the star, the light and the sky's variance, the PSF and (only
    # within reach) its derivatives times the star's gain, the weight in the fit, and its leverage.
    int count
    int all
    int[PHASES + 1] first
    int *place
    double *dx
    double *dy
    double *signal
    double *noise2
    double *value
    double *by_x
    double *by_y
    double *weight
    double *residual
    double *leverage
    # Of each row of the stamp the first column within reach, and the one after the last; and room for others.
    int *bound
    int *wanted
    # Of the star, when they were taken.
    double x
    double y
    # Of each pixel of the stamp, where it was marked last.
    unsigned char *outlier


cdef struct Star:
    double x
    double y
    double flux
    double[PHASES] gain
    double[PHASES] colour
    double[MOST * MOST] covariance
    double[MOST] right
    double[MOST] step
    # Of the flux at known place and gains.
    double information
    bint solved


cdef struct Stamp:
    # Of one star: its first column and row, size, and pixels; `outlier` is written.
    double left
    double top
    int size
    const float *signal
    const float *noise
    const unsigned char *good
    const unsigned char *phase
    unsigned char *outlier


cdef int _begin(Pixels *p, int area) except -1:
    """Take memory for so many pixels, and for whole blocks of them."""
    # the last step of a block may begin anywhere
    cdef int room = (blocks(area) + 1) * BLOCK
    cdef double *columns = <double *>malloc(COLUMNS * room * sizeof(double))
    p.place = <int *>malloc((room + 4 * area) * sizeof(int) + area)
    if columns == NULL or p.place == NULL:
        free(columns)
        free(p.place)
        raise MemoryError
    p.bound, p.wanted = p.place + room, p.place + room + 2 * area
    p.outlier = <unsigned char *>(p.place + room + 4 * area)
    p.count = p.all = 0
    p.dx, p.dy, p.signal, p.noise2 = columns, columns + room, columns + 2 * room, columns + 3 * room
    p.value, p.by_x, p.by_y = columns + 4 * room, columns + 5 * room, columns + 6 * room
    p.weight, p.residual, p.leverage = columns + 7 * room, columns + 8 * room, columns + 9 * room
    return 0


cdef void _gather(const Stamp *s, const Star *star, const Local *psf, Rules rules, bint again, Pixels *p) noexcept nogil:
    """Take the pixels of a stamp within reach of the star; the weight is 1 for those to be fitted, else 0.

    again: whether the star has some, which are most often the same
    """
    cdef int row, first, last, place, phase, some, n = 0, step = 2 if rules.own else 1
    rows_within(psf.axes, s.left - star.x, s.top - star.y, s.size, rules.widths2, p.wanted)
    if again and not memcmp(p.wanted, p.bound, 2 * s.size * sizeof(int)):
        for n in range(p.count):
            p.dx[n], p.dy[n] = p.dx[n] + (p.x - star.x), p.dy[n] + (p.y - star.y)
            p.weight[n] = s.good[p.place[n]] & ~s.outlier[p.place[n]]
        n = p.count
    else:
        p.wanted, p.bound = p.bound, p.wanted
        for phase in range(rules.phases):
            p.first[phase] = n
            # every other row has another two phases
            row = 1 if rules.own and s.phase[0] // 2 != phase // 2 else 0
            while row < s.size:
                first, last = p.bound[2 * row], p.bound[2 * row + 1]
                if rules.own:
                    first = first_of_phase(s.phase + row * s.size, first, last, phase)
                if first < last:
                    place, some = row * s.size + first, (last - first + step - 1) // step
                    take(
                        s.signal + place, s.noise + place, s.good + place, s.outlier + place, place, some, step,
                        s.left + first - star.x, s.top + row - star.y, p.place + n, p.dx + n, p.dy + n, p.signal + n,
                        p.noise2 + n, p.weight + n,
                    )
                    n += some
                row += step
    p.x, p.y = star.x, star.y
    p.count = p.all = p.first[rules.phases] = n
    evaluate(psf, p.dx, p.dy, n, p.value, p.by_x, p.by_y)
    for phase in range(rules.own):
        for place in range(p.first[phase], p.first[phase + 1]):
            p.value[place] *= star.gain[phase]
            p.by_x[place] *= star.gain[phase]
            p.by_y[place] *= star.gain[phase]


cdef void _gather_rest(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the pixels beyond reach too, with the weight 0."""
    cdef int row, column, place, k, n = p.count
    for row in range(s.size):
        for column in range(s.size):
            if not p.bound[2 * row] <= column < p.bound[2 * row + 1]:
                place = row * s.size + column
                p.place[n], p.dx[n], p.dy[n] = place, s.left + column - star.x, s.top + row - star.y
                p.signal[n], p.weight[n] = s.signal[place], 0.0
                n += 1
    p.all = n
    values(psf, p.dx + p.count, p.dy + p.count, n - p.count, p.value + p.count)
    for k in range(p.count, n):
        if rules.own:
            p.value[k] *= star.gain[s.phase[p.place[k]]]
        p.residual[k] = p.signal[k] - star.flux * p.value[k]


cdef double _first_flux(const Pixels *p) noexcept nogil:
    """The flux that explains the light at the first place, weighted by the sky's noise."""
    cdef double[2] sums
    of_sky(p.weight, p.noise2, p.value, p.signal, p.count, sums)
    return sums[1] / sums[0] if sums[0] > 0 and isfinite(sums[1]) else 0.0


cdef bint _mark(const Stamp *s, const Star *star, Rules rules, const Pixels *p) noexcept nogil:
    """Mark the good pixels that are much too bright for the star; whether they are those that were left out."""
    cdef double faintest = 0.0, light, variance
    cdef int k, place
    cdef bint same = True, bright, found
    memset(s.outlier, 0, s.size * s.size)
    # most stars have none, and had none
    any_bright(p.weight, p.residual, rules.outlier2, p.count, &found)
    if not found:
        return True
    for k in range(p.count):
        faintest = max(faintest, p.value[k])
    faintest = max(faintest * rules.faint * star.flux, 0.0)
    for k in range(p.count):
        place, bright = p.place[k], False
        if p.residual[k] > faintest and s.good[place]:
            light = max(star.flux * p.value[k], 0.0)
            variance = p.noise2[k] + rules.dn_per_photon * light + rules.misfit2 * light * light
            s.outlier[place] = bright = p.residual[k] * p.residual[k] > rules.outlier2 * variance
        same &= not s.good[place] or bright != (p.weight[k] > 0)
    return same


cdef void _sum_up(Star *star, Rules rules, const Pixels *p, double *normal) noexcept nogil:
    """Set the normal equations, normal (K, K), lower half, and star.right (K,).

    A pixel knows the gain of its phase alone; the star's own gains are held near the frame's.
    """
    cdef double[9] sums
    cdef double flux = star.flux, by
    cdef int n = rules.parameters, phase, first, row
    memset(normal, 0, n * n * sizeof(double))
    memset(star.right, 0, n * sizeof(double))
    for phase in range(rules.phases):
        first = p.first[phase]
        products(
            p.weight + first, p.by_x + first, p.by_y + first, p.value + first, p.residual + first, p.first[phase + 1] - first,
            sums,
        )
        normal[0] += flux * flux * sums[0]
        normal[n] += flux * flux * sums[1]
        normal[n + 1] += flux * flux * sums[2]
        normal[2 * n] += flux * sums[3]
        normal[2 * n + 1] += flux * sums[4]
        normal[2 * n + 2] += sums[5]
        star.right[0] += flux * sums[6]
        star.right[1] += flux * sums[7]
        star.right[2] += sums[8]
        if rules.own:
            row, by = 3 + phase, _by_gain(star, rules, phase)
            normal[row * n], normal[row * n + 1], normal[row * n + 2] = by * flux * sums[3], by * flux * sums[4], by * sums[5]
            normal[row * n + row] = rules.held + by * by * sums[5]
            star.right[row] = by * sums[8] - star.colour[phase] * rules.held
    star.information = normal[2 * n + 2]


cdef inline double _by_gain(const Star *star, Rules rules, int phase) noexcept nogil:
    """What turns a pixel's value of the PSF into its derivative by the star's gain at its phase, over the frame's."""
    return star.flux * rules.gain[phase] / star.gain[phase]


cdef void _step(Star *star, Rules rules) noexcept nogil:
    """Move the star by star.step (K,), at most 1 px."""
    cdef int a
    star.x += max(-1.0, min(star.step[0], 1.0))
    star.y += max(-1.0, min(star.step[1], 1.0))
    star.flux += star.step[2]
    for a in range(rules.own):
        star.colour[a] = max(-0.9, min(star.colour[a] + star.step[3 + a], 3.0))
        star.gain[a] = rules.gain[a] * (1 + star.colour[a])


cdef double _solve(Star *star, Rules rules, const double *factor, const double *scale) noexcept nogil:
    """Set star.step (K,) to the solution of the star's equations; its length in sigmas."""
    cdef double length2 = 0.0
    cdef int a
    for a in range(rules.parameters):
        star.step[a] = star.right[a]
    solve_scaled(factor, rules.parameters, scale, star.step)
    for a in range(rules.parameters):
        length2 += star.step[a] * star.right[a]
    return sqrt(length2)


cdef void _fit(
    const Stamp *s, const Local *psf, Rules rules, int rounds, bint whole, Pixels *p, Star *star
) noexcept nogil:
    """Fit a star that has a first place, in so many rounds at most; the pixels are at last, if asked for, the whole stamp.

    Rounds end when the star is settled: star.step is then the last step, so short that the pixels need not follow it; else 0.
    """
    cdef double[MOST * MOST] normal
    cdef double[MOST] scale
    cdef double length, before = 0.0
    cdef int round_, k
    cdef bint same
    for k in range(rules.phases):
        star.colour[k], star.gain[k] = 0.0, rules.gain[k]
    memset(s.outlier, 0, s.size * s.size)
    for round_ in range(rounds):
        _gather(s, star, psf, rules, round_ > 0, p)
        if round_ == 0:
            star.flux = _first_flux(p)
        weigh(p.signal, p.noise2, p.value, star.flux, rules.dn_per_photon, rules.misfit2, p.count, p.weight, p.residual)
        # a hot pixel or a neighbour's light is brighter than noise and an imperfect PSF explain
        same = 1 <= round_ < rounds - 1 and _mark(s, star, rules, p)
        _sum_up(star, rules, p, normal)
        star.solved = scaled_factor(normal, rules.parameters, scale)
        if not star.solved:
            star.x = star.y = star.flux = NAN
            for k in range(rules.parameters * rules.parameters):
                star.covariance[k] = NAN
            return
        if round_ == rounds - 1:
            memset(star.step, 0, sizeof(star.step))
            break
        length = _solve(star, rules, normal, scale)
        if same and is_settled(length, before, rules):
            break
        before = length
        _step(star, rules)
    invert_scaled(normal, rules.parameters, scale, star.covariance)
    if whole:
        _gather_rest(s, star, psf, rules, p)


cdef void _leverages(const Stamp *s, const Star *star, Rules rules, Pixels *p, float *leverage) noexcept nogil:
    """Set how far (0 to 1) each fitted pixel decides what the model has there; NaN if the star has no fit."""
    cdef double[6] form
    cdef const double *c = &star.covariance[0]
    cdef double flux = star.flux, by
    cdef int k, n = rules.parameters, phase, first, row
    if not star.solved:
        for k in range(s.size * s.size):
            leverage[k] = NAN
        return
    for phase in range(rules.phases):
        first = p.first[phase]
        form[0], form[1], form[2] = flux * flux * c[0], flux * flux * c[1], flux * flux * c[n + 1]
        form[3], form[4], form[5] = flux * c[2], flux * c[n + 2], c[2 * n + 2]
        if rules.own:
            row, by = 3 + phase, _by_gain(star, rules, phase)
            form[3], form[4] = form[3] + flux * by * c[row], form[4] + flux * by * c[n + row]
            form[5] += 2 * by * c[2 * n + row] + by * by * c[row * n + row]
        squares(
            p.weight + first, p.by_x + first, p.by_y + first, p.value + first, form, p.first[phase + 1] - first,
            p.leverage + first,
        )
    for k in range(p.count):
        leverage[p.place[k]] = <float>p.leverage[k]


def fitted(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const Py_ssize_t[::1] column, const Py_ssize_t[::1] row, const double[:] x,
    const double[:] y, const double[:, :, ::1] axes, const double[:, :, ::1] series, Rules rules, int rounds, bint weighed, bint whole,
):
    """Fit N stars to their stamps (N, S, S), as `detection.fit.fit_stars` explains.

    column, row   (N,) of each stamp's middle
    x, y          (N,) px: first places of the stars
    axes, series  (N, ...) or (1, ...): as `detection.psf.LocalPsf` has them
    weighed       whether the leverage of each pixel is wanted; else there is none
    whole         whether the model is wanted beyond reach; else it is 0 there

    Returns the columns of `detection.fit.Fit`, in their order. A star whose equations are singular has NaN.
    """
    cdef int n = signal.shape[0], size = signal.shape[1], area = size * size, most, k, a, b
    cdef int seen = size if weighed else 0
    cdef Pixels p
    cdef Local psf
    cdef Star star
    cdef Stamp s
    sound_stamps(signal, noise, good, phase, rules)
    sound(axes, series, n)
    if not (column.shape[0] == row.shape[0] == x.shape[0] == y.shape[0] == n and rounds > 0):
        raise ValueError(f"{column.shape[0]} stamps, {x.shape[0]} places, {rounds} rounds: {n} of each, 1 round or more")
    stars_, covariances, gains_ = np.empty((n, 6)), np.empty((n, 2, 2)), np.empty((n, rules.phases))
    images_, marks_ = np.empty((2, n, size, size), np.float32), np.zeros((2, n, size, size), np.uint8)
    leverage_ = np.zeros((n, seen, seen), np.float32)
    cdef double[:, ::1] found = stars_
    cdef double[:, :, ::1] covariance = covariances
    cdef double[:, ::1] gains = gains_
    cdef float[:, :, ::1] image = images_.reshape(2, n, area)
    cdef float[:, :, ::1] leverage = leverage_
    cdef unsigned char[:, :, ::1] mark = marks_.reshape(2, n, area)
    _begin(&p, area)
    s.size, s.outlier, most = size, p.outlier, rules.parameters
    with nogil:
        for k in range(n):
            s.left, s.top = column[k] - size // 2, row[k] - size // 2
            s.signal, s.noise, s.good = &signal[k, 0, 0], &noise[k, 0, 0], &good[k, 0, 0]
            s.phase = &phase[k, 0, 0]
            star.x, star.y = x[k], y[k]
            local_of(axes, series, k, &psf)
            _fit(&s, &psf, rules, rounds, whole, &p, &star)
            found[k, 4] = _told(
                &s, &star, &p, &image[0, k, 0], &image[1, k, 0], &mark[0, k, 0], &mark[1, k, 0], &found[k, 5]
            )
            if weighed:
                _leverages(&s, &star, rules, &p, &leverage[k, 0, 0])
            if star.solved:
                _step(&star, rules)
            found[k, 0], found[k, 1], found[k, 2] = star.x, star.y, star.flux
            found[k, 3] = 1 / sqrt(star.information)
            for a in range(2):
                for b in range(2):
                    covariance[k, a, b] = star.covariance[a * most + b]
            for a in range(rules.phases):
                gains[k, a] = star.gain[a]
    free(p.dx)
    free(p.place)
    at_x, at_y, flux, sigma, chi2, pixels = np.ascontiguousarray(stars_.T)
    residual, model = images_
    used, outlier = marks_.view(bool)
    return at_x, at_y, flux, sigma, covariances, gains_, chi2, pixels, residual, model, used, outlier, leverage_


cdef double _told(
    const Stamp *s, const Star *star, const Pixels *p, float *residual, float *model, unsigned char *used,
    unsigned char *outlier, double *pixels,
) noexcept nogil:
    """Set what is told of each pixel, and how many were fitted; chi-square per degree of freedom."""
    cdef int k, place, count = 0, area = s.size * s.size
    pixels[0] = 0.0
    if not star.solved:
        for k in range(area):
            residual[k] = model[k] = NAN
        return NAN
    if p.all < area:
        memset(model, 0, area * sizeof(float))
        memcpy(residual, s.signal, area * sizeof(float))
    for k in range(p.all):
        place = p.place[k]
        residual[place], model[place] = <float>p.residual[k], <float>(p.signal[k] - p.residual[k])
    for k in range(p.count):
        place = p.place[k]
        used[place], outlier[place] = p.weight[k] > 0, s.outlier[place]
        count += used[place]
    pixels[0] = count
    return chi_square(p.weight, p.residual, p.count) / max(count - 3, 1)
