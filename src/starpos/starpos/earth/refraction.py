# SPDX-License-Identifier: Apache-2.0
"""Refraction in the local level L, where the tilt gives the zenith distance.

The paper puts aberration in the same place; docs/the_paper.md#matrix-a2 says where it is here.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import erfa
import numpy as np

from starpos.earth._air import Refraction
from starpos.errors import InstrumentError

STANDARD_PRESSURE_PA = 101_325.0
STANDARD_TEMPERATURE_C = 15.0
# from the highest mountain to the lowest shore; hPa given as Pa, or Pa as hPa, lie outside
MIN_PRESSURE_PA, MAX_PRESSURE_PA = 30_000.0, 120_000.0
# ERFA's own limit: below 3 deg of altitude the two-constant model has no meaning.
MIN_COS_ZENITH = 0.05
# True altitude below which that model is off by arcseconds, and more and more; what refraction at the horizon changes by
# from day to day, and how large it is; rad.
LOW, LAYERS, AT_HORIZON = math.radians(10.0), math.radians(0.16), math.radians(29 / 60)


@dataclass(frozen=True, kw_only=True)
class Atmosphere:
    """The air at the instrument and how well it is known (1 sigma); InstrumentError for impossible values.

    Attributes
    ----------
    pressure_pa, pressure_stddev_pa : Pa, not reduced to sea level; 0: a vacuum
    temperature_c, temperature_stddev_c : deg C
    humidity, humidity_stddev : relative, from 0 to 1
    wavelength_um, wavelength_stddev_um : um, of the light that the camera sees

    Examples
    --------
    >>> air = starpos.Atmosphere(pressure_pa=88_000.0, temperature_c=12.0)
    >>> bool(air.relative_sigma > 0)
    True
    """

    pressure_pa: float = STANDARD_PRESSURE_PA
    temperature_c: float = STANDARD_TEMPERATURE_C
    humidity: float = 0.5
    wavelength_um: float = 0.55
    pressure_stddev_pa: float = 200.0
    temperature_stddev_c: float = 2.0
    humidity_stddev: float = 0.25
    wavelength_stddev_um: float = 0.08

    def __post_init__(self) -> None:
        if self.pressure_pa != 0 and not MIN_PRESSURE_PA <= self.pressure_pa <= MAX_PRESSURE_PA:
            raise InstrumentError(
                f"pressure {self.pressure_pa:g} Pa ({self.pressure_pa / 100:g} hPa): must lie between "
                f"{MIN_PRESSURE_PA:.0f} and {MAX_PRESSURE_PA:.0f} Pa ({MIN_PRESSURE_PA / 100:.0f} and "
                f"{MAX_PRESSURE_PA / 100:.0f} hPa), or be 0 for a vacuum"
            )
        checks = (
            ("temperature", self.temperature_c, -100.0, 80.0, "deg C"),
            ("humidity", self.humidity, 0.0, 1.0, ""),
            ("wavelength", self.wavelength_um, 0.2, 10.0, "um"),
        )
        for name, value, low, high, unit in checks:
            if not low <= value <= high:
                raise InstrumentError(
                    f"{name} {value} {unit}: must lie between {low:g} and {high:g} {unit}".rstrip()
                )

    @classmethod
    def measured(
        cls,
        pressure_pa: float | None,
        temperature_c: float | None,
        humidity: float | None = None,
        wavelength_um: float | None = None,
    ) -> "Atmosphere":
        """The air as far as it was measured, and the mean wavelength of the light that the camera sees.

        An unknown pressure or temperature (None) becomes a middle value with a sigma that covers sea level to 3000 m, or
        frost to summer; an unknown humidity or wavelength one that covers dry to damp, or the filters of cameras.
        """
        return cls(
            pressure_pa=90_000.0 if pressure_pa is None else pressure_pa,
            temperature_c=10.0 if temperature_c is None else temperature_c,
            humidity=0.3 if humidity is None else humidity,
            wavelength_um=0.55 if wavelength_um is None else wavelength_um,
            humidity_stddev=0.25 if humidity is None else 0.05,
            wavelength_stddev_um=0.08 if wavelength_um is None else 0.02,
            pressure_stddev_pa=9_000.0 if pressure_pa is None else 200.0,
            temperature_stddev_c=12.0 if temperature_c is None else 2.0,
        )

    @cached_property
    def relative_sigma(self) -> float:
        """Standard deviation of the refraction over the refraction, which is proportional to pressure / temperature."""
        if self.pressure_pa == 0:
            return 0.0
        here = self.refraction().a
        # steps to the side where the model has values
        drier = replace(self, humidity=abs(self.humidity - self.humidity_stddev)).refraction().a
        redder = replace(self, wavelength_um=self.wavelength_um + self.wavelength_stddev_um).refraction().a
        parts = (
            self.pressure_stddev_pa / self.pressure_pa,
            self.temperature_stddev_c / (self.temperature_c + 273.15),
            drier / here - 1,
            redder / here - 1,
        )
        return float(np.linalg.norm(parts))

    def refraction(self, factor: float = 1.0) -> Refraction:
        """The model, with its bending multiplied by `factor` (1, or a step for a derivative)."""
        a, b = self._constants
        return Refraction(a * factor, b * factor, MIN_COS_ZENITH)

    def raised(self, true: np.ndarray) -> tuple[np.ndarray, float]:
        """An unrefracted direction (3,) in L as it is seen, down to the horizon, and the error of its altitude, rad.

        Below LOW by Saemundsson's formula (1986, Sky and Telescope 72, 70), from where ERFA's ends.  There the layers of
        the air count: at the horizon they change by LAYERS (Schaefer and Liller 1990, PASP 102, 796).
        """
        altitude = math.asin(true[2])
        if altitude >= LOW or self.pressure_pa == 0:
            bent = self.refraction().bend(true)
            return bent, math.dist(bent, true) * self.relative_sigma
        low = np.array([math.cos(LOW), 0.0, math.sin(LOW)])
        size = math.dist(self.refraction().bend(low), low) * _saemundsson(altitude) / _saemundsson(LOW)
        level = true[:2] / math.hypot(*true[:2]) * math.cos(altitude + size)
        layers = LAYERS * (size / AT_HORIZON) ** 3
        return np.array([*level, math.sin(altitude + size)]), math.hypot(size * self.relative_sigma, layers)

    @cached_property
    def _constants(self) -> tuple[float, float]:
        a, b = erfa.refco(self.pressure_pa / 100, self.temperature_c, self.humidity, self.wavelength_um)
        return float(a), float(b)


def _saemundsson(altitude: float) -> float:
    """Refraction of a true altitude, rad, over a constant."""
    degrees = math.degrees(altitude)
    return 1 / math.tan(math.radians(degrees + 10.3 / (degrees + 5.11)))
