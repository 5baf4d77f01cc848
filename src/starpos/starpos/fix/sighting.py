# SPDX-License-Identifier: Apache-2.0
"""What one frame says: its time, the camera's attitude against the Earth by what it sees, the reading of the level."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from starpos.earth.orientation import station_velocity
from starpos.fix.attitude import CAMERA, ITRS, Attitude
from starpos.fix.budget import Circumstances
from starpos.fix.star_fit import StarFit
from starpos.frozen import at_once
from starpos.instrument.inclinometer import Tilt
from starpos.units import ARCSEC


@at_once
@dataclass(frozen=True, eq=False, kw_only=True)
class Sighting:
    """What one frame says, whatever it sees.

    utc_unix_s: middle of the exposure, of the row that is read first.
    camera: attitude of the camera against the Earth (C into ITRS) by the directions that it sees alone.
    stamp_stddev_s, clock_stddev_s: of the frame's time stamp, and of the clock that made it, s.
    tilt: what the level reads; None without a level.
    """

    utc_unix_s: float
    camera: Attitude
    source: str = ""
    stamp_stddev_s: float = 0.0
    clock_stddev_s: float = 0.0
    tilt: Tilt | None = None


@at_once
@dataclass(frozen=True, kw_only=True)
class FittedSighting(Sighting):
    """A sighting whose stars were fitted under a level, known or by a known place.

    used (M,): rows of the given stars that were kept; residual_px (M, 2): their fitted places minus their seen places.
    jitter_px: scatter of the stars beyond the centroids' own errors (seeing, optics).
    focal_scale: factor on the given focal length.
    zenith_distance: of the optical axis, rad.
    """

    used: np.ndarray
    residual_px: np.ndarray
    residual_arcsec: float
    jitter_px: float
    focal_scale: float
    zenith_distance: float
    refraction_arcsec: float
    diurnal_aberration_arcsec: float
    ut1_minus_utc_s: float


def seen_fields(about: Circumstances, g: np.ndarray, a4: np.ndarray, own: np.ndarray) -> dict[str, Any]:
    """The fields of a FittedSighting whatever is seen, without stars; g (3, 3): C into L, a4 (3, 3): ITRS into L.

    own (3, 3): covariance in rad2, about L's axes, of the errors of what this frame sees.
    """
    earth, axis = about.earth, g @ about.camera.centre_ray
    return {
        "utc_unix_s": earth.utc_unix_s,
        "clock_stddev_s": about.clock_stddev_s,
        "stamp_stddev_s": about.stamp_stddev_s,
        "camera": Attitude(a4.T @ g, a4.T @ own @ a4, of=CAMERA, into=ITRS),
        "zenith_distance": math.acos(min(max(axis[2], -1.0), 1.0)),
        "refraction_arcsec": math.dist(axis, about.atmosphere.refraction().unbend(axis)) / ARCSEC,
        "diurnal_aberration_arcsec": math.hypot(*station_velocity(a4[2])) / ARCSEC,
        "ut1_minus_utc_s": earth.orientation.ut1_minus_utc_s,
        "used": np.zeros(0, int),
        "residual_px": np.zeros((0, 2)),
        "jitter_px": 0.0,
        "focal_scale": 1.0,
    }


def fitted_fields(seen: StarFit, about: Circumstances, g: np.ndarray, a4: np.ndarray) -> dict[str, Any]:
    """The fields of a FittedSighting that a fit of stars gives; g, a4 as of `seen_fields`."""
    return seen_fields(about, g, a4, seen.own) | {
        "used": np.flatnonzero(seen.fit.keep),
        "residual_px": seen.residual,
        "residual_arcsec": seen.residual_px * about.camera.scale_arcsec,
        "jitter_px": math.sqrt(seen.fit.jitter2),
        "focal_scale": seen.fit.scale,
    }
