# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Weighted least-squares fit of a star's place, flux and gains to its stamp, by Gauss-Newton, one star after the other."""

from libc.math cimport NAN, ceil, floor, isfinite, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memset

import numpy as np

from starpos.core.equations cimport invert_scaled, scaled_factor, solve_scaled
from starpos.core.limits cimport unsigned_char, within
from starpos.core.psf cimport BLOCK, Local, blocks, evaluate, local_of, sound, values
from starpos.core.sums cimport products, weigh

cdef enum:
    # Numbers kept of each pixel.
    COLUMNS = 9


cdef class Rules:
    """What `fitted` goes by: `detection.fit` explains each.

    gain                             (P,): of each phase, P = 1 or 4
    colour_spread                    of a star's gains, 1 sigma
    dn_per_photon, misfit            of the light's noise
    widths                           within which pixels are fitted
    outlier, faint                   sigmas, and the share of the star's brightest pixel, above which a pixel is one
    settled                          sigmas that a star may still be from where more rounds would bring it; 0: all are made
    """

    def __init__(
        self, gain, double colour_spread, double dn_per_photon, double misfit, double widths, double outlier, double faint,
        double settled,
    ):
        cdef int k
        if len(gain) not in (1, PHASES):
            raise ValueError(f"{len(gain)} gains: a frame has 1, a colour mosaic {PHASES}")
        self.phases, self.own = len(gain), len(gain) if len(gain) > 1 else 0
        self.parameters = 3 + self.own
        for k in range(self.phases):
            self.gain[k] = gain[k]
        self.held, self.dn_per_photon, self.misfit2 = colour_spread**-2, dn_per_photon, misfit * misfit
        self.widths2, self.outlier2, self.faint, self.settled = widths * widths, outlier * outlier, faint, settled


cdef struct Pixels:
    # Pixels of a stamp, one after the other: first those within reach of the star, phase after phase, then, at last, the
    # others. Places in the stamp, offsets px from the star, the light and the sky's variance, the PSF and (only
    # within reach) its derivatives times the star's gain, and the weight in the fit.
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
    # Of each row of the stamp the first column within reach, and the one after the last.
    int *bound


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
    p.place = <int *>malloc((room + 2 * area) * sizeof(int))
    if columns == NULL or p.place == NULL:
        free(columns)
        free(p.place)
        raise MemoryError
    p.bound = p.place + room
    p.count = p.all = 0
    p.dx, p.dy, p.signal, p.noise2 = columns, columns + room, columns + 2 * room, columns + 3 * room
    p.value, p.by_x, p.by_y = columns + 4 * room, columns + 5 * room, columns + 6 * room
    p.weight, p.residual = columns + 7 * room, columns + 8 * room
    return 0


cdef void _gather(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the pixels of a stamp within reach of the star; the weight is 1 for those to be fitted, else 0."""
    cdef int row, column, place, phase, k, n = 0
    for row in range(s.size):
        p.bound[2 * row], p.bound[2 * row + 1] = _inside(psf, s.top + row - star.y, s.left - star.x, s.size, rules.widths2)
    for phase in range(rules.phases):
        p.first[phase] = n
        for row in range(s.size):
            place = row * s.size
            for column in range(p.bound[2 * row], p.bound[2 * row + 1]):
                if not rules.own or s.phase[place + column] == phase:
                    p.place[n], p.dx[n], p.dy[n] = place + column, s.left + column - star.x, s.top + row - star.y
                    n += 1
    p.count = p.all = p.first[rules.phases] = n
    for k in range(n):
        place = p.place[k]
        p.signal[k], p.noise2[k] = s.signal[place], <double>s.noise[place] * s.noise[place]
        p.weight[k] = s.good[place] & ~s.outlier[place]
    evaluate(psf, p.dx, p.dy, n, p.value, p.by_x, p.by_y)
    if rules.own:
        _by_own_gain(s, star, p, 0)


cdef void _gather_rest(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the pixels beyond reach too, with the weight 0; none of them is an outlier."""
    cdef int row, column, place, k, n = p.count
    for row in range(s.size):
        for column in range(s.size):
            if not p.bound[2 * row] <= column < p.bound[2 * row + 1]:
                place = row * s.size + column
                p.place[n], p.dx[n], p.dy[n] = place, s.left + column - star.x, s.top + row - star.y
                p.signal[n], p.weight[n], s.outlier[place] = s.signal[place], 0.0, False
                n += 1
    p.all = n
    values(psf, p.dx + p.count, p.dy + p.count, n - p.count, p.value + p.count)
    if rules.own:
        _by_own_gain(s, star, p, p.count)
    for k in range(p.count, n):
        p.residual[k] = p.signal[k] - star.flux * p.value[k]


cdef void _by_own_gain(const Stamp *s, const Star *star, Pixels *p, int first) noexcept nogil:
    """Multiply the PSF, and within reach its derivatives, by the star's gains, from a pixel on."""
    cdef double gain
    cdef int k
    for k in range(first, p.all):
        gain = star.gain[s.phase[p.place[k]]]
        p.value[k] *= gain
        if k < p.count:
            p.by_x[k], p.by_y[k] = p.by_x[k] * gain, p.by_y[k] * gain


cdef inline (int, int) _inside(const Local *psf, double dy, double left, int size, double widths2) noexcept nogil:
    """The first column of a row dy px from the star that lies within so many squared widths, and the one after the last."""
    cdef double xx = psf.axes[0] * psf.axes[0] + psf.axes[2] * psf.axes[2]
    cdef double half = (psf.axes[0] * psf.axes[1] + psf.axes[2] * psf.axes[3]) * dy / xx
    cdef double yy = (psf.axes[1] * psf.axes[1] + psf.axes[3] * psf.axes[3]) * dy * dy
    cdef double reach2 = half * half - (yy - widths2) / xx, reach
    if not reach2 > 0:
        return 0, 0
    reach = sqrt(reach2)
    return <int>max(0.0, min(ceil(-half - reach - left), size)), <int>max(0.0, min(floor(-half + reach - left) + 1, size))


cdef double _first_flux(const Pixels *p) noexcept nogil:
    """The flux that explains the light at the first place, weighted by the sky's noise."""
    cdef double above = 0.0, below = 0.0
    cdef int k
    for k in range(p.count):
        if p.weight[k] > 0:
            above += p.value[k] * p.signal[k] / p.noise2[k]
            below += p.value[k] * p.value[k] / p.noise2[k]
    return above / below if below > 0 and isfinite(above) else 0.0


cdef bint _mark(const Stamp *s, const Star *star, Rules rules, const Pixels *p) noexcept nogil:
    """Mark the good pixels that are much too bright for the star; whether they are those that were left out."""
    cdef double faintest = 0.0, light, variance
    cdef int k, place
    cdef bint same = True, bright
    memset(s.outlier, 0, s.size * s.size)
    for k in range(p.count):
        faintest = max(faintest, p.value[k])
    faintest = max(faintest * rules.faint * star.flux, 0.0)
    for k in range(p.count):
        place, bright = p.place[k], False
        # most pixels are far from it
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
            row, by = 3 + phase, _by_gain(star, rules, 1.0, phase)
            normal[row * n], normal[row * n + 1], normal[row * n + 2] = by * flux * sums[3], by * flux * sums[4], by * sums[5]
            normal[row * n + row] = rules.held + by * by * sums[5]
            star.right[row] = by * sums[8] - star.colour[phase] * rules.held
    star.information = normal[2 * n + 2]


cdef inline double _by_gain(const Star *star, Rules rules, double value, int phase) noexcept nogil:
    """The derivative of a pixel with this value of the PSF by the star's gain at its phase, over the frame's."""
    return star.flux * value * rules.gain[phase] / star.gain[phase]


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


cdef void _fit(const Stamp *s, const Local *psf, Rules rules, int rounds, Pixels *p, Star *star) noexcept nogil:
    """Fit a star that has a first place, in so many rounds at most; the pixels are at last all of the stamp.

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
        _gather(s, star, psf, rules, p)
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
    _gather_rest(s, star, psf, rules, p)


cdef void _leverages(const Stamp *s, const Star *star, Rules rules, const Pixels *p, float *leverage) noexcept nogil:
    """Set how far (0 to 1) each fitted pixel decides what the model has there; NaN if the star has no fit."""
    cdef double[4] slope
    cdef int[4] row
    cdef double total
    cdef int k, a, b, n = rules.parameters, most = 4 if rules.own else 3, phase
    if not star.solved:
        for k in range(s.size * s.size):
            leverage[k] = NAN
        return
    row[0], row[1], row[2] = 0, 1, 2
    for k in range(p.count):
        if not p.weight[k] > 0:
            continue
        phase, total = s.phase[p.place[k]], 0.0
        slope[0], slope[1], slope[2] = star.flux * p.by_x[k], star.flux * p.by_y[k], p.value[k]
        if rules.own:
            slope[3], row[3] = _by_gain(star, rules, p.value[k], phase), 3 + phase
        for a in range(most):
            for b in range(most):
                total += slope[a] * slope[b] * star.covariance[row[a] * n + row[b]]
        leverage[p.place[k]] = <float>(total * p.weight[k])


def fitted(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const double[:, ::1] corner, const double[:, ::1] first,
    const double[:, :, ::1] axes, const double[:, :, ::1] series, Rules rules, int rounds, bint weighed,
):
    """Fit N stars to their stamps (N, S, S), as `detection.fit.fit_stars` explains.

    corner  (N, 2) px: x and y of each stamp's first pixel
    first   (N, 2) px: first places of the stars
    axes    (N, 2, 2) or (1, 2, 2), and
    series  (N, I, J) or (1, I, J): as `detection.psf.LocalPsf` has them
    weighed  whether the leverage of each pixel is wanted; else there is none

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
    if not (corner.shape[0] == first.shape[0] == n and corner.shape[1] == first.shape[1] == 2 and rounds > 0):
        raise ValueError(f"{corner.shape[0]} corners, {first.shape[0]} places, {rounds} rounds: {n} pairs, 1 round or more")
    stars_, covariances, gains_ = np.empty((n, 6)), np.empty((n, 2, 2)), np.empty((n, rules.phases))
    images_, marks_ = np.empty((2, n, size, size), np.float32), np.zeros((2, n, size, size), np.uint8)
    leverage_ = np.zeros((n, seen, seen), np.float32)
    cdef double[:, ::1] column = stars_
    cdef double[:, :, ::1] covariance = covariances
    cdef double[:, ::1] gains = gains_
    cdef float[:, :, ::1] image = images_.reshape(2, n, area)
    cdef float[:, :, ::1] leverage = leverage_
    cdef unsigned char[:, :, ::1] mark = marks_.reshape(2, n, area)
    _begin(&p, area)
    s.size, most = size, rules.parameters
    with nogil:
        for k in range(n):
            s.left, s.top = corner[k, 0], corner[k, 1]
            s.signal, s.noise, s.good = &signal[k, 0, 0], &noise[k, 0, 0], &good[k, 0, 0]
            s.phase, s.outlier = &phase[k, 0, 0], &mark[1, k, 0]
            star.x, star.y = first[k, 0], first[k, 1]
            local_of(axes, series, k, &psf)
            _fit(&s, &psf, rules, rounds, &p, &star)
            column[k, 4] = _told(&s, &star, &p, &image[0, k, 0], &image[1, k, 0], &mark[0, k, 0], &column[k, 5])
            if weighed:
                _leverages(&s, &star, rules, &p, &leverage[k, 0, 0])
            if star.solved:
                _step(&star, rules)
            column[k, 0], column[k, 1], column[k, 2] = star.x, star.y, star.flux
            column[k, 3] = 1 / sqrt(star.information)
            for a in range(2):
                for b in range(2):
                    covariance[k, a, b] = star.covariance[a * most + b]
            for a in range(rules.phases):
                gains[k, a] = star.gain[a]
    free(p.dx)
    free(p.place)
    x, y, flux, sigma, chi2, pixels = np.ascontiguousarray(stars_.T)
    residual, model = images_
    used, outlier = marks_.view(bool)
    return x, y, flux, sigma, covariances, gains_, chi2, pixels, residual, model, used, outlier, leverage_


cdef double _told(
    const Stamp *s, const Star *star, const Pixels *p, float *residual, float *model, unsigned char *used, double *pixels
) noexcept nogil:
    """Set what is told of each pixel, and how many were fitted; chi-square per degree of freedom."""
    cdef double chi2 = 0.0
    cdef int k, place, count = 0
    pixels[0] = 0.0
    if not star.solved:
        for k in range(s.size * s.size):
            residual[k] = model[k] = NAN
            s.outlier[k] = False
        return NAN
    for k in range(p.all):
        place = p.place[k]
        residual[place], model[place] = <float>p.residual[k], <float>(p.signal[k] - p.residual[k])
        used[place] = p.weight[k] > 0
        chi2 += p.residual[k] * p.residual[k] * p.weight[k]
        count += used[place]
    pixels[0] = count
    return chi2 / max(count - 3, 1)


cdef int sound_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1:
    """Raise ValueError unless shapes and phases of stamps are what a fit reads."""
    cdef Py_ssize_t n = signal.shape[0], size = signal.shape[1]
    for name, shape in (
        ("signal", (n, size, signal.shape[2])),
        ("noise", (noise.shape[0], noise.shape[1], noise.shape[2])),
        ("good", (good.shape[0], good.shape[1], good.shape[2])),
        ("phase", (phase.shape[0], phase.shape[1], phase.shape[2])),
    ):
        if shape != (n, size, size):
            raise ValueError(f"{name} has the shape {shape}; {(n, size, size)} is needed")
    if not within[unsigned_char](&phase[0, 0, 0], n * size * size, 0, rules.phases - 1):
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {rules.phases}")
