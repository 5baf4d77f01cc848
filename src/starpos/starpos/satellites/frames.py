# SPDX-License-Identifier: Apache-2.0
"""Frames to trails: directions of both ends of each trail against the catalogue places of the stars around it.

Near a trail, pixels become directions by polynomials that its stars determine. They hold the lens, and refraction and
aberration as these stars have them, so neither a place nor a calibration is needed. The camera stands on the ground.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos.earth.ellipsoid import enu_at_zenith
from starpos.earth.orientation import earth_motion
from starpos.errors import FrameError
from starpos.fix.checks import check_exposure
from starpos.fix.solution import Solution
from starpos.frames.exposure import UNKNOWN_SHUTTER
from starpos.frames.frame import Frame, FrameTrail, Stars
from starpos.instrument.camera import Camera
from starpos.rotation import normalised
from starpos.satellites.trails import SatelliteTrail, turned
from starpos.sky.catalogue import Catalogue
from starpos.units import SIGMA_PER_MAD

# Minimum number of stars for polynomials of order 1, 2 and 3; how many of the stars nearest to a trail determine them, at
# most, and cosine of their greatest distance.
STARS_OF_ORDER, MAX_STARS, COS_FARTHEST = (6, 20, 60), 600, math.cos(math.radians(25))
# How far from a trail's end a star may be taken for its end, in widths of stars; their width (px) where it is unknown.
REACH_FWHM, USUAL_FWHM = 2.0, 2.5
# Larger residuals, in standard deviations, are left out.
OUTLIER = 4.0
# Beyond this angle from the middle of the stars, only identified stars explain light.
COS_WIDEST = math.cos(math.radians(40))


@dataclass(frozen=True, eq=False)
class Plate:
    """Polynomials that take points (N, 2) to points (N, 2), fitted to pairs of them.

    middle, scale: make the points about -1 to 1.  coefficients (T, 2).
    covariance (T, T): of the coefficients of either coordinate.
    """

    order: int
    middle: np.ndarray
    scale: float
    coefficients: np.ndarray
    covariance: np.ndarray

    @classmethod
    def fit(cls, points: np.ndarray, to: np.ndarray, sigma: np.ndarray) -> "Plate":
        """The plate of pairs with errors sigma (N,), in units of `to`, which may be too small, and outliers."""
        order = sum(len(points) >= fewest for fewest in STARS_OF_ORDER)
        middle = points.mean(0)
        scale = max(float(np.abs(points - middle).max()), 1e-12)
        terms = _terms((points - middle) / scale, order)
        shared, kept = 0.0, np.ones(len(points), bool)
        for _ in range(4):
            weight = kept / np.hypot(sigma, shared)
            inverse = np.linalg.pinv(terms * weight[:, None])
            coefficients = inverse @ (to * weight[:, None])
            rest = to - terms @ coefficients
            typical = float(np.median(np.abs(rest))) * SIGMA_PER_MAD
            shared = math.sqrt(max(typical**2 - float(np.median(sigma)) ** 2, 0.0))
            kept = np.abs(rest).max(1) < OUTLIER * np.hypot(sigma, shared)
        freedom = max(2 * (np.count_nonzero(weight) - terms.shape[1]), 1)
        chi2 = float(((rest * weight[:, None]) ** 2).sum()) / freedom
        return cls(order, middle, scale, coefficients, inverse @ inverse.T * max(chi2, 1.0))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return _terms((points - self.middle) / self.scale, self.order) @ self.coefficients

    def variance(self, points: np.ndarray) -> np.ndarray:
        """Variance (N,) of either coordinate by the errors of the pairs."""
        terms = _terms((points - self.middle) / self.scale, self.order)
        return np.einsum("ni,ij,nj->n", terms, self.covariance, terms)


def _terms(xy: np.ndarray, order: int) -> np.ndarray:
    """Monomials (N, T) of points (N, 2)."""
    x, y = xy.T
    return np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], -1)


@dataclass(frozen=True, eq=False)
class FrameSky:
    """The identified stars of a frame.

    stars: these alone.  directions (N, 3): their ICRS catalogue places at the date, turned with the Earth from the time
    of their rows to the middle of the first row's exposure, as the camera on the ground would see them then.
    """

    stars: Stars
    directions: np.ndarray
    magnitudes: np.ndarray

    @classmethod
    def of(cls, stars: Stars, solution: Solution, catalogue: Catalogue) -> "FrameSky":
        """The sky of a frame's stars. FrameError if they are not identified, or if time or exposure are not stated."""
        found, pointing = solution.found, solution.pointing
        if found is None or pointing is None:
            raise FrameError(solution.message)
        if stars.mid_unix_s is None:
            raise FrameError(
                f"{stars.place}: {stars.untimed or 'it has no time'}, and satellites move: give DATE-OBS"
            )
        if not stars.exposure_s:
            raise FrameError(
                f"{stars.place}: its exposure time is not stated, and a trail's ends are its beginning and its end: give "
                "EXPTIME in its header"
            )
        order = np.argsort(found.star)
        seen, rows = stars.select(found.star[order]), found.catalogue[order]
        directions = catalogue.directions(rows, earth_motion(stars.mid_unix_s)[0])
        check_exposure(stars, Camera.from_focal(stars.width, stars.height, pointing.focal_px), directions)
        return cls(seen, turned(directions, -_later_s(seen, seen.y)), catalogue.vmag(rows))

    def explained(self, catalogue: Catalogue) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels x, y and flux (N,) of all stars of the catalogue on the frame; of a wide frame, of the identified."""
        stars, axes = self.stars, enu_at_zenith(self.directions.mean(0))
        seen = self.directions @ axes.T
        if seen[:, 2].min() < COS_WIDEST or len(seen) < STARS_OF_ORDER[0]:
            return stars.x, stars.y, stars.flux
        pixels = np.stack([stars.x, stars.y], 1)
        plate = Plate.fit(seen[:, :2] / seen[:, 2:], pixels, stars.sigma)
        rows = catalogue.cone(axes[2], math.acos(seen[:, 2].min()))
        v = catalogue.directions(rows, earth_motion(stars.mid_unix_s or 0.0)[0]) @ axes.T
        x, y = plate(v[:, :2] / v[:, 2:]).T
        zero = np.median(np.log10(stars.flux) + 0.4 * self.magnitudes)
        return x, y, 10 ** (zero - 0.4 * catalogue.vmag(rows))

    def doubted(self, found: Sequence[FrameTrail], catalogue: Catalogue) -> list[FrameTrail]:
        """Trails found with the identified stars alone: wider along the way where another star may be what ends there."""
        x, y, _ = self.explained(catalogue)
        pixels = np.stack([x, y], 1)
        reach = REACH_FWHM * (self.stars.fwhm_px or USUAL_FWHM)
        known = np.hypot(*(pixels[:, None] - np.stack([self.stars.x, self.stars.y], 1)).T).min(0) < reach
        trails = []
        for trail in found:
            covariance, way = trail.covariance.copy(), normalised(trail.ends[1] - trail.ends[0])
            for k, end in enumerate(trail.ends):
                if (np.hypot(*(pixels[~known] - end).T) < reach).any():
                    covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += reach**2 / 3 * np.outer(way, way)
            trails.append(replace(trail, covariance=covariance))
        return trails

    def ends(self, trail: FrameTrail) -> tuple[np.ndarray, np.ndarray]:
        """Directions (2, 3) of a trail's ends as the stars' `directions` have it, and covariances (2, 2, 2) rad2.

        The covariances are along growing right ascension and declination. FrameError with too few stars around.
        """
        stars, middle = self.stars, trail.ends.mean(0)
        near = np.argsort(np.hypot(stars.x - middle[0], stars.y - middle[1]))[:MAX_STARS]
        axes = enu_at_zenith(self.directions[near[: STARS_OF_ORDER[0]]].mean(0))
        near = near[self.directions[near] @ axes[2] > COS_FARTHEST]
        if len(near) < STARS_OF_ORDER[0]:
            raise FrameError(
                f"{stars.place}: a trail has {len(near)} identified stars around it and needs {STARS_OF_ORDER[0]}"
            )
        pixels, seen = np.stack([stars.x[near], stars.y[near]], 1), self.directions[near] @ axes.T
        points = seen[:, :2] / seen[:, 2:]
        # rad per px: both spreads are of the same stars
        scale = math.sqrt(points.var(0).sum() / pixels.var(0).sum())
        plate = Plate.fit(pixels, points, stars.sigma[near] * scale)

        def at(pixel: np.ndarray) -> np.ndarray:
            return normalised(np.column_stack([plate(pixel), np.ones(len(pixel))])) @ axes

        directions = at(trail.ends)
        sky = np.stack([enu_at_zenith(d)[:2] for d in directions])
        step = np.eye(2) / 2
        change = np.stack([at(trail.ends + d) - at(trail.ends - d) for d in step], -1)
        turn = sky @ change
        own = np.stack([trail.covariance[:2, :2], trail.covariance[2:, 2:]])
        shared = plate.variance(trail.ends)[:, None, None] * np.eye(2)
        return directions, turn @ own @ turn.transpose(0, 2, 1) + shared

    def sighted(self, found: Sequence[FrameTrail]) -> tuple[list[SatelliteTrail], str]:
        """Trails found on the frame, as seen from the ground, with tracks from 0 and the time of each end's row.

        Of a trail that leaves the frame one end counts. One that is cut at both, or whose light is uneven, is left
        out, and a sentence, else '', says so. FrameError with too few stars around a trail.
        """
        stars = self.stars
        trails: list[SatelliteTrail] = []
        for seen in found:
            if seen.cut.all() or not seen.steady:
                continue
            directions, covariance = self.ends(seen)
            rows = seen.ends[:, 1]
            middle_s = _later_s(stars, rows)
            half_s = np.array([-1.0, 1.0]) * (stars.exposure_s or 0.0) / 2
            towards = None
            if seen.cut.any():
                kept = np.flatnonzero(~seen.cut)
                towards = turned(directions[seen.cut], middle_s[kept] - abs(half_s[:1]))[0]
                directions, covariance, rows, middle_s = (
                    x[kept] for x in (directions, covariance, rows, middle_s)
                )
                half_s = -abs(half_s[:1])
            row_error_s = (stars.shutter or UNKNOWN_SHUTTER).errors_s(rows, stars.height).mean(0)
            trails.append(
                SatelliteTrail(
                    track=len(trails),
                    directions=turned(directions, middle_s + half_s),
                    covariance=covariance,
                    utc_unix_s=(stars.mid_unix_s or 0.0) + middle_s + half_s,
                    turned_utc_unix_s=(stars.mid_unix_s or 0.0) + middle_s - half_s,
                    towards=towards,
                    time_stddev_s=float(np.hypot(stars.stamp_stddev_s, np.hypot(*row_error_s))),
                    file=stars.source,
                )
            )
        uneven = sum(not seen.steady for seen in found)
        cut = len(found) - len(trails) - uneven
        why = [f"{cut} leave the frame at both ends"] * (cut > 0) + [f"{uneven} flash or fade"] * (uneven > 0)
        left_out = f"{stars.place}: of {len(found)} trails {' and '.join(why)}: left out" if why else ""
        return trails, left_out


def trails_of(
    frame: Frame, stars: Stars, solution: Solution, catalogue: Catalogue
) -> tuple[list[SatelliteTrail], str]:
    """The trails on a frame whose stars were identified, and a sentence, else '', on those left out.

    FrameError without a time, an exposure or enough stars.
    """
    from starpos.detection.trails import find_trails

    sky = FrameSky.of(stars, solution, catalogue)
    return sky.sighted(find_trails(frame, stars, *sky.explained(catalogue)))


def _later_s(stars: Stars, rows: np.ndarray) -> np.ndarray:
    """Time (N,) from the middle of the first row's exposure to the middle of the rows' (N,) px."""
    return (stars.shutter or UNKNOWN_SHUTTER).later_s(rows, stars.height)
