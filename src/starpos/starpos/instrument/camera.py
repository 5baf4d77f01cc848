# SPDX-License-Identifier: Apache-2.0
"""Turn pixels into unit vectors of the camera frame C and back, by a pinhole and its distortion or by a fisheye.

Pixel (0, 0) is the centre of the top-left pixel; C has x right, y down, z out along the optical axis.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import InstrumentError
from starpos.instrument._lens import Equidistant, Lens
from starpos.instrument.lens import COEFFICIENTS, EQUIDISTANT, PLUMB_BOB, lens_of


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics of a camera, as in sensor_msgs/CameraInfo; InstrumentError for impossible values.

    width, height  px of the frame
    fx, fy         focal lengths, px
    cx, cy         principal point, px
    distortion     coefficients of the model, by the names in COEFFICIENTS; (): all 0
    model          of the lens: PLUMB_BOB or RATIONAL, or EQUIDISTANT for a fisheye
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
        names = COEFFICIENTS[self.model]
        if len(self.distortion) != len(names):
            raise InstrumentError(
                f"{len(self.distortion)} distortion terms: {self.model} has {len(names)}, {' '.join(names)}"
            )

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float, model: str = PLUMB_BOB) -> "Camera":
        """An ideal camera: square pixels, principal point at the frame's centre, all coefficients 0."""
        cx, cy = (width - 1) / 2, (height - 1) / 2
        return cls(width=width, height=height, fx=focal_px, fy=focal_px, cx=cx, cy=cy, model=model)

    @cached_property
    def lens(self) -> Lens:
        """Its lens: between directions in C and places in focal lengths."""
        return lens_of(self.model, self.distortion)

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
