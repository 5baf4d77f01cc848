# SPDX-License-Identifier: Apache-2.0
"""Tilts of a sensor that measures angles itself: flags, numbers and the covariance of its readings."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from starpos.instrument.inclinometer import SCA100T_NOISE_RAD
from starpos.instrument.noise_tracker import NoiseTracker
from starpos_inclinometer.host_clock import Moment
from starpos_inclinometer.sources.reading import GAP, OUT_OF_RANGE, STUCK, TIME_UNKNOWN, Reading


@dataclass(frozen=True, slots=True)
class Angles:
    """One reading: elevations of x, y and perhaps z, and the step of their digits, in rad."""

    angles: tuple[float, ...]
    step: float
    # NaN where it is not known.
    temperature_c: float
    # Readings lost just before this one.
    lost: int = 0
    # True: it does not continue the readings before.
    broken: bool = False


class AngleTilts:
    """Readings of one sensor of angles, in order."""

    def __init__(self) -> None:
        self.noise = NoiseTracker()
        # Noise of a reading until the readings show theirs, rad.
        self.usual_noise = SCA100T_NOISE_RAD
        self._floor = self._latency = 0.0
        self._stuck_samples, self._range = 0, math.pi / 2
        self._equal = 0
        self._last: tuple[float, ...] = ()
        self._sequence = -1

    def configure(self, values: Mapping[str, Any], *, stuck_samples: int, range_rad: float) -> None:
        """Take the parameters, the number of equal readings that shows a stuck sensor (0: none), and its range."""
        self._floor = 0.0 if math.isnan(values["noise_stddev"]) else math.radians(values["noise_stddev"])
        self._latency = 0.0 if math.isnan(values["latency"]) else values["latency"]
        self._stuck_samples, self._range = stuck_samples, range_rad

    def reading(self, measured: Angles, moment: Moment, late_s: float | None) -> Reading:
        """Convert a reading that came at a moment, late by some seconds, or None if unknown."""
        angles = measured.angles
        flags = self._flags(measured) | (TIME_UNKNOWN if late_s is None else 0)
        if flags & GAP:
            self.noise.interrupt()
        late = late_s or 0.0
        if not flags & (OUT_OF_RANGE | STUCK):
            self.noise.add(moment.monotonic_s - late, *angles)
        sigmas = self.noise.sigma or (max(self.usual_noise, measured.step),) * len(angles)
        variances = [max(s, self._floor) ** 2 + measured.step**2 / 12 for s in sigmas]
        self._sequence = (self._sequence + 1 + measured.lost) & 0xFFFFFFFF
        three = len(angles) > 2
        return Reading(
            stamp_ns=max(moment.host_ns - round((late + self._latency) * 1e9), 0),
            x=angles[0],
            y=angles[1],
            covariance=(variances[0], 0.0, 0.0, variances[1]),
            temperature_c=measured.temperature_c,
            sequence=self._sequence,
            flags=flags,
            z=angles[2] if three else math.nan,
            z_variance=variances[2] if three else math.nan,
        )

    def _flags(self, measured: Angles) -> int:
        self._equal = self._equal + 1 if measured.angles == self._last else 1
        self._last = measured.angles
        flags = GAP if measured.lost or measured.broken else 0
        if 0 < self._stuck_samples <= self._equal:
            flags |= STUCK
        # For a sensor without z, beyond 90 deg is upside down.
        if max(map(abs, measured.angles[:2])) > self._range:
            flags |= OUT_OF_RANGE
        return flags
