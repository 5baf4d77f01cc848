# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Weighted least-squares fit of a star's place, flux and gains to its stamp, by Gauss-Newton, one star after the other."""

from libc.math cimport NAN, ceil, floor, isfinite, log, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memset

import numpy as np

from starpos.core.algebra cimport factored, solved
from starpos.core.limits cimport unsigned_char, within
from starpos.core.psf cimport BLOCK, Local, blocks, evaluate, local_of, sound
from starpos.core.sums cimport products, weigh

cdef enum:
    # Numbers kept of each pixel.
    COLUMNS = 9
    # Parameters of two stars.
    LARGEST = 2 * MOST

# Equations whose scaled determinant is smaller have no solution.
cdef double SINGULAR = log(1e-9)


cdef class Rules:
    """What `fitted` goes by: `detection.fit` explains each.

    gain                             (P,): of each phase, P = 1 or 4
    colour_spread                    of a star's gains, 1 sigma
    dn_per_photon, misfit            of the light's noise
    widths                           within which pixels are fitted
    outlier, faint                   sigmas, and the share of the star's brightest pixel, above which a pixel is one
    """

    def __init__(
        self, gain, double colour_spread, double dn_per_photon, double misfit, double widths, double outlier, double faint
    ):
        cdef int k
        if len(gain) not in (1, PHASES):
            raise ValueError(f"{len(gain)} gains: a frame has 1, a colour mosaic {PHASES}")
        self.phases, self.own = len(gain), len(gain) if len(gain) > 1 else 0
        self.parameters = 3 + self.own
        for k in range(self.phases):
            self.gain[k] = gain[k]
        self.held, self.dn_per_photon, self.misfit2 = colour_spread**-2, dn_per_photon, misfit * misfit
        self.widths2, self.outlier2, self.faint = widths * widths, outlier * outlier, faint


cdef struct Pixels:
    # Pixels of a stamp, one after the other: places in the stamp, offsets px from the star, the light and the sky's
    # variance, the PSF and its derivatives times the star's gain, and the weight in the fit.
    int count
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


cdef struct Star:
    double x
    double y
    double flux
    double[PHASES] gain
    double[PHASES] colour
    double[MOST * MOST] covariance
    double[MOST] right
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
    cdef int room = blocks(area) * BLOCK
    cdef double *columns = <double *>malloc(COLUMNS * room * sizeof(double))
    p.place = <int *>malloc(room * sizeof(int))
    if columns == NULL or p.place == NULL:
        free(columns)
        free(p.place)
        raise MemoryError
    p.count = 0
    p.dx, p.dy, p.signal, p.noise2 = columns, columns + room, columns + 2 * room, columns + 3 * room
    p.value, p.by_x, p.by_y = columns + 4 * room, columns + 5 * room, columns + 6 * room
    p.weight, p.residual = columns + 7 * room, columns + 8 * room
    return 0


cdef void _gather(const Stamp *s, const Star *star, const Local *psf, Rules rules, bint all_pixels, Pixels *p) noexcept nogil:
    """Take the pixels of a stamp within reach of the star, or all; the weight is 1 for those to be fitted, else 0."""
    cdef int row, column, place, k, first, last, n = 0
    cdef double dy, gain
    cdef bint fitted
    for row in range(s.size):
        dy = s.top + row - star.y
        first, last = _inside(psf, dy, s.left - star.x, s.size, rules.widths2)
        for column in range(0 if all_pixels else first, s.size if all_pixels else last):
            place = row * s.size + column
            p.place[n], p.dx[n], p.dy[n], p.signal[n] = place, s.left + column - star.x, dy, s.signal[place]
            p.noise2[n] = <double>s.noise[place] * s.noise[place]
            fitted = first <= column < last and s.good[place]
            s.outlier[place] &= fitted
            p.weight[n] = fitted and not s.outlier[place]
            n += 1
    p.count = n
    evaluate(psf, p.dx, p.dy, n, p.value, p.by_x, p.by_y)
    # in whole fours
    for k in range(n, (n + 3) // 4 * 4):
        p.weight[k] = p.residual[k] = 0.0
    if rules.own:
        for k in range(n):
            gain = star.gain[s.phase[p.place[k]]]
            p.value[k], p.by_x[k], p.by_y[k] = p.value[k] * gain, p.by_x[k] * gain, p.by_y[k] * gain


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


cdef void _weigh(const Stamp *s, const Star *star, Rules rules, Pixels *p, bint mark) noexcept nogil:
    """Set residuals and weights by the model, and where asked mark what is much too bright for the star."""
    cdef double faintest = 0.0, light, variance
    cdef int k
    weigh(p.signal, p.noise2, p.value, star.flux, rules.dn_per_photon, rules.misfit2, p.count, p.weight, p.residual)
    if not mark:
        return
    memset(s.outlier, 0, s.size * s.size)
    for k in range(p.count):
        faintest = max(faintest, p.value[k])
    faintest = max(faintest * rules.faint * star.flux, 0.0)
    for k in range(p.count):
        # most pixels are far from it
        if p.residual[k] > faintest:
            light = max(star.flux * p.value[k], 0.0)
            variance = p.noise2[k] + rules.dn_per_photon * light + rules.misfit2 * light * light
            s.outlier[p.place[k]] = p.residual[k] * p.residual[k] > rules.outlier2 * variance


cdef void _sum_up(const Stamp *s, Star *star, Rules rules, const Pixels *p, double *normal) noexcept nogil:
    """Set the normal equations, normal (K, K), lower half, and star.right (K,)."""
    cdef double[9] sums
    cdef double flux = star.flux
    cdef int n = rules.parameters
    products(p.weight, p.by_x, p.by_y, p.value, p.residual, (p.count + 3) // 4 * 4, sums)
    normal[0], normal[n], normal[n + 1] = flux * flux * sums[0], flux * flux * sums[1], flux * flux * sums[2]
    normal[2 * n], normal[2 * n + 1], normal[2 * n + 2] = flux * sums[3], flux * sums[4], sums[5]
    star.right[0], star.right[1], star.right[2] = flux * sums[6], flux * sums[7], sums[8]
    star.information = sums[5]
    if rules.own:
        _sum_up_gains(s, star, rules, p, normal)


cdef void _sum_up_gains(const Stamp *s, Star *star, Rules rules, const Pixels *p, double *normal) noexcept nogil:
    """Set the rows of the star's own gains, which are held near the frame's. A pixel knows the gain of its phase alone."""
    cdef double g, w
    cdef int k, a, row, n = rules.parameters
    for a in range(rules.own):
        row = 3 + a
        memset(&normal[row * n], 0, n * sizeof(double))
        normal[row * n + row], star.right[row] = rules.held, -star.colour[a] * rules.held
    for k in range(p.count):
        row = 3 + s.phase[p.place[k]]
        g, w = _by_gain(star, rules, p, k, row - 3), p.weight[k]
        normal[row * n] += w * g * star.flux * p.by_x[k]
        normal[row * n + 1] += w * g * star.flux * p.by_y[k]
        normal[row * n + 2] += w * g * p.value[k]
        normal[row * n + row] += w * g * g
        star.right[row] += w * g * p.residual[k]


cdef inline double _by_gain(const Star *star, Rules rules, const Pixels *p, int k, int phase) noexcept nogil:
    """The derivative of a pixel by the star's gain at its phase, over the frame's."""
    return star.flux * p.value[k] * rules.gain[phase] / star.gain[phase]


cdef bint invert(double *normal, int n, double *out) noexcept nogil:
    """Set `out` (n, n) to the inverse of the lower half of normal (n, n), NaN if singular; whether it is not.

    It is scaled first, because fluxes are a million times larger than pixels.
    """
    cdef double[LARGEST] scale
    cdef double[LARGEST] column
    cdef double volume
    cdef int a, b
    for a in range(n):
        scale[a] = sqrt(normal[a * n + a])
    for a in range(n):
        for b in range(a + 1):
            normal[a * n + b] /= scale[a] * scale[b]
    volume = factored(normal, n)
    if not volume > SINGULAR:
        for a in range(n * n):
            out[a] = NAN
        return False
    for a in range(n):
        for b in range(n):
            column[b] = 1.0 if a == b else 0.0
        solved(normal, column, n)
        for b in range(n):
            out[b * n + a] = column[b] / (scale[a] * scale[b])
    return True


cdef void _step(Star *star, Rules rules) noexcept nogil:
    """Move the star to where its equations say, at most 1 px."""
    cdef double[MOST] step
    cdef int a, b, n = rules.parameters
    for a in range(n):
        step[a] = 0.0
        for b in range(n):
            step[a] += star.covariance[a * n + b] * star.right[b]
    star.x += max(-1.0, min(step[0], 1.0))
    star.y += max(-1.0, min(step[1], 1.0))
    star.flux += step[2]
    for a in range(rules.own):
        star.colour[a] = max(-0.9, min(star.colour[a] + step[3 + a], 3.0))
        star.gain[a] = rules.gain[a] * (1 + star.colour[a])


cdef void _fit(const Stamp *s, const Local *psf, Rules rules, int rounds, Pixels *p, Star *star) noexcept nogil:
    """Fit a star that has a first place; the pixels are at last all of the stamp."""
    cdef double[MOST * MOST] normal
    cdef int round_, k
    for k in range(rules.phases):
        star.colour[k], star.gain[k] = 0.0, rules.gain[k]
    memset(s.outlier, 0, s.size * s.size)
    for round_ in range(rounds):
        _gather(s, star, psf, rules, round_ == rounds - 1, p)
        if round_ == 0:
            star.flux = _first_flux(p)
        # a hot pixel or a neighbour's light is brighter than noise and an imperfect PSF explain
        _weigh(s, star, rules, p, 1 <= round_ < rounds - 1)
        _sum_up(s, star, rules, p, normal)
        star.solved = invert(normal, rules.parameters, star.covariance)
        if not star.solved:
            star.x = star.y = star.flux = NAN
            return
        if round_ < rounds - 1:
            _step(star, rules)


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
            slope[3], row[3] = _by_gain(star, rules, p, k, phase), 3 + phase
        for a in range(most):
            for b in range(most):
                total += slope[a] * slope[b] * star.covariance[row[a] * n + row[b]]
        leverage[k] = <float>(total * p.weight[k])


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
            column[k, 0], column[k, 1], column[k, 2] = star.x, star.y, star.flux
            column[k, 3] = 1 / sqrt(star.information)
            for a in range(2):
                for b in range(2):
                    covariance[k, a, b] = star.covariance[a * most + b]
            for a in range(rules.phases):
                gains[k, a] = star.gain[a]
            column[k, 4] = _told(&s, &star, &p, &image[0, k, 0], &image[1, k, 0], &mark[0, k, 0], &column[k, 5])
            if weighed:
                _leverages(&s, &star, rules, &p, &leverage[k, 0, 0])
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
    cdef int k, count = 0
    pixels[0] = 0.0
    if not star.solved:
        for k in range(s.size * s.size):
            residual[k] = model[k] = NAN
            s.outlier[k] = False
        return NAN
    for k in range(p.count):
        residual[k], model[k], used[k] = <float>p.residual[k], <float>(p.signal[k] - p.residual[k]), p.weight[k] > 0
        chi2 += p.residual[k] * p.residual[k] * p.weight[k]
        count += used[k]
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
