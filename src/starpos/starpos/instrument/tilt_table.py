# SPDX-License-Identifier: Apache-2.0
"""The table of tilt readings on disk, a CSV; and doubt whether its degrees are radians."""

import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from starpos.errors import TiltError
from starpos.instrument import phone_log
from starpos.instrument.inclinometer import MAX_CELSIUS, SCA100T_NOISE_RAD, elevations
from starpos.instrument.tilt_log import BRACKET_S, OUTLIER_SIGMA, TiltLog, white_noise
from starpos.tables import TableForm

ANGLES = ("theta_x_deg", "theta_y_deg", "theta_z_deg")
# the elevations of the sensor's axes, for a week at 10 Hz
TILT_TABLE = TableForm(
    what="table of tilts",
    error=TiltError,
    needed=("utc_unix_s", "theta_x_deg", "theta_y_deg"),
    optional=("theta_z_deg", "temperature_c", "sigma_deg"),
    # 1 sigma, up to which an angle still means anything
    limits={"sigma_deg": (1e-9, 45.0)},
)
# Readings alternate if, of three in a row, the outer two are closer than two neighbours in more than this share. White
# noise has a share of a half, and exceeds it by this many sigma less than once in 10^7 tables.
ALTERNATING, ALTERNATING_SIGMA = 0.75, 6.0
# Readings that leap to another tilt and back within BRACKET_S: minimum size of a leap in sigma of noise and in steps of
# the readings; minimum number of leaps, minimum share of one size, and minimum share of all readings. Beyond these they
# are not outliers. Last: tolerance on one size.
LEAP_SIGMA, LEAP_STEPS, MIN_LEAPS, ONE_SIZE, LEAPING, ALIKE_SIZE = 12.0, 3.0, 5, 0.8, 0.03, 0.1
# a quarter of a Gaussian's deviations are below this many sigma
QUARTER = 0.3186


def read_tilt_csv(path: Path | str, noise_rad: float = SCA100T_NOISE_RAD) -> TiltLog:
    """Read a TiltLog from a CSV, one reading of a sensor a line; or from a telephone's log (`phone_log`).

    Columns: utc_unix_s, theta_x_deg, theta_y_deg; theta_z_deg of a three-axis sensor; temperature_c, unknown (NaN) where
    it is beyond MAX_CELSIUS; sigma_deg, 1 sigma of the white noise of that line's angles. Other columns are ignored.

    Parameters
    ----------
    path : of the CSV
    noise_rad : sigma where no sigma is stated (no column, an empty cell, or NaN)

    Returns
    -------
    TiltLog
        its readings

    Raises
    ------
    TiltError
        the file cannot be one

    Examples
    --------
    >>> starpos.read_tilt_csv("night/tilt.csv").theta_x.shape
    (25,)
    """
    path = Path(path)
    if (log := phone_log.read(path, noise_rad)) is not None:
        _check_digits(path, log.utc_unix_s)
        return log
    table = TILT_TABLE.read(path)
    column = table.columns
    if not np.isfinite([column[name] for name in TILT_TABLE.needed]).all(0).any():
        raise TiltError(
            f"{path}: none of its {len(table.lines)} readings is a number: check the inclinometer and what wrote them"
        )
    _check_digits(path, column["utc_unix_s"])
    _check_degrees(path, column)
    _check_one_sensor(path, column)
    order = np.argsort(column["utc_unix_s"], kind="stable")
    order = order[np.isfinite(column["utc_unix_s"][order])]
    z = table.column("theta_z_deg")
    axes = ["theta_x_deg", "theta_y_deg"] + ([] if np.isnan(z).all() else ["theta_z_deg"])
    theta = elevations(np.radians([column[axis][order] for axis in axes]).T).T
    sigma = np.radians(table.column("sigma_deg"))[order]
    celsius = table.column("temperature_c")[order]
    return TiltLog.of(
        column["utc_unix_s"][order],
        theta[0],
        theta[1],
        np.where(np.abs(celsius) <= MAX_CELSIUS, celsius, np.nan),
        np.where(np.isnan(sigma), noise_rad, sigma),
        theta_z=theta[2] if len(theta) == 3 else None,
    )


FULL_TURN_DEG = 360.0
# Times of these steps, s, are rounded: float32 at today's times, and six digits as %g writes.
# FEWEST_STUCK times that are all the same were cut off elsewhere.
ROUNDED_S, FEWEST_ROUNDED, FEWEST_STUCK = (128.0, 10_000.0), 3, 10


def _check_digits(path: Path, t: np.ndarray) -> None:
    """TiltError if times (N,) were written with too few digits, so that many of them are the same."""
    t = t[np.isfinite(t)]
    different = len(np.unique(t))
    if len(t) < FEWEST_ROUNDED or different == len(t):
        return
    stuck = len(t) >= FEWEST_STUCK and different == 1
    if stuck or any((t % step == 0).all() for step in ROUNDED_S):
        raise TiltError(
            f"{path}: {len(t)} readings have only {different} different times: they were rounded, as by float32 "
            "or %g: write utc_unix_s with its fractions of a second (%.3f, double precision)"
        )


def _check_degrees(path: Path, column: Mapping[str, np.ndarray]) -> None:
    """TiltError if most angles of an axis are beyond a full turn."""
    for name in ANGLES:
        angles = column.get(name, np.zeros(0))
        angles = angles[np.isfinite(angles)]
        if len(angles) and (beyond := float(np.median(np.abs(angles)))) > FULL_TURN_DEG:
            raise TiltError(
                f"{path}: {name} is beyond a full turn ({beyond:g}): degrees and minutes (ddmm.mm), or another unit: "
                "give degrees with a decimal point"
            )


def _check_one_sensor(path: Path, column: Mapping[str, np.ndarray]) -> None:
    """TiltError if the rows seem to be readings of two sensors, one after the other or alternating.

    One after the other, the second sensor's times go back into times that the table already holds. A table may hold
    nights in any order, and repeat a part of itself.
    """
    finite = np.flatnonzero(np.isfinite(column["utc_unix_s"]))
    _, first = np.unique(np.stack(list(column.values()), -1)[finite], axis=0, return_index=True)
    once = finite[np.sort(first)]
    t = column["utc_unix_s"][once]
    runs = np.split(t, np.flatnonzero(np.diff(t) < 0) + 1)
    ranges = sorted((run[0], run[-1]) for run in runs if len(run))
    in_time = once[np.argsort(t, kind="stable")]
    angles = np.stack([column[name] for name in ANGLES if name in column], -1)[in_time]
    if any(later < end for (_, end), (later, _) in itertools.pairwise(ranges)):
        seen = "its times go back into those that it already holds"
    elif _alternate(column["utc_unix_s"][in_time], angles):
        seen = "its readings alternate between two tilts"
    elif any(_leaps(column["utc_unix_s"][in_time], axis) for axis in angles.T):
        seen = "its readings leap to another tilt and back"
    else:
        return
    raise TiltError(f"{path}: {seen}, as if it had the readings of two inclinometers: give the table of one")


def _alternate(t: np.ndarray, angles: np.ndarray) -> bool:
    """Whether readings (N, axes), in the order of their times t (N,), alternate beyond chance on an axis."""
    # threes that share no reading are independent
    start = np.arange(0, len(t) - 2, 3)
    # an instrument may be turned back and forth between readings that are further apart
    start = start[(t[start + 2] - t[start + 1] <= BRACKET_S) & (t[start + 1] - t[start] <= BRACKET_S)]
    with np.errstate(invalid="ignore"):
        near = np.abs(angles[start + 1] - angles[start])
        outer = np.abs(angles[start + 2] - angles[start])
    more, less = (outer < near).sum(0), (outer > near).sum(0)
    told = more + less
    beyond_chance = more - less > ALTERNATING_SIGMA * np.sqrt(told)
    return bool((beyond_chance & (more > ALTERNATING * told)).any())


def _leaps(t: np.ndarray, angle: np.ndarray) -> bool:
    """Whether readings (N,) of an axis, in the order of their times t (N,), leap to another tilt and back time and again.

    So do readings of two sensors of which one is read more often; a mount does not go there and back so quickly.
    """
    known = np.isfinite(angle)
    t, angle = t[known], angle[known]
    step, near = np.diff(angle), np.diff(t) <= BRACKET_S
    if len(step) < MIN_LEAPS:
        return False
    # if readings alternate, every second one is of the same sensor
    apart = [np.quantile(np.abs(angle[lag:] - angle[:-lag]), 0.25) for lag in (1, 2, 3)]
    noise = min(apart) / QUARTER / np.sqrt(2)
    quantum = np.diff(np.unique(angle)).min(initial=np.inf)
    leaps = np.flatnonzero(near & (np.abs(step) > max(LEAP_SIGMA * noise, LEAP_STEPS * quantum)))
    there, back = step[leaps[:-1]], step[leaps[1:]]
    alike = np.maximum(OUTLIER_SIGMA * np.sqrt(2) * noise, ALIKE_SIZE * np.abs(there))
    returns = (np.abs(there + back) <= alike) & (t[leaps[1:]] - t[leaps[:-1] + 1] <= BRACKET_S)
    size = np.abs(there[returns])
    if len(size) < max(MIN_LEAPS, LEAPING * len(step)):
        return False
    return bool(np.mean(np.abs(size - np.median(size)) <= alike[returns]) >= ONE_SIZE)


# The noise of readings in radians that are taken for degrees is 57.3 times too small. Number of differences that
# determine it, and to which factor.
ENOUGH_STEPS, ALIKE_NOISE = 8, 3.0


def like_radians(log: TiltLog) -> str:
    """Say that a table of tilts looks like radians; '' if it does not.

    The noise shows it: radians taken for degrees have 57 times less than the sensor's.
    """
    order = np.argsort(log.utc_unix_s, kind="stable")
    apart = np.diff(log.utc_unix_s[order])
    every = np.diff(log.theta[order, :2], axis=0)
    sound = (apart > 0) & np.isfinite(every).all(1)
    steps = every[sound & (apart < BRACKET_S)]
    if len(steps) < ENOUGH_STEPS:
        # one reading a frame: an instrument that stands differs from frame to frame by its noise alone
        steps = every[sound]
    if len(steps) < ENOUGH_STEPS or np.nanmax(np.abs(np.degrees(log.theta[:, :2]))) > np.pi / 2:
        return ""
    noise = float(np.degrees(white_noise(steps).mean()))
    stated_rad = float(np.sqrt(np.nanmean(log.variance)))
    if not stated_rad / ALIKE_NOISE < noise < stated_rad * ALIKE_NOISE:
        return ""
    return (
        f"the tilts look like radians: none is above pi/2, and their noise of {noise:.2g} would be the "
        f"inclinometer's ({stated_rad:.2g} rad): write them in deg, or state the inclinometer's noise if it "
        f"is so quiet"
    )
