# SPDX-License-Identifier: Apache-2.0
"""Detect a frame's stars: background, peaks, PSF and noise learnt from bright stars, a fit of each, a selection.

Where stars are wider than the peaks' kernels can find, the same is done with the frame reduced by two.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from starpos.detection._pixels import third_highest
from starpos.detection.background import halved, measure_sky, plane_of, window_of
from starpos.detection.discs import find_disc
from starpos.detection.finding import find_peaks, find_streaks
from starpos.detection.learn import learn
from starpos.detection.saturated import find_discs, with_clipped, with_discs
from starpos.detection.vet import measure, resolve
from starpos.errors import FrameError
from starpos.frames.exposure import Exposure
from starpos.frames.frame import BLENDED, COLUMNS, EDGE, ELONGATED, Frame, Stars, Window, no_stars

# Pixels of stars that are fitted together, give or take half, on a small and on a large frame: about 2 and 6 MB.
CHUNK_PIXELS = 30_000, 120_000
# Peaks looked at, or twice the stars wanted if that is more: hot pixels are peaks too.
PEAKS = 10_000
# Maximum number of fitted pixels over the maximum number of peaks: 2 million take some 10 s. Beyond it the faintest stars
# are left out. Ordinary frames have a tenth. Each reduction by two has half as many as the one before.
PIXELS_PER_PEAK = 100
# Stars of at least this FWHM (px), or none at all, are looked for in the frame reduced by two as well, and there again.
# They are taken if more of them are like stars. SHORTEST_PX is the minimum of a reduced frame's shorter side.
WIDE_FWHM, SHORTEST_PX = 8.0, 150
# Maximum number of reductions: light that is still wider is a cloud.
MAX_HALVINGS = 3


@dataclass(frozen=True, kw_only=True)
class DetectionSettings:
    """Settings of `detect`; FrameError if one is out of its range.

    threshold       height of a peak in sigma of the smoothed noise, 3 or more
    min_snr         flux of a star over its sigma in the sky's noise
    max_stars       how many stars are kept, brightest first
    mesh_px         size of the background's cells, 16 or more
    threads         maximum number of threads
    saturation_dn   DN from which a pixel is saturated; None: the type's largest value, or the frame's largest if several
                    pixels of a star share it
    """

    threshold: float = 5.0
    min_snr: float = 6.5
    max_stars: int = 10000
    mesh_px: int = 64
    threads: int = 1
    saturation_dn: float | None = None

    @classmethod
    def by_parameters(cls, values: Mapping[str, Any]) -> "DetectionSettings":
        """The settings by the values of the parameters of the node `detector`."""
        return cls(
            threshold=values["threshold"],
            min_snr=values["min_snr"],
            max_stars=values["max_stars"],
            threads=values["threads"],
            saturation_dn=None if math.isnan(values["saturation"]) else values["saturation"],
        )

    def __post_init__(self) -> None:
        for name, low in (
            ("threshold", 3),
            ("min_snr", 0),
            ("max_stars", 1),
            ("mesh_px", 16),
            ("threads", 1),
        ):
            if isinstance(getattr(self, name), str) or not low <= getattr(self, name) < np.inf:
                raise FrameError(
                    f"The detection setting {name} is {getattr(self, name)}; it must be {low} or more."
                )
        for name in ("max_stars", "mesh_px", "threads"):
            if getattr(self, name) != int(getattr(self, name)):
                raise FrameError(f"The detection setting {name} is {getattr(self, name)}; it must be whole.")
            object.__setattr__(self, name, int(getattr(self, name)))
        if self.saturation_dn is not None and not self.saturation_dn > 0:
            raise FrameError(
                f"The detection setting saturation_dn is {self.saturation_dn}; it must be positive."
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class Detection:
    """The stars of a frame, its background and noise (DN, medians over the frame) and FWHM (px).

    Attributes
    ----------
    chi2 : (N,) of each star's fit, per degree of freedom: about 1 for a star that PSF and noise describe
    left_out : how many peaks, the lowest, were not measured because there were too many

    Examples
    --------
    >>> frame = starpos.Frame(np.full((200, 300), 100, np.uint16))
    >>> len(starpos.detect(frame).stars.x)
    0
    """

    stars: Stars
    background: float
    noise: float
    fwhm_px: float
    chi2: np.ndarray
    left_out: int = 0

    @property
    def typical_chi2(self) -> float:
        """The median of chi2; NaN without stars."""
        return float(np.median(self.chi2)) if len(self.chi2) else float("nan")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Picture:
    """What stars are looked for in.

    plane     (h, w) of a frame, or of a reduced one; halvings: how often it may be reduced by two
    mosaic    whether its pixels are of several colours
    exposure  of the frame
    """

    plane: np.ndarray
    mosaic: bool | None
    settings: DetectionSettings
    exposure: Exposure
    halvings: int

    @property
    def facts(self) -> dict[str, Any]:
        """The fields of Stars that are not of stars."""
        height, width = self.plane.shape
        return {"width": width, "height": height} | self.exposure.facts

    def halved(self) -> tuple["_Picture", int]:
        """The picture of half the size, and the flux of 1 DN in it."""
        plane, gain = halved(self.plane)
        settings = self.settings
        if settings.saturation_dn is not None:
            settings = replace(settings, saturation_dn=settings.saturation_dn * 4 / gain)
        smaller = replace(self, plane=plane, mosaic=False, settings=settings, halvings=self.halvings - 1)
        return smaller, gain


def detect(frame: Frame, settings: DetectionSettings = DetectionSettings()) -> Detection:
    """Measure the stars of a Frame. Without stars the Detection is empty and fwhm_px NaN.

    Parameters
    ----------
    frame : its pixels
    settings : thresholds and limits

    Returns
    -------
    Detection
        `stars`, brightest first, with background, noise and FWHM

    Examples
    --------
    >>> frame = starpos.Frame(np.random.default_rng(1).poisson(100, (200, 300)).astype(np.uint16))
    >>> found = starpos.detect(frame)
    >>> 95 < found.background < 105
    True
    """
    # OpenCV would take all processors for a little, and wait for them where others work
    cv2.setNumThreads(settings.threads)
    plane, mosaic = plane_of(frame)
    picture = _Picture(plane=plane, mosaic=mosaic, settings=settings, exposure=frame, halvings=MAX_HALVINGS)
    found, disc = _detect(picture), find_disc(plane)
    return found if disc is None else replace(found, stars=replace(found.stars, disc=disc))


def _detect(picture: _Picture) -> Detection:
    """The Detection of a picture, or of a smaller one if that shows more stars."""
    found = _detect_at_full_size(picture)
    if found.fwhm_px < WIDE_FWHM or not picture.halvings or min(picture.plane.shape) < 2 * SHORTEST_PX:
        return found
    smaller, gain = picture.halved()
    reduced = _detect(smaller)
    if _clear(reduced.stars) <= _clear(found.stars):
        return found
    height, width = picture.plane.shape
    stars = enlarged(reduced.stars, 2, width, height, found.stars.window, gain)
    return replace(
        found, stars=stars, fwhm_px=2 * reduced.fwhm_px, chi2=reduced.chi2, left_out=reduced.left_out
    )


def enlarged(
    stars: Stars, times: int, width: int, height: int, window: Window | None, gain: float = 1.0
) -> Stars:
    """The stars of a frame that was reduced `times` times, on the original frame; gain: factor on their flux."""
    return replace(
        stars,
        x=times * stars.x + (times - 1) / 2,
        y=times * stars.y + (times - 1) / 2,
        flux=gain * stars.flux,
        covariance=times**2 * stars.covariance,
        fwhm_px=None if stars.fwhm_px is None else times * stars.fwhm_px,
        width=width,
        height=height,
        window=window,
        disc=None,
    )


def _clear(stars: Stars) -> int:
    """How many of the stars look like one star."""
    return int(np.count_nonzero((stars.flags & (EDGE | ELONGATED | BLENDED)) == 0))


def _detect_at_full_size(picture: _Picture) -> Detection:
    plane, settings = picture.plane, picture.settings
    if min(plane.shape) < 2:
        return _starless(picture, float(np.median(plane)), 0.0)
    sky = measure_sky(plane, settings.mesh_px, picture.mosaic)
    level, noise = sky.typical
    limit = max(PEAKS, 2 * settings.max_stars)
    peaks = find_peaks(sky, settings.threshold, limit, settings.threads)
    x, y, height = peaks.x, peaks.y, peaks.height
    if len(x) == 0:
        return _starless(picture, level, noise)
    saturation = _saturation(plane, x, y, settings)
    sky = replace(sky, correlation=peaks.correlation, saturation=saturation)
    streaks = find_streaks(sky, x, y)
    if streaks:
        sky = replace(sky, streaks=streaks)
    lesson = learn(sky, x, y, height)
    pixels = (2 * lesson.reach + 1) ** 2
    fewest, most = CHUNK_PIXELS
    chunk = max(1, min(max(plane.size // 32, fewest), most) // pixels)
    most = min(len(x), limit * (PIXELS_PER_PEAK >> MAX_HALVINGS - picture.halvings) // pixels)
    found = measure(sky, x[:most], y[:most], lesson, settings.min_snr, chunk)
    found = resolve(found, lesson.psf)
    fwhm_px = lesson.psf.fwhm_px
    found = with_discs(found, *find_discs(sky, fwhm_px, peaks.highest), fwhm_px)
    if fwhm_px < WIDE_FWHM:
        found = with_clipped(found, sky, x, y, fwhm_px)
    found = found[: settings.max_stars]
    columns: dict[str, Any] = {name: found[name] for name in COLUMNS}
    stars = Stars(
        **columns, fwhm_px=fwhm_px, window=window_of(plane, int(peaks.highest.max()), level), **picture.facts
    )
    return Detection(
        stars=stars,
        background=level,
        noise=noise,
        fwhm_px=fwhm_px if len(stars) else float("nan"),
        chi2=np.ascontiguousarray(found["chi2"]),
        left_out=peaks.left_out + len(x) - most,
    )


def _starless(picture: _Picture, level: float, noise: float) -> Detection:
    """The Detection of a frame without stars."""
    stars = no_stars(**picture.facts)
    return Detection(stars=stars, background=level, noise=noise, fwhm_px=float("nan"), chi2=np.zeros(0))


def _saturation(plane: np.ndarray, x: np.ndarray, y: np.ndarray, settings: DetectionSettings) -> float:
    if settings.saturation_dn is not None:
        return settings.saturation_dn
    # the third highest pixel of a star, because a hot pixel may exceed saturation; noise does not make three equal
    third, alike = third_highest(plane, x.astype(np.intp), y.astype(np.intp), 2)
    return float(third.max()) if alike[third == third.max()].max() >= 3 else np.iinfo(plane.dtype).max
