# SPDX-License-Identifier: Apache-2.0
"""Numbers for the figures: deviations of the frames from each other and from the truth."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, place_of_zenith, zenith_of
from starpos.fix.fix import PlaceFix
from starpos.night.night import Night, Truth, offset_m
from starpos.rotation import half_turns
from starpos.units import ARCSEC, SIGMA_PER_MAD

OUTLIER_SIGMA, CLAIMED_SIGMA = 5.0, 3.0
MIN_FOR_OUTLIERS = 5
SAME_TIME_S = 0.01
# if headings are further from their mean, the instrument was turned
TURNED_RAD, TURNED_SIGMA = np.radians(0.1), 10.0
# squared distances, in sigma, of the ellipses that hold 39 % and 95 % in two dimensions
INSIDE_1_SIGMA = -2 * np.log(1 - 0.3935)
INSIDE_95 = -2 * np.log(1 - 0.95)
# the paper's mean absolute deviations of latitude, longitude, north in arcsec
PAPER_STABILITY = (0.5256, 1.70, 6.336)
# the paper's mean absolute errors of latitude and longitude in 50 nights, in arcsec
PAPER_NIGHTS = (0.5028 * 60, 0.816 * 60)


@dataclass(frozen=True, eq=False)
class Stability:
    """Deviations of frames from their mean.

    number (N,): of each frame, from 1.  arcsec, sigma (N, 3): deviation of latitude, longitude, heading, and its sigma.
    outlier (N,): mask of frames far from the others in latitude or longitude.
    heading_from: what headings are compared with, 'mean' or 'truth'; '' if the instrument turned and the truth is
    unknown, their column is NaN then.
    """

    number: np.ndarray
    arcsec: np.ndarray
    sigma: np.ndarray
    outlier: np.ndarray
    heading_from: str

    @property
    def mean_absolute(self) -> np.ndarray:
        """Mean absolute deviation (3,) of latitude, longitude, heading in arcsec."""
        return np.abs(self.arcsec).mean(0)


def stability(night: Night) -> Stability:
    """Stability of the fixes of a night, each with its own tilt; at least one fix is needed."""
    places = night.places
    seen = np.array([[p.latitude, p.longitude, p.heading] for p in places])
    sigma, away, heading_from = _own_sigmas(night), _from_mean(seen), "mean"
    if np.abs(away[:, 2]).max() > max(TURNED_RAD, TURNED_SIGMA * np.median(sigma[:, 2])):
        true = _true_headings(night)
        heading_from = "truth" if true is not None else ""
        away[:, 2] = np.nan if true is None else half_turns(seen[:, 2] - true)
    return _stability(night, away, sigma, heading_from)


def steadiness(night: Night, steady: np.ndarray) -> Stability:
    """Stability of the fixes with one tilt for all, `steady` (N, 3) of the night: the part of stars and air alone."""
    return _stability(night, _from_mean(steady), _own_sigmas(night, without="tilt"), "mean")


def _stability(night: Night, away: np.ndarray, sigma: np.ndarray, heading_from: str) -> Stability:
    number, outlier = np.array([k for k, _ in night.fixed]), _outliers(away[:, :2], sigma[:, :2])
    return Stability(number, away / ARCSEC, sigma / ARCSEC, outlier, heading_from)


def around(night: Night, latitude: float, longitude: float) -> np.ndarray:
    """East, north (N, 2) in m of the fixes from a place (rad)."""
    return np.array([offset_m(p, latitude, longitude) for p in night.places])


def middle(night: Night) -> tuple[float, float]:
    """Latitude, longitude (rad) of the centre of the scatter: the average, or without one the mean of the fixes."""
    if night.combined:
        return night.combined.latitude, night.combined.longitude
    return place_of_zenith(np.mean([zenith_of(p.latitude, p.longitude) for p in night.places], axis=0))


def share_inside(night: Night, squared_distance: float) -> int:
    """Number of frames within an ellipse of their own errors about the middle."""
    apart = around(night, *middle(night))
    own = np.array([p.own[:2, :2] for p in night.places]) + np.eye(2) * 1e-12
    return int(np.sum(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(own), apart) <= squared_distance))


def error_arcsec(place: PlaceFix, truth: Truth) -> np.ndarray:
    """Latitude, longitude (2,) of a place minus the truth, in arcsec."""
    return half_turns(np.array([place.latitude - truth.latitude, place.longitude - truth.longitude])) / ARCSEC


def sigma_arcsec(place: PlaceFix) -> np.ndarray:
    """1 sigma of latitude and longitude (2,) in arcsec."""
    return _angles(place.covariance, place.latitude)[:2] / ARCSEC


def _from_mean(seen: np.ndarray) -> np.ndarray:
    away = half_turns(seen - seen[0])
    return away - away.mean(0)


def _own_sigmas(night: Night, without: str = "none") -> np.ndarray:
    """Sigma (N, 3) of latitude, longitude, heading in rad by the errors that are new in each frame."""
    found = []
    for p in night.places:
        own = [t.covariance[:3, :3] for t in p.terms if not t.common and not t.name.startswith(without)]
        found.append(_angles(sum(own, np.zeros((3, 3))), p.latitude))
    return np.array(found)


def _angles(covariance: np.ndarray, latitude: float) -> np.ndarray:
    prime, meridian = curvature_radii_m(latitude)
    east, north, heading = np.sqrt(np.diag(covariance))
    return np.array([north / meridian, east / (prime * max(np.cos(latitude), 1e-9)), heading])


def _outliers(away: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Mask (N,) of frames far outside the scatter of all, and further off than their own sigma (N, 2) allows."""
    if len(away) < MIN_FOR_OUTLIERS:
        return np.zeros(len(away), bool)
    far = np.abs(away - np.median(away, axis=0))
    wide = OUTLIER_SIGMA * (SIGMA_PER_MAD * np.median(far, axis=0) + 1e-12)
    return ((far > wide) & (far > CLAIMED_SIGMA * sigma)).any(1)


def _true_headings(night: Night) -> np.ndarray | None:
    """True headings (N,) in rad of the fixes; None if some are unknown."""
    if night.truth is None or not night.truth.headings:
        return None
    moments, headings = np.array(night.truth.headings).T
    at = np.array([s.utc_unix_s for _, s in night.fixed])
    nearest = np.abs(at[:, None] - moments).argmin(1)
    return headings[nearest] if (np.abs(at - moments[nearest]) < SAME_TIME_S).all() else None
