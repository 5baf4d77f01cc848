# SPDX-License-Identifier: Apache-2.0
"""Fits one camera, and one attitude per frame, to identified stars: robust weighted least squares with weak priors.

A narrow field cannot tell everything: a shift of the principal point looks nearly like a turn of the camera, and k2 and
k3 look nearly like k1.  The priors say how far the camera may be from the given one; the covariance is that of sky and
priors together.  Attitudes are eliminated frame by frame (Schur complement), so that many frames cost little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError, InstrumentError
from starpos.fix.outliers import distance2, judged
from starpos.instrument.camera import Camera

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
# 1 sigma of the priors about the given camera: relative focal length, fx over fy, principal point (share of the longer
# side), and the shift of a corner by k1, k2, p1, p2, k3 (share of half the diagonal)
FOCAL, SQUARE, PRINCIPAL = 0.03, 0.005, 0.03
CORNER = (0.02, 0.01, 0.003, 0.003, 0.005)
# Refraction shrinks the field: across the vertical as at the zenith, along it twice as much at 45 deg.  For a frame of
# unknown level: the shrinking that is assumed, and its sigma per axis, in units of that at the zenith
UNLEVELLED = 1.25, 0.3
# aberration, which needs a time, changes the scale by this at most
UNTIMED = 1e-4
# the sky has told a parameter if its sigma is below this share of the prior's
TOLD = 0.5
# sigma; a parameter further off than this is not of the given camera
BEYOND_PRIOR = 5.0
# stars for each free parameter; with fewer, one wrong match in a corner can look like a lens
STARS_EACH = 3
MAX_SCATTER_PX = 1.5
# the last in sigma of the priors
MAX_ROUNDS, MAX_STEPS, SETTLED = 8, 30, 1e-6
STEP_RAD = 1e-6  # of the numerical derivatives for the attitudes
# a camera is checked, and its error computed, at so many points per side of the frame
BORDER = 25


@dataclass(frozen=True, kw_only=True)
class Sighting:
    """The identified stars of one frame.

    xy (N, 2) in px and covariance_px2 (N, 2, 2): as measured.
    directions (N, 3): apparent directions, aberration included; direction_sigma (N,): sigma per axis in rad.
    attitude (3, 3): takes `directions` into C, approximately.
    level (3, 3): takes C into the local level L; None if unknown.
    timed: whether the aberration is that of the frame's date.
    """

    xy: np.ndarray
    covariance_px2: np.ndarray
    directions: np.ndarray
    direction_sigma: np.ndarray
    attitude: np.ndarray
    level: np.ndarray | None
    timed: bool


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera that was fitted to stars.

    covariance (9, 9): of PARAMETERS, with the scatter beyond the stars' own errors; prior_sigma (9,): of the priors.
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
        """Values (9,) of PARAMETERS."""
        return _values(self.camera)

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (9,) of PARAMETERS."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def told(self) -> np.ndarray:
        """Mask (9,) of those PARAMETERS that the sky determines; the others are held by their priors."""
        return self.sigma < TOLD * self.prior_sigma

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals per axis."""
        return rms(self.residual)

    def sigma_px(self, xy: np.ndarray) -> np.ndarray:
        """Sigma per axis (N,) in px of the camera's predictions at pixels xy (N, 2), after a fit of attitude and scale.

        Every use of the camera fits these two, so their part of the covariance does not matter.
        """
        grid = _grid(self.camera, BORDER)
        j, free = (_derivatives(self.camera, np.concatenate([grid, xy]), k) for k in (PARAMETERS, ()))
        n = 2 * len(grid)
        fitted = np.linalg.lstsq(free[:n], j[:n], rcond=None)[0]
        left = (j - free @ fitted)[n:]
        return np.sqrt(np.einsum("ni,ij,nj->n", left, self.covariance, left).reshape(-1, 2).mean(1))

    @property
    def worst_sigma_px(self) -> float:
        """The largest of `sigma_px` over the frame."""
        return float(self.sigma_px(_grid(self.camera, BORDER)).max())


def rms(residual: np.ndarray) -> float:
    """Root mean square per axis of residuals (N, 2)."""
    return float(np.sqrt(np.mean(residual * residual)))


def fit_camera(
    sightings: Sequence[Sighting], given: Camera, atmosphere: Atmosphere, free: Sequence[str] = PARAMETERS
) -> Intrinsics:
    """Fit a camera near the `given` one to all sightings; parameters that are not in `free` keep their values.

    Raises CalibrationError if the stars are too few or do not agree.  `check_sound` tells whether the fit is good.
    """
    count, fewest = sum(len(s.xy) for s in sightings), fewest_stars(free)
    if count < fewest:
        raise CalibrationError(
            f"{count} identified stars are too few for a camera: give frames with {fewest} at least"
        )
    problem = _CameraAdjustment.of(sightings, given, atmosphere, free)
    fitted = _settled(problem)
    camera = problem.camera(fitted.state.q)
    to_named = problem.named_per_unit()
    keep = fitted.keep
    held = replace(problem, sigma=problem.sigma * _only("scale"))
    before, _ = held.refined(
        _CameraEstimate(np.zeros(len(UNKNOWNS)), problem.start), problem.stated + np.eye(2), keep
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


def fewest_stars(free: Sequence[str] = PARAMETERS) -> int:
    """Number of stars that a camera with these free parameters needs; an attitude counts as one parameter."""
    return STARS_EACH * (len(free) + 1)


def check_sound(fitted: Intrinsics, given: Camera) -> None:
    """Raise CalibrationError if the fit is not good enough to work with."""
    if (np.abs(fitted.values - _values(given)) > BEYOND_PRIOR * fitted.prior_sigma).any():
        raise CalibrationError(
            "the stars want a camera too unlike the given one: check focal length and pixel size, and that the frames "
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
            "the distortion these stars tell folds inside the frame: give more frames, with stars in the corners"
        ) from None


def unbent(seen: np.ndarray, level: np.ndarray | None, atmosphere: Atmosphere) -> np.ndarray:
    """Directions (N, 3) in C with the refraction removed; without a level, an average one."""
    if level is not None:
        return atmosphere.refraction().unbend(seen @ level.T) @ level
    return rotation.normalised(seen / np.append([_shrinking(atmosphere)] * 2, 1.0))


def _shrinking(atmosphere: Atmosphere) -> float:
    """Factor by which refraction makes a field of unknown level smaller."""
    return 1 - UNLEVELLED[0] * atmosphere.refraction().a


def _grid(camera: Camera, side: int) -> np.ndarray:
    """Pixels (side^2, 2) on a regular grid over the frame, its corners included."""
    x, y = np.meshgrid(np.linspace(0, camera.width - 1, side), np.linspace(0, camera.height - 1, side))
    return np.stack([x.ravel(), y.ravel()], -1)


def _values(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])


def _with_values(camera: Camera, values: np.ndarray) -> Camera:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values.tolist()
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2, k3))


# The unknowns q, in sigma of their priors: scale, squareness, seven parameters of the camera, the strength of the
# refraction relative to the model, and the shrinking of the field along x and y where the level is not known
UNKNOWNS = ("scale", "square", *PARAMETERS[2:], "refraction", "shrink_x", "shrink_y")
CAMERA_UNKNOWNS = 9


def _only(name: str) -> np.ndarray:
    return np.array([u == name for u in UNKNOWNS], float)


@dataclass(frozen=True)
class _CameraEstimate:
    """The unknowns q (U,) and the attitudes (F, 3, 3) of the frames."""

    q: np.ndarray
    attitudes: np.ndarray


@dataclass(frozen=True)
class _Settled:
    """A finished fit: covariance (U, U) of q, mask `keep` (N,) of the stars, variance beyond their errors in px2."""

    state: _CameraEstimate
    covariance: np.ndarray
    keep: np.ndarray
    jitter2: float


@dataclass(frozen=True, kw_only=True)
class _CameraAdjustment:
    """The least-squares problem: all N stars of all F frames, frame by frame.

    sigma (U,): of the priors of UNKNOWNS, 0 for one that is held.
    xy (N, 2) px, stated (N, 2, 2) px2, places (N, 3): seen place, its covariance and direction of each star.
    frame (N,): the frame of each star; first (F,): the row where each frame begins.
    start (F, 3, 3): approximate attitudes.  level (F, 3, 3): C into L, 0 if unknown.
    """

    given: Camera
    sigma: np.ndarray
    xy: np.ndarray
    stated: np.ndarray
    places: np.ndarray
    frame: np.ndarray
    first: np.ndarray
    start: np.ndarray
    level: np.ndarray
    atmosphere: Atmosphere

    @classmethod
    def of(
        cls, sightings: Sequence[Sighting], given: Camera, atmosphere: Atmosphere, free: Sequence[str]
    ) -> "_CameraAdjustment":
        sightings = [s for s in sightings if len(s.xy)]
        counts = [len(s.xy) for s in sightings]
        direction2 = np.square(np.concatenate([s.direction_sigma for s in sightings]) * given.fx)
        untimed = any(not s.timed for s in sightings)
        shrink = np.hypot(UNLEVELLED[1] * atmosphere.refraction().a, UNTIMED * untimed)
        half = np.hypot(given.width, given.height) / 2
        r = half / np.sqrt(given.fx * given.fy)
        shift = np.array(CORNER) / np.array([r**2, r**4, 3 * r, 3 * r, r**6])
        side = PRINCIPAL * max(given.width, given.height)
        held = np.array([name in free for name in PARAMETERS])
        camera = np.array([FOCAL, SQUARE, side, side, *shift]) * held
        return cls(
            given=given,
            sigma=np.array([*camera, atmosphere.relative_sigma, shrink, shrink]),
            xy=np.concatenate([s.xy for s in sightings]),
            stated=np.concatenate([s.covariance_px2 for s in sightings])
            + np.eye(2) * direction2[:, None, None],
            places=np.concatenate([s.directions for s in sightings]),
            frame=np.repeat(np.arange(len(counts)), counts),
            first=np.cumsum([0, *counts[:-1]]),
            start=np.stack([s.attitude for s in sightings]),
            level=np.stack([np.zeros((3, 3)) if s.level is None else s.level for s in sightings]),
            atmosphere=atmosphere,
        )

    @cached_property
    def levelled(self) -> np.ndarray:
        """Mask (N,) of the stars whose frame has a known level."""
        return np.any(self.level != 0, axis=(1, 2))[self.frame]

    def named_per_unit(self) -> np.ndarray:
        """Derivatives (9, U) of PARAMETERS with respect to the unknowns."""
        m = np.zeros((len(PARAMETERS), len(UNKNOWNS)))
        m[0, :2], m[1, :2] = np.array([1, 0.5]) * self.given.fx, np.array([1, -0.5]) * self.given.fy
        m[range(2, 9), range(2, 9)] = 1.0
        return m * self.sigma

    def camera(self, q: np.ndarray) -> Camera:
        return _with_values(self.given, _values(self.given) + self.named_per_unit() @ q)

    def seen(self, state: _CameraEstimate) -> np.ndarray:
        """Directions (N, 3) in C from which the light of the stars comes."""
        u = np.einsum("nij,nj->ni", state.attitudes[self.frame], self.places)
        strength, *shrink = (state.q * self.sigma)[CAMERA_UNKNOWNS:]
        model = self.atmosphere.refraction(1 + strength)
        if self.levelled.all():
            g = self.level[self.frame]
            return np.einsum("nij,ni->nj", g, model.bend(np.einsum("nij,nj->ni", g, u)))
        out = u * np.append(_shrinking(self.atmosphere) - np.array(shrink), 1.0)
        if (on := self.levelled).any():
            g = self.level[self.frame[on]]
            out[on] = np.einsum("nij,ni->nj", g, model.bend(np.einsum("nij,nj->ni", g, u[on])))
        return out

    def residual(self, state: _CameraEstimate) -> np.ndarray:
        return self.xy - self.camera(state.q).project(self.seen(state))

    def turned(self, state: _CameraEstimate, turns: np.ndarray) -> _CameraEstimate:
        """Each attitude turned by a small rotation (F, 3) about C's axes."""
        new = np.stack([rotation.from_vector(t) @ a for t, a in zip(turns, state.attitudes, strict=True)])
        return _CameraEstimate(state.q, new)

    def derivatives(self, state: _CameraEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the predicted pixels with respect to q (N, 2, U) and to a turn of their own frame (N, 2, 3)."""
        seen, camera = self.seen(state), self.camera(state.q)
        here = camera.project(seen)
        of_q = np.zeros((len(here), 2, len(UNKNOWNS)))
        for k in np.flatnonzero(self.sigma):
            q = state.q.copy()
            q[k] += 1.0 if k < CAMERA_UNKNOWNS else 1e-3
            # the projection is linear in each parameter of the camera, so a difference is the derivative
            if k < CAMERA_UNKNOWNS:
                of_q[..., k] = self.camera(q).project(seen) - here
            else:
                of_q[..., k] = (camera.project(self.seen(replace(state, q=q))) - here) * 1e3
        of_turn = []
        # the light turns with the sky; the change of the refraction over a step is negligible
        for turn in np.eye(3) * STEP_RAD:
            ahead, behind = (camera.project(seen + sign * np.cross(turn, seen)) for sign in (1, -1))
            of_turn.append((ahead - behind) / (2 * STEP_RAD))
        return of_q, np.stack(of_turn, -1)

    def step(
        self, state: _CameraEstimate, covariance: np.ndarray, keep: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A Gauss-Newton step: change of q (U,), turns of the frames (F, 3), and the covariance (U, U) of q."""
        weight = np.linalg.cholesky(_inverse(covariance)) * keep[:, None, None]
        of_q, of_turn = self.derivatives(state)
        jq, jt = (np.einsum("nki,nkj->nij", weight, j) for j in (of_q, of_turn))
        r = np.einsum("nki,nk->ni", weight, self.residual(state))

        def sum_per_frame(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.add.reduceat(np.einsum("nki,nkj->nij", a, b), self.first)

        # the unit matrix serves a frame without stars; it is negligible for all others
        turns = sum_per_frame(jt, jt) + np.eye(3)
        mixed, pull = sum_per_frame(jt, jq), sum_per_frame(jt, r[..., None])[..., 0]
        solved, pulled = np.linalg.solve(turns, mixed), np.linalg.solve(turns, pull[..., None])[..., 0]
        flat = jq.reshape(-1, len(UNKNOWNS))
        normal = np.eye(len(UNKNOWNS)) + flat.T @ flat - np.einsum("fki,fkj->ij", mixed, solved)
        right = flat.T @ r.ravel() - state.q - np.einsum("fki,fk->i", mixed, pulled)
        inverse = np.linalg.inv(normal)
        dq = inverse @ right
        return dq, pulled - solved @ dq, inverse

    def cost(self, state: _CameraEstimate, covariance: np.ndarray, keep: np.ndarray) -> float:
        d2 = distance2(self.residual(state)[keep], covariance[keep])
        total = d2.sum() + state.q @ state.q
        return float(total) if np.isfinite(total) else np.inf

    def refined(
        self, state: _CameraEstimate, covariance: np.ndarray, keep: np.ndarray
    ) -> tuple[_CameraEstimate, np.ndarray]:
        """The minimum that is reached from `state`, and the covariance (U, U) of q there.

        Raises CalibrationError if the stars do not project into the frame.
        """
        cost = self.cost(state, covariance, keep)
        if cost == np.inf:
            raise CalibrationError(
                "the identified stars do not fit into the camera's field: check the focal length"
            )
        for _ in range(MAX_STEPS):
            dq, turns, inverse = self.step(state, covariance, keep)
            for shorter in 0.5 ** np.arange(8):
                new = self.turned(_CameraEstimate(state.q + shorter * dq, state.attitudes), shorter * turns)
                if (lower := self.cost(new, covariance, keep)) <= cost:
                    state, cost = new, lower
                    break
            else:
                # rounding lets the cost become no lower
                break
            if np.abs(dq).max() < SETTLED:
                break
        return state, inverse


def _settled(problem: _CameraAdjustment) -> _Settled:
    """The fit without outliers, with the stars' errors widened to their scatter; raises CalibrationError."""
    state = _CameraEstimate(np.zeros(len(UNKNOWNS)), problem.start)
    keep, jitter2, settled = np.ones(len(problem.xy), bool), 0.0, False
    unknowns = 3 * len(problem.first) + np.count_nonzero(problem.sigma)
    for _ in range(MAX_ROUNDS):
        if keep.sum() < 0.5 * len(keep):
            raise CalibrationError(
                f"only {int(keep.sum())} of {len(keep)} identified stars agree on one camera: check that the frames are "
                "of one"
            )
        state, covariance = problem.refined(state, problem.stated + np.eye(2) * jitter2, keep)
        if settled:
            break
        residual, before = problem.residual(state), (keep, jitter2)
        freedom = max(1 - unknowns / (2 * keep.sum()), 0.05)
        jitter2, keep = judged(residual, problem.stated, keep, freedom)
        settled = np.array_equal(keep, before[0]) and abs(jitter2 - before[1]) <= 0.02 * (jitter2 + 1e-6)
    return _Settled(state, covariance, keep, jitter2)


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Inverses of symmetric matrices (N, 2, 2); written out, because LAPACK takes ten times as long."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.stack([c, -b, -b, a], -1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]


def _derivatives(camera: Camera, xy: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Derivatives (2 N, 9) of pixels by the parameters; without names, by attitude and scale (2 N, 4)."""
    v = camera.directions(*xy.T)
    here = camera.project(v)
    if not names:
        turned = [camera.project(v + np.cross(t, v)) - here for t in np.eye(3) * STEP_RAD]
        turned.append(camera.scaled(1 + STEP_RAD).project(v) - here)
        return np.stack(turned, -1).reshape(-1, 4) / STEP_RAD
    moved = [_with_values(camera, _values(camera) + step).project(v) - here for step in np.eye(9)]
    return np.stack(moved, -1).reshape(-1, 9)
