# SPDX-License-Identifier: Apache-2.0
"""Readings of an inclinometer: their noise, and the tilt of an exposure from a log of them."""

import itertools
import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from starpos.errors import TiltError
from starpos.frozen import at_once
from starpos.instrument.inclinometer import SCA100T_NOISE_RAD, Tilt
from starpos.units import SIGMA_PER_MAD

# The noise is measured from readings at most NEIGHBOURS_S apart, if there are MIN_NEIGHBOURS of them.
NEIGHBOURS_S, MIN_NEIGHBOURS = 1.0, 20
# Readings further away, in sigma, are left out; an instrument whose readings scatter by a larger multiple of their noise
# is not at rest.
OUTLIER_SIGMA, MAX_SCATTER_SIGMA = 6.0, 6.0
# The noise comes from the smallest 80 % of a Gaussian's deviations, which have this variance.
KEPT, KEPT_VARIANCE = 0.8, 0.4377
# Over sqrt(steps) it is three times the relative error of `white_noise`.
SIGNIFICANT = 4.0
# tolerance for rounding at the exposure's edges
TOUCH_S = 1e-6
# two readings that are further apart do not bracket an exposure
BRACKET_S = 1.5
AGREE_SIGMA = 5.0
# readings that come at their usual rate may leave out one of them
USUAL_GAPS = 2.5
# an end of the exposure longer than this share of it is open if the reading beyond disagrees
OPEN_END = 0.25
# Half of an exposure with a margin for rounded times; number of readings that determine their usual interval.
HALF, MIN_TIMES = 0.6, 5
# Number of equal readings in a row that may show a stuck sensor, as in the node.
STUCK_READINGS = 10
# Steps, deg, in which loggers round.
ROUNDED_DEG = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.025, 0.02, 0.01)
# A value stands on a step if it is this near, in steps: chance brings it there once in 10^5.
ON_STEP = 5e-6
# Steps larger than this many sigma of noise leave an error of rounding. Readings whose noise removes it differ from their
# neighbours by two steps or more in at least this share; a turn goes over more steps.
COARSE_SIGMA, DITHERED, MOST_STEPS = 2.0, 0.03, 5.5
# A quiet sensor goes from one step to the next: minimum number of such moves, and their median over the smallest.
MIN_MOVES, ONE_STEP = 5, 2.5
# Axes that repeat together beyond chance by this many sigma show readings that are published several times, about
# equally often (up to a limit): these quantiles differ by a factor of 2 at most. Minimum number of changes.
TOGETHER_SIGMA, QUARTILES, MOST_COPIES, MIN_CHANGES = 4.0, (0.25, 0.75), 64, 3


def white_noise(steps: np.ndarray) -> np.ndarray:
    """1 sigma (K,) of the white noise of readings, from their differences from one to the next, steps (N, K), N > 0.

    A fifth of the differences may be outliers of any size. Readings that are all equal give 0.
    """
    # the largest are left out; a median would jump between the steps of coarse readings
    size = np.sort(np.abs(steps), axis=0)[: int(np.ceil(KEPT * len(steps)))]
    return np.sqrt((size**2).mean(0) / KEPT_VARIANCE / 2)


def noise_excess(steps: np.ndarray, stated_rad: float) -> float:
    """Noise of readings over the stated one, from their differences (N, axes) from one to the next; 1 or more.

    The readings of a pair are not more than NEIGHBOURS_S apart. Fewer than MIN_NEIGHBOURS pairs give 1.
    """
    # of an instrument at rest: while it moves, readings differ by more than any noise that is let pass
    steps = steps[(np.abs(steps) < np.sqrt(2) * OUTLIER_SIGMA * MAX_SCATTER_SIGMA * stated_rad).all(1)]
    if len(steps) < MIN_NEIGHBOURS:
        return 1.0
    found = float(white_noise(steps).max() / stated_rad)
    return found if found > 1 + SIGNIFICANT / np.sqrt(len(steps)) else 1.0


def copies(moves: np.ndarray) -> int:
    """How often each reading is published; 1: once, also where coarse steps repeat by chance.

    moves (M, axes): differences from one to the next. Noise repeats the values of one axis whether the other's repeat or
    not; what publishes faster than the sensor reads repeats all together.
    """
    x, y = moves[:, 0] != 0, moves[:, 1] != 0
    n, by_x, by_y, both = len(moves), int(x.sum()), int(y.sum()), int((x & y).sum())
    by_chance = by_x * by_y / max(n, 1)
    sigma = math.sqrt(by_chance * (n - by_x) * (n - by_y) / max(n * (n - 1), 1))
    # of a few that agree without exception
    least = min(TOGETHER_SIGMA, 0.99 * math.sqrt(max(n - 1, 0))) * sigma
    if both < MIN_CHANGES or sigma == 0 or both - by_chance < least:
        return 1
    often = np.diff(np.flatnonzero(np.concatenate([[True], moves.any(1), [True]])))
    seldom, usual = np.quantile(often, QUARTILES, method="lower").tolist()
    return int(usual) if usual <= min(2 * seldom, MOST_COPIES) else 1


def without_copies(moves: np.ndarray) -> np.ndarray:
    """The differences of readings that are published several times, without those between equal ones."""
    return moves[moves.any(1)] if copies(moves) > 1 else moves


def coarse_step(theta: np.ndarray, moves: np.ndarray, repeats: np.ndarray, noise_rad: float) -> float:
    """Step (rad) of readings that are rounded to steps larger than their noise; 0 if they are not.

    It is inf for readings that repeat to the last digit where nothing shows that the sensor lives.

    theta (N, 2): readings, rad.  moves (M, 2): differences of these and earlier ones from one to the next.
    repeats (2,): whether an axis repeats its value in STUCK_READINGS or more.  noise_rad: stated.
    """
    size = np.abs(moves)
    step = _rounding(theta) or max(_step_of_moves(axis) for axis in size.T)
    if step > COARSE_SIGMA * noise_rad:
        several = (size > 1.5 * step) & (size < MOST_STEPS * step)
        if len(size) >= MIN_NEIGHBOURS and several.mean() > DITHERED:
            return 0.0
        return math.inf if repeats.all() and not (moves.any() or np.ptp(theta, axis=0).any()) else step
    for axis in size.T[repeats]:
        moved = axis[axis > 0]
        if len(moved) < MIN_MOVES or np.median(moved) > ONE_STEP * moved.min():
            return math.inf
    return 0.0


def _step_of_moves(size: np.ndarray) -> float:
    """The smallest difference of an axis from one reading to the next, if most are equal; size (M,): of all; else 0."""
    moved = size[size > 0]
    repeating = len(size) >= MIN_NEIGHBOURS and 0 < len(moved) <= len(size) / 2
    return float(moved.min()) if repeating else 0.0


def _rounding(theta: np.ndarray) -> float:
    """The largest step (rad) of ROUNDED_DEG on which all readings (N, 2) in rad stand; 0 if on none, or all are 0."""
    degrees = np.degrees(theta)
    for step in ROUNDED_DEG if degrees.any() else ():
        if (np.abs(np.remainder(degrees / step + 0.5, 1.0) - 0.5) < ON_STEP).all():
            return math.radians(step)
    return 0.0


@at_once
@dataclass(frozen=True)
class TiltLog:
    """N readings of one sensor.

    Attributes
    ----------
    utc_unix_s, temperature_c : (N,)
    theta_x, theta_y : (N,) rad
    covariance : (N, 2, 2) rad2 of each reading's theta_x, theta_y
    theta_z : (N,) rad; None or NaN for a two-axis sensor
    variance_z : (N,) rad2; None or NaN: as for the other two
    earlier_excess, earlier_copies : noise over the stated one, and `copies`, of earlier readings that are not in the log
    either_way : as of a `Tilt`

    Examples
    --------
    >>> log = starpos.read_tilt_csv("night/tilt.csv")
    >>> stars = starpos.read_frame("night/stars_0000.csv")
    >>> log.average(stars.mid_unix_s, stars.exposure_s).samples
    5
    """

    utc_unix_s: np.ndarray
    theta_x: np.ndarray
    theta_y: np.ndarray
    _: KW_ONLY
    temperature_c: np.ndarray
    covariance: np.ndarray
    theta_z: np.ndarray | None = None
    variance_z: np.ndarray | None = None
    earlier_excess: float = 1.0
    earlier_copies: int = 1
    either_way: bool = False

    @classmethod
    def of(
        cls,
        utc_unix_s: np.ndarray,
        theta_x: np.ndarray,
        theta_y: np.ndarray,
        temperature_c: np.ndarray,
        noise_rad: float | np.ndarray = SCA100T_NOISE_RAD,
        theta_z: np.ndarray | None = None,
    ) -> "TiltLog":
        """Make a log of readings (N,); noise_rad: 1 sigma of the white noise of all of them, or of each (N,)."""
        variance = np.broadcast_to(np.square(noise_rad), np.shape(utc_unix_s))
        return cls(
            utc_unix_s,
            theta_x,
            theta_y,
            temperature_c=temperature_c,
            covariance=np.eye(2) * variance[:, None, None],
            theta_z=theta_z,
        )

    @classmethod
    def of_readings(cls, readings: Sequence[Tilt], **earlier: Any) -> "TiltLog":
        """Make a log of readings, each with its own covariance; earlier: the fields of that name."""
        names = [f.name for f in fields(cls) if "ndarray" in str(f.type)]
        columns: dict[str, Any] = {name: np.array([getattr(r, name) for r in readings]) for name in names}
        return cls(**columns, **earlier)

    def __repr__(self) -> str:
        return f"<{len(self.utc_unix_s)} readings of an inclinometer>"

    @cached_property
    def theta(self) -> np.ndarray:
        """The elevations (N, axes) in rad; where only some readings have a third axis, it is NaN in the others."""
        if self.theta_z is None or np.isnan(self.theta_z).all():
            return np.stack([self.theta_x, self.theta_y], -1)
        return np.stack([self.theta_x, self.theta_y, self.theta_z], -1)

    @cached_property
    def variance(self) -> np.ndarray:
        """The stated variance (N, axes) in rad2 of each elevation."""
        two = np.diagonal(self.covariance, axis1=1, axis2=2)
        if self.theta.shape[1] == 2:
            return two
        third = np.full(len(two), np.nan) if self.variance_z is None else self.variance_z
        return np.column_stack([two, np.where(np.isnan(third), two.mean(1), third)])

    @cached_property
    def excess(self) -> float:
        """Noise of the readings, from the differences of neighbours in time, over the stated noise; 1 or more."""
        return max(noise_excess(self._moves, float(np.sqrt(self.variance.mean()))), self.earlier_excess)

    @cached_property
    def _moves(self) -> np.ndarray:
        """Differences (M, axes) of neighbours in time."""
        return self._moves_of(self._each)

    def _moves_of(self, order: np.ndarray) -> np.ndarray:
        return np.diff(self.theta[order], axis=0)[np.diff(self.utc_unix_s[order]) < NEIGHBOURS_S]

    def until(self, unix_s: float) -> "TiltLog":
        """The readings up to a time."""
        rows = self.utc_unix_s <= unix_s
        columns = ((f.name, getattr(self, f.name)) for f in fields(self))
        kept: dict[str, Any] = {name: c[rows] for name, c in columns if isinstance(c, np.ndarray)}
        return replace(self, **kept)

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """The mean tilt over an exposure, from the readings in it or, for a short one, from two that bracket it closely.

        Two readings of the same time count once, and so does one that is published several times. A reading far from
        the others is left out; two that follow each other and agree are of a turn. If the readings scatter more than
        stated (wind, footsteps), the covariance is larger.
        Its `step_rad` says whether they are rounded, or repeat without an end.
        TiltError if they do not cover the exposure, or the instrument moved.

        spread_s: the full width within which the middle may lie, for a clock of whole seconds; then readings within it
        represent the exposure, if all of them agree.
        """
        use = self._first(self._of_exposure(mid_unix_s, exposure_s, spread_s))
        repeats = tuple(self._repeats[use].any(0).tolist())
        return replace(self._mean(use, self.step_rad), step_rad=self._steps[repeats])

    def mean(self) -> Tilt:
        """The mean of all readings, of an instrument that is at rest between them too; TiltError if it moved."""
        if not self._finite.all():
            raise TiltError("some tilts have two axes and some three: give the tilts of one inclinometer")
        return self._mean(np.argsort(self.utc_unix_s, kind="stable"))

    @property
    def _finite(self) -> np.ndarray:
        """Mask (N,) of the readings whose time and angles are finite."""
        return np.isfinite(self.utc_unix_s) & np.isfinite(self.theta).all(1)

    @cached_property
    def _once(self) -> np.ndarray:
        """Indices of the finite readings in order of time, one for each time."""
        index = np.flatnonzero(self._finite)
        return index[np.unique(self.utc_unix_s[index], return_index=True)[1]]

    @cached_property
    def _number(self) -> np.ndarray:
        """The number (N,) of the reading of the sensor that each is, if readings are published several times."""
        order = self._once
        number = np.arange(len(order))
        most = max(copies(self._moves_of(order)), self.earlier_copies) + 1
        if most > 2:
            new = np.append(True, np.diff(self.theta[order], axis=0).any(1))
            # a frozen sensor repeats for longer
            number = np.cumsum((number - np.maximum.accumulate(number * new)) % most == 0)
        numbers = np.full(len(self.utc_unix_s), -1)
        numbers[order] = number
        return numbers

    @cached_property
    def _each(self) -> np.ndarray:
        """Indices as `_once`, of the first publication of each reading of the sensor."""
        return self._first(self._once)

    def _first(self, use: np.ndarray) -> np.ndarray:
        """The readings of `use`, in order of time, without the copies of another one there."""
        return use[np.unique(self._number[use], return_index=True)[1]]

    @property
    def step_rad(self) -> float:
        """The step to which all readings are rounded, where it is larger than their noise; 0: finer."""
        return self._steps[False, False]

    @cached_property
    def _steps(self) -> dict[tuple[bool, ...], float]:
        """`coarse_step` of all readings, by whether X' and Y' repeat."""
        noise, theta = float(np.sqrt(self.variance.mean())), self.theta[self._each, :2]
        cases = list(itertools.product((False, True), repeat=2))
        return {case: coarse_step(theta, self._moves[:, :2], np.array(case), noise) for case in cases}

    @cached_property
    def _repeats(self) -> np.ndarray:
        """Mask (N, 2) of the values of X', Y' that stand in a row of STUCK_READINGS or more equal ones."""
        repeats = np.zeros((len(self.utc_unix_s), 2), bool)
        for axis, equal in enumerate((np.diff(self.theta[self._each, :2], axis=0) == 0).T):
            for first, last in zip(*_runs(equal), strict=True):
                repeats[self._each[first : last + 1], axis] = last - first >= STUCK_READINGS - 1
        return self._of_copies(repeats)

    def _of_copies(self, of_each: np.ndarray) -> np.ndarray:
        """What (N, ...) is known of the readings of the sensor, for all their copies."""
        whole, found = np.zeros_like(of_each), self._number >= 0
        whole[found] = of_each[self._each][np.unique(self._number[found], return_inverse=True)[1]]
        return whole

    def _mean(self, use: np.ndarray, step_rad: float = 0.0) -> Tilt:
        """The mean tilt of the readings `use` (indices, in order of time), rounded to a step."""
        theta = self.theta[use]
        # rounded readings may go from one step to the next
        noise = np.hypot(self.excess * np.sqrt(self.variance[use].mean()), step_rad / math.sqrt(12))
        from_middle = np.abs(theta - np.median(theta, axis=0))
        spread = np.maximum(noise, SIGMA_PER_MAD * np.median(from_middle, axis=0))
        sane = (from_middle <= OUTLIER_SIGMA * spread).all(1)
        wild = np.flatnonzero(~sane)
        # wild readings differ from each other; neighbours that agree are of another lean
        turned = any(self._agree(use[k], use[k + 1]) for k in wild[:-1] if not sane[k + 1])
        turned = turned or any(self._agree(a, b) for a, b in self._edges(use) if not sane[use == a].all())
        if turned or spread.max() > MAX_SCATTER_SIGMA * noise:
            # impossible angles, as in another unit, scatter as well
            _check_possible(theta[from_middle.max(1).argmin()])
            raise TiltError(
                f"the tilt moved by {np.degrees(np.ptp(theta, axis=0).max()):.3f} deg during the exposure: "
                "the instrument was not at rest, or its inclinometer has more noise than the "
                f"{np.degrees(noise):.2g} deg that are stated"
            )
        theta, use = theta[sane], use[sane]
        n = len(use)
        variance = self.variance[use].mean(0) * self.excess**2
        covariance = self.covariance[use].mean(0) * self.excess**2
        # the scatter of a few readings is uncertain: it counts only if it clearly exceeds the noise
        if n > 1:
            scatter = theta.var(0, ddof=1) / variance
            widen = np.sqrt(np.where(scatter > 1 + 2 * np.sqrt(2 / (n - 1)), scatter * (1 + 2 / n), 1.0))
            variance = variance * widen**2
            covariance = covariance * np.outer(widen[:2], widen[:2])
        theta_x, theta_y, *third = theta.mean(0).tolist()
        return Tilt(
            theta_x,
            theta_y,
            covariance / n,
            theta_z=third[0] if third else np.nan,
            variance_z=float(variance[2]) / n if third else np.nan,
            utc_unix_s=float(self.utc_unix_s[use].mean()),
            samples=n,
            temperature_c=mean_known(self.temperature_c[use]),
            times=tuple(self.utc_unix_s[use].tolist()),
            either_way=self.either_way,
        )

    def _edges(self, use: np.ndarray) -> Iterator[tuple[int, int]]:
        """The first and the last reading of `use`, each with the one beyond it, where that is near in time."""
        order = self._once
        for edge, step in ((use[0], -1), (use[-1], 1)):
            for k in np.flatnonzero(order == edge) + step:
                near = (
                    0 <= k < len(order)
                    and abs(self.utc_unix_s[order[k]] - self.utc_unix_s[edge]) <= BRACKET_S
                )
                if near:
                    yield int(edge), int(order[k])

    def _of_exposure(self, mid_unix_s: float, exposure_s: float, spread_s: float) -> np.ndarray:
        """Indices of the readings that `average` takes, in order of time, one for each time.

        They are those inside the exposure, which must cover it. If none is inside, two are taken that bracket it closely
        and agree: between two readings that differ the tilt is unknown.
        """
        index = self._once
        t, half = self.utc_unix_s[index], max(exposure_s, 0.0) / 2 + TOUCH_S
        first, end = np.searchsorted(t, [mid_unix_s - half, mid_unix_s + half])
        if first < end:
            self._check_cover(index, first, end, mid_unix_s, exposure_s)
            return index[first:end]
        if 0 < first < len(t) and t[first] - t[first - 1] <= BRACKET_S:
            pair = index[first - 1 : first + 1]
            if self._agree(*pair):
                return pair
            raise TiltError(
                "the tilt differs before and after the exposure, and no reading lies in it: the instrument was not at "
                "rest, readings were lost, or their noise is larger than stated"
            )
        first, end = np.searchsorted(t, [mid_unix_s - half - spread_s / 2, mid_unix_s + half + spread_s / 2])
        if spread_s > exposure_s and first < end:
            middle = index[first:end][np.argsort(self.theta_x[index[first:end]])[(end - first) // 2]]
            if all(self._agree(k, middle) for k in index[first:end]):
                return index[first:end]
            raise TiltError(
                f"the tilt changes within the {spread_s:g} s in which the exposure may lie: the instrument was not at "
                "rest, or its inclinometer's noise is larger than stated"
            )
        nearest = np.abs(t - mid_unix_s).min() if len(t) and np.isfinite(mid_unix_s) else np.inf
        raise TiltError(
            f"no tilt reading in the exposure of {exposure_s:g} s, nor two that bracket it within {BRACKET_S:g} s "
            f"(the nearest is {nearest:.1f} s from its middle): check the clocks and the inclinometer"
        )

    def _check_cover(
        self, index: np.ndarray, first: int, end: int, mid_unix_s: float, exposure_s: float
    ) -> None:
        """TiltError if no readings show whether the instrument was at rest in a part of the exposure.

        Such a part lies between two readings and is longer than half of the exposure, and than is usual; or it is an end
        of the exposure. An end may be HALF of it where no reading is near beyond, and any where readings are that rare,
        one a frame perhaps. It may be OPEN_END of it where the one beyond disagrees: it is unknown when the turn began.
        """
        t = self.utc_unix_s[index]
        begin, over = mid_unix_s - exposure_s / 2, mid_unix_s + exposure_s / 2
        usual_s = USUAL_GAPS * self.period_s
        rare = len(t) >= MIN_TIMES and self.period_s > BRACKET_S
        gaps = [(float(gap), max(exposure_s / 2, usual_s)) for gap in np.diff(t[first:end])]
        for gap, one in ((t[first] - begin, first - 1), (over - t[end - 1], end - 1)):
            if not (0 <= one < len(t) - 1 and t[one + 1] - t[one] <= BRACKET_S):
                gaps.append((gap, max(HALF * exposure_s, usual_s if rare else 0.0)))
            elif not self._agree(index[one], index[one + 1]):
                gaps.append((gap, OPEN_END * exposure_s))
        open_s = [gap for gap, most in gaps if gap > most + TOUCH_S]
        if open_s:
            raise TiltError(
                f"the tilt readings leave {max(open_s):.2f} s of the exposure of {exposure_s:g} s uncovered: readings "
                "were lost, or the instrument moved: check the inclinometer and its link"
            )

    @cached_property
    def period_s(self) -> float:
        """The usual time from one reading to the next; 0 for fewer than three."""
        apart = np.diff(np.unique(self.utc_unix_s[np.isfinite(self.utc_unix_s)]))
        return float(np.median(apart)) if len(apart) > 1 else 0.0

    def _agree(self, a: int, b: int) -> bool:
        """Whether two readings are of one lean within their noise."""
        variance = (self.variance[a] + self.variance[b]) * self.excess**2
        return bool(((self.theta[a] - self.theta[b]) ** 2 <= AGREE_SIGMA**2 * variance).all())


def _runs(mask: np.ndarray) -> np.ndarray:
    """Begin and end (2, R) of the runs in which a mask (N,) holds; each ends before its end."""
    return np.flatnonzero(np.diff(np.concatenate([[0], mask, [0]]))).reshape(-1, 2).T


def mean_known(celsius: np.ndarray) -> float:
    """Mean of the temperatures (N,) that are known; NaN without one."""
    known = celsius[np.isfinite(celsius)]
    return float(known.mean()) if len(known) else np.nan


def _check_possible(theta: np.ndarray) -> None:
    """TiltError if elevations (axes,) in rad are impossible."""
    theta_x, theta_y, *third = theta.tolist()
    Tilt(theta_x, theta_y, np.zeros((2, 2)), utc_unix_s=0.0, theta_z=third[0] if third else np.nan)


class Tilts(Protocol):
    """The tilts of a night; a `TiltLog` is one, and so is a `Tilt`, which serves any exposure."""

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Average over an exposure, whose middle may lie spread_s off; raises TiltError."""


@dataclass(frozen=True)
class TiltsByTime:
    """The tilts of exposures by their middles (Unix seconds); why: the reason why other exposures have no tilt."""

    tilts: Mapping[Any, Tilt] = field(default_factory=dict)
    why: str = "no tilt: give the inclinometer's"

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Give the tilt of the exposure with this middle; TiltError without one."""
        if mid_unix_s not in self.tilts:
            raise TiltError(self.why)
        return self.tilts[mid_unix_s]


NO_TILTS = TiltsByTime()


# A sensor of 18 Hz has a memory of 9 ms, so means over this time are independent.
BLOCK_S = 0.1
# Blocks further apart than this differ by drift rather than by noise.
APART_S = 3.0
# Numbers of block differences: the long run gives the estimate, the short one notices that the noise has grown.
LONG_RUN, SHORT_RUN = 200, 30


class NoiseTracker:
    """Estimates the white noise of each axis: `sigma` in rad for one sample, as averages of samples show it.

    Neighbouring samples of a sensor with a limited bandwidth are correlated. So it takes the means over BLOCK_S and the
    differences of successive means, and scales them to the noise of one sample as if samples were independent.
    """

    def __init__(self) -> None:
        self._differences: deque[list[float]] = deque(maxlen=LONG_RUN)
        # of samples, which may be published several times
        self._moves: deque[list[float]] = deque(maxlen=LONG_RUN)
        self.restart()

    def restart(self) -> None:
        """Start again, because the samples are of another kind now, such as another rate."""
        # None: too few samples yet.
        self.sigma: tuple[float, ...] | None = None
        self._copied = False
        self._last: tuple[float, ...] = ()
        self._differences.clear()
        self._moves.clear()
        self.interrupt()

    def interrupt(self) -> None:
        """Begin a new block, because the next sample does not continue the last one."""
        # Begin, number of samples, means.
        self._before: list[float] | None = None
        # Begin, number of samples, sums.
        self._block: list[float] | None = None

    def add_sample(self, time_s: float, *angles: float) -> None:
        """Take a sample (rad, of two axes or three) at `time_s` of a clock that does not step."""
        block, last, self._last = self._block, self._last, angles
        if len(last) == len(angles):
            self._moves.append([a - b for a, b in zip(angles, last, strict=True)])
        if self._copied and last == angles:
            return
        # With the factor, samples that come every 0.1 s are one block each.
        if block is not None and time_s - block[0] < 0.95 * BLOCK_S:
            block[1:] = [block[1] + 1, *(s + angle for s, angle in zip(block[2:], angles, strict=True))]
            return
        if block is not None:
            self._close(block)
        self._block = [time_s, 1, *angles]

    def _close(self, block: list[float]) -> None:
        begin, n, *sums = block
        copied = len(self._moves) >= MIN_NEIGHBOURS and copies(np.array(self._moves)) > 1
        if copied != self._copied:
            # the differences so far are of other numbers of readings
            self._copied, self.sigma = copied, None
            self._differences.clear()
            self.interrupt()
            return
        mean = [begin, n, *(s / n for s in sums)]
        before, self._before = self._before, mean
        if before is None or not 0 < begin - before[0] <= APART_S:
            return
        scale = math.sqrt(2 / (1 / n + 1 / before[1]))
        self._differences.append([scale * (a - b) for a, b in zip(mean[2:], before[2:], strict=True)])
        if len(self._differences) >= MIN_NEIGHBOURS:
            self.sigma = self._estimate()

    def _estimate(self) -> tuple[float, ...]:
        differences = np.array(self._differences)
        long, short = white_noise(differences), white_noise(differences[-SHORT_RUN:])
        grown = short > long * (1 + SIGNIFICANT / math.sqrt(SHORT_RUN))
        return tuple(np.where(grown, short, long).tolist())


def noise_text(sigma: tuple[float, ...] | None) -> str:
    """Write the noise of the axes (1 sigma, rad) in arcsec."""
    if sigma is None:
        return "not known yet"
    return ", ".join(f"{math.degrees(s) * 3600:.2f}" for s in sigma)
