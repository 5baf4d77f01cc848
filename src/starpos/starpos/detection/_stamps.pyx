# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The pixels around stars, above the sky and in its noise."""

from libc.math cimport ceil
from libc.stdlib cimport free, malloc

import numpy as np

cimport starpos._numeric.wide
from starpos._numeric.algebra cimport fetch
from starpos._numeric.limits cimport inside

cdef extern from *:
    """
    /* Eight pixels at once, which a compiler left to itself takes one by one where rows are short. */
    typedef float starpos_eight __attribute__((vector_size(32)));
    typedef float starpos_eights __attribute__((vector_size(32), aligned(4)));
    typedef signed char starpos_bytes __attribute__((vector_size(8), aligned(1)));
    /* Take a row of n pixels that lies on the frame, whose columns alternate between two phases (or are of one): most are so.
       level, noise: of the first column and of the second; full: 1, not 255. The last eight may overlap with others. */
    #define STARPOS_TAKE_ROW(name, pixel, whole) \
    typedef pixel name##_pixels __attribute__((vector_size(8 * sizeof(pixel)), aligned(sizeof(pixel)))); \
    STARPOS_WIDE static void name(const pixel *line, int n, int limit, const float *level, const float *noise, \
                                  const unsigned char *phase, float *signal, float *sky, \
                                  unsigned char *good, unsigned char *full, unsigned char *part) { \
        const pixel last_dark = (pixel)(limit - 1 < whole ? limit - 1 : whole); \
        for (int i = 0; i < n && n >= 8; i += 8) { \
            const int at = i < n - 8 ? i : n - 8, odd = at & 1; \
            const float a = level[odd], b = level[1 - odd], c = noise[odd], d = noise[1 - odd]; \
            const signed char e = phase[odd], f = phase[1 - odd]; \
            const name##_pixels value = *(const name##_pixels *)(line + at); \
            const starpos_bytes white = __builtin_convertvector(value > last_dark, starpos_bytes) & 1; \
            *(starpos_eights *)(signal + at) = __builtin_convertvector(value, starpos_eight) - (starpos_eight){a, b, a, b, a, b, a, b}; \
            *(starpos_eights *)(sky + at) = (starpos_eight){c, d, c, d, c, d, c, d}; \
            *(starpos_bytes *)(part + at) = (starpos_bytes){e, f, e, f, e, f, e, f}; \
            *(starpos_bytes *)(full + at) = white; \
            *(starpos_bytes *)(good + at) = white ^ 1; \
        } \
        for (int j = 0; j < n && n < 8; j++) { \
            signal[j] = (float)line[j] - level[j & 1]; \
            sky[j] = noise[j & 1]; \
            part[j] = phase[j & 1]; \
            full[j] = line[j] > last_dark; \
            good[j] = full[j] ^ 1; \
        } \
    }
    STARPOS_TAKE_ROW(starpos_take_8, unsigned char, 255)
    STARPOS_TAKE_ROW(starpos_take_16, unsigned short, 65535)
    /* The light of n pixels above the sky at each; the highest of them. */
    #define STARPOS_LIGHT_ROW(name, pixel) \
    STARPOS_WIDE static int name(const pixel *restrict line, int n, const float *restrict level, float *restrict light) { \
        int highest = 0; \
        for (int j = 0; j < n; j++) { \
            light[j] = (float)line[j] - level[j]; \
            highest = line[j] > highest ? line[j] : highest; \
        } \
        return highest; \
    }
    STARPOS_LIGHT_ROW(starpos_light_8, unsigned char)
    STARPOS_LIGHT_ROW(starpos_light_16, unsigned short)
    /* A row of n pixels smoothed along both axes by 1/4, 1/2, 1/4. line: room for n + 2. */
    STARPOS_WIDE static void starpos_grey(const float *restrict above, const float *restrict own, const float *restrict below,
                                          Py_ssize_t n, float *restrict line, float *restrict out) {
        for (Py_ssize_t j = 0; j < n; j++)
            line[j + 1] = 0.5f * own[j] + 0.25f * (above[j] + below[j]);
        line[0] = line[1];
        line[n + 1] = line[n];
        for (Py_ssize_t j = 0; j < n; j++)
            out[j] = 0.5f * line[j + 1] + 0.25f * (line[j] + line[j + 2]);
    }
    """
    void take_8 "starpos_take_8"(
        const unsigned char *line, int n, int limit, const float *level, const float *noise, const unsigned char *phase,
        float *signal, float *sky, unsigned char *good, unsigned char *full, unsigned char *part,
    ) noexcept nogil
    void take_16 "starpos_take_16"(
        const unsigned short *line, int n, int limit, const float *level, const float *noise, const unsigned char *phase,
        float *signal, float *sky, unsigned char *good, unsigned char *full, unsigned char *part,
    ) noexcept nogil
    int light_8 "starpos_light_8"(const unsigned char *line, int n, const float *level, float *light) noexcept nogil
    int light_16 "starpos_light_16"(const unsigned short *line, int n, const float *level, float *light) noexcept nogil
    void grey_row "starpos_grey"(
        const float *above, const float *own, const float *below, Py_ssize_t n, float *line, float *out
    ) noexcept nogil


cdef enum:
    # No pixel is as bright.
    BEYOND = 65536

ctypedef unsigned char unsigned_char

ctypedef fused pixel_t:
    unsigned_char
    unsigned short


def around(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach, const float[:, ::1] level,
    const float[:, ::1] noise, double saturation,
):
    """Stamps of (2 reach + 1) px around the pixels x, y (N,) of a plane (h, w).

    level, noise  (N, P) DN of the sky at each star, P = 1, or 4 for the phases of a colour mosaic
    saturation    DN from which a pixel is saturated

    Returns signal, noise, good, full and phase, as `detection.stamps.Stamps` has them. A pixel beyond the frame is as
    the nearest one on it, but neither good nor full.
    """
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row, place
    cdef int size = 2 * reach + 1, phases = level.shape[1], phase
    cdef int limit = <int>ceil(saturation) if saturation < BEYOND else BEYOND, value
    cdef const pixel_t *line
    cdef bint on, full, whole
    cdef float[2] levels
    cdef float[2] noises
    cdef unsigned char[2] parts
    if not (y.shape[0] == level.shape[0] == noise.shape[0] == n and noise.shape[1] == phases and phases in (1, 4)):
        raise ValueError("a row, and a level and noise for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    skies, marks = np.empty((2, n, size, size), np.float32), np.empty((3, n, size, size), np.uint8)
    cdef float[:, :, ::1] sky = skies.reshape(2, n, size * size)
    cdef unsigned char[:, :, ::1] mark = marks.reshape(3, n, size * size)
    with nogil:
        for k in range(n):
            whole = reach <= x[k] < width - reach
            # peaks are in no order: the next one's rows are far away
            for i in range(size if k + 1 < n else 0):
                fetch(&plane[inside(y[k + 1] - reach + i, height), inside(x[k + 1] - reach, width)])
            for i in range(size):
                row, place = y[k] - reach + i, i * size
                line = &plane[inside(row, height), 0]
                if whole and 0 <= row < height:
                    for j in range(2):
                        parts[j] = <unsigned char>(2 * (row & 1) + (x[k] - reach + j & 1)) if phases > 1 else 0
                        levels[j], noises[j] = level[k, parts[j]], noise[k, parts[j]]
                    if pixel_t is unsigned_char:
                        take_8(
                            line + x[k] - reach, size, limit, levels, noises, parts, &sky[0, k, place], &sky[1, k, place],
                            &mark[0, k, place], &mark[1, k, place], &mark[2, k, place],
                        )
                    else:
                        take_16(
                            line + x[k] - reach, size, limit, levels, noises, parts, &sky[0, k, place], &sky[1, k, place],
                            &mark[0, k, place], &mark[1, k, place], &mark[2, k, place],
                        )
                    continue
                for j in range(x[k] - reach, x[k] + reach + 1):
                    on = 0 <= row < height and 0 <= j < width
                    phase = <int>(2 * (row & 1) + (j & 1)) if phases > 1 else 0
                    value = line[inside(j, width)]
                    sky[0, k, place], sky[1, k, place] = <float>value - level[k, phase], noise[k, phase]
                    full = value >= limit
                    mark[0, k, place], mark[1, k, place], mark[2, k, place] = on and not full, on and full, phase
                    place += 1
    good, white = marks[:2].view(bool)
    return skies[0], skies[1], good, white, marks[2]


def light_around(
    const pixel_t[:, ::1] plane, const Py_ssize_t[::1] x, const Py_ssize_t[::1] y, int reach, const float[:, ::1] level,
    double saturation,
):
    """The signal alone (N, S, S) of stamps as in `around`, and whether one of their pixels is saturated, (N,) bool.

    Pixels beyond the frame count too: of a star on the frame they are as others on its stamp.
    """
    cdef Py_ssize_t n = x.shape[0], height = plane.shape[0], width = plane.shape[1], k, i, j, row
    cdef int size = 2 * reach + 1, phases = level.shape[1], highest
    cdef const pixel_t *line
    cdef float *own
    if not (y.shape[0] == level.shape[0] == n and phases in (1, 4)):
        raise ValueError("a row, and a level for each of 1 or 4 phases, are needed for each column of a star")
    if reach < 0 or not (height and width):
        raise ValueError(f"stamps of {size} px of a frame of {width} x {height} px: there is nothing to see")
    light, white = np.empty((n, size, size), np.float32), np.empty(n, np.uint8)
    cdef float[:, :, ::1] signal = light
    cdef unsigned char[::1] full = white
    # of the columns of an even row and of an odd one, and pixels where a row is not on the frame
    cdef float *skies = <float *>malloc(2 * size * sizeof(float))
    cdef pixel_t *pixels = <pixel_t *>malloc(size * sizeof(pixel_t))
    if skies == NULL or pixels == NULL:
        free(skies)
        free(pixels)
        raise MemoryError
    with nogil:
        for k in range(n):
            for i in range(size if k + 1 < n else 0):
                fetch(&plane[inside(y[k + 1] - reach + i, height), inside(x[k + 1] - reach, width)])
            for i in range(2):
                for j in range(size):
                    skies[i * size + j] = level[k, 2 * i + (x[k] - reach + j & 1)] if phases > 1 else level[k, 0]
            highest = 0
            for i in range(size):
                row = y[k] - reach + i
                line = &plane[inside(row, height), 0]
                if reach <= x[k] < width - reach:
                    line += x[k] - reach
                else:
                    for j in range(size):
                        pixels[j] = line[inside(x[k] - reach + j, width)]
                    line = pixels
                own = &signal[k, i, 0]
                if pixel_t is unsigned_char:
                    highest = max(highest, light_8(line, size, skies + (row & 1) * size, own))
                else:
                    highest = max(highest, light_16(line, size, skies + (row & 1) * size, own))
            full[k] = highest >= saturation
    free(skies)
    free(pixels)
    return light, white.view(bool)


def greyed(const float[:, :, ::1] signal):
    """Images (N, S, S) smoothed along both axes by 1/4, 1/2, 1/4, which removes a mosaic's pattern; they end as in a level."""
    cdef Py_ssize_t n = signal.shape[0], rows = signal.shape[1], columns = signal.shape[2], k, i
    out = np.empty((n, rows, columns), np.float32)
    if not columns:
        return out
    cdef float[:, :, ::1] smooth = out
    cdef float *line = <float *>malloc((columns + 2) * sizeof(float))
    if line == NULL:
        raise MemoryError
    with nogil:
        for k in range(n):
            for i in range(rows):
                grey_row(
                    &signal[k, max(i - 1, 0), 0], &signal[k, i, 0], &signal[k, min(i + 1, rows - 1), 0], columns, line,
                    &smooth[k, i, 0],
                )
    free(line)
    return out
