# SPDX-License-Identifier: Apache-2.0
"""Which catalogue star is which: lost in space, from a frame's brightest stars.

Triangles of the brightest stars are looked up by their angles; candidates that share a side support each other (the
paper's search); each is then held against the whole field by log-odds, so that a match is accepted by its probability
and never by a count, and fitted by least squares to the faintest stars seen.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from starpos import rotation
from starpos.camera import Camera
from starpos.catalogue import Catalogue
from starpos.triangles import TriangleCatalogue, angles, sides

ACCEPT_LOG_ODDS = np.log(1e9)  # a wrong match among all hypotheses of a frame at most once in 1e9
WORTH_A_FIT = 3.0  # log-odds of a raw triangle below which it is not looked at again
FALSE_FRACTION = 0.35  # of the detections that may be no catalogue star
EXPECTED_RANK = (10, 2)  # a + b n: how deep among the catalogue stars the n-th brightest detection may be
TEST_STARS = 50  # the brightest of a frame, which decide
FAINTEST_FIT = 2000  # stars that take part in the last fit
SCALE_TOLERANCE = 0.03  # of the focal length
# (brightest stars, their error in px): the second kind is for lenses that distort
STAGES = ((5, 0.3), (7, 0.3), (10, 0.3), (14, 0.3), (20, 0.3), (9, 2.5), (8, 6.0))
LOOSE_PX = 1.0  # above it a candidate must be supported by another
SMALLER_PX = (0.7, 1.5)
CHOICE = np.log(1 + len(SMALLER_PX))
TRIANGLE_SIGMA = 3.0
MATCH_SIGMA = 3.5
FEWEST_STARS = 4
SMALL_TABLE = 20_000  # detections times catalogue stars
BLEND_PX = 2.5  # closer stars make one image
MAX_VERIFIED = 25  # candidates a stage


@dataclass(frozen=True)
class Identification:
    """Matched stars and the attitude they give.

    star (M,): rows of the input; catalogue (M,): indices of the star catalogue; attitude (3, 3): `Sky`'s directions
    into C; blend_px (M,): how far unresolved neighbours may draw each star's image; focal_scale: factor on the camera's
    focal length; residual_px: rms of one axis; log_odds: of the match against chance; mirrored: the frame's rows run
    bottom-up, all of this holds for the frame flipped.
    """

    star: np.ndarray
    catalogue: np.ndarray
    blend_px: np.ndarray
    attitude: np.ndarray
    focal_scale: float
    residual_px: float
    log_odds: float
    mirrored: bool


@dataclass(frozen=True)
class Sky:
    """The catalogue as it looks at a date: proper motion to `year`, aberration by `velocity` (3,) in units of c."""

    catalogue: Catalogue
    triangles: TriangleCatalogue
    year: float = 2000.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def directions(self, index: np.ndarray) -> np.ndarray:
        """Unit vectors (n, 3)."""
        v = self.catalogue.directions(index, self.year) + np.asarray(self.velocity)
        return v / np.sqrt(np.einsum("ni,ni->n", v, v))[:, None]

    def unaberrated(self, v: np.ndarray) -> np.ndarray:
        """ICRS direction (3,) of one seen at v (3,)."""
        v = v - np.asarray(self.velocity)
        return v / np.linalg.norm(v)


def identify(xy: np.ndarray, sigma_px: np.ndarray, camera: Camera, sky: Sky) -> Identification | None:
    """Identify stars at pixels xy (N, 2), brightest first, of an ideal camera (distortion and refraction taken off).

    sigma_px (N,): their errors, one axis.  The focal length may be off by SCALE_TOLERANCE.  None: no part of the sky
    is these stars beyond doubt.
    """
    if len(xy) < FEWEST_STARS:
        return None
    search = _Search(xy, sigma_px, camera, sky)
    for stars, error_px in STAGES:
        for triangle in search.candidates(min(stars, len(xy)), error_px):
            match = search.verify(triangle, error_px)
            if match.log_odds > ACCEPT_LOG_ODDS + np.log(search.tried):
                return search.finish(match)
    return None


@dataclass(frozen=True)
class _Pose:
    """A pinhole camera among the stars: attitude (3, 3), Sky into C; focal length in px; rows bottom-up or not."""

    attitude: np.ndarray
    focal_px: float
    mirrored: bool


@dataclass(frozen=True)
class _Match:
    pose: _Pose
    log_odds: float
    star: np.ndarray
    catalogue: np.ndarray
    directions: np.ndarray


@dataclass(frozen=True)
class _Triangle:
    """Three stars (rows of the frame's) as three catalogue stars (rows of the triangle catalogue's)."""

    star: np.ndarray
    corner: np.ndarray
    mirrored: bool


@lru_cache(maxsize=32)
def _triples(n: int) -> np.ndarray:
    """All triples of 0..n-1 (T, 3), those of the brightest stars first."""
    t = np.array(list(combinations(range(n), 3)), int).reshape(-1, 3)
    return t[np.lexsort((t.sum(1), t.max(1)))]


class _Search:
    """One frame's search: pixels from the principal point, and what was looked at already."""

    def __init__(self, xy: np.ndarray, sigma_px: np.ndarray, camera: Camera, sky: Sky):
        self.camera, self.sky, self.sigma = camera, sky, sigma_px
        centre = np.array([camera.cx, camera.cy])
        self.xy = xy - centre
        flipped = np.stack([xy[:, 0], camera.height - 1 - xy[:, 1]], -1) - centre
        self.both = {False: self.xy, True: flipped}
        self.middle = np.array(camera.centre_px) - centre
        self.v = _directions(self.xy, camera.fx)
        self.log_area = np.log(camera.width * camera.height)
        self.tried = 1
        self._done: dict[float, int] = {}

    def candidates(self, stars: int, error_px: float):
        """Catalogue triangles for those of the `stars` brightest not yet tried at this error, best supported first."""
        done = self._done.get(error_px, 0)
        triples = _triples(stars)[done:]
        self._done[error_px] = done + len(triples)
        error = np.hypot(error_px, self.sigma[triples].max(1)) / self.camera.fx
        seen = _Seen.of(self.v, triples, error)
        if not len(seen.star):
            return
        tri = self.sky.triangles
        query, found = tri.near(seen.largest, seen.smallest, seen.tol_largest, seen.tol_smallest)
        size = np.log(tri.longest[found] / seen.longest[query])
        fits = np.abs(size) < SCALE_TOLERANCE + seen.error[query] / seen.longest[query]
        size, star, corner = size[fits], seen.star[query[fits]], tri.corners[found[fits]]
        self.tried += len(star)
        if not len(star):
            return
        mirrored = _handedness(tri.directions[corner]) != _handedness(self.v[star])
        support = _shared_sides(star, corner, mirrored)
        order = np.lexsort((np.abs(size), -support))
        if error_px > LOOSE_PX:
            order = order[support[order] > 0]
        for k in order[:MAX_VERIFIED].tolist():
            yield _Triangle(star[k], corner[k], bool(mirrored[k]))

    def verify(self, t: _Triangle, error_px: float) -> _Match:
        """Log-odds of a triangle over the frame's other bright stars; a promising one is fitted to its matches first."""
        pose = self._pose_of(t)
        xy = self.both[t.mirrored][:TEST_STARS]
        sigma = np.hypot(self.sigma[: len(xy)], error_px)
        tri = self.sky.triangles
        rows = tri.cone(*self._cone(pose))[: 4 * len(xy) + 30]
        index, w = self._on_frame(pose, tri.star[rows], 2 * len(xy) + 10)
        # a triangle's error grows with the distance from it
        corners = xy[t.star]
        middle = corners.mean(0)
        size2 = max(np.square(corners - middle).sum() / 3, 1.0)
        grown = sigma * np.sqrt(1 + np.square(xy - middle).sum(1) / size2)
        own = np.zeros(len(xy), bool)
        own[t.star] = True
        log_odds, hit, nearest = self._log_odds(xy, w, pose, grown, own)
        if log_odds > WORTH_A_FIT:
            pose = _fit(xy[hit], w[nearest[hit]], pose)
            log_odds, hit, nearest = self._log_odds(xy, w, pose, sigma, own)
            # a looser error than the fit needs hides what the match is worth; to choose among errors costs their number
            for smaller in (e for e in SMALLER_PX if e < error_px):
                tighter = self._log_odds(xy, w, pose, np.hypot(self.sigma[: len(xy)], smaller), own)
                if tighter[0] - CHOICE > log_odds:
                    log_odds, hit, nearest = tighter[0] - CHOICE, *tighter[1:]
        return _Match(pose, log_odds, np.flatnonzero(hit), index[nearest[hit]], w[nearest[hit]])

    def _log_odds(self, xy, w, pose: _Pose, sigma, own):
        """Log-odds of the stars that are not `own` (n,), which of all agree, and the catalogue star nearest to each."""
        none = np.zeros(len(xy), bool)
        if not len(w):
            return float("-inf"), none, np.zeros(len(xy), int)
        predicted = _project(w, pose)
        apart2 = np.square(xy[:, 0, None] - predicted[:, 0]) + np.square(xy[:, 1, None] - predicted[:, 1])
        nearest = apart2.argmin(1)
        distance2 = apart2[np.arange(len(xy)), nearest]
        variance = sigma * sigma
        # one catalogue star answers one detection: the one nearest to it
        hit = (distance2 < MATCH_SIGMA**2 * variance) & (apart2.argmin(0)[nearest] == np.arange(len(xy)))
        # the n-th brightest detection is expected among the brightest catalogue stars
        expected = np.minimum(EXPECTED_RANK[0] + EXPECTED_RANK[1] * np.arange(len(xy)), len(w))
        chance = np.log((1 - FALSE_FRACTION) / expected / (2 * np.pi * variance)) + self.log_area
        likely = np.where(hit & (nearest < expected), np.exp(chance - 0.5 * distance2 / variance), 0.0)
        odds = np.log(FALSE_FRACTION + likely)
        # the best from the brightest down to any: under chance a likelihood ratio seldom rises high (Ville's inequality)
        return float(np.cumsum(np.where(own, 0.0, odds)).max()), hit, nearest

    def _pose_of(self, t: _Triangle) -> _Pose:
        """The focal length that gives the triangle its size, and the rotation that brings it into place."""
        xy = self.both[t.mirrored][t.star]
        w = self.sky.directions(self.sky.triangles.star[t.corner])
        wanted = _perimeter(w)
        focal = self.camera.fx
        for _ in range(2):
            v = _directions(xy, focal)
            focal *= _perimeter(v) / wanted
        return _Pose(rotation.best_rotation(w, _directions(xy, focal)), float(focal), t.mirrored)

    def _cone(self, pose: _Pose) -> tuple[np.ndarray, float]:
        """Centre and radius of a cone that holds the frame."""
        centre = _directions(self.middle[None], pose.focal_px)[0] @ pose.attitude
        half = np.arctan(0.5 * np.hypot(self.camera.width, self.camera.height) / pose.focal_px)
        return centre, half * 1.02 + 2e-4

    def _on_frame(self, pose: _Pose, index: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Those of the catalogue's stars `index` that fall on the frame: the first `most`, and their directions."""
        w = self.sky.directions(index)
        apart = np.abs(_project(w, pose) - self.middle)
        half = np.array([self.camera.width, self.camera.height]) / 2 + 2
        on = np.flatnonzero((apart < half).all(1))[:most]
        return index[on], w[on]

    def finish(self, match: _Match) -> Identification:
        """The accepted match carried to the faintest stars: all detections against all catalogue stars of the field."""
        xy, pose = self.both[match.pose.mirrored][:FAINTEST_FIT], match.pose
        sigma = self.sigma[: len(xy)]
        index, w = self._on_frame(
            pose, self.sky.catalogue.cone(*self._cone(pose))[: 6 * len(xy) + 100], 3 * len(xy) + 50
        )
        index, w, blend = self._resolved(pose, index, w)
        residual = xy[match.star] - _project(match.directions, pose)
        for _ in range(2):
            spread = np.clip(1.4826 * np.median(np.abs(residual)), 0.02, None)
            star, near = _mutual_nearest(xy, _project(w, pose), 4 * np.hypot(spread, sigma) + 0.2)
            pose = _fit(xy[star], w[near], pose)
            residual = xy[star] - _project(w[near], pose)
        return Identification(
            star,
            index[near],
            blend[near],
            pose.attitude,
            pose.focal_px / self.camera.fx,
            float(np.sqrt(np.mean(residual**2))),
            match.log_odds,
            pose.mirrored,
        )

    def _resolved(self, pose: _Pose, index: np.ndarray, w: np.ndarray):
        """Stars (brightest first) without those that melt into a brighter one, and how far these may draw it (px)."""
        pixel = _project(w, pose)
        pair = cKDTree(pixel).query_pairs(BLEND_PX, output_type="ndarray")
        brighter, fainter = pair[:, 0], pair[:, 1]
        ratio = 10 ** (
            -0.4 * (self.sky.catalogue.vmag(index[fainter]) - self.sky.catalogue.vmag(index[brighter]))
        )
        apart = np.hypot(*(pixel[fainter] - pixel[brighter]).T)
        drawn = np.zeros(len(index))
        np.add.at(drawn, brighter, apart * ratio / (1 + ratio))
        single = np.ones(len(index), bool)
        single[fainter] = False
        return index[single], w[single], drawn[single]


@dataclass(frozen=True)
class _Seen:
    """Triangles of a frame as they are looked up, with both orders of corners whose angles are equal within the error.

    star (Q, 3): the corner of the largest angle first, of the smallest last; angles and tolerances (Q,) rad; longest
    side and the stars' error (Q,) rad.
    """

    star: np.ndarray
    largest: np.ndarray
    smallest: np.ndarray
    tol_largest: np.ndarray
    tol_smallest: np.ndarray
    longest: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, v: np.ndarray, triples: np.ndarray, error: np.ndarray) -> "_Seen":
        p = v[triples]
        angle = angles(p[:, 0], p[:, 1], p[:, 2])
        order = np.argsort(-angle, axis=1, kind="stable")
        rows = np.arange(len(triples))[:, None]
        triples, angle, p = triples[rows, order], angle[rows, order], p[rows, order]
        a = sides(p[:, 1], p[:, 2])
        b = sides(p[:, 0], p[:, 2])
        c = np.maximum(sides(p[:, 0], p[:, 1]), 1e-9)
        a, b = np.maximum(a, c), np.maximum(b, c)
        error = TRIANGLE_SIGMA * error
        tol_largest = error * np.sqrt(1 / b**2 + 1 / c**2 + (a / (b * c)) ** 2)
        tol_smallest = error * np.sqrt(1 / a**2 + 1 / b**2 + (c / (a * b)) ** 2)
        usable = (tol_smallest < 0.1) & (tol_largest < 0.2)
        first = usable & (angle[:, 0] - angle[:, 1] < 2 * tol_largest)
        last = usable & (angle[:, 1] - angle[:, 2] < 2 * tol_largest)
        star = np.concatenate([triples[usable], triples[first][:, [1, 0, 2]], triples[last][:, [0, 2, 1]]])
        row = np.concatenate([np.flatnonzero(k) for k in (usable, first, last)])
        return cls(
            star, angle[row, 0], angle[row, 2], tol_largest[row], tol_smallest[row], a[row], error[row]
        )


def _handedness(v: np.ndarray) -> np.ndarray:
    """Whether triples of directions (M, 3, 3) turn one way or the other."""
    return np.einsum("mi,mi->m", np.cross(v[:, 0], v[:, 1]), v[:, 2]) > 0


def _perimeter(v: np.ndarray) -> float:
    return float(sides(v, v[[1, 2, 0]]).sum())


def _shared_sides(star: np.ndarray, corner: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """How many other candidates share a side (two stars with the same two identities) with each (M,)."""
    pair = star.astype(np.int64) << 40 | corner  # a detection and its identity as one number
    same = np.unique(pair, return_inverse=True)[1].reshape(pair.shape).astype(np.int64)
    n = same.max() + 1
    one, other = same, same[:, [1, 2, 0]]
    key = (np.minimum(one, other) * n + np.maximum(one, other)) * 2 + mirrored[:, None]
    _, inverse, count = np.unique(key, return_inverse=True, return_counts=True)
    return (count[inverse].reshape(key.shape) - 1).sum(1)


def _mutual_nearest(xy, predicted, radius) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of xy, row of predicted) that are each other's nearest within radius (len(xy),) px."""
    if len(xy) * len(predicted) < SMALL_TABLE:  # all distances at once are quicker than two trees
        apart2 = np.square(xy[:, 0, None] - predicted[:, 0]) + np.square(xy[:, 1, None] - predicted[:, 1])
        nearest, back = apart2.argmin(1), apart2.argmin(0)
        distance = np.sqrt(apart2[np.arange(len(xy)), nearest])
    else:
        distance, nearest = cKDTree(predicted).query(xy)
        back = cKDTree(xy).query(predicted)[1]
    good = (distance < radius) & (back[nearest] == np.arange(len(xy)))
    return np.flatnonzero(good), nearest[good]


def _directions(xy: np.ndarray, focal_px: float) -> np.ndarray:
    """Unit vectors (N, 3) in C of pixels (N, 2) from the principal point."""
    v = np.empty((len(xy), 3))
    v[:, :2] = xy
    v[:, 2] = focal_px
    return v / np.sqrt(np.einsum("ni,ni->n", v, v))[:, None]


def _project(w: np.ndarray, pose: _Pose) -> np.ndarray:
    """Pixels (N, 2) from the principal point; far away for what is behind the camera."""
    u = w @ pose.attitude.T
    return u[:, :2] * (pose.focal_px / np.maximum(u[:, 2:], 1e-6))


def _fit(xy: np.ndarray, w: np.ndarray, pose: _Pose) -> _Pose:
    """Least squares for a small rotation and the focal length from pixels xy (N, 2) of directions w (N, 3)."""
    u = w @ pose.attitude.T
    x, y = u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]
    # d(x, y) for a rotation by d about the camera's axes, and for a relative change of the focal length
    j = np.empty((2, len(x), 4))
    j[0, :, 0], j[0, :, 1], j[0, :, 2], j[0, :, 3] = -x * y, 1 + x * x, -y, x
    j[1, :, 0], j[1, :, 1], j[1, :, 2], j[1, :, 3] = -1 - y * y, x * y, x, y
    j = j.reshape(-1, 4)
    residual = (xy / pose.focal_px - np.stack([x, y], -1)).T.ravel()
    try:
        d = np.linalg.solve(j.T @ j, j.T @ residual)
    except np.linalg.LinAlgError:  # all stars in one place
        return pose
    return _Pose(rotation.from_vector(d[:3]) @ pose.attitude, pose.focal_px * (1 + d[3]), pose.mirrored)
