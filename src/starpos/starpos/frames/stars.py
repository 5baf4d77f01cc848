# SPDX-License-Identifier: Apache-2.0
"""The stars of one frame as a detector measured them."""

from dataclasses import dataclass, replace

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exposure import Exposure, check_size

SATURATED = 1
EDGE = 2
ELONGATED = 4
BLENDED = 8
UNSOUND = SATURATED | EDGE | ELONGATED | BLENDED
COLUMNS = ("x", "y", "flux", "snr", "covariance", "flags")
EDGE_PX = 2.0  # a star whose centroid is further outside its frame is none
MOST_VARIANCE_PX2 = 1e12  # beyond any frame; squares of it must not overflow
SYMMETRIC = 1e-6  # of the variances: by how much a covariance's two halves may differ


@dataclass(frozen=True, eq=False, kw_only=True)
class Stars(Exposure):
    """N stars of a frame, brightest first; the centre of the top-left pixel is (0, 0).

    x, y            (N,) px: column and row
    flux            (N,) DN above the background (any consistent unit: only its order and ratios count)
    snr             (N,) flux over its standard deviation
    covariance      (N, 2, 2) px2 of (x, y)
    flags           (N,) uint8, a sum of SATURATED, EDGE, ELONGATED, BLENDED
    width, height   px, of the frame

    Sequences are converted; what does not fit together raises FrameError.
    """

    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    snr: np.ndarray
    covariance: np.ndarray
    flags: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        super().__post_init__()
        place = self.place
        check_size(self.width, self.height, place)
        n = np.size(self.x)
        for name in ("x", "y", "flux", "snr"):
            self._set(name, np.float64, (n,), place)
        self._set("covariance", np.float64, (n, 2, 2), place)
        self._set("flags", np.int64, (n,), place)
        if np.any((self.flags < 0) | (self.flags > 255)):
            raise FrameError(
                f"{place}: the stars' flags are not numbers from 0 to 255; give sums of the flags."
            )
        object.__setattr__(self, "flags", self.flags.astype(np.uint8))
        c = self.covariance
        if np.any(c > MOST_VARIANCE_PX2):
            raise FrameError(f"{place}: a star's error is {np.sqrt(c.max()):.1g} px; leave such stars out.")
        variances = c[:, 0, 0] * c[:, 1, 1]
        definite = (c[:, 0, 0] > 0) & (c[:, 1, 1] > 0) & (variances > c[:, 0, 1] ** 2)
        if not np.all(definite & ((c[:, 0, 1] - c[:, 1, 0]) ** 2 <= SYMMETRIC**2 * variances)):
            raise FrameError(
                f"{place}: a star's covariance is not symmetric and positive definite; measure its centroid again."
            )
        if np.any(np.diff(self.flux) > 0):
            raise FrameError(f"{place}: the stars are not sorted; give them brightest first.")

    def _set(self, name, dtype, shape, place):
        try:
            value = np.ascontiguousarray(getattr(self, name), dtype)
        except (TypeError, ValueError, OverflowError):
            raise FrameError(f"{place}: the stars' {name} are not numbers; give an array of them.") from None
        if value.shape != shape:
            raise FrameError(f"{place}: the stars' {name} has the shape {value.shape}, it must be {shape}.")
        if not np.all(np.isfinite(value)):
            raise FrameError(f"{place}: the stars' {name} holds NaN or infinity; leave such stars out.")
        object.__setattr__(self, name, value)

    def __len__(self):
        return len(self.x)

    @property
    def sigma(self) -> np.ndarray:
        """(N,) px: one axis, whichever way it lies."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2)

    @property
    def on_frame(self) -> np.ndarray:
        """(N,) whether the centroid lies on the frame, or within EDGE_PX of it."""
        on = (self.x > -EDGE_PX) & (self.x < self.width - 1 + EDGE_PX)
        return on & (self.y > -EDGE_PX) & (self.y < self.height - 1 + EDGE_PX)

    @property
    def sound(self) -> np.ndarray:
        """(N,) whether no flag is set: a saturated, cut or blended image has its centroid elsewhere."""
        return (self.flags & UNSOUND) == 0

    def take(self, index) -> "Stars":
        """The stars of an index array or a boolean mask of length N; an index must keep the order of flux."""
        return replace(self, **{name: getattr(self, name)[index] for name in COLUMNS})


def no_stars(width: int, height: int, **about) -> Stars:
    """The Stars of a frame on which there are none; about: what is known of the exposure."""
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
