# SPDX-License-Identifier: Apache-2.0
"""What to say of fixes that were made with an A3 that nobody knows."""

import numpy as np

from starpos.instrument.instrument import Calibration

# what to do, in the options of `starpos solve` and in the parameters of the node
BY_OPTIONS = (
    "turn the instrument on the spot and give --self-calibrate, find it at a known place with starpos calibrate "
    "--site, or state it with --misalignment and --misalignment-stddev"
)
BY_PARAMETERS = (
    "turn the instrument on the spot and set self_calibration:=true, find it at a known place with solver/calibrate or "
    "starpos calibrate --site and set calibration_url, or set misalignment and misalignment_stddev"
)


def unknown_a3(calibration: Calibration, covariance: np.ndarray, ways: str = BY_OPTIONS) -> str:
    """Say in a sentence that A3 is not known, and what to do; '' if it is known.

    covariance: of a place, (2, 2) or larger, of east m and north m first.  ways: what to do.
    """
    if not calibration.unknown:
        return ""
    km = float(np.sqrt(np.diag(covariance)[:2].max())) / 1000
    return (
        f"the misalignment of camera and inclinometer is not known, which makes the place {km:.0f} km wide (1 sigma): "
        + ways
    )
