# SPDX-License-Identifier: Apache-2.0
"""A tilt from its message, and a message from an inclinometer's reading."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos.errors import TiltError
from starpos.instrument.inclinometer import MAX_CELSIUS, SCA100T_NOISE_RAD, SQUARE, Tilt
from starpos.messages.stamp import PlainHeader, PlainStamp, stamp_to_unix

# bits of Tilt.flags, as starpos_interfaces defines them
OUT_OF_RANGE, STUCK, SATURATED, GAP, TIME_UNKNOWN = 1, 2, 4, 8, 16
UNUSABLE = OUT_OF_RANGE | STUCK | SATURATED | TIME_UNKNOWN
# rad2; a larger variance is meaningless, and might overflow
MAX_TILT_VARIANCE = 1.0


@dataclass(frozen=True, kw_only=True)
class TiltMessage:
    """Fields of starpos_interfaces/Tilt."""

    header: PlainHeader
    x: float
    y: float
    covariance: tuple[float, ...]
    temperature: float
    sequence: int
    flags: int
    z: float
    z_variance: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A tilt as it is published.

    stamp_ns: the host's time.  x, y: rad, always finite.  covariance: rad2 (xx, xy, yx, yy).
    temperature_c: deg C, or NaN if it is not known.
    z, z_variance: rad, rad2; NaN for a two-axis sensor.
    """

    stamp_ns: int
    x: float
    y: float
    covariance: tuple[float, ...]
    temperature_c: float
    sequence: int
    flags: int
    z: float = math.nan
    z_variance: float = math.nan

    def message(self, frame_id: str) -> TiltMessage:
        """Make a message; frame_id: the inclinometer's frame."""
        return TiltMessage(
            header=PlainHeader(PlainStamp.of_ns(self.stamp_ns), frame_id),
            x=self.x,
            y=self.y,
            covariance=self.covariance,
            temperature=self.temperature_c,
            sequence=self.sequence,
            flags=self.flags,
            z=self.z,
            z_variance=self.z_variance,
        )


def message_to_tilt(message: Any, unknown_stddev_rad: float = SCA100T_NOISE_RAD) -> Tilt:
    """Tilt from a message; an unknown covariance (all zeros) becomes unknown_stddev_rad on both axes.

    A tilt has two axes if the third is NaN, not filled in, or absent, as in the first release's messages.
    An impossible temperature becomes NaN, unknown.  The flags are left to the caller.  Raises TiltError for NaN, no
    stamp, angles that cannot hold together, or an impossible covariance.
    """
    covariance: np.ndarray = np.array(message.covariance, float).reshape(2, 2)
    unix_s = stamp_to_unix(message.header.stamp)
    if unix_s is None:
        raise TiltError("a tilt message has no time stamp: set header.stamp to the time of the sample.")
    if not covariance.any():
        covariance = np.eye(2) * unknown_stddev_rad**2
    elif np.isfinite(covariance).all():
        (xx, xy), (yx, yy) = covariance
        if not (xx > 0 and yy > 0 and math.isclose(xy, yx, abs_tol=1e-9 * xx) and xx * yy > xy * yx):
            raise TiltError(
                "a tilt message's covariance is not symmetric and positive: send zeros where it is unknown."
            )
        if max(xx, yy) > MAX_TILT_VARIANCE:
            raise TiltError("a tilt message's covariance is beyond 1 rad2: send zeros where it is unknown.")
    celsius = message.temperature if abs(message.temperature) <= MAX_CELSIUS else math.nan
    z, z_variance = _third_axis(message)
    return Tilt(
        message.x,
        message.y,
        covariance,
        utc_unix_s=unix_s,
        temperature_c=celsius,
        theta_z=z,
        variance_z=z_variance,
    )


def _third_axis(message: Any) -> tuple[float, float]:
    """Elevation in rad and variance in rad2 of the third axis, NaN if unknown; TiltError if impossible.

    A publisher that knows only two axes may leave both at 0. If x and y allow only a level third axis, 0 may also be a
    real reading; such a tilt is refused, because the two differ by degrees.
    """
    z, variance = getattr(message, "z", math.nan), getattr(message, "z_variance", math.nan)
    if math.isnan(z):
        return math.nan, math.nan
    if z == variance == 0:
        if math.sin(message.x) ** 2 + math.sin(message.y) ** 2 > 1 - SQUARE:
            raise TiltError(
                "a tilt message leaves z and z_variance at 0, and its x and y alone fit a sensor on its "
                "side: "
                "send z and its variance, or NaN for a sensor of two axes."
            )
        return math.nan, math.nan
    if not math.isfinite(z):
        raise TiltError("a tilt message's z is not a finite number: send NaN for a sensor of two axes.")
    if variance < 0 or variance > MAX_TILT_VARIANCE:
        raise TiltError(
            "a tilt message's z_variance is not from 0 to 1 rad2: send NaN or 0 where it is unknown."
        )
    return z, variance or math.nan
