# SPDX-License-Identifier: Apache-2.0
"""The stars of one frame as a detector measured them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exposure import Exposure, check_size

SATURATED = 1
EDGE = 2
ELONGATED = 4
BLENDED = 8
UNSOUND = SATURATED | EDGE | ELONGATED | BLENDED
# Left, top, right, bottom: the first column and row, and the first beyond.
Window = tuple[int, int, int, int]
COLUMNS = ("x", "y", "flux", "snr", "covariance", "flags")
# A centroid farther outside the frame than this is not a star's.
EDGE_PX = 2.0
# Larger than any frame; squares must not overflow.
MAX_VARIANCE_PX2 = 1e12
# The two halves of a covariance may differ by this share of the variances.
SYMMETRIC = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class Stars(Exposure):
    """N stars of a frame, brightest first; the centre of the top-left pixel is (0, 0).

    x, y            (N,) px: column and row
    flux            (N,) DN above the background, or any other unit: only order and ratios are used
    snr             (N,) flux over its standard deviation
    covariance      (N, 2, 2) px2 of (x, y)
    flags           (N,) uint8, a sum of SATURATED, EDGE, ELONGATED, BLENDED
    width, height   px, of the frame
    fwhm_px         width of the star images, px; None: unknown
    window          px, the part of the frame that holds a picture, if the rest is white; None: all of it
    negative        whether they are dark on a bright sky, as on a plate

    Sequences are converted to arrays. FrameError if the columns do not fit together or hold impossible values.
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    snr: np.ndarray
    covariance: np.ndarray
    flags: np.ndarray
    width: int
    height: int
    fwhm_px: float | None = None
    window: Window | None = None
    negative: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        place = self.place
        check_size(self.width, self.height, place)
        n = np.size(self.x)
        if self.window is not None:
            left, top, right, bottom = self.window
            if not (0 <= left < right <= self.width and 0 <= top < bottom <= self.height):
                raise FrameError(f"{place}: the window {self.window} is no part of the frame; leave it out.")
        for name in ("x", "y", "flux", "snr"):
            self._set(name, np.float64, (n,), place)
        self._set("covariance", np.float64, (n, 2, 2), place)
        self._set("flags", np.int64, (n,), place)
        if ((self.flags < 0) | (self.flags > 255)).any():
            raise FrameError(
                f"{place}: the stars' flags are not numbers from 0 to 255; give sums of the flags."
            )
        object.__setattr__(self, "flags", self.flags.astype(np.uint8))
        c = self.covariance
        if (c > MAX_VARIANCE_PX2).any():
            raise FrameError(f"{place}: a star's error is {np.sqrt(c.max()):.1g} px; leave such stars out.")
        variances = c[:, 0, 0] * c[:, 1, 1]
        definite = (c[:, 0, 0] > 0) & (c[:, 1, 1] > 0) & (variances > c[:, 0, 1] ** 2)
        if not (definite & ((c[:, 0, 1] - c[:, 1, 0]) ** 2 <= SYMMETRIC**2 * variances)).all():
            raise FrameError(
                f"{place}: a star's covariance is not symmetric and positive definite; measure its centroid again."
            )
        if (self.flux[1:] > self.flux[:-1]).any():
            raise FrameError(f"{place}: the stars are not sorted; give them brightest first.")

    def _set(self, name: str, dtype: type, shape: tuple[int, ...], place: str) -> None:
        try:
            value: np.ndarray = np.ascontiguousarray(getattr(self, name), dtype)
        except (TypeError, ValueError, OverflowError):
            raise FrameError(f"{place}: the stars' {name} are not numbers; give an array of them.") from None
        if value.shape != shape:
            raise FrameError(f"{place}: the stars' {name} has the shape {value.shape}, it must be {shape}.")
        if not np.isfinite(value).all():
            raise FrameError(f"{place}: the stars' {name} holds NaN or infinity; leave such stars out.")
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"<{len(self)} stars of {self.place}, {self.width} x {self.height} px>"

    def __len__(self) -> int:
        return len(self.x)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviation (N,) px of a position along one axis, averaged over directions."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2)

    @property
    def on_frame(self) -> np.ndarray:
        """Whether each centroid (N,) lies on the frame or within EDGE_PX of it."""
        on = (self.x > -EDGE_PX) & (self.x < self.width - 1 + EDGE_PX)
        return on & (self.y > -EDGE_PX) & (self.y < self.height - 1 + EDGE_PX)

    @property
    def sound(self) -> np.ndarray:
        """Whether each star (N,) has no flag; the centroid of a saturated, cut or blended image is biased."""
        return (self.flags & UNSOUND) == 0

    def take(self, index: np.ndarray | slice) -> "Stars":
        """The stars that an index array, a slice or a boolean mask (N,) selects; their order of flux must stay."""
        return replace(self, **{name: getattr(self, name)[index] for name in COLUMNS})


def no_stars(width: int, height: int, **about: Any) -> Stars:
    """The Stars of a frame without stars; `about` are fields of the Exposure."""
    none = np.zeros(0)
    return Stars(
        x=none,
        y=none,
        flux=none,
        snr=none,
        covariance=np.zeros((0, 2, 2)),
        flags=none,
        width=width,
        height=height,
        **about,
    )
