# SPDX-License-Identifier: Apache-2.0
"""Tilts from a sensor's angles or codes, their covariance and their faults.

Sources: data sheets SCA100T series (Murata 8261800 rev. B2), AD7730/AD7730L (Analog Devices rev. A), SCL3300-D01
(Murata Doc. 4921 Rev. 2); PROTOCOL.md says what the board makes of its registers.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from starpos.instrument import sensors
from starpos.instrument.inclinometer import (
    SCA100T_NOISE_RAD,
    SCA100T_RANGE_RAD,
)
from starpos.instrument.tilt_log import NoiseTracker
from starpos.messages.tilt import GAP, OUT_OF_RANGE, SATURATED, STUCK, Reading
from starpos_inclinometer.sources.mcu_protocol import FAULTS, Sample, SampleStatus

# The body of the sensor warms no faster.
SMOOTHING_S = 60.0
# Step from one reading to the next possible one.
READING_STEP_C = 0.92
# How fast the temperature may drift while it is not read.
AGEING_C_PER_S = 2.0 / 60
# Without any reading the temperature may be anywhere from -40 to 125 deg C.
UNKNOWN_STDDEV_C = 40.0
# (xx, xy, yx, yy) of a sensor whose axes are S's.
SQUARE_AXES = (1.0, 0.0, 0.0, 1.0)


class Temperature:
    """Smooths readings in steps of READING_STEP_C; its error grows while readings are missing."""

    def __init__(self) -> None:
        self._value = math.nan
        self._read_s = self._now_s = 0.0

    def observe(self, time_s: float, celsius: float) -> None:
        """Take a reading at `time_s` of a clock that does not step; NaN for a missing one."""
        elapsed = max(time_s - self._read_s, 0.0)
        self._now_s = time_s
        if math.isnan(celsius):
            return
        if math.isnan(self._value):
            self._value = celsius
        else:
            self._value += (celsius - self._value) * -math.expm1(-elapsed / SMOOTHING_S)
        self._read_s = time_s

    def celsius(self, otherwise: float) -> float:
        """The newest known temperature, or `otherwise` without one."""
        return otherwise if math.isnan(self._value) else self._value

    @property
    def stddev_c(self) -> float:
        """Standard deviation of the temperature that `celsius` gives."""
        if math.isnan(self._value):
            return UNKNOWN_STDDEV_C
        age_s = max(self._now_s - self._read_s, 0.0)
        return min(math.hypot(READING_STEP_C / math.sqrt(12), AGEING_C_PER_S * age_s), UNKNOWN_STDDEV_C)


class SensorTilts:
    """Readings of one sensor, in order: their noise, which they show themselves, and their faults.

    usual_noise_rad: noise of a reading until the readings show theirs.  range_rad: largest angle of x and y.
    stuck: number of equal readings, on all axes, that shows a stuck sensor; 0: none.  stuck_axis: the same on one axis.
    """

    def __init__(
        self,
        usual_noise_rad: float = SCA100T_NOISE_RAD,
        range_rad: float = math.pi / 2,
        stuck: int = 0,
        stuck_axis: int = 0,
    ) -> None:
        self.noise = NoiseTracker()
        self.range_rad, self.stuck = range_rad, stuck
        # Smallest noise of a reading, even if the readings show less.
        self.noise_floor_rad = 0.0
        # (xx, xy, yx, yy): from the sines of the sensor's x and y to the sines of S's.
        self.cross_axis: Sequence[float] = SQUARE_AXES
        self._usual_noise_rad, self._stuck_axis = usual_noise_rad, stuck_axis
        self._axes = 0
        self._codes: tuple[float, ...] = ()
        self._equal: list[int] = []

    def configure(self, values: Mapping[str, Any]) -> None:
        """Apply the parameters that may change at run time."""
        floor_deg = values["noise_stddev"]
        self.noise_floor_rad = 0.0 if math.isnan(floor_deg) else math.radians(floor_deg)

    def reading(
        self,
        angles: tuple[float, ...],
        steps: tuple[float, ...],
        *,
        time_s: float,
        stamp_ns: int,
        sequence: int,
        temperature_c: float,
        flags: int = 0,
        codes: tuple[float, ...] | None = None,
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> Reading:
        """Make the reading of a sensor's own angles (elevations of x, y and perhaps z, rad) and their steps (rad).

        time_s: of a clock that does not step.  codes: what the sensor sent, if not its angles.
        shift: change of S's x and y (rad) if the temperature is 1 sigma off.
        """
        x, y = self.turned(angles)
        if len(angles) != self._axes:
            # A device may leave out its third axis.
            self._axes, self._codes = len(angles), ()
            self.noise.restart()
        if self._is_stuck(angles if codes is None else codes):
            flags |= STUCK
        # For a sensor without z, beyond 90 deg is upside down.
        if max(abs(x), abs(y)) > self.range_rad:
            flags |= OUT_OF_RANGE
        if flags & GAP:
            self.noise.interrupt()
        if not flags & (OUT_OF_RANGE | STUCK | SATURATED):
            self.noise.add_sample(time_s, *angles)
        sigmas = self.noise.sigma or [max(self._usual_noise_rad, step) for step in steps]
        variances = [
            max(s, self.noise_floor_rad) ** 2 + step**2 / 12 for s, step in zip(sigmas, steps, strict=True)
        ]
        xx, xy, yx, yy = self._slopes(angles, (x, y))
        vx, vy, *vz = variances
        dx, dy = shift
        cxy = xx * yx * vx + xy * yy * vy + dx * dy
        return Reading(
            stamp_ns=stamp_ns,
            x=x,
            y=y,
            covariance=(
                xx * xx * vx + xy * xy * vy + dx * dx,
                cxy,
                cxy,
                yx * yx * vx + yy * yy * vy + dy * dy,
            ),
            temperature_c=temperature_c,
            sequence=sequence,
            flags=flags,
            z=angles[2] if vz else math.nan,
            z_variance=vz[0] if vz else math.nan,
        )

    def turned(self, angles: Sequence[float]) -> tuple[float, float]:
        """Elevations of S's x and y from the sensor's own, rad."""
        if self.cross_axis == SQUARE_AXES:
            return angles[0], angles[1]
        xx, xy, yx, yy = self.cross_axis
        sx, sy = math.sin(angles[0]), math.sin(angles[1])
        return _asin(xx * sx + xy * sy), _asin(yx * sx + yy * sy)

    def _slopes(
        self, angles: Sequence[float], turned: tuple[float, float]
    ) -> tuple[float, float, float, float]:
        """Derivatives of S's x and y by the sensor's own, as `cross_axis` has them."""
        xx, xy, yx, yy = self.cross_axis
        # An angle of 90 deg has no slope.
        cx, cy, x, y = (max(math.cos(angle), 0.1) for angle in (*angles[:2], *turned))
        return xx * cx / x, xy * cy / x, yx * cx / y, yy * cy / y

    def _is_stuck(self, codes: tuple[float, ...]) -> bool:
        if not self._codes:
            self._equal = [1] * len(codes)
        else:
            before = zip(codes, self._codes, self._equal, strict=True)
            self._equal = [count + 1 if code == last else 1 for code, last, count in before]
        self._codes = codes
        return 0 < self.stuck <= min(self._equal) or 0 < self._stuck_axis <= max(self._equal)


# Bipolar conversions of the AD7730 are offset binary: 0x000000 at minus full scale, 0x800000 at zero.
CODE_ZERO = 1 << 23
CODE_MAX = (1 << 24) - 1
# The +-80 mV range holds at a 5 V reference (mode register, HIREF = 1) and follows the reference.
ADC_RANGE_V = 0.080
ADC_NOMINAL_REFERENCE_V = 5.0
# The SCA100T's temperature (SPI command RWTR): T = (counts - 197) / -1.083 deg C.
SCA100T_ZERO_COUNTS = 197
SCA100T_COUNTS_PER_C = -1.083

# The 24-bit codes of a working converter have noise of tens of counts. Numbers of equal codes in a row, on one axis and
# on both axes, that are not chance.
SCA100T_STUCK_SAMPLES, SCA100T_STUCK_PAIRS = 10, 3


class BoardSensor(SensorTilts):
    """A sensor on a board of starpos, whose samples hold codes."""

    def __init__(self, values: Mapping[str, Any], *limits: Any) -> None:
        super().__init__(*limits)
        self.temperature = Temperature()
        self.configure(values)

    def configure(self, values: Mapping[str, Any]) -> None:
        super().configure(values)
        self.cross_axis = tuple(values["cross_axis"])

    def measure(self, sample: Sample, time_s: float, stamp_ns: int = 0) -> Reading:
        """Convert a sample taken at `time_s` of a clock that does not step."""
        celsius = self._celsius(sample.temperature)
        if sample.status & SampleStatus.NO_TEMPERATURE:
            celsius = math.nan
        self.temperature.observe(time_s, celsius)
        flags = GAP if sample.lost or sample.broken else 0
        if sample.status & (FAULTS | SampleStatus.SELF_TEST):
            flags |= STUCK
        if sample.status & SampleStatus.UPSIDE_DOWN:
            flags |= OUT_OF_RANGE
        if {sample.x, sample.y} & {0, CODE_MAX}:
            flags |= SATURATED
        angles, steps = self._angles(sample)
        return self.reading(
            angles,
            steps,
            time_s=time_s,
            stamp_ns=stamp_ns,
            sequence=sample.sequence,
            temperature_c=celsius,
            flags=flags,
            codes=(sample.x, sample.y),
            shift=self._shift(sample),
        )

    def _celsius(self, counts: int) -> float:
        """Convert the temperature counts of a sample to deg C."""
        raise NotImplementedError

    def _angles(self, sample: Sample) -> tuple[tuple[float, float], tuple[float, float]]:
        """Elevations of the sensor's own axes, and their steps, rad."""
        raise NotImplementedError

    def _shift(self, sample: Sample) -> tuple[float, float]:
        """Change of the tilt (rad) if the temperature is 1 sigma off."""
        return 0.0, 0.0


class Sca100t(BoardSensor):
    """An SCA100T-D01 behind an AD7730, calibrated by the node's parameters.

    The ADC's AIN(-) and the foot of the divider are at half the reference, which is also the supply of the sensor. So
    the codes do not depend on the supply; the voltages here hold for a supply of reference_volts.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        limits = SCA100T_NOISE_RAD, SCA100T_RANGE_RAD, SCA100T_STUCK_PAIRS, SCA100T_STUCK_SAMPLES
        super().__init__(values, *limits)

    def configure(self, values: Mapping[str, Any]) -> None:
        super().configure(values)
        self._offset_volts, self._sensitivity_volts_per_g = values["offset_volts"], values["sensitivity"]
        self._reference_volts, self._reference_c = values["reference_volts"], values["temperature.reference"]
        full_scale = ADC_RANGE_V * self._reference_volts / ADC_NOMINAL_REFERENCE_V
        # Change of the sensor's output voltage for one code.
        self.volts_per_code = values["divider"] * full_scale / CODE_ZERO
        # With t = T - reference: offset + c1 t + c2 t^2 + c3 t^3 [V], sensitivity (1 + c1 t + c2 t^2 + c3 t^3).
        self._offset_per_c, self._sensitivity_per_c = (
            [values[f"temperature.{name}_{axis}"] for axis in "xy"] for name in ("offset", "sensitivity")
        )

    def volts(self, code: int) -> float:
        return self._reference_volts / 2 + (code - CODE_ZERO) * self.volts_per_code

    def offset_and_sensitivity(self, axis: int, celsius: float) -> tuple[float, float]:
        """Offset (V) and sensitivity (V/g) of an axis at a temperature."""
        t = celsius - self._reference_c
        # A polynomial far outside its fitted range must not reverse the axis.
        share = min(max(1.0 + _cubic(self._sensitivity_per_c[axis], t), 0.5), 2.0)
        offset = self._offset_volts[axis] + _cubic(self._offset_per_c[axis], t)
        return offset, self._sensitivity_volts_per_g[axis] * share

    def _celsius(self, counts: int) -> float:
        return (counts - SCA100T_ZERO_COUNTS) / SCA100T_COUNTS_PER_C

    def _angles(self, sample: Sample) -> tuple[tuple[float, float], tuple[float, float]]:
        x, y = self._angles_at(sample, self.temperature.celsius(self._reference_c))
        # The step of the sine over its slope.
        sx, sy = (
            self.volts_per_code / self._sensitivity_volts_per_g[axis] / max(math.cos(angle), 0.1)
            for axis, angle in enumerate((x, y))
        )
        return (x, y), (sx, sy)

    def _angles_at(self, sample: Sample, celsius: float) -> tuple[float, float]:
        return self._angle(0, sample.x, celsius), self._angle(1, sample.y, celsius)

    def _angle(self, axis: int, code: int, celsius: float) -> float:
        """Elevation of an axis, rad. Beyond +-1 g it has none, and the sample is out of range anyway."""
        offset, sensitivity = self.offset_and_sensitivity(axis, celsius)
        return _asin((self.volts(code) - offset) / sensitivity)

    def _shift(self, sample: Sample) -> tuple[float, float]:
        if not any(map(any, (*self._offset_per_c, *self._sensitivity_per_c))):
            return 0.0, 0.0
        at, sigma = self.temperature.celsius(self._reference_c), self.temperature.stddev_c
        here, low, high = (self.turned(self._angles_at(sample, t)) for t in (at, at - sigma, at + sigma))
        # To the side with the larger change.
        return max(((x - here[0], y - here[1]) for x, y in (low, high)), key=lambda d: math.hypot(*d))


# 90 deg are 2^14 steps of the sensor, each 256 codes.
SCL3300_RAD_PER_CODE = math.radians(90) / (1 << 22)
SCL3300_STEP_RAD = 256 * SCL3300_RAD_PER_CODE
# The board sends TEMP / 16 - 256 of the sensor's T = -273 + TEMP / 18.9 deg C.
SCL3300_ZERO_COUNTS, SCL3300_STEP_C = 256, 16 / 18.9
# The steps are about as large as the noise, so neighbours are often equal on one axis; this many on both are no chance.
SCL3300_STUCK_PAIRS = 50


class Scl3300(BoardSensor):
    """An SCL3300-D01, which measures at any lean."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values, sensors.presets()["scl3300"].noise_rad, math.pi / 2, SCL3300_STUCK_PAIRS)

    def _celsius(self, counts: int) -> float:
        return (counts + SCL3300_ZERO_COUNTS + 0.5) * SCL3300_STEP_C - 273

    def _angles(self, sample: Sample) -> tuple[tuple[float, float], tuple[float, float]]:
        x, y = ((code - CODE_ZERO) * SCL3300_RAD_PER_CODE for code in (sample.x, sample.y))
        return (x, y), (SCL3300_STEP_RAD, SCL3300_STEP_RAD)


def _cubic(coefficients: Sequence[float], t: float) -> float:
    c1, c2, c3 = coefficients
    return t * (c1 + t * (c2 + t * c3))


def _asin(sine: float) -> float:
    return math.asin(min(max(sine, -1.0), 1.0))
