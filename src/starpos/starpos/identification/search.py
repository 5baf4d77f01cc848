# SPDX-License-Identifier: Apache-2.0
"""The search: priors first, then lost in space, from few bright stars to more, from good centroids to poor ones."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from starpos.camera import Camera
from starpos.identification.full import FEWEST_STARS, Identification, OnFrame, identified
from starpos.identification.lookup import Candidates, Lookup
from starpos.identification.pose import Field, Poses
from starpos.identification.prior import Plumb, Pointing
from starpos.identification.sky import Sky
from starpos.identification.verify import TEST_STARS, Hypotheses, Match, matches, own_stars

FALSE_ACCEPT = 1e-9  # probability that a frame of nothing is taken for some part of the sky
PRIOR_SHARES = 0.05, 0.05 / 25  # of that: for a camera that stands, for each other proposal
# (brightest stars, their error in px, share of FALSE_ACCEPT); the second kind is for lenses that distort
STAGES = (
    (5, 0.3, 0.7),
    (7, 0.3, 0.1),
    (10, 0.3, 0.04),
    (14, 0.3, 0.02),
    (20, 0.3, 0.02),
    (9, 2.5, 0.01),
    (8, 6.0, 0.01),
)
MAX_VERIFIED = 25  # candidates a stage
EDGE_PX, WIDEST_MARGIN = (
    2.0,
    0.25,
)  # how far stars may lie beyond the frame as it is, and (share of it) as it becomes


def identify(
    xy: np.ndarray,
    sigma_px: np.ndarray,
    camera: Camera,
    sky: Sky,
    priors: Sequence[Pointing | Plumb] = (),
) -> Identification | None:
    """Identify stars at pixels xy (N, 2), brightest first, of an ideal camera (distortion and refraction taken off).

    sigma_px (N,): their errors, one axis.  The focal length may be off by SCALE_TOLERANCE.  Priors only say where to look
    first.  None: no part of the sky is these stars beyond doubt.
    """
    if len(xy) < FEWEST_STARS:
        return None
    field = Field.of(xy, sigma_px, camera)
    for k, proposal in enumerate(p for given in priors for p in given.proposals(field, sky)):
        enough = _enough(proposal.chosen_from, PRIOR_SHARES[min(k, 1)])
        match = proposal.match(field, enough)
        if _sound(match, enough) and (
            found := identified(field, sky, match, OnFrame.of(field, sky, match.pose))
        ):
            return found
    for hypotheses, error_px, enough in _attempts(field, sky):
        for match in matches(field, sky, hypotheses, error_px, enough):
            if _sound(match, enough) and (
                found := identified(field, sky, match, OnFrame.of(field, sky, match.pose))
            ):
                return found
    return None


def identify_directions(
    directions: np.ndarray,
    sigma_px: np.ndarray,
    camera: Camera,
    sky: Sky,
    priors: Sequence[Pointing | Plumb] = (),
) -> Identification | None:
    """`identify` from unit vectors (N, 3) in C, refraction taken off, as any `camera` gave them."""
    # of square pixels, which is what identify fits
    squeeze = camera.fx / camera.fy
    size = np.array([camera.width, max(1, round(camera.height * squeeze))])
    middle = np.array([camera.cx, camera.cy * squeeze])
    xy = Camera(*size.tolist(), camera.fx, camera.fx, *middle.tolist()).project(directions)
    # what a lens has drawn in from the sides lies beyond them without its distortion, and so do the catalogue's stars
    beyond = np.maximum(-xy, xy - (size - 1)).max(initial=0.0)
    margin = int(np.ceil(np.clip(beyond - EDGE_PX, 0.0, WIDEST_MARGIN * size.max())))
    ideal = Camera(*(size + 2 * margin).tolist(), camera.fx, camera.fx, *(middle + margin).tolist())
    return identify(xy + margin, sigma_px, ideal, sky, priors)


def _enough(hypotheses: int, share: float) -> float:
    """Log-odds that the best of so many hypotheses must have: wrong ones reach them with share * FALSE_ACCEPT (Ville)."""
    return math.log(max(hypotheses, 1) / (share * FALSE_ACCEPT))


def _sound(match: Match, enough: float) -> bool:
    return match.log_odds > enough and len(match.star) >= FEWEST_STARS


def _attempts(field: Field, sky: Sky) -> Iterator[tuple[Hypotheses, float, float]]:
    """What to try, in this order: hypotheses, the stars' error in px, and the log-odds that are enough."""
    lookup = Lookup(field, sky.triangles)
    for stars, error_px, share in STAGES:
        candidates, count = lookup.candidates(min(stars, len(field)), error_px)
        # mostly the first one is right, and the others together cost little more
        for k in (slice(0, 1), slice(1, MAX_VERIFIED)):
            if len(some := candidates[k]):
                yield _of_triangles(field, sky, some, error_px), error_px, _enough(count, share)


def _of_triangles(field: Field, sky: Sky, c: Candidates, error_px: float) -> Hypotheses:
    xy = field.xy[c.mirrored.astype(int), : min(len(field), TEST_STARS)]
    each = np.arange(len(c))[:, None]
    corners = xy[each, c.star]
    w = sky.bright(c.corner.ravel()).reshape(-1, 3, 3)
    poses = Poses.of_triangles(corners, w, field.focal_px, c.mirrored)
    # a triangle's error grows with the distance from it
    middle = corners.mean(1, keepdims=True)
    size2 = np.maximum(np.square(corners - middle).sum((1, 2)) / 3, 1.0)[:, None]
    away2 = np.square(xy - middle).sum(2)
    sigma = np.hypot(field.sigma[: xy.shape[1]], error_px)
    return Hypotheses(poses, own_stars(xy, c.star, sigma), sigma * np.sqrt(1 + away2 / size2))
