# SPDX-License-Identifier: Apache-2.0
"""The inclinometer: its readings, its transfer function, and A2, which takes its frame S into the local level L."""

from dataclasses import KW_ONLY, dataclass

import numpy as np
from numpy.typing import ArrayLike

from starpos.errors import InstrumentError, TiltError, TiltRangeError
from starpos.units import ARCSEC

LIMIT_RAD = np.radians(30.0)  # the SCA100T-D01's range, and this product's
SCA100T_OFFSET_V = 2.5  # output at zero tilt with a 5 V supply (paper, section 3.1)
SCA100T_SENSITIVITY_V_PER_G = 4.0  # the -D01 variant
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
