# SPDX-License-Identifier: Apache-2.0
"""The error budget of a fix: each source of error as what it does to place, heading and attitude."""

from dataclasses import KW_ONLY, dataclass

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import ROTATION_RAD_S, EarthState
from starpos.instrument.inclinometer import Tilt, a2_matrix
from starpos.instrument.mounting import Mounting
from starpos.units import HOUR_S

STEP_RAD = 1e-6


ALWAYS = ("always",)


@dataclass(frozen=True)
class ErrorTerm:
    """One source of error: factor (6, m) of the covariance variance * factor @ factor.T.

    Rows: east m, north m, heading rad, and the attitude's small rotation about east, north, up in rad.  shared: None
    where the error is new in every frame; else the keys of what it is the mean of, and the m errors of two frames have
    the `correlation` of their keys: ALWAYS for a calibration or a clock.  walk_s: by how much the variance grows in a
    second, for an error that wanders.  posed: the factor is the same as long as nobody touches the camera; that it
    differs is noise.
    """

    name: str
    factor: np.ndarray
    _: KW_ONLY
    shared: tuple | None = None
    variance: float = 1.0
    walk_s: float = 0.0
    posed: bool = False

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6)."""
        return self.variance * self.factor @ self.factor.T

    @property
    def common(self) -> bool:
        """Whether it keeps its sign from frame to frame."""
        return self.shared == ALWAYS


def correlation(a: tuple, b: tuple) -> float:
    """Of two means of equally good readings, by the keys of these."""
    return len(set(a) & set(b)) / (len(a) * len(b)) ** 0.5 if a and b else 0.0


@dataclass(frozen=True)
class Place:
    """What A4 says: latitude, longitude (rad); east and north as unit vectors (3,) of L."""

    latitude: float
    longitude: float
    east: np.ndarray
    north: np.ndarray

    @property
    def local_to_enu(self) -> np.ndarray:
        """(3, 3)."""
        return np.stack([self.east, self.north, [0.0, 0.0, 1.0]])


def place_of(a4: np.ndarray) -> Place:
    """Zenith and pole of A4 (3, 3), ITRS into L; at a pole, where north is any direction, L's X is taken."""
    zenith, pole = a4[2], a4[:, 2]
    north = np.array([pole[0], pole[1], 0.0])
    length = np.linalg.norm(north)
    north = north / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    latitude = np.arctan2(zenith[2], np.hypot(zenith[0], zenith[1]))
    return Place(
        float(latitude), float(np.arctan2(zenith[1], zenith[0])), np.cross(north, [0.0, 0.0, 1.0]), north
    )


@dataclass(frozen=True)
class Sensitivity:
    """How the rows of an ErrorTerm answer to small rotations (6, 3) about L's axes.

    stars: of the sky against L (A4 alone); level: of L against sky and instrument (A4 and the attitude together).
    """

    stars: np.ndarray
    level: np.ndarray

    @classmethod
    def of(cls, a4: np.ndarray, link_to_enu: np.ndarray) -> "Sensitivity":
        p = place_of(a4)
        prime, meridian = curvature_radii_m(p.latitude)
        # the zenith among the stars moves by (-dy, dx) in L
        moved = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        ground = np.stack([p.east @ moved * prime, p.north @ moved * meridian])
        # north turns in L with the pole, and the attitude against it
        px, py, pz = a4[:, 2]
        flat = max(px * px + py * py, 1e-12)
        north_turns = np.array([-px * pz, -py * pz, flat]) / flat
        about_up = np.stack([np.zeros(3), np.zeros(3), -north_turns])
        return cls(
            *(
                np.vstack([ground, _heading_row(spin, link_to_enu), spin])
                for spin in (about_up, about_up + p.local_to_enu)
            )
        )


def heading_of(link_to_enu: np.ndarray) -> float:
    """Azimuth (rad, 0 to 2 pi) of the base link's x axis."""
    return rotation.full_turn(np.arctan2(link_to_enu[0, 0], link_to_enu[1, 0]))


def _heading_row(spin: np.ndarray, link_to_enu: np.ndarray) -> np.ndarray:
    """(1, 3): the heading's answer to rotations that spin (3, 3) the attitude about east, north, up."""
    east, north, up = link_to_enu[:, 0]
    level = max(east * east + north * north, 1e-12)
    # d azimuth = (north d_east - east d_north) / level, with d(forward) = spin x forward
    return np.array([[east * up / level, north * up / level, -1.0]]) @ spin


def symmetric_root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric F with F F = covariance, also of a singular one; it keeps its signs from frame to frame."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


@dataclass(frozen=True)
class StarErrors:
    """Errors of a fix's stars: gain (3, N, 2), rad of A4 for a pixel of each star; covariances (N, 2, 2) in px2.

    same_stars: keys that frames with the same stars, and so the same errors of the catalogue, have in common.
    """

    gain: np.ndarray
    centroids: np.ndarray
    catalogue: np.ndarray
    same_stars: tuple

    @classmethod
    def of(
        cls, slope: np.ndarray, centroids: np.ndarray, catalogue: np.ndarray, same_stars: tuple
    ) -> "StarErrors":
        """Of weighted least squares; slope (N, 2, P): px for each parameter, of which the first three turn A4."""
        weighted = np.linalg.solve(centroids + catalogue, slope)
        normal = np.einsum("nki,nkj->ij", slope, weighted)
        return cls(
            np.einsum("ij,nkj->ink", np.linalg.inv(normal), weighted)[:3], centroids, catalogue, same_stars
        )

    def rotation_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """(3, 3) rad2 of A4 from independent covariances (N, 2, 2)."""
        return np.einsum("anj,njk,bnk->ab", self.gain, covariance, self.gain)


def error_terms(
    sensitivity: Sensitivity,
    stars: StarErrors,
    tilt: Tilt,
    mounting: Mounting,
    refraction_rotation: np.ndarray,
    latitude: float,
    earth: EarthState,
    clock_stddev_s: float,
    stamp_stddev_s: float,
) -> tuple[ErrorTerm, ...]:
    """All sources that are known.  refraction_rotation (3,) rad: of A4 for 1 sigma of refraction."""

    def of_stars(covariance):
        return sensitivity.stars @ symmetric_root(stars.rotation_covariance(covariance))

    prime, _ = curvature_radii_m(latitude)
    east, north = np.eye(6)[:, :1], np.eye(6)[:, 1:2]
    second_of_time = east * ROTATION_RAD_S * prime * np.cos(latitude)
    pole = np.hstack([east, north]) * earth.orientation.pole_sigma * prime
    a2 = a2_matrix(tilt.theta_x, tilt.theta_y)
    levelling = _levelling(tilt, a2)
    calibration = np.hstack(
        [a2 @ symmetric_root(mounting.calibration_covariance), levelling @ _far_turn(tilt, mounting)]
    )
    return (
        ErrorTerm("centroids", of_stars(stars.centroids)),
        ErrorTerm("catalogue", of_stars(stars.catalogue), shared=stars.same_stars),
        ErrorTerm("calibration", sensitivity.level @ calibration, shared=ALWAYS, posed=True),
        *_of_inclinometer(sensitivity.level @ levelling, tilt, mounting, earth.utc_unix_s),
        ErrorTerm("refraction", (sensitivity.stars @ refraction_rotation)[:, None], shared=ALWAYS),
        ErrorTerm("clock", second_of_time * clock_stddev_s, shared=ALWAYS),
        ErrorTerm(
            "time stamp", second_of_time * stamp_stddev_s, shared=ALWAYS
        ),  # lags are: nobody may count on it
        ErrorTerm("ut1", second_of_time * earth.orientation.ut1_sigma_s, shared=ALWAYS),
        ErrorTerm("pole", pole, shared=ALWAYS),
    )


def _far_turn(tilt: Tilt, mounting: Mounting) -> np.ndarray:
    """(2, 1) rad of theta_x, theta_y: what an A3 that is turned far about the plumb line makes of a lean beside the small
    rotation, which moves it sideways only: it comes out shorter by the turn's cosine.
    """
    up = a2_matrix(*mounting.calibrated_tilt)[2]
    variance = up @ mounting.calibration_covariance @ up
    # mean of (1 - cos)^2 of a Gaussian turn
    shorter2 = 1.5 - 2 * np.exp(-variance / 2) + np.exp(-2 * variance) / 2
    lean = np.array([tilt.theta_x, tilt.theta_y]) - mounting.calibrated_tilt
    return lean[:, None] * np.sqrt(max(shorter2, 0.0))


def _levelling(tilt: Tilt, a2: np.ndarray) -> np.ndarray:
    """(3, 2): small rotation of L for an error of theta_x, theta_y."""
    steps = (np.array([STEP_RAD, 0.0]), np.array([0.0, STEP_RAD]))
    turned = [a2_matrix(tilt.theta_x + dx, tilt.theta_y + dy) @ a2.T for dx, dy in steps]
    return np.stack([rotation.to_small_vector(r) / STEP_RAD for r in turned], -1)


def _of_inclinometer(
    level: np.ndarray, tilt: Tilt, mounting: Mounting, utc_unix_s: float
) -> tuple[ErrorTerm, ...]:
    """Its sources; level (6, 2): what an error of theta_x, theta_y does.  The zero is the calibration's."""
    errors, theta = mounting.inclinometer, np.array([tilt.theta_x, tilt.theta_y])
    warmer = tilt.temperature_c - mounting.calibrated_temperature_c
    since_s = abs(utc_unix_s - mounting.calibrated_unix_s)
    return (
        ErrorTerm("tilt", level @ symmetric_root(tilt.covariance), shared=tilt.times),
        ErrorTerm("tilt quantisation", level * errors.undithered_rad(tilt), shared=errors.steps(tilt)),
        ErrorTerm(
            "tilt drift",
            level * errors.drift_rad_per_sqrt_hour / np.sqrt(HOUR_S),
            shared=ALWAYS,
            variance=since_s if np.isfinite(since_s) else 0.0,
            walk_s=1.0,
            posed=True,
        ),
        ErrorTerm(
            "tilt temperature",
            level * errors.temperature_rad_per_c * (warmer if np.isfinite(warmer) else 0.0),
            shared=ALWAYS,
        ),
        ErrorTerm(
            "tilt scale", level * (theta - mounting.calibrated_tilt) * errors.scale, shared=ALWAYS, posed=True
        ),
    )
