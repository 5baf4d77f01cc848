# SPDX-License-Identifier: Apache-2.0
"""Temperature of the sensor and its error, from coarse readings of which some are missing."""

import math

# The body of the sensor warms no faster.
SMOOTHING_S = 60.0
# Step from one reading to the next possible one.
STEP_C = 0.92
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
        return min(math.hypot(STEP_C / math.sqrt(12), AGEING_C_PER_S * age_s), UNKNOWN_STDDEV_C)
