# SPDX-License-Identifier: Apache-2.0
"""The stars of one frame as a detector measured them."""

from dataclasses import dataclass

import numpy as np

from starpos.errors import FrameError

SATURATED = 1
EDGE = 2
ELONGATED = 4
BLENDED = 8
MOST_EXPOSURE_S = 3600.0  # tilts of more than one pose would be averaged
MOST_VARIANCE_PX2 = 1e12  # beyond any frame; squares of it must not overflow
SYMMETRIC = 1e-6  # of the variances: by how much a covariance's two halves may differ
MOST_STDDEV_S = 1e9  # of a time: more says nothing, and its square must not overflow


@dataclass(frozen=True, eq=False)
class Stars:
    """N stars of a frame, brightest first; the centre of the top-left pixel is (0, 0).

    x, y            (N,) px: column and row
    flux            (N,) DN above the background (any consistent unit: only its order and ratios count)
    snr             (N,) flux over its standard deviation
    covariance      (N, 2, 2) px2 of (x, y)
    flags           (N,) uint8, a sum of SATURATED, EDGE, ELONGATED, BLENDED
    width, height   px, of the frame
    mid_unix_s      middle of the exposure, UTC as a Unix time; None: unknown
    exposure_s      None: unknown
    source          where it came from, for messages: a path or a topic
    focal_px        focal length a file's header claims, px; a hint only; None: unknown
    stamp_stddev_s  standard deviation of mid_unix_s against the clock that told it, common to all frames; 0: unknown
    clock_stddev_s  standard deviation of that clock against UTC, which all frames have in common; 0: unknown

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
    mid_unix_s: float | None = None
    exposure_s: float | None = None
    source: str = ""
    focal_px: float | None = None
    stamp_stddev_s: float = 0.0
    clock_stddev_s: float = 0.0

    def __post_init__(self):
        place = self.source or "the star list"
        check_size(self.width, self.height, place)
        check_times(self, place)
        check_focal(self.focal_px, place)
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

    def take(self, index) -> "Stars":
        """The stars of an index array or a boolean mask of length N; an index must keep the order of flux."""
        return Stars(
            self.x[index],
            self.y[index],
            self.flux[index],
            self.snr[index],
            self.covariance[index],
            self.flags[index],
            self.width,
            self.height,
            self.mid_unix_s,
            self.exposure_s,
            self.source,
            self.focal_px,
            self.stamp_stddev_s,
            self.clock_stddev_s,
        )


def no_stars(
    width,
    height,
    mid_unix_s=None,
    exposure_s=None,
    source="",
    focal_px=None,
    stamp_stddev_s=0.0,
    clock_stddev_s=0.0,
) -> Stars:
    """The Stars of a frame on which there are none."""
    none = np.zeros(0)
    return Stars(
        none,
        none,
        none,
        none,
        np.zeros((0, 2, 2)),
        none,
        width,
        height,
        mid_unix_s,
        exposure_s,
        source,
        focal_px,
        stamp_stddev_s,
        clock_stddev_s,
    )


def check_size(width, height, place):
    """Raise FrameError unless width and height are whole numbers of at least 1 px and at most 1e6 px."""
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, (int, np.integer)) or not 1 <= value <= 1_000_000:
            raise FrameError(
                f"{place}: the frame's {name} is {value!r}; it must be a whole number, 1 to 1000000 px."
            )


def check_times(about, place):
    """Raise FrameError unless a Frame's or Stars' times are finite numbers or None, exposure and errors not negative."""
    mid_unix_s, exposure_s = about.mid_unix_s, about.exposure_s
    if mid_unix_s is not None and not np.isfinite(mid_unix_s):
        raise FrameError(
            f"{place}: the time of the exposure's middle is {mid_unix_s}; give a Unix time or None."
        )
    if exposure_s is not None and not 0 <= exposure_s <= MOST_EXPOSURE_S:
        raise FrameError(
            f"{place}: the exposure is {exposure_s} s; give 0 to {MOST_EXPOSURE_S:g} s, or None where it is unknown."
        )
    for name in ("stamp_stddev_s", "clock_stddev_s"):
        value = getattr(about, name)
        if not 0 <= value <= MOST_STDDEV_S:
            raise FrameError(
                f"{place}: {name} is {value}; it must be from 0 (unknown) to {MOST_STDDEV_S:g} s."
            )


def check_focal(focal_px, place):
    """Raise FrameError unless the focal length is None or a positive finite number of pixels."""
    if focal_px is not None and not (np.isfinite(focal_px) and focal_px > 0):
        raise FrameError(f"{place}: the focal length is {focal_px} px; give a positive number or None.")
