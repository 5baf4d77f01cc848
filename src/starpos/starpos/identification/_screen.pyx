# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Poses of triangles, and their worth by the bright catalogue stars that a frame's bright stars coincide with."""

from libc.math cimport M_PI, log, sqrt
from libc.stdlib cimport free, malloc, qsort

import numpy as np

from starpos._numeric.algebra cimport best_rotation, fetch, length, turned
from starpos.identification._frame cimport FrameStars, axis_of, direction_of, on_frame, pixel_of, pixels_of
from starpos.identification._matching cimport Matching, begin, match, order
from starpos.identification._sky cimport MAX_RUNS, Date, StarTable, runs_near
from starpos.identification._triangles cimport Candidate

# Stars so far beyond a frame are on it.
cdef double EDGE_PX = 2.0


cdef int _by_rank(const void *one, const void *other) noexcept nogil:
    return (<const Bright *>one).rank - (<const Bright *>other).rank


cdef class BrightTable:
    """The brightest stars of a catalogue: their rows, their rank in brightness, first rows of the cells of the sky."""

    def __init__(self, StarTable stars, row, rank, cell_start):
        self.stars = stars
        self.row = np.ascontiguousarray(row, np.int32)
        self.rank = np.ascontiguousarray(rank, np.int32)
        self.cell_start = np.ascontiguousarray(cell_start, np.int32)

    cdef void pose(
        self, FrameStars frame, const Candidate *c, const Date *date, double error_px, double match_sigma, int n,
        double *attitude, double *focal, double *radius,
    ) noexcept nogil:
        """Set the pose that brings a candidate's catalogue triangle to that of the frame.

        error_px     of all stars, beside their own
        match_sigma  how many sigma stars may be off
        radius       (n,): the distance (px) by which the n brightest may be

        The focal length makes the triangle's perimeter right, then the rotation brings it into place.
        """
        cdef double[9] w
        cdef double[9] seen
        cdef double[9] b
        cdef double x = 0.0, y = 0.0, size2 = 0.0, away2, wanted
        cdef const double *xy = pixels_of(frame, c.mirrored)
        cdef const double *pixel
        cdef int i, j, k, turn
        for k in range(3):
            fetch(&self.row[c.corner[k]])
        for k in range(3):
            self.stars.ask(self.row[c.corner[k]], self.row[c.corner[k]], date)
        for k in range(3):
            self.stars.direction(self.row[c.corner[k]], date, &w[3 * k])
            pixel = &xy[2 * c.star[k]]
            x += pixel[0] / 3
            y += pixel[1] / 3
        wanted = _perimeter(w)
        focal[0] = frame.focal_px
        for turn in range(3):
            for k in range(3):
                pixel = &xy[2 * c.star[k]]
                direction_of(pixel[0], pixel[1], focal[0], &seen[3 * k])
            if turn < 2:
                focal[0] *= _perimeter(seen) / wanted
        for i in range(3):
            for j in range(3):
                b[3 * i + j] = 0.0
                for k in range(3):
                    b[3 * i + j] += seen[3 * k + i] * w[3 * k + j]
        best_rotation(b, attitude)
        # a triangle's error grows with the distance from it
        for k in range(3):
            pixel = &xy[2 * c.star[k]]
            size2 += ((pixel[0] - x) ** 2 + (pixel[1] - y) ** 2) / 3
        for i in range(n):
            pixel = &xy[2 * i]
            away2 = (pixel[0] - x) ** 2 + (pixel[1] - y) ** 2
            radius[i] = match_sigma * length(frame.error[i], error_px) * sqrt(1 + away2 / max(size2, 1.0))

    cdef double worth(
        self, FrameStars frame, const Candidate *c, const Date *date, const double *attitude, double focal_px, int n,
        const double *radius_px, int most_stars, double match_sigma, double log_false,
    ) except? -1:
        """The log-odds of a pose against chance, by stars that coincide with the n brightest of a frame.

        c           the candidate from which the pose was made: its stars are no evidence for it
        radius_px   (n,): how far stars may be off, match_sigma of their errors
        most_stars  so many of the brightest catalogue stars on the frame are looked at
        log_false   logarithm of the share of detections that may be false
        """
        cdef int[2 * MAX_RUNS] runs
        cdef double[3] axis
        cdef double total = 0.0, best = -1e300, variance, area_px2 = 4 * frame.reach[0] * frame.reach[1]
        cdef Matching m
        cdef Bright *bright = NULL
        cdef double *pixel
        cdef int i, count, room = 0
        axis_of(frame, c.mirrored, attitude, axis)
        count = runs_near(&self.cell_start[0], axis, frame.radius, runs)
        for i in range(count):
            room += runs[2 * i + 1] - runs[2 * i]
        m.memory = NULL
        bright = <Bright *>malloc((room + 1) * (sizeof(Bright) + 2 * sizeof(double)))
        try:
            if bright == NULL:
                raise MemoryError
            pixel = <double *>(bright + room + 1)
            count = self._on_frame(runs, count, frame, c.mirrored, attitude, focal_px, date, bright)
            if count > most_stars:
                qsort(bright, count, sizeof(Bright), _by_rank)
                count = most_stars
            for i in range(count):
                pixel[2 * i], pixel[2 * i + 1] = bright[i].x, bright[i].y
            begin(&m, n, count)
            order(&m, pixels_of(frame, c.mirrored), n)
            match(&m, n, pixel, count, radius_px)
            # the sum from the brightest star down to the one where it is largest
            for i in range(n):
                if i != c.star[0] and i != c.star[1] and i != c.star[2]:
                    if m.near[i] >= 0:
                        variance = (radius_px[i] / match_sigma) ** 2
                        total -= 0.5 * m.near2[i] / variance
                        total -= log(2 * M_PI * variance * max(count, 1) / area_px2)
                    else:
                        total += log_false
                best = max(best, total)
        finally:
            free(bright)
            free(m.memory)
        return best

    cdef int _on_frame(
        self, const int *runs, int count, FrameStars frame, bint mirrored, const double *attitude, double focal_px,
        const Date *date, Bright *bright,
    ) noexcept nogil:
        """The stars of runs of rows that lie on a frame: their pixels; how many."""
        cdef int i, k, kept = 0
        cdef double[3] w
        cdef double[3] u
        for i in range(count):
            for k in range(runs[2 * i], runs[2 * i + 1]):
                self.stars.direction(self.row[k], date, w)
                turned(attitude, w, u)
                pixel_of(u, focal_px, u)
                bright[kept].x, bright[kept].y, bright[kept].rank = u[0], u[1], self.rank[k]
                kept += on_frame(frame, mirrored, u, EDGE_PX)
        return kept


cdef double _perimeter(const double *v) noexcept nogil:
    """Perimeter of a triangle of unit vectors (3, 3), along the chords."""
    cdef double total = 0.0
    cdef int c, d
    for c in range(3):
        d = (c + 1) % 3
        total += sqrt((v[3 * c] - v[3 * d]) ** 2 + (v[3 * c + 1] - v[3 * d + 1]) ** 2 + (v[3 * c + 2] - v[3 * d + 2]) ** 2)
    return total
