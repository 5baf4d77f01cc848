# SPDX-License-Identifier: Apache-2.0
"""A log of tilt readings: the tilt of an exposure from it, and the table on disk that holds it."""

import io
import itertools
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TextIO

import numpy as np

from starpos.errors import TiltError
from starpos.files import open_regular
from starpos.instrument.inclinometer import SCA100T_NOISE_RAD, Tilt

# The noise is measured from readings that are so close in time, if there are so many.
NEIGHBOURS_S, ENOUGH_NEIGHBOURS = 1.0, 20
# Readings more than so many sigma away are left out; an instrument whose readings scatter so much more than their noise
# is not at rest.
OUTLIER_SIGMA, REST = 6.0, 6.0
SIGMA_PER_MAD = 1.4826
# The noise comes from the smallest 80 % of a Gaussian's deviations, which have this variance.
KEPT, KEPT_VARIANCE = 0.8, 0.4377
# Over sqrt(steps) it is three times the relative error of `white_noise`.
SIGNIFICANT = 4.0
# A week at 10 Hz.
MAX_CSV_BYTES = 300_000_000
# by how much a reading may miss the exposure's edge: rounding
TOUCH_S = 1e-6
# two readings that are further apart do not bracket an exposure
BRACKET_S = 1.5
AGREE_SIGMA = 5.0
# readings that come at their usual rate may leave out one of them
USUAL_GAPS = 2.5


def white_noise(steps: np.ndarray) -> np.ndarray:
    """1 sigma (K,) of the white noise of readings, from their differences from one to the next, steps (N, K), N > 0.

    A fifth of the differences may be outliers of any size. Readings that are all equal give 0.
    """
    # the largest are left out; a median would jump between the steps of coarse readings
    size = np.sort(np.abs(steps), axis=0)[: int(np.ceil(KEPT * len(steps)))]
    return np.sqrt((size**2).mean(0) / KEPT_VARIANCE / 2)


@dataclass(frozen=True)
class TiltLog:
    """N readings: utc_unix_s (N,), theta_x, theta_y (N,) rad, temperature_c (N,), covariance (N, 2, 2) rad2 of each."""

    utc_unix_s: np.ndarray
    theta_x: np.ndarray
    theta_y: np.ndarray
    temperature_c: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(
        cls,
        utc_unix_s: np.ndarray,
        theta_x: np.ndarray,
        theta_y: np.ndarray,
        temperature_c: np.ndarray,
        noise_rad: float = SCA100T_NOISE_RAD,
    ) -> "TiltLog":
        """Make a log of readings (N,) that have the same white noise, 1 sigma."""
        return cls(
            utc_unix_s,
            theta_x,
            theta_y,
            temperature_c,
            np.tile(np.eye(2) * noise_rad**2, (len(utc_unix_s), 1, 1)),
        )

    @classmethod
    def of_readings(cls, readings: Sequence[Tilt]) -> "TiltLog":
        """Make a log of readings, each with its own covariance."""
        return cls(
            np.array([r.utc_unix_s for r in readings]),
            np.array([r.theta_x for r in readings]),
            np.array([r.theta_y for r in readings]),
            np.array([r.temperature_c for r in readings]),
            np.array([r.covariance for r in readings]),
        )

    @cached_property
    def excess(self) -> float:
        """Noise of the readings, from the differences of neighbours in time, over the stated noise; 1 or more."""
        order = np.argsort(self.utc_unix_s, kind="stable")
        apart = np.diff(self.utc_unix_s[order])
        near = (apart > 0) & (apart < NEIGHBOURS_S)
        if near.sum() < ENOUGH_NEIGHBOURS:
            return 1.0
        steps = np.diff(np.stack([self.theta_x, self.theta_y], -1)[order], axis=0)[near]
        stated = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2).mean() / 2)
        # of an instrument at rest: while it moves, readings differ by more than any noise that is let pass
        steps = steps[(np.abs(steps) < np.sqrt(2) * OUTLIER_SIGMA * REST * stated).all(1)]
        if len(steps) < ENOUGH_NEIGHBOURS:
            return 1.0
        found = float(white_noise(steps).max() / stated)
        return found if found > 1 + SIGNIFICANT / np.sqrt(len(steps)) else 1.0

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """The mean tilt over an exposure, from the readings in it or, for a short one, from two that bracket it closely.

        Two readings of the same time count once. A reading far from the others is left out. If they scatter more than
        stated (wind, footsteps), the covariance is larger. TiltError if the readings do not cover the exposure, or the
        instrument moved.

        spread_s: the whole width in which the middle may lie, where a clock counts in whole seconds; then readings within
        it stand for the exposure, if all of them agree.
        """
        return self._mean(self._of_exposure(mid_unix_s, exposure_s, spread_s))

    def mean(self) -> Tilt:
        """The mean of all readings, of an instrument that is at rest between them too; TiltError if it moved."""
        return self._mean(np.arange(len(self.utc_unix_s)))

    def _mean(self, use: np.ndarray) -> Tilt:
        """The mean tilt of the readings `use` (indices)."""
        theta = np.stack([self.theta_x[use], self.theta_y[use]], -1)
        noise = self.excess * np.sqrt(np.trace(self.covariance[use], axis1=1, axis2=2).mean() / 2)
        from_middle = np.abs(theta - np.median(theta, axis=0))
        spread = np.maximum(noise, SIGMA_PER_MAD * np.median(from_middle, axis=0))
        if spread.max() > REST * noise:
            raise TiltError(
                f"the tilt moved by {np.degrees(np.ptp(theta, axis=0).max()):.3f} deg during the exposure: "
                "the instrument was not at rest"
            )
        sane = (from_middle <= OUTLIER_SIGMA * spread).all(1)
        theta, use = theta[sane], use[sane]
        n = len(use)
        covariance = self.covariance[use].mean(0) * self.excess**2
        # the scatter of a few readings is uncertain: it counts only if it clearly exceeds the noise
        if n > 1:
            scatter = theta.var(0, ddof=1) / np.diag(covariance)
            widen = np.sqrt(np.where(scatter > 1 + 2 * np.sqrt(2 / (n - 1)), scatter * (1 + 2 / n), 1.0))
            covariance = covariance * np.outer(widen, widen)
        theta_x, theta_y = theta.mean(0).tolist()
        return Tilt(
            theta_x,
            theta_y,
            covariance / n,
            utc_unix_s=float(self.utc_unix_s[use].mean()),
            samples=n,
            temperature_c=float(self.temperature_c[use].mean()),
            times=tuple(self.utc_unix_s[use].tolist()),
        )

    def _of_exposure(self, mid_unix_s: float, exposure_s: float, spread_s: float) -> np.ndarray:
        """Indices of the readings that `average` takes, in order of time, one for each time.

        They are those inside the exposure, which must cover it. If none is inside, two do that bracket it closely and
        agree: what happened between two readings that differ nobody knows.
        """
        readings = np.stack([self.utc_unix_s, self.theta_x, self.theta_y])
        index = np.flatnonzero(np.isfinite(readings).all(0))
        index = index[np.unique(self.utc_unix_s[index], return_index=True)[1]]
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
                "rest, or readings were lost"
            )
        first, end = np.searchsorted(t, [mid_unix_s - half - spread_s / 2, mid_unix_s + half + spread_s / 2])
        if spread_s > exposure_s and first < end:
            middle = index[first:end][np.argsort(self.theta_x[index[first:end]])[(end - first) // 2]]
            if all(self._agree(k, middle) for k in index[first:end]):
                return index[first:end]
            raise TiltError(
                f"the tilt changes within the {spread_s:g} s in which the exposure may lie: the instrument was not at "
                "rest"
            )
        nearest = np.abs(t - mid_unix_s).min() if len(t) and np.isfinite(mid_unix_s) else np.inf
        raise TiltError(
            f"no tilt reading in the exposure of {exposure_s:g} s, nor two that bracket it within {BRACKET_S:g} s "
            f"(the nearest is {nearest:.1f} s from its middle): check the clocks and the inclinometer"
        )

    def _check_cover(
        self, index: np.ndarray, first: int, end: int, mid_unix_s: float, exposure_s: float
    ) -> None:
        """TiltError if a part of the exposure is without readings that is longer than half of it, and than is usual."""
        t = self.utc_unix_s[index]
        begin, over = mid_unix_s - exposure_s / 2, mid_unix_s + exposure_s / 2
        most = max(exposure_s / 2, USUAL_GAPS * self.period_s) + TOUCH_S
        # a reading just outside covers an end as well, if it agrees with the one inside
        before = (
            first > 0 and t[first] - t[first - 1] <= BRACKET_S and self._agree(*index[first - 1 : first + 1])
        )
        after = end < len(t) and t[end] - t[end - 1] <= BRACKET_S and self._agree(*index[end - 1 : end + 1])
        gaps = [
            *np.diff(t[first:end]),
            0.0 if before else t[first] - begin,
            0.0 if after else over - t[end - 1],
        ]
        if max(gaps) > most:
            raise TiltError(
                f"the tilt readings leave {max(gaps):.2f} s of the exposure of {exposure_s:g} s uncovered: readings were "
                "lost, check the inclinometer and its link"
            )

    @cached_property
    def period_s(self) -> float:
        """The usual time from one reading to the next; 0 of fewer than three."""
        apart = np.diff(np.unique(self.utc_unix_s[np.isfinite(self.utc_unix_s)]))
        return float(np.median(apart)) if len(apart) > 1 else 0.0

    def _agree(self, a: int, b: int) -> bool:
        """Whether two readings are of one lean, as far as their noise tells."""
        off = np.array([self.theta_x[a] - self.theta_x[b], self.theta_y[a] - self.theta_y[b]])
        variance = np.diag(self.covariance[a] + self.covariance[b]) * self.excess**2
        return bool((off**2 <= AGREE_SIGMA**2 * variance).all())


def read_tilt_csv(path: Path | str, noise_rad: float = SCA100T_NOISE_RAD) -> TiltLog:
    """Read a TiltLog from CSV columns utc_unix_s, theta_x_deg, theta_y_deg[, temperature_c]; TiltError if impossible."""
    path = Path(path)
    cure = "give a CSV with a line of names, utc_unix_s,theta_x_deg,theta_y_deg[,temperature_c], and readings"
    try:
        with _opened(path) as f, warnings.catch_warnings():
            # our own error says that a file is empty
            warnings.simplefilter("ignore")
            names = [name.strip() for name in f.readline().lstrip("# ").split(",")]
            rows = np.loadtxt(f, delimiter=",", ndmin=2)
    except FileNotFoundError:
        raise TiltError(f"{path}: there is no such file: {cure}") from None
    except (OSError, ValueError, UnicodeDecodeError) as e:
        reason = getattr(e, "strerror", None) or _first_line(e)
        raise TiltError(f"{path}: not a readable table of tilts ({reason}): {cure}") from None
    need = ("utc_unix_s", "theta_x_deg", "theta_y_deg")
    if not set(need) <= set(names) or rows.shape[0] == 0 or rows.shape[1] != len(set(names)):
        raise TiltError(
            f"{path}: a tilt table needs the columns {', '.join(need)} and at least one row: {cure}"
        )
    column = dict(zip(names, rows.T, strict=True))
    _check_one_sensor(path, column["utc_unix_s"], rows)
    order = np.argsort(column["utc_unix_s"], kind="stable")
    order = order[np.isfinite(column["utc_unix_s"][order])]
    temperature = column.get("temperature_c", np.full(len(rows), np.nan))
    return TiltLog.of(
        column["utc_unix_s"][order],
        np.radians(column["theta_x_deg"][order]),
        np.radians(column["theta_y_deg"][order]),
        temperature[order],
        noise_rad,
    )


def _opened(path: Path) -> TextIO:
    """The open text of a table; OSError if it cannot be read, ValueError if it is too large."""
    file = open_regular(path)
    if os.fstat(file.fileno()).st_size > MAX_CSV_BYTES:
        file.close()
        raise ValueError(f"it is larger than {MAX_CSV_BYTES // 10**6} MB")
    return io.TextIOWrapper(file, "utf-8-sig")


def _check_one_sensor(path: Path, utc_unix_s: np.ndarray, rows: np.ndarray) -> None:
    """TiltError if the times go back into those that the table already holds: readings of two sensors, it seems.

    A table may hold nights in any order, and a part of itself once more.
    """
    finite = np.isfinite(utc_unix_s)
    _, first = np.unique(rows[finite], axis=0, return_index=True)
    t = utc_unix_s[finite][np.sort(first)]
    runs = np.split(t, np.flatnonzero(np.diff(t) < 0) + 1)
    ranges = sorted((run[0], run[-1]) for run in runs if len(run))
    if any(later < end for (_, end), (later, _) in itertools.pairwise(ranges)):
        raise TiltError(
            f"{path}: its times go back into those that it already holds, as if it had the readings of two "
            "inclinometers: give the table of one"
        )


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
