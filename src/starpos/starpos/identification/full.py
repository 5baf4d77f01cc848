# SPDX-License-Identifier: Apache-2.0
"""Verify a pose by a frame's stars, and match all detections with all catalogue stars of the field."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.identification.evidence import Prior, log_evidence
from starpos.identification.pairs import close_pairs, mutual_nearest
from starpos.identification.pose import FrameStars, Pose, directions
from starpos.identification.sky import Sky
from starpos.normal import SIGMA_PER_MAD
from starpos.sky.catalogue import Catalogue
from starpos.sky.zones import rows_near

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

Pairs = tuple[np.ndarray, np.ndarray]  # rows of the detections and of the stars matched with them


@dataclass(frozen=True, kw_only=True)
class Identification:
    """M matched stars and the attitude they give.

    star         (M,): rows of the input
    catalogue    (M,): rows of the star catalogue
    blend_px     (M,): how far unresolved neighbours may move each star's image
    attitude     (3, 3): `Sky`'s directions into C
    focal_scale  factor on the camera's focal length
    residual_px  rms along one axis, with the weights of the fit
    log_odds     of the identification, by `log_evidence`
    mirrored     whether the frame's rows run bottom-up; the attitude is that of the flipped frame
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
        catalogue, stars = sky.catalogue, min(len(field), most_detections)
        axis = np.append(field.middle / field.focal_px, 1.0) @ pose.attitude
        index = rows_near(catalogue.cell_start, axis, field.radius_rad)
        light = catalogue.vmag_centi[index]
        # three times too many, because the cells reach beyond the frame
        most = 12 * stars + 300
        if len(index) > most:
            brightest = np.argpartition(light, most)[:most]
            index, light = index[brightest], light[brightest]
        index = index[np.argsort(light, kind="stable")]
        w = sky.directions(index)
        pixel = pose.project(w)
        on = np.flatnonzero(field.holds(pixel))[: 3 * stars + 50]
        single, drawn = _resolved(catalogue, index[on], pixel[on], w[on], field.focal_px)
        on = on[single]
        return cls(index[on], w[on], drawn[single])


def identified(
    field: FrameStars, sky: Sky, near_pose: Pose, radius_px: np.ndarray, prior: Prior
) -> Identification | None:
    """Identify a frame's stars, starting from those within radius_px (N,) of their places by a pose near the right one.

    None unless the evidence is beyond doubt (ENOUGH).
    """
    xy, sigma = field.xy[int(near_pose.mirrored), :FAINTEST_FIT], field.sigma[:FAINTEST_FIT]
    tested = xy[: field.tested]
    stars = OnFrame.of(field, sky, near_pose, field.tested)
    pair = mutual_nearest(tested, near_pose.project(stars.directions), radius_px[: field.tested])
    match = _settled(field, tested, sigma, stars, near_pose, pair)
    if match is None:
        return None
    pose, (star, near), residual = match
    log_odds = log_evidence(tested, sigma, field.area_px2, pose, prior, star, near, stars.directions[near])
    # true for NaN too
    if not log_odds >= ENOUGH:
        return None
    if len(xy) > len(tested):
        stars = OnFrame.of(field, sky, pose, FAINTEST_FIT)
        pair = mutual_nearest(xy, pose.project(stars.directions), _gate(residual, sigma))
        match = _settled(field, xy, sigma, stars, pose, pair)
        if match is None:
            return None
        pose, (star, near), residual = match
    spread = _spread(residual)
    if spread > BENT_PX:
        w, error = stars.directions[near], np.hypot(sigma[star], spread)
        pose = _fitted_alone(field.focal_px, pose.mirrored, xy[star], w, error)
        residual = xy[star] - pose.project(w)
    return Identification(
        star=star,
        catalogue=stars.index[near],
        blend_px=stars.blend_px[near],
        attitude=pose.attitude,
        focal_scale=pose.focal_px / field.focal_px,
        residual_px=_rms(residual, np.hypot(sigma[star], FLOOR_PX)),
        log_odds=log_odds,
        mirrored=pose.mirrored,
    )


def _settled(
    field: FrameStars,
    xy: np.ndarray,
    sigma: np.ndarray,
    stars: OnFrame,
    pose: Pose,
    pair: tuple[np.ndarray, np.ndarray],
) -> tuple[Pose, tuple[np.ndarray, np.ndarray], np.ndarray] | None:
    """Fit a pose to pairs and match again, until the pairs no longer change.

    Returns the pose, the pairs and their residuals (M, 2) px; None if there are fewer than FEWEST_STARS pairs.
    """
    for _ in range(ROUNDS):
        star, near = pair
        if len(star) < FEWEST_STARS:
            return None
        w = stars.directions[near]
        pose = _fitted_alone(field.focal_px, pose.mirrored, xy[star], w, np.hypot(sigma[star], FLOOR_PX))
        predicted = pose.project(stars.directions)
        residual = xy[star] - predicted[near]
        pair = mutual_nearest(xy, predicted, _gate(residual, sigma[: len(xy)]))
        if np.array_equal(pair[0], star) and np.array_equal(pair[1], near):
            break
    return pose, (star, near), residual


def _gate(residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Largest distance (N,) px of each star from its place, from the residuals (M, 2) of the stars matched so far."""
    return GATE_SIGMA * np.hypot(max(_spread(residual), LEAST_SPREAD_PX), sigma) + GATE_PX


def _spread(residual: np.ndarray) -> float:
    """Standard deviation (px) that the median of residuals (M, 2) shows."""
    # np.median, without its overhead
    return SIGMA_PER_MAD * float(np.sort(np.abs(residual), axis=None)[residual.size // 2])


def _rms(residual: np.ndarray, sigma_px: np.ndarray) -> float:
    """Root mean square of residuals (M, 2) along one axis, with the weights of the fit."""
    weight = 1 / np.square(sigma_px)
    return float(np.sqrt(np.square(residual).sum(1) @ weight / (2 * weight.sum())))


def _fitted_alone(
    focal_px: float, mirrored: bool, xy: np.ndarray, w: np.ndarray, sigma_px: np.ndarray
) -> Pose:
    """Fit the pose to matched stars without a starting pose, so that the result does not depend on the search."""
    v = directions(xy[None], np.array([focal_px]))[0]
    return Pose(rotation.best_rotation(w, v), focal_px, mirrored).fitted(xy, w, sigma_px)


def _resolved(
    catalogue: Catalogue, index: np.ndarray, pixel: np.ndarray, w: np.ndarray, focal_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which stars (N,), brightest first, are not blended with a brighter one; how far fainter ones move them (px)."""
    single, drawn = np.ones(len(index), bool), np.zeros(len(index))
    brighter, fainter = close_pairs(pixel, BLEND_PX)
    if len(fainter):
        ratio = 10 ** (-0.4 * (catalogue.vmag(index[fainter]) - catalogue.vmag(index[brighter])))
        # from directions and rounded, so that it does not depend on the pose
        apart = np.round(focal_px * np.linalg.norm(w[fainter] - w[brighter], axis=1), 6)
        np.add.at(drawn, brighter, apart * ratio / (1 + ratio))
        single[fainter] = False
    return single, drawn
