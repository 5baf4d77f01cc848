# SPDX-License-Identifier: Apache-2.0
"""Fit a camera, and an attitude per frame, to identified stars (camera_adjustment.py), and judge the fit.

A narrow field does not determine everything: a shift of the principal point looks nearly like a turn of the camera, and
k2 and k3 look nearly like k1.  The covariance combines sky and priors.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.calibration.camera_adjustment import (
    STEP_RAD,
    CameraAdjustment,
    CameraEstimate,
    Sighting,
    camera_values,
    parameters,
    settled_camera,
    with_values,
)
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.instrument.camera import Camera
from starpos.instrument.lens import EQUIDISTANT

# the sky determines a parameter if its sigma is below this share of the prior's
TOLD = 0.5
# sigma; a parameter further off than this is not of the given camera
BEYOND_PRIOR = 5.0
# stars for each free parameter; with fewer, one wrong match in a corner can look like a lens
STARS_EACH = 3
MAX_SCATTER_PX = 1.5
# number of points per side of the frame at which a camera is checked and its error computed
BORDER = 25


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera that was fitted to stars.

    covariance (P, P): of the camera's `parameters`, with the scatter beyond the stars' own errors; prior_sigma (P,): of
    the priors.
    attitudes (F, 3, 3): of the frames.
    xy (N, 2) in px: the stars that were kept, frame by frame; frame (N,): the frame of each.
    residual (N, 2) in px: measured minus predicted; before (N, 2): with the given camera, of which only the focal length
    and the attitudes were fitted.
    scatter_px: sigma per axis beyond the stars' own errors.  rejected: number of stars left out.
    """

    camera: Camera
    covariance: np.ndarray
    prior_sigma: np.ndarray
    attitudes: np.ndarray
    xy: np.ndarray
    frame: np.ndarray
    residual: np.ndarray
    before: np.ndarray
    scatter_px: float
    rejected: int

    @property
    def values(self) -> np.ndarray:
        """Values (P,) of the camera's parameters."""
        return camera_values(self.camera)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (P,) of the camera's parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def told(self) -> np.ndarray:
        """Mask (P,) of those parameters that the sky determines; the others are held by their priors."""
        return self.sigma < TOLD * self.prior_sigma

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per axis."""
        return rms(self.residual)

    def sigma_px(self, xy: np.ndarray) -> np.ndarray:
        """Sigma per axis (N,) in px of the camera's predictions at pixels xy (N, 2), after a fit of attitude and scale.

        Every use of the camera fits these two, so their part of the covariance does not matter.
        """
        grid = self._grid
        both = np.concatenate([grid, xy])
        j, free = (_derivatives(self.camera, both, k) for k in (parameters(self.camera), ()))
        n = 2 * len(grid)
        fitted = np.linalg.lstsq(free[:n], j[:n], rcond=None)[0]
        left = (j - free @ fitted)[n:]
        return np.sqrt(np.einsum("ni,ij,nj->n", left, self.covariance, left).reshape(-1, 2).mean(1))

    @property
    def worst_sigma_px(self) -> float:
        """The largest of `sigma_px` over the frame; of a fisheye where it has shown stars."""
        return float(self.sigma_px(self._grid).max())

    @property
    def _grid(self) -> np.ndarray:
        """Pixels (G, 2) all over the frame; of a fisheye where it has shown stars."""
        grid, middle = _grid(self.camera, BORDER), [self.camera.cx, self.camera.cy]
        if self.camera.model != EQUIDISTANT:
            return grid
        return grid[np.hypot(*(grid - middle).T) <= np.hypot(*(self.xy - middle).T).max()]


def rms(residual: np.ndarray) -> float:
    """Root mean square per axis of residuals (N, 2)."""
    return float(np.sqrt(np.mean(residual * residual)))


def fit_camera(
    sightings: Sequence[Sighting], given: Camera, atmosphere: Atmosphere, free: Sequence[str] = ()
) -> Intrinsics:
    """Fit a camera near the `given` one to all sightings; parameters that are not in `free` keep their values.

    Without `free` all are fitted. Raises CalibrationError if the stars are too few or do not agree.  `check_sound` says
    whether the fit is good.
    """
    free = free or parameters(given)
    count, fewest = sum(len(s.xy) for s in sightings), fewest_stars(free)
    if count < fewest:
        raise CalibrationError(
            f"{count} identified stars are too few for a camera: give frames with {fewest} at least"
        )
    problem = CameraAdjustment.of(sightings, given, atmosphere, free)
    fitted = settled_camera(problem)
    camera = problem.camera(fitted.state.q)
    to_named = problem.named_per_unit()
    keep = fitted.keep
    held = problem.with_free("scale")
    before, _ = held.refined(
        CameraEstimate(np.zeros(len(problem.sigma)), problem.start), problem.stated + np.eye(2), keep
    )
    return Intrinsics(
        camera=camera,
        covariance=to_named @ fitted.covariance @ to_named.T,
        prior_sigma=np.sqrt(np.square(to_named).sum(1)),
        attitudes=fitted.state.attitudes,
        xy=problem.xy[keep],
        frame=problem.frame[keep],
        residual=problem.residual(fitted.state)[keep],
        before=held.residual(before)[keep],
        scatter_px=float(np.sqrt(fitted.jitter2)),
        rejected=int((~keep).sum()),
    )


def fewest_stars(free: Sequence[str]) -> int:
    """Number of stars that a camera with these free parameters needs; an attitude counts as one parameter."""
    return STARS_EACH * (len(free) + 1)


def check_sound(fitted: Intrinsics, given: Camera) -> None:
    """Raise CalibrationError if the fit is not good enough to work with."""
    if (np.abs(fitted.values - camera_values(given)) > BEYOND_PRIOR * fitted.prior_sigma).any():
        raise CalibrationError(
            "the stars fit a camera too different from the given one: check focal length and pixel size, "
            "and that the frames "
            "are of one camera"
        )
    if fitted.scatter_px > MAX_SCATTER_PX:
        raise CalibrationError(
            f"the identified stars lie {fitted.scatter_px:.1f} px off the best camera, {MAX_SCATTER_PX:g} at most are "
            "allowed: check that the frames are sharp and of one camera and focus"
        )
    check_invertible(fitted.camera)


def check_invertible(camera: Camera) -> None:
    """Raise CalibrationError if the distortion folds inside the frame."""
    try:
        camera.directions(*_grid(camera, BORDER).T)
    except InstrumentError:
        raise CalibrationError(
            "the distortion fitted to these stars folds inside the frame: give more frames, with stars in "
            "the corners"
        ) from None


def _grid(camera: Camera, side: int) -> np.ndarray:
    """Pixels (side^2, 2) on a regular grid over the frame, its corners included."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, side), np.linspace(0, camera.height - 1, side))
    return np.stack([x.ravel(), y.ravel()], -1)


def _derivatives(camera: Camera, xy: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Derivatives (2 N, P) of pixels by the parameters named; without names, by attitude and scale (2 N, 4)."""
    v = camera.directions(*xy.T)
    here = camera.project(v)
    if not names:
        turned = [camera.project(v + np.cross(t, v)) - here for t in np.eye(3) * STEP_RAD]
        turned.append(camera.scaled(1 + STEP_RAD).project(v) - here)
        return np.stack(turned, -1).reshape(-1, 4) / STEP_RAD
    moved = [
        with_values(camera, camera_values(camera) + step).project(v) - here for step in np.eye(len(names))
    ]
    return np.stack(moved, -1).reshape(-1, len(names))
