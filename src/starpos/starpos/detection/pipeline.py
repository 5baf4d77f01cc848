# SPDX-License-Identifier: Apache-2.0
"""From a frame to its stars: background, peaks, the frame's PSF, a fit of each star, and what is no star left out."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import spatial

from starpos.detection.background import measure_background
from starpos.detection.finding import find_peaks
from starpos.detection.fit import fit_stars
from starpos.detection.learn import centroid, grey, learn
from starpos.detection.shape import moments, relative_widths
from starpos.detection.stamps import cut
from starpos.errors import FrameError
from starpos.stars import BLENDED, EDGE, ELONGATED, SATURATED, Stars, no_stars

CHUNK = 1000  # stars fitted at once: a few tens of megabytes


@dataclass(frozen=True)
class DetectionSettings:
    """What may be chosen.

    threshold       sigma of the smoothed noise a peak must stand out by
    min_snr         flux over its sigma a star must have
    max_stars       the brightest so many are kept
    mesh_px         size of the background's cells
    saturation_dn   DN from which a pixel is full; None: the type's largest value, or the frame's largest if several
                    pixels share it
    """

    threshold: float = 5.0
    min_snr: float = 6.0
    max_stars: int = 10000
    mesh_px: int = 64
    saturation_dn: float | None = None

    def __post_init__(self):
        for name, low in (("threshold", 3), ("min_snr", 0), ("max_stars", 1), ("mesh_px", 16)):
            if not low <= getattr(self, name) < np.inf:
                raise FrameError(
                    f"The detection setting {name} is {getattr(self, name)}; it must be {low} or more."
                )
        if self.saturation_dn is not None and not self.saturation_dn > 0:
            raise FrameError(
                f"The detection setting saturation_dn is {self.saturation_dn}; it must be positive."
            )


@dataclass(frozen=True, eq=False)
class Detection:
    """The stars of a frame and what else it told: background and noise (DN, medians over the frame), FWHM (px)."""

    stars: Stars
    background: float
    noise: float
    fwhm_px: float


def detect(frame, settings=DetectionSettings()) -> Detection:  # noqa: B008  frozen
    """Measure the stars of a Frame. A frame without any gives none; fwhm_px is NaN then."""
    plane = _plane(frame)
    about = (frame.width, frame.height, frame.mid_unix_s, frame.exposure_s, frame.source, frame.focal_px)
    if min(plane.shape) < 2:
        return Detection(no_stars(*about), float(np.median(plane)), 0.0, float("nan"))
    background = measure_background(plane, settings.mesh_px, True if frame.pattern else None)
    level, noise = float(np.median(background.level)), float(np.median(background.noise))
    x, y, height = find_peaks(plane, background, settings.threshold, settings.max_stars)
    if len(x) == 0:
        return Detection(no_stars(*about), level, noise, float("nan"))
    saturation = _saturation(plane, x, y, settings)
    psf, response, reach = learn(plane, background, x, y, height, saturation)
    parts = [
        _measure(
            plane, background, x[i : i + CHUNK], y[i : i + CHUNK], psf, response, reach, saturation, settings
        )
        for i in range(0, len(x), CHUNK)
    ]
    measured = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    stars = Stars(**_resolve(measured, psf), **dict(zip(_ABOUT, about, strict=True)))
    return Detection(stars, level, noise, psf.fwhm_px if len(stars) else float("nan"))


_ABOUT = ("width", "height", "mid_unix_s", "exposure_s", "source", "focal_px")


def _plane(frame):
    """One number a pixel: as it is, or the sum of blue, green and red as uint16."""
    if frame.pixels.ndim == 2:
        return frame.pixels
    blue, green, red = cv2.split(frame.pixels)
    return cv2.add(cv2.add(blue, green, dtype=cv2.CV_16U), red, dtype=cv2.CV_16U)


def _saturation(plane, x, y, settings):
    if settings.saturation_dn is not None:
        return settings.saturation_dn
    highest = plane.max()
    near = np.arange(-2, 3)
    rows, columns = (
        np.clip(v[:, None] + near, 0, n - 1) for v, n in ((y, plane.shape[0]), (x, plane.shape[1]))
    )
    full = plane[rows[:, :, None], columns[:, None, :]] == highest
    # one pixel is always the highest; noise does not make three of one star's equal to it
    return int(highest) if full.sum((1, 2)).max() >= 3 else np.iinfo(plane.dtype).max


def _measure(plane, background, x, y, psf, response, reach, saturation, settings):
    """Fit the stars at the peaks x, y and keep what is one: a dict of columns."""
    stamps = cut(plane, background, x, y, reach, saturation)
    smooth, blur = grey(stamps, background)
    shape = psf.shape
    x, y = centroid(smooth, shape)
    fit = fit_stars(stamps, psf, x, y, response)
    _, _, seen = moments(smooth, fit.x, fit.y, shape)
    widths = relative_widths(seen, shape + blur * np.eye(2), shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        snr = fit.flux / fit.flux_sigma
        c = fit.covariance
        sound = np.isfinite(snr) & (c[:, 0, 0] > 0) & (c[:, 0, 0] * c[:, 1, 1] > c[:, 0, 1] ** 2)
        sound &= np.hypot(fit.x - stamps.x, fit.y - stamps.y) < 2 + reach / 4
        sound &= (snr >= settings.min_snr) & ~_is_dot(stamps, fit, psf)
        sound &= (
            (fit.x >= 0) & (fit.x <= background.width - 1) & (fit.y >= 0) & (fit.y <= background.height - 1)
        )
        slack = 3 / snr
        full = (stamps.full & _core(stamps, fit, psf, 2)).any((1, 2))
        sound &= full | ((widths[:, 0] > 0.45 - slack) & (widths[:, 1] < 1.7))
        edge = (~stamps.good & ~stamps.full & _core(stamps, fit, psf, 3)).any((1, 2))
        elongated = (widths[:, 1] / np.maximum(widths[:, 0], 0.1) > 1.25 + slack) & ~full & ~edge
    flags = SATURATED * full + EDGE * edge + ELONGATED * elongated
    columns = dict(x=fit.x, y=fit.y, flux=fit.flux, snr=snr, covariance=c, flags=flags)
    return {name: column[sound] for name, column in columns.items()}


def _core(stamps, fit, psf, widths):
    """(N, S, S) bool: the pixels within so many widths of the star's centre."""
    return psf.within(*stamps.offsets(fit.x, fit.y), widths)


def _is_dot(stamps, fit, psf):
    """Hot pixels and sharp cosmic rays: one pixel alone explains more than the PSF does (likelihood ratio)."""
    c = stamps.reach
    score = (stamps.signal * stamps.good / stamps.noise)[:, c - 2 : c + 3, c - 2 : c + 3].reshape(
        len(stamps.x), -1
    )
    matched = np.sqrt(((fit.model / stamps.noise) ** 2 * fit.used).sum((1, 2)))
    return score.max(1) > matched


def _resolve(columns, psf):
    """Sort by flux, keep one of each set of fits that ran into the same star, and flag neighbours as BLENDED."""
    order = np.argsort(-columns["flux"], kind="stable")
    columns = {name: column[order] for name, column in columns.items()}
    n = len(order)
    if n == 0:
        return columns
    points = np.stack([columns["x"], columns["y"]], 1) @ psf.axes.T  # in widths of the PSF
    pairs = spatial.cKDTree(points).query_pairs(6.0, output_type="ndarray")
    pairs = np.sort(pairs, axis=1)  # the brighter first
    apart = np.hypot(*(points[pairs[:, 0]] - points[pairs[:, 1]]).T)
    ratio = columns["flux"][pairs[:, 1]] / columns["flux"][pairs[:, 0]]
    keep = np.ones(n, bool)
    keep[pairs[(apart < 1.5) | (ratio < 0.01), 1]] = False
    real = keep[pairs].all(1)
    flags = columns["flags"].copy()
    flags[pairs[real, 1]] |= BLENDED
    flags[pairs[real & (ratio > 0.03), 0]] |= BLENDED
    columns["flags"] = flags.astype(np.uint8)
    return {name: column[keep] for name, column in columns.items()}
