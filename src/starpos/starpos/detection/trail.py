# SPDX-License-Identifier: Apache-2.0
"""The PSF of stars whose trail is known, for a frame with too few of them to learn it from."""

from dataclasses import replace

import numpy as np

from starpos.detection.background import Background
from starpos.detection.fit import Fit, fit_stars
from starpos.detection.learn import ALIKE, BRIGHT, FEW, USUAL_SIGMAS, Lesson, reach_of, respond
from starpos.detection.psf import trailed
from starpos.detection.refine import WORTH
from starpos.detection.stamps import Stamps, are_dots, cut

# px; a shorter trail makes no star longer
SHORTEST_PX = 1.0
# A long star has its peaks off its middle: a fit from there takes longer.
ROUNDS = 10
# Unknowns of a learnt Gaussian; and by how much chi-square must be lower than that of a width that no star has taught.
OF_SHAPE, CLEAR = 3, 10.0


def with_trail(
    lesson: Lesson,
    plane: np.ndarray,
    background: Background,
    x: np.ndarray,
    y: np.ndarray,
    saturation: float,
    trail: np.ndarray,
) -> Lesson:
    """The Lesson with a PSF along a trail (2,) px where fewer than ALIKE stars have taught, and it fits no worse.

    x, y (N,) int px: the peaks, highest first.  Across the trail it is as wide as what was learnt, or as usual.  What
    was learnt may fit better by as much as its own unknowns are worth.
    """
    if lesson.teachers >= ALIKE or np.linalg.norm(trail) < SHORTEST_PX:
        return lesson
    peaks = np.flatnonzero(~are_dots(plane, background, x[: 10 * FEW], y[: 10 * FEW]))[:FEW]
    across = np.array([-trail[1], trail[0]]) / np.linalg.norm(trail)
    own = float(np.sqrt(across @ lesson.psf.shape @ across))
    psfs = [lesson.psf, *(trailed(sigma, trail) for sigma in (own, *USUAL_SIGMAS))]
    stamps = cut(plane, background, x[peaks], y[peaks], max(map(reach_of, psfs)), saturation)
    begin = stamps.x.astype(float), stamps.y.astype(float)
    fits = [
        fit_stars(stamps, psf, *begin, lesson.response, ROUNDS, leverage=True, whole=True) for psf in psfs
    ]
    left = _left(stamps, fits, lesson)
    best = int(np.argmin(left[1:])) + 1
    unknowns = OF_SHAPE + np.count_nonzero(lesson.psf.series) - 1
    allowed = WORTH * unknowns if lesson.teachers else -CLEAR
    # 0 of no stamp
    if not (left[0] > 0 and left[best] < left[0] + allowed):
        return lesson
    psf, fit, response = psfs[best], fits[best], lesson.response
    sound = (fit.flux > BRIGHT * fit.flux_sigma) & np.isfinite(fit.covariance).all((1, 2))
    if sound.any():
        response = respond(stamps.take(sound), psf, fit.x[sound], fit.y[sound], fit, sound, response)
    return replace(lesson, psf=psf, response=response, reach=reach_of(psf))


def _left(stamps: Stamps, fits: list[Fit], lesson: Lesson) -> np.ndarray:
    """Chi-square that fits with different PSFs leave in the same stamps, by the noise of the first one's light."""
    noise2 = lesson.response.variance(stamps.noise, fits[0].model)
    left = np.array([(stamps.good * fit.residual**2 / noise2).sum((1, 2)) for fit in fits])
    return left[:, np.isfinite(left).all(0)].sum(1)
