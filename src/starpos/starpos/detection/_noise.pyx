# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The noise that grows with a star's light, from what fits leave."""

from libc.math cimport INFINITY, hypot, sqrt
from libc.stdlib cimport free, malloc
from libc.string cimport memset

import numpy as np

from starpos._numeric.algebra cimport middle
from starpos._numeric.limits cimport within
from starpos._numeric.wide cimport fused_void, lanes, sum_of

cdef enum:
    # Pixels that are summed at once.
    LANES = 4
    BLOCK = 64
    ROUNDS = 4

# Smaller singular values, as a share of the largest, are 0; residuals are at most so much more certain than they look.
cdef double SINGULAR = 1e-12, CERTAIN = 0.1


cdef struct Pixels:
    # The sky's variance, the light, and the residual's square as it would be without the fit; at the end some without light.
    int count
    double *noise2
    double *light
    double *square


cdef (double, double) _two_terms(double pp, double pq, double qq, double p, double q) noexcept nogil:
    """Least-squares a, b >= 0 of a symmetric system of two equations; of both or, where one were negative, the better one."""
    cdef double large, small, a, b
    if not pp > 0:
        return 0.0, 0.0
    large = (pp + qq) / 2 + hypot((pp - qq) / 2, pq)
    small = (pp * qq - pq * pq) / large
    if small > SINGULAR * large:
        a, b = (qq * p - pq * q) / (small * large), (pp * q - pq * p) / (small * large)
    else:
        a, b = (pp * p + pq * q) / (large * large), (pq * p + qq * q) / (large * large)
    if a >= 0 and b >= 0:
        return a, b
    a, b = max(p / pp, 0.0), max(q / qq, 0.0)
    # the one that lowers the sum of squares more
    if p * a >= q * b:
        return a, 0.0
    return 0.0, b


cdef fused_void _light_sums(const Pixels *p, double photon, double misfit2, double limit2, double *out) noexcept nogil:
    """Sums over pixels of their light over its variance, squared; and pp, pq, qq, p, q.

    These are the products of light, light squared and the excess, each over the variance, of pixels whose square is not too large
    for it.
    """
    cdef double[BLOCK] whole
    cdef double[BLOCK] kept
    cdef double[BLOCK] excess
    cdef double[BLOCK] light
    cdef lanes[6] sums
    cdef lanes all_, a, b, e
    cdef double variance
    cdef int first = 0, n, k
    memset(sums, 0, sizeof(sums))
    while first < p.count:
        # whole lanes, as the pixels are
        n = min(BLOCK, p.count - first)
        for k in range(n):
            light[k] = p.light[first + k]
            variance = p.noise2[first + k] + (photon + misfit2 * light[k]) * light[k]
            whole[k], excess[k] = light[k] / variance, (p.square[first + k] - p.noise2[first + k]) / variance
            kept[k] = whole[k] if p.square[first + k] < limit2 * variance else 0.0
        for k in range(0, n, 4):
            all_, a, e = (<const lanes *>(whole + k))[0], (<const lanes *>(kept + k))[0], (<const lanes *>(excess + k))[0]
            b = a * (<const lanes *>(light + k))[0]
            sums[0] += all_ * all_
            sums[1] += a * a
            sums[2] += a * b
            sums[3] += b * b
            sums[4] += a * e
            sums[5] += b * e
        first += BLOCK
    for k in range(6):
        out[k] = sum_of(&sums[k])


cdef (double, double) _fitted(const Pixels *p, double photon, double misfit2, double outlier2) noexcept nogil:
    """DN of a photon, with 1 sigma of its error, and misfit squared, from those before."""
    cdef double[6] sums
    cdef int round_
    for round_ in range(ROUNDS):
        # at first nothing is known that could be exceeded
        _light_sums(p, photon, misfit2, outlier2 if photon + misfit2 > 0 else INFINITY, sums)
        photon, misfit2 = _two_terms(sums[1], sums[2], sums[3], sums[4], sums[5])
    # because errors given too small do more harm than too large ones
    return photon + sqrt(2 / max(sums[0], 1e-12)), misfit2


cdef int _alike(
    const float[:, :, ::1] noise, const float[:, :, ::1] model, const float[:, :, ::1] residual,
    const unsigned char[:, :, ::1] used, const float[:, :, ::1] leverage,
) except -1:
    """Raise ValueError unless images of fits have the same shapes, and stamps the same size."""
    for name, fits, height, width in (
        ("model", model.shape[0], model.shape[1], model.shape[2]),
        ("residual", residual.shape[0], residual.shape[1], residual.shape[2]),
        ("used", used.shape[0], used.shape[1], used.shape[2]),
        ("leverage", leverage.shape[0], leverage.shape[1], leverage.shape[2]),
    ):
        if (fits, height, width) != (model.shape[0], noise.shape[1], noise.shape[2]):
            raise ValueError(f"{name} has the shape {(fits, height, width)}: as the model, and stamps as of the noise")
    return 0


def light_noise(
    const float[:, :, ::1] noise, const float[:, :, ::1] model, const float[:, :, ::1] residual,
    const unsigned char[:, :, ::1] used, const float[:, :, ::1] leverage, const Py_ssize_t[::1] rows, double photon,
    double misfit, double outlier,
):
    """DN of a photon and misfit: a star's light s adds the variance photon s + (misfit s)^2 to that of the sky.

    noise                            (M, S, S) of the sky, of the stars that teach
    model, residual, used, leverage  (N, S, S) of a fit, in which these are `rows` (M,)
    photon, misfit                   before
    outlier                          sigmas beyond which a residual teaches nothing
    """
    cdef Py_ssize_t n = rows.shape[0], area = noise.shape[1] * noise.shape[2], room = n * area + LANES, k, j, row
    cdef double misfit2
    cdef Pixels p
    _alike(noise, model, residual, used, leverage)
    if noise.shape[0] != n or not within[Py_ssize_t](&rows[0], n, 0, model.shape[0] - 1):
        raise ValueError(f"{n} rows of {model.shape[0]} fits for {noise.shape[0]} stars: one each is needed")
    p.noise2 = <double *>malloc(3 * room * sizeof(double))
    if p.noise2 == NULL:
        raise MemoryError
    p.count, p.light, p.square = 0, p.noise2 + room, p.noise2 + 2 * room
    with nogil:
        for k in range(n if area else 0):
            row = rows[k]
            for j in range(area):
                if (&used[row, 0, 0])[j]:
                    p.noise2[p.count] = <double>(&noise[k, 0, 0])[j] * (&noise[k, 0, 0])[j]
                    p.light[p.count] = max((&model[row, 0, 0])[j], 0.0)
                    p.square[p.count] = <double>(&residual[row, 0, 0])[j] * (&residual[row, 0, 0])[j]
                    p.square[p.count] /= max(1.0 - (&leverage[row, 0, 0])[j], CERTAIN)
                    p.count += 1
        while p.count % LANES:
            p.noise2[p.count], p.light[p.count], p.square[p.count] = 1.0, 0.0, 0.0
            p.count += 1
        photon, misfit2 = _fitted(&p, photon, misfit * misfit, outlier * outlier)
    free(p.noise2)
    return photon, sqrt(misfit2)


def strangeness(
    const float[:, :, ::1] noise, const float[:, :, ::1] model, const float[:, :, ::1] residual,
    const unsigned char[:, :, ::1] used, const float[:, :, ::1] leverage, double darkest,
):
    """Sum of squared residuals beyond the sky's noise over that of the model (N,), of fits (N, S, S), and its error (N,).

    darkest  DN2: a model's sum of squares is at least so much
    """
    cdef Py_ssize_t n = model.shape[0], area = noise.shape[1] * noise.shape[2], k, j
    cdef double light2, left, scatter, noise2
    _alike(noise, model, residual, used, leverage)
    if noise.shape[0] != n:
        raise ValueError(f"{noise.shape[0]} stars and {n} fits: one each is needed")
    out = np.empty((2, n))
    cdef double[:, ::1] found = out
    with nogil:
        for k in range(n):
            light2 = left = scatter = 0.0
            for j in range(area):
                if (&used[k, 0, 0])[j]:
                    noise2 = <double>(&noise[k, 0, 0])[j] * (&noise[k, 0, 0])[j]
                    light2 += <double>(&model[k, 0, 0])[j] * (&model[k, 0, 0])[j]
                    left += <double>(&residual[k, 0, 0])[j] * (&residual[k, 0, 0])[j] - noise2 * (1 - (&leverage[k, 0, 0])[j])
                    scatter += noise2 * noise2
            light2 = max(light2, darkest)
            found[0, k], found[1, k] = left / light2, sqrt(2 * scatter) / light2
    return out[0], out[1]


def of_phases(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const float[:, :, ::1] value, double dn_per_photon, double misfit, int phases,
):
    """The light of N stars (N, S, S) in each phase of a mosaic, by a PSF's values there (N, S, S).

    The pixels' variance is that of the sky's noise and of the light in the signal: dn_per_photon and misfit, its share.

    Returns (N, phases): each phase's flux, and the inverse of its variance, 1e-12 at least.
    """
    cdef Py_ssize_t n = signal.shape[0], area = signal.shape[1] * signal.shape[2], k, j
    cdef double light, weight, misfit2 = misfit * misfit
    cdef int p
    _alike(noise, signal, value, good, value)
    _alike(noise, signal, value, phase, value)
    if noise.shape[0] != n:
        raise ValueError(f"{noise.shape[0]} noises of {n} stars: one each is needed")
    fluxes, weights = np.zeros((2, n, phases))
    cdef double[:, ::1] flux = fluxes
    cdef double[:, ::1] information = weights
    for k in range(n):
        for j in range(area):
            p = (&phase[k, 0, 0])[j]
            if not (&good[k, 0, 0])[j] or p >= phases:
                continue
            light = max((&signal[k, 0, 0])[j], <float>0)
            weight = (&value[k, 0, 0])[j] / (
                <double>(&noise[k, 0, 0])[j] * (&noise[k, 0, 0])[j] + dn_per_photon * light + misfit2 * light * light
            )
            information[k, p] += weight * (&value[k, 0, 0])[j]
            flux[k, p] += weight * (&signal[k, 0, 0])[j]
        for p in range(phases):
            information[k, p] = max(information[k, p], 1e-12)
            flux[k, p] /= information[k, p]
    return fluxes, weights


def unit_light(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] phase,
    const float[:, :, ::1] model, const unsigned char[:, :, ::1] used, const Py_ssize_t[::1] rows, const double[::1] flux,
    const double[:, ::1] gains, double dn_per_photon, double misfit2,
):
    """The pixels (M, S, S) of stars that teach over their fluxes and gains, and the inverse variances; 0 if not used.

    signal, noise, phase  (M, S, S) of these stars
    model, used           (N, S, S) of a fit, in which these are `rows` (M,), with flux (N,) and gains (N, P)
    dn_per_photon         DN2 of variance for each DN of light, and
    misfit2               for its square
    """
    cdef Py_ssize_t n = rows.shape[0], area = noise.shape[1] * noise.shape[2], k, j, row
    cdef float light, sky
    cdef double scale
    _alike(noise, model, model, used, model)
    _alike(noise, signal, signal, phase, signal)
    if noise.shape[0] != n or not within[Py_ssize_t](&rows[0], n, 0, model.shape[0] - 1):
        raise ValueError(f"{n} rows of {model.shape[0]} fits for {noise.shape[0]} stars: one each is needed")
    if flux.shape[0] != model.shape[0] or gains.shape[0] != flux.shape[0]:
        raise ValueError(f"{flux.shape[0]} fluxes and {gains.shape[0]} gains of {model.shape[0]} fits: one each is needed")
    if n and np.max(phase, initial=0) >= gains.shape[1]:
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {gains.shape[1]}")
    out = np.empty((2, n, noise.shape[1], noise.shape[2]), np.float32)
    cdef float[:, :, :, ::1] found = out
    with nogil:
        for k in range(n if area else 0):
            row = rows[k]
            for j in range(area):
                scale = flux[row] * gains[row, (&phase[k, 0, 0])[j]]
                light, sky = max((&model[row, 0, 0])[j], <float>0), (&noise[k, 0, 0])[j]
                (&found[0, k, 0, 0])[j] = <float>((&signal[k, 0, 0])[j] / scale)
                (&found[1, k, 0, 0])[j] = <float>(
                    (&used[row, 0, 0])[j] * scale * scale / (sky * sky + (dn_per_photon + misfit2 * light) * light)
                )
    return out[0], out[1]


def typical_gains(
    const double[:, ::1] own, const double[:, ::1] information, double darkest, double least, double outlying, int rounds
):
    """Gains (P,) of a mosaic's phases, mean 1, and the scatter (1 sigma) of single stars' gains about them, without noise.

    own, information  (N, P), N > 0: the light of each star at each phase, and its inverse variance
    darkest           a star's mean light is at least this
    least             of a gain
    outlying          sigmas from which a star's gain does not count
    """
    cdef int n = own.shape[0], phases = own.shape[1], k, p, round_
    cdef double mean, total, sum_, of_spread, all_, off, spread2 = 0.0
    if not n or not phases or information.shape[0] != n or information.shape[1] != phases:
        raise ValueError(f"{n} x {phases} lights, {information.shape[0]} x {information.shape[1]} errors: as many are needed")
    gain_ = np.empty(phases)
    cdef double[::1] gain = gain_
    # of each phase the gains of all stars, their variances, their weights; and some to be sorted
    cdef double *room = <double *>malloc((3 * phases + 1) * n * sizeof(double))
    if room == NULL:
        raise MemoryError
    cdef double *ratio = room
    cdef double *error2 = room + phases * n
    cdef double *weight = room + 2 * phases * n
    cdef double *sorted_ = room + 3 * phases * n
    with nogil:
        for k in range(n):
            mean = 0.0
            for p in range(phases):
                mean += own[k, p] / phases
            mean = max(mean, darkest)
            for p in range(phases):
                ratio[p * n + k], error2[p * n + k] = own[k, p] / mean, 1 / max(information[k, p] * mean * mean, 1e-12)
        for p in range(phases):
            for k in range(n):
                sorted_[k] = ratio[p * n + k]
            gain[p] = middle(sorted_, n)
        for round_ in range(rounds):
            all_ = mean = of_spread = 0.0
            for p in range(phases):
                total = sum_ = 0.0
                for k in range(p * n, (p + 1) * n):
                    off = ratio[k] - gain[p]
                    weight[k] = 1 / (error2[k] + spread2 + 1e-6)
                    if not off * off * weight[k] < outlying * outlying:
                        weight[k] = 0.0
                    total += weight[k]
                    sum_ += weight[k] * ratio[k]
                gain[p] = max(sum_ / max(total, 1e-12), least)
                mean += gain[p] / phases
                all_ += total
            for p in range(phases):
                gain[p] /= mean
                for k in range(p * n, (p + 1) * n):
                    off = ratio[k] / gain[p] - 1
                    of_spread += weight[k] * (off * off - error2[k])
            spread2 = max(0.0, of_spread / max(all_, 1e-12))
    free(room)
    return gain_, sqrt(spread2)
