# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame: the place and the attitude of the instrument, with their covariance.

The equation is that of the paper's section 4, A2 A3 W = A4 A1 V, with refraction in L and the diurnal aberration of the
site.  The residuals are formed in pixels, because the errors of the stars are known there.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.core.observed import observed
from starpos.earth.orientation import EarthState, later, station_velocity
from starpos.earth.refraction import Atmosphere, Refraction
from starpos.errors import FixError
from starpos.fix.budget import (
    ALWAYS,
    ErrorTerm,
    Sensitivity,
    StarErrors,
    error_terms,
    heading_of,
    place_of,
    total_covariance,
)
from starpos.fix.outliers import expected_extra, judged
from starpos.fix.readable import InDegrees
from starpos.frames.shutter import GLOBAL, Shutter
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt, level_of, levelling_of
from starpos.instrument.mounting import Mounting

MAX_ROUNDS = 6
# share of the frame's diagonal; stars that scatter more were not identified rightly
MAX_SCATTER = 0.003
MIN_STARS = 3
STEP_REFRACTION = 0.01
# so many stars tell whether two frames show the same ones
MARKS = 20
# the iteration ends at a step below this, in rad and as a share of the scale
SETTLED, MOST_STEPS = 1e-13, 20


@dataclass(frozen=True)
class MatchedStars:
    """N identified stars.

    xy (N, 2) in px and covariance_px2 (N, 2, 2): where they are on the frame.
    places (N, 3): ICRS directions at the date; place_sigma (N,): their standard deviation per axis in rad.
    index (N,): their rows in the catalogue; None if unknown.
    """

    xy: np.ndarray
    covariance_px2: np.ndarray
    places: np.ndarray
    place_sigma: np.ndarray
    index: np.ndarray | None = None


def sound_matches(stars: Stars, found: Identification, enough: int) -> np.ndarray:
    """Mask (M,) of the matches to use: those of stars without a flag, or all if fewer than `enough` have none."""
    sound = stars.sound[found.star]
    return sound if sound.sum() >= enough else np.ones(len(sound), bool)


@dataclass(frozen=True, kw_only=True)
class Fix:
    """Astronomic latitude, longitude and heading (rad) at one instant, with the error budget.

    link_to_enu (3, 3): attitude of the base link.
    used (M,): rows of the given stars that were kept; residual_px (M, 2): their fitted places minus their seen ones.
    jitter_px: scatter of the stars beyond the centroids' own errors (seeing, optics).
    focal_scale: factor on the given focal length.
    levelling (6, 2): change of the rows of an ErrorTerm for errors, in rad, of up about two axes fixed to the
    inclinometer. camera_to_itrs (3, 3): attitude of the camera against the Earth by the stars alone; camera_covariance
    (3, 3) in rad2: of its small rotation about the Earth's axes.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    link_to_enu: np.ndarray
    terms: tuple[ErrorTerm, ...]
    levelling: np.ndarray
    used: np.ndarray
    residual_px: np.ndarray
    residual_arcsec: float
    jitter_px: float
    focal_scale: float
    zenith_distance: float
    refraction_arcsec: float
    diurnal_aberration_arcsec: float
    ut1_minus_utc_s: float
    camera_to_itrs: np.ndarray
    camera_covariance: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of east m, north m, heading rad."""
        return total_covariance(self.terms)[:3, :3]

    @property
    def in_degrees(self) -> InDegrees:
        """Place and heading in degrees."""
        return InDegrees.of(self.latitude, self.longitude, self.heading, self.covariance)

    def __repr__(self) -> str:
        return f"<Fix: {self.in_degrees}>"

    @property
    def attitude_covariance(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the base link's orientation about east, north, up."""
        return total_covariance(self.terms)[3:, 3:]


def solve_fix(
    stars: MatchedStars,
    camera: Camera,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_stddev_s: float,
    stamp_stddev_s: float = 0.0,
    shutter: Shutter = GLOBAL,
) -> Fix:
    """The fix of one frame from identified stars.

    It starts from a closed solution (singular values) and goes on by Gauss-Newton over the rotation A4 and the plate
    scale.  The derivatives are computed once: they hardly change over the arcseconds that are left.
    clock_stddev_s, stamp_stddev_s: of the clock, and of the frame's time stamp by that clock.
    shutter: when each row was exposed; `earth` is of the row that is read first.
    Raises FixError if the stars are too few or do not agree.
    """
    problem = _Adjustment(
        stars.xy,
        camera,
        level_of(mounting.up(tilt)) @ mounting.a3,
        later(earth.to_itrs(stars.places), shutter.later_s(stars.xy[:, 1], camera.height)),
        atmosphere.refraction(),
    )
    catalogue_px2 = np.eye(2) * ((stars.place_sigma * camera.fx) ** 2)[:, None, None]
    stated = stars.covariance_px2 + catalogue_px2
    keep, jitter2 = np.ones(len(stars.xy), bool), 0.0
    state, settled = problem.closed_form(), False
    slope = problem.jacobian(state)
    for _ in range(MAX_ROUNDS):
        if keep.sum() < max(MIN_STARS, 0.5 * len(keep)):
            raise FixError(
                f"only {int(keep.sum())} of {len(keep)} identified stars agree on one attitude: no fix from them"
            )
        state = problem.refine(state, slope, stated + np.eye(2) * jitter2, keep)
        if settled:
            break
        residual, before = problem.residual(state), (keep, jitter2)
        jitter2, keep = judged(residual, stated, keep, _share_free(keep))
        settled = np.array_equal(keep, before[0]) and abs(jitter2 - before[1]) <= 0.02 * (jitter2 + 1e-6)
    if jitter2 > (MAX_SCATTER * np.hypot(camera.width, camera.height)) ** 2:
        raise FixError(
            f"the identified stars lie {np.sqrt(jitter2):.1f} px off the best attitude: check the camera's distortion"
        )
    residual = problem.residual(state)[keep]
    claimed2 = expected_extra(residual, stated[keep], _share_free(keep))
    centroids = stars.covariance_px2[keep] + np.eye(2) * claimed2
    same_stars = ALWAYS if stars.index is None else tuple(stars.index[keep][:MARKS].tolist())
    errors = StarErrors.of(slope[keep], centroids, catalogue_px2[keep], same_stars)
    place = place_of(state.a4)
    link_to_enu = place.local_to_enu @ problem.g @ mounting.link_to_camera
    sensitivity, up = Sensitivity.of(state.a4, link_to_enu), mounting.up(tilt)
    # the two axes go with the inclinometer, however it leans
    axes = rotation.shortest_turn(np.array([0.0, 0.0, 1.0]), up)[:, :2]
    terms = _terms(
        problem,
        state,
        keep,
        errors,
        tilt,
        mounting,
        atmosphere,
        earth,
        (clock_stddev_s, stamp_stddev_s),
        sensitivity,
        shutter,
    )
    axis = camera.directions(*np.array(camera.centre_px)[:, None]) @ problem.g.T
    bent = np.linalg.norm(rotation.cross(axis, problem.refraction.unbend(axis)))
    return Fix(
        utc_unix_s=earth.utc_unix_s,
        latitude=place.latitude,
        longitude=place.longitude,
        heading=heading_of(link_to_enu),
        link_to_enu=link_to_enu,
        terms=terms,
        levelling=sensitivity.level @ levelling_of(up, axes),
        used=np.flatnonzero(keep),
        residual_px=residual,
        residual_arcsec=float(np.sqrt(np.mean(residual**2)) * camera.scale_arcsec),
        jitter_px=float(np.sqrt(jitter2)),
        focal_scale=state.scale,
        zenith_distance=float(np.arccos(np.clip(axis[0, 2], -1, 1))),
        refraction_arcsec=float(np.degrees(bent) * 3600),
        diurnal_aberration_arcsec=float(np.degrees(np.linalg.norm(station_velocity(state.a4[2]))) * 3600),
        ut1_minus_utc_s=earth.orientation.ut1_minus_utc_s,
        camera_to_itrs=state.a4.T @ problem.g,
        camera_covariance=state.a4.T @ errors.rotation_covariance(centroids) @ state.a4,
    )


def _share_free(keep: np.ndarray) -> float:
    """Share of the 2 N coordinates of N kept stars that four parameters leave free."""
    return max(1 - 2 / keep.sum(), 1 / keep.sum())


@dataclass(frozen=True)
class _Estimate:
    """A4 (3, 3), ITRS into L, and the factor on the focal length."""

    a4: np.ndarray
    scale: float


@dataclass(frozen=True)
class _Adjustment:
    """The least-squares problem of a frame: stars at xy (N, 2) px with geocentric apparent directions itrs (N, 3).

    g (3, 3): A2 A3, which takes C into L.
    """

    xy: np.ndarray
    camera: Camera
    g: np.ndarray
    itrs: np.ndarray
    refraction: Refraction

    def closed_form(self) -> _Estimate:
        """First estimate, by singular values, at the given focal length."""
        local = self.refraction.unbend(self.camera.directions(*self.xy.T) @ self.g.T)
        a4 = rotation.best_rotation(self.itrs, local)
        # the diurnal aberration depends on the place that is sought
        for _ in range(2):
            a4 = rotation.best_rotation(self.itrs + station_velocity(a4[2]), local)
        return _Estimate(a4, 1.0)

    @cached_property
    def principal_px(self) -> np.ndarray:
        """The principal point (2,)."""
        return np.array([self.camera.cx, self.camera.cy])

    def predict(self, state: _Estimate, refraction: Refraction | None = None) -> np.ndarray:
        """Pixels (N, 2) where the estimate has the stars."""
        air = (refraction or self.refraction).compiled
        v = observed(self.itrs, state.a4, station_velocity(state.a4[2]), air, self.g)
        return self.principal_px + state.scale * (self.camera.project(v) - self.principal_px)

    def residual(self, state: _Estimate) -> np.ndarray:
        """Predicted minus seen places (N, 2) in px."""
        return self.predict(state) - self.xy

    def moved(self, state: _Estimate, p: np.ndarray) -> _Estimate:
        """The estimate after a small rotation p[:3] about L's axes and a relative change p[3] of the scale."""
        return _Estimate(rotation.from_vector(p[:3]) @ state.a4, state.scale * (1 + p[3]))

    def refine(
        self, state: _Estimate, slope: np.ndarray, covariance_px2: np.ndarray, keep: np.ndarray
    ) -> _Estimate:
        """The best estimate near `state` for the stars to keep (N,), by Gauss-Newton with derivatives slope (N, 2, 4).

        Raises FixError if it does not converge.
        """
        slope = slope[keep]
        weighted = (np.linalg.inv(covariance_px2[keep]) @ slope).reshape(-1, 4)
        gain = np.linalg.solve(slope.reshape(-1, 4).T @ weighted, weighted.T)
        for _ in range(MOST_STEPS):
            step = -gain @ self.residual(state)[keep].ravel()
            if not np.isfinite(step).all():
                break
            state = self.moved(state, step)
            if np.abs(step).max() < SETTLED:
                return state
        raise FixError("the identified stars do not fit into the camera's field: check focal length and tilt")

    def jacobian(self, state: _Estimate) -> np.ndarray:
        """Derivatives (N, 2, 4) of `predict` by the parameters of `moved`."""
        air, ground = self.refraction.compiled, station_velocity(state.a4[2])
        v, turned = observed(self.itrs, state.a4, ground, air, self.g, True)
        from_principal = state.scale * (self.camera.project(v) - self.principal_px)
        turned = state.scale * (self.camera.slopes(v) @ turned)
        return np.concatenate([turned, from_principal[:, :, None]], -1)


def _terms(
    problem: _Adjustment,
    state: _Estimate,
    keep: np.ndarray,
    errors: StarErrors,
    tilt: Tilt,
    mounting: Mounting,
    atmosphere: Atmosphere,
    earth: EarthState,
    clock_and_stamp_stddev_s: tuple[float, float],
    sensitivity: Sensitivity,
    shutter: Shutter,
) -> tuple[ErrorTerm, ...]:
    """The budget of the fix: the errors of its stars, of refraction and shutter as they act on them, and all others."""
    here = problem.predict(state)
    stronger = problem.predict(state, atmosphere.refraction(1 + STEP_REFRACTION)) - here
    bending = (
        -np.einsum("ank,nk->a", errors.gain, stronger[keep]) / STEP_REFRACTION * atmosphere.relative_sigma
    )
    turned = replace(problem, itrs=later(problem.itrs, np.ones(len(problem.itrs)))).predict(state)
    drift = turned - here
    late = shutter.errors_s(problem.xy[:, 1], problem.camera.height)
    rolling = -np.einsum("ank,nk,nc->ac", errors.gain, drift[keep], late[keep])
    return error_terms(
        sensitivity,
        errors,
        tilt,
        mounting,
        bending,
        rolling,
        place_of(state.a4).latitude,
        earth,
        *clock_and_stamp_stddev_s,
    )
