# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Normal equations of a PSF's terms, star by star, with the star's own place and gains eliminated."""

from libc.math cimport isnan, sqrt
from libc.stdlib cimport calloc, free, malloc
from libc.string cimport memset

import numpy as np

from starpos._numeric.algebra cimport factored, solved
from starpos._numeric.limits cimport unsigned_char, within
from starpos._numeric.wide cimport eights, fused_void
from starpos.detection._psf cimport BLOCK, ORDERS, Local, blocks, evaluate, local_of, scaled, sound, terms_at

cdef enum:
    ROOM = 128
    EIGHTS = 16
    STEP = 8
    ABREAST = 4


cdef struct Pixels:
    # Offsets px, weights, brightness without the mean star, and phases; the columns of the equations.
    int count
    double[ROOM] dx
    double[ROOM] dy
    float[ROOM] weight
    float[ROOM] value
    unsigned char[ROOM] phase
    float *design


cdef inline double _all(const eights *sums) noexcept nogil:
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
        right[a] += _all(sums)
        for b in range(0, a + 1, 4):
            other = <const eights *>design + b * EIGHTS
            memset(sums, 0, sizeof(sums))
            for s in range(steps):
                for c in range(ABREAST):
                    sums[c] += weighted[s] * other[c * EIGHTS + s]
            for c in range(min(ABREAST, a + 1 - b)):
                normal[a * n + b + c] += _all(&sums[c])


cdef void _add(
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


def marginal(
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
    for images, rows, columns in (
        (brightness.shape[0], brightness.shape[1], brightness.shape[2]),
        (weight.shape[0], weight.shape[1], weight.shape[2]),
        (phase.shape[0], phase.shape[1], phase.shape[2]),
    ):
        if (images, rows, columns) != (n, size, size):
            raise ValueError(f"pixels {(images, rows, columns)}: {(n, size, size)} are needed")
    if top.shape[0] != n or orders.shape[1] != 2 or phases not in (1, 4):
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
    cdef double *normal = <double *>malloc(each * (each + 1) * sizeof(double))
    pixels.design = <float *>calloc((each + ABREAST) * ROOM, sizeof(float))
    if normal == NULL or pixels.design == NULL:
        free(normal)
        free(pixels.design)
        raise MemoryError
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
                        _add(&pixels, &psf, orders, highest, phases, normal, normal + each * each)
            if pixels.count:
                _add(&pixels, &psf, orders, highest, phases, normal, normal + each * each)
            _eliminate(normal, normal + each * each, count, phases + 2, normals[k], rights[k])
    free(normal)
    free(pixels.design)
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


def chosen(
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
    cdef double *upper = <double *>malloc(max(most * (most + 1), 1) * sizeof(double))
    cdef int *index = <int *>malloc(max(most, 1) * sizeof(int))
    if upper == NULL or index == NULL:
        free(upper)
        free(index)
        raise MemoryError
    cdef double *solution = upper + most * most
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
    free(upper)
    free(index)
    return out
