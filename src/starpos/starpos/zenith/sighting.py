# SPDX-License-Identifier: Apache-2.0
"""Frames at a known site: attitude, errors and tilt of each, their faces, and the stars' places on which they agree.

Stars stand in many frames, so a frame's stars show how far each is from its place in the others.  So their places are
adjusted, as overlapping plates are (Eichhorn 1960, Astron. Nachr. 285, 233), with the catalogue's errors as what is known
before; and their scatter shows how large the catalogue's errors are here, by maximum likelihood.  What is common to all
stars of the session remains as uncertain as such errors leave it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S, EarthOrientation, station_velocity
from starpos.earth.place import Place
from starpos.errors import FixError, InstrumentError
from starpos.fix._adjustment import gain_of, spread
from starpos.fix.attitude import CAMERA, ITRS, Attitude
from starpos.fix.sighting import Sighting
from starpos.fix.solver import ENOUGH_SOUND, Solver
from starpos.fix.star_fit import (
    ISOTROPIC,
    MatchedStars,
    apparent,
    expected_extra,
    fitted,
    seen_problem,
    share_free,
    sound_matches,
)
from starpos.frames.frame import Stars
from starpos.frozen import at_once
from starpos.identification import Identification
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import Tilts
from starpos.rotation import half_turns

# step of the refraction for its derivative
STRONGER = 0.01


@at_once
@dataclass(frozen=True, kw_only=True)
class ZenithSighting(Sighting):
    """A sighting at a known site, with the effects of its stars' errors.

    camera: with its errors by the stars' places on the frame alone.  axes (3, 3): geodetic east, north, up at the mark,
    in ITRS.  All rotations below are small ones of the camera about C's axes, rad.
    stars (N,): rows of the catalogue.  by_star (3, N, 3): rotation for 1 sigma of each star's place along ICRS's axes.
    star_weight (N, 3, 3), star_common (4, N, 3), star_pull (N, 3): normal equations of these displacements by this
    frame's stars alone: each star's own weight, less what attitude and scale take up, and the right side.
    by_refraction (3,): rotation for 1 sigma of the refraction.  by_rows (3, 2): for the two errors of the rows' times.
    residual_arcsec (N, 2): the stars' places by the fit minus those seen, along the frame's columns and rows.
    """

    tilt: Tilt
    axes: np.ndarray
    stars: np.ndarray
    by_star: np.ndarray
    star_weight: np.ndarray
    star_common: np.ndarray
    star_pull: np.ndarray
    by_refraction: np.ndarray
    by_rows: np.ndarray
    residual_arcsec: np.ndarray
    orientation: EarthOrientation

    @property
    def enu_to_camera(self) -> np.ndarray:
        """Rotation (3, 3) of geodetic east, north, up into C."""
        return self.camera.rotation.T @ self.axes.T

    def turned(self, turn: np.ndarray) -> "ZenithSighting":
        """Turn the camera by a rotation (3, 3) of its axes C."""
        camera, own = self.camera.rotation @ turn.T, self.camera.covariance_about_own
        return replace(self, camera=Attitude.by_own(camera, own, of=CAMERA, into=ITRS))

    @property
    def heading(self) -> float:
        """Azimuth (rad) of the top of the frame."""
        east, north, _ = -self.enu_to_camera[1]
        return rotation.full_turn(float(np.arctan2(east, north)))

    @property
    def residual_rms_arcsec(self) -> float:
        """Root mean square of the residuals a coordinate."""
        return float(np.sqrt(np.mean(self.residual_arcsec**2)))


def sighting(
    solver: Solver, stars: Stars, found: Identification, mark: Place, tilts: Tilts
) -> ZenithSighting:
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
    index = found.catalogue[use]
    camera = camera.scaled(found.focal_scale)
    places = catalogue.directions(index, state.year, state.observer_au)
    matched = MatchedStars.of(stars, found, use, camera, catalogue, state.year, places)
    about = solver.circumstances(stars, camera, state)
    enu = rotation.normalised(apparent(matched, about) + station_velocity(mark.axes[2])) @ mark.axes.T
    refraction = solver.atmosphere.refraction()
    problem = seen_problem(matched.xy, camera, refraction.bend(enu))
    # the catalogue's errors do not weigh here: `places` adjusts them with all frames' stars
    fit = fitted(problem, camera.directions(*matched.xy.T), matched.covariance_px2)
    kept, residual = fit.kept, fit.residual[fit.kept]
    placed_px = matched.place_sigma[kept] * camera.fx
    centroids = centroids_of(residual, matched.covariance_px2[kept], placed_px, share_free(fit.keep))
    gain = gain_of(np.ascontiguousarray(fit.slope[kept]), np.ascontiguousarray(centroids))
    if not np.isfinite(gain).all():
        raise FixError(
            f"{stars.place}: its {len(residual)} stars do not determine the attitude: more are needed"
        )
    turns = fit.slope[kept, :, :3]
    rays = refraction.bend(enu)[kept] @ fit.a4.T
    # a star that is displaced moves on the frame as the camera's turn about its ray x displacement would move it
    across = rotation.cross_matrices(rays)
    icrs_to_camera = fit.a4 @ mark.axes @ state.gcrs_to_itrs
    displaced_px = turns @ across @ icrs_to_camera * matched.place_sigma[kept, None, None]
    white = np.linalg.inv(np.linalg.cholesky(centroids))
    shown = white @ displaced_px
    common = np.linalg.qr((white @ fit.slope[kept]).reshape(-1, 4))[0].reshape(-1, 2, 4)
    stronger = solver.atmosphere.refraction(1 + STRONGER).bend(enu)[kept] - refraction.bend(enu)[kept]
    bent_px = np.einsum("nij,njk,nk->ni", turns, across, stronger @ fit.a4.T)
    pole = fit.a4 @ mark.axes[:, 2]
    late_s = about.shutter.errors_s(matched.xy[kept, 1], camera.height)
    drift_px = turns @ (-ROTATION_RAD_S * pole)
    return ZenithSighting(
        source=stars.source,
        utc_unix_s=state.utc_unix_s,
        camera=Attitude.by_own(mark.axes.T @ fit.a4.T, spread(gain, centroids), of=CAMERA, into=ITRS),
        axes=mark.axes,
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
        clock_stddev_s=about.clock_stddev_s,
        stamp_stddev_s=stars.stamp_stddev_s,
    )


def centroids_of(residual: np.ndarray, stated: np.ndarray, placed_px: np.ndarray, share: float) -> np.ndarray:
    """Covariances (N, 2, 2) px2 of centroids, as stated (N, 2, 2) or larger where the residuals (N, 2) show it.

    placed_px (N,): 1 sigma of the stars' own places, each with its star: one of unknown motion would otherwise hide the
    scatter of all centroids.  share: part of the coordinates that the fit leaves free.
    """
    whole = stated + ISOTROPIC * placed_px[:, None, None] ** 2
    return stated + ISOTROPIC * expected_extra(residual, whole, share)


# within a face the heading stays: a turntable or a foot that settles moves it by less than this
SAME_FACE_RAD = np.radians(5.0)


def faces_of(sightings: Sequence[ZenithSighting]) -> np.ndarray:
    """Number (N,) of the face of each frame, from 0, of frames in order of time."""
    headings = np.array([s.heading for s in sightings])
    faces, first = np.zeros(len(headings), int), headings[0]
    for k in range(1, len(headings)):
        turned = abs(half_turns(headings[k] - first)) > SAME_FACE_RAD
        faces[k] = faces[k - 1] + turned
        first = headings[k] if turned else first
    return faces


def mean_headings(sightings: Sequence[ZenithSighting], faces: np.ndarray) -> np.ndarray:
    """Azimuth (F,) in rad of the top of the frame in each face."""
    towards = np.exp(1j * np.array([s.heading for s in sightings]))
    return np.angle([towards[faces == k].sum() for k in range(faces.max() + 1)]) % (2 * np.pi)


# factor by which the catalogue's errors may be smaller or larger than stated
MAX_FACTOR = 5.0


@dataclass(frozen=True, eq=False, kw_only=True)
class StarPlaces:
    """Corrections of S stars' places along the axes of ICRS, in units of their sigmas in the catalogue.

    stars (S,): rows of the catalogue.  rows: for each frame, which of the S stars are its (N,).  correction (S, 3).
    root (3 S, 3 S): lower triangular, of the weights that the corrections have.
    factor: size of the catalogue's errors over what it states.
    """

    stars: np.ndarray
    rows: tuple[np.ndarray, ...]
    correction: np.ndarray
    root: np.ndarray
    factor: float

    @classmethod
    def of(cls, sightings: Sequence[ZenithSighting]) -> "StarPlaces":
        """The corrections that all frames agree on best."""
        # slow to import
        from scipy.linalg import cho_solve, cholesky

        names, inverse = np.unique(np.concatenate([s.stars for s in sightings]), return_inverse=True)
        rows = tuple(np.split(inverse, np.cumsum([len(s.stars) for s in sightings])[:-1]))
        number = len(names)
        own, right = np.zeros((number, 3, 3)), np.zeros((number, 3))
        # a frame's attitude and scale take up what its stars have in common
        taken = np.zeros((len(sightings), 4, number, 3))
        for k, (row, s) in enumerate(zip(rows, sightings, strict=True)):
            taken[k][:, row] = s.star_common
            own[row] += s.star_weight
            right[row] += s.star_pull
        common = taken.reshape(-1, 3 * number)
        flat, pull = -common.T @ common, right.ravel()
        blocks, each = flat.reshape(number, 3, number, 3), np.arange(number)
        blocks[each, :, each] += own
        factor = _factor(flat, pull)
        root = cholesky(flat + np.eye(len(flat)) / factor**2, lower=True)
        correction = cho_solve((root, True), pull).reshape(-1, 3)
        return cls(stars=names, rows=rows, correction=correction, root=root, factor=factor)

    def applied(self, sightings: Sequence[ZenithSighting]) -> list[ZenithSighting]:
        """The sightings with the attitudes that the corrected places give."""
        return [
            s.turned(rotation.from_vector(-np.einsum("inj,nj->i", s.by_star, self.correction[rows])))
            for rows, s in zip(self.rows, sightings, strict=True)
        ]

    def columns(self, by_camera: np.ndarray, sightings: Sequence[ZenithSighting]) -> np.ndarray:
        """Errors of 1 sigma (N, 2, 3 S) of the readings, by what remains unknown of the places.

        by_camera (N, 2, 3): derivatives of the readings by a small rotation of the camera.
        """
        # slow to import
        from scipy.linalg import solve_triangular

        whole = np.zeros((len(sightings), 2, len(self.correction), 3))
        for k, (rows, s) in enumerate(zip(self.rows, sightings, strict=True)):
            whole[k][:, rows] = np.einsum("ai,inj->anj", by_camera[k], s.by_star)
        flat = whole.reshape(2 * len(sightings), -1)
        return solve_triangular(self.root, flat.T, lower=True).T.reshape(len(sightings), 2, -1)


def _factor(weights: np.ndarray, pull: np.ndarray) -> float:
    """The size of the catalogue's errors, over what it states, that makes the residuals likeliest.

    weights (M, M), pull (M,): normal equations of the stars' displacements in units of their stated sigmas.
    """
    # slow to import
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import minimize_scalar

    def cost(log_factor: float) -> float:
        prior = np.exp(-2 * log_factor)
        root = cholesky(weights + prior * np.eye(len(pull)), lower=True)
        half = solve_triangular(root, pull, lower=True)
        size = len(pull) * 2 * log_factor + 2 * float(np.log(np.diag(root)).sum())
        # a log-normal of a factor of 2 about what is stated, for sessions of few stars
        return size - float(half @ half) + (log_factor / np.log(2)) ** 2

    most = float(np.log(MAX_FACTOR))
    found = minimize_scalar(cost, bounds=(-most, most), method="bounded", options={"xatol": 0.02})
    return float(np.exp(found.x))
