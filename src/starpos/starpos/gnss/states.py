# SPDX-License-Identifier: Apache-2.0
"""What GNSS teaches of an instrument: A3, the errors of its inclinometer, the deflection of the vertical; all together.

All are angles in rad, or shares. Their covariance is kept whole, because at first most of them cannot be separated: at
one pose a turn of A3 looks like a zero, and at one heading like a deflection.
"""

import json
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from starpos import files, rotation
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.vertical import Vertical
from starpos.errors import GnssError
from starpos.fix.fix import Fix
from starpos.instrument.inclinometer import (
    MAX_CELSIUS,
    RESPONSE_COEFFICIENTS,
    UNMEASURED_WALK_C_PER_SQRT_HOUR,
    Tilt,
    response_columns,
    stated_variances,
)
from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC

# Share of the deflection's variance that is the same everywhere the instrument goes; the rest is a field.
CONSTANT_SHARE = 0.5
# Distance (m) over which the field is forgotten, by exp(-d / L): 20 nautical miles.  Our choice, after the Markov models
# with which inertial navigation describes deflections (reviewed by Nash and Jordan, Statistical geodesy - an engineering
# perspective, Proc. IEEE 66(5), 1978, 532-550, of which only the abstract was at hand).  Laws that agree with anomaly and
# geoid are smooth at d = 0 (Jordan, JGR 77(20), 1972): an exponential forgets more on a short way.
FIELD_LENGTH_M = 37_000.0
# An error of GNSS that it does not state: multipath, which changes within minutes.
GNSS_SLOW_RAD, GNSS_SLOW_S = 10.0 / EARTH_RADIUS_M, 300.0
# 1 sigma about each axis of an unknown A3.
NO_A3_RAD = 1.0


class Layout(NamedTuple):
    """Where each state stands.

    a3: a small rotation of A3 about S's axes.  zero: each axis' zero, which wanders.
    response: the coefficients of `instrument.response`.  temperature: change of each zero per C.
    pose: error of each axis that is new at each pose.
    constant: deflection, east and north, that is the same everywhere, beyond the `Vertical`'s.
    field: deflection, east and north, of this place, beyond the constant.
    gnss: slow error of GNSS, east and north, as angles at the Earth's centre.
    """

    a3: slice
    zero: slice
    response: slice
    temperature: slice
    pose: slice
    constant: slice
    field: slice
    gnss: slice

    @property
    def size(self) -> int:
        """Number of states."""
        return self.gnss.stop


@lru_cache(maxsize=2)
def layout_of(axes: int) -> Layout:
    """The states of a sensor of two or three axes."""
    ends = np.cumsum((0, 3, axes, RESPONSE_COEFFICIENTS[axes], axes, axes, 2, 2, 2)).tolist()
    return Layout(*map(slice, ends, ends[1:]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Learned:
    """What is known of an instrument at a time and a place.

    a3 (3, 3): C into S, about which the states are linear.  calibrated_up (3,): where the response counts nothing.
    temperature_c: at which the state `zero` is the whole of the zero; NaN while the temperature is not measured.
    warmer_c: how much warmer the sensor is than that, as far as it was measured.
    state (n,), covariance (n, n): as `layout_of(axes)` has them.
    place: latitude and longitude (rad) to which the deflection's field belongs; None before there was one.
    frames, poses: from how many it was learned.  since_unix_s: time of the first of them, NaN without one.
    """

    axes: int
    a3: np.ndarray
    calibrated_up: np.ndarray
    temperature_c: float
    state: np.ndarray
    covariance: np.ndarray
    utc_unix_s: float
    warmer_c: float = 0.0
    place: tuple[float, float] | None = None
    frames: int = 0
    poses: int = 0
    since_unix_s: float = float("nan")

    @property
    def layout(self) -> Layout:
        """Where the states stand."""
        return layout_of(self.axes)

    @property
    def rotation(self) -> np.ndarray:
        """A3 (3, 3) with what was learned of it."""
        return rotation.from_vector(self.state[self.layout.a3]) @ self.a3

    @property
    def a3_stddev_rad(self) -> tuple[float, float]:
        """1 sigma of A3 across the plumb line, an axis, and about it."""
        a3, up = self.covariance[self.layout.a3, self.layout.a3], self.calibrated_up
        about2 = float(up @ a3 @ up)
        return float(np.sqrt(max(np.trace(a3) - about2, 0.0) / 2)), float(np.sqrt(about2))

    @property
    def deflection_stddev_rad(self) -> float:
        """1 sigma of a component of the deflection at `place`."""
        at, covariance = self.layout, self.covariance
        both = covariance[at.constant, at.constant] + covariance[at.field, at.field]
        both = both + covariance[at.constant, at.field] + covariance[at.field, at.constant]
        return float(np.sqrt(np.trace(both) / 2))

    def columns(self, tilt: Tilt) -> tuple[np.ndarray, np.ndarray]:
        """Change of up in S for the response's coefficients (3, m), and for errors of the angles (3, axes)."""
        return response_columns(tilt.theta, tilt.up, self.calibrated_up), tilt.slope

    def up(self, tilt: Tilt) -> np.ndarray:
        """Up (3,) in S at a tilt, without the errors that are known."""
        at, (response, slope) = self.layout, self.columns(tilt)
        x = self.state
        angles = x[at.zero] + x[at.pose] + x[at.temperature] * self.warmer_c
        return rotation.normalised(tilt.up - response @ x[at.response] - slope @ angles)

    def tilted(self, tilt: Tilt) -> np.ndarray:
        """Derivatives (3, n) of `up` by the states; A3, the deflection and GNSS have none."""
        at, (response, slope) = self.layout, self.columns(tilt)
        rows = np.zeros((3, at.size))
        rows[:, at.response] = -response
        rows[:, at.zero] = rows[:, at.pose] = -slope
        rows[:, at.temperature] = -slope * self.warmer_c
        return rows

    def deflection_rad(self, vertical: Vertical, latitude: float, longitude: float) -> np.ndarray:
        """Deflection (2,) east, north at a place: a Vertical's, and what was learned beyond it."""
        stated, at = vertical.at(latitude, longitude), self.layout
        known = np.array([stated.eta_arcsec, stated.xi_arcsec]) * ARCSEC
        return known + self.state[at.constant] + self.state[at.field]


def prior(instrument: Instrument, tilt: Tilt, deflection_stddev_rad: float, utc_unix_s: float) -> Learned:
    """What is known of an instrument before GNSS has taught anything, at the time of a tilt."""
    at, calibration, errors = layout_of(tilt.axes), instrument.calibration, instrument.inclinometer
    variance = np.zeros((at.size, at.size))
    variance[at.a3, at.a3] = (
        np.eye(3) * NO_A3_RAD**2 if calibration.unknown else calibration.covariance
    ) + np.eye(3) * (calibration.remounted_arcsec * ARCSEC) ** 2
    since_s = abs(utc_unix_s - calibration.utc_unix_s)
    drift2, warmer_c = errors.wander_variance(since_s), calibration.warmer_c(tilt)
    if not np.isfinite(warmer_c):
        drift2 += (errors.temperature_rad_per_c * calibration.unmeasured_c) ** 2
    state = np.zeros(at.size)
    if calibration.response and len(calibration.response) == RESPONSE_COEFFICIENTS[tilt.axes]:
        state[at.response] = calibration.response
        variance[at.response, at.response] = calibration.response_covariance
    else:
        variance[at.response, at.response] = np.diag(stated_variances(errors, tilt.axes))
    deflection2 = deflection_stddev_rad**2
    for rows, value in (
        (at.zero, drift2),
        (at.temperature, errors.temperature_rad_per_c**2),
        (at.pose, errors.pose_variance(tilt)),
        (at.constant, CONSTANT_SHARE * deflection2),
        (at.field, (1 - CONSTANT_SHARE) * deflection2),
        (at.gnss, GNSS_SLOW_RAD**2),
    ):
        variance[rows, rows] = np.eye(rows.stop - rows.start) * value
    return Learned(
        axes=tilt.axes,
        a3=calibration.a3,
        calibrated_up=calibration.up,
        temperature_c=calibration.temperature_c if np.isfinite(warmer_c) else tilt.temperature_c,
        warmer_c=warmer_c if np.isfinite(warmer_c) else 0.0,
        state=state,
        covariance=variance,
        utc_unix_s=utc_unix_s,
    )


@dataclass(frozen=True, eq=False)
class Ageing:
    """What passes between two frames: each state keeps a share (n,) of itself and gains a variance (n,)."""

    share: np.ndarray
    variance: np.ndarray

    def of(self, state: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States (..., n) and covariances (..., n, n) after it; states beyond those n stay."""
        share, variance = self.share, self.variance
        if (more := state.shape[-1] - len(share)) > 0:
            share, variance = np.append(share, np.ones(more)), np.append(variance, np.zeros(more))
        covariance = covariance * (share[:, None] * share) + np.diag(variance)
        return state * share, covariance


def aged(
    learned: Learned,
    instrument: Instrument,
    vertical: Vertical,
    fix: Fix,
    place: tuple[float, float],
    moved_m: float,
    new_pose: bool,
) -> tuple[Learned, Ageing]:
    """What is left at a fix of what was learned, and what passed until then.

    place: latitude, longitude (rad) of the fix by what was learned, or by GNSS; moved_m: how far that is from before.
    """
    at, errors, tilt, utc_unix_s = learned.layout, instrument.inclinometer, fix.tilt, fix.utc_unix_s
    share, variance = np.ones(at.size), np.zeros(at.size)
    seconds = abs(utc_unix_s - learned.utc_unix_s)
    measured = np.isfinite(tilt.temperature_c - learned.temperature_c)
    variance[at.zero] = errors.wander_variance(seconds, 0.0 if measured else UNMEASURED_WALK_C_PER_SQRT_HOUR)
    kept, deflection2 = np.exp(-moved_m / FIELD_LENGTH_M), (vertical.at(*place).stddev_arcsec * ARCSEC) ** 2
    share[at.field], variance[at.field] = kept, (1 - CONSTANT_SHARE) * deflection2 * (1 - kept**2)
    kept = np.exp(-seconds / GNSS_SLOW_S)
    share[at.gnss], variance[at.gnss] = kept, GNSS_SLOW_RAD**2 * (1 - kept**2)
    if new_pose:
        share[at.pose], variance[at.pose] = 0.0, errors.pose_variance(tilt)
    passed = Ageing(share, variance)
    state, covariance = passed.of(learned.state, learned.covariance)
    now = replace(at_temperature(learned, tilt), state=state, covariance=covariance, utc_unix_s=utc_unix_s)
    return now, passed


def at_temperature(learned: Learned, tilt: Tilt) -> Learned:
    """Carry what was learned to the temperature of a tilt.

    While temperatures are not measured, the zero walks with them: from then on they count from the next measured one.
    """
    measured_c, reference_c = tilt.temperature_c, learned.temperature_c
    if math.isnan(measured_c):
        return replace(learned, temperature_c=math.nan)
    if math.isnan(reference_c):
        return replace(learned, temperature_c=measured_c - learned.warmer_c)
    return replace(learned, warmer_c=measured_c - reference_c)


VERSION, KEY = 1, "starpos_learned"
MAX_BYTES = 200_000
# a covariance may miss being positive by this share of its trace of correlations, by rounding
ROUNDING = 1e-9
CURE = "delete it to learn anew, or give another file"
# keys of the file that are not the names of the fields
IN_FILE = {"place": "place_rad"}


def save_learned(path: Path, learned: Learned) -> None:
    """Write what was learned; GnssError if the file cannot be written."""
    content = {KEY: VERSION} | {IN_FILE.get(k, k): v for k, v in vars(learned).items()}
    for name in ("since_unix_s", "temperature_c"):
        content[name] = None if math.isnan(content[name]) else content[name]
    text = json.dumps(content, default=np.ndarray.tolist) + "\n"
    files.save(path, text.encode(), "what was learned", GnssError)


def read_learned(path: Path) -> Learned | None:
    """Read what was learned; None without a file.  GnssError if it cannot be that."""
    try:
        text = files.read_regular(path, MAX_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise GnssError(
            f"{path}: not a readable file of what GNSS taught ({error.strerror}): {CURE}"
        ) from None
    try:
        return _learned(json.loads(text))
    except (ValueError, TypeError, KeyError, IndexError, AttributeError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise GnssError(f"{path}: not a file of what GNSS taught ({reason}): {CURE}") from None


def _learned(content: dict) -> Learned:
    if content.get(KEY) != VERSION:
        raise ValueError(f"{KEY} is not {VERSION}")
    axes = content["axes"]
    if axes not in (2, 3) or not isinstance(axes, int):
        raise ValueError("axes is neither 2 nor 3")
    n = layout_of(axes).size
    arrays = {name: np.array(content[name], float) for name in ("a3", "calibrated_up", "state", "covariance")}
    shapes = {"a3": (3, 3), "calibrated_up": (3,), "state": (n,), "covariance": (n, n)}
    for name, array in arrays.items():
        if array.shape != shapes[name] or not np.isfinite(array).all():
            raise ValueError(f"{name} is not {shapes[name]} finite numbers")
    covariance, a3 = arrays["covariance"], arrays["a3"]
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-40))
    correlation = covariance / np.outer(scale, scale)
    if (
        not np.allclose(correlation, correlation.T, atol=1e-6)
        or np.linalg.eigvalsh(correlation)[0] < -ROUNDING * n
    ):
        raise ValueError("its covariance is not symmetric and positive")
    if not np.allclose(a3 @ a3.T, np.eye(3), atol=1e-9) or np.linalg.det(a3) < 0:
        raise ValueError("a3 is no rotation")
    if not abs(np.linalg.norm(arrays["calibrated_up"]) - 1) < 1e-6:
        raise ValueError("calibrated_up is no direction")
    place, since, celsius = content["place_rad"], content["since_unix_s"], content["temperature_c"]
    # files from before it was written have none
    warmer_c = content.get("warmer_c", 0.0)
    known = [v for v in (since, celsius) if v is not None]
    known += [content["utc_unix_s"], content["frames"], content["poses"], warmer_c, *(place or ())]
    possible = abs(place[0] if place else 0.0) <= np.pi / 2 and abs(celsius or 0.0) <= MAX_CELSIUS
    if not np.isfinite(known).all() or not possible:
        raise ValueError("its times, temperatures, place or counts are not possible numbers")
    return Learned(
        axes=axes,
        temperature_c=math.nan if celsius is None else float(celsius),
        warmer_c=float(warmer_c),
        utc_unix_s=float(content["utc_unix_s"]),
        place=None if place is None else (float(place[0]), float(place[1])),
        frames=int(content["frames"]),
        poses=int(content["poses"]),
        since_unix_s=math.nan if since is None else float(since),
        **arrays,
    )
