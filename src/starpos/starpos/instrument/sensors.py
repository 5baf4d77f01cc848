# SPDX-License-Identifier: Apache-2.0
"""Errors of inclinometers by name, from their data sheets; docs/sensors.md says where each figure stands.

What a sheet states becomes 1 sigma by one rule. A standard deviation, an rms and a typical value count as they are.
Murata's minimum and maximum are 3 sigma, as its sheets say. Another limit (a maximum, "<", the largest deviation from a
straight line) is a uniform distribution: `limit`. A noise density becomes the noise behind a filter of first order:
`rms`.
"""

from dataclasses import replace
from math import pi, radians, sin, sqrt

from starpos.errors import InstrumentError
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.units import ARCSEC

# Rad: an acceleration of 1 mg looks like this tilt.
MG = 1e-3
# Noise bandwidth of a filter of first order, in units of its -3 dB bandwidth: pi / 2.
FIRST_ORDER = 1.57


def limit(most: float) -> float:
    """Standard deviation of a uniform distribution within +-most (GUM, 4.3.7)."""
    return most / sqrt(3)


def rms(density: float, bandwidth_hz: float) -> float:
    """Noise of one reading from its density per sqrt(Hz) and its filter's -3 dB bandwidth."""
    return density * sqrt(FIRST_ORDER * bandwidth_hz)


# Murata SCA100T series, Doc. 8261800 Rev. B2, table 1.2, analogue output at 10 Hz. Temperature, sensitivity, cross axis
# and nonlinearity are from memory of it: only its first page was at hand.
SCA100T = InclinometerErrors(
    # resolution in 10 Hz: 0.0035 deg
    noise_rad=radians(0.0035),
    # estimate: of a converter of 16 bit, as the paper has it
    quantum_rad=radians(0.0005),
    # estimate: not stated
    drift_rad_per_sqrt_hour=2 * ARCSEC,
    # typical 0.008 deg/C, uncompensated
    temperature_rad_per_c=radians(0.008),
    # calibration error of the sensitivity: 0.5 %
    scale=limit(0.005),
    # at most 4 %
    cross=limit(0.04),
    # nonlinearity within its range: 0.11 deg
    pose_rad=limit(radians(0.11)),
    range_rad=radians(30),
)

# Murata SCL3300-D01, Doc. 4921 Rev. 2, table 2, in mode 1 (40 Hz), which alone measures at any lean. Linearity,
# sensitivity and cross axis are the SCA3300-D01's, the same element (Doc. 3165 Rev. 3, table 2).
SCL3300 = InclinometerErrors(
    # estimate: the 0.001 deg/sqrt(Hz) of its product page, in mode 1's 40 Hz
    noise_rad=rms(radians(0.001), 40),
    # 90 deg / 2^14
    quantum_rad=radians(90 / 2**14),
    # estimate: not stated
    drift_rad_per_sqrt_hour=5 * ARCSEC,
    # X, Y: 0.57 deg between 23 and 125 C
    temperature_rad_per_c=radians(0.57) / 3 / 102,
    # 0.7 %
    scale=0.007 / 3,
    # 1 %
    cross=0.01 / 3,
    # linearity within 1 g: 1 mg
    pose_rad=1 * MG / 3,
    range_rad=radians(90),
)

# Analog Devices ADIS16209 Rev. E, table 1, horizontal, with its default filter, the mean of 256 samples.
ADIS16209 = InclinometerErrors(
    # 1.7 mg without a filter
    noise_rad=1.7 * MG / sqrt(256),
    quantum_rad=radians(0.025),
    # estimate: not stated
    drift_rad_per_sqrt_hour=10 * ARCSEC,
    # estimate: its bias stays within 6 mg from 25 to 85 C (figure 14)
    temperature_rad_per_c=limit(6 * MG) / 60,
    # 0.243 to 0.245 mg/LSB
    scale=limit(0.001 / 0.244),
    # typical 2 %
    cross=0.02,
    # relative accuracy within 30 deg: 0.1 deg
    pose_rad=limit(radians(0.1)),
    # the figures hold so far; it measures to 90 deg
    range_rad=radians(30),
)

# Leica Nivel210 and Nivel220, user manual 1.0 of the NIVEL200, section 8.1, in range A.
NIVEL210 = InclinometerErrors(
    # estimate: not stated; one step
    noise_rad=1e-6,
    # resolution 0.001 mrad
    quantum_rad=1e-6,
    # estimate: not stated; one step
    drift_rad_per_sqrt_hour=1e-6,
    # zero-point stability below 0.00471 mrad/C
    temperature_rad_per_c=limit(4.71e-6),
    # scaling error 0.5 %
    scale=limit(0.005),
    # orthogonal error below 2 deg
    cross=limit(sin(radians(2))),
    # standard deviation 0.0047 mrad, and 0.00204 mrad of equipoise
    pose_rad=sqrt(4.7e-6**2 + 2.04e-6**2),
    range_rad=1.51e-3,
)

# Bosch BMI088 accelerometer, BST-BMI088-DS001-14 Rev. 1.4, table 4, within 3 g, 100 Hz with OSR4 (10 Hz, table 8).
BMI088 = InclinometerErrors(
    # 190 ug/sqrt(Hz) of Z, the worst
    noise_rad=rms(0.19 * MG, 10),
    # 10920 LSB/g
    quantum_rad=1 / 10920,
    # estimate: not stated
    drift_rad_per_sqrt_hour=20 * ARCSEC,
    # below 0.2 mg/K
    temperature_rad_per_c=limit(0.2 * MG),
    # estimate: not stated; the 1 % of its gyroscope (table 5)
    scale=limit(0.01),
    # 0.5 %
    cross=0.005,
    # estimate: 0.5 % of 3 g; a curve of second order leaves a ninth of it within 1 g
    pose_rad=limit(15 * MG / 9),
    range_rad=radians(90),
)

# Murata SCA3300-D01, Doc. 3165 Rev. 3, table 2, in mode 1 (3 g, 70 Hz), which the kernel's driver leaves it in.
SCA3300 = InclinometerErrors(
    # 37 ug/sqrt(Hz)
    noise_rad=rms(0.037 * MG, 70),
    # 2700 LSB/g
    quantum_rad=1 / 2700,
    # estimate: not stated
    drift_rad_per_sqrt_hour=5 * ARCSEC,
    # X, Y: 10 mg between 23 and 125 C, as the SCL3300's 0.57 deg
    temperature_rad_per_c=10 * MG / 3 / 102,
    # 0.7 %
    scale=0.007 / 3,
    # 1 %
    cross=0.01 / 3,
    # linearity within 1 g: 1 mg
    pose_rad=1 * MG / 3,
    range_rad=radians(90),
)

# Analog Devices ADXL355, data sheet ADXL354/ADXL355 Rev. B, table 2, within 2 g, 125 Hz (31.25 Hz). Its sheet was not at
# hand: all but the noise density is from memory of it.
ADXL355 = InclinometerErrors(
    # 22.5 ug/sqrt(Hz)
    noise_rad=rms(0.0225 * MG, 31.25),
    # 256000 LSB/g
    quantum_rad=1 / 256000,
    # estimate: not stated
    drift_rad_per_sqrt_hour=5 * ARCSEC,
    # below 0.15 mg/C
    temperature_rad_per_c=limit(0.15 * MG),
    # 235520 to 276480 LSB/g
    scale=limit(0.08),
    # 1 %
    cross=0.01,
    # nonlinearity 0.1 % of 2 g; a curve of second order leaves a quarter of it within 1 g
    pose_rad=limit(2 * MG / 4),
    range_rad=radians(90),
)

# the SCA100T with a good converter, compensated for temperature and calibrated by its owner; each figure is an estimate
# of the remaining error
SCA100T_CALIBRATED = InclinometerErrors()

# default if neither inclinometer nor errors are stated: a sensor as sold, at any lean
UNNAMED = replace(SCA100T, range_rad=pi / 2)

PRESETS = {
    "sca100t": SCA100T,
    "sca100t_calibrated": SCA100T_CALIBRATED,
    "scl3300": SCL3300,
    "adis16209": ADIS16209,
    "nivel210": NIVEL210,
    "bmi088": BMI088,
    "sca3300": SCA3300,
    "adxl355": ADXL355,
}


def find(model: str) -> tuple[str, InclinometerErrors]:
    """Name among PRESETS and errors of a model in any case; '' gives '' and UNNAMED.

    Raises InstrumentError with the names for an unknown one.
    """
    name = model.strip().lower()
    if not name:
        return "", UNNAMED
    if name not in PRESETS:
        raise InstrumentError(
            f"the inclinometer's model {model[:40]!r} is not known: the models are {', '.join(PRESETS)}; "
            "for another sensor state its errors (tilt_noise_deg and the others) in the instrument file"
        )
    return name, PRESETS[name]
