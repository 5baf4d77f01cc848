# SPDX-License-Identifier: Apache-2.0
"""The search: priors first, then lost in space, from few bright stars to more, from good centroids to poor ones."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from starpos.core.frame import projected
from starpos.identification import wide
from starpos.identification.evidence import anywhere
from starpos.identification.full import FEWEST_STARS, Identification, identified
from starpos.identification.lookup import Candidates, Lookup
from starpos.identification.pose import CROWD_STARS, LEAST_SIGMA_PX, FrameStars, Pose, Poses
from starpos.identification.prior import Attempt, PlumbPrior, PointingPrior
from starpos.identification.screen import MATCH_SIGMA, promising
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera

# (number of brightest stars, their error in px); the last stages are for lenses with distortion.
STAGES = (5, 0.3), (7, 0.3), (10, 0.3), (14, 0.3), (20, 0.3), (9, 2.5), (8, 6.0)
LOG_HALF = math.log(0.5)
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
    return identify_frame(FrameStars.of(xy, sigma_px, camera), sky, priors)


def identify_directions(
    directions: np.ndarray,
    sigma_px: np.ndarray,
    camera: Camera,
    sky: Sky,
    priors: Sequence[PointingPrior | PlumbPrior] = (),
) -> Identification | None:
    """Identify stars as `identify` does, from unit vectors (N, 3) in C, with refraction removed, of any camera."""
    return identify_frame(field_of(directions, sigma_px, camera), sky, priors)


def field_of(directions: np.ndarray, sigma_px: np.ndarray, camera: Camera) -> FrameStars | wide.WideField:
    """The stars in directions (N, 3) in C, errors (N,) px, as `identify_frame` takes them from this camera."""
    if wide.is_wide(camera):
        return wide.WideField(directions, sigma_px, camera)
    return frame_stars(directions, sigma_px, camera)


def frame_stars(directions: np.ndarray, sigma_px: np.ndarray, camera: Camera) -> FrameStars:
    """Make FrameStars from unit vectors (N, 3) in C and errors (N,) px. ValueError if one is not a finite number."""
    # a camera with square pixels, as `identify` needs
    squeeze = camera.fx / camera.fy
    width, height = camera.width, max(1, round(camera.height * squeeze))
    cx, cy = camera.cx, camera.cy * squeeze
    xy, sigma, beyond = projected(directions, sigma_px, camera.fx, cx, cy, width, height, LEAST_SIGMA_PX)
    # without distortion, stars that a lens has drawn in may lie beyond the frame: it gets a margin
    margin = math.ceil(min(beyond - EDGE_PX, WIDEST_MARGIN * max(width, height))) if beyond > EDGE_PX else 0
    return FrameStars(
        xy=xy,
        sigma=sigma,
        middle=np.array([(width - 1) / 2 - cx, (height - 1) / 2 - cy]),
        half=np.array([width / 2 + margin, height / 2 + margin]),
        focal_px=camera.fx,
        area_px2=float(width * height),
    )


def identify_frame(
    field: FrameStars | wide.WideField, sky: Sky, priors: Priors = ()
) -> Identification | None:
    """Identify stars as `identify` does, from FrameStars, or from those of a fisheye."""
    if isinstance(field, wide.WideField):
        return _by_parts(field, sky, priors)
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


def _by_parts(field: wide.WideField, sky: Sky, priors: Priors) -> Identification | None:
    """Identify a part of a fisheye's frame, then all of it."""
    parts = wide.parts(field)
    for part in parts:
        found = identify_frame(part.field, sky, part.turned(priors))
        if found and found.log_odds >= wide.enough(len(parts)):
            return wide.everywhere(field, sky, part, found)
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
        made, radius_px = _of_triangles(field, sky, candidates, error_px)
        for k in range(len(made)):
            yield made[k], radius_px[k], lost


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
            made, radius_px = _of_triangles(field, sky, candidates[:1], error_px)
            yield made[0], radius_px[0]
        if len(candidates) > 1:
            others = candidates[1:]
            made, radius_px = _of_triangles(field, sky, others, error_px)
            for k in promising(field, sky, made, others.star, radius_px):
                yield made[k], radius_px[k]


def _of_triangles(field: FrameStars, sky: Sky, c: Candidates, error_px: float) -> tuple[Poses, np.ndarray]:
    """The poses of K candidates, and the distance (K, n) px by which the field's brightest stars may be off."""
    attitude, focal_px, radius_px = sky.brightest.poses(
        field.compiled,
        c.star,
        c.corner,
        c.mirrored,
        sky.years,
        sky.velocity,
        error_px,
        MATCH_SIGMA,
        field.tested,
    )
    return Poses(attitude, focal_px, c.mirrored), radius_px
