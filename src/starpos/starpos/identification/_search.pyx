# SPDX-License-Identifier: Apache-2.0
# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The search for a frame's place in the sky: poses of triangles, stage by stage, and the judgement of each pose."""

from libc.math cimport INFINITY, M_PI, fabs, log
from libc.stdlib cimport free, malloc
from libc.string cimport memcpy

import numpy as np

from starpos._numeric.memory cimport numbers_of, room_for, start_of
from starpos.identification._found cimport Identification, hold
from starpos.identification._frame cimport FrameStars, on_frame, pixels_of
from starpos.identification._matching cimport Matching, begin
from starpos.identification._poses cimport Chances, Rules, Settled, count_alike, gates, settle, weighed
from starpos.identification._screen cimport BrightTable
from starpos.identification._sky cimport Date, StarTable, Visible, date_of
from starpos.identification._triangles cimport Candidate, TriangleTable


cdef enum:
    MAX_STAGES = 8
    LOOKS = 3


cdef struct Work:
    # The catalogue's stars on a frame, their pixels (S, 2) and room to work in, and the pose on which they have settled.
    Visible stars
    Matching m
    Settled end
    double *memory


cdef class Anywhere:
    """The logarithm of the density of poses of a frame lost in space, as `evidence.Prior` has it.

    focal_px   about the focal length
    scales     ((limit, probability), (limit, probability)): on the error of its logarithm
    mirrored   probability that a frame is
    log_share  of the probability of all poses
    """

    cdef double focal, mirrored, log_share
    cdef double[2] limit
    cdef double[2] share

    def __init__(self, double focal_px, scales, double mirrored, double log_share):
        self.focal, self.mirrored, self.log_share = focal_px, mirrored, log_share
        (self.limit[0], self.share[0]), (self.limit[1], self.share[1]) = scales

    def __call__(self, pose):
        return self.at(pose.focal_px, pose.mirrored)

    cdef double at(self, double focal, bint mirrored) noexcept:
        """The logarithm at a focal length; rotations have a volume of 8 pi2."""
        cdef double off = fabs(log(focal / self.focal)), density = 0.0
        cdef int k
        for k in range(2):
            if off < self.limit[k]:
                density += self.share[k] / (2 * self.limit[k])
        if density == 0:
            return -INFINITY
        return self.log_share + log((self.mirrored if mirrored else 1 - self.mirrored) * density / (8 * M_PI * M_PI))


cdef struct Limits:
    # number of the brightest stars whose triangles each of the first looks tries
    int[LOOKS] first_stars
    # maximum distance of a star from its place, in sigma
    double match_sigma
    # logarithm of the share of detections that may be false
    double log_false
    # minimum log-odds of a candidate that is fitted
    double worth_a_fit
    # errors of the centroids, px, above which a candidate counts only if another one supports it
    double loose_px
    # maximum number of the brightest catalogue stars by which a pose is judged
    int most_stars
    # maximum number of candidates that chance alone makes in a look-up, and of those that are looked at
    double most_candidates
    int most_looked_at
    # in a crowd of false stars: usual number of triangles that are looked up, and the two maxima above
    int most_looked_up
    double most_in_crowd
    int most_supported


cdef class Finder:
    """Tables and rules by which poses of frames are judged, and found where they are lost in space.

    rules, chances, limits  mappings of what the structures of that name hold
    """

    cdef StarTable stars
    cdef TriangleTable triangles
    cdef BrightTable bright
    cdef Rules rules
    cdef Chances chances
    cdef Limits limits

    def __init__(self, StarTable stars, TriangleTable triangles, BrightTable bright, rules, chances, limits):
        self.stars, self.triangles, self.bright = stars, triangles, bright
        self.rules, self.chances, self.limits = rules, chances, limits

    def judge(self, FrameStars frame, double years, velocity, prior, double enough):
        """A Judge of poses of a frame.

        years, velocity  of the date: Julian years after J2000, and (3,) in units of c
        prior            as `evidence.Prior` has it
        enough           log-odds of an identification
        """
        cdef Judge out = Judge.__new__(Judge)
        out.finder, out.frame, out.date, out.enough = self, frame, date_of(years, velocity), enough
        log_density = prior.log_density
        if isinstance(log_density, Anywhere):
            out.anywhere = log_density
        else:
            out.log_density = prior.log_density_at
        memcpy(out.width, numbers_of(prior.width, 4 * sizeof(double)), 4 * sizeof(double))
        return out

    def lost(self, FrameStars frame, double years, velocity, prior, double enough, stages, bint crowded):
        """An iterator over what is identified, as a `judge` with the same arguments has it; stages, crowded: see `Lost`."""
        cdef Lost out = Lost.__new__(Lost)
        out._take(self.judge(frame, years, velocity, prior, enough), stages, crowded)
        return out


cdef class Judge:
    """Judges poses of a frame by the evidence of its stars."""

    cdef Finder finder
    cdef FrameStars frame
    cdef Date date
    cdef double[4] width
    # one of them is None
    cdef Anywhere anywhere
    cdef object log_density
    cdef double enough

    def identified(self, const double[:, ::1] attitude, double focal_px, bint mirrored, const double[::1] radius_px):
        """What is identified by a pose near the right one.

        mirrored   whether the frame's rows are flipped
        radius_px  (n,): how far from their places those of the frame's stars may be that decide

        None where the evidence is not enough.
        """
        if radius_px.shape[0] < self._deciding():
            raise ValueError(f"{radius_px.shape[0]} radii for {self._deciding()} stars: each one that decides needs its own")
        return self.judged(&attitude[0, 0], focal_px, mirrored, &radius_px[0])

    cdef int _deciding(self):
        """How many of the frame's stars decide."""
        return min(self.frame.count, self.frame.tested)

    cdef judged(self, const double *attitude, double focal, bint mirrored, const double *radius):
        """What `identified` returns."""
        cdef Work work
        cdef int n = self._deciding(), most = min(self.frame.count, self.finder.rules.most_stars)
        cdef double log_odds
        memcpy(work.end.attitude, attitude, 9 * sizeof(double))
        work.end.focal, work.stars.memory, work.m.memory, work.memory = focal, NULL, NULL, NULL
        try:
            if not self._settled(mirrored, n, radius, &work):
                return None
            log_odds = weighed(
                pixels_of(self.frame, mirrored), self.frame.error, n, self.frame.area_px2, work.end.attitude, work.end.focal,
                self.width, work.end.star, work.end.near, work.stars.w, work.end.near, work.end.count,
                &self.finder.chances,
            )
            if self.anywhere is not None:
                log_odds += self.anywhere.at(work.end.focal, mirrored)
            else:
                log_odds += self.log_density(_attitude(&work.end), work.end.focal, mirrored)
            # true for NaN too
            if not log_odds >= self.enough:
                return None
            if self.frame.count > n and not self._settled(mirrored, most, NULL, &work):
                return None
            if work.end.spread > self.finder.rules.bent_px:
                count_alike(
                    self.frame, mirrored, &work.stars, &self.finder.rules, work.memory, work.memory + 2 * work.stars.count,
                    &work.end,
                )
            return self._found(mirrored, &work, log_odds)
        finally:
            _release(&work)

    cdef bint _settled(self, bint mirrored, int n, const double *radius, Work *work) except -1:
        """Settle on pairs of the frame's n brightest stars, from the pose in `work`; whether there are enough.

        radius (n,): how far from their places they may be; NULL: as the spread of the residuals allows.
        """
        cdef const Rules *rules = &self.finder.rules
        cdef int most = rules.per_detection * n + rules.more_stars, pairs
        cdef double *room
        _release(work)
        self.finder.stars.find(
            self.frame, mirrored, work.end.attitude, work.end.focal, &self.date, rules.edge_px, most, rules.blend_px,
            &work.stars,
        )
        pairs = min(n, work.stars.count)
        if pairs < rules.fewest_stars:
            return False
        begin(&work.m, n, work.stars.count)
        work.memory = <double *>malloc((2 * work.stars.count + 4 * pairs + n) * sizeof(double) + 2 * pairs * sizeof(Py_ssize_t))
        if work.memory == NULL:
            raise MemoryError
        room = work.memory + 2 * work.stars.count + 4 * pairs
        work.end.star = <Py_ssize_t *>(room + n)
        work.end.near = work.end.star + pairs
        if radius != NULL:
            memcpy(room, radius, n * sizeof(double))
        else:
            gates(self.frame, rules, work.end.spread, n, room)
        settle(
            self.frame, mirrored, n, &work.stars, rules, room, &work.m, work.memory,
            work.memory + 2 * work.stars.count, &work.end,
        )
        return work.end.count >= rules.fewest_stars

    cdef Identification _found(self, bint mirrored, const Work *work, double log_odds):
        """What `identified` returns."""
        cdef Identification out = Identification.__new__(Identification)
        cdef const Settled *end = &work.end
        cdef int k, n = end.count, last = 2 * n
        hold(out, n, np.empty(2 * n + work.stars.count, np.intp), np.empty(9 + n))
        memcpy(out.turn, end.attitude, 9 * sizeof(double))
        for k in range(n):
            out.row[k], out.row[n + k] = end.star[k], work.stars.row[end.near[k]]
            out.turn[9 + k] = work.stars.moved[end.near[k]]
        for k in range(work.stars.count):
            if on_frame(self.frame, mirrored, &work.memory[2 * k], -self.finder.rules.inside_px):
                out.row[last] = work.stars.row[k]
                last += 1
        out.due = last - 2 * n
        out.focal_scale, out.log_odds, out.mirrored = end.focal / self.frame.focal_px, log_odds, mirrored
        out.residual_px, out.mean_square_px2 = end.rms, end.mean_square
        return out


cdef _attitude(const Settled *end):
    """The attitude as an array (3, 3)."""
    out = np.empty((3, 3))
    cdef double[:, ::1] attitude = out
    memcpy(&attitude[0, 0], end.attitude, 9 * sizeof(double))
    return out


cdef void _release(Work *work) noexcept:
    """Free what `work` holds."""
    free(work.stars.memory)
    free(work.m.memory)
    free(work.memory)
    work.stars.memory, work.m.memory, work.memory = NULL, NULL, NULL


cdef class Lost:
    """An iterator over what is identified of a frame lost in space, as `Finder.lost` makes it.

    stages   (number of brightest stars, their error in px), at most MAX_STAGES: triangles of these are looked up, none
             twice with one error. Before the first stage come looks at few stars: of each the best candidate that others
             support is judged, which mostly is right
    crowded  most of the brightest stars may be false: only candidates that two others support are judged, all of them;
             else the best candidate is judged, and of the others those that are worth a fit
    """

    cdef Judge judge
    # the stages as they are given, and as numbers once the looks have failed
    cdef object plan
    cdef int[MAX_STAGES] stars
    cdef double[MAX_STAGES] stage_px
    cdef int stages, stage, looks
    cdef bint crowded, ranked
    cdef double error_px
    # Candidates of a stage; their order, where in it the search is, and its end; radii (px) of the stars that decide.
    cdef Candidate *found
    cdef int *order
    cdef double *radius
    cdef bytearray room
    cdef int count, at

    cdef int _take(self, Judge judge, stages, bint crowded) except -1:
        """Take what a new one searches by."""
        cdef int most = max(judge.finder.limits.most_looked_at, judge.finder.limits.most_supported) + 1
        self.judge, self.crowded, self.looks, self.stages = judge, crowded, LOOKS if crowded else 0, len(stages)
        if not 0 < self.stages <= MAX_STAGES:
            raise ValueError(f"{self.stages} stages of a search: 1 to {MAX_STAGES} are possible")
        self.plan = stages
        _, self.error_px = stages[0]
        self.room = room_for(most * (sizeof(Candidate) + sizeof(int)) + judge._deciding() * sizeof(double))
        self.found = <Candidate *>start_of(self.room)
        self.radius = <double *>(self.found + most)
        self.order = <int *>(self.radius + judge._deciding())
        return 0

    def __iter__(self):
        return self

    def __next__(self):
        cdef double[9] attitude
        cdef double focal
        cdef const Candidate *c
        while True:
            if self.at == 1 and not self.ranked:
                self._rank()
            if self.at == self.count and self.looks < LOOKS:
                self._look_first()
                continue
            if self.at == self.count:
                if self.stage == self.stages:
                    raise StopIteration
                self._look_up()
                continue
            c = &self.found[self.order[self.at]]
            self.at += 1
            self._pose(c, attitude, &focal)
            identified = self.judge.judged(attitude, focal, c.mirrored, self.radius)
            if identified is not None:
                return identified

    cdef int _look_first(self) except -1:
        """Take the best candidate of the next few stars, if others support it and it was not that of the look before."""
        cdef const Limits *limits = &self.judge.finder.limits
        cdef int stars = min(limits.first_stars[self.looks], self.judge.frame.count)
        cdef Candidate before = self.found[0]
        cdef bint any_before = self.count > 0
        self.count = self.judge.finder.triangles.best(
            self.judge.frame, 0, stars, self.error_px, limits.most_candidates, 1, True, self.found
        )
        self.at = self.count if any_before and self.count > 0 and _same(&before, &self.found[0]) else 0
        self.looks, self.ranked, self.order[0] = self.looks + 1, True, 0
        return 0

    cdef int _look_up(self) except -1:
        """Take the candidates of the next stage."""
        cdef FrameStars frame = self.judge.frame
        cdef const Limits *limits = &self.judge.finder.limits
        cdef TriangleTable table = self.judge.finder.triangles
        cdef double error_px
        cdef int k, done = 0, stars
        if self.stage == 0:
            for k in range(self.stages):
                self.stars[k], self.stage_px[k] = self.plan[k]
        error_px, stars = self.stage_px[self.stage], min(self.stars[self.stage], frame.count)
        if self.crowded:
            self.count = table.supported(
                frame, stars, error_px, limits.most_looked_up, limits.most_in_crowd, limits.most_supported, self.found
            )
        else:
            for k in range(self.stage):
                if self.stage_px[k] == error_px:
                    done = min(self.stars[k], frame.count)
            self.count = table.best(
                frame, done, stars, error_px, limits.most_candidates, limits.most_looked_at, error_px > limits.loose_px,
                self.found,
            )
        self.stage += 1
        self.error_px, self.at, self.ranked = error_px, 0, self.crowded
        for k in range(self.count):
            self.order[k] = k
        return 0

    cdef void _pose(self, const Candidate *c, double *attitude, double *focal) noexcept:
        """Set the pose of a candidate, and the radii of the stars that decide."""
        self.judge.finder.bright.pose(
            self.judge.frame, c, &self.judge.date, self.error_px, self.judge.finder.limits.match_sigma, self.judge._deciding(),
            attitude, focal, self.radius,
        )

    cdef int _rank(self) except -1:
        """Keep of the candidates behind the first, which mostly is right, those that are worth a fit, best first."""
        cdef double[9] attitude
        cdef double focal, worth
        cdef const Limits *limits = &self.judge.finder.limits
        room = room_for(self.count * sizeof(double))
        cdef double *kept = <double *>start_of(room)
        cdef int k, j, end = 1
        self.ranked = True
        for k in range(1, self.count):
            self._pose(&self.found[k], attitude, &focal)
            worth = self.judge.finder.bright.worth(
                self.judge.frame, &self.found[k], &self.judge.date, attitude, focal, self.judge._deciding(), self.radius,
                limits.most_stars, limits.match_sigma, limits.log_false,
            )
            if not worth > limits.worth_a_fit:
                continue
            j = end
            while j > 1 and worth > kept[j - 1]:
                kept[j], self.order[j] = kept[j - 1], self.order[j - 1]
                j -= 1
            kept[j], self.order[j] = worth, k
            end += 1
        self.count = end
        return 0


cdef bint _same(const Candidate *one, const Candidate *other) noexcept:
    """Whether two candidates bring the same stars to the same detections, in whatever order."""
    cdef int i, j, pairs = 0
    for i in range(3):
        for j in range(3):
            pairs += one.star[i] == other.star[j] and one.corner[i] == other.corner[j]
    return pairs == 3 and one.mirrored == other.mirrored
