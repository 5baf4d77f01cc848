# SPDX-License-Identifier: Apache-2.0
"""The plumb line in the camera: A3 from the attitudes of frames and their tilts, with a known or an unknown zenith.

The stars of each frame give the attitude R of the camera against the Earth without A3.  The zenith is a fixed direction
of the Earth, z = R^T A3^T s, where s is the plumb line as the inclinometer reads it.  With a wrong A3 the z of several
headings lie on a circle; with the right one they agree.  Only the sum of A3's tilts and the inclinometer's zero matters.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.errors import FixError
from starpos.fix.fix import Fix
from starpos.instrument.inclinometer import InclinometerErrors, Tilt, a2_matrix
from starpos.units import ARCSEC

# sigma of A3 about S's axes before anything is known of it
UNKNOWN_ARCSEC = (36000.0, 36000.0, 324000.0)
# a frame further off than this pulls no harder
ROBUST_SIGMA, ROBUST_ROUNDS = 3.0, 10
TURNS_TRIED = 8
# chi-square per degree of freedom above which the search ended in a wrong minimum
FOUND_SCATTER = 16.0
# the instrument leans if chi-square falls by this when the tilts may follow the heading
LEAN_CHI2 = 25.0
# zeniths of equally good solutions that are further apart are two answers
AMBIGUOUS_SIGMA = 4.0
# root mean square, per axis, of the way a random turn moves a point on a circle, in radii
ANY_TURN = np.sqrt(1.5)
TOLD_TURN = np.radians(10)
# if the turn is known better than this, no other turns need be tried
NARROW_TURN = np.radians(20)
# half the chi-square by which a solution may be worse than the best and still be true
AS_GOOD = 8.0
# share of the axis' weight below which the headings do not tell the axis
SAME_AXIS = 1e-9
MOST_STEPS, LONGEST_STEP, SETTLED_RAD = 60, 0.5, 1e-11


@dataclass(frozen=True)
class FixedFrame:
    """A frame's fix, and the tilt that it was made with."""

    fix: Fix
    tilt: Tilt


@dataclass(frozen=True)
class Readings:
    """Attitudes and tilts of K frames.

    to_camera (K, 3, 3): ITRS into C.  plumb (K, 3): up in S as the inclinometer reads it.  heading (K,) in rad.
    sigma (K,) in rad: of the zenith from each frame alone.
    wandering (K, 3, M): change of `plumb` by 1 sigma of each of M errors of the inclinometer that frames share, besides
    its zero.
    """

    to_camera: np.ndarray
    plumb: np.ndarray
    heading: np.ndarray
    sigma: np.ndarray
    wandering: np.ndarray

    @classmethod
    def of(cls, solved: Sequence[FixedFrame], errors: InclinometerErrors) -> "Readings":
        """Readings of frames with a fix."""
        plumb = np.array([a2_matrix(s.tilt.theta_x, s.tilt.theta_y)[2] for s in solved])
        return cls(
            np.array([s.fix.camera_to_itrs.T for s in solved]),
            plumb,
            np.array([s.fix.heading for s in solved]),
            _own_sigma([s.fix for s in solved]),
            _wandering(solved, plumb, errors),
        )

    @property
    def mean_plumb(self) -> np.ndarray:
        """Mean direction (3,) of `plumb`."""
        return rotation.normalised(self.plumb.sum(0))


def _own_sigma(fixes: Sequence[Fix]) -> np.ndarray:
    """Sigma per axis (K,) in rad of each frame's zenith, without the errors that all frames share.

    An error that some frames share (a reading, the same stars) counts as an own error of each of them, enlarged so much
    that together they know the zenith no better than one.
    """
    terms = [[(k, t) for k, t in enumerate(f.terms) if not t.common] for f in fixes]
    frames = Counter((k, key) for own in terms for k, t in own for key in t.shared or ())
    variance = [
        sum(
            np.trace(t.covariance[:2, :2]) / 2 * max((frames[k, key] for key in t.shared or ()), default=1)
            for k, t in own
        )
        for own in terms
    ]
    return np.sqrt(variance) / EARTH_RADIUS_M


def _wandering(solved: Sequence[FixedFrame], plumb: np.ndarray, errors: InclinometerErrors) -> np.ndarray:
    """Change (K, 3, 6) of `plumb` by drift, temperature and scale of each axis, counted from the means of the frames."""
    hours = np.array([s.fix.utc_unix_s for s in solved]) / 3600
    warm = np.array([s.tilt.temperature_c for s in solved])
    theta = np.array([[s.tilt.theta_x, s.tilt.theta_y] for s in solved])
    late = (hours - hours.mean()) / max(np.sqrt(np.ptp(hours)), 1e-9)
    warm = warm - np.mean(warm) if np.isfinite(warm).all() else np.zeros(len(warm))
    known = np.stack([late * errors.drift_rad_per_sqrt_hour, warm * errors.temperature_rad_per_c], -1)
    columns = []
    for axis in range(2):
        for off in (*known.T, (theta[:, axis] - theta[:, axis].mean()) * errors.scale):
            moved = np.zeros_like(plumb)
            moved[:, axis] = np.cos(theta[:, axis])
            moved[:, 2] = -plumb[:, axis] * moved[:, axis] / plumb[:, 2]
            columns.append(moved * off[:, None])
    return np.stack(columns, -1)


@dataclass(frozen=True, kw_only=True)
class PlumbLine:
    """a3 (3, 3) with covariance (3, 3) in rad2 about S's axes, and the zenith (3,) in ITRS with its sigma in rad.

    cost: half the robust chi-square.  scatter: chi-square per degree of freedom, 1 for frames of one zenith.
    off (K,): distance of each frame from the zenith, in its own sigma.
    astray (rad): sigma by which the zenith may be off together with A3's turn about a leaning axis; no heading tells it.
    """

    a3: np.ndarray
    covariance: np.ndarray
    zenith: np.ndarray
    zenith_sigma: float
    cost: float
    scatter: float
    off: np.ndarray
    astray: float = 0.0

    def stddev_across(self, plumb: np.ndarray) -> float:
        """Sigma in rad of the direction that A3 takes to `plumb` (3,), on the worse of two axes."""
        across = np.linalg.svd(plumb[None])[2][1:]
        return float(np.sqrt(np.linalg.eigvalsh(across @ self.covariance @ across.T)[-1]))


def level(readings: Readings, given: np.ndarray, turn_sigma: float = np.pi) -> PlumbLine:
    """The A3 for which all frames have one zenith, wherever that is; it stays near `given` (3, 3) where nothing tells it.

    turn_sigma: sigma in rad of the turn of `given` about the plumb line.  The readings tell that turn only if the lean
    changes in another way than by a turn about one leaning axis: A3 and the zenith, both turned about such an axis, give
    the same readings.  The zenith is then as uncertain as the lean times the turn.
    Raises FixError if two answers are equally good and further apart than that.
    """
    mean = readings.mean_plumb
    start = _axis_of_turn(readings, given)
    known = _Known(turn_sigma=turn_sigma)
    nearest = _fitted(readings, start, known)
    leans = _leans(readings)
    if nearest.scatter < FOUND_SCATTER and not leans:
        return nearest
    # the prior holds each answer near its own start
    starts = _turns(mean, start) if turn_sigma > NARROW_TURN else [(0.0, start)]
    found = [_fitted(readings, start, known) for _, start in starts]
    best = min(found, key=_cost)
    # a search that began half a turn away may have ended in a wrong minimum
    if not leans:
        return best if best.scatter < FOUND_SCATTER else nearest
    as_good = [f.zenith for f in found if f.cost < best.cost + AS_GOOD]
    apart = max(np.linalg.norm(z - best.zenith) for z in as_good)
    lean = np.arccos(np.clip(readings.plumb @ mean, -1, 1)).max()
    turn = np.sqrt(mean @ best.covariance @ mean)
    astray = lean * min(turn, ANY_TURN)
    if apart > AMBIGUOUS_SIGMA * np.hypot(best.zenith_sigma, astray):
        raise FixError(
            f"the instrument leans by {np.degrees(lean):.2f} deg from one heading to the other, and these headings do "
            "not tell which way its inclinometer faces, or one heading's tilts are off: level it better, or add a frame "
            "with one foot raised by as much or more"
        )
    if nearest.cost < best.cost + AS_GOOD:
        best = nearest
    # leans in other directions may have told the turn
    told = turn < min(turn_sigma / 2, TOLD_TURN)
    return best if told or astray < best.zenith_sigma / 2 else replace(best, astray=astray)


def hang(
    readings: Readings, given: np.ndarray, zenith: np.ndarray, zenith_sigma: float, turn_sigma: float
) -> PlumbLine:
    """A3 for a known zenith (3,) in ITRS with zenith_sigma in rad; it stays near `given` where nothing tells it.

    turn_sigma: sigma in rad of the turn of `given` about the plumb line.
    """
    mean = readings.mean_plumb
    up = np.einsum("kij,j->ki", readings.to_camera, zenith).sum(0)
    start = rotation.shortest_turn(given @ rotation.normalised(up), mean) @ given
    known = _Known(zenith, max(zenith_sigma, 1e-12), turn_sigma)
    starts = _turns(mean, start) if turn_sigma > NARROW_TURN else [(0.0, start)]
    found = [_fitted(readings, start, known, angle) for angle, start in starts]
    best = min(found, key=_cost)
    if found[0].cost < best.cost + AS_GOOD:
        best = found[0]
    return best


@dataclass(frozen=True)
class _Known:
    """Prior knowledge of the fit: the zenith (3,) or None, its sigma, and the sigma of A3's turn, in rad."""

    zenith: np.ndarray | None = None
    zenith_sigma: float = np.inf
    turn_sigma: float = np.pi


def _cost(plumb: PlumbLine) -> float:
    return plumb.cost


def _turns(axis: np.ndarray, start: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """A3s that start from `start` (3, 3) turned about an axis of S, with the angle in rad."""
    angles = [rotation.half_turn(k * 2 * np.pi / TURNS_TRIED) for k in range(TURNS_TRIED)]
    return [(angle, rotation.from_vector(axis * angle) @ start) for angle in angles]


def _leans(readings: Readings) -> bool:
    """Whether the plumb line in S moves with the heading by more than noise and wandering explain."""
    heading, one = readings.heading, np.ones(len(readings.heading))
    still, going = (
        _chi2_without(readings, np.stack(c, -1)) for c in ((one,), (one, np.cos(heading), np.sin(heading)))
    )
    return still - going > LEAN_CHI2


def _chi2_without(readings: Readings, columns: np.ndarray) -> float:
    """Robust chi-square of the plumb line after a fit of columns (K, n) for each axis of S.

    Robust, because one reading that is far off is no lean.
    """
    weight, more = 1 / readings.sigma, readings.wandering.shape[2]
    off = np.append(((readings.plumb - readings.mean_plumb) * weight[:, None]).ravel(), np.zeros(more))
    design = np.hstack([np.kron(columns, np.eye(3)), readings.wandering.reshape(-1, more)])
    design = np.vstack(
        [design * np.repeat(weight, 3)[:, None], np.eye(more, design.shape[1], design.shape[1] - more)]
    )
    pull = np.ones(len(off))
    for _ in range(ROBUST_ROUNDS):
        rest = off - design @ np.linalg.lstsq(design * pull[:, None], off * pull, rcond=1e-9)[0]
        size = np.linalg.norm(rest[: len(rest) - more].reshape(-1, 3), axis=1)
        pull = np.append(np.repeat(_huber(size), 3), np.ones(more))
    return float(_robust(size).sum() + np.sum(rest[len(rest) - more :] ** 2))


def _huber(off: np.ndarray) -> np.ndarray:
    """Square root of Huber's weight of residuals in sigma: beyond a limit they pull no harder."""
    # far from the answer all residuals are large and none is an outlier
    limit = max(ROBUST_SIGMA, 2 * float(np.median(np.abs(off))))
    return np.sqrt(np.minimum(1.0, limit / np.maximum(np.abs(off), 1e-300)))


def _robust(off: np.ndarray) -> np.ndarray:
    """Contribution of each residual (in sigma) to the robust chi-square."""
    size = np.abs(off)
    return np.where(size > ROBUST_SIGMA, ROBUST_SIGMA * (2 * size - ROBUST_SIGMA), size**2)


def _fitted(readings: Readings, start: np.ndarray, known: _Known, turned: float = 0.0) -> PlumbLine:
    """Fit A3, the zenith and the errors of the inclinometer by robust Gauss-Newton.

    start (3, 3): the given A3, `turned` by so many rad about the plumb line.  The residuals are those of the readings
    against the plumb line of the stars, whose error is small beside theirs.  The prior of A3's tilts is UNKNOWN_ARCSEC.
    """
    to_camera, mean = readings.to_camera, readings.mean_plumb
    zenith = known.zenith
    if zenith is None:
        zenith = np.einsum("kji,jl,kl->i", to_camera, start.T, readings.plumb)
    zenith = rotation.normalised(zenith)
    # two axes across the zenith; and in S two across the plumb line and one along it
    across = np.linalg.svd(zenith[None])[2][1:]
    turns = np.vstack([np.linalg.svd(mean[None])[2][1:], mean]).T
    wandering = -np.einsum("kim,ij->kjm", readings.wandering, turns[:, :2])
    more = wandering.shape[2]
    loose = UNKNOWN_ARCSEC[0] * ARCSEC
    prior = 1 / np.array([loose, loose, known.turn_sigma, *[known.zenith_sigma] * 2, *[1.0] * more])
    a3, p = start, np.zeros(5 + more)
    p[2] = turned
    up, best = zenith, np.inf
    for _ in range(MOST_STEPS):
        length = np.linalg.norm(up)
        read = to_camera @ (up / length) @ a3.T
        off = (readings.plumb - read) @ turns[:, :2] + wandering @ p[5:]
        slope = np.concatenate(
            [
                -np.einsum("kij,il->klj", np.cross(turns.T, read[:, None]).swapaxes(1, 2), turns[:, :2]),
                -np.einsum("kij,il->klj", np.einsum("ab,kbc,dc->kad", a3, to_camera, across) / length, turns[:, :2]),
                wandering,
            ],
            2,
        ) / readings.sigma[:, None, None]  # fmt: skip
        off = off / readings.sigma[:, None]
        weight = _huber(off)
        design = np.vstack([(slope * weight[..., None]).reshape(-1, 5 + more), np.diag(prior)])
        cost = float(_robust(off).sum() + np.sum((p * prior) ** 2)) / 2
        # if the headings hardly differ, later steps may lead away again
        if cost < best:
            best, answer = cost, (a3, up, off, design)
        step = -np.linalg.lstsq(design, np.concatenate([(off * weight).ravel(), p * prior]), rcond=None)[0]
        step *= min(1.0, LONGEST_STEP / np.linalg.norm(step[:5]))
        a3, p = rotation.from_vector(turns @ step[:3]) @ a3, p + step
        up = zenith + p[3:5] @ across
        if np.abs(step[:5]).max() < SETTLED_RAD:
            break
    a3, up, off, design = answer
    whole = turns @ np.linalg.inv(design.T @ design)[:3, :3] @ turns.T
    # without the turn about the plumb line, which may be as good as unknown
    told = np.delete(design, 2, 1)
    return PlumbLine(
        a3=a3,
        covariance=(whole + whole.T) / 2,
        zenith=rotation.normalised(up),
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(told.T @ told)[2:4, 2:4])[-1])),
        cost=best,
        scatter=2 * best / max(2 * len(readings.sigma) - 5, 1),
        off=np.hypot(*off.T),
    )


def _axis_of_turn(readings: Readings, given: np.ndarray) -> np.ndarray:
    """The A3 (3, 3) nearest to `given` for which the axis of the turn, seen from C, is the plumb line."""
    mean = readings.mean_plumb
    _, strength, directions = np.linalg.svd(np.mean(readings.to_camera, 0).T)
    # frames of one heading have no axis
    if strength[0] - strength[1] < SAME_AXIS:
        return given
    up = directions[0] * np.sign(directions[0] @ given.T @ mean)
    return rotation.shortest_turn(given @ up, mean) @ given
