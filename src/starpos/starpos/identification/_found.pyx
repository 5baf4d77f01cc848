# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What is found of a frame: which stars are which, the attitude they give, and what follows from it."""

from libc.math cimport M_PI, atan2, hypot, sqrt

import numpy as np

from starpos._numeric.memory cimport numbers_of


NAMES = (
    "star", "catalogue", "blend_px", "attitude", "focal_scale", "residual_px", "mean_square_px2", "log_odds", "expected",
    "mirrored",
)


cdef class Identification:
    """M matched stars and the attitude they give.

    star             (M,): rows of the frame's stars, in ascending order
    catalogue        (M,): rows of the star catalogue
    blend_px         (M,): how far unresolved neighbours may move each star's image
    attitude         (3, 3): directions of the sky into C
    focal_scale      factor on the camera's focal length
    residual_px      rms along one axis, with the weights of the fit
    mean_square_px2  of the residuals along one axis, all alike
    log_odds         of the identification: its evidence, as `evidence` defines it, with the prior
    expected         (E,): rows of the catalogue's stars well inside the frame, brightest first
    mirrored         whether the frame's rows run bottom-up; the attitude is that of the flipped frame
    """

    def __init__(
        self, *, star, catalogue, blend_px, attitude, double focal_scale, double residual_px, double mean_square_px2,
        double log_odds, expected, bint mirrored,
    ):
        if not len(star) == len(catalogue) == len(blend_px):
            raise ValueError(f"{len(star)} stars, {len(catalogue)} rows and {len(blend_px)} blends are not of the same stars")
        hold(
            self, len(star), np.concatenate([star, catalogue, expected], dtype=np.intp, casting="unsafe"),
            np.concatenate([np.reshape(attitude, 9), blend_px], dtype=float),
        )
        self.due = len(expected)
        self.focal_scale, self.residual_px, self.mean_square_px2 = focal_scale, residual_px, mean_square_px2
        self.log_odds, self.mirrored = log_odds, mirrored

    @property
    def star(self):
        return self.rows[:self.matched]

    @property
    def catalogue(self):
        return self.rows[self.matched:2 * self.matched]

    @property
    def expected(self):
        return self.rows[2 * self.matched:2 * self.matched + self.due]

    @property
    def attitude(self):
        return self.reals[:9].reshape(3, 3)

    @property
    def blend_px(self):
        return self.reals[9:]

    def but(self, **changes):
        """The identification with some of its values changed."""
        return made({name: getattr(self, name) for name in NAMES} | changes)

    def __reduce__(self):
        return made, ({name: getattr(self, name) for name in NAMES},)

    def explains(self, int bright, int least):
        """How much of the frame it explains: three numbers.

        How many of the frame's `bright` brightest stars are matched; how many of the brightest expected stars are, of as many
        and at least `least`; and how many these are.
        """
        cdef const Py_ssize_t *catalogue = self.row + self.matched
        cdef const Py_ssize_t *expected = catalogue + self.matched
        cdef int k, j, due, found = 0, seen = 0
        for k in range(self.matched):
            found += self.row[k] < bright
        due = min(max(found, least), <int>self.due)
        for k in range(due):
            for j in range(self.matched):
                if catalogue[j] == expected[k]:
                    seen += 1
                    break
        return found, seen, due

    def spread_px(self, across_px, down_px):
        """Root of the summed squared distances of the matched stars from their mean; pixels (N,), (N,) of the frame's stars."""
        cdef Py_ssize_t n = len(across_px), k
        cdef const double *x = <const double *>numbers_of(across_px, n * sizeof(double))
        cdef const double *y = <const double *>numbers_of(down_px, n * sizeof(double))
        cdef double mean_x = 0.0, mean_y = 0.0, total = 0.0
        if self.matched > 0 and not 0 <= self.row[0] <= self.row[self.matched - 1] < n:
            raise IndexError(f"the stars that are matched are not among {n}")
        for k in range(self.matched):
            mean_x += x[self.row[k]]
            mean_y += y[self.row[k]]
        mean_x, mean_y = mean_x / self.matched, mean_y / self.matched
        for k in range(self.matched):
            total += (x[self.row[k]] - mean_x) ** 2 + (y[self.row[k]] - mean_y) ** 2
        return sqrt(total)

    def pointing(self, centre, above, velocity):
        """Right ascension, declination and position angle of the top (rad) of the frame, ICRS without aberration.

        The first and the last are in [0, 2 pi).

        centre    vector in C, three numbers of any length, of the frame's centre
        above     the same of a pixel above it
        velocity  (3,): of the Earth, in units of c
        """
        cdef const double *attitude = self.turn
        cdef double[2][3] seen
        cdef double[3] up
        cdef double norm, flat, east, north, x, y, z
        cdef int k, i
        for k in range(2):
            x, y, z = above if k else centre
            norm = sqrt(x * x + y * y + z * z)
            for i in range(3):
                seen[k][i] = (x * attitude[i] + y * attitude[3 + i] + z * attitude[6 + i]) / norm - <double>velocity[i]
            norm = sqrt(seen[k][0] ** 2 + seen[k][1] ** 2 + seen[k][2] ** 2)
            for i in range(3):
                seen[k][i] /= norm
        flat = hypot(seen[0][0], seen[0][1])
        for i in range(3):
            up[i] = (seen[1][i] - seen[0][i]) * (-1 if self.mirrored else 1)
        if flat > 0:
            east = (up[1] * seen[0][0] - up[0] * seen[0][1]) / flat
            north = up[2] * flat - (up[0] * seen[0][0] + up[1] * seen[0][1]) * seen[0][2] / flat
        else:
            # at a pole, on the meridian of right ascension 0
            east, north = up[1], -up[0] * seen[0][2]
        return _full_turn(atan2(seen[0][1], seen[0][0])), atan2(seen[0][2], flat), _full_turn(atan2(east, north))


def made(values):
    """The Identification of these values, by their names."""
    return Identification(**values)


cdef int hold(Identification found, Py_ssize_t matched, rows, reals) except -1:
    """Let it keep rows, of numpy's intp, and reals, doubles, as it names them."""
    found.matched, found.rows, found.reals = matched, rows, reals
    found.row = <Py_ssize_t *>numbers_of(rows, len(rows) * sizeof(Py_ssize_t))
    found.turn = <double *>numbers_of(reals, (9 + matched) * sizeof(double))
    return 0


cdef double _full_turn(double angle) noexcept:
    """An angle in [-pi, pi], brought to [0, 2 pi), as `rotation.full_turn` does."""
    angle += 2 * M_PI if angle < 0 else 0.0
    # the smallest negative angle becomes 2 pi
    return 0.0 if angle >= 2 * M_PI else angle
