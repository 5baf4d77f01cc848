# SPDX-License-Identifier: Apache-2.0
"""The plumb line in the camera: A3 from the attitudes of frames and their tilts, with a known or an unknown zenith."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from starpos import rotation
from starpos.averaging.poses import poses_of
from starpos.averaging.scatter import Frames, Scatter, scatter_of
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.errors import FixError
from starpos.fix.fix import Fix, zenith_variance
from starpos.fix.terms import EACH_POSE
from starpos.frozen import at_once
from starpos.instrument.inclinometer import InclinometerErrors, response_columns, stated_variances
from starpos.instrument.instrument import UNKNOWN_ARCSEC
from starpos.units import ARCSEC, MEDIAN_OF_CHI2

# sigma of a coefficient that is as good as known
KNOWN = 1e-9
# terms that move the zenith, of all frames about alike
OF_PLACE = ("refraction", "shutter", "clock", "time stamp", "ut1", "pole")
# minimum significance of a lean, which errors of the tilts do not reach
LEAN_SIGMA = 5.0


@at_once
@dataclass(frozen=True, kw_only=True)
class Readings:
    """Attitudes and tilts of K frames.

    utc_unix_s (K,).  to_camera (K, 3, 3): ITRS into C.  plumb (K, 3): up in S as the inclinometer reads it.
    sigma (K,) in rad: of the zenith from each frame alone.
    common2 (K,) in rad2: variance of what moves the zenith of all frames about alike.
    pose (K,): number of each frame's pose, from 0.  pose_sigma (rad): of an error that is new at each pose.
    columns (K, 3, M): change of `plumb` for each of M errors of the inclinometer that frames share: its drift and its
    temperature in units of their sigma, then its response.  column_sigma (M,): 1 sigma of these.
    axes: of the inclinometer.
    """

    utc_unix_s: np.ndarray
    to_camera: np.ndarray
    plumb: np.ndarray
    sigma: np.ndarray
    common2: np.ndarray
    pose: np.ndarray
    pose_sigma: float
    columns: np.ndarray
    column_sigma: np.ndarray
    axes: int

    @classmethod
    def of(cls, fixes: Sequence[Fix], errors: InclinometerErrors) -> "Readings":
        """Readings of frames with a fix; FixError if some have two axes and some three."""
        tilts = [f.tilt for f in fixes]
        plumb = np.array([t.up for t in tilts])
        if len({t.axes for t in tilts}) != 1:
            raise FixError("some tilts have two axes and some three: give the tilts of one inclinometer")
        mean = rotation.normalised(plumb.sum(0))
        response = np.array([response_columns(t.theta, t.up, mean) for t in tilts])
        walked = _wandering(fixes, errors)
        variances = stated_variances(errors, tilts[0].axes)
        return cls(
            utc_unix_s=np.array([f.utc_unix_s for f in fixes]),
            to_camera=np.array([f.camera.rotation.T for f in fixes]),
            plumb=plumb,
            sigma=_own_sigma(fixes),
            common2=np.array([zenith_variance(t for t in f.terms if t.name in OF_PLACE) for f in fixes]),
            pose=poses_of(fixes),
            pose_sigma=errors.pose_rad,
            columns=np.concatenate([walked, response], 2),
            column_sigma=np.concatenate([np.ones(walked.shape[2]), np.maximum(np.sqrt(variances), KNOWN)]),
            axes=tilts[0].axes,
        )

    def subset(self, rows: np.ndarray) -> "Readings":
        """The readings of the frames in `rows`."""
        per_frame = ("utc_unix_s", "to_camera", "plumb", "sigma", "common2", "columns")
        pose = np.unique(self.pose[rows], return_inverse=True)[1]
        return replace(self, pose=pose, **{name: getattr(self, name)[rows] for name in per_frame})

    @property
    def mean_plumb(self) -> np.ndarray:
        """Mean direction (3,) of `plumb`."""
        return rotation.normalised(self.plumb.sum(0))

    @property
    def spread(self) -> np.ndarray:
        """Sigma (K,) in rad of frames with the errors of poses, so that all frames of a pose are no better than one."""
        return np.sqrt(self.sigma**2 + np.bincount(self.pose)[self.pose] * self.pose_sigma**2)

    def lean(self, pose_sigma: float) -> bool:
        """Whether the tilt changes from pose to pose by more than errors of that sigma (rad) make it seem to."""
        off = np.linalg.norm(self.plumb - self.mean_plumb, axis=1)
        return bool((off > LEAN_SIGMA * replace(self, pose_sigma=pose_sigma).spread).any())

    @property
    def response(self) -> slice:
        """The columns of the response: those after the drift and the temperature of each axis."""
        return slice(2 * self.axes, self.columns.shape[2])


def _own_sigma(fixes: Sequence[Fix]) -> np.ndarray:
    """Sigma per axis (K,) in rad of each frame's zenith, without the errors of poses and those that all frames share.

    An error that some frames share (a reading, the same stars) counts as an own error of each of them, enlarged so much
    that together they know the zenith no better than one.
    """
    terms = [[(k, t) for k, t in enumerate(f.terms) if not t.common and t.shared != EACH_POSE] for f in fixes]
    frames = Counter((k, key) for own in terms for k, t in own for key in t.shared or ())
    variance = [
        sum(
            np.trace(t.covariance[:2, :2]) / 2 * max((frames[k, key] for key in t.shared or ()), default=1)
            for k, t in own
        )
        for own in terms
    ]
    return np.sqrt(variance) / EARTH_RADIUS_M


def _wandering(fixes: Sequence[Fix], errors: InclinometerErrors) -> np.ndarray:
    """Change (K, 3, 2 axes) of up by drift and temperature of each axis, counted from the means of the frames."""
    hours = np.array([f.utc_unix_s for f in fixes]) / 3600
    warm = np.array([f.tilt.temperature_c for f in fixes])
    late = (hours - hours.mean()) / max(np.sqrt(np.ptp(hours)), 1e-9)
    warm = warm - np.mean(warm) if np.isfinite(warm).all() else np.zeros(len(warm))
    slope = np.array([f.tilt.slope for f in fixes])
    known = late * errors.drift_rad_per_sqrt_hour, warm * errors.temperature_rad_per_c
    return np.concatenate([slope * off[:, None, None] for off in known], 2)


# a frame further off than this pulls no harder
ROBUST_SIGMA = 3.0
MAX_STEPS, LONGEST_STEP = 60, 0.5
# a step that would lower chi-square by less (1e-5 sigma) is the last
SETTLED_CHI2 = 1e-10


@at_once
@dataclass(frozen=True, kw_only=True)
class PlumbLine:
    """a3 (3, 3) with covariance (3, 3) in rad2 about S's axes, and the zenith (3,) in ITRS with its sigma in rad.

    cost: half the robust chi-square.  scatter: chi-square per degree of freedom, 1 for frames of one zenith.
    left (K, 2): residual of each frame's reading, in rad across the plumb line.
    response (m,), response_covariance (m, m): the inclinometer's.
    residual (K, 2) rad, design (K, 2, n), prior_sigma (n,): linear fit about the answer.  Its n parameters are
    A3's turns (3) about `turns`, the zenith's moves (2) along `across`, and the columns, which are 0 in the residual.
    turns (3, 3): axes in S, two across the plumb line and it.  across (2, 3): axes in ITRS, across the zenith.
    astray (rad): sigma by which the zenith may be off together with A3's turn about a leaning axis; no heading shows it.
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
    residual: np.ndarray
    design: np.ndarray
    prior_sigma: np.ndarray
    turns: np.ndarray
    across: np.ndarray
    astray: float = 0.0

    def stddev_across(self, plumb: np.ndarray) -> float:
        """Sigma in rad of the direction that A3 takes to `plumb` (3,), on the worse of two axes."""
        across = np.linalg.svd(plumb[None])[2][1:]
        return float(np.sqrt(np.linalg.eigvalsh(across @ self.covariance @ across.T)[-1]))


def huber(off: np.ndarray) -> np.ndarray:
    """Square root of Huber's weight of residuals (..., K) in sigma: beyond a limit they pull no harder."""
    size = np.abs(off)
    # far from the answer all residuals are large and none is an outlier
    limit = np.maximum(ROBUST_SIGMA, 2 * np.median(size, axis=-1, keepdims=True))
    return np.sqrt(np.minimum(1.0, limit / np.maximum(size, 1e-300)))


def robust(off: np.ndarray) -> np.ndarray:
    """Contribution of each residual (in sigma) to the robust chi-square."""
    size = np.abs(off)
    return np.where(size > ROBUST_SIGMA, ROBUST_SIGMA * (2 * size - ROBUST_SIGMA), size**2)


def symmetric(covariance: np.ndarray) -> np.ndarray:
    """The symmetric part of a covariance (n, n)."""
    return (covariance + covariance.T) / 2


@at_once
@dataclass(frozen=True)
class _State:
    """Where T fits stand: a3 (T, 3, 3), up (T, 3) of any length, p (T, n) as in PlumbLine."""

    a3: np.ndarray
    up: np.ndarray
    p: np.ndarray


def fits(
    readings: Readings,
    starts: np.ndarray,
    turn_sigma: float,
    turned: np.ndarray | float = 0.0,
    zenith: np.ndarray | None = None,
    zenith_sigma: float = np.pi,
) -> list[PlumbLine]:
    """Fit A3, the zenith and the errors of the inclinometer by robust Gauss-Newton, from each of T starts.

    starts (T, 3, 3): the given A3, turned by `turned` (T,) rad about the plumb line; turn_sigma (rad): of that turn.
    zenith (3,): None if nothing is known of it.  The residuals compare the readings with the plumb line of the stars,
    whose error is small compared with theirs.  The prior of A3's tilts is UNKNOWN_ARCSEC.
    """
    to_camera, mean = readings.to_camera, readings.mean_plumb
    if zenith is None:
        zenith = np.einsum("kji,tlj,kl->ti", to_camera, starts, readings.plumb)
    zenith = rotation.normalised(np.broadcast_to(zenith, (len(starts), 3)))
    across = np.linalg.svd(zenith[:, None])[2][:, 1:]
    turns = np.vstack([np.linalg.svd(mean[None])[2][1:], mean]).T
    loose = UNKNOWN_ARCSEC[0] * ARCSEC
    sigma = [loose, loose, turn_sigma, zenith_sigma, zenith_sigma, *readings.column_sigma]
    problem = _Fits(
        readings=readings,
        turns=turns,
        columns=-np.einsum("kim,ij->kjm", readings.columns, turns[:, :2]),
        prior_sigma=np.array(sigma),
        zenith=zenith,
        across=across,
        seen_across=np.einsum("kij,tdj->tdki", to_camera, across),
    )
    p = np.zeros((len(starts), len(sigma)))
    p[:, 2] = turned
    return problem.answers(_State(starts, zenith, p))


@at_once
@dataclass(frozen=True, kw_only=True)
class _Fits:
    """What all starts of a fit share, and what each begins with.

    turns (3, 3): axes in S, two across the plumb line and it.  columns (K, 2, M): as Readings', across the plumb line.
    prior_sigma (n,): of A3's turns (3), the zenith's moves (2) and the columns (M).
    zenith (T, 3), across (T, 2, 3): of each start, in ITRS.  seen_across (T, 2, K, 3): `across` in the camera.
    """

    readings: Readings
    turns: np.ndarray
    columns: np.ndarray
    prior_sigma: np.ndarray
    zenith: np.ndarray
    across: np.ndarray
    seen_across: np.ndarray

    def answers(self, now: _State) -> list[PlumbLine]:
        """The answer from each start."""
        best, answer = np.full(len(now.p), np.inf), now
        for _ in range(MAX_STEPS):
            _, slope, off, cost = self._slopes(now)
            # if the headings hardly differ, later steps may lead away again
            better = cost < best
            best = np.where(better, cost, best)
            answer = _State(
                *(
                    np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b)
                    for a, b in ((now.a3, answer.a3), (now.up, answer.up), (now.p, answer.p))
                )
            )
            now, gain = self._stepped(now, slope, off)
            if (gain < SETTLED_CHI2).all():
                break
        residual, slope, off, cost = self._slopes(answer)
        scaled = self._design(slope, off)[0]
        return [
            self._plumb_line(answer, t, residual[t], slope[t], scaled[t], float(cost[t]))
            for t in range(len(best))
        ]

    def _slopes(self, now: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """At T states the residuals (T, K, 2) in rad without the columns, their derivatives (T, K, 2, n), the residuals
        with them in sigma, and the costs (T,).
        """
        plumb, flat = self.readings.plumb, self.turns[:, :2]
        count, frames, n = len(now.p), len(plumb), len(self.prior_sigma)
        length = np.linalg.norm(now.up, axis=1)
        seen = np.tensordot(now.up / length[:, None], self.readings.to_camera, (1, 2))
        read = seen @ now.a3.swapaxes(1, 2)
        residual = (plumb - read) @ flat
        slope = np.empty((count, frames, 2, n))
        # a turn about an axis moves the reading by axis x reading
        slope[..., :3] = np.tensordot(read, np.cross(self.turns.T, flat.T[:, None]), (2, 2))
        moved = self.seen_across.reshape(count, 2 * frames, 3) @ (now.a3.swapaxes(1, 2) @ flat)
        slope[..., 3:5] = (
            -moved.reshape(count, 2, frames, 2).transpose(0, 2, 3, 1) / length[:, None, None, None]
        )
        slope[..., 5:] = self.columns
        off = (residual + np.tensordot(now.p[:, 5:], self.columns, (1, 2))) / self.readings.spread[:, None]
        prior = np.sum((now.p / self.prior_sigma) ** 2, axis=1)
        return residual, slope, off, (robust(off).sum((1, 2)) + prior) / 2

    def _design(self, slope: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weighted design (T, 2 K, n) in units of the prior, and weighted residuals (T, 2 K) in sigma."""
        off = off.reshape(len(off), -1)
        weight = huber(off)
        # the prior's own units keep the loose and the tight of one size
        scaled = slope.reshape(*off.shape, -1) * self.prior_sigma
        return scaled * (weight / np.repeat(self.readings.spread, 2))[..., None], off * weight

    def _stepped(self, now: _State, slope: np.ndarray, off: np.ndarray) -> tuple[_State, np.ndarray]:
        """The fits after a step of at most LONGEST_STEP, and by how much a whole one would lower each chi-square."""
        design, weighted = self._design(slope, off)
        transposed = design.swapaxes(1, 2)
        pull = (transposed @ weighted[..., None])[..., 0] + now.p / self.prior_sigma
        normal = transposed @ design + np.eye(design.shape[2])
        moved = np.linalg.solve(normal, pull[..., None])[..., 0]
        step = -self.prior_sigma * moved
        longest = np.linalg.norm(step[:, :5], axis=1, keepdims=True)
        step *= LONGEST_STEP / np.maximum(longest, LONGEST_STEP)
        p = now.p + step
        turned = np.array([rotation.from_vector(self.turns @ s) for s in step[:, :3]])
        up = self.zenith + np.einsum("td,tdi->ti", p[:, 3:5], self.across)
        return _State(turned @ now.a3, up, p), np.sum(moved * pull, axis=1)

    def _plumb_line(
        self, answer: _State, t: int, residual: np.ndarray, slope: np.ndarray, scaled: np.ndarray, cost: float
    ) -> PlumbLine:
        """The answer from start t."""
        readings, turns, prior_sigma, p = self.readings, self.turns, self.prior_sigma, answer.p[t]
        normal = scaled.T @ scaled + np.eye(len(prior_sigma))
        whole = np.outer(prior_sigma, prior_sigma) * np.linalg.inv(normal)
        # without the turn about the plumb line, which may be as good as unknown
        told = np.delete(np.arange(len(prior_sigma)), 2)
        given_turn = np.outer(prior_sigma[told], prior_sigma[told]) * np.linalg.inv(
            normal[np.ix_(told, told)]
        )
        response = slice(5 + readings.response.start, 5 + readings.response.stop)
        return PlumbLine(
            a3=answer.a3[t],
            covariance=symmetric(turns @ whole[:3, :3] @ turns.T),
            zenith=rotation.normalised(answer.up[t]),
            zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(given_turn[2:4, 2:4])[-1])),
            cost=cost,
            scatter=2 * cost / max(2 * len(readings.plumb) - 5, 1),
            left=residual + self.columns @ p[5:],
            response=p[response],
            response_covariance=symmetric(whole[response, response]),
            residual=residual,
            design=slope,
            prior_sigma=prior_sigma,
            turns=turns,
            across=self.across[t],
        )


TURNS_TRIED = 8
# one pose does not show the inclinometer's response
MIN_POSES = 2
# chi-square per degree of freedom above which the poses scatter
USUAL_SCATTER = 4.0
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
    # the prior holds each answer near its own start
    starts = _turns(mean, start)[1] if turn_sigma > NARROW_TURN else start[None]
    found = fits(readings, starts, turn_sigma)
    best = min(found, key=attrgetter("cost"))
    if best.scatter > USUAL_SCATTER:
        # whichever way the inclinometer faces, its poses scatter
        readings = replace(readings, pose_sigma=_pose_scatter(best, readings))
        found = fits(readings, starts, turn_sigma)
        best = min(found, key=attrgetter("cost"))
    # a search that began half a turn away may have ended in a wrong minimum
    nearest = found[0] if found[0].cost < best.cost + AS_GOOD else best
    if not readings.lean(_pose_scatter(nearest, readings)):
        return nearest
    as_good = [f.zenith for f in found if f.cost < best.cost + AS_GOOD]
    apart = max(np.linalg.norm(z - best.zenith) for z in as_good)
    lean = np.arccos(np.clip(readings.plumb @ mean, -1, 1)).max()
    turn = np.sqrt(mean @ best.covariance @ mean)
    astray = lean * min(turn, ANY_TURN)
    if apart > AMBIGUOUS_SIGMA * np.hypot(best.zenith_sigma, astray):
        raise FixError(
            f"the instrument leans by {np.degrees(lean):.2f} deg from one heading to the other, and these "
            f"headings do not determine which way its inclinometer faces, or one heading's tilts are off: "
            f"leave out a frame whose tilt is wrong, level it better, or add a frame "
            "with one foot raised by as much or more"
        )
    # leans in other directions may have shown the turn
    told = turn < min(turn_sigma / 2, TOLD_TURN)
    return nearest if told or astray < nearest.zenith_sigma / 2 else replace(nearest, astray=astray)


def hang(
    readings: Readings, given: np.ndarray, zenith: np.ndarray, zenith_sigma: float, turn_sigma: float
) -> PlumbLine:
    """A3 for a known zenith (3,) in ITRS with zenith_sigma in rad; it stays near `given` where undetermined.

    turn_sigma: sigma in rad of the turn of `given` about the plumb line.
    """
    mean = readings.mean_plumb
    up = np.einsum("kij,j->ki", readings.to_camera, zenith).sum(0)
    start = rotation.shortest_turn(given @ rotation.normalised(up), mean) @ given
    angles, starts = _turns(mean, start) if turn_sigma > NARROW_TURN else (np.zeros(1), start[None])
    found = fits(readings, starts, turn_sigma, angles, zenith, min(max(zenith_sigma, 1e-12), np.pi))
    best = min(found, key=attrgetter("cost"))
    return found[0] if found[0].cost < best.cost + AS_GOOD else best


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
    prior_sigma = plumb.prior_sigma.copy()
    # the errors of the tilts would seem to show A3's turn, unless the instrument really leans from pose to pose
    leans = readings.lean(_pose_scatter(plumb, readings))
    if not leans:
        prior_sigma[2] = KNOWN
    scatter = scatter_of(
        Frames(
            utc_unix_s=readings.utc_unix_s,
            pose=readings.pose,
            attitude=readings.to_camera,
            # by the stars: the readings' own errors would seem to follow from the lean that they show
            up=readings.to_camera @ plumb.zenith,
            residual=plumb.residual,
            design=plumb.design,
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
        covariance[2, 2] = plumb.prior_sigma[2] ** 2
    # as in the fit, without the turn about the plumb line
    given_turn = covariance[3:5, 3:5] - np.outer(covariance[3:5, 2], covariance[3:5, 2]) / covariance[2, 2]
    a3 = rotation.from_vector(plumb.turns @ moved[:3]) @ plumb.a3
    up = rotation.normalised(plumb.zenith + moved[3:5] @ plumb.across)
    answer = replace(
        plumb,
        a3=a3,
        covariance=symmetric(plumb.turns @ covariance[:3, :3] @ plumb.turns.T),
        zenith=up,
        zenith_sigma=float(np.sqrt(np.linalg.eigvalsh(given_turn)[-1])),
        response=moved[at:],
        response_covariance=symmetric(covariance[at:, at:]),
    )
    return answer, scatter


def _turns(axis: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles (T,) in rad about an axis of S, and A3s (T, 3, 3) that start from `start` (3, 3) turned by each."""
    angles = np.array([rotation.half_turn(k * 2 * np.pi / TURNS_TRIED) for k in range(TURNS_TRIED)])
    return angles, np.array([rotation.from_vector(axis * angle) for angle in angles]) @ start


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
