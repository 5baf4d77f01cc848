# SPDX-License-Identifier: Apache-2.0
"""The PSF of stars whose trail is known, for a frame whose own stars do not determine it well enough."""

from dataclasses import replace

import numpy as np

from starpos.detection.background import Background
from starpos.detection.fit import Fit, fit_stars
from starpos.detection.learn import ALIKE, BRIGHT, FEW, USUAL_SIGMAS, Lesson, reach_of, respond
from starpos.detection.psf import FieldPsf
from starpos.detection.refine import WORTH
from starpos.detection.stamps import Stamps, are_dots, cut
from starpos.detection.trailed import trailed
from starpos.frames.trail import Trail

# px; a shorter trail makes no star longer
SHORTEST_PX = 1.0
# A long star has its peaks off its middle: a fit from there takes longer.
ROUNDS = 10
# Where trails differ over the frame the highest peaks belong to the shortest: factor by which more peaks are looked at.
MORE = 4
# Factors by which the width is sought further, after the usual ones.
FINER = 2**0.5, 2**0.25
# Unknowns of a learnt Gaussian; minimum decrease of chi-square against a width that is not learnt from stars.
OF_SHAPE, CLEAR = 3, 10.0


def with_trail(
    lesson: Lesson,
    plane: np.ndarray,
    background: Background,
    x: np.ndarray,
    y: np.ndarray,
    saturation: float,
    trail: Trail,
) -> Lesson:
    """The Lesson with a PSF along a Trail where fewer than ALIKE stars have taught, and it fits no worse.

    Where the camera rolled, so that each star has its own trail, also where more have taught, and it fits better.
    x, y (N,) int px: the peaks, highest first.  Across the trail it is as wide as fits best.  What few stars have taught
    may fit better by as much as its own unknowns are worth.
    """
    size = background.width, background.height
    differ = trail.varies_px(*size) > SHORTEST_PX
    taught = lesson.teachers >= ALIKE
    if not differ and (taught or np.hypot(*trail.middle_px) < SHORTEST_PX):
        return lesson
    few = FEW * MORE if differ else FEW
    peaks = np.flatnonzero(~are_dots(plane, background, x[: 10 * few], y[: 10 * few]))[:few]
    own = float(np.sqrt(np.linalg.eigvalsh(lesson.psf.shape)[0]))
    tried = [trailed(sigma, trail, *size) for sigma in (own, *USUAL_SIGMAS)]
    stamps = cut(plane, background, x[peaks], y[peaks], max(map(reach_of, (lesson.psf, *tried))), saturation)

    def fitted(psf: FieldPsf) -> Fit:
        start = stamps.x.astype(float), stamps.y.astype(float)
        return fit_stars(stamps, psf, *start, lesson.response, ROUNDS, leverage=True, whole=True)

    fits = [fitted(lesson.psf), *map(fitted, tried)]
    for factor in FINER:
        best = tried[int(np.argmin(_left(stamps, fits, lesson)[1:]))]
        finer = [trailed(best.sigma * f, trail, *size) for f in (factor, 1 / factor)]
        tried, fits = tried + finer, fits + [fitted(psf) for psf in finer]
    left = _left(stamps, fits, lesson)
    best_of = int(np.argmin(left[1:]))
    unknowns = OF_SHAPE + np.count_nonzero(lesson.psf.at(x[:1].astype(float), y[:1].astype(float)).series) - 1
    allowed = 0.0 if taught else WORTH * unknowns if lesson.teachers else -CLEAR
    # 0 of no stamp
    if not (left[0] > 0 and left[1 + best_of] < left[0] + allowed):
        return lesson
    psf, fit, response = tried[best_of], fits[1 + best_of], lesson.response
    sound = (fit.flux > BRIGHT * fit.flux_sigma) & np.isfinite(fit.covariance).all((1, 2))
    if sound.any():
        response = respond(stamps.take(sound), psf, fit.x[sound], fit.y[sound], fit, sound, response)
    return replace(lesson, psf=psf, response=response, reach=reach_of(psf))


def _left(stamps: Stamps, fits: list[Fit], lesson: Lesson) -> np.ndarray:
    """Chi-square that fits with different PSFs leave in the same stamps, by the noise of the first one's light."""
    noise2 = lesson.response.variance(stamps.noise, fits[0].model)
    left = np.array([(stamps.good * fit.residual**2 / noise2).sum((1, 2)) for fit in fits])
    return left[:, np.isfinite(left).all(0)].sum(1)
