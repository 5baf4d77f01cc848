# SPDX-License-Identifier: Apache-2.0
"""The accepted match carried to the faintest stars: all detections against all catalogue stars of the field."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.identification.evidence import TEST_STARS, Prior, log_evidence
from starpos.identification.pairs import close_pairs, mutual_nearest
from starpos.identification.pose import FrameStars, Pose, directions
from starpos.identification.sky import Sky
from starpos.sky.catalogue import Catalogue
from starpos.sky.zones import rows_near

FEWEST_STARS = 4  # an identification has
ENOUGH = np.log(1e9)  # a frame of nothing is taken for some part of the sky once in as many
ROUNDS = 3
# a star is within GATE_SIGMA of its place, and GATE_PX more
LEAST_SPREAD_PX, GATE_SIGMA, GATE_PX = 0.02, 4.0, 0.2
FAINTEST_FIT = 2000  # stars that take part
FLOOR_PX = 0.05  # what a centroid's own error does not tell: the catalogue, the lens
BLEND_PX = 2.5  # closer stars make one image


@dataclass(frozen=True, kw_only=True)
class Identification:
    """Matched stars and the attitude they give.

    star (M,): rows of the input; catalogue (M,): indices of the star catalogue; attitude (3, 3): `Sky`'s directions
    into C; blend_px (M,): how far unresolved neighbours may draw each star's image; focal_scale: factor on the camera's
    focal length; residual_px: rms of one axis, bright stars counting more as they do in the fit; log_odds:
    `log_evidence` of it; mirrored: the frame's rows run bottom-up, all of this holds for the frame flipped.
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
    """The catalogue's stars on a frame, brightest first: index (S,), directions (S, 3), and how far fainter ones that
    melt into them may draw them, blend_px (S,)."""

    index: np.ndarray
    directions: np.ndarray
    blend_px: np.ndarray

    @classmethod
    def of(cls, field: FrameStars, sky: Sky, pose: Pose, most_detections: int) -> "OnFrame":
        """As many as the brightest of the field's detections may be."""
        catalogue, stars = sky.catalogue, min(len(field), most_detections)
        axis = np.append(field.middle / field.focal_px, 1.0) @ pose.attitude
        index = rows_near(catalogue.cell_start, axis, field.radius_rad)
        light = catalogue.vmag_centi[index]
        most = 12 * stars + 300  # three times too many, as the cells reach beyond the frame
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
    """The stars within radius_px (N,) of where a pose has them, fitted, weighed, and carried to the faintest ones.

    None where these are not beyond doubt the stars they were taken for.
    """
    xy, sigma = field.xy[int(near_pose.mirrored), :FAINTEST_FIT], field.sigma[:FAINTEST_FIT]
    stars = OnFrame.of(field, sky, near_pose, TEST_STARS)
    pair = mutual_nearest(xy[:TEST_STARS], near_pose.project(stars.directions), radius_px[:TEST_STARS])
    match = _settled(field, xy[:TEST_STARS], sigma, stars, near_pose, pair)
    if match is None:
        return None
    pose, (star, near), residual = match
    log_odds = log_evidence(
        xy[:TEST_STARS], sigma, field.area_px2, pose, prior, star, near, stars.directions[near]
    )
    if not log_odds >= ENOUGH:  # nor where it is no number
        return None
    if len(xy) > TEST_STARS:
        stars = OnFrame.of(field, sky, pose, FAINTEST_FIT)
        pair = mutual_nearest(xy, pose.project(stars.directions), _gate(residual, sigma))
        match = _settled(field, xy, sigma, stars, pose, pair)
        if match is None:
            return None
        pose, (star, near), residual = match
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
    """The pose fitted to its own pairs, these, their residuals (M, 2) px; None where they are fewer than FEWEST_STARS."""
    for _ in range(ROUNDS):
        star, near = pair
        if len(star) < FEWEST_STARS:
            return None
        w = stars.directions[near]
        pose = _of_these(field.focal_px, pose.mirrored, xy[star], w, np.hypot(sigma[star], FLOOR_PX))
        predicted = pose.project(stars.directions)
        residual = xy[star] - predicted[near]
        pair = mutual_nearest(xy, predicted, _gate(residual, sigma[: len(xy)]))
        if np.array_equal(pair[0], star) and np.array_equal(pair[1], near):
            break
    return pose, (star, near), residual


def _gate(residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """How far from its place a star may be (N,) px, where these are the residuals (M, 2) of some."""
    middling = np.sort(np.abs(residual), axis=None)[residual.size // 2]  # np.median, without its overhead
    return GATE_SIGMA * np.hypot(max(1.4826 * float(middling), LEAST_SPREAD_PX), sigma) + GATE_PX


def _rms(residual: np.ndarray, sigma_px: np.ndarray) -> float:
    """Of one axis of residuals (M, 2), each weighted as in the fit."""
    weight = 1 / np.square(sigma_px)
    return float(np.sqrt(np.square(residual).sum(1) @ weight / (2 * weight.sum())))


def _of_these(focal_px: float, mirrored: bool, xy: np.ndarray, w: np.ndarray, sigma_px: np.ndarray) -> Pose:
    """The pose of matched stars from them alone: to the last bit the same, from wherever the search came to them."""
    v = directions(xy[None], np.array([focal_px]))[0]
    return Pose(rotation.best_rotation(w, v), focal_px, mirrored).fitted(xy, w, sigma_px)


def _resolved(
    catalogue: Catalogue, index: np.ndarray, pixel: np.ndarray, w: np.ndarray, focal_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which stars (brightest first) do not melt into a brighter one (N,), and how far these draw it (N,) px."""
    single, drawn = np.ones(len(index), bool), np.zeros(len(index))
    brighter, fainter = close_pairs(pixel, BLEND_PX)
    if len(fainter):
        ratio = 10 ** (-0.4 * (catalogue.vmag(index[fainter]) - catalogue.vmag(index[brighter])))
        # from the sky and rounded, so that it is the same at every pose
        apart = np.round(focal_px * np.linalg.norm(w[fainter] - w[brighter], axis=1), 6)
        np.add.at(drawn, brighter, apart * ratio / (1 + ratio))
        single[fainter] = False
    return single, drawn
