# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame: where the instrument stands and which way it faces, with the whole covariance.

The equation is the paper's (15), A2 A3 W = A4 A1 V, with refraction in L and the diurnal aberration of the site; its
residuals are taken in pixels, where the errors of the stars live.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, least_squares

from starpos import rotation
from starpos.atmosphere import Atmosphere, Refraction
from starpos.camera import Camera
from starpos.earth import ROTATION_RAD_S, EarthState, curvature_radii_m, station_velocity
from starpos.errors import FixError
from starpos.inclinometer import Tilt, a2_matrix

OUTLIER_SIGMA = 5.0
MAX_ROUNDS = 6
MIN_STARS = 3
STEP_RAD = 1e-6  # of the numerical derivatives; the functions are smooth at 1 rad


@dataclass(frozen=True)
class Mounting:
    """How the parts are fixed to each other: A3 (camera C into inclinometer S) and base link into C, (3, 3) each.

    calibration_covariance (3, 3) rad2: of A3 as a small rotation about S's axes, the inclinometer's zero included
    (only the sum of the two matters).
    """

    a3: np.ndarray
    link_to_camera: np.ndarray
    calibration_covariance: np.ndarray


@dataclass(frozen=True)
class ErrorTerm:
    """One source of error: factor (6, m) of the covariance factor @ factor.T.

    Rows: east m, north m, heading rad, and the attitude's small rotation about east, north, up in rad.  A common term
    keeps its sign from frame to frame (a calibration, a clock); the others are new in every frame.
    """

    name: str
    factor: np.ndarray
    common: bool

    @property
    def covariance(self) -> np.ndarray:
        """(6, 6)."""
        return self.factor @ self.factor.T


@dataclass(frozen=True)
class Fix:
    """Astronomic latitude, longitude and heading (rad) at one instant, with the error budget.

    link_to_enu (3, 3): attitude of the base link.  used (M,): which of the given stars were kept.  focal_scale: factor
    on the given focal length.  jitter_px: scatter beyond the centroids' own errors (seeing, optics).
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    link_to_enu: np.ndarray
    terms: tuple[ErrorTerm, ...]
    used: np.ndarray
    residual_arcsec: float
    jitter_px: float
    focal_scale: float
    zenith_distance: float
    refraction_arcsec: float
    diurnal_aberration_arcsec: float
    ut1_minus_utc_s: float

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) of east m, north m, heading rad."""
        return sum(t.covariance for t in self.terms)[:3, :3]

    @property
    def attitude_covariance(self) -> np.ndarray:
        """(3, 3) rad2 of the base link's orientation about east, north, up."""
        return sum(t.covariance for t in self.terms)[3:, 3:]


def solve_fix(
    xy: np.ndarray,
    covariance_px2: np.ndarray,
    places: np.ndarray,
    place_sigma: np.ndarray,
    camera: Camera,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
) -> Fix:
    """The fix of one frame from identified stars.

    xy (N, 2) px; covariance_px2 (N, 2, 2); places (N, 3): ICRS directions at the date; place_sigma (N,) rad, one axis.
    The start is closed (singular values), the rest Levenberg-Marquardt over the rotation A4 and the plate scale.
    Raises FixError where the stars are too few or do not agree.
    """
    problem = _Problem(
        xy,
        camera,
        a2_matrix(tilt.theta_x, tilt.theta_y) @ mounting.a3,
        earth.to_itrs(places),
        atmosphere.refraction(),
    )
    catalogue_px2 = np.eye(2) * ((place_sigma * camera.fx) ** 2)[:, None, None]
    keep, jitter2 = np.ones(len(xy), bool), 0.0
    state = problem.closed_form()
    for _ in range(MAX_ROUNDS):
        if keep.sum() < MIN_STARS:
            raise FixError(f"only {int(keep.sum())} stars agree with each other: no fix from so few")
        total = covariance_px2 + catalogue_px2 + np.eye(2) * jitter2
        state = problem.refine(state, np.linalg.cholesky(np.linalg.inv(total)), keep)
        residual = problem.residual(state)
        jitter2_new = _extra_variance(residual[keep], (covariance_px2 + catalogue_px2)[keep])
        total = covariance_px2 + catalogue_px2 + np.eye(2) * jitter2_new
        distance2 = np.einsum("ni,nij,nj->n", residual, np.linalg.inv(total), residual)
        keep_new = distance2 < OUTLIER_SIGMA**2
        settled = np.array_equal(keep, keep_new) and abs(jitter2_new - jitter2) <= 0.02 * (jitter2 + 1e-6)
        keep, jitter2 = keep_new, jitter2_new
        if settled:
            break
    if keep.sum() < max(MIN_STARS, 0.5 * len(xy)):
        raise FixError(
            f"only {int(keep.sum())} of {len(xy)} identified stars agree on one attitude: no fix from them"
        )
    return _report(problem, state, keep, covariance_px2, catalogue_px2, jitter2, tilt, mounting, atmosphere, earth,
                   clock_stddev_s)  # fmt: skip


def _extra_variance(residual: np.ndarray, covariance: np.ndarray) -> float:
    """The isotropic variance (px2) that brings chi-square to its expectation; 0 where it is not above it."""
    freedom = max(2 * len(residual) - 4, 1)

    def excess(extra):
        inverse = np.linalg.inv(covariance + np.eye(2) * extra)
        return np.einsum("ni,nij,nj->", residual, inverse, residual) - freedom

    if excess(0.0) <= 0:
        return 0.0
    high = 2 * np.sum(residual**2) / freedom + 1e-12
    return float(brentq(excess, 0.0, high, rtol=1e-3)) if excess(high) < 0 else float(high)


@dataclass(frozen=True)
class _State:
    a4: np.ndarray  # ITRS into L
    scale: float  # of the focal length


@dataclass(frozen=True)
class _Problem:
    xy: np.ndarray
    camera: Camera
    g: np.ndarray  # A2 A3: C into L
    itrs: np.ndarray  # geocentric apparent directions
    refraction: Refraction

    def closed_form(self) -> _State:
        local = self.refraction.unbend(self.camera.directions(*self.xy.T) @ self.g.T)
        a4 = rotation.best_rotation(self.itrs, local)
        for _ in range(2):  # the diurnal aberration needs the place it helps to find
            a4 = rotation.best_rotation(self.itrs + station_velocity(a4[2]), local)
        return _State(a4, 1.0)

    def predict(
        self, state: _State, refraction: Refraction | None = None, g: np.ndarray | None = None
    ) -> np.ndarray:
        """Pixels (N, 2) where the stars should be."""
        v = self.itrs + station_velocity(state.a4[2])
        v = v / np.linalg.norm(v, axis=1, keepdims=True)
        observed = (refraction or self.refraction).bend(v @ state.a4.T)
        return self.camera.scaled(state.scale).project(observed @ (self.g if g is None else g))

    def residual(self, state: _State) -> np.ndarray:
        return self.predict(state) - self.xy

    def moved(self, state: _State, p: np.ndarray) -> _State:
        """The state after a small rotation p[:3] about L's axes and a relative change p[3] of the scale."""
        return _State(rotation.from_vector(p[:3]) @ state.a4, state.scale * (1 + p[3]))

    def refine(self, state: _State, whiten: np.ndarray, keep: np.ndarray) -> _State:
        """Levenberg-Marquardt (MINPACK) from `state`; whiten (N, 2, 2): Cholesky factors of the inverse covariances."""

        def whitened(p):
            r = self.residual(self.moved(state, p))[keep]
            return np.einsum("nji,nj->ni", whiten[keep], r).ravel()

        if np.isnan(whitened(np.zeros(4))).any():
            raise FixError(
                "the identified stars do not fit into the camera's field: check focal length and tilt"
            )
        found = least_squares(whitened, np.zeros(4), method="lm", xtol=1e-12, ftol=1e-12)
        return self.moved(state, found.x)

    def jacobian(self, state: _State) -> np.ndarray:
        """d predict / d p, (N, 2, 4), central differences."""
        columns = []
        for i in range(4):
            p = np.zeros(4)
            p[i] = STEP_RAD
            columns.append(
                (self.predict(self.moved(state, p)) - self.predict(self.moved(state, -p))) / (2 * STEP_RAD)
            )
        return np.stack(columns, -1)


def _report(
    problem, state, keep, centroid_px2, catalogue_px2, jitter2, tilt, mounting, atmosphere, earth, clock_s
) -> Fix:
    total = (centroid_px2 + catalogue_px2 + np.eye(2) * jitter2)[keep]
    j = problem.jacobian(state)[keep]
    wj = np.linalg.solve(total, j)  # (M, 2, 4): weight times jacobian
    normal = np.einsum("nki,nkj->ij", j, wj)
    gain = np.linalg.solve(normal, wj.reshape(-1, 4).T).reshape(4, -1, 2)[
        :3
    ]  # rotation of A4 per pixel of star
    stars_move = _numerical(lambda d: _outcome(rotation.from_vector(d) @ state.a4, problem.g, mounting), 3)
    level_moves = _numerical(
        lambda d: _outcome(rotation.from_vector(d) @ state.a4, rotation.from_vector(d) @ problem.g, mounting),
        3,
    )

    def per_star(covariance):
        root = np.linalg.cholesky(covariance + np.eye(2) * 1e-18)
        return stars_move @ np.einsum("anj,njk->ank", gain, root).reshape(3, -1)

    def tilted(d):
        return rotation.to_small_vector(
            a2_matrix(tilt.theta_x + d[0], tilt.theta_y + d[1]) @ mounting.a3 @ problem.g.T
        )

    a2 = a2_matrix(tilt.theta_x, tilt.theta_y)
    weaker, stronger = (problem.predict(state, atmosphere.refraction(f))[keep] for f in (0.99, 1.01))
    pull = -np.einsum("anj,nj->a", gain, (stronger - weaker) / 0.02)
    latitude, longitude, *_ = _place(state.a4)
    prime, _ = curvature_radii_m(latitude)
    metres_a_second = ROTATION_RAD_S * prime * np.cos(latitude)
    pole = earth.orientation.pole_sigma * prime * np.eye(6)[:, :2]
    time_east = np.eye(6)[:, :1] * metres_a_second
    terms = (
        ErrorTerm("centroids", _compact(per_star(centroid_px2[keep] + np.eye(2) * jitter2)), False),
        ErrorTerm("catalogue", _compact(per_star(catalogue_px2[keep])), True),
        ErrorTerm("tilt", level_moves @ _numerical(tilted, 2) @ symmetric_root(tilt.covariance), False),
        ErrorTerm("calibration", level_moves @ a2 @ symmetric_root(mounting.calibration_covariance), True),
        ErrorTerm("refraction", (stars_move @ pull * atmosphere.relative_sigma)[:, None], True),
        ErrorTerm("clock", time_east * clock_s, True),
        ErrorTerm("ut1", time_east * earth.orientation.ut1_sigma_s, True),
        ErrorTerm("pole", pole, True),
    )
    outcome = _Outcome.of(state.a4, problem.g, mounting)
    observed = problem.camera.directions(*np.array(problem.camera.centre_px)[:, None]) @ problem.g.T
    bent = problem.refraction.unbend(observed)
    residual_px = problem.residual(state)[keep]
    return Fix(
        earth.utc_unix_s,
        latitude,
        longitude,
        outcome.heading,
        outcome.link_to_enu,
        terms,
        np.flatnonzero(keep),
        float(np.sqrt(np.mean(residual_px**2)) * problem.camera.scale_arcsec),
        float(np.sqrt(jitter2)),
        state.scale,
        float(np.arccos(np.clip(observed[0, 2], -1, 1))),
        float(np.degrees(np.arccos(np.clip(np.sum(observed * bent), -1, 1))) * 3600),
        float(np.degrees(np.linalg.norm(station_velocity(state.a4[2]))) * 3600),
        earth.orientation.ut1_minus_utc_s,
    )


@dataclass(frozen=True)
class _Outcome:
    heading: float
    link_to_enu: np.ndarray

    @classmethod
    def of(cls, a4: np.ndarray, g: np.ndarray, mounting: Mounting) -> "_Outcome":
        _, _, east, north = _place(a4)
        local_to_enu = np.stack([east, north, [0.0, 0.0, 1.0]])
        link_to_enu = local_to_enu @ g @ mounting.link_to_camera
        forward = link_to_enu[:, 0]
        return cls(float(np.arctan2(forward[0], forward[1]) % (2 * np.pi)), link_to_enu)


def _place(a4: np.ndarray) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Latitude, longitude (rad), and east and north as unit vectors in L, of A4 (ITRS into L)."""
    zenith, pole = a4[2], a4[:, 2]
    north = np.array([pole[0], pole[1], 0.0])
    length = np.linalg.norm(north)
    north = north / length if length > 1e-12 else np.array([1.0, 0.0, 0.0])
    east = np.cross(north, [0.0, 0.0, 1.0])
    return (
        float(np.arctan2(zenith[2], np.hypot(zenith[0], zenith[1]))),
        float(np.arctan2(zenith[1], zenith[0])),
        east,
        north,
    )


def _outcome(a4: np.ndarray, g: np.ndarray, mounting: Mounting):
    """What a fix says, for differences: zenith in ITRS, latitude, heading, attitude."""
    return a4[2], _Outcome.of(a4, g, mounting)


def _numerical(function, n: int) -> np.ndarray:
    """Central differences of a vector or of an outcome with respect to n small angles: (rows, n)."""
    columns = []
    for i in range(n):
        d = np.zeros(n)
        d[i] = STEP_RAD
        plus, minus = function(d), function(-d)
        columns.append(_difference(plus, minus) / (2 * STEP_RAD))
    return np.stack(columns, -1)


def _difference(plus, minus) -> np.ndarray:
    if isinstance(plus, np.ndarray):
        return plus - minus
    (zenith_plus, a), (zenith_minus, b) = plus, minus
    zenith = (zenith_plus + zenith_minus) / 2
    latitude, longitude = np.arcsin(np.clip(zenith[2], -1, 1)), np.arctan2(zenith[1], zenith[0])
    east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
    north = np.cross(zenith / np.linalg.norm(zenith), east)
    prime, meridian = curvature_radii_m(latitude)
    moved = zenith_plus - zenith_minus
    turned = (a.heading - b.heading + np.pi) % (2 * np.pi) - np.pi
    spin = rotation.to_small_vector(a.link_to_enu @ b.link_to_enu.T)
    return np.array([moved @ east * prime, moved @ north * meridian, turned, *spin])


def symmetric_root(covariance: np.ndarray) -> np.ndarray:
    """The symmetric F with F F = covariance, also of a singular one; it keeps its signs from frame to frame."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T


def _compact(factor: np.ndarray) -> np.ndarray:
    """The same covariance with six columns."""
    scale = np.array([1.0, 1.0, 1e-6, 1e-6, 1e-6, 1e-6])  # m and rad, brought to like sizes
    root = symmetric_root(factor @ factor.T / np.outer(scale, scale))
    return root * scale[:, None]
