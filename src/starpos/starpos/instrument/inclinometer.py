# SPDX-License-Identifier: Apache-2.0
"""The inclinometer: its readings, its errors, its response, and A2, which takes its frame S into the local level L."""

import math
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np

from starpos import rotation
from starpos.errors import InstrumentError, TiltError, TiltRangeError
from starpos.frozen import at_once
from starpos.units import ARCSEC, HOUR_S

# The -D01 variant.
SCA100T_RANGE_RAD = np.radians(30.0)
# Noise of one 10 Hz sample, 1 sigma: the paper's resolution.
SCA100T_NOISE_RAD = np.radians(0.0035)


# The squared sines of three orthogonal axes add up to 1. Scale and cross-axis errors of any sensor change this by less
# than SQUARE, unstated errors (zeros, 0.3 deg of a pose, 3 % of scale) by less than MIN_SQUARE.
SQUARE, MIN_SQUARE = 0.1, 0.06
SQUARE_SIGMA = 5.0
# deviation that the stated errors explain, in sigma
EXPLAINED_SIGMA = 3.0
# Maximum temperature at which an inclinometer measures
MAX_CELSIUS = 300.0
# Temperatures that no sensor measured: 1 sigma of the difference of two, as of a warm room and a clear night.
# Its random walk, by a night's cooling; and of an instrument that has long stood outdoors, by some degrees in hours.
UNMEASURED_JUMP_C = 14.0
UNMEASURED_WALK_C_PER_SQRT_HOUR = UNMEASURED_JUMP_C / math.sqrt(6.0)
OUTDOORS_WALK_C_PER_SQRT_HOUR = 2.0
# a few readings may stand on larger steps than the sensor's by chance, up to this many times as large
BY_CHANCE = 2.5
# said of a telephone's log without its description, where the stars do not show it either
EITHER_WAY = (
    "the telephone's log does not say whether its readings point up or down: give the app's whole zip, with its "
    "Metadata.csv, or state A3 (--misalignment) and point the camera well above the horizon"
)
# sine above which X' counts as vertical: then L's X is taken below Y' instead
STEEP = 0.999


@at_once
@dataclass(frozen=True)
class Tilt:
    """Elevation of S's X', Y' and, of a three-axis sensor, Z' above the horizon, averaged over readings.

    The sensor may lean in any way. TiltError if a value is not finite, or no direction of gravity gives these angles.

    Attributes
    ----------
    theta_x, theta_y : rad
    covariance : (2, 2) rad2 of the average of these two
    utc_unix_s : middle of the readings
    samples : number of readings
    temperature_c : NaN: unknown
    times : Unix times of the readings, if they are known
    theta_z : rad; NaN of a two-axis sensor, whose Z' points upwards
    variance_z : rad2 of theta_z; NaN: as for the other two
    step_rad : step to which the readings are rounded, where it is larger than their noise; 0: finer;
        inf: they repeat to the last digit and show no step
    either_way : whether the signs may all be wrong, because it is unknown if the readings point up or down

    Examples
    --------
    >>> tilt = starpos.Tilt(0.01, -0.02, np.eye(2) * 1e-10, utc_unix_s=1.8e9)
    >>> tilt.up.round(3)  # direction of up in S
    array([ 0.01, -0.02,  1.  ])
    """

    theta_x: float
    theta_y: float
    covariance: np.ndarray
    _: KW_ONLY
    utc_unix_s: float
    samples: int = 1
    temperature_c: float = float("nan")
    times: tuple[float, ...] = ()
    theta_z: float = float("nan")
    variance_z: float = float("nan")
    step_rad: float = 0.0
    either_way: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", np.asarray(self.covariance, float))
        if not np.isfinite([self.theta_x, self.theta_y, self.utc_unix_s]).all():
            raise TiltError("a tilt reading is not a finite number: check the inclinometer")
        if self.covariance.shape != (2, 2) or not np.isfinite(self.covariance).all():
            raise TiltError("a tilt's covariance must be 2 x 2 finite numbers, rad2")
        sines = np.sin(self.theta)
        square = float(sines @ sines)
        possible = abs(square - 1) < SQUARE if self.axes == 3 else square < 1
        if not possible or np.abs(self.theta).max() > np.pi / 2:
            angles = ", ".join(f"{angle:.3f}" for angle in np.degrees(self.theta))
            raise TiltError(
                f"tilts of {angles} deg cannot hold together: check the inclinometer and its units"
            )

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> "Tilt":
        """Return itself: a single tilt serves any exposure, as `starpos.instrument.tilt_log.Tilts`."""
        return self

    @property
    def reversed(self) -> "Tilt":
        """This tilt with the other sign."""
        return replace(self, theta_x=-self.theta_x, theta_y=-self.theta_y, theta_z=-self.theta_z)

    @property
    def axes(self) -> int:
        """Number of axes that were measured, 2 or 3."""
        return 2 if math.isnan(self.theta_z) else 3

    @cached_property
    def theta(self) -> np.ndarray:
        """The elevations (axes,) in rad."""
        return np.array([self.theta_x, self.theta_y, self.theta_z])[: self.axes]

    @property
    def noise(self) -> np.ndarray:
        """Covariance (axes, axes) of `theta` in rad2."""
        if self.axes == 2:
            return self.covariance
        whole = np.zeros((3, 3))
        whole[:2, :2] = self.covariance
        whole[2, 2] = np.trace(self.covariance) / 2 if np.isnan(self.variance_z) else self.variance_z
        return whole

    @cached_property
    def up(self) -> np.ndarray:
        """Up (3,), a unit vector in S."""
        return up_of(self.theta)

    @property
    def slope(self) -> np.ndarray:
        """Change (3, axes) of `up` for an error of each axis in rad: of the angle for two axes, of the sine for three.

        The error of three accelerometers, and of the direction they give, does not depend on the lean.
        """
        if self.axes == 3:
            up = self.up
            return (np.eye(3) - np.outer(up, up)) / np.linalg.norm(np.sin(self.theta))
        return up_slope(self.theta, self.up)


@dataclass(frozen=True, kw_only=True)
class InclinometerErrors:
    """Errors of an inclinometer, 1 sigma; the defaults are an SCA100T-D01's, compensated and calibrated.

    noise_rad                white noise of one reading
    quantum_rad              step of its readings
    drift_rad_per_sqrt_hour  random walk of its zero
    temperature_rad_per_c    change of its zero with temperature, after compensation
    scale                    relative error of the angle
    cross                    share of one axis' angle that the other shows: the axes are not square
    pose_rad                 new at each pose, and the same in all its readings: hysteresis, nonlinearity, flexure
    range_rad                largest angle that it measures
    """

    noise_rad: float = SCA100T_NOISE_RAD
    quantum_rad: float = np.radians(0.0005)
    drift_rad_per_sqrt_hour: float = 2 * ARCSEC
    temperature_rad_per_c: float = 3 * ARCSEC
    scale: float = 1e-4
    cross: float = 0.0
    pose_rad: float = 0.0
    range_rad: float = np.pi / 2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            most = np.pi / 2 if name == "range_rad" else 1
            if not 0 <= value <= most:
                raise InstrumentError(
                    f"the inclinometer's {name} is {value:g}: it must be a finite number from 0 to {most:.4g}"
                )

    def check_range(self, tilt: Tilt) -> None:
        """Raise TiltRangeError if a tilt is beyond the range of the sensor."""
        most = float(np.abs(tilt.theta[:2]).max())
        if most > self.range_rad:
            x, y = np.degrees(tilt.theta[:2])
            raise TiltRangeError(
                f"tilt ({x:.3f}, {y:.3f}) deg is beyond +-{np.degrees(self.range_rad):.3g} deg, "
                "the inclinometer's range: set the instrument more upright"
            )

    def check_axes(self, tilt: Tilt) -> None:
        """Raise TiltError if three axes contradict each other by more than the sensor's errors make possible."""
        if tilt.axes == 2:
            return
        off, sigma = self._off_square(tilt)
        most = min(SQUARE, MIN_SQUARE + SQUARE_SIGMA * sigma)
        if abs(off) > most:
            angles = ", ".join(f"{angle:.3f}" for angle in np.degrees(tilt.theta))
            raise TiltError(
                f"tilts of {angles} deg contradict each other: the squares of their sines add up to {1 + off:.4f}, not "
                f"to 1 within the {most:.4f} that the inclinometer's stated errors make possible: check it, or name its "
                "model"
            )

    def check_live(self, tilt: Tilt) -> None:
        """Raise TiltError if readings repeat to the last digit, though the sensor's noise is larger than its steps."""
        if math.isinf(tilt.step_rad) and self.noise_rad > self.quantum_rad:
            x, y = np.degrees(tilt.theta[:2])
            raise TiltError(
                f"the inclinometer repeats the same value ({x:.6g}, {y:.6g} deg) to the last digit, though its noise of "
                f"{np.degrees(self.noise_rad):.2g} deg is larger than its steps: it does not measure: check its sensor "
                "and converter, or state its step (tilt_quantum_deg) and noise if its readings are so coarse"
            )

    def coarser(self, step_rad: float) -> str:
        """Say that readings are rounded to steps (`Tilt.step_rad`) larger than the sensor's; '' if they are not."""
        if not self._is_rounded(step_rad):
            return ""
        return (
            f"the tilts come in steps of {np.degrees(step_rad):.2g} deg, coarser than the inclinometer's "
            f"{np.degrees(self.quantum_rad):.2g} deg: the rounding is in the claimed errors: record more digits, or "
            "state the step (tilt_quantum_deg)"
        )

    def contradiction(self, tilt: Tilt) -> float:
        """Error of each axis' sine by which three axes contradict each other beyond the stated errors; 0 for two axes.

        A sum of squares shows only the error along gravity; the errors across it are assumed equal.
        """
        if tilt.axes == 2:
            return 0.0
        off, sigma = self._off_square(tilt)
        return max(abs(off) - EXPLAINED_SIGMA * sigma, 0.0) / 2

    def _off_square(self, tilt: Tilt) -> tuple[float, float]:
        """Deviation from 1 of the sum of three axes' squared sines, and its stated sigma."""
        sines = np.sin(tilt.theta)
        squares = sines**2
        # each axis shows a share of the other two
        cross = (squares.sum() - squares) @ squares
        variance = (
            sines @ tilt.noise @ sines
            + self.quantum_rad**2 / 12
            + self.pose_rad**2
            + self.scale**2 * (squares @ squares)
            + self.cross**2 * cross
        )
        return float(squares.sum()) - 1, 2 * float(np.sqrt(variance))

    def wander_variance(self, seconds: float, walk_c_per_sqrt_hour: float = 0.0) -> float:
        """Variance (rad2) that the zero gains in a time (NaN: 0), also by an unmeasured temperature's random walk."""
        walk2 = self.drift_rad_per_sqrt_hour**2 + (self.temperature_rad_per_c * walk_c_per_sqrt_hour) ** 2
        return walk2 * seconds / HOUR_S if math.isfinite(seconds) else 0.0

    def pose_variance(self, tilt: Tilt) -> float:
        """Variance (rad2) of what is new at each pose: hysteresis, flexure, and the rounding that noise leaves."""
        return self.pose_rad**2 + self.undithered_rad(tilt) ** 2

    def _is_rounded(self, step_rad: float) -> bool:
        """Whether readings are rounded to steps that the sensor's stated one does not explain."""
        return BY_CHANCE * self.quantum_rad < step_rad < math.inf

    def undithered_rad(self, tilt: Tilt) -> float:
        """Error (rad) that rounding leaves in the mean of many readings; noise larger than half a step removes it.

        It is the first harmonic of a quantiser's mean error under Gaussian noise, after Widrow and Kollar,
        "Quantization Noise", 2008. Of readings in coarser steps than the sensor's, the scatter is rounding too, and the
        sensor's own noise counts.
        """
        if self._is_rounded(tilt.step_rad):
            noise2 = (self.noise_rad / tilt.step_rad) ** 2
            return float(tilt.step_rad / math.sqrt(12) * math.exp(-2 * math.pi**2 * noise2))
        if self.quantum_rad == 0:
            return 0.0
        noise2 = min(tilt.covariance[0, 0], tilt.covariance[1, 1]) * tilt.samples / self.quantum_rad**2
        return float(self.quantum_rad / math.sqrt(12) * math.exp(-2 * math.pi**2 * noise2))

    def steps(self, tilt: Tilt) -> tuple:
        """The quantiser's steps on which the readings stand; the error of rounding is the same while they stay."""
        step = tilt.step_rad if self._is_rounded(tilt.step_rad) else self.quantum_rad
        if step == 0:
            return ()
        return (tuple(np.round(tilt.theta / step).astype(int).tolist()),)


EXACT = InclinometerErrors(
    noise_rad=0.0, quantum_rad=0.0, drift_rad_per_sqrt_hour=0.0, temperature_rad_per_c=0.0, scale=0.0
)


def elevations(angles: np.ndarray) -> np.ndarray:
    """Elevations (..., axes) in rad from angles (..., axes) in rad that a sensor may count from 0 to 360 deg; NaN of inf.

    A third axis shows which way is up, so with three axes an angle beyond 90 deg has the elevation of its supplement.
    With two axes it stays, and `Tilt` refuses it: the sensor is upside down.
    """
    angles = np.asarray(angles, float)
    with np.errstate(invalid="ignore"):
        unwrapped = np.where(np.abs(angles) > np.pi, rotation.half_turns(angles), angles)
    if angles.shape[-1] == 2:
        return unwrapped
    return np.where(np.abs(unwrapped) > np.pi / 2, np.sign(unwrapped) * np.pi - unwrapped, unwrapped)


def up_of(theta: np.ndarray) -> np.ndarray:
    """Up (..., 3) in S, from elevations (..., 2) in rad of X', Y', with Z' upwards, or (..., 3) of all three axes."""
    sines = np.sin(np.asarray(theta, float))
    if sines.shape[-1] == 3:
        return rotation.normalised(sines)
    up = np.empty((*sines.shape[:-1], 3))
    up[..., :2] = sines
    up[..., 2] = np.sqrt(np.maximum(1 - np.einsum("...i,...i->...", sines, sines), 0.0))
    return up


def up_slope(theta: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Derivatives (3, axes) of up (3,), as `up_of` has it, by the elevations theta (axes,)."""
    cosines = np.cos(theta)
    if len(theta) == 3:
        across = np.eye(3) - np.outer(up, up)
        return across * cosines / np.linalg.norm(np.sin(theta))
    (cx, cy), (x, y, z) = cosines.tolist(), up.tolist()
    steep = max(z, 1e-9)
    return np.array([[cx, 0.0], [0.0, cy], [-x * cx / steep, -y * cy / steep]])


def level_of(up: np.ndarray) -> np.ndarray:
    """A2 (3, 3), S into L, from up (3,) in S: A2 = R2(b) R1(a) of the paper's section 4.2.

    b = -theta_x, and a = atan2 of up's y and z, so that the third row is up. L's X is below S's X'; where that is
    vertical, L's X is below Y' instead. Any X will do, because the heading comes from the stars.
    """
    if abs(up[0]) > STEEP:
        across = rotation.normalised(np.cross(up, np.cross([0.0, 1.0, 0.0], up)))
        return np.stack([across, np.cross(up, across), up])
    cb, sb = np.sqrt(up[1] ** 2 + up[2] ** 2), -up[0]
    sa, ca = up[1] / cb, up[2] / cb
    return np.array([[cb, sa * sb, ca * sb], [0.0, ca, -sa], [-sb, sa * cb, ca * cb]])


# The response: how the angles err at another lean than at the calibration. Each axis has a zero and a scale, each pair of
# axes an angle that is not square. A3 is fitted at the calibration's lean, so these count only away from it; even a zero
# does, because a constant error of an angle is not a rotation. Number of coefficients by number of axes.
RESPONSE_COEFFICIENTS = {2: 5, 3: 9}


def angles_at(up: np.ndarray, axes: int) -> np.ndarray:
    """The elevations (axes,) in rad of S's axes for up (3,) in S."""
    return np.arcsin(np.clip(up, -1, 1))[:axes]


@lru_cache(maxsize=8)
def _zeroed(up: tuple[float, ...], axes: int) -> tuple[np.ndarray, np.ndarray]:
    """Angles (axes,) of a lean, and the rotation of S (axes, 3) that moves up there as an error of each angle does."""
    there = np.array(up)
    theta = angles_at(there, axes)
    return theta, rotation.cross(there, up_slope(theta, there).T)


def response_columns(theta: np.ndarray, up: np.ndarray, calibrated_up: np.ndarray) -> np.ndarray:
    """Change (3, m) of up (3,) in S, as read at the angles theta (axes,), for each coefficient of the response.

    calibrated_up (3,): where the response counts nothing, because A3 was fitted there.

    The m coefficients are the zeros (rad), the scales (shares) and, for each pair of axes, the share of one axis' angle
    that the other shows.
    """
    axes = len(theta)
    then, turns = _zeroed(tuple(calibrated_up.tolist()), axes)
    lean = (theta - then).tolist()
    # change of each angle for each coefficient
    angles = np.zeros((axes, RESPONSE_COEFFICIENTS[axes]))
    for k in range(axes):
        angles[k, k], angles[k, axes + k] = 1.0, lean[k]
    for k, (i, j) in enumerate(combinations(range(axes), 2), 2 * axes):
        angles[i, k], angles[j, k] = lean[j], lean[i]
    columns = up_slope(theta, up) @ angles
    # a rotation of S by up x moved takes up there by `moved`
    columns[:, :axes] += rotation.cross_matrix(up) @ turns.T
    return columns


def stated_variances(errors: InclinometerErrors, axes: int) -> np.ndarray:
    """Variances (m,) of the coefficients as the sensor's errors state them; its zero is part of A3's error."""
    pairs = axes * (axes - 1) // 2
    return np.array([0.0] * axes + [errors.scale**2] * axes + [errors.cross**2] * pairs)
