# SPDX-License-Identifier: Apache-2.0
"""Random star fields of known pointing, and a tally of the answers that identification gives for them.

The fields repeat the paper's table.  Their places are the catalogue's at J2000, without aberration.  Seed and
number determine the stars of a field, whatever is done to them afterwards.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count

import numpy as np

from starpos.errors import CatalogueError
from starpos.frames.frame import Stars
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.sky.catalogue import Catalogue
from starpos.units import ARCSEC

# of the frame's centre; a pixel if that is more
TOLERANCE_ARCSEC = 20.0
# each false star is brighter than the next by this
FALSE_STEP_MAG = 0.1
# minimum and maximum number of points in a random field
POINTS = (5, 60)

# direction (3,) in ICRS of the frame's centre, None if not identified
Answer = Callable[[Stars], np.ndarray | None]


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """How a camera sees the stars brighter than limit_mag.

    sigma_px: error of a centroid per axis.  scatter_mag: error of a brightness.  missing: share of stars not detected.
    blend_px: stars closer than this become one.  focal_error: largest relative error of the assumed focal length.
    """

    camera: Camera
    limit_mag: float = 9.0
    sigma_px: float = 0.05
    scatter_mag: float = 0.3
    missing: float = 0.05
    blend_px: float = 4.0
    focal_error: float = 0.0

    @property
    def tolerance_rad(self) -> float:
        """Largest error (rad) of the frame's centre in a right answer."""
        return max(TOLERANCE_ARCSEC * ARCSEC, 1 / self.camera.fx)


def ideal(camera: Camera, limit_mag: float = 9.0, **more: float) -> Conditions:
    """The paper's conditions: each star is seen with its catalogue brightness, however close to the next it is."""
    return Conditions(camera=camera, limit_mag=limit_mag, scatter_mag=0.0, missing=0.0, blend_px=0.0, **more)


def limit_for(camera: Camera, catalogue: Catalogue, stars: float) -> float:
    """Limiting magnitude at which a frame of this camera holds this number of stars on average."""
    frames_in_sky = 4 * np.pi * camera.fx * camera.fy / (camera.width * camera.height)
    rank = min(int(stars * frames_in_sky), len(catalogue) - 1)
    return round(float(np.partition(catalogue.vmag_centi, rank)[rank]) / 100, 2)


@at_once
@dataclass(frozen=True)
class Field:
    """Stars of a frame at xy (N, 2) px, brightest first.

    centre (3,): ICRS direction of the frame's centre; None for random points.
    """

    xy: np.ndarray
    mag: np.ndarray
    centre: np.ndarray | None
    name: str

    def __len__(self) -> int:
        return len(self.xy)

    def brightest(self, n: int) -> "Field":
        """The field with its n brightest stars only."""
        return Field(self.xy[:n], self.mag[:n], self.centre, f"{self.name} {n} stars")

    def with_false(self, n: int, camera: Camera) -> "Field":
        """The field with n random points brighter than all its stars.

        The points of n are the last n of the points of n + 1.
        """
        rng = np.random.default_rng(list(self.name.encode()))
        points = rng.uniform(0, [camera.width - 1, camera.height - 1], (n, 2))[::-1]
        top = self.mag[0] if len(self.mag) else 9.0
        mag = top - FALSE_STEP_MAG * np.arange(n, 0, -1)
        return Field(
            np.concatenate([points, self.xy]),
            np.concatenate([mag, self.mag]),
            self.centre,
            f"{self.name} {n} false",
        )

    def stars(self, conditions: Conditions) -> Stars:
        """The list that a detector would give for this field."""
        n, camera = len(self), conditions.camera
        covariance = np.broadcast_to(np.eye(2) * conditions.sigma_px**2, (n, 2, 2))
        flux = 10 ** (-0.4 * (self.mag - 15))
        flags = np.zeros(n, np.uint8)
        return Stars(
            x=self.xy[:, 0],
            y=self.xy[:, 1],
            flux=flux,
            snr=np.full(n, 100.0),
            covariance=covariance,
            flags=flags,
            width=camera.width,
            height=camera.height,
            source=self.name,
        )


def draw(catalogue: Catalogue, conditions: Conditions, seed: int, number: int) -> Field:
    """Draw a field of a random part of the sky at a random angle."""
    c, rng = conditions, np.random.default_rng([seed, number])
    attitude, r = np.linalg.qr(rng.normal(size=(3, 3)))
    attitude = attitude * np.sign(np.diag(r))
    attitude[0] *= np.linalg.det(attitude)
    camera = c.camera.scaled(1 + c.focal_error * rng.uniform(-1, 1))
    reach = camera.half_diagonal_rad * 1.01
    index = catalogue.cone(attitude[2], reach, c.limit_mag + 4 * c.scatter_mag)
    xy = camera.project(catalogue.directions(index) @ attitude.T)
    xy = xy + rng.normal(0, c.sigma_px, xy.shape)
    mag = catalogue.vmag(index) + rng.normal(0, 1, len(index)) * c.scatter_mag
    seen = (xy > 0).all(1) & (xy < [camera.width - 1, camera.height - 1]).all(1) & (mag < c.limit_mag)
    seen &= rng.random(len(index)) >= c.missing
    order = np.flatnonzero(seen)[np.argsort(mag[seen], kind="stable")]
    return Field(*blended(xy[order], mag[order], c.blend_px), attitude[2], f"seed {seed} field {number}")


def blended(xy: np.ndarray, mag: np.ndarray, reach_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and magnitudes after stars closer than reach_px were joined to the brighter one; brightest first."""
    xy, light, single = xy.copy(), 10 ** (-0.4 * mag), np.ones(len(mag), bool)
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    for a, b in zip(*np.nonzero(np.triu(apart < reach_px, 1)), strict=True):
        if single[a] and single[b]:
            xy[a] = (light[a] * xy[a] + light[b] * xy[b]) / (light[a] + light[b])
            light[a] += light[b]
            single[b] = False
    order = np.flatnonzero(single)[np.argsort(-light[single], kind="stable")]
    return xy[order], -2.5 * np.log10(light[order])


def false_stars(catalogue: Catalogue, conditions: Conditions, seed: int, n: int) -> Iterator[Field]:
    """Fields with n false stars; endless."""
    for number in count():
        yield draw(catalogue, conditions, seed, number).with_false(n, conditions.camera)


def few_stars(catalogue: Catalogue, conditions: Conditions, seed: int, n: int) -> Iterator[Field]:
    """The n brightest stars of each field that has as many; endless.  Raises CatalogueError if hardly any has."""
    found = 0
    for number in count():
        drawn = draw(catalogue, conditions, seed, number)
        if len(drawn) >= n:
            found += 1
            yield drawn.brightest(n)
        elif number > 1000 * (found + 1):
            raise CatalogueError(
                f"fields with V < {conditions.limit_mag:g} hardly ever hold {n} stars: ask for fewer"
            )


def points(conditions: Conditions, seed: int) -> Iterator[Field]:
    """Fields of random points; endless."""
    camera = conditions.camera
    for number in count():
        rng = np.random.default_rng([seed, number, 1])
        n = int(rng.integers(*POINTS))
        xy = rng.uniform(0, [camera.width - 1, camera.height - 1], (n, 2))
        yield Field(xy, np.sort(rng.uniform(4, 9, n)), None, f"seed {seed} points {number}")


@dataclass
class Tally:
    """Counts of right, wrong (or invented) and missing answers to fields.

    cpu_ms: CPU time of each answer.
    """

    correct: int = 0
    wrong: int = 0
    none: int = 0
    cpu_ms: list[float] = field(default_factory=list)

    @property
    def fields(self) -> int:
        """Number of fields."""
        return self.correct + self.wrong + self.none

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval (Wilson 1927) of the probability of a right answer."""
        # slow to import
        from scipy.stats import binomtest

        if not self.fields:
            return 0.0, 1.0
        low, high = binomtest(self.correct, self.fields).proportion_ci(method="wilson")
        return float(low), float(high)

    def ask(self, given: Field, stars: Stars, answer: Answer, tolerance_rad: float) -> None:
        """Count the answer to one more field, given as stars."""
        begin = time.process_time()
        found = answer(stars)
        self.cpu_ms.append(1000 * (time.process_time() - begin))
        if found is None:
            self.none += 1
        elif given.centre is not None and np.linalg.norm(found - given.centre) < tolerance_rad:
            self.correct += 1
        else:
            self.wrong += 1
