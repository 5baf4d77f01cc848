# SPDX-License-Identifier: Apache-2.0
"""The sources by their name in the parameter `source`, and the parameters of the node `camera`.

A new camera needs a module in `sources` and a line below.
"""

import math

from starpos.frames.exposure import MAX_READOUT_S
from starpos_camera.sources import timing
from starpos_camera.sources.alpaca import Alpaca
from starpos_camera.sources.aravis import Aravis
from starpos_camera.sources.files import Files
from starpos_camera.sources.gphoto2 import Gphoto2
from starpos_camera.sources.indi import Indi
from starpos_camera.sources.simulated import Simulated
from starpos_camera.sources.source import FrameSource
from starpos_camera.sources.video import Video
from starpos_common.parameters import FRAME_NAME, Parameter

SOURCES: dict[str, type[FrameSource]] = {
    "files": Files,
    "simulated": Simulated,
    "alpaca": Alpaca,
    "aravis": Aravis,
    "gphoto2": Gphoto2,
    "indi": Indi,
    "video": Video,
}


COMMON = (
    Parameter(
        "source",
        "files",
        "Where frames come from. A simulated sky gives fixes that are not real: never on a working robot.",
        choices=tuple(SOURCES),
        read_only=True,
    ),
    Parameter(
        "frame_id",
        "starpos_camera_optical_frame",
        "Frame of the images: x right, y down, z out along the optical axis.",
        read_only=True,
        form=FRAME_NAME,
    ),
    Parameter(
        "cadence",
        5.0,
        "Time from the start of one exposure to the start of the next. If a frame takes longer, "
        "some are skipped.",
        unit="s",
        minimum=0.01,
        maximum=86400.0,
    ),
    Parameter(
        "exposure",
        math.nan,
        "Exposure time; unset takes the source's own (simulated: 0.5 s). Too long trails the stars, too short "
        "leaves too few of them.",
        unit="s",
        minimum=1e-6,
        maximum=3600.0,
    ),
    Parameter(
        "gain",
        math.nan,
        "Gain in the camera's own unit; unset leaves it as it is. Too high saturates the bright stars.",
        unit="",
        minimum=0.0,
        maximum=1e6,
    ),
    Parameter(
        "command_lag",
        0.0,
        "Time from the command to the start of the exposure, for cameras that do not report the "
        "start. Each second that it is set too small moves longitudes 15 arcsec east; a known place "
        "shows that.",
        unit="s",
        minimum=-10.0,
        maximum=60.0,
    ),
    Parameter(
        "command_lag_stddev",
        0.3,
        "Error of command_lag, 1 sigma; 0.1 s is 46 m at the equator. The default is for a camera "
        "whose lag was not measured.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "driver_lag",
        0.0,
        "Time from the start that a driver (INDI, Alpaca) reports to the opening of the shutter: a "
        "driver reports when it sent the command, and a single-lens reflex opens tenths of a second "
        "later. Its error has the same effect as that in command_lag.",
        unit="s",
        minimum=-10.0,
        maximum=60.0,
    ),
    Parameter(
        "driver_lag_stddev",
        0.05,
        "Error of driver_lag, 1 sigma; 0.05 s is 23 m at the equator. If too small, fixes claim "
        "errors that are too small.",
        unit="s",
        minimum=0.0,
        maximum=60.0,
    ),
    Parameter(
        "readout",
        math.nan,
        "Time a rolling shutter takes from the first row to the last: positive if the top row is "
        "read first, negative if the bottom row is; 0 for a global shutter. Unset takes what the "
        "source knows; if it knows nothing, fixes include an error of 0.03 s. The wrong sign "
        "doubles the error that it should remove.",
        unit="s",
        minimum=-MAX_READOUT_S,
        maximum=MAX_READOUT_S,
    ),
    Parameter(
        "readout_stddev",
        0.0,
        "Error of `readout` where it is set, 1 sigma; 0.03 s moves all fixes alike, by some tens of metres.",
        unit="s",
        minimum=0.0,
        maximum=MAX_READOUT_S,
    ),
    Parameter(
        "calibration_url",
        "",
        "Calibration YAML of the camera (file:///... or a path), written by set_camera_info; "
        "without it, an ideal lens with focal_mm and pixel_um. The calibration of another lens or "
        "frame size gives no fix, or a wrong heading.",
        read_only=True,
    ),
    Parameter(
        "focal_mm",
        600.0,
        "Focal length, used without a calibration. If it is wrong by some percent, no star is identified.",
        unit="mm",
        minimum=0.1,
        maximum=100000.0,
    ),
    Parameter(
        "pixel_um",
        6.4,
        "Size of a pixel, used without a calibration; only focal_mm / pixel_um counts.",
        unit="um",
        minimum=0.1,
        maximum=1000.0,
    ),
)
PARAMETERS = (
    *COMMON,
    *timing.PULSE_PARAMETERS,
    *(p for source in SOURCES.values() for p in source.parameters),
)
