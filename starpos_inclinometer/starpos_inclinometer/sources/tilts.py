# SPDX-License-Identifier: Apache-2.0
"""Tilts from a sensor's angles or codes, their covariance and their faults.

Sources: data sheets SCA100T series (Murata 8261800 rev. B2), AD7730/AD7730L (Analog Devices rev. A), SCL3300-D01
(Murata Doc. 4921 Rev. 2); PROTOCOL.md says what the board makes of its registers.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from starpos.instrument import sensors
from starpos.instrument.inclinometer import (
    SCA100T_NOISE_RAD,
    SCA100T_OFFSET_V,
    SCA100T_RANGE_RAD,
    SCA100T_SENSITIVITY_V_PER_G,
)
from starpos.instrument.tilt_log import NoiseTracker
from starpos_inclinometer.clock import Moment
from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.source import GAP, OUT_OF_RANGE, SATURATED, STUCK, TIME_UNKNOWN, Reading

# The body of the sensor warms no faster.
SMOOTHING_S = 60.0
# Step from one reading to the next possible one.
READING_STEP_C = 0.92
# How fast the temperature may drift while it is not read.
AGEING_C_PER_S = 2.0 / 60
# Without any reading the temperature may be anywhere from -40 to 125 deg C.
UNKNOWN_STDDEV_C = 40.0


class Temperature:
    """Smooths readings in steps of STEP_C; its error grows while readings are missing."""

    def __init__(self) -> None:
        self._value = math.nan
        self._read_s = self._now_s = 0.0

    def add(self, time_s: float, celsius: float) -> None:
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


# Bipolar conversions of the AD7730 are offset binary: 0x000000 at minus full scale, 0x800000 at zero.
CODE_ZERO = 1 << 23
CODE_MAX = (1 << 24) - 1
# The +-80 mV range holds at a 5 V reference (mode register, HIREF = 1) and follows the reference.
ADC_RANGE_V = 0.080
ADC_NOMINAL_REFERENCE_V = 5.0
# 30 kohm to 1 kohm: the whole output, 2.5 +- 2.48 V, on +-80 mV.
DIVIDER = 31.0
# The SCA100T's temperature (SPI command RWTR): T = (counts - 197) / -1.083 deg C.
SCA100T_ZERO_COUNTS = 197
SCA100T_COUNTS_PER_C = -1.083

# The 24-bit codes of a working converter have noise of tens of counts. Numbers of equal codes in a row, on one axis and
# on both axes, that are not chance.
SCA100T_STUCK_SAMPLES, SCA100T_STUCK_PAIRS = 10, 3


@dataclass(frozen=True, kw_only=True)
class Sca100tCalibration:
    """Calibration from codes to angles; pairs are (x, y).

    The ADC's AIN(-) and the foot of the divider are at half the reference, which is also the supply of the sensor. So
    the codes do not depend on the supply; the voltages here hold for a supply of reference_volts.
    """

    offset_volts: tuple[float, float] = (SCA100T_OFFSET_V, SCA100T_OFFSET_V)
    sensitivity_volts_per_g: tuple[float, float] = (SCA100T_SENSITIVITY_V_PER_G, SCA100T_SENSITIVITY_V_PER_G)
    divider: float = DIVIDER
    reference_volts: float = ADC_NOMINAL_REFERENCE_V
    # (xx, xy, yx, yy): matrix from the g of the sensor's axes to the g of the axes of S.
    cross_axis: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    # With t = T - reference: offset + c1 t + c2 t^2 + c3 t^3 [V], sensitivity (1 + c1 t + c2 t^2 + c3 t^3), for x and y.
    temperature_reference_c: float = 25.0
    offset_per_c: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),) * 2
    sensitivity_per_c: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),) * 2
    # Smallest noise of one sample, even if the samples show less.
    noise_floor_rad: float = 0.0

    @property
    def volts_per_code(self) -> float:
        """Change of the sensor's output voltage for one code."""
        full_scale = ADC_RANGE_V * self.reference_volts / ADC_NOMINAL_REFERENCE_V
        return self.divider * full_scale / CODE_ZERO

    @property
    def compensates(self) -> bool:
        """Whether the temperature matters."""
        return any(any(c) for c in (*self.offset_per_c, *self.sensitivity_per_c))

    def volts(self, code: int) -> float:
        """Convert a code to the sensor's output voltage."""
        return self.reference_volts / 2 + (code - CODE_ZERO) * self.volts_per_code

    def code(self, volts: float) -> int:
        """Convert an output voltage to a code, limited to the range of the converter."""
        code = CODE_ZERO + round((volts - self.reference_volts / 2) / self.volts_per_code)
        return min(max(code, 0), CODE_MAX)

    def offset_and_sensitivity(self, axis: int, temperature_c: float) -> tuple[float, float]:
        """Offset (V) and sensitivity (V/g) of an axis at a temperature."""
        t = temperature_c - self.temperature_reference_c
        share = 1.0 + _cubic(self.sensitivity_per_c[axis], t)
        # A polynomial far outside its fitted range must not reverse the axis.
        share = min(max(share, 0.5), 2.0)
        offset = self.offset_volts[axis] + _cubic(self.offset_per_c[axis], t)
        return offset, self.sensitivity_volts_per_g[axis] * share

    def axis_g(self, axis: int, code: int, temperature_c: float) -> float:
        """Acceleration of an axis in g, limited to +-1; beyond, it has no angle and the sample is out of range anyway."""
        offset, sensitivity = self.offset_and_sensitivity(axis, temperature_c)
        return min(max((self.volts(code) - offset) / sensitivity, -1.0), 1.0)

    def angles(self, gx: float, gy: float) -> tuple[float, float]:
        """Elevation of S's axes above the horizon in rad, from the g of the sensor's axes."""
        xx, xy, yx, yy = self.cross_axis
        return _asin(xx * gx + xy * gy), _asin(yx * gx + yy * gy)


@dataclass(frozen=True, slots=True)
class Measured:
    """A sample in units: x, y rad (always finite), covariance rad2 (xx, xy, yx, yy), deg C or NaN, Tilt.msg's flags."""

    x: float
    y: float
    covariance: tuple[float, float, float, float]
    temperature_c: float
    flags: int


def sca100t_celsius(counts: int) -> float:
    """Convert the SCA100T's temperature counts to deg C."""
    return (counts - SCA100T_ZERO_COUNTS) / SCA100T_COUNTS_PER_C


def sca100t_counts(celsius: float) -> int:
    """Convert deg C to temperature counts, limited to 8 bits."""
    return min(max(round(SCA100T_ZERO_COUNTS + SCA100T_COUNTS_PER_C * celsius), 0), 255)


class Sca100t:
    """Converts the samples of one MCU to tilts; remembers the last codes, the temperature and the noise."""

    def __init__(self, calibration: Sca100tCalibration = Sca100tCalibration()) -> None:
        self.calibration = calibration
        self.noise = NoiseTracker()
        self.temperature = Temperature()
        self._last = (-1, -1)
        self._run = [0, 0]

    def measure(self, sample: Sample, time_s: float) -> Measured:
        """Convert a sample taken at `time_s` of a clock that does not step."""
        flags = self._flags(sample)
        measured = math.nan
        if not sample.status & SampleStatus.NO_TEMPERATURE:
            measured = sca100t_celsius(sample.temperature)
        self.temperature.add(time_s, measured)
        c, at = self.calibration, self.temperature.celsius(self.calibration.temperature_reference_c)
        g = c.axis_g(0, sample.x, at), c.axis_g(1, sample.y, at)
        x, y = c.angles(*g)
        if max(abs(x), abs(y)) > SCA100T_RANGE_RAD:
            flags |= OUT_OF_RANGE
        if flags & GAP:
            self.noise.interrupt()
        if not flags & (OUT_OF_RANGE | STUCK | SATURATED):
            self.noise.add(time_s, math.asin(g[0]), math.asin(g[1]))
        return Measured(x, y, self._covariance(sample, g, (x, y), at), measured, flags)

    def _flags(self, sample: Sample) -> int:
        codes = (sample.x, sample.y)
        flags = GAP if sample.lost or sample.restarted or sample.resumed else 0
        for axis in range(2):
            self._run[axis] = self._run[axis] + 1 if codes[axis] == self._last[axis] else 1
        self._last = codes
        stuck = max(self._run) >= SCA100T_STUCK_SAMPLES or min(self._run) >= SCA100T_STUCK_PAIRS
        if stuck or sample.status & (SampleStatus.NO_ANSWER | SampleStatus.MEANINGLESS):
            flags |= STUCK
        if any(code in (0, CODE_MAX) for code in codes):
            flags |= SATURATED
        return flags

    def _covariance(
        self, sample: Sample, g: tuple[float, float], angles: tuple[float, float], at: float
    ) -> tuple[float, float, float, float]:
        """Covariance from noise and quantisation of each axis, through the cross-axis matrix, and temperature error.

        at: the temperature, deg C.
        """
        c = self.calibration
        noise = self.noise.sigma or (SCA100T_NOISE_RAD, SCA100T_NOISE_RAD)
        step = [c.volts_per_code / c.sensitivity_volts_per_g[axis] for axis in range(2)]
        # Variances of each axis in g^2; the noise of an angle is the noise of g over the cosine.
        vx, vy = (
            max(noise[i], c.noise_floor_rad) ** 2 * (1 - g[i] ** 2) + step[i] ** 2 / 12 for i in range(2)
        )
        kx, ky = (1 / max(math.cos(angle), 0.1) for angle in angles)
        xx, xy, yx, yy = c.cross_axis
        cxx = kx * kx * (xx * xx * vx + xy * xy * vy)
        cxy = kx * ky * (xx * yx * vx + xy * yy * vy)
        cyy = ky * ky * (yx * yx * vx + yy * yy * vy)
        if c.compensates:
            dx, dy = self._temperature_error(sample, at)
            cxx, cxy, cyy = cxx + dx * dx, cxy + dx * dy, cyy + dy * dy
        return cxx, cxy, cxy, cyy

    def _temperature_error(self, sample: Sample, at: float) -> tuple[float, float]:
        """Change of the tilt (rad) if the temperature is 1 sigma off, to the side with the larger change."""
        c, sigma = self.calibration, self.temperature.stddev_c
        here, low, high = (
            c.angles(c.axis_g(0, sample.x, t), c.axis_g(1, sample.y, t)) for t in (at, at - sigma, at + sigma)
        )
        return max(((x - here[0], y - here[1]) for x, y in (low, high)), key=lambda d: math.hypot(*d))


def _cubic(coefficients: tuple[float, float, float], t: float) -> float:
    c1, c2, c3 = coefficients
    return t * (c1 + t * (c2 + t * c3))


def _asin(g: float) -> float:
    return math.asin(min(max(g, -1.0), 1.0))


# 90 deg are 2^14 steps of the sensor, each 256 codes.
SCL3300_RAD_PER_CODE = math.radians(90) / (1 << 22)
SCL3300_STEP_RAD = 256 * SCL3300_RAD_PER_CODE
# The board sends TEMP / 16 - 256 of the sensor's T = -273 + TEMP / 18.9 deg C.
SCL3300_ZERO_COUNTS, SCL3300_STEP_C = 256, 16 / 18.9
# The steps are about as large as the noise, so neighbours are often equal on one axis; this many on both are no chance.
SCL3300_STUCK_PAIRS = 50
SCL3300_FAULTS = SampleStatus.NO_ANSWER | SampleStatus.MEANINGLESS | SampleStatus.SELF_TEST


@dataclass(frozen=True)
class Scl3300Calibration:
    """What the owner found out.

    cross_axis: matrix (xx, xy, yx, yy) from the sines of the sensor's angles to the sines of S's.
    noise_floor_rad: smallest noise of one sample, even if the samples show less.
    """

    cross_axis: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 1.0)
    noise_floor_rad: float = 0.0


def scl3300_celsius(counts: int) -> float:
    """Convert the board's temperature counts to deg C."""
    return (counts + SCL3300_ZERO_COUNTS + 0.5) * SCL3300_STEP_C - 273


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
            measured = scl3300_celsius(sample.temperature)
        self.temperature.add(time_s, measured)
        if flags & GAP:
            self.noise.interrupt()
        felt = [(code - CODE_ZERO) * SCL3300_RAD_PER_CODE for code in (sample.x, sample.y)]
        if not flags & (OUT_OF_RANGE | STUCK):
            self.noise.add(time_s, *felt)
        sx, sy = map(math.sin, felt)
        xx, xy, yx, yy = self.calibration.cross_axis
        x, y = _scl3300_asin(xx * sx + xy * sy), _scl3300_asin(yx * sx + yy * sy)
        sigmas = self.noise.sigma or (sensors.SCL3300.noise_rad,) * 2
        floor = self.calibration.noise_floor_rad
        vx, vy = (max(s, floor) ** 2 + SCL3300_STEP_RAD**2 / 12 for s in sigmas)
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
        if sample.status & SCL3300_FAULTS or self._equal >= SCL3300_STUCK_PAIRS:
            flags |= STUCK
        if sample.status & SampleStatus.UPSIDE_DOWN:
            flags |= OUT_OF_RANGE
        return flags


def _scl3300_asin(sine: float) -> float:
    return math.asin(min(max(sine, -1.0), 1.0))
