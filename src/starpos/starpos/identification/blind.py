# SPDX-License-Identifier: Apache-2.0
"""Identify a frame of which nothing is known, not even the scale: by quads of its brightest stars, at every scale.

Scales are tried in steps so small that a pinhole's projection shows in no shape. Quads of the frame that look like
quads of the sky give poses. Those on which most agree are judged by the same evidence as any other, but every scale was
possible before. Where the focal length is roughly known, scales near it come first, which is quick.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from starpos import rotation
from starpos.frames.stars import Window
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import any_scale
from starpos.identification.full import ENOUGH, FEWEST_STARS, Identification, identified
from starpos.identification.pose import MATCH_SIGMA, Pose, Poses, directions, stars_at
from starpos.identification.quads import SHORTEST, SIDES, QuadCatalogue, shapes
from starpos.identification.search import SECOND_TRY, second_try, through
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera

# Fields from corner to corner that are tried, deg.
SMALLEST_DEG, LARGEST_DEG = 0.6, 100.0
# A focal length that is roughly known may be off by this factor. With it wider fields are tried too, as telephones have
# them: up to this many deg.
ROUGHLY, LARGEST_TOLD_DEG = 1.2, 130.0
# (number of brightest stars, their error in px)
STAGES = (10, 0.4), (15, 0.4), (21, 0.4), (12, 2.0)
# A step of the focal length is at most this; and so small that it changes the shape of no quad by more than that.
LARGEST_STEP, BENT = 0.1, 0.003
# Sides of quads over the longest may be off by this beside the errors of the stars: lenses bend.
LENS = 0.003
QUAD_SIGMA = 3.0
# Poses agree if their axes differ by this share of the field and their focal lengths by this share.
SAME_AXIS, SAME_FOCAL = 0.03, 0.03
# So many poses, those with most votes, are judged in each stage.
MOST_JUDGED = 40


@dataclass(frozen=True)
class Matches:
    """K pairs of quads that look alike.

    star      (K, 4): rows of the frame's stars
    corner    (K, 4): rows of the star catalogue
    focal_px  (K,): the focal length at which they do
    """

    star: np.ndarray
    corner: np.ndarray
    focal_px: np.ndarray


def identify_blind(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    width: int,
    height: int,
    sky: Sky,
    quads: QuadCatalogue,
    stages: Sequence[tuple[int, float]] = STAGES,
    near_px: float | None = None,
    window: Window | None = None,
) -> tuple[Camera, Identification] | None:
    """Identify stars at pixels xy (N, 2), brightest first, of a pinhole camera of unknown focal length.

    near_px: a focal length that it may have, with which the search begins; half of the probability is for it.
    window: the part of the frame that shows something, as `Stars` has it; None: all of it.

    Returns the camera, whose focal length `Identification.focal_scale` refines, and the identification; None if there is
    none beyond doubt.
    """
    if len(xy) < FEWEST_STARS:
        return None
    half_diagonal_px = np.hypot(width, height) / 2
    told, shortest, longest = (
        half_diagonal_px / np.tan(np.radians(d / 2)) for d in (LARGEST_TOLD_DEG, LARGEST_DEG, SMALLEST_DEG)
    )
    spans = [(shortest, longest)]
    if near_px is not None and told < near_px < longest:
        spans.insert(0, (max(told, near_px / ROUGHLY), min(longest, near_px * ROUGHLY)))
    camera = Camera.from_focal(width, height, shortest)
    frame = stars_at(camera, xy, sigma_px)
    tries = [(np.arange(len(xy)), 1.0, ENOUGH)]
    if (even := second_try(through(frame, camera, window))) is not None:
        # each star found keeps those of its cell away: that leaves less area for the others
        tries.append((even, 0.5, ENOUGH + SECOND_TRY))
    for rows, share, enough in tries:
        field = frame.take(rows)
        different = dict.fromkeys((min(stars, len(field)), error_px) for stars, error_px in stages)
        for (stars, error_px), (low, high) in product(different, spans):
            prior = any_scale(low, high, -math.log(len(spans)))
            for pose, radius_px in _poses(field, sky, quads, (low, high), stars, error_px):
                camera = Camera.from_focal(width, height, pose.focal_px)
                seen = through(stars_at(camera, xy[rows], sigma_px[rows]), camera, window)
                seen = seen.but(area_px2=share * seen.area_px2)
                found = identified(seen, sky, pose, radius_px, prior, enough)
                if found:
                    return camera, found.but(star=rows[found.star])
    return None


def _poses(
    field: FrameStars,
    sky: Sky,
    quads: QuadCatalogue,
    focal_range: tuple[float, float],
    stars: int,
    error_px: float,
) -> Iterator[tuple[Pose, np.ndarray]]:
    """Yield poses, those first on which most quads agree, and the distance (N,) px by which each star may be off."""
    half_diagonal_px, (shortest, longest) = float(np.hypot(*field.half)), focal_range
    parts = [
        _matches(field, quads, stars, error_px, focal, step)
        for focal, step in _focal_lengths(half_diagonal_px, shortest, longest)
    ]
    star, corner, focal = (
        np.concatenate([getattr(m, name) for m in parts]) for name in ("star", "corner", "focal_px")
    )
    if not len(star):
        return
    poses, off_px = _fitted(field, Matches(star, corner, focal), sky)
    error = np.hypot(error_px, field.sigma[star].max(1))
    good = (
        (off_px < QUAD_SIGMA * error) & (poses.focal_px > 0.9 * shortest) & (poses.focal_px < 1.1 * longest)
    )
    poses, star = Poses(poses.attitude[good], poses.focal_px[good], poses.mirrored[good]), star[good]
    for k in _most_agreed(poses, half_diagonal_px):
        yield poses[k], _radius(field, poses[k], star[k], error_px)


def _focal_lengths(half_diagonal_px: float, shortest: float, longest: float) -> Iterator[tuple[float, float]]:
    """Yield focal lengths (px) and by which share the true one may differ from each."""
    focal = shortest
    while focal < longest:
        step = min(LARGEST_STEP, BENT / (half_diagonal_px / focal) ** 2)
        yield focal * (1 + step), step
        focal *= (1 + step) ** 2


def _matches(
    field: FrameStars, quads: QuadCatalogue, stars: int, error_px: float, focal_px: float, step: float
) -> Matches:
    """Quads of the frame's brightest stars, and those of the sky that they look like at a focal length."""
    four = _fours(stars)
    v = directions(field.xy[:1, :stars], np.array([focal_px]))[0]
    order, shape, size = shapes(v[four])
    star = np.take_along_axis(four, order, 1)
    error = QUAD_SIGMA * np.hypot(error_px, field.sigma[four].max(1)) / (focal_px * size)
    # a lower rim than that of the catalogue's
    use = np.flatnonzero((shape.min(1) > 0.8 * SHORTEST) & (error < 0.03))
    tolerance = error[use] + LENS
    query, quad = quads.near(shape[use].astype(np.float32), tolerance, np.log(size[use]), step + 0.01)
    return Matches(star[use[query]], quads.corners[quad], np.full(len(query), focal_px))


def _fours(n: int) -> np.ndarray:
    """All sets (F, 4) of four of 0..n-1."""
    return np.array(list(combinations(range(n), 4)), int).reshape(-1, 4)


def _fitted(field: FrameStars, m: Matches, sky: Sky) -> tuple[Poses, np.ndarray]:
    """The pose of each match, and the largest distance (K,) px of its four stars from their places."""
    w = sky.directions(m.corner.ravel()).reshape(-1, 4, 3)
    focal = m.focal_px.copy()
    seen = directions(field.xy[0][m.star], focal)
    mirrored = (_turn(seen[:, :3]) > 0) != (_turn(w[:, :3]) > 0)
    xy = field.xy[mirrored.astype(int)[:, None], m.star]
    wanted = _perimeter(w)
    for _ in range(3):
        focal = focal * _perimeter(directions(xy, focal)) / wanted
    attitude = rotation.best_rotation(w, directions(xy, focal))
    u = np.einsum("kij,knj->kni", attitude, w)
    off = u[..., :2] * (focal[:, None, None] / np.maximum(u[..., 2:], 1e-6)) - xy
    return Poses(attitude, focal, mirrored), np.sqrt(np.square(off).sum(2).max(1))


def _turn(v: np.ndarray) -> np.ndarray:
    """Determinants (K,) of triangles (K, 3, 3): their signs are their orientations."""
    return np.einsum("ki,ki->k", v[:, 0], np.cross(v[:, 1], v[:, 2]))


def _perimeter(v: np.ndarray) -> np.ndarray:
    """Sum (K,) of all chords of quads (K, 4, 3)."""
    return np.linalg.norm(v[:, SIDES[:, 0]] - v[:, SIDES[:, 1]], axis=2).sum(1)


def _most_agreed(poses: Poses, half_diagonal_px: float) -> list[int]:
    """Rows of the poses with most votes, at most MOST_JUDGED, one of each group that agrees."""
    from scipy.spatial import cKDTree

    if not len(poses):
        return []
    place = np.concatenate(
        [
            poses.attitude[:, 2] * (poses.focal_px / (SAME_AXIS * half_diagonal_px))[:, None],
            np.log(poses.focal_px)[:, None] / SAME_FOCAL,
            10.0 * poses.mirrored[:, None],
        ],
        axis=1,
    )
    tree = cKDTree(place)
    votes = tree.query_ball_point(place, 1.0, return_length=True)
    rows: list[int] = []
    taken = np.zeros(len(place), bool)
    for k in np.argsort(-votes, kind="stable").tolist():
        if not taken[k]:
            rows.append(k)
            taken[tree.query_ball_point(place[k], 1.0)] = True
            if len(rows) == MOST_JUDGED:
                break
    return rows


def _radius(field: FrameStars, pose: Pose, star: np.ndarray, error_px: float) -> np.ndarray:
    """Distance (N,) px by which each star may be off where a pose comes from the stars (4,): it grows with theirs."""
    xy = field.xy[int(pose.mirrored)]
    middle = xy[star].mean(0)
    size2 = max(float(np.square(xy[star] - middle).sum() / 4), 1.0)
    away2 = np.square(xy - middle).sum(1)
    return MATCH_SIGMA * np.hypot(field.sigma, error_px) * np.sqrt(1 + away2 / size2)
