# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame: where the instrument stands and which way it faces, with the whole covariance.

The equation is the paper's (15), A2 A3 W = A4 A1 V, with refraction in L and the diurnal aberration of the site; its
residuals are taken in pixels, where the errors of the stars live.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, least_squares

from starpos import rotation
from starpos.atmosphere import Atmosphere, Refraction
from starpos.budget import ErrorTerm, Sensitivity, StarErrors, error_terms, heading_of, place_of
from starpos.camera import Camera
from starpos.earth import EarthState, station_velocity
from starpos.errors import FixError
from starpos.inclinometer import Tilt, a2_matrix

OUTLIER_SIGMA = 5.0
MAX_ROUNDS = 6
MAX_SCATTER = 0.003  # of the frame's diagonal: identified stars that scatter more are not these stars
MEDIAN_OF_CHI2 = 2 * np.log(2)  # of two degrees of freedom
MIN_STARS = 3
STEP_RAD = 1e-6  # of the numerical derivatives; the functions are smooth at 1 rad
STEP_REFRACTION = 0.01


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
class MatchedStars:
    """Identified stars: xy (N, 2) px and covariance_px2 (N, 2, 2) on the frame; places (N, 3), ICRS directions at the
    date, and place_sigma (N,) rad, one axis."""

    xy: np.ndarray
    covariance_px2: np.ndarray
    places: np.ndarray
    place_sigma: np.ndarray


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
    tilt_times: tuple[
        float, ...
    ] = ()  # of the inclinometer's readings: frames that share some share their errors

    @property
    def covariance(self) -> np.ndarray:
        """(3, 3) of east m, north m, heading rad."""
        return sum(t.covariance for t in self.terms)[:3, :3]

    @property
    def attitude_covariance(self) -> np.ndarray:
        """(3, 3) rad2 of the base link's orientation about east, north, up."""
        return sum(t.covariance for t in self.terms)[3:, 3:]


def solve_fix(
    stars: MatchedStars,
    camera: Camera,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
) -> Fix:
    """The fix of one frame from identified stars.

    The start is closed (singular values), the rest Levenberg-Marquardt over the rotation A4 and the plate scale.
    Raises FixError where the stars are too few or do not agree.
    """
    problem = _Problem(
        stars.xy,
        camera,
        a2_matrix(tilt.theta_x, tilt.theta_y) @ mounting.a3,
        earth.to_itrs(stars.places),
        atmosphere.refraction(),
    )
    catalogue_px2 = np.eye(2) * ((stars.place_sigma * camera.fx) ** 2)[:, None, None]
    stated = stars.covariance_px2 + catalogue_px2
    keep, jitter2 = np.ones(len(stars.xy), bool), 0.0
    state, settled = problem.closed_form(), False
    for _ in range(MAX_ROUNDS):
        if keep.sum() < max(MIN_STARS, 0.5 * len(keep)):
            raise FixError(
                f"only {int(keep.sum())} of {len(keep)} identified stars agree on one attitude: no fix from them"
            )
        state = problem.refine(state, stated + np.eye(2) * jitter2, keep)
        if settled:
            break
        residual, before = problem.residual(state), (keep, jitter2)
        # by the median, else an outlier among a dozen stars would widen the gate enough to pass itself
        typical = _extra_variance(
            residual[keep], stated[keep], lambda d2, share: np.median(d2) / MEDIAN_OF_CHI2 - share
        )
        jitter2 = _extra_variance(residual[keep], stated[keep], lambda d2, share: d2.mean() / 2 - share)
        keep = _distance2(residual, stated, typical) < OUTLIER_SIGMA**2
        settled = np.array_equal(keep, before[0]) and abs(jitter2 - before[1]) <= 0.02 * (jitter2 + 1e-6)
    if jitter2 > (MAX_SCATTER * np.hypot(camera.width, camera.height)) ** 2:
        raise FixError(
            f"the identified stars lie {np.sqrt(jitter2):.1f} px off the best attitude: check the camera's distortion"
        )
    errors = _StarCovariances(stars.covariance_px2[keep] + np.eye(2) * jitter2, catalogue_px2[keep])
    terms = _terms(problem, state, keep, errors, tilt, mounting, atmosphere, earth, clock_stddev_s)
    place = place_of(state.a4)
    link_to_enu = place.local_to_enu @ problem.g @ mounting.link_to_camera
    axis = camera.directions(*np.array(camera.centre_px)[:, None]) @ problem.g.T
    bent = np.linalg.norm(np.cross(axis, problem.refraction.unbend(axis)))
    return Fix(
        utc_unix_s=earth.utc_unix_s,
        latitude=place.latitude,
        longitude=place.longitude,
        heading=heading_of(link_to_enu),
        link_to_enu=link_to_enu,
        terms=terms,
        used=np.flatnonzero(keep),
        residual_arcsec=float(np.sqrt(np.mean(problem.residual(state)[keep] ** 2)) * camera.scale_arcsec),
        jitter_px=float(np.sqrt(jitter2)),
        focal_scale=state.scale,
        zenith_distance=float(np.arccos(np.clip(axis[0, 2], -1, 1))),
        refraction_arcsec=float(np.degrees(bent) * 3600),
        diurnal_aberration_arcsec=float(np.degrees(np.linalg.norm(station_velocity(state.a4[2]))) * 3600),
        ut1_minus_utc_s=earth.orientation.ut1_minus_utc_s,
        tilt_times=tilt.times,
    )


def _distance2(residual: np.ndarray, covariance: np.ndarray, extra: float) -> np.ndarray:
    """Squared residuals (N,) in units of their covariance and an extra isotropic variance (px2)."""
    return np.einsum("ni,nij,nj->n", residual, np.linalg.inv(covariance + np.eye(2) * extra), residual)


def _extra_variance(residual: np.ndarray, covariance: np.ndarray, excess: Callable) -> float:
    """The isotropic variance (px2) at which excess(squared distances, share of freedom) is 0; 0 where it never is above.

    The share: of the stars' 2 N coordinates, those that the four parameters of the fit leave free.
    """
    share = max(1 - 2 / len(residual), 1 / len(residual))

    def above(extra):
        return excess(_distance2(residual, covariance, extra), share)

    if above(0.0) <= 0:
        return 0.0
    high = 8 * np.sum(residual**2) + 1e-12
    return float(brentq(above, 0.0, high, rtol=1e-3)) if above(high) < 0 else float(high)


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

    def predict(self, state: _State, refraction: Refraction | None = None) -> np.ndarray:
        """Pixels (N, 2) where the stars should be."""
        v = self.itrs + station_velocity(state.a4[2])
        v = v / np.linalg.norm(v, axis=1, keepdims=True)
        observed = (refraction or self.refraction).bend(v @ state.a4.T)
        return self.camera.scaled(state.scale).project(observed @ self.g)

    def residual(self, state: _State) -> np.ndarray:
        return self.predict(state) - self.xy

    def moved(self, state: _State, p: np.ndarray) -> _State:
        """The state after a small rotation p[:3] about L's axes and a relative change p[3] of the scale."""
        return _State(rotation.from_vector(p[:3]) @ state.a4, state.scale * (1 + p[3]))

    def refine(self, state: _State, covariance_px2: np.ndarray, keep: np.ndarray) -> _State:
        """Levenberg-Marquardt (MINPACK) from `state` over the stars to keep."""
        whiten = np.linalg.cholesky(np.linalg.inv(covariance_px2[keep]))

        def whitened(p):
            r = self.residual(self.moved(state, p))[keep]
            return np.einsum("nji,nj->ni", whiten, r).ravel()

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


@dataclass(frozen=True)
class _StarCovariances:
    centroids: np.ndarray  # (M, 2, 2) px2, scatter included
    catalogue: np.ndarray  # (M, 2, 2) px2


def _terms(
    problem, state, keep, errors, tilt, mounting, atmosphere, earth, clock_stddev_s
) -> tuple[ErrorTerm, ...]:
    """The budget: how the fit passes on the errors of its stars, and what else there is."""
    place = place_of(state.a4)
    j = problem.jacobian(state)[keep]
    weighted = np.linalg.solve(errors.centroids + errors.catalogue, j)
    normal = np.einsum("nki,nkj->ij", j, weighted)
    gain = np.einsum("ij,nkj->ink", np.linalg.inv(normal), weighted)[:3]
    stronger = problem.predict(state, atmosphere.refraction(1 + STEP_REFRACTION)) - problem.predict(state)
    bending = -np.einsum("ank,nk->a", gain, stronger[keep]) / STEP_REFRACTION * atmosphere.relative_sigma
    return error_terms(
        Sensitivity.of(state.a4, place.local_to_enu @ problem.g @ mounting.link_to_camera),
        StarErrors(gain, errors.centroids, errors.catalogue),
        tilt,
        mounting.calibration_covariance,
        bending,
        place.latitude,
        earth,
        clock_stddev_s,
    )
