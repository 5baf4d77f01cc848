# SPDX-License-Identifier: Apache-2.0
"""If too few stars are detected to decide, look in the frame itself for light where fainter stars should be.

A pose that its stars make likely, but not likely enough, says where the catalogue's other stars are. Each of these places
is compared with those around it, where a star is as likely to be if the pose is wrong. The evidence is the ratio of the
probabilities of that comparison. So its mean is at most 1 if the pose is wrong, for any noise of the frame. It looks only
where nothing was detected, so it multiplies with the evidence of the detections.
"""

from collections.abc import Callable

import numpy as np

from starpos.identification._frame import FrameStars
from starpos.identification.full import Identification, OnFrame
from starpos.identification.pose import TEST_STARS, Pose
from starpos.identification.search import STAGES, Priors, near_or_lost
from starpos.identification.sky import Sky
from starpos.instrument.camera import Camera

# What a frame shows at pixels x, y (N,), in sigma of a normal distribution by rank, and the SNR; NaN where it cannot say.
Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
# Log-odds from which a pose is looked at, and those that accept it with what the look finds. For random points the
# largest evidence of the detections exceeds y in 1 of y frames. So its product with the look's exceeds x in
# (1 + log(x / y)) / x of the frames, with y the evidence from which one looks: 0.1 in 1e9 frames. The first try adds 1 in
# 1e9, the evenly spread stars (SECOND_TRY in search.py) 0.1: all tries with one list of stars are wrong in 1.2 in 1e9.
MIN_LOG_ODDS_TO_LOOK, MIN_LOG_ODDS_WITH_LOOK = 5.0, 26.2
MAX_LOOKS = 20
# Places nearer to a detection add no information; places nearer to a brighter catalogue star show that star's light.
DETECTED_PX, NEAR_PX = 8.0, 6.0
# Brightness of stars over the prediction from identified ones (common to all), probability that a star is missing, and
# maximum and minimum expected signal in sigma. Brighter detections add no evidence; fainter stars are not looked for.
BRIGHTNESS, MISSING, HIGHEST, LOWEST = np.array([0.25, 0.5, 0.8, 1.2]), 0.25, 2.5, 0.5


def second_look(
    field: FrameStars, sky: Sky, priors: Priors, camera: Camera, look: Look
) -> Identification | None:
    """Identify a frame whose stars are too few, by the light at the places of others.

    field, priors  as `identify_frame` takes them; the field is in the camera's pixels, without refraction
    """
    seen: set[tuple[bytes, bytes]] = set()
    for found in near_or_lost(field, sky, priors, STAGES, MIN_LOG_ODDS_TO_LOOK):
        pairs = found.star.tobytes(), found.catalogue.tobytes()
        if pairs in seen:
            continue
        seen.add(pairs)
        log_odds = found.log_odds + _log_ratio(field, sky, camera, found, look)
        if log_odds >= MIN_LOG_ODDS_WITH_LOOK:
            return found.but(log_odds=log_odds)
        if len(seen) == MAX_LOOKS:
            break
    return None


def _log_ratio(field: FrameStars, sky: Sky, camera: Camera, found: Identification, look: Look) -> float:
    """The logarithm of the evidence for an identification by what was not detected."""
    pose = Pose(found.attitude, field.focal_px * found.focal_scale, found.mirrored)
    due = OnFrame.of(field, sky, pose, TEST_STARS)
    xy, detected = pose.project(due.directions), field.xy[int(found.mirrored)]
    alone = np.linalg.norm(xy[:, None] - detected, axis=2).min(1) > DETECTED_PX
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    # rows are sorted: the brighter ones come first
    alone &= ~np.tril(apart < NEAR_PX, -1).any(1)
    _, snr = look(*_pixels(sky.directions(found.catalogue), camera, found))
    lights = (snr * 10 ** (0.4 * sky.catalogue.vmag(found.catalogue)))[~np.isnan(snr)]
    light = np.median(lights) if len(lights) else 0.0
    expected = light * 10 ** (-0.4 * sky.catalogue.vmag(due.index))
    rows = np.flatnonzero(alone & (expected * BRIGHTNESS.max() > LOWEST))
    height, _ = look(*_pixels(due.directions[rows], camera, found))
    said = ~np.isnan(height)
    return log_ratio(height[said], expected[rows[said]])


def log_ratio(height: np.ndarray, expected: np.ndarray) -> float:
    """The logarithm of how much likelier heights (N,), in sigma, are with stars of the expected heights than without."""
    high = np.minimum(BRIGHTNESS[:, None] * expected, HIGHEST)
    ratio = MISSING + (1 - MISSING) * np.exp(high * height - high**2 / 2)
    return float(np.logaddexp.reduce(np.log(ratio).sum(1)) - np.log(len(BRIGHTNESS)))


def _pixels(w: np.ndarray, camera: Camera, found: Identification) -> tuple[np.ndarray, np.ndarray]:
    """Pixels x, y (N,) on the camera's frame of `Sky`'s directions w (N, 3)."""
    x, y = camera.scaled(found.focal_scale).project(w @ found.attitude.T).T
    return x, camera.height - 1 - y if found.mirrored else y
