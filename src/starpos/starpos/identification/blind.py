# SPDX-License-Identifier: Apache-2.0
"""Identify a frame of which nothing is known, not even the scale: by quads of its brightest stars, at every scale.

Scales are tried in steps so small that a pinhole's projection shows in no shape. Quads of the frame that look like
quads of the sky give poses. Those on which most agree are judged by the same evidence as any other, but every scale was
possible before. Where the focal length is roughly known, scales near it come first, which is quick. An answer that is
not sure is kept while the search goes on, in case there is a better one.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from starpos.budget import ENDLESS, Budget
from starpos.frames.stars import Window
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import any_scale
from starpos.identification.explained import MIN_EXPLAINED, explained_by
from starpos.identification.full import MIN_LOG_ODDS, MIN_STARS, Identification, verify_pose
from starpos.identification.pose import Pose, stars_at
from starpos.identification.quad_poses import Matches, QuadPoses, most_agreed
from starpos.identification.quads import QuadCatalogue
from starpos.identification.search import SECOND_TRY, second_try, through
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera
from starpos.progress import Progress, quiet

# Fields from corner to corner that are tried, deg.
SMALLEST_DEG, LARGEST_DEG = 0.6, 100.0
# A focal length that is roughly known may be off by this factor. With it wider fields are tried too, as telephones have
# them: up to this many deg.
ROUGHLY, LARGEST_TOLD_DEG = 1.2, 130.0
# (number of brightest stars, their error in px)
STAGES = (10, 0.4), (15, 0.4), (21, 0.4), (12, 2.0)
# A step of the focal length is at most this; and so small that it changes the shape of no quad by more than that.
LARGEST_STEP, BENT = 0.1, 0.003
# Poses judged in each stage: the ones with most votes.
MAX_JUDGED = 40
# Log-odds of an answer that ends the search though most bright detections are not its stars.
SURE = 6 * MIN_LOG_ODDS


@dataclass(frozen=True)
class _Try:
    """Stars that are searched: rows of them, their share of the frame's area, and the log-odds that they need."""

    rows: np.ndarray
    share: float
    enough: float


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
    budget: Budget = ENDLESS,
    progress: Progress = quiet,
) -> tuple[Camera, Identification] | None:
    """Identify stars at pixels xy (N, 2), brightest first, of a pinhole camera of unknown focal length.

    near_px: a likely focal length, with which the search begins; it has half of the probability.
    window: the part of the frame that shows something, as `Stars` has it; None: all of it.
    budget: CPU time after which the search ends; what it has found until then counts.

    Returns the camera, whose focal length `Identification.focal_scale` refines, and the identification; None without
    an identification beyond doubt.
    """
    if len(xy) < MIN_STARS:
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
    tries = [_Try(np.arange(len(xy)), 1.0, MIN_LOG_ODDS)]
    if (even := second_try(through(frame, camera, window))) is not None:
        # only one star is taken from a cell, which leaves less area for the others
        tries.append(_Try(even, 0.5, MIN_LOG_ODDS + SECOND_TRY))
    # the quick stages of all tries come before the slow ones of any
    work = [
        (t, stage, span)
        for k in range(len(stages))
        for t in tries
        for stage, span in product(stages_of(stages, len(t.rows))[k : k + 1], spans)
    ]
    best: tuple[Camera, Identification] | None = None
    for k, (t, (stars, error_px), (low, high)) in enumerate(work):
        progress("searching all scales", k / len(work))
        prior = any_scale(low, high, -math.log(len(spans)))
        for pose, radius_px in _poses(frame.take(t.rows), sky, quads, (low, high), stars, error_px, budget):
            camera = Camera.from_focal(width, height, pose.focal_px)
            seen = through(stars_at(camera, xy[t.rows], sigma_px[t.rows]), camera, window)
            seen = seen.but(area_px2=t.share * seen.area_px2)
            found = verify_pose(seen, sky, pose, radius_px, prior, t.enough)
            if found and (best is None or found.log_odds > best[1].log_odds):
                best = camera, found.but(star=t.rows[found.star])
                if is_sure(found, seen):
                    return best
        if budget.spent:
            break
    return best


def stages_of(stages: Sequence[tuple[int, float]], stars: int) -> list[tuple[int, float]]:
    """The stages for a frame with this number of stars, without duplicates."""
    return list(dict.fromkeys((min(number, stars), error_px) for number, error_px in stages))


def is_sure(found: Identification, field: FrameStars) -> bool:
    """Whether no better answer needs to be looked for."""
    explained = explained_by(found, field)
    return explained.explained >= MIN_EXPLAINED * explained.bright or (
        explained.enough and found.log_odds >= SURE
    )


def _poses(
    field: FrameStars,
    sky: Sky,
    quads: QuadCatalogue,
    focal_range: tuple[float, float],
    stars: int,
    error_px: float,
    budget: Budget,
) -> Iterator[tuple[Pose, np.ndarray]]:
    """Yield poses, those first on which most quads agree, and the distance (N,) px by which each star may be off."""
    half_diagonal_px = float(np.hypot(*field.half))
    matches = []
    for focal_px, step in focal_lengths(half_diagonal_px, *focal_range):
        if budget.spent:
            return
        matches.append(Matches.of(field, quads, stars, error_px, focal_px, step))
    found = QuadPoses.of(field, sky, Matches.together(matches), error_px, focal_range)
    for k in most_agreed(found.poses, half_diagonal_px, MAX_JUDGED):
        if budget.spent:
            return
        yield found.poses[k], found.radius_px(field, k, error_px)


def focal_lengths(half_diagonal_px: float, shortest: float, longest: float) -> Iterator[tuple[float, float]]:
    """Yield focal lengths (px) and by which share the true one may differ from each."""
    focal = shortest
    while focal < longest:
        step = min(LARGEST_STEP, BENT / (half_diagonal_px / focal) ** 2)
        yield focal * (1 + step), step
        focal *= (1 + step) ** 2
