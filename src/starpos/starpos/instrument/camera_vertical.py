# SPDX-License-Identifier: Apache-2.0
"""A camera that is fixed to the ground and has no inclinometer: its pose at a known place is its vertical.

It is modelled as an inclinometer that always reads zero and whose Z' is the camera's vertical at the calibration. A3
takes C into it; its drift is the sag of the camera. So calibrations and budgets work as usual.
"""

from dataclasses import dataclass, replace

import numpy as np

from starpos.errors import InstrumentError
from starpos.instrument.inclinometer import EXACT, InclinometerErrors, Tilt
from starpos.units import ARCSEC

# default sag: a camera on a pillar or a heavy tripod during a night
SAG_ARCSEC_PER_SQRT_HOUR, MAX_SAG_ARCSEC = 10.0, 3600.0
# noise of the fictitious reading, rad: negligible
NO_NOISE = 1e-9


@dataclass(frozen=True)
class CameraVertical:
    """Attitude of a fixed camera at its calibration; InstrumentError for impossible values.

    camera_to_itrs      (3, 3): C into ITRS
    covariance_arcsec2  (3, 3) of it as a small rotation about the Earth's axes, by the stars alone
    """

    camera_to_itrs: tuple
    covariance_arcsec2: tuple

    def __post_init__(self) -> None:
        turn, covariance = (np.asarray(m, float) for m in (self.camera_to_itrs, self.covariance_arcsec2))
        rotation = (
            np.isfinite(turn).all()
            and turn.shape == (3, 3)
            and np.abs(turn).max() < 2
            and np.allclose(turn @ turn.T, np.eye(3), atol=1e-6)
            and np.linalg.det(turn) > 0
        )
        if not rotation:
            raise InstrumentError("the vertical's camera_to_itrs must be a 3 x 3 rotation matrix")
        sound = (
            covariance.shape == (3, 3)
            and np.isfinite(covariance).all()
            and np.allclose(covariance, covariance.T)
            and np.linalg.eigvalsh(covariance)[0] >= 0
        )
        if not sound:
            raise InstrumentError(
                "the vertical's covariance_arcsec2 must be a symmetric 3 x 3 matrix without negative variances"
            )


def level_errors(sag_arcsec_per_sqrt_hour: float) -> InclinometerErrors:
    """Errors of a fixed camera as its own level: its sag alone."""
    return replace(EXACT, noise_rad=NO_NOISE, drift_rad_per_sqrt_hour=sag_arcsec_per_sqrt_hour * ARCSEC)


class OwnLevel:
    """The tilts of that level, as `starpos.instrument.tilts.Tilts`: always zero."""

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Zero, read at the middle of the exposure."""
        return Tilt(0.0, 0.0, np.eye(2) * NO_NOISE**2, utc_unix_s=mid_unix_s)


OWN_LEVEL = OwnLevel()
