# SPDX-License-Identifier: Apache-2.0
"""The plumb line in the camera: A3 from the attitudes of frames and their tilts, with a known or an unknown zenith.

The stars of each frame give the attitude R of the camera against the Earth without A3.  The zenith is a fixed direction
of the Earth, z = R^T A3^T s, where s is the plumb line as the inclinometer reads it.  With a wrong A3 the z of several
headings lie on a circle; with the right one they agree.  Only the sum of A3's tilts and the inclinometer's zero matters.
"""

from dataclasses import dataclass, replace

import numpy as np

from starpos import rotation
from starpos.averaging.scatter import Frames, Scatter, scatter_of
from starpos.calibration.readings import KNOWN, Readings
from starpos.errors import FixError
from starpos.instrument.instrument import UNKNOWN_ARCSEC
from starpos.normal import MEDIAN_OF_CHI2
from starpos.units import ARCSEC

# a frame further off than this pulls no harder
ROBUST_SIGMA, ROBUST_ROUNDS = 3.0, 10
TURNS_TRIED = 8
# fewer poses tell no response of the inclinometer
FEWEST_POSES = 3
# chi-square per degree of freedom above which the search ended in a wrong minimum
FOUND_SCATTER = 16.0
# chi-square per degree of freedom above which the poses scatter
USUAL_SCATTER = 4.0
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
class Linear:
    """A fit about its answer: p holds A3's turns (3) about `turns`, the zenith's moves (2) along `across`, and the
    columns.

    residual (K, 2) in rad with p = 0 for the columns, design (K, 2, n): its derivatives.  prior_sigma (n,).
    turns (3, 3): axes in S, two across the plumb line and it.  across (2, 3): axes in ITRS, across the zenith.
    """

    residual: np.ndarray
    design: np.ndarray
    prior_sigma: np.ndarray
    turns: np.ndarray
    across: np.ndarray


@dataclass(frozen=True, kw_only=True)
class PlumbLine:
    """a3 (3, 3) with covariance (3, 3) in rad2 about S's axes, and the zenith (3,) in ITRS with its sigma in rad.

    cost: half the robust chi-square.  scatter: chi-square per degree of freedom, 1 for frames of one zenith.
    left (K, 2): what the fit leaves of each frame's reading, in rad across the plumb line.
    response (m,), response_covariance (m, m): of the inclinometer's response.
    linear: the fit about its answer.
    astray (rad): sigma by which the zenith may be off together with A3's turn about a leaning axis; no heading tells it.
    """

    a3: np.ndarray
    covariance: np.ndarray
    zenith: np.ndarray
    zenith_sigma: float
    cost: float
    scatter: float
    left: np.ndarray
    response: np.ndarray
    response_covariance: np.ndarray
    linear: "Linear"
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
    if best.scatter > USUAL_SCATTER:
        # whichever way the inclinometer faces, its poses scatter
        readings = replace(readings, pose_sigma=_pose_scatter(best, readings))
        found = [_fitted(readings, start, known) for _, start in starts]
        best, nearest, leans = min(found, key=_cost), found[0], _leans(readings)
    # a search that began half a turn away may have ended in a wrong minimum
    if not leans:
        return best if best.cost < nearest.cost - AS_GOOD else nearest
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


def typical(left: np.ndarray, parameters: int) -> float:
    """Sigma per axis in rad of what a fit of so many parameters leaves (K, 2), by the median: outliers do not count."""
    free = len(left) / max(len(left) - parameters / 2, 0.5)
    return float(np.sqrt(np.median(np.sum(left**2, 1)) / MEDIAN_OF_CHI2 * free))


def _pose_scatter(plumb: PlumbLine, readings: Readings) -> float:
    """Sigma in rad of the error of a pose, by the median of the poses."""
    poses = [readings.pose == k for k in range(readings.pose.max() + 1)]
    left = np.array([np.median(plumb.left[rows], axis=0) for rows in poses])
    own2 = np.median([1 / np.sum(1 / readings.sigma[rows] ** 2) for rows in poses])
    return float(np.sqrt(max(typical(left, 5) ** 2 - own2, readings.pose_sigma**2)))


def settled(plumb: PlumbLine, readings: Readings) -> tuple[PlumbLine, Scatter]:
    """The plumb line as the mean over all sizes of the poses' errors and of the response, and what these are.

    readings: of the frames of the fit.
    """
    linear, prior_sigma = plumb.linear, plumb.linear.prior_sigma.copy()
    # the errors of the tilts would seem to tell A3's turn, unless the instrument really leans from pose to pose
    leans = readings.lean(_pose_scatter(plumb, readings))
    if not leans:
        prior_sigma[2] = KNOWN
    response = np.zeros(len(prior_sigma), bool)
    response[5 + readings.response.start :] = readings.pose.max() + 1 >= FEWEST_POSES
    scatter = scatter_of(
        Frames(
            utc_unix_s=readings.utc_unix_s,
            pose=readings.pose,
            residual=linear.residual,
            design=linear.design,
            sigma=readings.sigma,
            pose_sigma=readings.pose_sigma,
            prior_sigma=prior_sigma,
            response=(np.arange(len(prior_sigma)) >= 5 + readings.response.start)
            & (readings.pose.max() + 1 >= FEWEST_POSES),
        )
    )
    moved, covariance, at = scatter.moved, scatter.covariance, 5 + readings.response.start
    if not leans:
        covariance[2, 2] = linear.prior_sigma[2] ** 2
    # as in the fit, without the turn about the plumb line
    given_turn = covariance[3:5, 3:5] - np.outer(covariance[3:5, 2], covariance[3:5, 2]) / covariance[2, 2]
    a3 = rotation.from_vector(linear.turns @ moved[:3]) @ plumb.a3
    up = rotation.normalised(plumb.zenith + moved[3:5] @ linear.across)
    answer = replace(
        plumb,
        a3=a3,
        covariance=_symmetric(linear.turns @ covariance[:3, :3] @ linear.turns.T),
        zenith=up,
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(given_turn)[-1])),
        response=moved[at:],
        response_covariance=_symmetric(covariance[at:, at:]),
    )
    return answer, scatter


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
    weight, more = 1 / readings.spread, readings.columns.shape[2]
    wandering = (readings.columns * readings.column_sigma).reshape(-1, more)
    off = np.append(((readings.plumb - readings.mean_plumb) * weight[:, None]).ravel(), np.zeros(more))
    design = np.hstack([np.kron(columns, np.eye(3)), wandering])
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
    columns = -np.einsum("kim,ij->kjm", readings.columns, turns[:, :2])
    more, spread = columns.shape[2], readings.spread
    loose = UNKNOWN_ARCSEC[0] * ARCSEC
    prior_sigma = np.array(
        [loose, loose, known.turn_sigma, *[min(known.zenith_sigma, np.pi)] * 2, *readings.column_sigma]
    )
    a3, p = start, np.zeros(5 + more)
    p[2] = turned
    up, best = zenith, np.inf
    for _ in range(MOST_STEPS):
        length = np.linalg.norm(up)
        read = to_camera @ (up / length) @ a3.T
        residual = (readings.plumb - read) @ turns[:, :2]
        slope = np.concatenate(
            [
                -np.einsum("kij,il->klj", np.cross(turns.T, read[:, None]).swapaxes(1, 2), turns[:, :2]),
                -np.einsum("kij,il->klj", np.einsum("ab,kbc,dc->kad", a3, to_camera, across) / length, turns[:, :2]),
                columns,
            ],
            2,
        )  # fmt: skip
        off = (residual + columns @ p[5:]) / spread[:, None]
        weight = _huber(off)
        design = np.vstack(
            [
                (slope / spread[:, None, None] * weight[..., None]).reshape(-1, 5 + more),
                np.diag(1 / prior_sigma),
            ]
        )
        cost = float(_robust(off).sum() + np.sum((p / prior_sigma) ** 2)) / 2
        # if the headings hardly differ, later steps may lead away again
        if cost < best:
            best, answer = cost, (a3, up, residual, slope, design, p)
        # the prior's own units keep the loose and the tight of one size
        scaled = np.concatenate([(off * weight).ravel(), p / prior_sigma])
        step = -prior_sigma * np.linalg.lstsq(design * prior_sigma, scaled, rcond=None)[0]
        step *= LONGEST_STEP / max(float(np.linalg.norm(step[:5])), LONGEST_STEP)
        a3, p = rotation.from_vector(turns @ step[:3]) @ a3, p + step
        up = zenith + p[3:5] @ across
        if np.abs(step[:5]).max() < SETTLED_RAD:
            break
    a3, up, residual, slope, design, p = answer
    scaled = design * prior_sigma
    whole = np.outer(prior_sigma, prior_sigma) * np.linalg.inv(scaled.T @ scaled)
    # without the turn about the plumb line, which may be as good as unknown
    told = np.delete(design, 2, 1)
    response = slice(5 + readings.response.start, 5 + readings.response.stop)
    return PlumbLine(
        a3=a3,
        covariance=_symmetric(turns @ whole[:3, :3] @ turns.T),
        zenith=rotation.normalised(up),
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(told.T @ told)[2:4, 2:4])[-1])),
        cost=best,
        scatter=2 * best / max(2 * len(spread) - 5, 1),
        left=residual + slope[:, :, 5:] @ p[5:],
        response=p[response],
        response_covariance=_symmetric(whole[response, response]),
        linear=Linear(residual, slope, prior_sigma, turns, across),
    )


def _symmetric(covariance: np.ndarray) -> np.ndarray:
    return (covariance + covariance.T) / 2


def _axis_of_turn(readings: Readings, given: np.ndarray) -> np.ndarray:
    """The A3 (3, 3) nearest to `given` for which the axis of the turn, seen from C, is the plumb line."""
    mean = readings.mean_plumb
    _, strength, directions = np.linalg.svd(np.mean(readings.to_camera, 0).T)
    # frames of one heading have no axis
    if strength[0] - strength[1] < SAME_AXIS:
        return given
    # a camera that sees stars looks above the horizon; the given A3 may stand the sensor on its head
    up = directions[0] * np.sign(directions[0][2])
    return rotation.shortest_turn(given @ up, mean) @ given
