# SPDX-License-Identifier: Apache-2.0
"""Turning on the spot: the angle between camera and plumb line from frames at several headings, at no known place.

Each frame's stars give the attitude R of the camera among them whatever A3 is.  The zenith is one direction of the
Earth, z = R^T A3^T s, with s the plumb line as the inclinometer reads it: an A3 that is wrong turns with the instrument
and takes z round a circle, the right one keeps it still.  Of A3's tilts and the inclinometer's zero only the sum matters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from starpos import rotation
from starpos.errors import FixError
from starpos.fix import Fix
from starpos.inclinometer import Tilt, a2_matrix
from starpos.instrument import Calibration, Instrument
from starpos.progress import Progress, quiet
from starpos.solve import Solution, Solver
from starpos.stars import Stars

UNKNOWN_ARCSEC = (
    10 * 3600.0,
    10 * 3600.0,
    90 * 3600.0,
)  # of A3 before anything is known of it, about S's axes
ROUNDS = 4
SETTLED_RAD = np.radians(0.02 / 3600)
ROBUST_SIGMA = 3.0  # beyond it a frame pulls no harder
TURNS_TRIED = 8
LEAN_CHI2 = 25.0  # by which the tilts must follow the heading before they are believed to
AMBIGUOUS_SIGMA = 4.0  # zeniths of equally good solutions further apart are two answers
AS_GOOD = 8.0  # half the chi-square by which a solution may be worse than the best and still be true
SAME_AXIS = 1e-9  # share of the axis' weight below which the headings do not tell it
EARTH_RADIUS_M = 6.371e6


@dataclass(frozen=True)
class Turned:
    """What turning gave: the instrument with its A3, and each frame solved with it.

    plumb_stddev_arcsec: of the plumb line in the camera, the worse of two axes.  The fixes still hold A3 for unknown, so
    that the covariance of their `average` says how well the headings tell it and the place apart.
    """

    instrument: Instrument
    plumb_stddev_arcsec: float
    solutions: tuple[Solution, ...]

    @property
    def fixes(self) -> list[Fix]:
        return [s.fix for s in self.solutions if s.fix]


def turn(
    solver: Solver,
    frames: Sequence[Stars],
    tilt: Callable[[float, float], Tilt],
    progress: Progress = quiet,
) -> Turned:
    """A3 and the place of frames of one place at several headings; the solver's A3 need not be near.

    tilt: of (mid_unix_s, exposure_s).  From fewer than two fixes A3 stays what it was; FixError where the instrument
    leans and the headings do not tell which way.
    """
    unknown = Calibration.of(solver.instrument.calibration.misalignment_deg, UNKNOWN_ARCSEC)
    solver = replace(solver, instrument=replace(solver.instrument, calibration=unknown))
    solutions: list[Solution | None] = [None] * len(frames)
    plumb_stddev = float(np.max(UNKNOWN_ARCSEC[:2]))
    for k in range(ROUNDS):
        for n, stars in enumerate(frames):
            known = solutions[n].standing if solutions[n] else None
            solutions[n] = solver.solve(stars, tilt, known)
            progress("turning", (k + (n + 1) / len(frames)) / ROUNDS)
        solved = [s for s in solutions if s.fix]
        if len(solved) < 2:
            break
        a3, plumb_stddev = _level(solved, solver.instrument)
        moved = np.linalg.norm(rotation.to_small_vector(a3 @ solver.instrument.mounting.a3.T)[:2])
        solver = replace(
            solver,
            instrument=replace(solver.instrument, calibration=solver.instrument.calibration.turned_to(a3)),
        )
        if moved < SETTLED_RAD:
            break
    progress("turning", 1.0)
    return Turned(solver.instrument, plumb_stddev, tuple(solutions))


def _level(solved: Sequence[Solution], instrument: Instrument) -> tuple[np.ndarray, float]:
    """A3 (3, 3) that keeps the zenith still, and the error of the plumb line in the camera, arcsec.

    Its turn about the plumb line is told by the instrument's lean alone, if there is any: all of them are tried.
    """
    to_camera = np.array([s.fix.camera_to_itrs.T for s in solved])
    plumb = np.array([a2_matrix(s.tilt.theta_x, s.tilt.theta_y)[2] for s in solved])
    sigma = np.array([_own_sigma(s.fix) for s in solved])
    mean = plumb.sum(0) / np.linalg.norm(plumb.sum(0))
    start = _axis_of_turn(to_camera, plumb, instrument.mounting.a3)
    if not _leans(plumb - mean, np.array([s.fix.heading for s in solved]), sigma):
        level = _fitted(to_camera, np.broadcast_to(mean, plumb.shape), sigma, start)
        return level.a3, float(np.degrees(level.plumb_sigma) * 3600)
    found = [
        _fitted(to_camera, plumb, sigma, rotation.from_vector(mean * angle) @ start)
        for angle in np.arange(0.0, 2 * np.pi, 2 * np.pi / TURNS_TRIED)
    ]
    best = min(found, key=lambda f: f.cost)
    as_good = [f.zenith for f in found if f.cost < best.cost + AS_GOOD]
    apart = max(np.linalg.norm(z - best.zenith) for z in as_good)
    if apart > AMBIGUOUS_SIGMA * best.zenith_sigma:
        lean = np.degrees(np.arccos(np.clip(plumb @ mean, -1, 1)).max())
        raise FixError(
            f"the instrument leans by {lean:.2f} deg from one heading to the other, and these headings do not tell which "
            "way its inclinometer faces: level it better, or turn it to three headings or more"
        )
    return best.a3, float(np.degrees(best.plumb_sigma) * 3600)


def _leans(off: np.ndarray, heading: np.ndarray, sigma: np.ndarray) -> bool:
    """Whether the plumb line in S, off (N, 3) from its mean, goes round with the heading (N,) by more than its noise."""
    weight = 1 / sigma[:, None]
    constant = np.ones((len(off), 1)) * weight
    round_ = np.stack([np.ones(len(off)), np.cos(heading), np.sin(heading)], -1) * weight
    still, going = (np.linalg.lstsq(d, off * weight, rcond=1e-6)[0] for d in (constant, round_))
    better = np.sum((off * weight - constant @ still) ** 2) - np.sum((off * weight - round_ @ going) ** 2)
    return bool(better > LEAN_CHI2)


@dataclass(frozen=True)
class _Fitted:
    """cost: half the robust chi-square; the others rad and rotation (3, 3), zenith (3,)."""

    a3: np.ndarray
    zenith: np.ndarray
    cost: float
    zenith_sigma: float
    plumb_sigma: float


def _fitted(to_camera: np.ndarray, plumb: np.ndarray, sigma: np.ndarray, start: np.ndarray) -> _Fitted:
    """Robust least squares for A3, from `start`, and the zenith; A3's tilts only are held, to UNKNOWN_ARCSEC."""
    zenith = np.einsum("kji,jl,kl->i", to_camera, start.T, plumb)
    zenith /= np.linalg.norm(zenith)
    level = np.linalg.svd(zenith[None])[2][1:]  # two axes across the zenith
    mean = plumb.sum(0) / np.linalg.norm(plumb.sum(0))
    turns = np.vstack([np.linalg.svd(mean[None])[2][1:], mean]).T  # across the plumb line in S, and about it
    loose = np.radians(UNKNOWN_ARCSEC[0] / 3600)

    def whitened(p):
        a3 = rotation.from_vector(turns @ p[:3]) @ start
        off = (np.einsum("kji,jl,kl->ki", to_camera, a3.T, plumb) - zenith) @ level.T - p[3:]
        return np.concatenate([(off / sigma[:, None]).ravel(), p[:2] / loose, p[2:3] / np.pi])

    found = least_squares(
        whitened, np.zeros(5), "3-point", loss="huber", f_scale=ROBUST_SIGMA, x_scale=[1e-4, 1e-4, 1e-2, 1e-5, 1e-5],
        xtol=1e-14, ftol=1e-14,
    )  # fmt: skip
    # without the turn about the plumb line, which may be as good as unknown
    told = np.delete(found.jac, 2, 1)
    covariance = np.linalg.inv(told.T @ told)
    return _Fitted(
        rotation.from_vector(turns @ found.x[:3]) @ start,
        zenith + found.x[3:] @ level,
        float(found.cost),
        float(np.sqrt(np.linalg.eigvalsh(covariance[2:, 2:])[-1])),
        float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])),
    )


def _axis_of_turn(to_camera: np.ndarray, plumb: np.ndarray, given: np.ndarray) -> np.ndarray:
    """A3 (3, 3), the nearest to `given` whose plumb line is the direction of C that all frames have at one zenith."""
    mean = plumb.sum(0) / np.linalg.norm(plumb.sum(0))
    _, strength, directions = np.linalg.svd(np.mean(to_camera, 0).T)
    if strength[0] - strength[1] < SAME_AXIS:  # one heading: any direction is
        return given
    up = directions[0] * np.sign(directions[0] @ given.T @ mean)
    between = given @ up
    axis = np.cross(between, mean)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return given
    return rotation.from_vector(axis / sine * np.arctan2(sine, between @ mean)) @ given


def _own_sigma(fix: Fix) -> float:
    """Of one frame's zenith, rad, one axis, without what all frames share."""
    covariance = sum(t.covariance for t in fix.terms if not t.common)[:2, :2]
    return float(np.sqrt(np.trace(covariance) / 2)) / EARTH_RADIUS_M
