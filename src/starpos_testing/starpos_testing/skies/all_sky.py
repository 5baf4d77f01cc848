# SPDX-License-Identifier: Apache-2.0
"""Star lists of all-sky cameras: the catalogue through a fisheye, with what stands in the way and what is no star."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from starpos import rotation
from starpos.frames.frame import Frame, Stars
from starpos.sky.catalogue import Catalogue

# What lenses make of the angle off their axis, in focal lengths.
LENSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "equidistant": lambda t: t,
    "equisolid": lambda t: 2 * np.sin(t / 2),
    "stereographic": lambda t: 2 * np.tan(t / 2),
    # of the kind that board cameras have
    "between": lambda t: t * (1 - 0.02 * t**2 - 0.004 * t**4),
}
EXTINCTION_MAG = 0.2


@dataclass(kw_only=True)
class AllSky:
    """What an all-sky camera sees, brightest first: pixels, magnitudes, directions in C, which are stars.

    lens, radius_px, field_deg  how the picture, of that radius and diameter, is made
    """

    catalogue: Catalogue
    rng: np.random.Generator
    lens: str = "equidistant"
    width: int = 1280
    height: int = 960
    radius_px: float = 470.0
    field_deg: float = 180.0
    limit_mag: float = 5.0
    off_px: float = 8.0
    lean_deg: float = 5.0
    attitude: np.ndarray = field(init=False)
    xy: np.ndarray = field(init=False)
    mag: np.ndarray = field(init=False)
    altitude: np.ndarray = field(init=False)
    azimuth: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = self.rng
        self.attitude = rotation.best_rotation(rng.normal(size=(1, 3, 3)), rng.normal(size=(1, 3, 3)))[0]
        self.centre = np.array([self.width - 1, self.height - 1]) / 2 + rng.normal(0, self.off_px, 2)
        self.focal_px = self.radius_px / float(LENSES[self.lens](np.radians(self.field_deg / 2)))
        lean = rotation.from_vector(np.radians(rng.normal(0, self.lean_deg, 3)) * [1, 1, 0])
        self.zenith = lean @ np.array([0.0, 0.0, 1.0])
        v = (
            self.catalogue.directions(np.flatnonzero(self.catalogue.vmag() < self.limit_mag))
            @ self.attitude.T
        )
        mag = self.catalogue.vmag(np.flatnonzero(self.catalogue.vmag() < self.limit_mag))
        self.altitude = np.arcsin(v @ self.zenith)
        mag = mag + EXTINCTION_MAG / np.maximum(np.sin(self.altitude), 0.02) + rng.normal(0, 0.25, len(v))
        self.azimuth = np.arctan2(v[:, 1], v[:, 0])
        self.xy = self.pixels(v) + rng.normal(0, 0.25, (len(v), 2))
        self.mag = mag
        angle = np.arccos(np.clip(v[:, 2], -1, 1))
        self.keep(
            (angle < np.radians(self.field_deg / 2)) & (self.altitude > 0.02) & (mag < self.limit_mag + 0.3)
        )

    def pixels(self, v: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of directions v (N, 3) in C."""
        angle, around = np.arccos(np.clip(v[:, 2], -1, 1)), np.arctan2(v[:, 1], v[:, 0])
        r = self.focal_px * LENSES[self.lens](angle)
        return self.centre + r[:, None] * np.stack([np.cos(around), np.sin(around)], 1)

    def keep(self, which: np.ndarray) -> "AllSky":
        """Leave the others out, and what lies beyond the frame."""
        which = which & ((self.xy > 0) & (self.xy < [self.width - 1, self.height - 1])).all(1)
        for name in ("xy", "mag", "altitude", "azimuth"):
            setattr(self, name, getattr(self, name)[which])
        return self

    def add(self, altitude_deg: np.ndarray, azimuth: np.ndarray, mag: np.ndarray) -> "AllSky":
        """Add what is no star, at altitudes and azimuths (N,) as the lens sees them."""
        alt = np.radians(altitude_deg)
        v = np.stack([np.cos(alt) * np.cos(azimuth), np.cos(alt) * np.sin(azimuth), np.sin(alt)], 1)
        self.xy = np.concatenate([self.xy, self.pixels(v)])
        self.mag, self.altitude = np.append(self.mag, mag), np.append(self.altitude, alt)
        self.azimuth = np.append(self.azimuth, azimuth)
        return self.keep(np.ones(len(self.mag), bool))

    def _around(self, n: int) -> np.ndarray:
        return self.rng.uniform(-np.pi, np.pi, n)

    def horizon(self, lights: int = 40) -> "AllSky":
        """Haze to 8 deg, and lamps below that are brighter than any star."""
        self.keep(self.altitude > np.radians(8))
        return self.add(self.rng.uniform(0, 6, lights), self._around(lights), self.rng.uniform(-2, 2, lights))

    def trees(self) -> "AllSky":
        """Crowns up to 20 and 55 deg, and sky that shines through at their edge."""
        rng = self.rng
        phases, sizes = rng.uniform(0, 2 * np.pi, 4), rng.uniform(3, 10, 4)

        def top_deg(azimuth: np.ndarray) -> np.ndarray:
            waves = [
                s * np.cos((k + 1) * azimuth + p) for k, (s, p) in enumerate(zip(sizes, phases, strict=True))
            ]
            return np.clip(25 + sum(waves), 10, 55)

        self.keep(np.degrees(self.altitude) > top_deg(self.azimuth))
        gaps = self._around(50)
        return self.add(top_deg(gaps) - rng.uniform(0, 4, 50), gaps, rng.uniform(1, 4, 50))

    def dome(self) -> "AllSky":
        """Only a slit 70 deg wide is open, from the horizon over the zenith; its edges glint."""
        turn, rng = self.rng.uniform(0, np.pi), self.rng
        across = np.cos(self.altitude) * np.sin(self.azimuth - turn)
        self.keep(np.abs(across) < np.sin(np.radians(35)))
        alt = rng.uniform(0, 50, 16)
        side = np.where(rng.random(16) < 0.5, 1, -1) * np.arcsin(
            np.clip(np.sin(np.radians(35)) / np.cos(np.radians(alt)), -1, 1)
        )
        return self.add(alt, turn + side, rng.uniform(1, 3, 16))

    def aurora(self) -> "AllSky":
        """A band over a third of the sky: faint stars drown in it, and its rays are detections."""
        rng, middle = self.rng, self.rng.uniform(-np.pi, np.pi)
        inside = (np.abs(np.angle(np.exp(1j * (self.azimuth - middle)))) < 1.0) & (
            self.altitude < np.radians(65)
        )
        self.keep(~inside | (self.mag < 3.0))
        return self.add(rng.uniform(15, 65, 60), middle + rng.uniform(-1, 1, 60), rng.uniform(1.0, 3.5, 60))

    def moon(self) -> "AllSky":
        """The Moon, the faint stars that it outshines, and reflections of it in the lens."""
        alt, azimuth = self.rng.uniform(25, 70), self._around(1)[0]
        there = np.array(
            [np.cos(np.radians(alt)) * np.cos(azimuth), np.cos(np.radians(alt)) * np.sin(azimuth)]
        )
        here = np.cos(self.altitude)[:, None] * np.stack([np.cos(self.azimuth), np.sin(self.azimuth)], 1)
        away = np.hypot(*(here - there).T)
        self.keep((away > 0.35) & (self.mag < 3.2 + 1.5 * away))
        return self.add(
            np.array([alt, 90 - 0.4 * (90 - alt), 60.0]),
            azimuth + np.array([0, np.pi, np.pi]),
            np.array([-12.0, 0.0, 1.5]),
        )

    def planets(self) -> "AllSky":
        """Three of them."""
        return self.add(self.rng.uniform(15, 80, 3), self._around(3), self.rng.uniform(-4, 1, 3))

    @property
    def stars(self) -> Stars:
        """The list of stars, brightest first."""
        order = np.argsort(self.mag)
        n = len(order)
        return Stars(
            x=self.xy[order, 0], y=self.xy[order, 1], flux=10 ** (-0.4 * self.mag[order]), snr=np.full(n, 20.0),
            covariance=np.broadcast_to(0.09 * np.eye(2), (n, 2, 2)), flags=np.zeros(n),
            width=self.width, height=self.height,
        )  # fmt: skip

    def picture(self, glow: float = 12.0, noise: float = 2.0) -> Frame:
        """An 8-bit picture of the stars on a glowing sky, black around the disc, with what stands in the way as dark."""
        rng, shape = self.rng, (self.height, self.width)
        rows, columns = np.mgrid[: self.height, : self.width]
        away = np.hypot(columns - self.centre[0], rows - self.centre[1]) / self.radius_px
        pixels = np.where(away < 1, glow * (1 + 1.5 * away**4), 0.0)
        for (x, y), mag in zip(self.xy.tolist(), self.mag.tolist(), strict=True):
            i, j, reach = round(y), round(x), 5
            if not (reach <= i < shape[0] - reach and reach <= j < shape[1] - reach):
                continue
            near = np.s_[i - reach : i + reach + 1, j - reach : j + reach + 1]
            apart2 = (rows[near] - y) ** 2 + (columns[near] - x) ** 2
            pixels[near] += 400 * 10 ** (-0.4 * (mag - 1)) * np.exp(-0.5 * apart2 / 1.1**2)
        if (bright := self.mag < -8).any():
            moon = self.xy[bright][0]
            apart = np.hypot(columns - moon[0], rows - moon[1]) / self.radius_px
            pixels += np.where(away < 1, 60 / (0.05 + 4 * apart), 0.0)
        pixels = np.where(away < 1, pixels, 0.0) + 3 + rng.normal(0, noise, shape)
        return Frame(pixels=pixels.clip(0, 255).astype(np.uint8))

    @property
    def axis(self) -> np.ndarray:
        """Direction (3,) that the frame's middle shows."""
        centre = np.array([self.width - 1, self.height - 1]) / 2
        dx, dy = centre - self.centre
        # so near the axis all lenses are alike
        v = np.array([dx, dy, self.focal_px])
        return v / np.linalg.norm(v) @ self.attitude
