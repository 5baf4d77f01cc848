# SPDX-License-Identifier: Apache-2.0
"""How much the air dims the stars, from the identified stars of a night whose altitudes are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.calibration.plumb_line import huber
from starpos.fix.searching import Sight
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.units import SIGMA_PER_MAD

# stars that are brighter by this than the faintest identified ones are detected however their brightness errs
SURELY_DETECTED_MAG = 1.0
# the lowest altitude whose light is used, deg, and the fewest stars
LOWEST_DEG, FEWEST = 5.0, 60
# neighbours share what is not modelled of lens and sky: patches of 1 / PATCHES focal lengths count as one star each, and
# this many are needed
PATCHES, FEWEST_PATCHES = 4, 15
# an error (mag per air mass) beyond which it is unknown; so it is where brightness does not follow light to this share
UNKNOWN_MAG, LINEAR = 0.1, 0.2
# share by which the air mass of low stars may differ from the law of any night
LAW = 0.05
ROUNDS = 10


@at_once
@dataclass(frozen=True)
class Light:
    """N identified stars: V by the catalogue, magnitude by the frame, air mass, places (N, 2) in focal lengths."""

    v: np.ndarray
    measured: np.ndarray
    air_mass: np.ndarray
    off: np.ndarray


def air_mass(altitude_deg: np.ndarray) -> np.ndarray:
    """Air masses at altitudes as they are seen, above 0 (Pickering 2002)."""
    h = np.maximum(altitude_deg, 0.0)
    return np.asarray(1 / np.sin(np.radians(h + 244 / (165 + 47 * h**1.1))))


def light_of(sight: Sight, camera: Camera) -> Light:
    """The sound identified stars of a frame whose attitude at a known place is known."""
    stars, solution = sight.stars, sight.solution
    assert solution.at_place is not None and solution.star is not None
    row, v = np.asarray(solution.star, int), np.asarray(solution.magnitudes, float)
    up = camera.directions(stars.x[row], stars.y[row]) @ solution.at_place.optics.rotation[2]
    altitude = np.degrees(np.arcsin(np.clip(up, -1, 1)))
    good = np.isfinite(v) & (stars.flags[row] == 0) & (stars.flux[row] > 0) & (altitude > LOWEST_DEG)
    row, v, altitude = row[good], v[good], altitude[good]
    off = np.stack([(stars.x[row] - camera.cx) / camera.fx, (stars.y[row] - camera.cy) / camera.fy], -1)
    return Light(v, -2.5 * np.log10(stars.flux[row]), air_mass(altitude), off)


def extinction(lights: Sequence[Light]) -> tuple[float, float]:
    """Extinction in mag per air mass and its error, by frames of one camera and night; NaN where they do not show it.

    The vignetting, a polynomial of the radius, is fitted too, and how much each frame is dimmed as a whole, as by dew.
    """
    v, measured, mass, off = (
        np.concatenate([getattr(f, name) for f in lights]) for name in ("v", "measured", "air_mass", "off")
    )
    unknown = np.nan, np.nan
    if len(v) < FEWEST:
        return unknown
    frame = np.repeat(range(len(lights)), [len(light.v) for light in lights])
    bright = np.concatenate(
        [light.v < np.percentile(light.v, 95) - SURELY_DETECTED_MAG for light in lights if len(light.v)]
    )
    patch = np.unique(np.floor(off[bright] * PATCHES), axis=0, return_inverse=True)[1].ravel()
    if bright.sum() < FEWEST or patch.max() < FEWEST_PATCHES:
        return unknown
    r2 = np.square(off[bright]).sum(1)
    zero = frame[bright, None] == np.unique(frame[bright])
    design = np.column_stack([mass[bright], v[bright], r2, r2**2, zero])
    target, weight = measured[bright], np.ones(len(r2))
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        left = target - design @ found
        weight = huber(left / max(SIGMA_PER_MAD * float(np.median(np.abs(left))), 1e-6))
    inverse = np.linalg.pinv(design.T @ (design * weight[:, None] ** 2))
    pulls = np.zeros((patch.max() + 1, design.shape[1]))
    np.add.at(pulls, patch, design * (weight**2 * left)[:, None])
    free = len(pulls) / max(len(pulls) - design.shape[1], 1)
    sigma = np.sqrt(free * np.diag(inverse @ pulls.T @ pulls @ inverse))
    if sigma[0] > UNKNOWN_MAG or abs(found[1] - 1) > LINEAR or found[0] < -2 * sigma[0]:
        return unknown
    return float(found[0]), float(np.hypot(sigma[0], LAW * found[0]))
