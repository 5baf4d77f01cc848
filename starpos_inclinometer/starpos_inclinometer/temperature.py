# SPDX-License-Identifier: Apache-2.0
"""The sensor's temperature out of coarse readings, some of which are missing; and how well it is known."""

import math

SMOOTHING_S = 60.0  # the sensor's body warms no faster
STEP_C = 0.92  # of the readings
AGEING_C_PER_S = 2.0 / 60  # how far it may go while nobody reads it
UNKNOWN_STDDEV_C = 40.0  # nothing is known: anywhere from -40 to 125 deg C


class Temperature:
    """Smooths readings that are STEP_C apart, and knows its error, which grows while they are missing."""

    def __init__(self):
        self._value = math.nan
        self._read_s = self._now_s = 0.0

    def add(self, time_s: float, celsius: float):
        """A reading at `time_s` of a clock that does not step; NaN where it is missing."""
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
        """The newest known, or `otherwise` where none is."""
        return otherwise if math.isnan(self._value) else self._value

    @property
    def stddev_c(self) -> float:
        """1 sigma of what `celsius` says."""
        if math.isnan(self._value):
            return UNKNOWN_STDDEV_C
        age_s = max(self._now_s - self._read_s, 0.0)
        return min(math.hypot(STEP_C / math.sqrt(12), AGEING_C_PER_S * age_s), UNKNOWN_STDDEV_C)
