# SPDX-License-Identifier: Apache-2.0
"""Which catalogue star is which: lost in space, from a frame's brightest stars.

Triangles of the brightest stars are looked up by their angles; candidates that share a side support each other (the
paper's search); each is then held against the whole field by log-odds, so that a match is accepted by its probability
and never by a count, and fitted by least squares to the faintest stars seen.
"""

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos.camera import Camera
from starpos.catalogue import Catalogue
from starpos.triangles import TriangleCatalogue, angles, sides

ACCEPT_LOG_ODDS = np.log(1e9)  # a wrong match among all hypotheses of a frame at most once in 1e9
FALSE_FRACTION = 0.35  # of the detections that may be no catalogue star
TEST_STARS = 50  # the brightest of a frame, which decide
SCALE_TOLERANCE = 0.03  # of the focal length
STAGES = (
    (5, 0.35),
    (7, 0.35),
    (10, 0.35),
    (14, 0.35),
    (8, 2.5),
    (12, 6.0),
)  # (brightest stars, their error in px)
TRIANGLE_SIGMA = 3.0
MAX_VERIFIED = 60  # candidates a stage
FAINTEST_FIT = 400  # stars


class Status(str, Enum):
    """How an identification ended."""

    OK = "ok"
    TOO_FEW_STARS = "too few stars"
    NOT_IDENTIFIED = "not identified"


@dataclass(frozen=True)
class Identification:
    """Matched stars and the attitude they give.

    star (M,): rows of the input; catalogue (M,): indices of the star catalogue; attitude (3, 3): ICRS into C (places as
    given by `Sky`); focal_scale: factor on the camera's focal length; residual_px: rms of one axis; log_odds: of the
    match against chance; mirrored: the frame's rows run bottom-up.
    """

    status: Status
    star: np.ndarray
    catalogue: np.ndarray
    attitude: np.ndarray
    focal_scale: float
    residual_px: float
    log_odds: float
    mirrored: bool

    @property
    def ok(self) -> bool:
        return self.status is Status.OK


def nothing(status: Status, log_odds: float = float("-inf")) -> Identification:
    """An Identification that found nothing."""
    empty = np.zeros(0, int)
    return Identification(status, empty, empty, np.eye(3), float("nan"), float("nan"), log_odds, False)


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
        return v / np.linalg.norm(v, axis=-1, keepdims=True)

    def unaberrated(self, v: np.ndarray) -> np.ndarray:
        """ICRS direction (3,) of one seen at v (3,)."""
        v = v - np.asarray(self.velocity)
        return v / np.linalg.norm(v)


def identify(xy: np.ndarray, sigma_px: np.ndarray, camera: Camera, sky: Sky) -> Identification:
    """Identify stars at pixels xy (N, 2), brightest first, of an ideal camera (distortion and refraction taken off).

    sigma_px (N,): their errors, one axis.  The focal length may be off by SCALE_TOLERANCE.
    """
    if len(xy) < 4:
        return nothing(Status.TOO_FEW_STARS)
    search = _Search(xy, sigma_px, camera, sky)
    best = float("-inf")
    for stars, error_px in STAGES:
        for hypothesis in search.candidates(min(stars, len(xy)), error_px):
            match = search.verify(hypothesis, error_px)
            best = max(best, match.log_odds)
            if match.log_odds > ACCEPT_LOG_ODDS + np.log(search.tried):
                return search.finish(match)
    return nothing(Status.NOT_IDENTIFIED, best)


@dataclass(frozen=True)
class _Hypothesis:
    attitude: np.ndarray  # Sky's directions into the camera
    scale: float
    mirrored: bool
    stars: tuple[int, int, int]


@dataclass(frozen=True)
class _Match:
    attitude: np.ndarray
    scale: float
    mirrored: bool
    log_odds: float
    star: np.ndarray
    catalogue: np.ndarray


@lru_cache(maxsize=32)
def _triples(n: int) -> np.ndarray:
    """All triples of 0..n-1 (T, 3), those of the brightest stars first."""
    t = np.array(list(combinations(range(n), 3)), int).reshape(-1, 3)
    return t[np.lexsort((t.sum(1), t.max(1)))]


class _Search:
    """The state of one frame's search: what was looked at is not looked at again."""

    def __init__(self, xy, sigma_px, camera: Camera, sky: Sky):
        self.xy, self.sigma, self.camera, self.sky = xy, sigma_px, camera, sky
        self.flipped = np.stack([xy[:, 0], (camera.height - 1) - xy[:, 1]], -1)
        self.v = camera.directions(xy[:, 0], xy[:, 1])
        self.tried = 1
        self._done: dict[float, int] = {}
        area = camera.width * camera.height
        self.log_area = np.log(area)

    def candidates(self, stars: int, error_px: float):
        """Hypotheses of triangles among the `stars` brightest that this error has not tried, best supported first."""
        done = self._done.get(error_px, 0)
        triples = _triples(stars)[done:]
        self._done[error_px] = done + len(triples)
        if not len(triples):
            return
        f = self.camera.fx
        p = [self.v[triples[:, k]] for k in range(3)]
        angle = angles(*p)
        order = np.argsort(-angle, axis=1, kind="stable")
        triples = np.take_along_axis(triples, order, 1)
        angle = np.take_along_axis(angle, order, 1)
        p = [self.v[triples[:, k]] for k in range(3)]
        length = np.stack([sides(p[1], p[2]), sides(p[0], p[2]), sides(p[0], p[1])], -1)  # a >= b >= c
        error = TRIANGLE_SIGMA * np.hypot(error_px, self.sigma[triples].max(1)) / f
        a, b, c = np.maximum(length, 1e-9).T
        tol_large = error * np.sqrt(1 / b**2 + 1 / c**2 + (a / (b * c)) ** 2)
        tol_small = error * np.sqrt(1 / a**2 + 1 / b**2 + (c / (a * b)) ** 2)
        usable = (tol_small < 0.1) & (tol_large < 0.2)
        rows = np.flatnonzero(usable)
        # corners whose angles are equal within the error may stand in either order
        swap_first = rows[(angle[rows, 0] - angle[rows, 1]) < 2 * tol_large[rows]]
        swap_last = rows[(angle[rows, 1] - angle[rows, 2]) < 2 * tol_large[rows]]
        variants = [triples[rows], triples[swap_first][:, [1, 0, 2]], triples[swap_last][:, [0, 2, 1]]]
        source = np.concatenate([rows, swap_first, swap_last])
        triples = np.concatenate(variants)
        tri = self.sky.triangles
        query, found = tri.near(angle[source, 0], angle[source, 2], tol_large[source], tol_small[source])
        corner = tri.corners[found]
        star = triples[query]
        w = tri.directions[corner]  # (M, 3, 3)
        seen = self.v[star]
        ratio = sides(w[:, 1], w[:, 2]) / np.maximum(sides(seen[:, 1], seen[:, 2]), 1e-9)
        fits = np.abs(np.log(ratio)) < SCALE_TOLERANCE + error[source[query]] / a[source[query]]
        star, corner, w, seen = star[fits], corner[fits], w[fits], seen[fits]
        if not len(star):
            return
        self.tried += len(star)
        hand = np.sign(_triple_product(w)) * np.sign(_triple_product(seen))
        support = _shared_sides(star, corner, hand)
        best = np.lexsort((star.sum(1), -support))
        if error_px > 1:
            best = best[support[best] > 0]
        for k in best[:MAX_VERIFIED].tolist():
            yield self._hypothesis(star[k], corner[k], bool(hand[k] < 0))

    def _hypothesis(self, star, corner, mirrored) -> _Hypothesis:
        xy = (self.flipped if mirrored else self.xy)[star]
        w = self.sky.directions(self.sky.triangles.star[corner])
        scale = 1.0
        for _ in range(2):  # the focal length that gives the triangle its size
            v = self.camera.scaled(scale).directions(xy[:, 0], xy[:, 1])
            seen = sides(v[1], v[2]) + sides(v[0], v[2]) + sides(v[0], v[1])
            scale *= seen / (sides(w[1], w[2]) + sides(w[0], w[2]) + sides(w[0], w[1]))
        v = self.camera.scaled(scale).directions(xy[:, 0], xy[:, 1])
        return _Hypothesis(rotation.best_rotation(w, v), float(scale), mirrored, tuple(star.tolist()))

    def verify(self, h: _Hypothesis, error_px: float) -> _Match:
        """Log-odds of a hypothesis over the frame's other bright stars, improved by a fit to its matches."""
        attitude, scale = h.attitude, h.scale
        xy = self.flipped if h.mirrored else self.xy
        test = np.arange(min(TEST_STARS, len(xy)))
        index, w = self._in_field(attitude, scale, 2 * len(test) + 10)
        if len(index) < 3:
            return _Match(attitude, scale, h.mirrored, float("-inf"), test[:0], index[:0])
        own = np.isin(test, h.stars)
        reach = np.hypot(self.sigma[test], error_px)
        # a triangle's error grows with the distance from it
        middle = xy[list(h.stars)].mean(0)
        size = max(np.hypot(*(xy[list(h.stars)] - middle).T).mean(), 1.0)
        grown = reach * np.sqrt(1 + (np.hypot(*(xy[test] - middle).T) / size) ** 2)
        for sigma in (grown, np.minimum(reach, grown)):
            predicted = self.camera.scaled(scale).project(w @ attitude.T)
            apart = np.hypot(*(xy[test][:, None] - predicted[None]).transpose(2, 0, 1))
            nearest = np.argmin(apart, axis=1)
            distance = apart[np.arange(len(test)), nearest]
            hit = distance < 3.5 * sigma
            hit[own] = True
            # one catalogue star answers one detection only: the nearer
            order = np.lexsort((distance, nearest))
            first = np.r_[True, np.diff(nearest[order]) != 0]
            hit &= np.isin(np.arange(len(test)), order[first])
            if hit.sum() < 3:
                return _Match(attitude, scale, h.mirrored, float("-inf"), test[:0], index[:0])
            attitude, scale = _fit(xy[test[hit]], w[nearest[hit]], attitude, scale, self.camera)
        predicted = self.camera.scaled(scale).project(w @ attitude.T)
        offset = xy[test] - predicted[nearest]
        distance2 = np.sum(offset**2, 1)
        variance = sigma**2
        likelihood = (
            (1 - FALSE_FRACTION)
            / len(index)
            * np.exp(self.log_area - 0.5 * distance2 / variance)
            / (2 * np.pi * variance)
        )
        odds = np.log(FALSE_FRACTION + np.where(hit, likelihood, 0.0))
        return _Match(attitude, scale, h.mirrored, float(odds[~own].sum()), test[hit], index[nearest[hit]])

    def _in_field(self, attitude, scale, most: int) -> tuple[np.ndarray, np.ndarray]:
        """The brightest catalogue stars on the frame: indices, directions."""
        camera = self.camera.scaled(scale)
        centre = camera.directions(*np.array(camera.centre_px)[:, None])[0] @ attitude
        index = self.sky.catalogue.cone(centre, camera.half_diagonal_rad * 1.02 + 1e-4)
        index = index[: 3 * most]
        w = self.sky.directions(index)
        px = camera.project(w @ attitude.T)
        on = (px > -2).all(1) & (px < [camera.width + 1, camera.height + 1]).all(1)
        index, w = index[on][:most], w[on][:most]
        return index, w

    def finish(self, match: _Match) -> Identification:
        """The accepted match carried to the faintest stars: all detections against all catalogue stars of the field."""
        xy = (self.flipped if match.mirrored else self.xy)[:FAINTEST_FIT]
        attitude, scale = match.attitude, match.scale
        index, w = self._in_field(attitude, scale, 3 * len(xy) + 50)
        residual = xy[match.star] - self.camera.scaled(scale).project(
            self.sky.directions(match.catalogue) @ attitude.T
        )
        spread = max(float(np.sqrt(np.mean(residual**2))), 0.1)
        star, near = match.star, None
        for _ in range(3):
            predicted = self.camera.scaled(scale).project(w @ attitude.T)
            star, near = _mutual_nearest(xy, predicted, 4 * np.hypot(spread, self.sigma[: len(xy)]) + 0.2)
            if len(star) < 3:
                break
            attitude, scale = _fit(xy[star], w[near], attitude, scale, self.camera)
            residual = xy[star] - self.camera.scaled(scale).project(w[near] @ attitude.T)
            spread = max(float(1.4826 * np.median(np.abs(residual))), 0.02)
        rms = float(np.sqrt(np.mean(residual**2)))
        return Identification(
            Status.OK, star, index[near], attitude, float(scale), rms, match.log_odds, match.mirrored
        )


def _triple_product(v: np.ndarray) -> np.ndarray:
    return np.einsum("mi,mi->m", np.cross(v[:, 0], v[:, 1]), v[:, 2])


def _shared_sides(star: np.ndarray, corner: np.ndarray, hand: np.ndarray) -> np.ndarray:
    """How many other candidates share a side (two stars with the same two identities) with each (M,)."""
    one = star.astype(np.int64) * (1 << 40) + corner  # (detection, catalogue star) as one number
    support = np.zeros(len(star), int)
    flat = np.unique(one.ravel(), return_inverse=True)[1].reshape(one.shape).astype(np.int64)
    n = flat.max() + 1
    keys = []
    for i, j in ((0, 1), (0, 2), (1, 2)):
        low, high = np.minimum(flat[:, i], flat[:, j]), np.maximum(flat[:, i], flat[:, j])
        keys.append((low * n + high) * 2 + (hand > 0))
    inverse, count = np.unique(np.concatenate(keys), return_inverse=True, return_counts=True)[1:]
    for k in range(3):
        support += count[inverse[k * len(star) : (k + 1) * len(star)]] - 1
    return support


def _mutual_nearest(xy, predicted, radius) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (row of xy, row of predicted) that are each other's nearest within radius (len(xy),) px."""
    from scipy.spatial import cKDTree

    there = cKDTree(predicted)
    distance, nearest = there.query(xy)
    back = cKDTree(xy).query(predicted)[1]
    good = (distance < radius) & (back[np.minimum(nearest, len(predicted) - 1)] == np.arange(len(xy)))
    return np.flatnonzero(good), nearest[good]


def _fit(xy, w, attitude, scale, camera: Camera, rounds: int = 2):
    """Least squares for a small rotation and the focal length from pixels xy (N, 2) of directions w (N, 3)."""
    for _ in range(rounds):
        cam = camera.scaled(scale)
        u = w @ attitude.T
        plane = u[:, :2] / u[:, 2:]
        x, y = plane.T
        residual = (xy - [cam.cx, cam.cy]) / [cam.fx, cam.fy] - plane
        # d plane for a rotation by d about the camera's axes, and for a relative change of the focal length
        jx = np.stack([-x * y, 1 + x * x, -y, x], -1)
        jy = np.stack([-(1 + y * y), x * y, x, y], -1)
        d = np.linalg.lstsq(
            np.concatenate([jx, jy]), np.concatenate([residual[:, 0], residual[:, 1]]), rcond=None
        )[0]
        attitude = rotation.from_vector(d[:3]) @ attitude
        scale = scale * (1 + d[3])
    return attitude, scale
