# SPDX-License-Identifier: Apache-2.0
"""The inclinometer: its readings, its transfer function, and A2, which takes its frame S into the local level L."""

import warnings
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import InstrumentError, TiltError, TiltRangeError
from starpos.units import ARCSEC

LIMIT_RAD = np.radians(30.0)  # the SCA100T-D01's range, and this product's
SCA100T_OFFSET_V = 2.5  # output at zero tilt with a 5 V supply (paper, section 3.1)
SCA100T_SENSITIVITY_V_PER_G = 4.0  # the -D01 variant
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
SCA100T_NOISE_RAD = np.radians(0.0035)  # of one 10 Hz sample, 1 sigma: the paper's resolution


@dataclass(frozen=True)
class Tilt:
    """Elevation of S's X' and Y' axes above the horizon, averaged over readings.

    theta_x, theta_y  rad
    covariance        (2, 2) rad2 of the average
    utc_unix_s        middle of the readings
    samples           number of readings
    temperature_c     NaN: unknown
    times             Unix times of the readings, if they are known

    TiltError if a value is not finite, TiltRangeError beyond LIMIT_RAD.
    """

    theta_x: float
    theta_y: float
    covariance: np.ndarray
    _: KW_ONLY
    utc_unix_s: float
    samples: int = 1
    temperature_c: float = float("nan")
    times: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", np.asarray(self.covariance, float))
        if not np.isfinite([self.theta_x, self.theta_y, self.utc_unix_s]).all():
            raise TiltError("a tilt reading is not a finite number: check the inclinometer")
        if self.covariance.shape != (2, 2) or not np.isfinite(self.covariance).all():
            raise TiltError("a tilt's covariance must be 2 x 2 finite numbers, rad2")
        if max(abs(self.theta_x), abs(self.theta_y)) > LIMIT_RAD:
            raise TiltRangeError(
                f"tilt ({np.degrees(self.theta_x):.3f}, {np.degrees(self.theta_y):.3f}) deg is beyond +-30 deg, "
                "the inclinometer's range: set the instrument more upright"
            )


@dataclass(frozen=True)
class InclinometerErrors:
    """Errors of an inclinometer, 1 sigma; the default is an SCA100T-D01 with a good converter.

    noise_rad                white noise of one reading
    quantum_rad              step of its readings
    drift_rad_per_sqrt_hour  random walk of its zero
    temperature_rad_per_c    change of its zero with temperature, after compensation
    scale                    relative error of the angle
    """

    noise_rad: float = SCA100T_NOISE_RAD
    quantum_rad: float = np.radians(0.0005)
    drift_rad_per_sqrt_hour: float = 2 * ARCSEC
    temperature_rad_per_c: float = 3 * ARCSEC
    scale: float = 1e-4

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value <= 1:
                raise InstrumentError(
                    f"the inclinometer's {name} is {value:g}: it must be a finite number from 0 to 1"
                )

    def undithered_rad(self, tilt: Tilt) -> float:
        """Error (rad) that rounding leaves in the mean of many readings; noise larger than half a step removes it.

        It is the first harmonic of a quantiser's mean error under Gaussian noise (Widrow and Kollar, Quantization Noise,
        2008).
        """
        if self.quantum_rad == 0:
            return 0.0
        noise2 = np.diag(tilt.covariance).min() * tilt.samples / self.quantum_rad**2
        return float(self.quantum_rad / np.sqrt(12) * np.exp(-2 * np.pi**2 * noise2))

    def steps(self, tilt: Tilt) -> tuple:
        """The quantiser's steps on which the two readings stand; the error of rounding is the same while they stay."""
        if self.quantum_rad == 0:
            return ()
        return ((round(tilt.theta_x / self.quantum_rad), round(tilt.theta_y / self.quantum_rad)),)


EXACT = InclinometerErrors(0.0, 0.0, 0.0, 0.0, 0.0)


def a2_matrix(theta_x: float, theta_y: float) -> np.ndarray:
    """A2 = R2(b) R1(a) of the paper's section 4.2 (3, 3): S into L, from the two elevations in rad.

    b = -theta_x and a = asin(sin theta_y / cos b), so that the third row is up as S sees it.
    """
    b = -theta_x
    s = np.sin(theta_y) / np.cos(b)
    if not abs(s) < 1:
        raise TiltError(
            f"tilts {np.degrees(theta_x):.3f}, {np.degrees(theta_y):.3f} deg cannot hold together"
        )
    a = np.arcsin(s)
    ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    return np.array([[cb, sa * sb, ca * sb], [0.0, ca, -sa], [-sb, sa * cb, ca * cb]])


def sca100t_angle(
    volts: ArrayLike,
    offset_v: float = SCA100T_OFFSET_V,
    sensitivity_v_per_g: float = SCA100T_SENSITIVITY_V_PER_G,
) -> np.ndarray:
    """Angle in rad from the SCA100T's output: asin((V - offset) / sensitivity); NaN beyond +-1 g (paper, section 3.1)."""
    g = (np.asarray(volts, float) - offset_v) / sensitivity_v_per_g
    return np.arcsin(np.where(np.abs(g) <= 1, g, np.nan))


def sca100t_volts(
    angle: ArrayLike,
    offset_v: float = SCA100T_OFFSET_V,
    sensitivity_v_per_g: float = SCA100T_SENSITIVITY_V_PER_G,
) -> np.ndarray:
    """The inverse of `sca100t_angle`: output voltage at an angle in rad."""
    return offset_v + sensitivity_v_per_g * np.sin(angle)


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
        steps = steps[np.isfinite(steps).all(1)]
        if len(steps) < ENOUGH_NEIGHBOURS:
            return 1.0
        stated = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2).mean() / 2)
        found = float(white_noise(steps).max() / stated)
        return found if found > 1 + SIGNIFICANT / np.sqrt(len(steps)) else 1.0

    def average(self, mid_unix_s: float, exposure_s: float) -> Tilt:
        """The mean tilt over an exposure, or, if no reading lies in it, the nearest reading within one second.

        Two readings of the same time count once. A reading far from the others is left out. If they scatter more than
        stated (wind, footsteps), the covariance is larger. TiltError if there is no reading or the instrument moved.
        """
        use = self._of_exposure(mid_unix_s, exposure_s)
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

    def _of_exposure(self, mid_unix_s: float, exposure_s: float) -> np.ndarray:
        """Indices of the readings that `average` takes, one for each time."""
        apart = np.abs(self.utc_unix_s - mid_unix_s)
        finite = np.isfinite(self.theta_x) & np.isfinite(self.theta_y)
        half = max(exposure_s, 0.0) / 2 + 1e-6
        use = finite & (apart <= half)
        if not use.any():
            nearest = apart[finite].min() if finite.any() else np.inf
            if not nearest <= half + 1.0:
                raise TiltError(
                    f"no tilt reading within {half + 1:.2f} s of the middle of the exposure "
                    f"(nearest {nearest:.1f} s off): check the clocks and the inclinometer"
                )
            use = finite & (apart <= nearest + 1e-6)
        index = np.flatnonzero(use)
        return index[np.unique(self.utc_unix_s[index], return_index=True)[1]]


def read_tilt_csv(path: Path | str, noise_rad: float = SCA100T_NOISE_RAD) -> TiltLog:
    """Read a TiltLog from CSV columns utc_unix_s, theta_x_deg, theta_y_deg[, temperature_c]; TiltError if impossible."""
    path = Path(path)
    cure = "give a CSV with a line of names, utc_unix_s,theta_x_deg,theta_y_deg[,temperature_c], and readings"
    try:
        if path.stat().st_size > MAX_CSV_BYTES:
            raise ValueError(f"it is larger than {MAX_CSV_BYTES // 10**6} MB")
        with path.open(encoding="utf-8-sig") as f, warnings.catch_warnings():
            # our own error says that a file is empty
            warnings.simplefilter("ignore")
            names = [name.strip() for name in f.readline().lstrip("# ").split(",")]
            rows = np.loadtxt(f, delimiter=",", ndmin=2)
    except FileNotFoundError:
        raise TiltError(f"{path}: there is no such file: {cure}") from None
    except (OSError, ValueError, UnicodeDecodeError) as e:
        raise TiltError(f"{path}: not a readable table of tilts ({_first_line(e)}): {cure}") from None
    need = ("utc_unix_s", "theta_x_deg", "theta_y_deg")
    if not set(need) <= set(names) or rows.shape[0] == 0 or rows.shape[1] != len(set(names)):
        raise TiltError(
            f"{path}: a tilt table needs the columns {', '.join(need)} and at least one row: {cure}"
        )
    column = dict(zip(names, rows.T, strict=True))
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


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
