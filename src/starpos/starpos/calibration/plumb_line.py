# SPDX-License-Identifier: Apache-2.0
"""The plumb line in the camera: A3 from the attitudes of frames and their tilts, with a known or an unknown zenith.

The stars of each frame give the attitude R of the camera against the Earth without A3.  The zenith is a fixed direction
of the Earth, z = R^T A3^T s, where s is the plumb line as the inclinometer reads it.  With a wrong A3 the z of several
headings lie on a circle; with the right one they agree.  Only the sum of A3's tilts and the inclinometer's zero matters.
"""

from dataclasses import replace

import numpy as np

from starpos import rotation
from starpos.averaging.scatter import Frames, Scatter, scatter_of
from starpos.calibration.plumb_fit import Known, PlumbLine, fits, huber, robust, symmetric
from starpos.calibration.readings import KNOWN, Readings
from starpos.errors import FixError
from starpos.normal import MEDIAN_OF_CHI2

ROBUST_ROUNDS = 10
TURNS_TRIED = 8
# one pose does not show the inclinometer's response
MIN_POSES = 2
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
# a zenith whose prior is wider than this is not known
TOLD_ZENITH = 1.0
# if the turn is known better than this, no other turns need be tried
NARROW_TURN = np.radians(20)
# half the chi-square by which a solution may be worse than the best and still be true
AS_GOOD = 8.0
# share of the axis' weight below which the headings do not determine the axis
SAME_AXIS = 1e-9


def level(readings: Readings, given: np.ndarray, turn_sigma: float = np.pi) -> PlumbLine:
    """The A3 for which all frames have one zenith, wherever that is; it stays near `given` (3, 3) where undetermined.

    turn_sigma: sigma in rad of the turn of `given` about the plumb line.  The readings show that turn only if the lean
    changes in another way than by a turn about one leaning axis: A3 and the zenith, both turned about such an axis, give
    the same readings.  The zenith is then as uncertain as the lean times the turn.
    Raises FixError if two answers are equally good and further apart than that.
    """
    mean = readings.mean_plumb
    start = _axis_of_turn(readings, given)
    known = Known(turn_sigma=turn_sigma)
    [nearest] = fits(readings, start[None], known)
    leans = _leans(readings)
    if nearest.scatter < FOUND_SCATTER and not leans:
        return nearest
    # the prior holds each answer near its own start
    starts = _turns(mean, start)[1] if turn_sigma > NARROW_TURN else start[None]
    found = fits(readings, starts, known)
    best = min(found, key=_cost)
    if best.scatter > USUAL_SCATTER:
        # whichever way the inclinometer faces, its poses scatter
        readings = replace(readings, pose_sigma=_pose_scatter(best, readings))
        found = fits(readings, starts, known)
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
            f"the instrument leans by {np.degrees(lean):.2f} deg from one heading to the other, and these "
            f"headings do not determine which way its inclinometer faces, or one heading's tilts are off: "
            f"level it better, or add a frame "
            "with one foot raised by as much or more"
        )
    if nearest.cost < best.cost + AS_GOOD:
        best = nearest
    # leans in other directions may have shown the turn
    told = turn < min(turn_sigma / 2, TOLD_TURN)
    return best if told or astray < best.zenith_sigma / 2 else replace(best, astray=astray)


def hang(
    readings: Readings, given: np.ndarray, zenith: np.ndarray, zenith_sigma: float, turn_sigma: float
) -> PlumbLine:
    """A3 for a known zenith (3,) in ITRS with zenith_sigma in rad; it stays near `given` where undetermined.

    turn_sigma: sigma in rad of the turn of `given` about the plumb line.
    """
    mean = readings.mean_plumb
    up = np.einsum("kij,j->ki", readings.to_camera, zenith).sum(0)
    start = rotation.shortest_turn(given @ rotation.normalised(up), mean) @ given
    known = Known(zenith, max(zenith_sigma, 1e-12), turn_sigma)
    angles, starts = _turns(mean, start) if turn_sigma > NARROW_TURN else (np.zeros(1), start[None])
    found = fits(readings, starts, known, angles)
    best = min(found, key=_cost)
    if found[0].cost < best.cost + AS_GOOD:
        best = found[0]
    return best


def typical(left: np.ndarray, parameters: int) -> float:
    """Sigma per axis in rad of the residuals (K, 2) of a fit, by the median: outliers do not count."""
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
    # the errors of the tilts would seem to show A3's turn, unless the instrument really leans from pose to pose
    leans = readings.lean(_pose_scatter(plumb, readings))
    if not leans:
        prior_sigma[2] = KNOWN
    response = np.zeros(len(prior_sigma), bool)
    response[5 + readings.response.start :] = readings.pose.max() + 1 >= MIN_POSES
    scatter = scatter_of(
        Frames(
            utc_unix_s=readings.utc_unix_s,
            pose=readings.pose,
            attitude=readings.to_camera,
            # by the stars: the readings' own errors would seem to follow from the lean that they show
            up=readings.to_camera @ plumb.zenith,
            residual=linear.residual,
            design=linear.design,
            sigma=readings.sigma,
            pose_sigma=readings.pose_sigma,
            prior_sigma=prior_sigma,
            response=(np.arange(len(prior_sigma)) >= 5 + readings.response.start)
            & (readings.pose.max() + 1 >= MIN_POSES),
            # with an unknown zenith an error of all poses moves that too
            zero_free=bool(prior_sigma[3] < TOLD_ZENITH),
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
        covariance=symmetric(linear.turns @ covariance[:3, :3] @ linear.turns.T),
        zenith=up,
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(given_turn)[-1])),
        response=moved[at:],
        response_covariance=symmetric(covariance[at:, at:]),
    )
    return answer, scatter


def _cost(plumb: PlumbLine) -> float:
    return plumb.cost


def _turns(axis: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (T,) in rad about an axis of S, and A3s (T, 3, 3) that start from `start` (3, 3) turned by each."""
    angles = np.array([rotation.half_turn(k * 2 * np.pi / TURNS_TRIED) for k in range(TURNS_TRIED)])
    return angles, np.array([rotation.from_vector(axis * angle) for angle in angles]) @ start


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
    pull: np.ndarray = np.ones(len(off))
    for _ in range(ROBUST_ROUNDS):
        rest = off - design @ np.linalg.lstsq(design * pull[:, None], off * pull, rcond=1e-9)[0]
        size = np.linalg.norm(rest[: len(rest) - more].reshape(-1, 3), axis=1)
        pull = np.append(np.repeat(huber(size), 3), np.ones(more))
    return float(robust(size).sum() + np.sum(rest[len(rest) - more :] ** 2))


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
