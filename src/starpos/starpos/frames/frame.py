# SPDX-License-Identifier: Apache-2.0
"""One exposure of a camera: its pixels, or the stars that a detector measured on it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exposure import Exposure, check_size

# Maximum bytes of a file, and of the pixels it unpacks to: both fit into a small robot's memory.
MAX_BYTES = 800_000_000


def check_pixels(width: int, height: int, bytes_each: float, place: str) -> None:
    """Raise FrameError unless width x height pixels, of bytes_each as a header claims, fit into MAX_BYTES."""
    if min(width, height) < 1 or width * height * bytes_each > MAX_BYTES:
        raise FrameError(
            f"{place}: its header claims {width} x {height} pixels of {bytes_each:g} bytes; a frame has at least one and "
            f"at most {MAX_BYTES // 10**6} MB."
        )


# A header may claim any size; this many pixels fit into a small robot's memory.
MAX_PIXELS = 200_000_000
# Ratio to the noise above or below the sky from which a pixel is an error: no sensor has such a range.
LOUDEST = 30_000
PATTERNS = ("", "rggb", "bggr", "grbg", "gbrg")


@dataclass(frozen=True, eq=False)
class Frame(Exposure):
    """The pixels of one exposure, row 0 on top.

    FrameError for other types, shapes, sizes or patterns.

    Attributes
    ----------
    pixels : (height, width) uint8 or uint16, grey or a colour mosaic; or (height, width, 3) uint8, BGR
    pattern : the mosaic's colours in reading order: 'rggb', 'bggr', 'grbg', 'gbrg'; '' for none

    Examples
    --------
    >>> frame = starpos.Frame(np.zeros((700, 1000), np.uint16), mid_unix_s=1.8e9, exposure_s=0.5)
    >>> frame.width, frame.height
    (1000, 700)
    """

    pixels: np.ndarray
    pattern: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        place, pixels = self.place, self.pixels
        if not isinstance(pixels, np.ndarray):
            raise FrameError(f"{place}: the pixels are a {type(pixels).__name__}; give a numpy array.")
        colour = pixels.ndim == 3 and pixels.shape[2] == 3
        if not (pixels.ndim == 2 or colour):
            raise FrameError(
                f"{place}: the pixels have the shape {pixels.shape}; give rows by columns, or by 3 as BGR."
            )
        if pixels.dtype != np.uint8 and (colour or pixels.dtype != np.uint16):
            depth = "uint8" if colour else "uint8 or uint16"
            raise FrameError(f"{place}: the pixels are {pixels.dtype}; convert them to {depth}.")
        check_size(pixels.shape[1], pixels.shape[0], place)
        if self.pattern not in PATTERNS or (colour and self.pattern):
            allowed = "''" if colour else ", ".join(map(repr, PATTERNS))
            raise FrameError(f"{place}: the colour pattern is {self.pattern!r}; it must be {allowed}.")

    def __repr__(self) -> str:
        return f"<{self.place}: {self.width} x {self.height} px, {self.pixels.dtype}>"

    @property
    def width(self) -> int:
        return self.pixels.shape[1]

    @property
    def height(self) -> int:
        return self.pixels.shape[0]


# number of pixels that are looked at; smallest noise of high bytes; number of low ones that show something
LOOKED_AT, NOISY, SEVERAL = 1 << 18, 4, 8


def in_order(frame: Frame) -> Frame:
    """The frame; FrameError if the bytes of its pixels are in the wrong order: then the low ones alone make a picture."""
    if frame.pixels.dtype != np.uint16:
        return frame
    some = frame.pixels[:: -(-frame.pixels.size // LOOKED_AT)]
    high, low = (some >> 8).astype(int), (some & 255).astype(int)
    # in a mosaic, every second pixel has the same colour
    noise = [np.median(np.abs(v[:, 2:] - v[:, :-2])) if v.shape[1] > 2 else 0 for v in (high, low)]
    if noise[0] >= NOISY and noise[1] <= 1 and len(np.unique(low)) > SEVERAL:
        raise FrameError(
            f"{frame.place}: the two bytes of its pixels are in the wrong order, because only the low ones make a "
            "picture; write them in the other order (big-endian in FITS)."
        )
    return frame


def to_unsigned(values: np.ndarray, place: str) -> np.ndarray:
    """Convert real values (h, w) to uint8 or uint16; FrameError for other values.

    Those that fit 16 bits are only rounded. Others are shifted to begin at 0, and scaled to fill 16 bits if their range
    is wider than that or, for floats, narrower than 4096. A few NaN or infinite pixels become the median.
    """
    if values.dtype.kind not in "uif":
        raise FrameError(f"{place}: its pixels are {values.dtype}; give numbers.")
    if values.size == 0:
        raise FrameError(f"{place}: it has no pixels; its shape is {values.shape}.")
    if values.dtype.kind == "u" and values.dtype.itemsize <= 2:
        return np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    if values.dtype.kind == "f":
        finite = np.isfinite(values)
        if finite.mean() < 0.99:
            raise FrameError(f"{place}: more than 1 % of its pixels are NaN or infinite; mask fewer of them.")
        if not finite.all():
            values = np.where(finite, values, np.median(values[finite]))
    if not np.isfinite(float(values.max()) - float(values.min())):
        raise FrameError(
            f"{place}: its pixels span {values.min():g} to {values.max():g}; rescale them to 16 bits."
        )
    low, high = _limits(values)
    span = high - low
    narrow = values.dtype.kind == "f" and 0 < span < 4096
    if low >= 0 and high <= 65535 and not narrow:
        offset, scale = 0.0, 1.0
    else:
        offset, scale = low, (65535 / span if narrow or span > 65535 else 1.0)
    out = np.empty(values.shape, np.uint16)
    # in strips, because a float64 copy of a whole frame takes 170 MB
    for row in range(0, len(values), 256):
        strip = np.clip(values[row : row + 256].astype(np.float64), low, high)
        out[row : row + 256] = np.rint((strip - offset) * scale)
    return out


def _limits(values: np.ndarray) -> tuple[float, float]:
    """The smallest and the largest value, limited by LOUDEST.

    Without the limit a single pixel, divided by a dead pixel of the flat field, would take up all 16 bits.
    """
    low, high = float(values.min()), float(values.max())
    some = np.atleast_2d(values)[:: max(1, len(values) // 256)].astype(np.float64)
    noise = np.median(np.abs(np.diff(some, axis=1))) if some.shape[1] > 1 else 0.0
    if noise == 0:
        return low, high
    sky = float(np.median(some))
    return max(low, sky - LOUDEST * noise), min(high, sky + LOUDEST * noise)


SATURATED = 1
EDGE = 2
ELONGATED = 4
BLENDED = 8
UNSOUND = SATURATED | EDGE | ELONGATED | BLENDED
# In messages: not a star but a Disc, whose flux is its area, px2; SATURATED with it: a glow.
DISC = 16
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
class FrameTrail:
    """A straight trail on a frame.

    ends        (2, 2) px: x, y of both; which came first is not known
    covariance  (4, 4) px2 of x, y of the first end and of the second
    snr         its light over the sky's noise
    cut         (2,) bool: whether the trail leaves the frame there, so that this is not its end
    steady      whether its light is even enough for its ends to be the exposure's
    """

    ends: np.ndarray
    covariance: np.ndarray
    snr: float
    cut: np.ndarray
    steady: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Disc:
    """A bright round thing far wider than a star on a frame: the Sun, or what looks like it.

    x, y: its centre, px, with the covariance (2, 2) px2.  radius_px: of its limb, or of the glow that is saturated.
    sharp: whether its limb was fitted; else it is a saturated glow.
    other: a second one on the frame, fainter, with a limb; None without.
    """

    x: float
    y: float
    covariance: np.ndarray
    radius_px: float
    sharp: bool
    other: "Disc | None" = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Stars(Exposure):
    """N stars of a frame, brightest first; the centre of the top-left pixel is (0, 0).

    Sequences are converted to arrays. FrameError if the columns do not fit together or hold impossible values.

    Attributes
    ----------
    x, y : (N,) px: column and row
    flux : (N,) DN above the background, or any other unit: only order and ratios are used
    snr : (N,) flux over its standard deviation
    covariance : (N, 2, 2) px2 of (x, y)
    flags : (N,) uint8, a sum of SATURATED, EDGE, ELONGATED, BLENDED
    width, height : px, of the frame
    fwhm_px : width of the star images, px; None: unknown
    window : px, the part of the frame that holds a picture, if the rest is white; None: all of it
    negative : whether they are dark on a bright sky, as on a plate
    disc : what looks like the Sun on the frame; None without

    Examples
    --------
    >>> stars = starpos.read_frame("night/stars_0000.csv")
    >>> stars.x.shape == stars.flux.shape == (len(stars.snr),)
    True
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
    disc: Disc | None = None

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

    def select(self, index: np.ndarray | slice) -> "Stars":
        """The stars that an index array, a slice or a boolean mask (N,) selects; their order of flux must stay."""
        return replace(self, **{name: getattr(self, name)[index] for name in COLUMNS})


def no_stars(width: int, height: int, **about: Any) -> Stars:
    """The Stars of a frame without stars; `about` are fields of the Exposure."""
    columns: dict[str, Any] = {name: np.zeros((0, 2, 2) if name == "covariance" else 0) for name in COLUMNS}
    return Stars(**columns, width=width, height=height, **about)
