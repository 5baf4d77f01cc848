# SPDX-License-Identifier: Apache-2.0
from starpos._numeric.algebra cimport Point
from starpos.identification._frame cimport FrameStars


cdef enum:
    ZONES = 180
    CELLS = 360
    # Of rows: two in each zone.
    MAX_RUNS = 360


cdef struct Date:
    double years
    double[3] velocity
    bint moved


cdef struct Visible:
    # Stars on a frame, brightest first: rows, directions (count, 3), and how far (px) fainter ones move their images.
    int count
    Py_ssize_t *row
    double *w
    double *moved
    void *memory


cdef struct Patch:
    # A frame on the sky as a plane. Mas: its middle. Across and down: px a mas of right ascension and of declination, and
    # how far (px) stars may be from the middle.
    int ra
    int dec
    float[2] by_ra
    float[2] by_dec
    float[2] reach


cdef class StarTable:
    cdef const unsigned int[::1] ra
    cdef const int[::1] dec
    cdef const short[::1] pm_ra
    cdef const short[::1] pm_dec
    cdef const short[::1] vmag
    cdef const int[::1] cell_start

    cdef void direction(self, Py_ssize_t row, const Date *date, double *w) noexcept nogil
    cdef int find(
        self, FrameStars frame, bint mirrored, const double *attitude, double focal_px, const Date *date,
        double margin_px, int most, double blend_px, Visible *out,
    ) except -1 nogil
    cdef void ask(self, int first, int end, const Date *date) noexcept nogil
    cdef int _inside(self, const int *runs, int count, const Patch *patch, int *flags, int *near) noexcept nogil
    cdef int _by_light(self, const int *rows, int n, int cut, int *bins, int *near) noexcept nogil
    cdef int _projected(
        self, const int *near, int n, FrameStars frame, bint mirrored, const double *attitude, double focal_px,
        double margin_px, const Date *date, int most, Visible *out, Point *pixel,
    ) noexcept nogil
    cdef int _unblended(
        self, Point *pixel, double blend_px, double focal_px, Visible *out, int *single
    ) noexcept nogil


cdef Date date_of(double years, velocity) except *
cdef int runs_near(const int *cell_start, const double *axis, double radius, int *runs) noexcept nogil
