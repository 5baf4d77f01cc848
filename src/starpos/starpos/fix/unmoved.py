# SPDX-License-Identifier: Apache-2.0
"""Detects by the stars alone whether a camera was moved since its calibration."""

import numpy as np

from starpos import rotation
from starpos.earth.ellipsoid import EARTH_RADIUS_M
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.errors import FixError
from starpos.fix.fix import Fix
from starpos.fix.readable import angle_text
from starpos.instrument.instrument import Instrument
from starpos.units import ARCSEC, HOUR_S
from starpos.utc import utc_text

# a camera at rest gets beyond it once in 900 frames
SIGMAS = 4.0


def check_unmoved(fix: Fix, instrument: Instrument, clock_stddev_s: float) -> None:
    """Raise FixError if a camera with a vertical of its own has turned against the Earth since its calibration.

    A camera that was moved looks like one at another place, but not like the same camera at the same place.
    """
    vertical = instrument.vertical
    if vertical is None:
        return
    then = np.asarray(vertical.camera_to_itrs, float)
    turned = fix.camera_to_itrs @ then.T
    since_s = abs(fix.utc_unix_s - instrument.calibration.utc_unix_s)
    sag2 = instrument.inclinometer.drift_rad_per_sqrt_hour**2 * since_s / HOUR_S
    # the air bends the whole field by about as much as it moves the zenith, then and now
    air2 = (
        sum(np.trace(t.covariance[:2, :2]) for t in fix.terms if t.name == "refraction") / EARTH_RADIUS_M**2
    )
    covariance = fix.camera_covariance + np.asarray(vertical.covariance_arcsec2) * ARCSEC**2
    covariance = covariance + np.eye(3) * (sag2 + air2)
    covariance[2, 2] += 2 * (ROTATION_RAD_S * clock_stddev_s) ** 2
    angle = float(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    small = rotation.to_small_vector(turned)
    if angle < 0.5 and small @ np.linalg.solve(covariance, small) <= SIGMAS**2:
        return
    raise FixError(
        f"the camera has moved, by {angle_text(angle)} against the Earth since its calibration of "
        f"{utc_text(instrument.calibration.utc_unix_s)}, where {angle_text(SIGMAS * np.sqrt(sag2))} of sag are allowed "
        "for (or the clock is off): calibrate it again at a known place, or use an inclinometer"
    )
