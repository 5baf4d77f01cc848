# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Learning a PSF: normal equations of its terms with each star's place and gains eliminated, light by phase, and the noise.

The noise is that which grows with a star's light, from what fits leave.
"""

from libc.math cimport INFINITY, hypot, isnan, sqrt
from libc.string cimport memset

import numpy as np

from starpos._numeric.algebra cimport factored, solved
from starpos._numeric.limits cimport check_stamps, unsigned_char, within
from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport eights, fused_void, lanes, sum_of
from starpos.detection._psf cimport BLOCK, ORDERS, Local, blocks, evaluate, local_of, scaled, sound, terms_at

cdef enum:
    # Pixels of the equations that are taken together, in steps of eight, and sums side by side.
    ROOM = 128
    EIGHTS = 16
    STEP = 8
    ABREAST = 4
    # Pixels of the noise that are summed at once, and rounds of its fit.
    LANES = 4
    ROUNDS = 4

# Smaller singular values, as a share of the largest, are 0; residuals are at most so much more certain than they look.
cdef double SINGULAR = 1e-12, CERTAIN = 0.1


cdef struct Pixels:
    # Offsets px, weights, brightness without the mean star, and phases; the columns of the equations.
    int count
    double[ROOM] dx
    double[ROOM] dy
    float[ROOM] weight
    float[ROOM] value
    unsigned char[ROOM] phase
    float *design


cdef inline double _sum(const eights *sums) noexcept nogil:
    cdef const float *v = <const float *>sums
    return <double>((v[0] + v[4]) + (v[2] + v[6])) + <double>((v[1] + v[5]) + (v[3] + v[7]))


cdef fused_void _gram(
    const float *design, const float *weight, const float *value, int n, int steps, double *normal, double *right
) noexcept nogil:
    """Add to the lower half of normal (n, n) and to right (n,) what so many steps of pixels say.

    design: (n, ROOM), and beyond it room for the rows abreast.
    """
    cdef const eights *row
    cdef const eights *other
    cdef const eights *w = <const eights *>weight
    cdef const eights *v = <const eights *>value
    cdef eights[EIGHTS] weighted
    # four sums side by side, none of which waits for another
    cdef eights[ABREAST] sums
    cdef int a, b, c, s
    for a in range(n):
        row = <const eights *>design + a * EIGHTS
        memset(sums, 0, sizeof(sums))
        for s in range(steps):
            weighted[s] = row[s] * w[s]
            sums[0] += weighted[s] * v[s]
        right[a] += _sum(sums)
        for b in range(0, a + 1, 4):
            other = <const eights *>design + b * EIGHTS
            memset(sums, 0, sizeof(sums))
            for s in range(steps):
                for c in range(ABREAST):
                    sums[c] += weighted[s] * other[c * EIGHTS + s]
            for c in range(min(ABREAST, a + 1 - b)):
                normal[a * n + b + c] += _sum(&sums[c])


cdef void _add_pixels(
    Pixels *pixels, const Local *psf, const int[:, ::1] orders, int highest, int phases, double *normal, double *right
) noexcept nogil:
    """Add the pixels to the equations: of the terms, then of the gains, x and y."""
    cdef double[BLOCK] u
    cdef double[BLOCK] v
    cdef double[BLOCK] gauss
    cdef double[3][BLOCK] star
    cdef int terms = orders.shape[0], free_ = phases + 2, block, first, some, p, k
    cdef float *own = pixels.design + terms * ROOM
    memset(own, 0, free_ * ROOM * sizeof(float))
    for block in range(blocks(pixels.count)):
        first = block * BLOCK
        some = min(BLOCK, pixels.count - first)
        scaled(psf, pixels.dx + first, pixels.dy + first, some, u, v, gauss)
        if terms:
            terms_at(&orders[0, 0], terms, highest, u, v, gauss, pixels.design + first, ROOM)
        evaluate(psf, pixels.dx + first, pixels.dy + first, some, star[0], star[1], star[2])
        for p in range(some):
            k = first + p
            own[pixels.phase[k] * ROOM + k] = <float>star[0][p]
            own[phases * ROOM + k], own[(phases + 1) * ROOM + k] = <float>star[1][p], <float>star[2][p]
            pixels.value[k] -= <float>gauss[p]
    # the last step is filled up
    for k in range(pixels.count, (pixels.count + STEP - 1) // STEP * STEP):
        pixels.weight[k] = pixels.value[k] = 0.0
    _gram(pixels.design, pixels.weight, pixels.value, terms + free_, (pixels.count + STEP - 1) // STEP, normal, right)
    pixels.count = 0


cdef void _eliminate(double *normal, double *right, int terms, int free_, double[:, ::1] out, double[::1] out_right) noexcept nogil:
    """Set the equations of the terms with the others eliminated; 0 if these have no solution."""
    cdef int n = terms + free_, a, b, c
    cdef double[36] factor
    cdef double[6] share
    cdef double trace = 0.0
    for a in range(free_):
        trace += normal[(terms + a) * n + terms + a]
    for a in range(free_):
        for b in range(a + 1):
            factor[a * free_ + b] = normal[(terms + a) * n + terms + b]
        factor[a * free_ + a] += 1e-9 * trace + 1e-30
    if isnan(factored(factor, free_)):
        out[:, :], out_right[:] = 0.0, 0.0
        return
    for a in range(terms):
        for c in range(free_):
            share[c] = normal[(terms + c) * n + a]
        solved(factor, share, free_)
        out_right[a] = right[a]
        for c in range(free_):
            out_right[a] -= share[c] * right[terms + c]
        for b in range(a + 1):
            out[a, b] = normal[a * n + b]
            for c in range(free_):
                out[a, b] -= share[c] * normal[(terms + c) * n + b]
            out[b, a] = out[a, b]


def marginal_equations(
    const double[:, :, ::1] axes, const double[:, :, ::1] series, const double[::1] left, const double[::1] top,
    const float[:, :, ::1] brightness, const float[:, :, ::1] weight, const unsigned char[:, :, ::1] phase, int phases,
    const int[:, ::1] orders,
):
    """Normal equations, (N, T, T) and (N, T), of each of N stars for T terms of the PSF beside its mean Gaussian.

    axes, series  (N, ...) or (1, ...): as `detection.psf.LocalPsf` has them
    left, top     (N,) px: of each stamp's first column and row from its star's centre
    brightness    (N, S, S): the pixels over their stars' fluxes and gains
    weight        (N, S, S): inverse variances of brightness; 0 for a pixel that is not used
    phase         (N, S, S): the pixels' numbers in the mosaic of so many phases, 1 or 4
    orders        (T, 2): i, j of each term h_i(u) h_j(v)

    A star's place and its gain at each phase are free.
    """
    cdef int n = left.shape[0], size = brightness.shape[1], count = orders.shape[0], highest = 1, k, row, column
    cdef int each = count + phases + 2
    cdef Pixels pixels
    cdef Local psf
    sound(axes, series, n)
    check_stamps(brightness.shape, 2, [&weight.shape[0], &phase.shape[0]])
    if not (n == brightness.shape[0] == top.shape[0]) or orders.shape[1] != 2 or phases not in (1, 4):
        raise ValueError(f"{top.shape[0]} rows, {phases} phases, orders of {orders.shape[1]} numbers: {n} rows, 1 or 4, 2")
    if not within[unsigned_char](&phase[0, 0, 0], phase.shape[0] * phase.shape[1] * phase.shape[2], 0, phases - 1):
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {phases}")
    if not within[int](&orders[0, 0], 2 * count, 0, ORDERS):
        raise ValueError(f"terms of orders to {np.max(orders)}: they must be 0 to {ORDERS}")
    for k in range(count):
        highest = max(highest, max(orders[k, 0], orders[k, 1]))
    out, right_ = np.empty((n, count, count)), np.empty((n, count))
    cdef double[:, :, ::1] normals = out
    cdef double[:, ::1] rights = right_
    equations, designs = room_for(each * (each + 1) * sizeof(double)), np.zeros((each + ABREAST, ROOM), np.float32)
    cdef double *normal = <double *>start_of(equations)
    cdef float[:, ::1] design = designs
    pixels.design = &design[0, 0]
    with nogil:
        for k in range(n):
            local_of(axes, series, k, &psf)
            memset(normal, 0, each * (each + 1) * sizeof(double))
            pixels.count = 0
            for row in range(size):
                for column in range(size):
                    if not weight[k, row, column] > 0:
                        continue
                    pixels.dx[pixels.count], pixels.dy[pixels.count] = left[k] + column, top[k] + row
                    pixels.weight[pixels.count] = weight[k, row, column]
                    pixels.value[pixels.count] = brightness[k, row, column]
                    pixels.phase[pixels.count] = phase[k, row, column]
                    pixels.count += 1
                    if pixels.count == ROOM:
                        _add_pixels(&pixels, &psf, orders, highest, phases, normal, normal + each * each)
            if pixels.count:
                _add_pixels(&pixels, &psf, orders, highest, phases, normal, normal + each * each)
            _eliminate(normal, normal + each * each, count, phases + 2, normals[k], rights[k])
    return out, right_


cdef struct Light:
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


cdef fused_void _light_sums(const Light *p, double photon, double misfit2, double limit2, double *out) noexcept nogil:
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


cdef (double, double) _fit_noise(const Light *p, double photon, double misfit2, double outlier2) noexcept nogil:
    """DN of a photon, with 1 sigma of its error, and misfit squared, from those before."""
    cdef double[6] sums
    cdef int round_
    for round_ in range(ROUNDS):
        # at first nothing is known that could be exceeded
        _light_sums(p, photon, misfit2, outlier2 if photon + misfit2 > 0 else INFINITY, sums)
        photon, misfit2 = _two_terms(sums[1], sums[2], sums[3], sums[4], sums[5])
    # because errors given too small do more harm than too large ones
    return photon + sqrt(2 / max(sums[0], 1e-12)), misfit2


def light_noise(
    const float[:, :, ::1] noise, const float[:, :, ::1] model, const float[:, :, ::1] residual,
    const unsigned char[:, :, ::1] used, const float[:, :, ::1] leverage, double photon, double misfit, double outlier,
):
    """DN of a photon and misfit: a star's light s adds the variance photon s + (misfit s)^2 to that of the sky.

    noise                            (N, S, S) of the sky
    model, residual, used, leverage  (N, S, S) of a fit
    photon, misfit                   before
    outlier                          sigmas beyond which a residual teaches nothing
    """
    cdef Py_ssize_t pixels = noise.shape[0] * noise.shape[1] * noise.shape[2], room = pixels + LANES, j
    cdef double misfit2
    cdef Light p
    check_stamps(noise.shape, 4, [&model.shape[0], &residual.shape[0], &used.shape[0], &leverage.shape[0]])
    columns = room_for(3 * room * sizeof(double))
    p.noise2 = <double *>start_of(columns)
    p.count, p.light, p.square = 0, p.noise2 + room, p.noise2 + 2 * room
    with nogil:
        for j in range(pixels):
            if (&used[0, 0, 0])[j]:
                p.noise2[p.count] = <double>(&noise[0, 0, 0])[j] * (&noise[0, 0, 0])[j]
                p.light[p.count] = max((&model[0, 0, 0])[j], 0.0)
                p.square[p.count] = <double>(&residual[0, 0, 0])[j] * (&residual[0, 0, 0])[j]
                p.square[p.count] /= max(1.0 - (&leverage[0, 0, 0])[j], CERTAIN)
                p.count += 1
        while p.count % LANES:
            p.noise2[p.count], p.light[p.count], p.square[p.count] = 1.0, 0.0, 0.0
            p.count += 1
        photon, misfit2 = _fit_noise(&p, photon, misfit * misfit, outlier * outlier)
    return photon, sqrt(misfit2)


def phase_fluxes(
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
    check_stamps(noise.shape, 4, [&signal.shape[0], &value.shape[0], &good.shape[0], &phase.shape[0]])
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
