# SPDX-License-Identifier: Apache-2.0
"""Angles from the codes of a board with an SCL3300-D01, their covariance, and the faults of a sample.

Source: the sensor's data sheet (Murata Doc. 4921 Rev. 2); PROTOCOL.md says what the board makes of its registers.
"""

import math
from dataclasses import dataclass

from starpos.instrument import sensors
from starpos.instrument.noise_tracker import NoiseTracker
from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.reading import GAP, OUT_OF_RANGE, STUCK
from starpos_inclinometer.sources.sca100t import CODE_ZERO, Measured
from starpos_inclinometer.temperature import Temperature

# 90 deg are 2^14 steps of the sensor, each 256 codes.
RAD_PER_CODE = math.radians(90) / (1 << 22)
STEP_RAD = 256 * RAD_PER_CODE
# The board sends TEMP / 16 - 256 of the sensor's T = -273 + TEMP / 18.9 deg C.
TEMPERATURE_ZERO_COUNTS, TEMPERATURE_STEP_C = 256, 16 / 18.9
# The steps are about as large as the noise, so neighbours are often equal on one axis; this many on both are no chance.
STUCK_PAIRS = 50
FAULTS = SampleStatus.NO_ANSWER | SampleStatus.MEANINGLESS | SampleStatus.SELF_TEST


@dataclass(frozen=True)
class Scl3300Calibration:
    """What the owner found out.

    cross_axis: matrix (xx, xy, yx, yy) from the sines of the sensor's angles to the sines of S's.
    noise_floor_rad: smallest noise of one sample, even if the samples show less.
    """

    cross_axis: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    noise_floor_rad: float = 0.0


def temperature_c(counts: int) -> float:
    """Convert the board's temperature counts to deg C."""
    return (counts + TEMPERATURE_ZERO_COUNTS + 0.5) * TEMPERATURE_STEP_C - 273


class Scl3300:
    """Converts the samples of one board to tilts; remembers the last codes, the temperature and the noise."""

    def __init__(self, calibration: Scl3300Calibration = Scl3300Calibration()) -> None:
        self.calibration = calibration
        self.noise = NoiseTracker()
        self.temperature = Temperature()
        self._last = (-1, -1)
        self._equal = 0

    def measure(self, sample: Sample, time_s: float) -> Measured:
        """Convert a sample taken at `time_s` of a clock that does not step."""
        flags = self._flags(sample)
        measured = math.nan
        if not sample.status & SampleStatus.NO_TEMPERATURE:
            measured = temperature_c(sample.temperature)
        self.temperature.add(time_s, measured)
        if flags & GAP:
            self.noise.interrupt()
        felt = [(code - CODE_ZERO) * RAD_PER_CODE for code in (sample.x, sample.y)]
        if not flags & (OUT_OF_RANGE | STUCK):
            self.noise.add(time_s, *felt)
        sx, sy = map(math.sin, felt)
        xx, xy, yx, yy = self.calibration.cross_axis
        x, y = _asin(xx * sx + xy * sy), _asin(yx * sx + yy * sy)
        sigmas = self.noise.sigma or (sensors.SCL3300.noise_rad,) * 2
        floor = self.calibration.noise_floor_rad
        vx, vy = (max(s, floor) ** 2 + STEP_RAD**2 / 12 for s in sigmas)
        covariance = (
            xx * xx * vx + xy * xy * vy,
            xx * yx * vx + xy * yy * vy,
            xx * yx * vx + xy * yy * vy,
            yx * yx * vx + yy * yy * vy,
        )
        return Measured(x, y, covariance, measured, flags)

    def _flags(self, sample: Sample) -> int:
        self._equal = self._equal + 1 if (sample.x, sample.y) == self._last else 1
        self._last = (sample.x, sample.y)
        flags = GAP if sample.lost or sample.restarted or sample.resumed else 0
        if sample.status & FAULTS or self._equal >= STUCK_PAIRS:
            flags |= STUCK
        if sample.status & SampleStatus.UPSIDE_DOWN:
            flags |= OUT_OF_RANGE
        return flags


def _asin(sine: float) -> float:
    return math.asin(min(max(sine, -1.0), 1.0))
