# SPDX-License-Identifier: Apache-2.0
"""One frame at a known site: the camera's attitude by its stars, its errors, and the tilt."""

from dataclasses import dataclass

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import ECCENTRICITY2, enu_axes
from starpos.earth.orientation import ROTATION_RAD_S, EarthOrientation, EarthState, later, station_velocity
from starpos.earth.refraction import Refraction
from starpos.errors import FixError, InstrumentError
from starpos.fix._adjustment import Adjustment
from starpos.fix.adjustment import ISOTROPIC, fitted, share_free
from starpos.fix.budget import StarErrors
from starpos.fix.matched import MatchedStars, sound_matches
from starpos.fix.outliers import expected_extra
from starpos.fix.solver import ENOUGH_SOUND, Solver
from starpos.frames.shutter import Shutter
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilts import Tilts

# refraction is put on the stars, so nothing bends between them and the camera
BENT_ALREADY = Refraction(0.0, 0.0)
# step of the refraction for its derivative
STRONGER = 0.01


@dataclass(frozen=True)
class Mark:
    """The point above which the instrument stands: geodetic latitude, longitude (rad) and height (m) on WGS 84."""

    latitude: float
    longitude: float
    height_m: float

    @property
    def enu(self) -> np.ndarray:
        """Rotation (3, 3) of ITRS into east, north, up."""
        return enu_axes(self.latitude, self.longitude)


@dataclass(frozen=True, eq=False, kw_only=True)
class ZenithSighting:
    """The attitude of the camera at one frame, its tilt, and the errors of both.

    enu_to_camera (3, 3): geodetic east, north, up into C, by the stars.  All rotations below are small ones of the camera
    about C's axes, rad.
    centroids (3, 3): covariance of it by the stars' places on the frame.
    stars (N,): rows of the catalogue.  by_star (3, N, 3): rotation for 1 sigma of each star's place along ICRS's axes.
    star_weight (N, 3, 3), star_common (4, N, 3), star_pull (N, 3): normal equations of these displacements by this
    frame's stars alone: each star's own weight, less what attitude and scale take up, and the right side.
    by_refraction (3,): rotation for 1 sigma of the refraction.  by_rows (3, 2): for the two errors of the rows' times.
    residual_arcsec (N, 2): the stars' places by the fit minus those seen, along the frame's columns and rows.
    """

    source: str
    utc_unix_s: float
    enu_to_camera: np.ndarray
    centroids: np.ndarray
    stars: np.ndarray
    by_star: np.ndarray
    star_weight: np.ndarray
    star_common: np.ndarray
    star_pull: np.ndarray
    by_refraction: np.ndarray
    by_rows: np.ndarray
    residual_arcsec: np.ndarray
    tilt: Tilt
    orientation: EarthOrientation
    clock_stddev_s: float
    stamp_stddev_s: float

    @property
    def heading(self) -> float:
        """Azimuth (rad) of the top of the frame."""
        east, north, _ = -self.enu_to_camera[1]
        return rotation.full_turn(float(np.arctan2(east, north)))

    @property
    def residual_rms_arcsec(self) -> float:
        """Root mean square of the residuals a coordinate."""
        return float(np.sqrt(np.mean(self.residual_arcsec**2)))


def sighting(solver: Solver, stars: Stars, found: Identification, mark: Mark, tilts: Tilts) -> ZenithSighting:
    """The sighting of a frame whose stars are identified.

    Refraction is counted from the ellipsoid's normal; `adjustment` accounts for the plumb line's deflection from it.
    Raises StarposError if the stars do not determine the attitude, or no tilt belongs to the frame.
    """
    if found.mirrored:
        raise InstrumentError(
            f"{stars.place}: the frame is mirrored (its rows run bottom-up): flip it, faces turn the other way in it"
        )
    if len(found.star) < solver.min_stars:
        raise FixError(
            f"{stars.place}: only {len(found.star)} stars identified, {solver.min_stars} are needed"
        )
    state, tilt = solver.levelled(stars, tilts)
    camera, catalogue, _ = solver.view(stars.width, stars.height, stars.origin_px)
    use = sound_matches(stars, found, max(solver.min_stars, ENOUGH_SOUND))
    star, index = found.star[use], found.catalogue[use]
    camera = camera.scaled(found.focal_scale)
    matched = MatchedStars(
        np.stack([stars.x, stars.y], -1)[star],
        stars.covariance[star],
        catalogue.directions(index, state.year, state.observer_au),
        np.hypot(catalogue.sigma(index, state.year), found.blend_px[use] / camera.fx),
        index,
    )
    shutter = solver.shutter(stars)
    itrs = _seen(matched, state, shutter, camera.height, mark)
    enu = itrs @ mark.enu.T
    refraction = solver.atmosphere.refraction()
    problem = Adjustment(
        matched.xy,
        refraction.bend(enu),
        np.eye(3),
        camera.lens,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        BENT_ALREADY.compiled,
        0.0,
        ECCENTRICITY2,
    )
    # the catalogue's errors do not weigh here: `places` adjusts them with all frames' stars
    fit = fitted(problem, camera.directions(*matched.xy.T), matched.covariance_px2)
    kept, residual = fit.kept, fit.residual[fit.kept]
    placed_px = matched.place_sigma[kept] * camera.fx
    centroids = centroids_of(residual, matched.covariance_px2[kept], placed_px, share_free(fit.keep))
    errors = StarErrors.of(fit.slope[kept], centroids, np.zeros_like(centroids), ())
    if not np.isfinite(errors.gain).all():
        raise FixError(
            f"{stars.place}: its {len(residual)} stars do not determine the attitude: more are needed"
        )
    turns = fit.slope[kept, :, :3]
    rays = refraction.bend(enu)[kept] @ fit.a4.T
    # a star that is displaced moves on the frame as the camera's turn about its ray x displacement would move it
    across = np.array([rotation.cross_matrix(ray) for ray in rays])
    icrs_to_camera = fit.a4 @ mark.enu @ state.gcrs_to_itrs
    displaced_px = turns @ across @ icrs_to_camera * matched.place_sigma[kept, None, None]
    gain, white = errors.gain, np.linalg.inv(np.linalg.cholesky(centroids))
    shown = white @ displaced_px
    common = np.linalg.qr((white @ fit.slope[kept]).reshape(-1, 4))[0].reshape(-1, 2, 4)
    stronger = solver.atmosphere.refraction(1 + STRONGER).bend(enu)[kept] - refraction.bend(enu)[kept]
    bent_px = np.einsum("nij,njk,nk->ni", turns, across, stronger @ fit.a4.T)
    pole = fit.a4 @ mark.enu[:, 2]
    late_s = shutter.errors_s(matched.xy[kept, 1], camera.height)
    drift_px = turns @ (-ROTATION_RAD_S * pole)
    return ZenithSighting(
        source=stars.source,
        utc_unix_s=state.utc_unix_s,
        enu_to_camera=fit.a4,
        centroids=errors.rotation_covariance(centroids),
        stars=index[kept],
        by_star=np.einsum("ing,ngj->inj", gain, displaced_px),
        star_weight=np.einsum("ngi,ngj->nij", shown, shown),
        star_common=np.einsum("ngp,ngi->pni", common, shown),
        star_pull=-np.einsum("ngi,ngh,nh->ni", shown, white, residual),
        by_refraction=np.einsum("ing,ng->i", gain, bent_px) * solver.atmosphere.relative_sigma / STRONGER,
        by_rows=np.einsum("ing,ng,nk->ik", gain, drift_px, late_s),
        residual_arcsec=residual * camera.scale_arcsec,
        tilt=tilt,
        orientation=state.orientation,
        clock_stddev_s=solver.clock_stddev_s(stars),
        stamp_stddev_s=stars.stamp_stddev_s,
    )


def centroids_of(residual: np.ndarray, stated: np.ndarray, placed_px: np.ndarray, share: float) -> np.ndarray:
    """Covariances (N, 2, 2) px2 of centroids, as stated (N, 2, 2) or larger where the residuals (N, 2) show it.

    placed_px (N,): 1 sigma of the stars' own places, each with its star: one of unknown motion would otherwise hide the
    scatter of all centroids.  share: part of the coordinates that the fit leaves free.
    """
    whole = stated + ISOTROPIC * placed_px[:, None, None] ** 2
    return stated + ISOTROPIC * expected_extra(residual, whole, share)


def _seen(stars: MatchedStars, state: EarthState, shutter: Shutter, height: int, mark: Mark) -> np.ndarray:
    """Topocentric directions (N, 3) in ITRS, with the diurnal aberration, each when its row was exposed."""
    itrs = state.to_itrs(stars.places)
    if shutter.readout_s:
        itrs = later(itrs, shutter.later_s(stars.xy[:, 1], height))
    return rotation.normalised(itrs + station_velocity(mark.enu[2]))
