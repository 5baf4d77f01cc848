# SPDX-License-Identifier: Apache-2.0
"""What to say of fixes that were made with an A3 that nobody knows."""

import numpy as np

from starpos.instrument.instrument import Calibration


def unknown_a3(calibration: Calibration, covariance: np.ndarray) -> str:
    """Say in a sentence that A3 is not known, and what to do; '' if it is known.

    covariance: of a place, (2, 2) or larger, of east m and north m first.
    """
    if not calibration.unknown:
        return ""
    km = float(np.sqrt(np.diag(covariance)[:2].max())) / 1000
    return (
        f"the misalignment of camera and inclinometer is not known, which makes the place {km:.0f} km wide (1 sigma): "
        "turn the instrument on the spot and give --self-calibrate, find it at a known place with starpos calibrate "
        "--site, or state it with --misalignment and --misalignment-stddev"
    )
