# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Weighted least-squares fit of one star, or of two together, to each stamp: places, fluxes and gains, by Gauss-Newton."""

from libc.math cimport NAN, isfinite, sqrt
from libc.string cimport memcmp, memcpy, memset

import numpy as np

from starpos._numeric.limits cimport check_stamps, unsigned_char, within
from starpos._numeric.memory cimport room_for, start_of
from starpos.detection._psf cimport BLOCK, Local, blocks, evaluate, local_of, sound, values
from starpos.detection._sums cimport (
    LARGEST, any_bright, chi_square, copy_pixels, cross_products, invert, invert_scaled, products, scaled_factor, sky_sums,
    solve_scaled, squares, weigh,
)

cdef enum:
    STARS = 2
    # Phases of a mosaic, and unknowns of a star: x, y, flux, and a gain for each phase.
    PHASES = 4
    MOST = 7
    # Numbers kept of each pixel: 5, and 5 of each star.
    COLUMNS = 15


cdef class Rules:
    """The rules of a fit: `detection.fit` explains each.

    gain                             (P,): of each phase, P = 1 or 4
    colour_spread                    of a star's gains, 1 sigma
    dn_per_photon, misfit            of the light's noise
    widths                           within which pixels are fitted
    outlier, faint                   sigmas, and the share of the star's brightest pixel, above which a pixel is one
    settled                          sigmas that a star may still be from where more rounds would bring it; 0: all are made
    """

    cdef int phases, own, unknowns
    cdef double[PHASES] gain
    cdef double held, dn_per_photon, misfit2, widths2, outlier2, faint, settled

    def __init__(
        self, gain, double colour_spread, double dn_per_photon, double misfit, double widths, double outlier, double faint,
        double settled,
    ):
        cdef int k
        if len(gain) not in (1, PHASES):
            raise ValueError(f"{len(gain)} gains: a frame has 1, a colour mosaic {PHASES}")
        self.phases, self.own = len(gain), len(gain) if len(gain) > 1 else 0
        self.unknowns = 3 + self.own
        for k in range(self.phases):
            self.gain[k] = gain[k]
        self.held, self.dn_per_photon, self.misfit2 = colour_spread**-2, dn_per_photon, misfit * misfit
        self.widths2, self.outlier2, self.faint, self.settled = widths * widths, outlier * outlier, faint, settled


cdef struct Image:
    # Of one star, at the pixels one after the other: offsets px, the PSF, and (only within reach) its derivatives; all times
    # the star's gain.
    double *dx
    double *dy
    double *value
    double *by_x
    double *by_y
    # The star's place when the offsets were set.
    double x
    double y


cdef struct Pixels:
    # Pixels of a stamp, one after the other: first those within reach of a star, phase after phase, then, if they are wanted,
    # the others. Places in the stamp, the light and the sky's variance, the weight in the fit, and what the stars leave.
    int stars
    int count
    int all
    int[PHASES + 1] first
    int *place
    double *signal
    double *noise2
    double *weight
    double *residual
    double *light
    Image[STARS] of
    # Of each row of the stamp, for each star, the first column within reach and the one after the last; and room for others.
    int *bound
    int *wanted
    # Of each pixel of the stamp, where it was marked last.
    unsigned char *outlier


cdef struct Star:
    double x
    double y
    double flux
    double[PHASES] gain
    double[PHASES] colour


cdef struct Solution:
    # Of all unknowns, star after star: normal equations, then their scaled factor; the right side, the covariance, the last
    # step; the normal equations without the gains. Sigma of each flux at known gains; SNR of each star in the sky's noise.
    bint solved
    int unknowns
    double[LARGEST * LARGEST] normal
    double[LARGEST] scale
    double[LARGEST] right
    double[LARGEST] step
    double[LARGEST * LARGEST] covariance
    double[36] known
    double[STARS] sigma
    double[STARS] snr


cdef struct Stamp:
    # First column and row, size, and pixels.
    double left
    double top
    int size
    const float *signal
    const float *noise
    const unsigned char *good
    const unsigned char *phase


cdef bytearray _begin(Pixels *p, int stars, int size):
    """The memory of the pixels of a stamp, in whole blocks."""
    # the last step of a block may begin anywhere
    cdef int area = size * size, room = (blocks(area) + 1) * BLOCK, rows = 2 * stars * size, k
    memory = room_for(COLUMNS * room * sizeof(double) + (room + 2 * rows) * sizeof(int) + area)
    cdef double *columns = <double *>start_of(memory)
    p.place = <int *>(columns + COLUMNS * room)
    p.bound, p.wanted = p.place + room, p.place + room + rows
    p.outlier = <unsigned char *>(p.place + room + 2 * rows)
    p.stars, p.count, p.all = stars, 0, 0
    p.signal, p.noise2, p.weight = columns, columns + room, columns + 2 * room
    p.residual, p.light = columns + 3 * room, columns + 4 * room
    for k in range(STARS):
        columns += 5 * room
        p.of[k].dx, p.of[k].dy, p.of[k].value = columns, columns + room, columns + 2 * room
        p.of[k].by_x, p.of[k].by_y = columns + 3 * room, columns + 4 * room
    return memory


cdef inline void _rows_within(const double *axes, double left, double top, int size, int apart, double widths2, int *bound) noexcept nogil:
    """Set of each row of a stamp the first column within so many squared widths of a star, and the one after the last.

    axes (2, 2) of the PSF; left, top: of the stamp's first pixel from the star, px; `bound` has a row's every `apart` numbers
    """
    cdef double xx = axes[0] * axes[0] + axes[2] * axes[2], yy = axes[1] * axes[1] + axes[3] * axes[3]
    cdef double lean = (axes[0] * axes[1] + axes[2] * axes[3]) / xx, middle, reach2, reach, first, last
    cdef int row
    for row in range(size):
        middle, reach2 = -lean * (top + row), (widths2 - yy * (top + row) * (top + row)) / xx
        reach2 += middle * middle
        if not reach2 > 0:
            bound[0] = bound[1] = 0
        else:
            reach = sqrt(reach2)
            first, last = max(0.0, min(middle - reach - left, size)), max(0.0, min(middle + reach - left + 1, size))
            bound[0], bound[1] = <int>first, <int>last
            bound[0] += bound[0] < first
        bound += apart


cdef void _join_rows(int *bound, int size) noexcept nogil:
    """Join the columns of two stars in each row, where they meet: the second star has then none of its own."""
    cdef int row
    for row in range(size):
        if bound[0] < bound[1] and bound[2] < bound[3] and bound[2] <= bound[1] and bound[0] <= bound[3]:
            bound[0], bound[1] = min(bound[0], bound[2]), max(bound[1], bound[3])
            bound[2] = bound[3] = 0
        bound += 4


cdef inline int _first_of_phase(const unsigned char *phase, int column, int last, int wanted) noexcept nogil:
    """The first column of a row that has this phase, from one on; `last` if none before it has. Phases alternate."""
    if column < last and phase[column] != wanted:
        column += 1
    return column if column < last and phase[column] == wanted else last


cdef void _gather(const Stamp *s, const Star *star, const Local *psf, Rules rules, bint again, Pixels *p) noexcept nogil:
    """Take the pixels of a stamp within reach of the stars; the weight is 1 for those to be fitted, else 0.

    again: whether pixels have been taken, which are most often the same
    """
    cdef int row, first, last, place, phase, some, j, k, n = 0, step = 2 if rules.own else 1, each = 2 * p.stars
    cdef double x, y, gain
    for k in range(p.stars):
        _rows_within(psf.axes, s.left - star[k].x, s.top - star[k].y, s.size, each, rules.widths2, p.wanted + 2 * k)
    if p.stars > 1:
        _join_rows(p.wanted, s.size)
    if again and not memcmp(p.wanted, p.bound, each * s.size * sizeof(int)):
        n = p.count
        for k in range(p.stars):
            x, y = p.of[k].x - star[k].x, p.of[k].y - star[k].y
            for j in range(n):
                p.of[k].dx[j], p.of[k].dy[j] = p.of[k].dx[j] + x, p.of[k].dy[j] + y
        for j in range(n):
            p.weight[j] = s.good[p.place[j]] & ~p.outlier[p.place[j]]
    else:
        p.wanted, p.bound = p.bound, p.wanted
        for phase in range(rules.phases):
            p.first[phase] = n
            # every other row has another two phases
            row = 1 if rules.own and s.phase[0] // 2 != phase // 2 else 0
            while row < s.size:
                for k in range(p.stars):
                    first, last = p.bound[each * row + 2 * k], p.bound[each * row + 2 * k + 1]
                    if rules.own:
                        first = _first_of_phase(s.phase + row * s.size, first, last, phase)
                    if first < last:
                        place, some = row * s.size + first, (last - first + step - 1) // step
                        copy_pixels(
                            s.signal + place, s.noise + place, s.good + place, p.outlier + place, place, some, step,
                            s.left + first - star[0].x, s.top + row - star[0].y, p.place + n, p.of[0].dx + n, p.of[0].dy + n,
                            p.signal + n, p.noise2 + n, p.weight + n,
                        )
                        n += some
                row += step
        for k in range(1, p.stars):
            x, y = star[0].x - star[k].x, star[0].y - star[k].y
            for j in range(n):
                p.of[k].dx[j], p.of[k].dy[j] = p.of[0].dx[j] + x, p.of[0].dy[j] + y
    p.count = p.all = p.first[rules.phases] = n
    for k in range(p.stars):
        p.of[k].x, p.of[k].y = star[k].x, star[k].y
        evaluate(psf, p.of[k].dx, p.of[k].dy, n, p.of[k].value, p.of[k].by_x, p.of[k].by_y)
        for phase in range(rules.own):
            gain = star[k].gain[phase]
            for j in range(p.first[phase], p.first[phase + 1]):
                p.of[k].value[j] *= gain
                p.of[k].by_x[j] *= gain
                p.of[k].by_y[j] *= gain


cdef void _gather_rest(const Stamp *s, const Star *star, const Local *psf, Rules rules, Pixels *p) noexcept nogil:
    """Take the pixels beyond reach too, with the weight 0."""
    cdef int row, column, j, k, n = p.count, each = 2 * p.stars
    cdef const int *bound
    for row in range(s.size):
        bound = p.bound + each * row
        for column in range(s.size):
            if bound[0] <= column < bound[1] or (p.stars > 1 and bound[2] <= column < bound[3]):
                continue
            p.place[n], p.signal[n], p.weight[n] = row * s.size + column, s.signal[row * s.size + column], 0.0
            for k in range(p.stars):
                p.of[k].dx[n], p.of[k].dy[n] = s.left + column - star[k].x, s.top + row - star[k].y
            n += 1
    p.all = n
    for j in range(p.count, n):
        p.residual[j] = p.signal[j]
    for k in range(p.stars):
        values(psf, p.of[k].dx + p.count, p.of[k].dy + p.count, n - p.count, p.of[k].value + p.count)
        for j in range(p.count, n):
            if rules.own:
                p.of[k].value[j] *= star[k].gain[s.phase[p.place[j]]]
            p.residual[j] -= star[k].flux * p.of[k].value[j]


cdef void _set_first_fluxes(const Pixels *p, Star *star) noexcept nogil:
    """Set the fluxes that explain the light at the first places, weighted by the sky's noise; of two, at least the given ones."""
    cdef double[2] sums
    cdef double aa = 0.0, ab = 0.0, bb = 0.0, sa = 0.0, sb = 0.0, a, b, w, volume
    cdef int j
    if p.stars == 1:
        sky_sums(p.weight, p.noise2, p.of[0].value, p.signal, p.count, sums)
        star[0].flux = sums[1] / sums[0] if sums[0] > 0 and isfinite(sums[1]) else 0.0
        return
    for j in range(p.count):
        a, b, w = p.of[0].value[j], p.of[1].value[j], p.weight[j] / p.noise2[j]
        aa, ab, bb = aa + w * a * a, ab + w * a * b, bb + w * b * b
        sa, sb = sa + w * a * p.signal[j], sb + w * b * p.signal[j]
    volume = max(aa * bb - ab * ab, 1e-12)
    star[0].flux = max((bb * sa - ab * sb) / volume, star[0].flux)
    star[1].flux = max((aa * sb - ab * sa) / volume, star[1].flux)


cdef void _weigh(const Star *star, Rules rules, Pixels *p) noexcept nogil:
    """Set residuals and weights by the model."""
    cdef int j
    if p.stars == 1:
        weigh(
            p.signal, p.noise2, p.of[0].value, star[0].flux, rules.dn_per_photon, rules.misfit2, p.count, p.weight, p.residual
        )
        return
    for j in range(p.count):
        p.light[j] = star[0].flux * p.of[0].value[j] + star[1].flux * p.of[1].value[j]
    weigh(p.signal, p.noise2, p.light, 1.0, rules.dn_per_photon, rules.misfit2, p.count, p.weight, p.residual)


cdef bint _mark_outliers(const Stamp *s, const Star *star, Rules rules, Pixels *p) noexcept nogil:
    """Mark the good pixels that are much too bright for a single star; whether they are those that were left out."""
    cdef double faintest = 0.0, light, variance
    cdef int j, place
    cdef bint same = True, bright, found
    memset(p.outlier, 0, s.size * s.size)
    # most stars have none, and had none
    any_bright(p.weight, p.residual, rules.outlier2, p.count, &found)
    if not found:
        return True
    for j in range(p.count):
        faintest = max(faintest, p.of[0].value[j])
    faintest = max(faintest * rules.faint * star.flux, 0.0)
    for j in range(p.count):
        place, bright = p.place[j], False
        if p.residual[j] > faintest and s.good[place]:
            light = max(star.flux * p.of[0].value[j], 0.0)
            variance = p.noise2[j] + rules.dn_per_photon * light + rules.misfit2 * light * light
            p.outlier[place] = bright = p.residual[j] * p.residual[j] > rules.outlier2 * variance
        same &= not s.good[place] or bright != (p.weight[j] > 0)
    return same


cdef inline double _by_gain(const Star *star, Rules rules, int phase) noexcept nogil:
    """What turns a pixel's value of the PSF into its derivative by the star's gain at its phase, over the frame's."""
    return star.flux * rules.gain[phase] / star.gain[phase]


cdef void _sum_up(const Star *star, Rules rules, const Pixels *p, Solution *to) noexcept nogil:
    """Set the normal equations of all stars, the lower half, and their right side.

    A pixel knows of each star the place, the flux and the gain of its own phase alone, which is held near the frame's.
    """
    cdef double[9] sums
    cdef double[STARS][4] slope
    cdef const double *column[STARS][3]
    cdef double *own
    cdef double *right
    cdef double flux, by
    cdef int n = to.unknowns, each = 4 if rules.own else 3, k, a, b, phase, first, some, gain
    memset(to.normal, 0, n * n * sizeof(double))
    memset(to.right, 0, n * sizeof(double))
    for phase in range(rules.phases):
        first, some, gain = p.first[phase], p.first[phase + 1] - p.first[phase], 3 + phase
        for k in range(p.stars):
            # the star's block begins on the diagonal
            own, right, flux = to.normal + k * rules.unknowns * (n + 1), to.right + k * rules.unknowns, star[k].flux
            column[k][0], column[k][1], column[k][2] = p.of[k].by_x + first, p.of[k].by_y + first, p.of[k].value + first
            products(p.weight + first, column[k][0], column[k][1], column[k][2], p.residual + first, some, sums)
            own[0] += flux * flux * sums[0]
            own[n] += flux * flux * sums[1]
            own[n + 1] += flux * flux * sums[2]
            own[2 * n] += flux * sums[3]
            own[2 * n + 1] += flux * sums[4]
            own[2 * n + 2] += sums[5]
            right[0] += flux * sums[6]
            right[1] += flux * sums[7]
            right[2] += sums[8]
            if rules.own:
                by = _by_gain(&star[k], rules, phase)
                own[gain * n], own[gain * n + 1], own[gain * n + 2] = by * flux * sums[3], by * flux * sums[4], by * sums[5]
                own[gain * n + gain] = rules.held + by * by * sums[5]
                right[gain] = by * sums[8] - star[k].colour[phase] * rules.held
                slope[k][3] = by
            slope[k][0], slope[k][1], slope[k][2] = flux, flux, 1.0
        if p.stars > 1:
            cross_products(p.weight + first, column[1], column[0], some, sums)
            for a in range(each):
                own = to.normal + (rules.unknowns + (a if a < 3 else gain)) * n
                for b in range(each):
                    own[b if b < 3 else gain] += slope[1][a] * slope[0][b] * sums[3 * min(a, 2) + min(b, 2)]
    # without the gains
    to.known[8] = to.normal[2 * n + 2]
    for a in range(6 if p.stars > 1 else 0):
        for b in range(a + 1):
            to.known[6 * a + b] = to.normal[(a // 3 * rules.unknowns + a % 3) * n + b // 3 * rules.unknowns + b % 3]


cdef void _set_sigmas(int stars, Solution *to) noexcept nogil:
    """Set each flux's sigma at known gains: of a single star at a known place, of two at places that are fitted with them."""
    cdef double[36] inverse
    if stars == 1:
        to.sigma[0] = 1 / sqrt(to.known[8])
        return
    invert(to.known, 6, inverse)
    to.sigma[0], to.sigma[1] = sqrt(inverse[14]), sqrt(inverse[35])


cdef double _solve(Solution *to) noexcept nogil:
    """Set the step to the solution of the equations; its length in sigmas."""
    cdef double length2 = 0.0
    cdef int a
    memcpy(to.step, to.right, to.unknowns * sizeof(double))
    solve_scaled(to.normal, to.unknowns, to.scale, to.step)
    for a in range(to.unknowns):
        length2 += to.step[a] * to.right[a]
    return sqrt(length2)


cdef void _move(Star *star, int stars, Rules rules, double least, const double *step) noexcept nogil:
    """Move the stars by a step: a single one by at most 1 px, two by at most half of that.

    A flux of two keeps the share `least` in one step: a star without light could not move any more, its place changes nothing.
    """
    cdef double farthest = 1.0 / stars
    cdef int k, a
    for k in range(stars):
        star[k].x += max(-farthest, min(step[0], farthest))
        star[k].y += max(-farthest, min(step[1], farthest))
        star[k].flux = star[k].flux + step[2] if stars == 1 else max(star[k].flux + step[2], least * star[k].flux)
        for a in range(rules.own):
            star[k].colour[a] = max(-0.9, min(star[k].colour[a] + step[3 + a], 3.0))
            star[k].gain[a] = rules.gain[a] * (1 + star[k].colour[a])
        step += rules.unknowns


cdef void _fit(
    const Stamp *s, const Local *psf, Rules rules, int rounds, double least, bint whole, Pixels *p, Star *star, Solution *to
) noexcept nogil:
    """Fit stars that have first places, two of them least fluxes, in so many rounds; the pixels are at last, if asked for, the whole stamp.

    Rounds end when the stars are settled: the step is then the last one, so short that the pixels need not follow it; else 0.
    """
    cdef double length, before = 0.0
    cdef int round_, k, j
    cdef bint same
    to.unknowns = p.stars * rules.unknowns
    for k in range(p.stars):
        for j in range(rules.phases):
            star[k].colour[j], star[k].gain[j] = 0.0, rules.gain[j]
    memset(p.outlier, 0, s.size * s.size)
    for round_ in range(rounds):
        _gather(s, star, psf, rules, round_ > 0, p)
        if round_ == 0:
            _set_first_fluxes(p, star)
        _weigh(star, rules, p)
        # a hot pixel or a neighbour's light is brighter than noise and an imperfect PSF explain
        same = p.stars > 1 or (1 <= round_ < rounds - 1 and _mark_outliers(s, star, rules, p))
        _sum_up(star, rules, p, to)
        to.solved = scaled_factor(to.normal, to.unknowns, to.scale)
        if not to.solved:
            for k in range(p.stars):
                star[k].x = star[k].y = star[k].flux = NAN
            for k in range(to.unknowns * to.unknowns):
                to.covariance[k] = NAN
            return
        if round_ == rounds - 1:
            memset(to.step, 0, sizeof(to.step))
            break
        length = _solve(to)
        # the first steps may shrink faster than later ones; the next ones are shorter by the same factor
        if same and length < 0.05 and length * length < rules.settled * before:
            break
        before = length
        _move(star, p.stars, rules, least, to.step)
    invert_scaled(to.normal, to.unknowns, to.scale, to.covariance)
    if whole:
        _gather_rest(s, star, psf, rules, p)


cdef void _set_leverages(const Stamp *s, const Star *star, Rules rules, const Solution *to, Pixels *p, float *leverage) noexcept nogil:
    """Set how far (0 to 1) each fitted pixel decides what a single star's model has there; NaN if it has no fit."""
    cdef double[6] form
    cdef const double *c = &to.covariance[0]
    cdef double flux = star.flux, by
    cdef int k, n = to.unknowns, phase, first, row
    if not to.solved:
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
            p.weight + first, p.of[0].by_x + first, p.of[0].by_y + first, p.of[0].value + first, form,
            p.first[phase + 1] - first, p.light + first,
        )
    for k in range(p.count):
        leverage[p.place[k]] = <float>p.light[k]


cdef double _set_images(
    const Stamp *s, const Star *star, Solution *to, const Pixels *p, float *model, int apart, float *residual, unsigned char *used,
    unsigned char *outlier, double *pixels, double *foreign,
) noexcept nogil:
    """Set the models, `apart` numbers from star to star, the residual and the marks of each pixel, how many were fitted, and sums.

    Returns chi-square per degree of freedom.
    """
    cdef int j, k, place, count = 0, area = s.size * s.size
    cdef double light
    pixels[0] = foreign[0] = to.snr[0] = to.snr[1] = 0.0
    if not to.solved:
        for j in range(area):
            residual[j] = NAN
            for k in range(p.stars):
                model[k * apart + j] = NAN
        return NAN
    if p.all < area:
        memcpy(residual, s.signal, area * sizeof(float))
    for j in range(p.all):
        residual[p.place[j]] = <float>p.residual[j]
    for k in range(p.stars):
        if p.all < area:
            memset(model, 0, area * sizeof(float))
        for j in range(p.all):
            model[p.place[j]] = <float>(star[k].flux * p.of[k].value[j])
        model += apart
    for j in range(p.count):
        place = p.place[j]
        used[place], outlier[place] = p.weight[j] > 0, p.outlier[place]
        count += used[place]
        if outlier[place] and p.residual[j] > 0:
            foreign[0] += p.residual[j]
    for k in range(p.stars):
        for j in range(p.count):
            light = star[k].flux * p.of[k].value[j] if p.weight[j] > 0 else 0.0
            to.snr[k] += light * light / p.noise2[j]
        to.snr[k] = sqrt(to.snr[k])
    pixels[0] = count
    return chi_square(p.weight, p.residual, p.count) / max(count - 3 * p.stars, 1)


cdef int _check_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, Rules rules,
) except -1:
    """Raise ValueError unless shapes and phases of stamps (N, S, S) are what a fit reads."""
    cdef Py_ssize_t n = signal.shape[0], size = signal.shape[1], k, row, column
    cdef bint alternate = True
    check_stamps(signal.shape, 3, [&noise.shape[0], &good.shape[0], &phase.shape[0]])
    if not within[unsigned_char](&phase[0, 0, 0], n * size * size, 0, rules.phases - 1):
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {rules.phases}")
    # each pixel has the phase of the next but one in its row
    for k in range(n if rules.own else 0):
        for row in range(size):
            for column in range(size - 2):
                alternate &= phase[k, row, column] == phase[k, row, column + 2]
    if not alternate:
        raise ValueError("phases of a mosaic alternate along each row of a stamp")


def fit_stamps(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const Py_ssize_t[::1] column, const Py_ssize_t[::1] row, const double[:, ::1] x,
    const double[:, ::1] y, const double[:, :, ::1] axes, const double[:, :, ::1] series, Rules rules, int rounds, bint weighed,
    bint whole, const double[::1] least_flux=None, double least=0.0,
):
    """Fit K = 1 or 2 stars to each of N stamps (N, S, S), as `detection.fit` explains.

    column, row   (N,) of each stamp's middle
    x, y          (K, N) px: first places of the stars
    axes, series  (N, ...) or (1, ...): as `detection.psf.LocalPsf` has them, of both stars of a stamp
    weighed       whether the leverage of each pixel is wanted, of single stars; else there is none
    whole         whether the models are wanted beyond reach; else they are 0 there
    least_flux    (N,) DN: of both of two stars at the beginning
    least         share of its flux that each of two stars keeps in one step

    Returns the columns of `detection.fit.Fit`, in their order: of those of a star, and of the model, (K, ...). A stamp whose
    equations are singular has NaN.
    """
    cdef int stars = x.shape[0], n = signal.shape[0], size = signal.shape[1], area = size * size, k, j, a, b, at
    cdef int seen = size if weighed else 0
    cdef Pixels p
    cdef Local psf
    cdef Star[STARS] star
    cdef Stamp s
    cdef Solution to
    _check_stamps(signal, noise, good, phase, rules)
    sound(axes, series, n)
    if not (column.shape[0] == row.shape[0] == x.shape[1] == y.shape[1] == n and rounds > 0):
        raise ValueError(f"{column.shape[0]} stamps, {x.shape[1]} places, {rounds} rounds: {n} of each, 1 round or more")
    if not (1 <= stars == y.shape[0] <= STARS) or (stars > 1 and (least_flux is None or least_flux.shape[0] != n or weighed)):
        raise ValueError(f"{stars} stars to a stamp: 1, or {STARS} with least fluxes and without leverages")
    columns_, covariances_, gains_ = np.empty((5, stars, n)), np.empty((stars, n, 2, 2)), np.empty((stars, n, rules.phases))
    models_, residuals_ = np.empty((stars, n, size, size), np.float32), np.empty((n, size, size), np.float32)
    marks_, leverages_ = np.zeros((2, n, size, size), np.uint8), np.zeros((n, seen, seen), np.float32)
    fits_ = np.empty((3, n))
    cdef double[:, :, ::1] found = columns_
    cdef double[:, :, :, ::1] covariance = covariances_
    cdef double[:, :, ::1] gains = gains_
    cdef float[:, :, ::1] model = models_.reshape(stars, n, area)
    cdef float[:, ::1] residual = residuals_.reshape(n, area)
    cdef float[:, :, ::1] leverage = leverages_
    cdef unsigned char[:, :, ::1] mark = marks_.reshape(2, n, area)
    cdef double[:, ::1] fit = fits_
    memory = _begin(&p, stars, size)
    s.size = size
    with nogil:
        for k in range(n):
            s.left, s.top = column[k] - size // 2, row[k] - size // 2
            s.signal, s.noise, s.good = &signal[k, 0, 0], &noise[k, 0, 0], &good[k, 0, 0]
            s.phase = &phase[k, 0, 0]
            for j in range(stars):
                star[j].x, star[j].y, star[j].flux = x[j, k], y[j, k], 0.0 if stars == 1 else least_flux[k]
            local_of(axes, series, k, &psf)
            _fit(&s, &psf, rules, rounds, least, whole, &p, star, &to)
            _set_sigmas(stars, &to)
            fit[0, k] = _set_images(
                &s, star, &to, &p, &model[0, k, 0], n * area, &residual[k, 0], &mark[0, k, 0], &mark[1, k, 0], &fit[1, k],
                &fit[2, k],
            )
            if weighed:
                _set_leverages(&s, star, rules, &to, &p, &leverage[k, 0, 0])
            if to.solved:
                _move(star, stars, rules, least, to.step)
            for j in range(stars):
                found[0, j, k], found[1, j, k], found[2, j, k] = star[j].x, star[j].y, star[j].flux
                found[3, j, k], found[4, j, k] = to.sigma[j], to.snr[j]
                for a in range(2):
                    for b in range(2):
                        at = (j * rules.unknowns + a) * to.unknowns + j * rules.unknowns + b
                        covariance[j, k, a, b] = to.covariance[at]
                for a in range(rules.phases):
                    gains[j, k, a] = star[j].gain[a]
    at_x, at_y, flux, sigma, snr = columns_
    used, outlier = marks_.view(bool)
    chi2, pixels, foreign = fits_
    return (
        at_x, at_y, flux, sigma, covariances_, gains_, chi2, pixels, residuals_, models_, used, outlier, leverages_, snr, foreign
    )
