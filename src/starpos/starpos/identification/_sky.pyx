# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Catalogue stars in the directions in which they are seen at a date, and those of them that lie on a frame."""

from libc.math cimport M_PI, asin, atan2, cos, fabs, fabsf, floor, hypot, pow, rint, sin, sqrt, tan
from libc.stdlib cimport free, malloc

import numpy as np

from starpos._numeric.algebra cimport Point, Strips, fetch, sort_by_x, turned
from starpos.identification._frame cimport FrameStars, axis_of, pixel_of, seen_on

cdef enum:
    # In mas.
    DEGREE = 3600000
    # Of brightness: V from -10.24 to 30.71 in steps of 0.01.
    BINS = 4096
    BRIGHTEST = -1024
    # Numbers of 32 bits in a piece of memory that comes at once.
    LINE = 16
    # Mas: a circle, and how far beyond a frame stars may be that have moved, or whose light is bent.
    CIRCLE = 1296000000
    MOVED = 360000

cdef double MAS = M_PI / 180 / DEGREE
# Where the plane is as far (rad) from the sphere as this share of a frame's radius, it is no plane.
cdef double MAX_CURVED = 0.5

# Sine and cosine of the middle of each degree of right ascension, and of declination from -90.
cdef double[CELLS] sin_ra, cos_ra
cdef double[ZONES + 1] sin_dec, cos_dec


cdef void _fill_tables() noexcept:
    cdef int k
    for k in range(CELLS):
        sin_ra[k], cos_ra[k] = sin((k + 0.5) * M_PI / 180), cos((k + 0.5) * M_PI / 180)
    for k in range(ZONES + 1):
        sin_dec[k], cos_dec[k] = sin((k - 89.5) * M_PI / 180), cos((k - 89.5) * M_PI / 180)


_fill_tables()


cdef inline void _of_small(double x, double *sine, double *cosine) noexcept nogil:
    """Sine and cosine of at most half a degree: the next terms of the series are below 1e-18."""
    cdef double x2 = x * x
    sine[0] = x * (1 - x2 * (1.0 / 6) * (1 - x2 * (1.0 / 20) * (1 - x2 * (1.0 / 42))))
    cosine[0] = 1 - x2 * 0.5 * (1 - x2 * (1.0 / 12) * (1 - x2 * (1.0 / 30)))


cdef class StarTable:
    """Columns of a star catalogue: places in mas, motions in mas/yr, V in 0.01 mag, first rows of the cells of the sky."""

    def __init__(self, catalogue):
        self.ra = np.ascontiguousarray(catalogue.ra_mas, np.uint32)
        self.dec = np.ascontiguousarray(catalogue.dec_mas, np.int32)
        self.pm_ra = np.ascontiguousarray(catalogue.pm_ra, np.int16)
        self.pm_dec = np.ascontiguousarray(catalogue.pm_dec, np.int16)
        self.vmag = np.ascontiguousarray(catalogue.vmag_centi, np.int16)
        self.cell_start = np.ascontiguousarray(catalogue.cell_start, np.int32)

    cdef void direction(self, Py_ssize_t row, const Date *date, double *w) noexcept nogil:
        """Set w (3,) to the unit vector of a row at a date."""
        cdef unsigned int ra = self.ra[row], dec = <unsigned int>(self.dec[row] + 90 * DEGREE)
        cdef unsigned int i = ra // DEGREE, j = dec // DEGREE
        cdef double s, c, sr, cr, sd, cd, east, north, norm
        _of_small(<int>(ra - i * DEGREE - DEGREE // 2) * MAS, &s, &c)
        sr, cr = sin_ra[i] * c + cos_ra[i] * s, cos_ra[i] * c - sin_ra[i] * s
        _of_small(<int>(dec - j * DEGREE - DEGREE // 2) * MAS, &s, &c)
        sd, cd = sin_dec[j] * c + cos_dec[j] * s, cos_dec[j] * c - sin_dec[j] * s
        w[0], w[1], w[2] = cd * cr, cd * sr, sd
        if not date.moved:
            return
        east, north = self.pm_ra[row] * date.years * MAS, self.pm_dec[row] * date.years * MAS
        w[0] += -sr * east - sd * cr * north
        w[1] += cr * east - sd * sr * north
        w[2] += cd * north
        norm = 1 / sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        for i in range(3):
            w[i] = w[i] * norm + date.velocity[i]
        norm = 1 / sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
        for i in range(3):
            w[i] *= norm

    def directions(self, const Py_ssize_t[::1] index, double years, velocity):
        """Unit vectors (n, 3) of rows (n,), `years` after J2000, with aberration by `velocity` (3,) in units of c."""
        cdef Date date = date_of(years, velocity)
        cdef Py_ssize_t k
        out = np.empty((len(index), 3))
        cdef double[:, ::1] w = out
        for k in range(len(index)):
            if not 0 <= index[k] < len(self.ra):
                raise IndexError(f"the star catalogue has no row {index[k]}")
            self.direction(index[k], &date, &w[k, 0])
        return out

    def on_frame(
        self, FrameStars frame, bint mirrored, const double[:, ::1] attitude, double focal_px, double years, velocity,
        double margin_px, int most, double blend_px,
    ):
        """The brightest stars on a frame: rows (S,), directions (S, 3), and how far (px) fainter ones move the image.

        mirrored            whether the frame's rows are flipped
        attitude, focal_px  the pose
        margin_px           stars so far beyond the frame are on it
        most                so many stars are taken
        blend_px            closer stars make one image
        """
        cdef Date date = date_of(years, velocity)
        cdef Visible found
        cdef Py_ssize_t[::1] row
        cdef double[:, ::1] w
        cdef double[::1] moved
        cdef int k, i
        found.memory = NULL
        try:
            self.find(frame, mirrored, &attitude[0, 0], focal_px, &date, margin_px, most, blend_px, &found)
            index, directions, drawn = np.empty(found.count, np.intp), np.empty((found.count, 3)), np.empty(found.count)
            row, w, moved = index, directions, drawn
            for k in range(found.count):
                row[k], moved[k] = found.row[k], found.moved[k]
                for i in range(3):
                    w[k, i] = found.w[3 * k + i]
            return index, directions, drawn
        finally:
            free(found.memory)

    cdef int find(
        self, FrameStars frame, bint mirrored, const double *attitude, double focal_px, const Date *date,
        double margin_px, int most, double blend_px, Visible *out,
    ) except -1 nogil:
        """Set `out` to the stars of `on_frame`; its memory is the caller's to free, even after an error."""
        cdef int[2 * MAX_RUNS] runs
        cdef double[3] axis
        # the cells reach beyond the frame
        cdef int cut = 4 * most + 100, i, n = 0, count
        cdef Patch patch
        axis_of(frame, mirrored, attitude, axis)
        count = runs_near(&self.cell_start[0], axis, frame.radius, runs)
        for i in range(count):
            n += runs[2 * i + 1] - runs[2 * i]
            self.ask(runs[2 * i], runs[2 * i + 1], date)
        most = min(most, n)
        out.memory = malloc((most + 1) * (sizeof(Py_ssize_t) + 4 * sizeof(double) + 2 * sizeof(Point)) + 3 * sizeof(int) * (n + 1))
        if out.memory == NULL:
            with gil:
                raise MemoryError
        out.w = <double *>out.memory
        out.moved = out.w + 3 * most
        out.row = <Py_ssize_t *>(out.moved + most)
        # half of it to sort in
        cdef Point *pixel = <Point *>(out.row + most)
        cdef int *near = <int *>(pixel + 2 * most)
        cdef int *rows = near + n + 1
        cdef int *bins = rows + n + 1
        _flatten(frame, mirrored, attitude, focal_px, axis, margin_px, &patch)
        n = self._inside(runs, count, &patch, near, rows)
        n = self._by_light(rows, n, cut, bins, near)
        self._projected(near, n, frame, mirrored, attitude, focal_px, margin_px, date, most, out, pixel)
        return self._unblended(pixel, blend_px, frame.focal_px, out, near)

    cdef void ask(self, int first, int end, const Date *date) noexcept nogil:
        """Ask for the memory of rows that are needed soon."""
        cdef int k, row
        for k in range((end - first) // LINE + 2):
            row = min(first + k * LINE, end)
            fetch(&self.ra[row])
            fetch(&self.dec[row])
            fetch(&self.vmag[row])
            if date.moved:
                fetch(&self.pm_ra[row])
                fetch(&self.pm_dec[row])

    cdef int _inside(self, const int *runs, int count, const Patch *patch, int *flags, int *near) noexcept nogil:
        """Write the rows of runs that lie in a patch to `near`; how many: cells reach beyond it.  flags: to work in."""
        cdef int i, k, first, n, kept = 0
        for i in range(count):
            first, n = runs[2 * i], runs[2 * i + 1] - runs[2 * i]
            _marked(&self.ra[first], &self.dec[first], n, patch, flags)
            for k in range(n):
                near[kept] = first + k
                kept += flags[k]
        return kept

    cdef int _by_light(self, const int *rows, int n, int cut, int *bins, int *near) noexcept nogil:
        """Write rows (n,) to `near`, brightest first, about `cut` of them; how many.  bins (n,): to work in."""
        cdef int[BINS] first
        cdef int k, bin, total = 0, kept = 0, low = BINS - 1, high = 0
        for k in range(n):
            bins[k] = _light(self.vmag[rows[k]])
            low, high = min(low, bins[k]), max(high, bins[k])
        for bin in range(low, high + 1):
            first[bin] = 0
        for k in range(n):
            first[bins[k]] += 1
        # how many are brighter; stars that come after `cut` others do not count
        for bin in range(low, high + 1):
            kept = kept if total >= cut else total + first[bin]
            first[bin], total = total, total + first[bin]
        for k in range(n):
            near[first[bins[k]]] = rows[k]
            first[bins[k]] += 1
        return kept

    cdef int _projected(
        self, const int *near, int n, FrameStars frame, bint mirrored, const double *attitude, double focal_px,
        double margin_px, const Date *date, int most, Visible *out, Point *pixel,
    ) noexcept nogil:
        """Keep of the rows `near` (n,) those on the frame, with their directions and pixels, at most so many."""
        cdef int k, kept = 0
        cdef double[3] u
        cdef double[2] at
        for k in range(n):
            if kept == most:
                break
            self.direction(near[k], date, &out.w[3 * kept])
            turned(attitude, &out.w[3 * kept], u)
            out.row[kept] = near[k]
            pixel_of(u, focal_px, at)
            pixel[kept].x, pixel[kept].y, pixel[kept].row = at[0], at[1], kept
            # no jump, which no processor could guess: it works on the next stars meanwhile
            kept += seen_on(frame, mirrored, u, focal_px, margin_px)
        out.count = kept
        return kept

    cdef int _unblended(
        self, Point *pixel, double blend_px, double focal_px, Visible *out, int *single
    ) noexcept nogil:
        """Leave those out that make one image with a brighter star, which they move; how many stay."""
        cdef int i, j, a, b, n = out.count, kept = 0
        cdef double apart, ratio
        cdef Strips strips
        cdef const double *one
        cdef const double *other
        for i in range(n):
            out.moved[i], single[i] = 0.0, 1
        sort_by_x(pixel, n, pixel + n, &strips)
        for i in range(n):
            for j in range(i + 1, n):
                if pixel[j].x - pixel[i].x >= blend_px:
                    break
                if (pixel[j].x - pixel[i].x) ** 2 + (pixel[j].y - pixel[i].y) ** 2 >= blend_px * blend_px:
                    continue
                a, b = min(pixel[i].row, pixel[j].row), max(pixel[i].row, pixel[j].row)
                one, other = &out.w[3 * a], &out.w[3 * b]
                ratio = pow(10, -0.004 * (self.vmag[out.row[b]] - self.vmag[out.row[a]]))
                apart = sqrt((other[0] - one[0]) ** 2 + (other[1] - one[1]) ** 2 + (other[2] - one[2]) ** 2)
                # from directions and rounded, so that it does not depend on the pose
                apart = rint(focal_px * apart * 1e6) / 1e6
                out.moved[a] += apart * ratio / (1 + ratio)
                single[b] = 0
        for i in range(n):
            if kept < i and single[i]:
                out.row[kept], out.moved[kept] = out.row[i], out.moved[i]
                for j in range(3):
                    out.w[3 * kept + j] = out.w[3 * i + j]
            kept += single[i]
        out.count = kept
        return kept


cdef inline int _light(short vmag) noexcept nogil:
    """The bin of a brightness."""
    return max(0, min(vmag - BRIGHTEST, BINS - 1))


cdef Date date_of(double years, velocity) except *:
    """The date `years` after J2000, with the Earth's velocity (3,) in units of c."""
    cdef Date date
    date.years = years
    date.velocity[0], date.velocity[1], date.velocity[2] = velocity
    date.moved = years != 0 or date.velocity[0] != 0 or date.velocity[1] != 0 or date.velocity[2] != 0
    return date


cdef void _flatten(
    FrameStars frame, bint mirrored, const double *attitude, double focal, const double *axis, double margin_px, Patch *out
) noexcept nogil:
    """Set the patch of a frame in a pose about the direction `axis` (3,), of any length, of its middle.

    Lines of right ascension and declination are taken to be straight there. How much they bend is a margin, which grows
    with the square of the frame's radius; where it is a large share of that, near a pole or in a wide field, all is in.
    """
    cdef double flat = hypot(axis[0], axis[1]), norm = hypot(flat, axis[2]), radius = frame.radius
    cdef double ra = atan2(axis[1], axis[0]), dec = atan2(axis[2], flat), steep, slant, bend, ahead, off
    cdef double[3] east
    cdef double[3] north
    cdef double[3] slope
    cdef int i, k
    out.ra, out.dec = <int>(ra / MAS), <int>(dec / MAS)
    out.ra += CIRCLE if out.ra < 0 else 0
    for i in range(2):
        out.by_ra[i], out.by_dec[i], out.reach[i] = 0.0, 0.0, 1.0
    # of the frame's middle and C's axis z
    ahead = (attitude[6] * axis[0] + attitude[7] * axis[1] + attitude[8] * axis[2]) / norm
    if fabs(dec) + radius > M_PI / 2 - 0.01 or ahead < 0.1:
        return
    steep, slant = tan(fabs(dec) + radius), sqrt(max(1 - ahead * ahead, 0.0)) / ahead
    bend = radius * radius * (steep + 2 * slant + 2 * radius * (1 + steep * steep))
    if bend > MAX_CURVED * radius:
        return
    bend += MOVED * MAS
    east[0], east[1], east[2] = -axis[1] / norm, axis[0] / norm, 0.0
    north[0], north[1], north[2] = -axis[2] * axis[0] / (flat * norm), -axis[2] * axis[1] / (flat * norm), flat / norm
    for i in range(2):
        for k in range(3):
            slope[k] = (attitude[3 * i + k] * focal - frame.centre[mirrored][i] * attitude[6 + k]) / ahead * MAS
        # `east` is as long as a parallel is, for a unit of right ascension
        out.by_ra[i] = <float>(slope[0] * east[0] + slope[1] * east[1] + slope[2] * east[2])
        out.by_dec[i] = <float>(slope[0] * north[0] + slope[1] * north[1] + slope[2] * north[2])
        # the middle is that of the frame's own focal length
        off = fabs(frame.centre[mirrored][i] * (focal / frame.focal_px - 1))
        out.reach[i] = <float>(frame.reach[i] + margin_px + off + bend * focal / (ahead * ahead))


cdef void _marked(const unsigned int *ra, const int *dec, int n, const Patch *patch, int *flags) noexcept nogil:
    """Set flags (n,) to 1 for places (mas) in a patch, to 0 for others: several at once, where the processor can."""
    cdef int k, east
    cdef float x, y
    for k in range(n):
        east = <int>ra[k] - patch.ra
        east -= CIRCLE if east > CIRCLE // 2 else 0
        east += CIRCLE if east < -(CIRCLE // 2) else 0
        x = patch.by_ra[0] * east + patch.by_dec[0] * (dec[k] - patch.dec)
        y = patch.by_ra[1] * east + patch.by_dec[1] * (dec[k] - patch.dec)
        flags[k] = (fabsf(x) < patch.reach[0]) & (fabsf(y) < patch.reach[1])


cdef int runs_near(const int *cell_start, const double *axis, double radius, int *runs) noexcept nogil:
    """Write the first rows and the ends of all runs of cells that a cone about a vector (3,) touches; how many.

    As `starpos.sky.catalogue.rows_near` does.
    """
    cdef double flat = hypot(axis[0], axis[1]), ra = atan2(axis[1], axis[0]) * 180 / M_PI, dec = atan2(axis[2], flat)
    cdef double wide = 180.0
    cdef int low, high, first, width, zone, count = 0
    if fabs(dec) + radius < M_PI / 2 - 1e-9:
        wide = asin(min(sin(radius) / cos(dec), 1.0)) * 180 / M_PI
    low = max(<int>((dec - radius) * 180 / M_PI + 90), 0)
    high = min(<int>((dec + radius) * 180 / M_PI + 90), ZONES - 1)
    first = <int>floor(ra - wide)
    width = min(<int>floor(ra + wide) - first + 1, CELLS)
    first = (first + 2 * CELLS) % CELLS
    for zone in range(low, high + 1):
        runs[2 * count] = cell_start[zone * CELLS + first]
        runs[2 * count + 1] = cell_start[zone * CELLS + min(first + width, CELLS)]
        count += 1
        # a run that passes 360 deg continues at 0
        if first + width > CELLS:
            runs[2 * count] = cell_start[zone * CELLS]
            runs[2 * count + 1] = cell_start[zone * CELLS + first + width - CELLS]
            count += 1
    return count
