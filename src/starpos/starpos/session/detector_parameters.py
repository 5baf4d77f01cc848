# SPDX-License-Identifier: Apache-2.0
"""Parameters of the node `detector`."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from starpos.frames.driver_stamp import KINDS, UNKNOWN
from starpos.frames.exposure import MAX_EXPOSURE_S
from starpos.frames.shutter import MAX_READOUT_S
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
        "Maximum number of stars published, brightest first; a frame takes time in proportion.",
        unit="",
        minimum=1,
        maximum=100000,
    ),
    Parameter(
        "threads",
        1,
        "Threads that search a frame; more are faster where processors are idle, and slow other programs "
        "where none is.",
        unit="",
        minimum=1,
        maximum=64,
    ),
    Parameter(
        "max_rate",
        math.nan,
        "Maximum rate of the frames that are searched, chosen evenly by their stamps; unset, as many as the "
        "processor can: then all of them, or an even share, which slows other programs.",
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
        "Exposure time of frames that come without a Capture message, 0 unknown: the tilt is averaged over "
        "it, and it gives the middle of an exposure whose start or end is stamped.",
        unit="s",
        minimum=0.0,
        maximum=MAX_EXPOSURE_S,
    ),
    Parameter(
        "stamp",
        UNKNOWN,
        "Moment that the stamps of frames without a Capture message mark: middle, start or end of the "
        "exposure of the row "
        "that is read first, or arrival of the image, after its last row was read; '' unknown: 0.3 s off (1 sigma). "
        "A wrong one shifts longitudes by 15 arcsec for each second.",
        choices=KINDS,
    ),
    Parameter(
        "stamp_stddev",
        math.nan,
        "How far these stamps may be off; 0.1 s is 46 m at the equator. Unset: 0.02 s for middle, start and end, 0.3 s "
        "for arrival and unknown. If too small, fixes claim errors that are too small.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "readout",
        math.nan,
        "From the row of these frames that is read first to the last: positive where the top row is first, negative "
        "where the bottom one is; 0 for a global shutter. Unset: unknown, and fixes include an error of "
        "0.03 s. The wrong sign doubles the error that it should remove.",
        unit="s",
        minimum=-MAX_READOUT_S,
        maximum=MAX_READOUT_S,
    ),
    Parameter(
        "gyro",
        False,
        "Take imu/data, by whose turn rates stars trail: frames with fewer than five stars to learn from are measured "
        "better. A trail that does not fit is left out. Of no effect with use_sim_time: a replay gives the same stars at "
        "any rate.",
        read_only=True,
    ),
    Parameter(
        "calibration_url",
        "",
        "Instrument file (YAML), as the solver's, whose link_to_camera says how the camera sits on the IMU; '' for its "
        "axis along z and the top of the frame forward. Used with gyro; a wrong one is of no use.",
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
