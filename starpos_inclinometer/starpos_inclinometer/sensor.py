# SPDX-License-Identifier: Apache-2.0
"""ADC codes to angles: AD7730, divider, SCA100T-D01; and what is wrong with a sample.

Sources: data sheets SCA100T series (Murata 8261800 rev. B2), AD7730/AD7730L (Analog Devices rev. A).
"""

from dataclasses import dataclass

import numpy as np

from starpos.inclinometer import (
    LIMIT_RAD,
    SCA100T_NOISE_RAD,
    SCA100T_OFFSET_V,
    SCA100T_SENSITIVITY_V_PER_G,
    sca100t_angle,
)
from starpos_inclinometer.protocol import Sample, Status

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

# starpos_interfaces/Tilt flags
OUT_OF_RANGE = 1
STUCK = 2
SATURATED = 4
GAP = 8

# 24-bit codes of a living converter have noise of tens of counts: so many equal ones in a row are not chance.
STUCK_SAMPLES = 10


@dataclass(frozen=True)
class Calibration:
    """What lies between the codes and the angles; pairs are (x, y).

    The ADC's AIN(-) and the divider's foot lie at half the reference, which is also the sensor's supply; so
    the codes do not depend on the supply, and the voltages here are those of a supply of reference_volts.
    """

    offset_volts: tuple[float, float] = (SCA100T_OFFSET_V, SCA100T_OFFSET_V)
    sensitivity_volts_per_g: tuple[float, float] = (SCA100T_SENSITIVITY_V_PER_G, SCA100T_SENSITIVITY_V_PER_G)
    divider: float = DIVIDER
    reference_volts: float = ADC_NOMINAL_REFERENCE_V
    noise_rad: float = SCA100T_NOISE_RAD  # white, of one sample

    @property
    def volts_per_code(self) -> float:
        """The sensor's output voltage that one code stands for."""
        full_scale = ADC_RANGE_V * self.reference_volts / ADC_NOMINAL_REFERENCE_V
        return self.divider * full_scale / CODE_ZERO

    def volts(self, code: int) -> float:
        """The sensor's output voltage of an ADC code."""
        return self.reference_volts / 2 + (code - CODE_ZERO) * self.volts_per_code

    def code(self, volts: float) -> int:
        """The inverse of `volts`, limited to what the ADC can say."""
        code = CODE_ZERO + round((volts - self.reference_volts / 2) / self.volts_per_code)
        return min(max(code, 0), CODE_MAX)


@dataclass(frozen=True)
class Reading:
    """A sample in units: x, y rad (always finite), variances rad2, deg C or NaN, flags of Tilt.msg."""

    x: float
    y: float
    variance_x: float
    variance_y: float
    temperature_c: float
    flags: int


def temperature_c(counts: int) -> float:
    """deg C of the SCA100T's temperature counts."""
    return (counts - TEMPERATURE_ZERO_COUNTS) / TEMPERATURE_COUNTS_PER_C


def temperature_counts(celsius: float) -> int:
    """The inverse, limited to 8 bits."""
    return min(max(round(TEMPERATURE_ZERO_COUNTS + TEMPERATURE_COUNTS_PER_C * celsius), 0), 255)


class Sensor:
    """Samples to readings; remembers the codes before, to tell a stuck converter."""

    def __init__(self, calibration: Calibration = Calibration()):
        self.calibration = calibration
        self._last = (-1, -1)
        self._run = [0, 0]

    def measure(self, sample: Sample) -> Reading:
        codes = (sample.x, sample.y)
        flags = GAP if sample.lost or sample.restarted or sample.resumed else 0
        for axis in range(2):
            self._run[axis] = self._run[axis] + 1 if codes[axis] == self._last[axis] else 1
        self._last = codes
        if max(self._run) >= STUCK_SAMPLES or sample.status & (Status.ADC_TIMEOUT | Status.NO_REFERENCE):
            flags |= STUCK
        if any(code in (0, CODE_MAX) for code in codes):
            flags |= SATURATED
        (x, variance_x), (y, variance_y) = self._axis(0, sample.x), self._axis(1, sample.y)
        if max(abs(x), abs(y)) > LIMIT_RAD:
            flags |= OUT_OF_RANGE
        unknown = sample.status & Status.NO_TEMPERATURE
        temperature = float("nan") if unknown else temperature_c(sample.temperature)
        return Reading(x, y, variance_x, variance_y, temperature, flags)

    def _axis(self, axis: int, code: int) -> tuple[float, float]:
        c = self.calibration
        offset, sensitivity = c.offset_volts[axis], c.sensitivity_volts_per_g[axis]
        # Beyond +-1 g there is no angle; the sample is out of range anyway and stays a number.
        volts = min(max(c.volts(code), offset - abs(sensitivity)), offset + abs(sensitivity))
        angle = float(sca100t_angle(volts, offset, sensitivity))
        step = c.volts_per_code / (sensitivity * max(np.cos(angle), 0.1))
        return angle, c.noise_rad**2 + step**2 / 12
