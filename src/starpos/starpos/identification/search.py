# SPDX-License-Identifier: Apache-2.0
"""The search: priors first, then lost in space, from few bright stars to more, from good centroids to poor ones."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from starpos.identification.evidence import anywhere
from starpos.identification.full import FEWEST_STARS, Identification, identified
from starpos.identification.lookup import Candidates, Lookup
from starpos.identification.pose import CROWD_STARS, FrameStars, Pose, Poses
from starpos.identification.prior import Attempt, PlumbPrior, PointingPrior
from starpos.identification.screen import MATCH_SIGMA, promising
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera

# (number of brightest stars, their error in px); the last stages are for lenses with distortion.
STAGES = (5, 0.3), (7, 0.3), (10, 0.3), (14, 0.3), (20, 0.3), (9, 2.5), (8, 6.0)
LOG_HALF = math.log(0.5)
# Candidates looked at in each stage.
MOST_LOOKED_AT = 25
# Stars so far beyond the frame (px) need no margin; a margin is at most this share of the frame.
EDGE_PX, WIDEST_MARGIN = 2.0, 0.25

# Triangles of the brightest stars, and the error in px, where a crowd of them is false.
CROWD_STAGES = (60, 0.3), (140, 0.1)

Priors = Sequence[PointingPrior | PlumbPrior]


def identify(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    camera: Camera,
    sky: Sky,
    priors: Sequence[PointingPrior | PlumbPrior] = (),
) -> Identification | None:
    """Identify stars at pixels xy (N, 2), brightest first, of an ideal camera (distortion and refraction removed).

    sigma_px  (N,): their errors along one axis
    camera    its focal length may be off by SCALE_TOLERANCE
    priors    where to look first

    None if no part of the sky fits beyond doubt. ValueError if a pixel or an error is not a finite number.
    """
    return _identify(FrameStars.of(xy, sigma_px, camera), sky, priors)


def identify_directions(
    directions: np.ndarray,
    sigma_px: np.ndarray,
    camera: Camera,
    sky: Sky,
    priors: Sequence[PointingPrior | PlumbPrior] = (),
) -> Identification | None:
    """Identify stars as `identify` does, from unit vectors (N, 3) in C, with refraction removed, of any camera."""
    return _identify(frame_stars(directions, sigma_px, camera), sky, priors)


def frame_stars(directions: np.ndarray, sigma_px: np.ndarray, camera: Camera) -> FrameStars:
    """Make FrameStars from unit vectors (N, 3) in C and errors (N,) px. ValueError if one is not a finite number."""
    # a camera with square pixels, as `identify` needs
    squeeze = camera.fx / camera.fy
    width, height = camera.width, max(1, round(camera.height * squeeze))
    cx, cy = camera.cx, camera.cy * squeeze
    xy = Camera(width=width, height=height, fx=camera.fx, fy=camera.fx, cx=cx, cy=cy).project(directions)
    # without distortion, stars that a lens has drawn in may lie beyond the frame: it gets a margin
    beyond = float(np.maximum(-xy, xy - (width - 1, height - 1)).max(initial=0.0))
    widest = WIDEST_MARGIN * max(width, height)
    margin = math.ceil(min(beyond - EDGE_PX, widest)) if beyond > EDGE_PX else 0
    ideal = Camera(
        width=width + 2 * margin,
        height=height + 2 * margin,
        fx=camera.fx,
        fy=camera.fx,
        cx=cx + margin,
        cy=cy + margin,
    )
    return FrameStars.of(xy + margin, sigma_px, ideal, margin)


def _identify(field: FrameStars, sky: Sky, priors: Priors) -> Identification | None:
    """The first attempt that is accepted; None if there is none."""
    if len(field) < FEWEST_STARS:
        return None
    for pose, radius_px, prior in attempts(field, sky, priors, STAGES):
        if found := identified(field, sky, pose, radius_px, prior):
            return found
    field = replace(field, tested=CROWD_STARS)
    for pose, radius_px, prior in crowded_attempts(field, sky, priors):
        if found := identified(field, sky, pose, radius_px, prior):
            return found
    return None


def crowded_attempts(field: FrameStars, sky: Sky, priors: Priors) -> Iterator[Attempt]:
    """Yield the attempts for a frame whose brightest stars may nearly all be false, or in any order of brightness."""
    for prior in priors:
        yield from prior.attempts(field, sky, LOG_HALF - np.log(len(priors)))
    lost = anywhere(field.focal_px, LOG_HALF if priors else 0.0)
    lookup, stages = (
        Lookup(field, sky.triangles),
        [(min(n, len(field)), error_px) for n, error_px in CROWD_STAGES],
    )
    for stars, error_px in dict.fromkeys(stages):
        candidates = lookup.supported(stars, error_px)
        poses, radius_px = _of_triangles(field, sky, candidates, error_px)
        for k in range(len(poses)):
            yield poses[k], radius_px[k], lost


def attempts(
    field: FrameStars, sky: Sky, priors: Priors, stages: Sequence[tuple[int, float]]
) -> Iterator[Attempt]:
    """Yield the attempts in their order: by the priors, then lost in space by `stages`.

    Half of the probability is that of the priors, if there are any.
    """
    for prior in priors:
        yield from prior.attempts(field, sky, LOG_HALF - np.log(len(priors)))
    lost = anywhere(field.focal_px, LOG_HALF if priors else 0.0)
    for pose, radius_px in _lost_in_space(field, sky, stages):
        yield pose, radius_px, lost


def _lost_in_space(
    field: FrameStars, sky: Sky, stages: Sequence[tuple[int, float]]
) -> Iterator[tuple[Pose, np.ndarray]]:
    """Yield poses from triangles, stage by stage, and the distance (N,) px by which each star may be off."""
    lookup = Lookup(field, sky.triangles)
    for stars, error_px in stages:
        candidates = lookup.candidates(min(stars, len(field)), error_px)
        # mostly the first one is right
        if len(candidates):
            poses, radius_px = _of_triangles(field, sky, candidates[:1], error_px)
            yield poses[0], radius_px[0]
        if len(candidates) > 1:
            others = candidates[1:MOST_LOOKED_AT]
            poses, radius_px = _of_triangles(field, sky, others, error_px)
            for k in promising(field, sky, poses, others.star, radius_px / MATCH_SIGMA):
                yield poses[k], radius_px[k]


def _of_triangles(field: FrameStars, sky: Sky, c: Candidates, error_px: float) -> tuple[Poses, np.ndarray]:
    """The poses of K candidates, and the distance (K, n) px by which the field's brightest stars may be off."""
    xy = field.xy[c.mirrored.astype(int), : field.tested]
    each = np.arange(len(c))[:, None]
    corners = xy[each, c.star]
    w = sky.bright(c.corner.ravel()).reshape(-1, 3, 3)
    poses = Poses.of_triangles(corners, w, field.focal_px, c.mirrored)
    # a triangle's error grows with the distance from it
    middle = corners.mean(1, keepdims=True)
    size2 = np.maximum(np.square(corners - middle).sum((1, 2)) / 3, 1.0)[:, None]
    away2 = np.square(xy - middle).sum(2)
    sigma = np.hypot(field.sigma[: xy.shape[1]], error_px)
    return poses, MATCH_SIGMA * sigma * np.sqrt(1 + away2 / size2)
