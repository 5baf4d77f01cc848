# SPDX-License-Identifier: Apache-2.0
"""Poses of a frame from quads of its brightest stars that look like quads of the sky, those first that most agree on."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos.identification._frame import FrameStars
from starpos.identification.pose import MATCH_SIGMA, Poses, directions
from starpos.identification.quads import SHORTEST, SIDES, QuadCatalogue, shapes
from starpos.identification.sky import Sky

# Sides of quads over the longest may be off by this besides the errors of the stars: lenses bend.
LENS = 0.003
QUAD_SIGMA = 3.0
# Poses agree if their axes differ by this share of the field and their focal lengths by this share.
SAME_AXIS, SAME_FOCAL = 0.03, 0.03
# A focal length may be outside the range that is searched by this share, once it is fitted.
BEYOND = 0.1


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

    @classmethod
    def of(
        cls,
        field: FrameStars,
        quads: QuadCatalogue,
        stars: int,
        error_px: float,
        focal_px: float,
        step: float,
    ) -> "Matches":
        """Quads of the frame's brightest stars, and similar quads of the sky at a focal length.

        error_px: of the stars, besides their own.  step: the share by which the true focal length may differ.
        """
        four = _fours(stars)
        v = directions(field.xy[:1, :stars], np.array([focal_px]))[0]
        order, shape, size = shapes(v[four])
        star = np.take_along_axis(four, order, 1)
        error = QUAD_SIGMA * np.hypot(error_px, field.sigma[four].max(1)) / (focal_px * size)
        # a lower limit than the catalogue's
        use = np.flatnonzero((shape.min(1) > 0.8 * SHORTEST) & (error < 0.03))
        # the best known first: the number of look-ups is limited
        use = use[np.argsort(error[use], kind="stable")]
        query, quad = quads.near(shape[use], error[use] + LENS, np.log(size[use]), step + 0.01)
        return cls(star[use[query]], quads.corners[quad], np.full(len(query), focal_px))

    @classmethod
    def together(cls, parts: Iterable["Matches"]) -> "Matches":
        """All matches of several parts, at least one."""
        listed = list(parts)
        return cls(
            *(np.concatenate([getattr(m, name) for m in listed]) for name in ("star", "corner", "focal_px"))
        )


@dataclass(frozen=True)
class QuadPoses:
    """K poses of a frame, and the quads of its stars (K, 4) from which they come."""

    poses: Poses
    star: np.ndarray

    @classmethod
    def of(
        cls, field: FrameStars, sky: Sky, m: Matches, error_px: float, focal_range: tuple[float, float]
    ) -> "QuadPoses":
        """The poses of matches by which their four stars are in their places, with focal lengths in a range."""
        poses, off_px = _fitted(field, m, sky)
        error = np.hypot(error_px, field.sigma[m.star].max(1)) if len(m.star) else np.zeros(0)
        (low, high), focal = focal_range, poses.focal_px
        good = (off_px < QUAD_SIGMA * error) & (focal > (1 - BEYOND) * low) & (focal < (1 + BEYOND) * high)
        return cls(Poses(poses.attitude[good], focal[good], poses.mirrored[good]), m.star[good])

    def radius_px(self, field: FrameStars, k: int, error_px: float) -> np.ndarray:
        """Distance (N,) px by which each star may be off by pose k: it grows with that from the quad's stars."""
        xy = field.xy[int(self.poses.mirrored[k])]
        of_quad = xy[self.star[k]]
        middle = of_quad.mean(0)
        size2 = max(float(np.square(of_quad - middle).sum() / 4), 1.0)
        away2 = np.square(xy - middle).sum(1)
        return MATCH_SIGMA * np.hypot(field.sigma, error_px) * np.sqrt(1 + away2 / size2)


def most_agreed(poses: Poses, half_diagonal_px: float, most: int) -> list[int]:
    """Rows of the poses with most votes, one of each group that agrees, up to a maximum number."""
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
            if len(rows) == most:
                break
    return rows


@lru_cache(maxsize=8)
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
