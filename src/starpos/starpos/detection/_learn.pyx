# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Learning a PSF: normal equations of its terms with each star's place and gains eliminated, its variation, and the noise.

The noise is that which grows with a star's light, from what fits leave.
"""

from libc.math cimport INFINITY, fabs, hypot, isnan, sqrt
from libc.string cimport memset

import numpy as np

from starpos._numeric.algebra cimport factored, middle, solved
from starpos._numeric.limits cimport check_stamps, unsigned_char, within
from starpos._numeric.memory cimport room_for, start_of
from starpos._numeric.wide cimport eights, fused_void, lanes, sum_of
from starpos.detection._psf cimport BLOCK, MONOMIALS, ORDERS, Local, blocks, evaluate, local_of, scaled, sound, terms_at

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


cdef bint _solve(double *upper, double *b, int n) noexcept nogil:
    """Replace b (n,) by the solution of the symmetric equations whose upper half is given, and destroyed; False: there is none.

    Cholesky's factor row by row: whole rows are added, in wide registers.
    """
    cdef double pivot, share
    cdef int i, j, k
    for k in range(n):
        pivot = upper[k * n + k]
        if not pivot > 0:
            return False
        pivot = 1 / sqrt(pivot)
        for j in range(k, n):
            upper[k * n + j] *= pivot
        b[k] *= pivot
        for i in range(k + 1, n):
            share = upper[k * n + i]
            for j in range(i, n):
                upper[i * n + j] -= share * upper[k * n + j]
            b[i] -= share * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= upper[k * n + j] * b[j]
        b[k] /= upper[k * n + k]
    return True


def choose_terms(
    const double[:, ::1] normal, const double[::1] right, const unsigned char[:, ::1] candidates, const double[::1] price
):
    """The coefficients (M,) that minimise chi-square plus their price; 0 for those not worth it.

    normal, right  (M, M), (M,): of the normal equations
    candidates     (C, M): sets of coefficients that are tried one after the other, beside those accepted before
    price          (M,): what each coefficient must lower chi-square by
    """
    cdef int most = right.shape[0], c, j, i, n
    cdef double best = 0.0, gain
    if not (normal.shape[0] == normal.shape[1] == candidates.shape[1] == price.shape[0] == most):
        raise ValueError(f"{normal.shape[0]} equations, {candidates.shape[1]} and {price.shape[0]} coefficients: {most} are needed")
    out, taken_ = np.zeros(most), np.zeros(most, np.uint8)
    cdef double[::1] found = out
    cdef unsigned char[::1] taken = taken_
    room = room_for(most * (most + 1) * sizeof(double) + most * sizeof(int))
    cdef double *upper = <double *>start_of(room)
    cdef double *solution = upper + most * most
    cdef int *index = <int *>(solution + most)
    with nogil:
        for c in range(candidates.shape[0]):
            n = 0
            for j in range(most):
                if taken[j] or candidates[c, j]:
                    index[n] = j
                    n += 1
            for i in range(n):
                solution[i] = right[index[i]]
                for j in range(i, n):
                    upper[i * n + j] = normal[index[i], index[j]]
            if not _solve(upper, solution, n):
                continue
            gain = 0.0
            for i in range(n):
                gain += right[index[i]] * solution[i] - price[index[i]]
            if gain > best:
                best = gain
                found[:] = 0.0
                for i in range(n):
                    found[index[i]], taken[index[i]] = solution[i], True
    return out


cdef bint _fit_field(
    const double[:, ::1] field, const double[:, ::1] own, const double *weight, double[:, ::1] out
) noexcept nogil:
    """Set coefficients of the monomials (6, V) to those of weighted least squares; False if there is no solution."""
    cdef double[MONOMIALS * MONOMIALS] normal
    cdef double[MONOMIALS] right
    cdef double trace = 0.0
    cdef Py_ssize_t k, v, n = field.shape[0]
    cdef int i, j
    for i in range(MONOMIALS):
        for j in range(i + 1):
            normal[i * MONOMIALS + j] = 0.0
            for k in range(n):
                normal[i * MONOMIALS + j] += weight[k] * field[k, i] * field[k, j]
        trace += normal[i * MONOMIALS + i]
    # what the places do not tell, as on a line, is 0
    for i in range(MONOMIALS):
        normal[i * MONOMIALS + i] += 1e-12 * trace
    if isnan(factored(normal, MONOMIALS)):
        return False
    for v in range(own.shape[1]):
        for i in range(MONOMIALS):
            right[i] = 0.0
            for k in range(n):
                right[i] += weight[k] * field[k, i] * own[k, v]
        solved(normal, right, MONOMIALS)
        for i in range(MONOMIALS):
            out[i, v] = right[i]
    return True


cdef int _check_field(const double[:, ::1] field, const double[:, ::1] own) except -1:
    if field.shape[1] != MONOMIALS or own.shape[0] != field.shape[0]:
        raise ValueError(f"{own.shape[0]} rows at {field.shape[0]} places of {field.shape[1]} monomials: as many, of {MONOMIALS}")
    return 0


def fit_field_robustly(const double[:, ::1] field, const double[:, ::1] own, const double[::1] weight, double outlying, int least, int rounds):
    """Coefficients (6, V) of monomials, field (N, 6), that fit values (N, V) best, with weights (N,), of the rows that agree.

    None of these is so many times farther off than the median.

    Returns also chi-square of their weighted mean and of the fit, and how many they are; None if fewer than the least.
    """
    cdef Py_ssize_t n = field.shape[0], values = own.shape[1], k, v
    cdef int round_, i, count = 0
    cdef bint same
    cdef double typical, one, total, mean, before = 0.0, after = 0.0
    _check_field(field, own)
    if weight.shape[0] != n:
        raise ValueError(f"{weight.shape[0]} weights for {n} rows: as many are needed")
    if n < least:
        return None
    out = np.empty((MONOMIALS, values))
    cdef double[:, ::1] fitted = out
    # weights of the rows that are kept, how far each is off, and that to be sorted
    room = room_for(3 * n * sizeof(double))
    cdef double *kept = <double *>start_of(room)
    cdef double *off = kept + n
    with nogil:
        for k in range(n):
            kept[k] = weight[k]
        for round_ in range(rounds):
            if not _fit_field(field, own, kept, fitted):
                count = 0
                break
            for k in range(n):
                off[k] = 0.0
                for v in range(values):
                    one = own[k, v]
                    for i in range(MONOMIALS):
                        one -= field[k, i] * fitted[i, v]
                    off[k] = max(off[k], sqrt(weight[k]) * fabs(one))
                off[n + k] = off[k]
            typical, count, same = middle(off + n, <int>n), 0, True
            for k in range(n):
                one = weight[k] if off[k] < outlying * typical else 0.0
                same, kept[k] = same and one == kept[k], one
                count += one > 0
            if count < least or same:
                break
        for v in range(values):
            mean = total = 0.0
            for k in range(n):
                mean += kept[k] * own[k, v]
                total += kept[k]
            mean /= total
            for k in range(n):
                one = own[k, v]
                for i in range(MONOMIALS):
                    one -= field[k, i] * fitted[i, v]
                before += kept[k] * (own[k, v] - mean) ** 2
                after += kept[k] * one * one
    return (out, before, after, count) if count >= least else None


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


def strangeness(
    const float[:, :, ::1] noise, const float[:, :, ::1] model, const float[:, :, ::1] residual,
    const unsigned char[:, :, ::1] used, const float[:, :, ::1] leverage, double darkest,
):
    """Sum of squared residuals beyond the sky's noise over that of the model (N,), of fits (N, S, S), and its error (N,).

    darkest  DN2: a model's sum of squares is at least so much
    """
    cdef Py_ssize_t n = model.shape[0], area = noise.shape[1] * noise.shape[2], k, j
    cdef double light2, left, scatter, noise2
    check_stamps(noise.shape, 4, [&model.shape[0], &residual.shape[0], &used.shape[0], &leverage.shape[0]])
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


def unit_light(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] phase,
    const float[:, :, ::1] model, const unsigned char[:, :, ::1] used, const double[::1] flux, const double[:, ::1] gains,
    double dn_per_photon, double misfit2,
):
    """The pixels (N, S, S) of stars over their fluxes and gains, and the inverse variances; 0 if not used.

    signal, noise, phase  (N, S, S) of the stars
    model, used           (N, S, S) of a fit, with flux (N,) and gains (N, P)
    dn_per_photon         DN2 of variance for each DN of light, and
    misfit2               for its square
    """
    cdef Py_ssize_t n = noise.shape[0], area = noise.shape[1] * noise.shape[2], k, j
    cdef float light, sky
    cdef double scale
    check_stamps(noise.shape, 4, [&model.shape[0], &used.shape[0], &signal.shape[0], &phase.shape[0]])
    if flux.shape[0] != n or gains.shape[0] != n:
        raise ValueError(f"{flux.shape[0]} fluxes and {gains.shape[0]} gains of {n} fits: one each is needed")
    if n and np.max(phase, initial=0) >= gains.shape[1]:
        raise ValueError(f"a pixel of phase {np.max(phase)}: there are {gains.shape[1]}")
    out = np.empty((2, n, noise.shape[1], noise.shape[2]), np.float32)
    cdef float[:, :, :, ::1] found = out
    with nogil:
        for k in range(n if area else 0):
            for j in range(area):
                scale = flux[k] * gains[k, (&phase[k, 0, 0])[j]]
                light, sky = max((&model[k, 0, 0])[j], <float>0), (&noise[k, 0, 0])[j]
                (&found[0, k, 0, 0])[j] = <float>((&signal[k, 0, 0])[j] / scale)
                (&found[1, k, 0, 0])[j] = <float>(
                    (&used[k, 0, 0])[j] * scale * scale / (sky * sky + (dn_per_photon + misfit2 * light) * light)
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
    room = room_for((3 * phases + 1) * n * sizeof(double))
    cdef double *ratio = <double *>start_of(room)
    cdef double *error2 = ratio + phases * n
    cdef double *weight = error2 + phases * n
    cdef double *sorted_ = weight + phases * n
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
    return gain_, sqrt(spread2)
