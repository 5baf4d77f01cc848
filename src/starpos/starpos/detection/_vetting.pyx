# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What the pixels of stamps say of their stars: the sky at their rims, spikes, and whether one pixel is all."""

from libc.math cimport log

import numpy as np

from starpos._numeric.algebra cimport level_and_scatter, middle
from starpos._numeric.limits cimport check_stamps
from starpos._numeric.memory cimport room_for, start_of

cdef struct Rim:
    # Of a stamp: the pixels at its edges, over their noise, and their noise; whether this is the same in all.
    int count
    bint even
    double *score
    double *noise


cdef float _highest(const float *v, int n) noexcept nogil:
    """The highest of n numbers."""
    cdef float highest = v[0]
    cdef int k
    for k in range(n):
        highest = v[k] if v[k] > highest else highest
    return highest


cdef void _copy_rim(const float *signal, const float *noise, int size, Rim *rim) noexcept nogil:
    """Take the pixels at the edges of a stamp (S, S)."""
    cdef int row, place, step, n = 0
    rim.even = True
    for row in range(size):
        # of a row within, its ends
        step = 1 if row == 0 or row == size - 1 else size - 1
        place = row * size
        while place < (row + 1) * size:
            rim.score[n], rim.noise[n] = <double>signal[place] / noise[place], noise[place]
            rim.even = rim.even and noise[place] == noise[0]
            n += 1
            place += step
    rim.count = n


def correct_sky(float[:, :, ::1] signal, float[:, :, ::1] noise, double per_mad, double raised, double uneven, double own):
    """Correct level and noise of the sky in stamps (N, S, S), in place, by what the pixels at their rims show.

    per_mad          sigma over the median of the absolute differences
    raised, uneven   level and scatter in units of the noise, below which they may be chance
    own              share of the brightest pixel that at the rim may be the star's own light
    """
    cdef Py_ssize_t n = signal.shape[0], k
    cdef int size = signal.shape[1], area = size * size, j
    cdef double sky, spread, light
    cdef float up, wider
    cdef Rim rim
    check_stamps(signal.shape, 1, [&noise.shape[0]])
    room = room_for(2 * area * sizeof(double))
    rim.score = <double *>start_of(room)
    rim.noise = rim.score + area
    with nogil:
        for k in range(n):
            _copy_rim(&signal[k, 0, 0], &noise[k, 0, 0], size, &rim)
            sky, spread = level_and_scatter(rim.score, rim.count, per_mad, uneven)
            light = own * _highest(&signal[k, 0, 0], area) / (rim.noise[0] if rim.even else middle(rim.noise, rim.count))
            up = <float>sky if sky > raised and sky > light else 0
            wider = <float>spread if spread > light else 1
            if up != 0 or wider != 1:
                for j in range(area):
                    (&signal[k, 0, 0])[j] -= up * (&noise[k, 0, 0])[j]
                    (&noise[k, 0, 0])[j] *= wider


def replace_spikes(
    float[:, :, ::1] signal, const float[:, :, ::1] noise, unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] phase, const float[::1] gain, const float[::1] sharpest, float above,
):
    """Put the mean of their neighbours into pixels of stamps (N, S, S) that are much brighter than these, in place.

    gain      (P,): of each phase, by which pixels are compared
    sharpest  (N,): a spike is so many times brighter than its four neighbours and the noise, and
    above     so many sigma above the sky

    Returns which pixels they are, (N, S, S) bool; they are not good any more.
    """
    cdef Py_ssize_t n = signal.shape[0], k
    cdef int size = signal.shape[1], row, column, place, count
    cdef float grey, around
    cdef float *own
    cdef const float *sky
    cdef const unsigned char *part
    check_stamps(signal.shape, 3, [&noise.shape[0], &good.shape[0], &phase.shape[0]])
    if sharpest.shape[0] != n or (n and np.max(phase) >= gain.shape[0]):
        raise ValueError(f"{sharpest.shape[0]} sharpest and {gain.shape[0]} gains for {n} stars: one each, and of each phase")
    out = np.zeros((n, size, size), np.uint8)
    cdef unsigned char[:, :, ::1] spike = out
    room = room_for(size * size * sizeof(float))
    cdef float *mean = <float *>start_of(room)
    with nogil:
        for k in range(n):
            own, sky, part, count = &signal[k, 0, 0], &noise[k, 0, 0], &phase[k, 0, 0], 0
            for row in range(size):
                for column in range(size):
                    place = row * size + column
                    if not own[place] > above * sky[place]:
                        continue
                    grey = own[place] / gain[part[place]]
                    around = _beside(own, part, &gain[0], size, row, column)
                    if grey > sharpest[k] * (around + sky[place]):
                        spike[k, row, column], mean[place] = True, around * gain[part[place]]
                        count += 1
            # only now: a spike may have a spike beside it
            for place in range(size * size if count else 0):
                if (&spike[k, 0, 0])[place]:
                    own[place], (&good[k, 0, 0])[place] = mean[place], False
    return out.view(bool)


cdef float _beside(const float *signal, const unsigned char *phase, const float *gain, int size, int row, int column) noexcept nogil:
    """The mean of the four pixels beside one, over their gains; beyond the edges the image goes on as on them."""
    cdef int up = max(row - 1, 0) * size + column, down = min(row + 1, size - 1) * size + column
    cdef int left = row * size + max(column - 1, 0), right = row * size + min(column + 1, size - 1)
    cdef float total = signal[up] / gain[phase[up]] + signal[down] / gain[phase[down]]
    total += signal[left] / gain[phase[left]]
    total += signal[right] / gain[phase[right]]
    return total * <float>0.25


def compare_with_pixel(
    const float[:, :, ::1] signal, const float[:, :, ::1] noise, const unsigned char[:, :, ::1] good,
    const unsigned char[:, :, ::1] full, const float[:, :, ::1] residual, const float[:, :, ::1] model,
    double dn_per_photon, double misfit, int half,
):
    """How well a single pixel on the sky describes stars, and how well their fits do, `half` px around the middle.

    Returns columns (N,): chi-square of the one pixel, chi-square of the star with the logarithm of its variance, and how
    many pixels are good, and how many are saturated.
    """
    cdef Py_ssize_t n = signal.shape[0], k
    cdef int size = signal.shape[1], middle_ = size // 2, row, column, count, white
    cdef double score, most, one, star, light, sky2, variance
    check_stamps(signal.shape, 5, [&noise.shape[0], &good.shape[0], &full.shape[0], &residual.shape[0], &model.shape[0]])
    if not 0 <= half <= middle_:
        raise ValueError(f"{half} px around the middle of stamps of {size} px: they have no such pixels")
    sums_, counts_ = np.empty((2, n)), np.empty((2, n), np.int64)
    cdef double[:, ::1] sums = sums_
    cdef long long[:, ::1] counts = counts_
    with nogil:
        for k in range(n):
            most = one = star = 0.0
            count = white = 0
            for row in range(middle_ - half, middle_ + half + 1):
                for column in range(middle_ - half, middle_ + half + 1):
                    white += full[k, row, column]
                    if not good[k, row, column]:
                        continue
                    count += 1
                    score = signal[k, row, column] / noise[k, row, column]
                    one += score * score
                    if signal[k, row, column] > 0:
                        most = max(most, score * score)
                    light, sky2 = max(model[k, row, column], 0.0), <double>noise[k, row, column] * noise[k, row, column]
                    variance = sky2 + dn_per_photon * light + misfit * misfit * light * light
                    star += residual[k, row, column] * residual[k, row, column] / variance + log(variance / sky2)
            sums[0, k], sums[1, k], counts[0, k], counts[1, k] = one - most, star, count, white
    return sums_[0], sums_[1], counts_[0], counts_[1]
