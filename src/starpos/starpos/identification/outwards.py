# SPDX-License-Identifier: Apache-2.0
"""Extend the identification of a part of a fisheye's frame to the whole of it, and find out its lens on the way.

Stars near identified ones are matched first. Each ring of them improves the lens (focal length, axis and distortion),
which then predicts the next ring.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.identification.full import FAINTEST_FIT, GATE_SIGMA, MIN_STARS, Identification, OnFrame
from starpos.identification.pairs import mutual_nearest
from starpos.identification.sky import Sky
from starpos.identification.wide import FAR_PX, FLIP, LensPose, Part, WideField, error_px, spread_px, stars_on
from starpos.instrument.camera import Camera

# Prior of an unknown lens, 1 sigma: the position of the axis in focal lengths (x, y), k1 and k2.
PRIOR = np.array([0.08, 0.08, 0.06, 0.02])
# Terms of a fit: rotations, logarithm of the focal length, and the terms of PRIOR. Size and number of its steps.
TERMS, STEP, STEPS = 8, 1e-6, 3
# Radius about the part's middle in which stars are matched first, its growth in each round, number of final rounds.
FIRST_RAD, NEXT_RAD, LAST_ROUNDS = math.radians(32), math.radians(15), 2
# Maximum distance of a star from its predicted place (focal lengths), in addition to the residuals' spread.
GATE_RAD, MIN_SPREAD_PX = 0.004, 0.2
# Stars beyond the part bear it out if chance makes as many pairs as seldom as this (logarithm).
LOG_CHANCE = math.log(1e-6)


@dataclass(frozen=True)
class Outwards:
    """A camera fitted to its stars, the identification of a frame, and whether stars beyond the part bear it out.

    If they do not, the camera and the identification stay as the part gave them.
    """

    camera: Camera
    found: Identification
    borne_out: bool


def outwards(field: WideField, sky: Sky, part: Part, found: Identification) -> Outwards | None:
    """Extend the identification of a part; None if the lens does not have in their places the stars of the part."""
    flip = FLIP if found.mirrored else np.eye(3)
    attitude = flip @ part.turn.T @ flip @ found.attitude
    pose = LensPose(field.camera.scaled(found.focal_scale), attitude, found.mirrored)
    xy = np.nan_to_num(field.camera.project(field.directions[:FAINTEST_FIT]), nan=FAR_PX)
    sigma, beyond = field.sigma_px[:FAINTEST_FIT], ~np.isin(np.arange(len(xy)), part.row)
    star, index = part.row[found.star], found.catalogue
    star, index = star[star < len(xy)], index[star < len(xy)]
    w = sky.directions(index)
    middle = part.turn[2] * [1, -1, 1] if found.mirrored else part.turn[2]
    rounds = math.ceil((math.pi - FIRST_RAD) / NEXT_RAD) + LAST_ROUNDS
    inner: Outwards | None = None
    for k in range(rounds):
        error = np.hypot(sigma[star], error_px(xy[star] - pose.project(w)))
        pose = _fitted(pose, field.camera, xy[star], w, error)
        spread = max(spread_px(xy[star] - pose.project(w)), MIN_SPREAD_PX)
        gate = GATE_SIGMA * np.hypot(spread, sigma) + GATE_RAD * pose.camera.fx
        near = stars_on(pose, sky, len(xy))
        reach = math.cos(min(FIRST_RAD + k * NEXT_RAD, math.pi))
        near = _within(near, near.directions @ pose.attitude.T @ middle > reach)
        pair = np.stack(mutual_nearest(xy, pose.project(near.directions), gate))
        if pair.shape[1] < MIN_STARS:
            return None
        star, w = pair[0], near.directions[pair[1]]
        if inner is None:
            inner = _answer(field, pose, xy, near, pair, found, False)
    if _borne_out(int(beyond[star].sum()), xy[beyond], len(near.index), gate[beyond]):
        return _answer(field, pose, xy, near, pair, found, True)
    return inner


def _answer(
    field: WideField,
    pose: LensPose,
    xy: np.ndarray,
    there: OnFrame,
    pair: np.ndarray,
    found: Identification,
    borne_out: bool,
) -> Outwards:
    whole = replace(field, camera=pose.camera)
    return Outwards(pose.camera, pose.identified(whole, xy, there, pair, found), borne_out)


def _within(there: OnFrame, which: np.ndarray) -> OnFrame:
    return OnFrame(there.index[which], there.directions[which], there.blend_px[which])


def _borne_out(pairs: int, xy: np.ndarray, places: int, gate: np.ndarray) -> bool:
    """Whether this number of pairs of stars xy (n, 2) and places, within gate (n,) px, is more than chance makes."""
    if pairs == 0:
        return False
    area = float(np.prod(np.ptp(xy, axis=0))) * math.pi / 4
    expected = places * float(np.square(gate).sum()) * math.pi / max(area, 1.0)
    return pairs > expected and _log_tail(pairs, expected) < LOG_CHANCE


def _log_tail(count: int, expected: float) -> float:
    """Chernoff's bound of the logarithm of the probability of `count` or more events."""
    return count - expected - count * math.log(count / expected) if expected > 0 else -math.inf


def _fitted(pose: LensPose, given: Camera, xy: np.ndarray, w: np.ndarray, error: np.ndarray) -> LensPose:
    """Fit pose and lens to pixels xy (n, 2), with errors (n,) px, of directions w (n, 3), and to PRIOR about `given`."""
    for _ in range(STEPS):
        here = pose.project(w)
        ahead = [_moved(pose, step).project(w) for step in np.eye(TERMS) * STEP]
        slope = (np.stack(ahead, -1) - here[..., None]) / STEP
        on = np.isfinite(slope).all((1, 2))
        j = (slope[on] / error[on, None, None]).reshape(-1, TERMS)
        prior = np.hstack([np.zeros((len(PRIOR), TERMS - len(PRIOR))), np.diag(1 / PRIOR)])
        target = np.append(
            ((xy - here)[on] / error[on, None]).ravel(), _from_prior(pose.camera, given) / PRIOR
        )
        step = np.linalg.lstsq(np.vstack([j, prior]), target, rcond=None)[0]
        pose = _moved(pose, step)
        if np.abs(step).max() < STEP:
            break
    return pose


def _from_prior(camera: Camera, given: Camera) -> np.ndarray:
    """How far (4,) a camera has still to go to `given`, in the terms of PRIOR."""
    axis = (given.cx - camera.cx) / camera.fx, (given.cy - camera.cy) / camera.fx
    return np.array([*axis, *np.subtract(given.distortion[:2], camera.distortion[:2])])


def _moved(pose: LensPose, step: np.ndarray) -> LensPose:
    """The pose turned, its focal length longer, axis elsewhere and lens another by the terms (TERMS,) of a step."""
    c = pose.camera
    k1, k2, *rest = c.distortion
    camera = replace(
        c,
        fx=c.fx * (1 + step[3]),
        fy=c.fy * (1 + step[3]),
        cx=c.cx + c.fx * step[4],
        cy=c.cy + c.fx * step[5],
        distortion=(k1 + step[6], k2 + step[7], *rest),
    )
    return replace(pose, camera=camera, attitude=rotation.from_vector(step[:3]) @ pose.attitude)
