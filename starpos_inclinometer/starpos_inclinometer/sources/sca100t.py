# SPDX-License-Identifier: Apache-2.0
"""Angles from ADC codes (AD7730, divider, SCA100T-D01), their covariance, and the faults of a sample.

Sources: data sheets SCA100T series (Murata 8261800 rev. B2), AD7730/AD7730L (Analog Devices rev. A).
"""

import math
from dataclasses import dataclass

from starpos.instrument.inclinometer import (
    SCA100T_NOISE_RAD,
    SCA100T_OFFSET_V,
    SCA100T_RANGE_RAD,
    SCA100T_SENSITIVITY_V_PER_G,
)
from starpos.instrument.noise_tracker import NoiseTracker
from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.reading import GAP, OUT_OF_RANGE, SATURATED, STUCK
from starpos_inclinometer.temperature import Temperature

# Bipolar conversions of the AD7730 are offset binary: 0x000000 at minus full scale, 0x800000 at zero.
CODE_ZERO = 1 << 23
CODE_MAX = (1 << 24) - 1
# The +-80 mV range holds at a 5 V reference (mode register, HIREF = 1) and follows the reference.
ADC_RANGE_V = 0.080
ADC_NOMINAL_REFERENCE_V = 5.0
# 30 kohm to 1 kohm: the whole output, 2.5 +- 2.48 V, on +-80 mV.
DIVIDER = 31.0
# The SCA100T's temperature (SPI command RWTR): T = (counts - 197) / -1.083 deg C.
TEMPERATURE_ZERO_COUNTS = 197
TEMPERATURE_COUNTS_PER_C = -1.083

# The 24-bit codes of a working converter have noise of tens of counts. Numbers of equal codes in a row, on one axis and
# on both axes, that are not chance.
STUCK_SAMPLES, STUCK_PAIRS = 10, 3


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


def temperature_c(counts: int) -> float:
    """Convert the SCA100T's temperature counts to deg C."""
    return (counts - TEMPERATURE_ZERO_COUNTS) / TEMPERATURE_COUNTS_PER_C


def temperature_counts(celsius: float) -> int:
    """Convert deg C to temperature counts, limited to 8 bits."""
    return min(max(round(TEMPERATURE_ZERO_COUNTS + TEMPERATURE_COUNTS_PER_C * celsius), 0), 255)


class Sensor:
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
            measured = temperature_c(sample.temperature)
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
        stuck = max(self._run) >= STUCK_SAMPLES or min(self._run) >= STUCK_PAIRS
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
