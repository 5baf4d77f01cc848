# SPDX-License-Identifier: Apache-2.0
"""Verify a pose by a frame's stars, and match all detections with all catalogue stars of the field."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from starpos.core.poses import Rules, fitted, settled
from starpos.identification.evidence import Prior, log_evidence
from starpos.identification.pose import SMALL_STEP, STEPS, FrameStars, Pose
from starpos.identification.sky import Sky
from starpos.normal import SIGMA_PER_MAD

# An identification has at least so many stars.
FEWEST_STARS = 4
# Log-odds: at most one of 1e9 frames without stars is identified.
ENOUGH = np.log(1e9)
ROUNDS = 3
# A star may be GATE_SIGMA of the spread from its place, plus GATE_PX; the spread is at least LEAST_SPREAD_PX.
LEAST_SPREAD_PX, GATE_SIGMA, GATE_PX = 0.02, 4.0, 0.2
# So many of the brightest detections take part.
FAINTEST_FIT = 2000
# Errors of catalogue and lens, which a centroid's own error does not include.
FLOOR_PX = 0.05
# Where the residuals spread more, the lens bends: then all stars count alike, or the brightest few would decide.
BENT_PX = 0.3
# Closer stars make one image.
BLEND_PX = 2.5
# Stars so far beyond the frame (px) are on it, and a star so near its edge may be cut off.
EDGE_PX, INSIDE_PX = 2.0, 5.0


RULES = Rules(
    rounds=ROUNDS,
    fewest_stars=FEWEST_STARS,
    steps=STEPS,
    small_step=SMALL_STEP,
    floor_px=FLOOR_PX,
    sigma_per_mad=SIGMA_PER_MAD,
    least_spread_px=LEAST_SPREAD_PX,
    gate_sigma=GATE_SIGMA,
    gate_px=GATE_PX,
    edge_px=EDGE_PX,
    inside_px=INSIDE_PX,
    blend_px=BLEND_PX,
)


@dataclass(frozen=True, kw_only=True)
class Identification:
    """M matched stars and the attitude they give.

    star             (M,): rows of the input
    catalogue        (M,): rows of the star catalogue
    blend_px         (M,): how far unresolved neighbours may move each star's image
    attitude         (3, 3): `Sky`'s directions into C
    focal_scale      factor on the camera's focal length
    residual_px      rms along one axis, with the weights of the fit
    mean_square_px2  of the residuals along one axis, all alike
    log_odds         of the identification, by `log_evidence`
    expected         (E,): rows of the catalogue's stars well inside the frame, brightest first
    mirrored         whether the frame's rows run bottom-up; the attitude is that of the flipped frame
    """

    star: np.ndarray
    catalogue: np.ndarray
    blend_px: np.ndarray
    attitude: np.ndarray
    focal_scale: float
    residual_px: float
    mean_square_px2: float
    log_odds: float
    expected: np.ndarray
    mirrored: bool


@dataclass(frozen=True)
class OnFrame:
    """S catalogue stars on a frame, brightest first.

    index       (S,): rows of the star catalogue
    directions  (S, 3)
    blend_px    (S,): how far fainter stars that make one image with them may move it
    """

    index: np.ndarray
    directions: np.ndarray
    blend_px: np.ndarray

    @classmethod
    def of(cls, field: FrameStars, sky: Sky, pose: Pose, most_detections: int) -> "OnFrame":
        """The stars that the field's brightest detections may be, at most `most_detections` of them."""
        found = sky.stars.on_frame(
            field.compiled,
            pose.attitude,
            pose.focal_px,
            sky.years,
            sky.velocity,
            EDGE_PX,
            *most_stars(min(len(field), most_detections)),
            BLEND_PX,
        )
        return cls(*found)


def most_stars(detections: int) -> tuple[int, int]:
    """How many catalogue stars so many detections may be, and of how many of the brightest about the frame."""
    # three times too many again, because the cells reach beyond the frame
    return 3 * detections + 50, 12 * detections + 300


class Match(NamedTuple):
    """Stars on which a pose has settled.

    attitude, focal_px  the pose
    star                (M,): rows of the detections
    rank                (M,): brightness rank on the frame of the catalogue stars matched with them
    directions          (M, 3) of these
    index               (M,): their rows in the catalogue
    blend_px            (M,): how far fainter stars that make one image with them may move it
    expected            (E,): rows of the catalogue's stars well inside the frame, brightest first
    spread_px           standard deviation that the median of the residuals shows
    rms_px              of the residuals along one axis, with the weights of the fit
    mean_square_px2     of the residuals along one axis, all alike
    """

    attitude: np.ndarray
    focal_px: float
    star: np.ndarray
    rank: np.ndarray
    directions: np.ndarray
    index: np.ndarray
    blend_px: np.ndarray
    expected: np.ndarray
    spread_px: float
    rms_px: float
    mean_square_px2: float


def identified(
    field: FrameStars, sky: Sky, near_pose: Pose, radius_px: np.ndarray, prior: Prior
) -> Identification | None:
    """Identify a frame's stars, starting from those within radius_px (N,) of their places by a pose near the right one.

    None unless the evidence is beyond doubt (ENOUGH).
    """
    mirrored, tested = near_pose.mirrored, min(len(field), field.tested)
    match = _settled(field, sky, tested, near_pose, radius_px)
    if match is None:
        return None
    pose = Pose(match.attitude, match.focal_px, mirrored)
    xy, sigma = field.xy[int(mirrored), :tested], field.sigma[:tested]
    log_odds = log_evidence(
        xy, sigma, field.area_px2, pose, prior, match.star, match.rank, match.directions
    )
    # true for NaN too
    if not log_odds >= ENOUGH:
        return None
    if len(field) > tested:
        most = min(len(field), FAINTEST_FIT)
        gate_px = GATE_SIGMA * np.hypot(max(match.spread_px, LEAST_SPREAD_PX), field.sigma[:most]) + GATE_PX
        match = _settled(field, sky, most, pose, gate_px)
        if match is None:
            return None
    if match.spread_px > BENT_PX:
        match = _all_alike(field, mirrored, match)
    return Identification(
        star=match.star,
        catalogue=match.index,
        blend_px=match.blend_px,
        attitude=match.attitude,
        focal_scale=match.focal_px / field.focal_px,
        residual_px=match.rms_px,
        mean_square_px2=match.mean_square_px2,
        log_odds=log_odds,
        expected=match.expected,
        mirrored=mirrored,
    )


def _settled(field: FrameStars, sky: Sky, most: int, pose: Pose, radius_px: np.ndarray) -> Match | None:
    """Match the `most` brightest within radius_px (most,) of their places by a pose, fit it, and match again.

    None if there are fewer than FEWEST_STARS pairs.
    """
    found = settled(
        field.compiled,
        sky.stars,
        pose.mirrored,
        most,
        pose.attitude,
        pose.focal_px,
        radius_px,
        sky.years,
        sky.velocity,
        *most_stars(most),
        RULES,
    )
    return None if found is None else Match(*found)


def _all_alike(field: FrameStars, mirrored: bool, match: Match) -> Match:
    """The match with the pose to which all stars count alike."""
    xy, w = field.xy[int(mirrored), match.star], match.directions
    sigma = field.sigma[match.star]
    attitude, focal_px = fitted(
        xy, w, np.hypot(sigma, match.spread_px), match.attitude, field.focal_px, True, STEPS, SMALL_STEP
    )
    square = np.square(xy - Pose(attitude, focal_px, mirrored).project(w)).sum(1)
    weight = 1 / (sigma**2 + FLOOR_PX**2)
    return match._replace(
        attitude=attitude,
        focal_px=focal_px,
        rms_px=float(np.sqrt(square @ weight / (2 * weight.sum()))),
        mean_square_px2=float(square.mean() / 2),
    )
