# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `detector`."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from starpos.frames.exposure import MAX_EXPOSURE_S, MAX_READOUT_S, STAMPS, UNKNOWN_STAMP
from starpos.session.pace import MAX_RATE
from starpos.session.parameter import Parameter

if TYPE_CHECKING:
    from starpos.detection import DetectionSettings

PARAMETERS = (
    Parameter(
        "threshold",
        5.0,
        "Detection threshold, in standard deviations of the smoothed noise; too low finds noise, too high "
        "loses the faint stars that half of the accuracy comes from.",
        unit="",
        minimum=3.0,
        maximum=1000.0,
    ),
    Parameter(
        "min_snr",
        6.5,
        "Minimum signal-to-noise ratio of a star that is published; too low lets false stars through.",
        unit="",
        minimum=0.0,
        maximum=1000.0,
    ),
    Parameter(
        "max_stars",
        10000,
        "Maximum number of stars published, brightest first. The time a frame takes grows in proportion.",
        unit="",
        minimum=1,
        maximum=100000,
    ),
    Parameter(
        "threads",
        1,
        "Threads that search a frame. More are faster if processors are idle, and slow down other "
        "programs if none is.",
        unit="",
        minimum=1,
        maximum=64,
    ),
    Parameter(
        "max_rate",
        math.nan,
        "Maximum rate of frames that are searched, chosen evenly by their stamps. Unset searches "
        "all frames, or as large an even share as the processor can, which slows down other "
        "programs.",
        unit="Hz",
        minimum=0.01,
        maximum=MAX_RATE,
    ),
    Parameter(
        "saturation",
        math.nan,
        "Pixel value from which a pixel counts as saturated; unset finds it in each frame. If too high, "
        "centroids of saturated stars pass as good.",
        unit="DN",
        minimum=1.0,
        maximum=65535.0,
    ),
    Parameter(
        "exposure",
        0.0,
        "Exposure time of frames that come without a Capture message; 0 is unknown. The tilt is "
        "averaged over it. Where stamps mark start or end, it gives the middle of the exposure.",
        unit="s",
        minimum=0.0,
        maximum=MAX_EXPOSURE_S,
    ),
    Parameter(
        "stamp",
        UNKNOWN_STAMP,
        "Moment that stamps mark in frames without a Capture message: middle, start or end of the "
        "first row's exposure, or arrival of the whole image. '' is unknown, with an error of 0.3 s "
        "(1 sigma). A wrong one shifts longitudes by 15 arcsec for each second.",
        choices=STAMPS,
    ),
    Parameter(
        "stamp_stddev",
        math.nan,
        "Error of these stamps, 1 sigma; 0.1 s is 46 m at the equator. Unset: 0.02 s for middle, "
        "start and end, 0.3 s for arrival and unknown. If too small, fixes claim errors that are "
        "too small.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "readout",
        math.nan,
        "Time a rolling shutter takes from the first row of these frames to the last: positive if "
        "the top row is read first, negative if the bottom row is; 0 for a global shutter. Unset: "
        "unknown, and fixes include an error of 0.03 s. The wrong sign doubles the error that it "
        "should remove.",
        unit="s",
        minimum=-MAX_READOUT_S,
        maximum=MAX_READOUT_S,
    ),
    Parameter(
        "gyro",
        False,
        "Predict the trails of stars from the turn rates in imu/data, so that frames with fewer "
        "than five stars are measured better. A predicted trail that does not fit is not used. "
        "Without effect under use_sim_time, so that a replay gives the same stars at any rate.",
        read_only=True,
    ),
    Parameter(
        "calibration_url",
        "",
        "Instrument file (YAML), as the solver's, whose link_to_camera says how the camera sits on "
        "the IMU; '' means the optical axis along z and the top of the frame forward. Used with "
        "gyro; a wrong one brings no benefit.",
        read_only=True,
    ),
)


def detection_settings(values: Mapping[str, Any]) -> "DetectionSettings":
    """The settings of the detection by the values of these parameters."""
    from starpos.detection import DetectionSettings

    return DetectionSettings(
        threshold=values["threshold"],
        min_snr=values["min_snr"],
        max_stars=values["max_stars"],
        threads=values["threads"],
        saturation_dn=None if math.isnan(values["saturation"]) else values["saturation"],
    )
