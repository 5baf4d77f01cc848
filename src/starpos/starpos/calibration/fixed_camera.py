# SPDX-License-Identifier: Apache-2.0
"""The vertical of a camera that is fixed to the ground, from frames at a known place and no inclinometer."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from starpos import rotation
from starpos.averaging.slip import poses_of
from starpos.calibration.misalignment import NOTHING_KNOWN, Calibrated, Known, calibrate_at
from starpos.errors import FixError
from starpos.fix.solver import Solver
from starpos.frames.pointings import Pointing
from starpos.frames.stars import Stars
from starpos.instrument.camera_vertical import (
    OWN_LEVEL,
    SAG_ARCSEC_PER_SQRT_HOUR,
    CameraVertical,
    level_errors,
)
from starpos.progress import Progress, quiet
from starpos.sky.site import Site
from starpos.units import ARCSEC

# the level that the camera is for itself has no direction to face
TURN_DEG = 1e-3


def calibrate_fixed(
    solver: Solver,
    frames: Sequence[Stars | Pointing],
    site: Site,
    site_stddev_arcsec: float = 0.0,
    sag_arcsec_per_sqrt_hour: float = SAG_ARCSEC_PER_SQRT_HOUR,
    progress: Progress = quiet,
    known: Known = NOTHING_KNOWN,
) -> Calibrated:
    """The instrument with the camera's own vertical, from frames of a camera at rest at a known astronomic place.

    known: the stars of frames, as `calibrate_at` has them.
    Raises FixError if there is no fix, the frames do not agree, or the camera was touched between them.
    """
    level = level_errors(sag_arcsec_per_sqrt_hour)
    bare = replace(
        solver,
        instrument=replace(solver.instrument, inclinometer=level, inclinometer_model="", vertical=None),
    )
    found = calibrate_at(bare, frames, OWN_LEVEL, site, site_stddev_arcsec, TURN_DEG, progress, known)
    fixes = found.fixes
    if poses_of(fixes).any():
        raise FixError(
            "the camera was touched between the frames, or their clock was set: give frames of a camera "
            "that nothing moved"
        )
    attitudes = np.array([f.camera_to_itrs for f in fixes])
    mean = rotation.best_rotation(
        np.tile(np.eye(3), (len(fixes), 1)), np.concatenate(attitudes.swapaxes(1, 2))
    )
    covariance = np.mean([f.camera_covariance for f in fixes], axis=0) / ARCSEC**2
    vertical = CameraVertical(*(tuple(map(tuple, m.tolist())) for m in (mean, covariance)))
    # a level that always reads zero has no response
    calibration = replace(found.instrument.calibration, response=(), response_covariance=())
    return replace(
        found,
        instrument=replace(found.instrument, calibration=calibration, inclinometer=level, vertical=vertical),
    )
