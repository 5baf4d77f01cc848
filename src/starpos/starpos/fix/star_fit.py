# SPDX-License-Identifier: Apache-2.0
"""Identified stars of a frame, and the attitude and plate scale that fit them best, without outliers and with their
scatter.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import ECCENTRICITY2
from starpos.earth.orientation import EQUATOR_M_PER_S, ROTATION_RAD_S, SPEED_OF_LIGHT, later
from starpos.earth.refraction import MIN_COS_ZENITH, Atmosphere, Refraction
from starpos.errors import FixError
from starpos.fix._adjustment import Adjustment, gain_of, spread
from starpos.fix._scatter import expected_variance, sifted
from starpos.fix.budget import Circumstances
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.frames.exposure import Shutter
from starpos.frames.frame import Stars
from starpos.frozen import at_once
from starpos.identification import Identification
from starpos.instrument.camera import Camera
from starpos.sky.catalogue import Catalogue
from starpos.units import MEDIAN_OF_CHI2

MAX_ROUNDS = 6
MIN_STARS = 3
# the iteration ends at a step below this, in rad and as a share of the scale: the remaining error is a thousandth of it
SETTLED, MAX_STEPS = 1e-11, 20
# the rounds end when the scatter changes by less than this share of itself, and of this minimum, px2
SAME_SHARE, SAME_PX2 = 0.02, 1e-6
# an air that bends nothing
BENT_ALREADY = Refraction(0.0, 0.0, MIN_COS_ZENITH)
# a covariance that is the same in all directions
ISOTROPIC = np.eye(2)


@at_once
@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A4 (3, 3), ITRS into L, and the factor on the focal length, from N stars.

    slope (N, 2, 4): derivatives of their places, px, by a small rotation about L's axes and a relative change of scale.
    residual (N, 2): places by the fit minus seen places, px.
    keep (N,): which of them are not outliers.  jitter2: their scatter beyond the stated errors, px2.
    """

    a4: np.ndarray
    scale: float
    slope: np.ndarray
    residual: np.ndarray
    keep: np.ndarray
    jitter2: float

    @cached_property
    def kept(self) -> slice | np.ndarray:
        """Rows that are not outliers; a slice of all, without a copy, in the usual case."""
        return slice(None) if self.keep.all() else self.keep


def adjustment_of(
    xy: np.ndarray, camera: Camera, g: np.ndarray, itrs: np.ndarray, refraction: Refraction
) -> Adjustment:
    """The problem of N stars, seen at xy (N, 2) px, in the geocentric apparent directions itrs (N, 3).

    g (3, 3): A2 A3, which takes C into L.
    """
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    ground = EQUATOR_M_PER_S / SPEED_OF_LIGHT, ECCENTRICITY2
    return Adjustment(xy, itrs, g, camera.lens, intrinsics, refraction, *ground)


def fitted(problem: Adjustment, local: np.ndarray, stated: np.ndarray) -> Fitted:
    """The fit of the stars, from a closed solution by Gauss-Newton over the rotation A4 and the plate scale.

    The derivatives are computed once: they hardly change over the remaining arcseconds.
    local (N, 3): unrefracted directions in L by the given focal length.  stated (N, 2, 2): covariances of places, px2.
    Raises FixError if the stars are too few or do not agree.
    """
    a4, scale, settled = problem.closed_form(local), 1.0, False
    slope = problem.jacobian(a4, scale)
    keep, jitter2 = np.ones(len(local), bool), 0.0
    for _ in range(MAX_ROUNDS):
        if np.count_nonzero(keep) < max(MIN_STARS, 0.5 * len(keep)):
            raise FixError(
                f"only {np.count_nonzero(keep)} of {len(keep)} identified stars agree on one attitude: no fix from them"
            )
        covariance = np.ascontiguousarray(stated + ISOTROPIC * jitter2)
        a4, scale, residual = problem.refine(
            a4, scale, slope, covariance, keep.view(np.uint8), SETTLED, MAX_STEPS
        )
        if residual is None:
            raise FixError(
                "the identified stars do not fit into the camera's field: check focal length and tilt"
            )
        if settled:
            break
        before = keep, jitter2
        jitter2, keep = judged(residual, stated, keep, share_free(keep))
        change = abs(jitter2 - before[1])
        settled = np.array_equal(keep, before[0]) and change <= SAME_SHARE * (jitter2 + SAME_PX2)
    return Fitted(a4=a4, scale=scale, slope=slope, residual=residual, keep=keep, jitter2=jitter2)


def share_free(keep: np.ndarray) -> float:
    """Share of the 2 N coordinates of N kept stars that four parameters leave free."""
    kept = np.count_nonzero(keep)
    return max(1 - 2 / kept, 1 / kept)


OUTLIER_SIGMA = 5.0
# the grid of variances that `expected_extra` integrates over: minimum in units of the stated variance, maximum in units
# of the sum of the squared residuals
GRID_LEAST, GRID_MOST = 1e-3, 1e2
# the search of the extra variance: minimum as a share of the maximum, and relative precision
MIN_EXTRA, GOOD_EXTRA = 1e-12, 2e-4


def judged(
    residual: np.ndarray, covariance: np.ndarray, keep: np.ndarray, share: float
) -> tuple[float, np.ndarray]:
    """Scatter of residuals (N, 2) px beyond their covariance (N, 2, 2) px2, and a mask (N,) without outliers.

    The scatter is an isotropic variance in px2, of the residuals in the mask `keep` (N,).  share: the part of the 2 N
    coordinates that the parameters of the fit leave free.
    """
    return sifted(
        np.ascontiguousarray(residual, float),
        np.ascontiguousarray(covariance, float),
        np.ascontiguousarray(keep, bool).view(np.uint8),
        share,
        MEDIAN_OF_CHI2,
        OUTLIER_SIGMA**2,
        MIN_EXTRA,
        GOOD_EXTRA,
    )


def expected_extra(residual: np.ndarray, covariance: np.ndarray, share: float) -> float:
    """Extra isotropic variance (px2) to use in a covariance: its expectation instead of the likeliest value.

    Few stars hardly determine their scatter, and the likeliest value is mostly too small: the errors of a fit of N
    stars follow Student's t.  This is the mean of the posterior under Jeffreys' prior of the whole variance; for errors
    that are all alike it is the mean of the inverse gamma distribution.  For many stars it is the value of `judged`.
    """
    residual, covariance = np.ascontiguousarray(residual, float), np.ascontiguousarray(covariance, float)
    # the median; numpy's own takes longer than everything else here
    traces = np.sort(covariance[:, 0, 0] + covariance[:, 1, 1])
    stated = float(traces[(len(traces) - 1) // 2] + traces[len(traces) // 2]) / 4
    most = GRID_MOST * max(stated, float(np.vdot(residual, residual)))
    return expected_variance(residual, covariance, share, stated, GRID_LEAST * stated, most)


# maximum scatter as a share of the frame's diagonal; stars that scatter more were misidentified
MAX_SCATTER = 0.003
STEP_REFRACTION = 0.01
# number of stars that determine whether two frames show the same ones
MARKS = 20


@at_once
@dataclass(frozen=True)
class MatchedStars:
    """N identified stars; ValueError if the arrays do not fit together, FixError if a place's error is not finite.

    xy (N, 2) in px and covariance_px2 (N, 2, 2): where they are on the frame.
    places (N, 3): ICRS directions at the date; place_sigma (N,): their standard deviation per axis in rad.
    index (N,): their rows in the catalogue; None if unknown.
    """

    xy: np.ndarray
    covariance_px2: np.ndarray
    places: np.ndarray
    place_sigma: np.ndarray
    index: np.ndarray | None = None

    def __post_init__(self) -> None:
        n = len(self.xy)
        shapes = (self.xy.shape, self.covariance_px2.shape, self.places.shape, self.place_sigma.shape)
        if shapes != ((n, 2), (n, 2, 2), (n, 3), (n,)) or (self.index is not None and len(self.index) != n):
            raise ValueError(f"arrays of identified stars differ in length or shape: {shapes}")
        if not np.isfinite(self.covariance_px2).all():
            raise FixError("the error of a star's place is not a finite number: leave that star out")

    @classmethod
    def of(
        cls,
        stars: Stars,
        found: Identification,
        use: np.ndarray,
        camera: Camera,
        catalogue: Catalogue,
        year: float,
        places: np.ndarray,
    ) -> "MatchedStars":
        """The identified stars of a frame that are in the mask use (M,); places (N, 3): their directions."""
        star, index = found.star[use], found.catalogue[use]
        return cls(
            np.stack([stars.x, stars.y], -1)[star],
            stars.covariance[star],
            places,
            np.hypot(catalogue.sigma(index, year), found.blend_px[use] / camera.fx),
            index,
        )


def sound_matches(stars: Stars, found: Identification, enough: int) -> np.ndarray:
    """Mask (M,) of the matches to use: stars without a flag, or all if fewer than `enough` are without."""
    sound = stars.sound[found.star]
    return sound if sound.sum() >= enough else np.ones(len(sound), bool)


@at_once
@dataclass(frozen=True, kw_only=True)
class StarFit:
    """A fit of N stars: the problem, its solution, and of the M stars that are kept their errors.

    residual (M, 2): fitted places minus seen places, px.
    gain (3, M, 2): rotation of A4 in rad for an error of one pixel of each star.
    centroids, catalogue (M, 2, 2): covariances in px2.
    same_stars: keys of the stars; frames that share them share the errors of the catalogue.
    """

    problem: Adjustment
    fit: Fitted
    residual: np.ndarray
    gain: np.ndarray
    centroids: np.ndarray
    catalogue: np.ndarray
    same_stars: tuple

    @property
    def own(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of A4's rotation by the errors of the centroids."""
        return self.rotation_covariance(self.centroids)

    def rotated(self, errors_px: np.ndarray) -> np.ndarray:
        """Rotation (3, ...) of A4 in rad that errors (M, 2, ...) of the predicted places in px make."""
        # the gain is for errors of the seen places, which have the opposite sign
        number = 2 * len(errors_px)
        return -self.gain.reshape(3, number) @ errors_px.reshape(number, *errors_px.shape[2:])

    def rotation_covariance(self, covariance: np.ndarray) -> np.ndarray:
        """Covariance (3, 3) in rad2 of A4's rotation, from the covariances (M, 2, 2) in px2 of independent stars."""
        return spread(self.gain, np.ascontiguousarray(covariance))

    @property
    def residual_px(self) -> float:
        """Root mean square residual of a coordinate."""
        return math.sqrt(np.vdot(self.residual, self.residual) / self.residual.size)

    def terms(self, rows: np.ndarray, about: Circumstances) -> tuple[ErrorTerm, ...]:
        """The terms of the stars, the air and the shutter; rows (n, 3): the factors' rows for a small rotation of A4."""
        air = about.atmosphere

        def of_stars(covariance: np.ndarray) -> np.ndarray:
            return rows @ symmetric_root(self.rotation_covariance(covariance))

        bent = self.rotated(self._bent(air) * (air.relative_sigma / STEP_REFRACTION))
        rolling = rows @ self._rolling(about.shutter, about.camera.height)
        return (
            ErrorTerm("centroids", of_stars(self.centroids)),
            ErrorTerm("catalogue", of_stars(self.catalogue), shared=self.same_stars),
            ErrorTerm("refraction", (rows @ bent)[:, None], shared=ALWAYS),
            ErrorTerm("shutter", rolling, shared=ALWAYS, constant_within_pose=True),
        )

    def more(self, moved: np.ndarray, atmosphere: Atmosphere) -> tuple[np.ndarray, np.ndarray]:
        """Refraction beyond the air's, relative, and k more values, which move the M stars by moved (M, 2, k) px a unit.

        With attitude and plate scale free. Returns them (k + 1,), without the first if k > 0, and their covariance.
        """
        strength = self._bent(atmosphere)[..., None] / STEP_REFRACTION
        slope = np.concatenate([self.fit.slope[self.fit.kept], strength, moved], -1)
        whole = self.centroids + self.catalogue
        weighted = np.linalg.solve(whole, slope)
        covariance = np.linalg.pinv(np.einsum("nki,nkj->ij", slope, weighted))
        found = covariance @ np.einsum("nki,nk->i", weighted, -self.residual)
        # the scatter of the stars may stem from a wrong refraction
        left = -self.residual - slope @ found
        free = max(left.size - len(found), 1)
        scatter2 = np.vdot(left, np.linalg.solve(whole, left[..., None])[..., 0]) / free
        begin = 4 + (moved.shape[2] > 0)
        return found[begin:], covariance[begin:, begin:] * scatter2

    def _bent(self, atmosphere: Atmosphere) -> np.ndarray:
        """Move (M, 2) of the stars, px, by STEP_REFRACTION of their refraction more."""
        fit, stronger = self.fit, atmosphere.refraction(1 + STEP_REFRACTION)
        moved = self.problem.predict(fit.a4, fit.scale, stronger) - self.problem.xy - fit.residual
        return moved[fit.kept]

    def _rolling(self, shutter: Shutter, height: int) -> np.ndarray:
        """Rotation (3, 2) of A4 in rad for 1 sigma of the two errors of the rows' times."""
        fit = self.fit
        if not shutter.readout_stddev_s:
            return np.zeros((3, 2))
        # in a second the sky turns about the pole, which is a column of A4
        drift = fit.slope[fit.kept, :, :3] @ (-ROTATION_RAD_S * fit.a4[:, 2])
        late = shutter.errors_s(self.problem.xy[fit.kept, 1], height)
        return self.rotated(drift[..., None] * late[:, None])


def fit_stars(
    stars: MatchedStars, camera: Camera, g: np.ndarray, refraction: Refraction, itrs: np.ndarray
) -> StarFit:
    """Fit A4 and the plate scale to stars; g (3, 3): C into L.  itrs (N, 3): their geocentric apparent directions.

    Raises FixError if the stars are too few or do not agree.
    """
    problem = adjustment_of(stars.xy, camera, g, itrs, refraction)
    catalogue_px2 = ISOTROPIC * ((stars.place_sigma * camera.fx) ** 2)[:, None, None]
    stated = stars.covariance_px2 + catalogue_px2
    fit = fitted(problem, refraction.unbend(camera.directions(*stars.xy.T) @ g.T), stated)
    if fit.jitter2 > (MAX_SCATTER * math.hypot(camera.width, camera.height)) ** 2:
        raise FixError(
            f"the identified stars lie {math.sqrt(fit.jitter2):.1f} px off the best attitude: check the camera's "
            "distortion"
        )
    return _with_errors(problem, fit, stars.covariance_px2, catalogue_px2, stars.index)


def seen_problem(xy: np.ndarray, camera: Camera, seen: np.ndarray) -> Adjustment:
    """The problem of N stars at xy (N, 2) px whose light comes from the directions seen (N, 3) along any axes.

    Nothing bends it on its way: A4 takes these axes into C.
    """
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    return Adjustment(xy, seen, np.eye(3), camera.lens, intrinsics, BENT_ALREADY, 0.0, ECCENTRICITY2)


def fit_seen(xy: np.ndarray, stated: np.ndarray, camera: Camera, seen: np.ndarray) -> StarFit:
    """Fit the camera's attitude and the plate scale to stars as `seen_problem` has them; FixError as `fit_stars`.

    stated (N, 2, 2): covariances of the places, px2, with the catalogue's errors.
    """
    problem = seen_problem(xy, camera, seen)
    fit = fitted(problem, camera.directions(*xy.T), stated)
    return _with_errors(problem, fit, stated, np.zeros_like(stated), None)


def _with_errors(
    problem: Adjustment,
    fit: Fitted,
    centroids_px2: np.ndarray,
    catalogue_px2: np.ndarray,
    index: np.ndarray | None,
) -> StarFit:
    """The fit with the errors of its stars, whose scatter widens the errors of the centroids."""
    kept, residual = fit.kept, fit.residual[fit.kept]
    stated = centroids_px2 + catalogue_px2
    claimed2 = expected_extra(residual, stated[kept], share_free(fit.keep))
    centroids = centroids_px2[kept] + ISOTROPIC * claimed2
    same_stars = ALWAYS if index is None else tuple(index[kept][:MARKS].tolist())
    gain = gain_of(
        np.ascontiguousarray(fit.slope[kept]), np.ascontiguousarray(centroids + catalogue_px2[kept])
    )
    if not np.isfinite(gain).all() or not math.isfinite(claimed2):
        raise FixError(
            f"the {len(residual)} stars do not determine the attitude and its error: more stars are needed, "
            f"further apart, with realistic errors"
        )
    return StarFit(
        problem=problem,
        fit=fit,
        residual=residual,
        gain=gain,
        centroids=centroids,
        catalogue=catalogue_px2[kept],
        same_stars=same_stars,
    )


def apparent(stars: MatchedStars, about: Circumstances) -> np.ndarray:
    """Geocentric apparent directions (N, 3) of the stars in ITRS, each when its row was exposed."""
    itrs, shutter = about.earth.to_itrs(stars.places), about.shutter
    return later(itrs, shutter.later_s(stars.xy[:, 1], about.camera.height)) if shutter.readout_s else itrs
