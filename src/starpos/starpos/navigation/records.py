# SPDX-License-Identifier: Apache-2.0
"""Records of a voyage: inertial readings and measured velocities, their tables on disk, and how good an IMU is."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from starpos.errors import InstrumentError, VoyageError, one_line
from starpos.instrument import yaml_file
from starpos.tables import TableForm

# a night of 400 Hz
MAX_BYTES = 1_500_000_000
# Unix times of the years 1973 to 2100
EARLIEST_S, LATEST_S = 9.4e7, 4.1e9


# rows that can be used, in order of time: times (N,), values (N, C), and a sentence for each fault
Rows = tuple[np.ndarray, np.ndarray, tuple[str, ...]]


def _read_record(path: Path | str, form: TableForm) -> Rows:
    """Read the columns that a form needs, utc_unix_s first; VoyageError if they cannot be used."""
    columns = form.read(path).columns
    utc_unix_s, *values = (columns[name] for name in form.needed)
    return in_order(utc_unix_s, np.stack(values, -1), f"{path}")


def in_order(utc_unix_s: np.ndarray, values: np.ndarray, place: str) -> Rows:
    """Keep the rows that can be used; VoyageError if none can.

    Rows that are not all finite numbers are left out, and so are rows whose time does not come after all before them:
    of two readings with one stamp it is unknown which is right.
    """
    faults = []
    sound = np.isfinite(values).all(1) & np.isfinite(utc_unix_s)
    sound &= (utc_unix_s > EARLIEST_S) & (utc_unix_s < LATEST_S)
    if not sound.all():
        faults.append(
            f"{place}: {_rows(~sound)} without a finite number in each cell, or a time of 1973 to 2100: left out"
        )
    t, v = utc_unix_s[sound], values[sound]
    late = t > np.maximum.accumulate(np.concatenate([[-np.inf], t]))[:-1]
    if not late.all():
        faults.append(
            f"{place}: {_rows(~late)} not later than all before: their times go back or are doubled; left out"
        )
    if not late.any():
        raise VoyageError(f"{place}: no row can be used: it needs a time in Unix s and finite numbers")
    return t[late], v[late], tuple(faults)


def _rows(wrong: np.ndarray) -> str:
    number = int(wrong.sum())
    return f"{number} row is" if number == 1 else f"{number} rows are"


IMU_TABLE = TableForm(
    what="table of inertial readings",
    error=VoyageError,
    needed=("utc_unix_s", "gx", "gy", "gz", "ax", "ay", "az"),
    most_bytes=MAX_BYTES,
)
# a reading that comes later than this share of the usual time has one missing before it
GAP = 1.5
# number of readings in a row at a channel's greatest value that count as clipped
CLIPPED = 3
MIN_READINGS = 100


@dataclass(frozen=True, eq=False, kw_only=True)
class ImuLog:
    """N readings in the order of time, each the mean over the time length_s (N,) that ends at utc_unix_s (N,).

    gyro, force (N, 3): turn rate against inertial space in rad/s and specific force in m/s2, along the body's axes, x
    forward, y left, z up.  faults: a sentence for each fault that was found.
    """

    utc_unix_s: np.ndarray
    length_s: np.ndarray
    gyro: np.ndarray
    force: np.ndarray
    faults: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        utc_unix_s: np.ndarray,
        gyro: np.ndarray,
        force: np.ndarray,
        faults: tuple[str, ...] = (),
        place: str = "imu",
    ) -> "ImuLog":
        """Make a log from readings in the order of time; what is clipped becomes a gap.  VoyageError for too few."""
        if len(utc_unix_s) < MIN_READINGS:
            raise VoyageError(
                f"{place}: {len(utc_unix_s)} inertial readings: at least {MIN_READINGS} are needed"
            )
        apart = np.diff(utc_unix_s, prepend=utc_unix_s[0])
        usual = float(np.median(apart[1:]))
        apart[0] = usual
        gaps = apart > GAP * usual
        said = list(faults)
        if gaps.any():
            lost = float((apart[gaps] - usual).sum())
            said.append(
                f"{place}: {int(gaps.sum())} gaps, {lost:.2f} s in all: what happened there is not known"
            )
        full = clipped(np.hstack([gyro, force]))
        if full.any():
            said.append(
                f"{place}: {int(full.sum())} readings are their channel's greatest value, as if saturated: left "
                "out"
            )
        use = ~full
        return cls(
            utc_unix_s=utc_unix_s[use],
            length_s=np.where(gaps, usual, apart)[use],
            gyro=gyro[use],
            force=force[use],
            faults=tuple(said),
        )

    @property
    def vibration(self) -> float:
        """Scatter in m/s of a sum of forces that vibration leaves at its end, from the steps between readings."""
        steps = np.diff(self.force, axis=0)
        return float(np.sqrt(np.mean(steps**2) / 6) * np.median(self.length_s))


def clipped(values: np.ndarray) -> np.ndarray:
    """Mask (N,) of rows in a run of CLIPPED or more at the greatest magnitude that their channel (N, C) ever has."""
    mask = np.zeros(len(values), bool)
    size = np.abs(values)
    at_most = (size == size.max(0)) & (size > 0)
    for column in at_most.T[at_most.sum(0) >= CLIPPED]:
        begin, end = np.flatnonzero(np.diff(np.concatenate([[0], column, [0]]))).reshape(-1, 2).T
        for first, last in zip(begin, end, strict=True):
            # a channel that never changes is another fault
            if CLIPPED <= last - first < len(values) / 2:
                mask[first:last] = True
    return mask


def read_imu(path: Path | str) -> ImuLog:
    """Read a CSV of utc_unix_s, gx, gy, gz (rad/s), ax, ay, az (m/s2); VoyageError says why one cannot be used."""
    t, values, faults = _read_record(path, IMU_TABLE)
    return ImuLog.of(t, values[:, :3], values[:, 3:], faults, f"{path}")


@dataclass(frozen=True, kw_only=True)
class ImuModel:
    """Errors of an IMU, 1 sigma an axis: densities of noise as kalibr names them, and what is constant over a voyage.

    The defaults describe a cheap IMU, for one that is not stated.

    gyroscope_noise_density, accelerometer_noise_density: rad/s/sqrt(Hz), m/s2/sqrt(Hz)
    gyroscope_random_walk, accelerometer_random_walk: of the biases, rad/s2/sqrt(Hz), m/s3/sqrt(Hz)
    gyroscope_bias_stddev, accelerometer_bias_stddev: of the biases at the start, rad/s, m/s2
    scale_stddev: of each channel's scale, a share; axes_stddev: of each axis's direction, rad
    """

    gyroscope_noise_density: float = 2e-4
    accelerometer_noise_density: float = 2e-3
    gyroscope_random_walk: float = 2e-6
    accelerometer_random_walk: float = 5e-5
    gyroscope_bias_stddev: float = 0.02
    accelerometer_bias_stddev: float = 0.3
    scale_stddev: float = 5e-3
    axes_stddev: float = 5e-3

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not 0 < value < MOST[f.name]:
                raise InstrumentError(
                    f"{f.name} of the IMU is {value:g}: it must be above 0 and below {MOST[f.name]:g}, in SI units"
                )


# beyond these it is no instrument, or another unit
MOST = {
    "gyroscope_noise_density": 0.1,
    "accelerometer_noise_density": 1.0,
    "gyroscope_random_walk": 0.01,
    "accelerometer_random_walk": 0.1,
    "gyroscope_bias_stddev": 1.0,
    "accelerometer_bias_stddev": 5.0,
    "scale_stddev": 0.3,
    "axes_stddev": 0.3,
}
NEEDED = tuple(MOST)[:4]


def read_imu_model(path: Path) -> ImuModel:
    """Read kalibr's imu.yaml, with or without the four constants of an ImuModel; InstrumentError says what is wrong."""
    content = yaml_file.load(path, "model of an IMU")
    if not isinstance(content, dict) or not set(NEEDED) <= set(content):
        raise InstrumentError(f"{path}: a model of an IMU needs {', '.join(NEEDED)}, as kalibr writes them")
    values = {}
    for name in MOST:
        if name in content:
            try:
                # YAML takes 5e-06 for a text, which kalibr does not mind
                values[name] = float(content[name])
            except (TypeError, ValueError):
                raise InstrumentError(
                    f"{path}: {name} is {one_line(repr(content[name]))}: give a number"
                ) from None
    try:
        return ImuModel(**values)
    except InstrumentError as error:
        raise InstrumentError(f"{path}: {error}") from None


# In m/s.
FASTEST = 1000.0
# below it a stated error is a mistake; above it nothing is measured
MIN_SIGMA, MAX_SIGMA = 1e-6, 1000.0
VELOCITY_TABLE = TableForm(
    what="table of velocities",
    error=VoyageError,
    needed=("utc_unix_s", "vx", "vy", "vz", "sigma"),
    limits={"sigma": (MIN_SIGMA, MAX_SIGMA)},
    most_bytes=MAX_BYTES,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class VelocityLog:
    """N velocities (N, 3) in m/s along the body's axes, their 1 sigma an axis (N,), at times (N,) in order."""

    utc_unix_s: np.ndarray
    velocity: np.ndarray
    sigma: np.ndarray
    faults: tuple[str, ...] = ()


def read_velocity(path: Path | str) -> VelocityLog:
    """Read a CSV of utc_unix_s, vx, vy, vz, sigma (m/s); VoyageError says why one cannot be used."""
    t, values, faults = _read_record(path, VELOCITY_TABLE)
    velocity, sigma = values[:, :3], values[:, 3]
    if np.abs(velocity).max() > FASTEST:
        raise VoyageError(f"{path}: a velocity is beyond {FASTEST:g} m/s: give m/s along the body's axes")
    return VelocityLog(utc_unix_s=t, velocity=velocity, sigma=sigma, faults=faults)
