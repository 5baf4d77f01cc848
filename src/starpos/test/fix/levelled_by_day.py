# SPDX-License-Identifier: Apache-2.0
"""The instrument of drawn frames with two bodies by day: a lens of 900 px before a level that leans by 35 deg."""

from functools import cache

import numpy as np

from starpos.earth.refraction import Atmosphere
from starpos.fix.solver import Solver
from starpos.instrument.inclinometer import InclinometerErrors
from starpos.instrument.instrument import Calibration, Instrument
from starpos.sky.catalogue import load_catalogue

AIR = Atmosphere(pressure_pa=90000.0, temperature_c=15.0, humidity=0.3)
POSE, A3_ARCSEC, FOCAL, SIZE, SIGMA_PX = np.radians(0.01), 30.0, 900.0, (1936, 1216), 0.1
LEANING = -35.0


@cache
def solver() -> Solver:
    instrument = Instrument(
        FOCAL,
        calibration=Calibration.of((LEANING, 0.0, 0.0), (A3_ARCSEC,) * 3),
        inclinometer=InclinometerErrors(
            pose_rad=POSE, quantum_rad=0.0, drift_rad_per_sqrt_hour=0.0, scale=0.0
        ),
        clock_stddev_s=0.02,
    )
    return Solver(instrument, load_catalogue(), AIR)
