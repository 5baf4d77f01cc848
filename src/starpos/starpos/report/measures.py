# SPDX-License-Identifier: Apache-2.0
"""The numbers that the figures show: deviations of the frames from each other and from the truth."""

from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.report.night import Night, ReportedPlace, Truth
from starpos.units import ARCSEC

OUTLIER_SIGMA, CLAIMED_SIGMA = 5.0, 3.0
FEWEST_FOR_OUTLIERS = 5
SIGMA_PER_MAD = 1.4826
SAME_TIME_S = 0.01
TURNED_RAD, TURNED_SIGMA = (
    np.radians(0.1),
    10.0,
)  # headings further from their mean are of an instrument that turned
INSIDE_1_SIGMA = -2 * np.log(1 - 0.3935)  # squared distance of the ellipses in two dimensions
INSIDE_95 = -2 * np.log(1 - 0.95)
PAPER_STABILITY = (0.5256, 1.70, 6.336)  # arcsec, mean absolute deviations of latitude, longitude, north
PAPER_NIGHTS = (
    0.5028 * 60,
    0.816 * 60,
)  # arcsec, mean absolute errors of latitude and longitude in 50 nights


@dataclass(frozen=True, eq=False)
class Stability:
    """Frames against their mean: number (N,) from 1, arcsec (N, 3) of latitude, longitude, heading, their sigma (N, 3).

    outlier (N,): far from the others in latitude or longitude.  heading_from: 'mean', 'truth', or '' where the instrument
    turned and nobody knows how; its column is NaN then.
    """

    number: np.ndarray
    arcsec: np.ndarray
    sigma: np.ndarray
    outlier: np.ndarray
    heading_from: str

    @property
    def mean_absolute(self) -> np.ndarray:
        return np.abs(self.arcsec).mean(0)


def stability(night: Night) -> Stability:
    """Of each frame's own fix; at least one."""
    places = [s.place for _, s in night.fixed]
    seen = np.array([[p.latitude, p.longitude, p.heading] for p in places])
    away, heading_from = _from_mean(seen), "mean"
    if np.abs(away[:, 2]).max() > max(
        TURNED_RAD, TURNED_SIGMA * np.median([_own_sigma(p)[2] for p in places])
    ):
        true = _true_headings(night)
        heading_from = "truth" if true is not None else ""
        away[:, 2] = np.nan if true is None else wrapped(seen[:, 2] - true)
    sigma = np.array([_own_sigma(p) for p in places])
    return Stability(
        np.array([k for k, _ in night.fixed]),
        away / ARCSEC,
        sigma / ARCSEC,
        _outliers(away[:, :2], sigma[:, :2]),
        heading_from,
    )


def steadiness(night: Night) -> Stability:
    """The same with one tilt for all frames: what stars and air do alone."""
    away = _from_mean(night.steady)
    without_tilt = np.array([_own_sigma(s.place, without="tilt") for _, s in night.fixed])
    return Stability(
        np.array([k for k, _ in night.fixed]),
        away / ARCSEC,
        without_tilt / ARCSEC,
        _outliers(away[:, :2], without_tilt[:, :2]),
        "mean",
    )


def around(night: Night, latitude: float, longitude: float) -> np.ndarray:
    """East, north in m of the frames with a fix from a place (rad), (N, 2)."""
    return np.array([offset_m(s.place, latitude, longitude) for _, s in night.fixed])


def offset_m(place: ReportedPlace | Truth, latitude: float, longitude: float) -> tuple[float, float]:
    """East, north in m of a place from another (rad)."""
    prime, meridian = curvature_radii_m(latitude)
    east = wrapped(place.longitude - longitude) * prime * np.cos(latitude)
    return float(east), float((place.latitude - latitude) * meridian)


def middle(night: Night) -> tuple[float, float]:
    """Latitude, longitude (rad) that the scatter is drawn about: the combined place, else the frames' mean."""
    if night.combined:
        return night.combined.latitude, night.combined.longitude
    seen = np.array([[s.place.latitude, s.place.longitude] for _, s in night.fixed])
    latitude, longitude = seen[0] + wrapped(seen - seen[0]).mean(0)
    return float(latitude), float(longitude)


def share_inside(night: Night, squared_distance: float) -> int:
    """How many frames lie within an ellipse of their own errors about the middle."""
    apart = around(night, *middle(night))
    own = np.array([s.place.own[:2, :2] for _, s in night.fixed]) + np.eye(2) * 1e-12
    return int(np.sum(np.einsum("ni,nij,nj->n", apart, np.linalg.inv(own), apart) <= squared_distance))


def error_arcsec(night: Night) -> np.ndarray:
    """Latitude, longitude (2,) of the night less the truth, in arcsec."""
    c, t = night.combined, night.truth
    return wrapped(np.array([c.latitude - t.latitude, c.longitude - t.longitude])) / ARCSEC


def sigma_arcsec(place: ReportedPlace) -> np.ndarray:
    """1 sigma of latitude and longitude (2,) in arcsec."""
    return _angles(place.covariance, place.latitude)[:2] / ARCSEC


def wrapped(angle):
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _from_mean(seen: np.ndarray) -> np.ndarray:
    away = wrapped(seen - seen[0])
    return away - away.mean(0)


def _own_sigma(place: ReportedPlace, without: str = "none") -> np.ndarray:
    """Latitude, longitude, heading in rad, of what is new in each frame."""
    own = [t.covariance[:3, :3] for t in place.terms if not t.common and not t.name.startswith(without)]
    return _angles(sum(own, np.zeros((3, 3))), place.latitude)


def _angles(covariance: np.ndarray, latitude: float) -> np.ndarray:
    prime, meridian = curvature_radii_m(latitude)
    east, north, heading = np.sqrt(np.diag(covariance))
    return np.array([north / meridian, east / (prime * max(np.cos(latitude), 1e-9)), heading])


def _outliers(away: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Far off the scatter of all, and further than their own claims (N, 2) allow."""
    if len(away) < FEWEST_FOR_OUTLIERS:
        return np.zeros(len(away), bool)
    far = np.abs(away - np.median(away, axis=0))
    wide = OUTLIER_SIGMA * (SIGMA_PER_MAD * np.median(far, axis=0) + 1e-12)
    return ((far > wide) & (far > CLAIMED_SIGMA * sigma)).any(1)


def _true_headings(night: Night) -> np.ndarray | None:
    """(N,) rad, one a fix; None where some are unknown."""
    if night.truth is None or not night.truth.headings:
        return None
    moments, headings = np.array(night.truth.headings).T
    at = np.array([s.utc_unix_s for _, s in night.fixed])
    nearest = np.abs(at[:, None] - moments).argmin(1)
    return headings[nearest] if (np.abs(at - moments[nearest]) < SAME_TIME_S).all() else None
