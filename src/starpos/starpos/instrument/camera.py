# SPDX-License-Identifier: Apache-2.0
"""Turn pixels into unit vectors of the camera frame C and back: a pinhole with distortion, or a fisheye, as ROS names
lenses.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import InstrumentError
from starpos.instrument._lens import Equidistant, Lens, PlumbBob

# ROS's names of the models that are understood, and the names of their coefficients; a fisheye's may have two more.
PLUMB_BOB, EQUIDISTANT, RATIONAL = "plumb_bob", "equidistant", "rational_polynomial"
COEFFICIENTS = {
    PLUMB_BOB: ("k1", "k2", "p1", "p2", "k3"),
    EQUIDISTANT: ("k1", "k2", "k3", "k4"),
    RATIONAL: ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
DECENTRED = "p1", "p2"
# COLMAP's name of a decentred fisheye in files and messages: k1, k2, p1, p2, k3, k4, and a thin prism's two
THIN_PRISM_FISHEYE = "thin_prism_fisheye"
# numbers of a pinhole's coefficients in OpenCV: 12 and 14 include a thin prism and a tilted sensor
OPENCV_NUMBERS = (0, 4, 5, 8, 12, 14)


def stated_lens(model: str, d: Sequence[float], place: str) -> tuple[str, tuple[float, ...]]:
    """Model and coefficients for a Camera, from a message's or file's as OpenCV and ROS define them.

    A pinhole's coefficients are OpenCV's by their number, under either of the two names. Without a name they are a
    pinhole's. Trailing zeros are ignored.
    InstrumentError where the model is another one or has another number of coefficients.
    """
    model = model or PLUMB_BOB
    if model == EQUIDISTANT and len(d) in (0, 4):
        return model, tuple(d)
    if model == THIN_PRISM_FISHEYE and len(d) == 8 and not any(d[6:]):
        return EQUIDISTANT, (*d[:2], *d[4:6], *d[2:4])
    if model in (PLUMB_BOB, RATIONAL) and len(d) in OPENCV_NUMBERS:
        terms = [*d, *[0.0] * 14]
        if not any(terms[8:]):
            pinhole = RATIONAL if any(terms[5:8]) else PLUMB_BOB
            return pinhole, tuple(terms[: len(COEFFICIENTS[pinhole])])
    raise InstrumentError(
        f"{place}: the distortion model is {model[:40]!r} with {len(d)} terms; {PLUMB_BOB!r} and {RATIONAL!r} with 4, 5 "
        f"or 8, {EQUIDISTANT!r} with 4 and {THIN_PRISM_FISHEYE!r} with 8 are understood (further ones and a thin "
        "prism's must be 0): calibrate with one of them."
    )


# The axis of a whole frame is no further from its middle than this share of a side, on one of the two sides at least.
OFF_MIDDLE = 0.24


def check_axis(width: int, height: int, cx: float, cy: float, place: str) -> None:
    """Raise InstrumentError if a whole frame's principal point lies near its corner, or outside, px; size 0: unknown."""
    if not width or not height:
        return
    x, y = (cx + 0.5) / width - 0.5, (cy + 0.5) / height - 0.5
    if max(abs(x), abs(y)) > 0.5 or min(abs(x), abs(y)) > OFF_MIDDLE:
        raise InstrumentError(
            f"{place}: the optical axis is at pixel ({cx:.1f}, {cy:.1f}) of a whole frame of {width} x {height} px, near "
            "its corner or outside: the matrix seems to be of a part of the frame: give the whole sensor's, with its size"
        )


def pixels_over(width: int, height: int, side: int) -> np.ndarray:
    """Pixels (side^2, 2) on a regular grid over a frame, its corners included."""
    x, y = np.meshgrid(np.linspace(0, width - 1, side), np.linspace(0, height - 1, side))
    return np.stack([x.ravel(), y.ravel()], -1)


@lru_cache(maxsize=64)
def _reach(d: tuple[float, ...]) -> float:
    """The angle off the axis, rad, out to which a fisheye has a picture; at most pi."""
    # of the slope, by the square of the angle
    roots = np.roots([9 * d[3], 7 * d[2], 5 * d[1], 3 * d[0], 1.0])
    turning = [r.real for r in roots if r.real > 0 and abs(r.imag) < 1e-9 * abs(r)]
    return min(math.sqrt(min(turning, default=math.inf)), math.pi)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics of a camera, as in sensor_msgs/CameraInfo; InstrumentError for impossible values.

    Attributes
    ----------
    width, height : px of the frame
    fx, fy : focal lengths, px
    cx, cy : principal point, px
    distortion : coefficients of the model, by the names in COEFFICIENTS, a fisheye's also with DECENTRED; (): all 0
    model : of the lens: PLUMB_BOB or RATIONAL, or EQUIDISTANT for a fisheye

    Examples
    --------
    >>> camera = starpos.Camera.from_focal(1000, 700, 4636.0)
    >>> round(float(camera.scale_arcsec), 1)  # arcsec per px
    44.5
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    model: str = PLUMB_BOB

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            raise InstrumentError(
                f"the distortion model is {self.model[:40]!r}; {', '.join(COEFFICIENTS)} are understood: calibrate "
                "with one of them"
            )
        if not self.distortion:
            object.__setattr__(self, "distortion", (0.0,) * len(COEFFICIENTS[self.model]))
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if self.width < 1 or self.height < 1:
            raise InstrumentError(f"camera size {self.width} x {self.height} px: both must be at least 1")
        if not all(map(math.isfinite, numbers)):
            raise InstrumentError(
                "camera intrinsics hold a number that is not finite: calibrate the camera again"
            )
        if self.fx <= 0 or self.fy <= 0:
            raise InstrumentError(f"focal length {self.fx} x {self.fy} px: must be positive")
        names = self.coefficients
        if len(self.distortion) != len(names):
            raise InstrumentError(
                f"{len(self.distortion)} distortion terms: {self.model} has {len(names)}, {' '.join(names)}"
            )

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float, model: str = PLUMB_BOB) -> "Camera":
        """An ideal camera: square pixels, principal point at the frame's centre, all coefficients 0."""
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return cls(width=width, height=height, fx=focal_px, fy=focal_px, cx=cx, cy=cy, model=model)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the coefficients of its distortion."""
        names = COEFFICIENTS[self.model]
        more = self.model == EQUIDISTANT and len(self.distortion) == len(names) + len(DECENTRED)
        return (*names, *DECENTRED) if more else names

    @property
    def stated(self) -> tuple[str, tuple[float, ...]]:
        """Model and coefficients in files and messages, as `stated_lens` reads them."""
        if self.coefficients[-2:] != DECENTRED:
            return self.model, self.distortion
        k1, k2, k3, k4, p1, p2 = self.distortion
        return THIN_PRISM_FISHEYE, (k1, k2, p1, p2, k3, k4, 0.0, 0.0)

    @cached_property
    def lens(self) -> Lens:
        """Its lens: between directions in C and places in focal lengths."""
        d = self.distortion
        return Equidistant(d, _reach(d)) if self.model == EQUIDISTANT else PlumbBob(d)

    @cached_property
    def is_ideal(self) -> bool:
        """Whether the camera is a pinhole without distortion."""
        return self.model != EQUIDISTANT and not any(self.distortion)

    @property
    def scale_arcsec(self) -> float:
        """Plate scale on the optical axis, arcsec per px."""
        return float(np.degrees(1 / np.sqrt(self.fx * self.fy)) * 3600)

    @property
    def half_diagonal_rad(self) -> float:
        """Angle to the frame's corner, without a pinhole's distortion, or to the end of a fisheye's picture."""
        corner = 0.5 * math.hypot(self.width / self.fx, self.height / self.fy)
        if not isinstance(self.lens, Equidistant):
            return math.atan(corner)
        angle = self.lens.angle_at(corner)
        return angle if math.isfinite(angle) else self.lens.reach

    @property
    def centre_px(self) -> tuple[float, float]:
        """The frame's centre (not the principal point), px."""
        return (self.width - 1) / 2, (self.height - 1) / 2

    @cached_property
    def centre_ray(self) -> np.ndarray:
        """Unit vector (3,) in C of the frame's centre."""
        return self.directions(*self.centre_px)

    @cached_property
    def centre_from_axis(self) -> tuple[float, float, float]:
        """How far the frame's centre is from the axis, across and down, and the height of a row, in focal lengths."""
        x, y = self.centre_px
        return (x - self.cx) / self.fx, (y - self.cy) / self.fy, 1 / self.fy

    def scaled(self, factor: float) -> "Camera":
        """The camera with its focal lengths multiplied by `factor`."""
        return replace(self, fx=self.fx * factor, fy=self.fy * factor)

    def part(self, left: float, top: float, width: int, height: int) -> "Camera":
        """The camera of a part of its frame: its size in px, and column and row of its first pixel."""
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def sees(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Whether pixels x, y (N,) lie within the lens's picture: around a fisheye's picture the frame may be black."""
        places = self._places(x, y)
        if not isinstance(self.lens, Equidistant):
            return np.ones(places.shape[:-1], bool)
        return np.hypot(places[..., 0], places[..., 1]) < self.lens.picture

    def directions(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Unit vectors (N, 3) in C of pixels x, y (N,): of a pinhole W = (X, Y, f) / norm, after undistortion.

        The paper prints another third component; docs/the_paper.md#star-vectors says why it is f. NaN outside the
        picture of a fisheye. Raises InstrumentError where the distortion of a pinhole cannot be inverted.
        """
        places = self._places(x, y)
        v = self.lens.rays(places)
        lost = np.isnan(v[..., 0])
        if self.model != EQUIDISTANT and lost.any() and (lost & np.isfinite(places).all(-1)).any():
            raise InstrumentError(
                f"distortion {self.distortion} cannot be inverted inside the frame: calibrate the camera again"
            )
        return v

    def project(self, v: ArrayLike) -> np.ndarray:
        """Pixels (N, 2) of directions v (N, 3) in C; NaN behind a pinhole, and outside the picture of a fisheye."""
        return self.lens.places(v) * [self.fx, self.fy] + [self.cx, self.cy]

    def _places(self, x: ArrayLike, y: ArrayLike) -> np.ndarray:
        """Places (N, 2) of pixels x, y (N,), in focal lengths from the principal point."""
        x, y = np.asarray(x, float), np.asarray(y, float)
        places = np.empty((*np.broadcast(x, y).shape, 2))
        places[..., 0], places[..., 1] = (x - self.cx) / self.fx, (y - self.cy) / self.fy
        return places
