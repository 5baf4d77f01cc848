# SPDX-License-Identifier: Apache-2.0
"""The least-squares problem of a camera and its frames, with weak priors, robust against outliers.

The priors say how far the camera may be from the given one.  Attitudes are eliminated frame by frame (Schur complement),
so that many frames cost little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from starpos import rotation
from starpos.earth.refraction import Atmosphere
from starpos.errors import CalibrationError
from starpos.fix._scatter import distances2
from starpos.fix.star_fit import MatchedStars, judged
from starpos.frozen import at_once
from starpos.instrument.camera import COEFFICIENTS, DECENTRED, EQUIDISTANT, PLUMB_BOB, RATIONAL, Camera

# 1 sigma of the priors about the given camera: relative focal length, fx over fy, principal point (share of the longer
# side), and the shift of a corner by k1, k2, p1, p2, k3 (share of half the diagonal)
FOCAL, SQUARE, PRINCIPAL = 0.03, 0.005, 0.03
CORNER = (0.02, 0.01, 0.003, 0.003, 0.005)
# The same of a fisheye's k1, k2, k3, k4, whose picture's end may be shifted by a quarter (a stereographic lens); it is
# at most so far off the axis, rad; and of p1, p2, which hardly move it.
FISHEYE_EDGE, FISHEYE_MOST_RAD, FISHEYE_DECENTRED = (0.15, 0.08, 0.04, 0.02), 1.6, 0.02
# Refraction shrinks the field: across the vertical as at the zenith, along it twice as much at 45 deg.  For a frame of
# unknown level: the shrinking that is assumed, and its sigma per axis, in units of that at the zenith
UNLEVELLED = 1.25, 0.3
# aberration, which needs a time, changes the scale by this at most
UNTIMED = 1e-4
# the last in sigma of the priors
MAX_ROUNDS, MAX_STEPS, SETTLED = 8, 30, 1e-6
# Step of the numerical derivatives for the attitudes.
STEP_RAD = 1e-6


@at_once
@dataclass(frozen=True, kw_only=True)
class CameraSighting:
    """The identified stars of one frame; their places are apparent directions, aberration included.

    attitude (3, 3): takes these directions into C, approximately.
    level (3, 3): takes C into the local level L; None if unknown.
    upright: whether the directions are along L, as at a known place: then the attitude itself is the level.
    timed: whether the aberration is computed for the frame's date.
    """

    stars: MatchedStars
    attitude: np.ndarray
    level: np.ndarray | None
    timed: bool
    upright: bool = False


def unbent(seen: np.ndarray, level: np.ndarray | None, atmosphere: Atmosphere) -> np.ndarray:
    """Directions (N, 3) in C with the refraction removed; without a level, an average one."""
    if level is not None:
        return atmosphere.refraction().unbend(seen @ level.T) @ level
    return rotation.normalised(seen / np.append([_shrinking(atmosphere)] * 2, 1.0))


def _shrinking(atmosphere: Atmosphere) -> float:
    """Factor by which refraction makes a field of unknown level smaller."""
    return 1 - UNLEVELLED[0] * atmosphere.refraction().a


def parameters(camera: Camera) -> tuple[str, ...]:
    """Names (P,) of the parameters of a camera that can be found: of a rational lens all but its denominator's."""
    return (
        "fx",
        "fy",
        "cx",
        "cy",
        *(COEFFICIENTS[PLUMB_BOB] if camera.model == RATIONAL else camera.coefficients),
    )


def camera_values(camera: Camera) -> np.ndarray:
    """Values (P,) of a camera's parameters."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])[
        : len(parameters(camera))
    ]


def with_values(camera: Camera, values: np.ndarray) -> Camera:
    """A camera of the same size and model with other values (P,) of its parameters."""
    fx, fy, cx, cy, *distortion = values.tolist()
    held = camera.distortion[len(distortion) :]
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=(*distortion, *held))


# The unknowns q are in sigma of their priors: scale, squareness, the camera's other parameters, and these. They are the
# strength of the refraction relative to the model, and the shrinking of the field along x and y if the level is unknown.
# LEANS turn the zenith of the air against L, rad; they are held unless they are asked for
LEANS = ("lean_north", "lean_west")
OF_THE_AIR = ("refraction", "shrink_x", "shrink_y", *LEANS)
# 1 sigma of a lean by a wrong hour, rad
LEAN_RAD = 0.3


def unknowns(camera: Camera) -> tuple[str, ...]:
    """Names (U,) of the unknowns of a camera's fit."""
    return ("scale", "square", *parameters(camera)[2:], *OF_THE_AIR)


@at_once
@dataclass(frozen=True)
class CameraEstimate:
    """The unknowns q (U,) and the attitudes (F, 3, 3) of the frames."""

    q: np.ndarray
    attitudes: np.ndarray


@at_once
@dataclass(frozen=True, kw_only=True)
class CameraAdjustment:
    """The least-squares problem: all N stars of all F frames, frame by frame.

    sigma (U,): of the priors of `unknowns`, 0 for one that is held.
    xy (N, 2) px, stated (N, 2, 2) px2, places (N, 3): seen place, its covariance and direction of each star.
    frame (N,): the frame of each star; first (F,): the row where each frame begins.
    start (F, 3, 3): approximate attitudes.  level (F, 3, 3): C into L, 0 if unknown.
    upright: whether all places are along L.
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
    upright: bool

    @classmethod
    def of(
        cls, sightings: Sequence[CameraSighting], given: Camera, atmosphere: Atmosphere, free: Sequence[str]
    ) -> "CameraAdjustment":
        sightings = [s for s in sightings if len(s.stars.xy)]
        counts = [len(s.stars.xy) for s in sightings]
        direction2 = np.square(np.concatenate([s.stars.place_sigma for s in sightings]) * given.fx)
        untimed = any(not s.timed for s in sightings)
        shrink = np.hypot(UNLEVELLED[1] * atmosphere.refraction().a, UNTIMED * untimed)
        side = PRINCIPAL * max(given.width, given.height)
        held = np.array([name in free for name in parameters(given)])
        camera = np.array([FOCAL, SQUARE, side, side, *_lens_sigma(given)]) * held
        return cls(
            given=given,
            sigma=np.array([*camera, atmosphere.relative_sigma, shrink, shrink, *np.zeros(len(LEANS))]),
            xy=np.concatenate([s.stars.xy for s in sightings]),
            stated=np.concatenate([s.stars.covariance_px2 for s in sightings])
            + np.eye(2) * direction2[:, None, None],
            places=np.concatenate([s.stars.places for s in sightings]),
            frame=np.repeat(np.arange(len(counts)), counts),
            first=np.cumsum([0, *counts[:-1]]),
            start=np.stack([s.attitude for s in sightings]),
            level=np.stack([np.zeros((3, 3)) if s.level is None else s.level for s in sightings]),
            atmosphere=atmosphere,
            upright=all(s.upright for s in sightings),
        )

    def leaning(self, state: CameraEstimate) -> "CameraAdjustment":
        """The problem near an estimate, with the zenith of the air free too."""
        sigma = np.append(self.sigma[: -len(LEANS)], [LEAN_RAD] * len(LEANS))
        return replace(self, given=self.camera(state.q), start=state.attitudes, sigma=sigma)

    @cached_property
    def levelled(self) -> np.ndarray:
        """Mask (N,) of the stars whose frame has a known level."""
        return np.any(self.level != 0, axis=(1, 2))[self.frame]

    def named_per_unit(self) -> np.ndarray:
        """Derivatives (P, U) of the camera's parameters with respect to the unknowns."""
        m = np.eye(len(parameters(self.given)), len(self.sigma))
        m[0, :2], m[1, :2] = np.array([1, 0.5]) * self.given.fx, np.array([1, -0.5]) * self.given.fy
        return m * self.sigma

    def camera(self, q: np.ndarray) -> Camera:
        """The camera with the unknowns q (U,)."""
        return with_values(self.given, camera_values(self.given) + self.named_per_unit() @ q)

    def light(self, state: CameraEstimate) -> np.ndarray:
        """Directions (N, 3) in C from which the light of the stars comes."""
        strength, *shrink, north, west = (state.q * self.sigma)[-len(OF_THE_AIR) :]
        model = self.atmosphere.refraction(1 + strength)
        places = self.places
        if self.upright:
            lean = rotation.from_vector(np.array([north, west, 0.0]))
            places = model.bend(places @ lean.T) @ lean
        u = np.einsum("nij,nj->ni", state.attitudes[self.frame], places)
        if self.upright:
            return u
        if self.levelled.all():
            g = self.level[self.frame]
            return np.einsum("nij,ni->nj", g, model.bend(np.einsum("nij,nj->ni", g, u)))
        out = u * np.append(_shrinking(self.atmosphere) - np.array(shrink), 1.0)
        if (on := self.levelled).any():
            g = self.level[self.frame[on]]
            out[on] = np.einsum("nij,ni->nj", g, model.bend(np.einsum("nij,nj->ni", g, u[on])))
        return out

    def residual(self, state: CameraEstimate) -> np.ndarray:
        """Measured minus predicted places (N, 2) in px."""
        return self.xy - self.camera(state.q).project(self.light(state))

    def turned(self, state: CameraEstimate, turns: np.ndarray) -> CameraEstimate:
        """Each attitude turned by a small rotation (F, 3) about C's axes."""
        new = np.stack([rotation.from_vector(t) @ a for t, a in zip(turns, state.attitudes, strict=True)])
        return CameraEstimate(state.q, new)

    def derivatives(self, state: CameraEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives of the predicted pixels with respect to q (N, 2, U) and to a turn of their own frame (N, 2, 3)."""
        seen, camera = self.light(state), self.camera(state.q)
        here = camera.project(seen)
        of_q = np.zeros((len(here), 2, len(self.sigma)))
        of_camera = len(self.sigma) - len(OF_THE_AIR)
        for k in np.flatnonzero(self.sigma):
            q = state.q.copy()
            q[k] += 1.0 if k < of_camera else 1e-3
            # the projection is linear in each parameter of the camera, so a difference is the derivative
            if k < of_camera:
                of_q[..., k] = self.camera(q).project(seen) - here
            else:
                of_q[..., k] = (camera.project(self.light(replace(state, q=q))) - here) * 1e3
        of_turn = []
        # the light turns with the sky; the change of the refraction over a step is negligible
        for turn in np.eye(3) * STEP_RAD:
            ahead, behind = (camera.project(seen + sign * np.cross(turn, seen)) for sign in (1, -1))
            of_turn.append((ahead - behind) / (2 * STEP_RAD))
        return of_q, np.stack(of_turn, -1)

    def step(
        self, state: CameraEstimate, covariance: np.ndarray, keep: np.ndarray
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
        flat = jq.reshape(-1, len(self.sigma))
        normal = np.eye(len(self.sigma)) + flat.T @ flat - np.einsum("fki,fkj->ij", mixed, solved)
        right = flat.T @ r.ravel() - state.q - np.einsum("fki,fk->i", mixed, pulled)
        inverse = np.linalg.inv(normal)
        dq = inverse @ right
        return dq, pulled - solved @ dq, inverse

    def cost(self, state: CameraEstimate, covariance: np.ndarray, keep: np.ndarray) -> float:
        """Chi-square of the stars to keep (N,) and of the priors; infinite if a star does not project."""
        d2 = distances2(self.residual(state)[keep], covariance[keep])
        total = d2.sum() + state.q @ state.q
        return float(total) if np.isfinite(total) else np.inf

    def refined(
        self, state: CameraEstimate, covariance: np.ndarray, keep: np.ndarray
    ) -> tuple[CameraEstimate, np.ndarray]:
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
                new = self.turned(CameraEstimate(state.q + shorter * dq, state.attitudes), shorter * turns)
                if (lower := self.cost(new, covariance, keep)) <= cost:
                    state, cost = new, lower
                    break
            else:
                # rounding lets the cost become no lower
                break
            if np.abs(dq).max() < SETTLED:
                break
        return state, inverse


def settled_camera(problem: CameraAdjustment) -> tuple[CameraEstimate, np.ndarray, np.ndarray, float]:
    """The fit without outliers, with the stars' errors widened to their scatter; raises CalibrationError.

    Also the covariance (U, U) of q, the mask (N,) of the stars that were kept, and the variance beyond their errors, px2.
    """
    state = CameraEstimate(np.zeros(len(problem.sigma)), problem.start)
    keep, jitter2, stable = np.ones(len(problem.xy), bool), 0.0, False
    fitted = 3 * len(problem.first) + np.count_nonzero(problem.sigma)
    for _ in range(MAX_ROUNDS):
        if keep.sum() < 0.5 * len(keep):
            raise CalibrationError(
                f"only {int(keep.sum())} of {len(keep)} identified stars agree on one camera: check that the frames are "
                "of one"
            )
        state, covariance = problem.refined(state, problem.stated + np.eye(2) * jitter2, keep)
        if stable:
            break
        residual, before = problem.residual(state), (keep, jitter2)
        freedom = max(1 - fitted / (2 * keep.sum()), 0.05)
        jitter2, keep = judged(residual, problem.stated, keep, freedom)
        stable = np.array_equal(keep, before[0]) and abs(jitter2 - before[1]) <= 0.02 * (jitter2 + 1e-6)
    return state, covariance, keep, jitter2


def _lens_sigma(given: Camera) -> np.ndarray:
    """1 sigma of the priors of the lens's coefficients."""
    if given.model == EQUIDISTANT:
        edge = min(given.half_diagonal_rad, FISHEYE_MOST_RAD)
        radial = np.array(FISHEYE_EDGE) / edge ** np.array([2, 4, 6, 8])
        decentred = given.coefficients[-2:] == DECENTRED
        return np.append(radial, [FISHEYE_DECENTRED / (3 * edge)] * 2) if decentred else radial
    r = np.hypot(given.width, given.height) / 2 / np.sqrt(given.fx * given.fy)
    return np.array(CORNER) / np.array([r**2, r**4, 3 * r, 3 * r, r**6])


def _inverse(covariance: np.ndarray) -> np.ndarray:
    """Inverses of symmetric matrices (N, 2, 2); written out, because LAPACK takes ten times as long."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    return np.stack([c, -b, -b, a], -1).reshape(-1, 2, 2) / (a * c - b * b)[:, None, None]
