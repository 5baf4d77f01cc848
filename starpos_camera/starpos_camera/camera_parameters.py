# SPDX-License-Identifier: Apache-2.0
"""The parameters of the node `camera`."""

import math
from pathlib import Path
from urllib.parse import unquote, urlsplit

from starpos.errors import InstrumentError
from starpos_common.parameters import Parameter

PARAMETERS = (
    Parameter(
        "source",
        "files",
        "Where frames come from. A simulated sky gives fixes that are not real: never on a working robot.",
        choices=("files", "simulated"),
        read_only=True,
    ),
    Parameter(
        "frame_id",
        "starpos_camera_optical_frame",
        "Frame of the images: x right, y down, z out along the optical axis.",
        read_only=True,
    ),
    Parameter(
        "cadence",
        5.0,
        "From the start of one exposure to the start of the next; shorter than a frame takes, frames are skipped.",
        "s",
        0.01,
        86400.0,
    ),
    Parameter(
        "exposure",
        math.nan,
        "Exposure time; unset takes the source's own (simulated: 0.5 s). Too long trails the stars, too short "
        "leaves too few of them.",
        "s",
        1e-6,
        3600.0,
    ),
    Parameter(
        "gain",
        math.nan,
        "Gain in the camera's own unit; unset leaves it as it is. Too high saturates the bright stars.",
        "",
        0.0,
        1e6,
    ),
    Parameter(
        "calibration_url",
        "",
        "Calibration YAML of the camera (file:///... or a path), written by set_camera_info; without one the "
        "camera is ideal, of focal_mm and pixel_um. One of another lens or frame size gives no fix, or a wrong heading.",
        read_only=True,
    ),
    Parameter(
        "focal_mm",
        600.0,
        "Focal length where there is no calibration; some percent off and no star is identified.",
        "mm",
        0.1,
        100000.0,
    ),
    Parameter(
        "pixel_um",
        6.4,
        "Size of a pixel where there is no calibration; only focal_mm / pixel_um counts.",
        "um",
        0.1,
        1000.0,
    ),
    Parameter(
        "files.path",
        "",
        "Folder of frames (FITS, TIFF, PNG, raw), or a pattern like /nights/1/*.fits; played by name.",
        read_only=True,
    ),
    Parameter("files.loop", False, "Begin again after the last frame.", read_only=True),
    Parameter(
        "files.restamp",
        False,
        "Stamp the frames with the node's clock instead of their own time. For frames without a time; old ones "
        "restamped give a wrong longitude, 15 arcsec for each second.",
        read_only=True,
    ),
    Parameter(
        "simulated.latitude",
        35.7046,
        "Astronomic latitude of the simulated place.",
        "deg",
        -90.0,
        90.0,
    ),
    Parameter(
        "simulated.longitude",
        51.4106,
        "Astronomic longitude of the simulated place, east positive.",
        "deg",
        -180.0,
        360.0,
    ),
    Parameter(
        "simulated.azimuth",
        40.0,
        "Azimuth of the optical axis, clockwise from north.",
        "deg",
        -360.0,
        360.0,
    ),
    Parameter(
        "simulated.altitude",
        78.0,
        "Altitude of the optical axis above the horizon; below 60 deg the inclinometer is out of its range.",
        "deg",
        5.0,
        90.0,
    ),
    Parameter(
        "simulated.roll", 15.0, "Roll about the optical axis; 0: rows are level.", "deg", -360.0, 360.0
    ),
    Parameter(
        "simulated.pressure",
        101325.0,
        "Air pressure of the simulated place; the solver's refraction.pressure has to agree.",
        "Pa",
        0.0,
        120000.0,
    ),
    Parameter(
        "simulated.temperature",
        15.0,
        "Air temperature of the simulated place; the solver's refraction.temperature has to agree.",
        "deg C",
        -100.0,
        80.0,
    ),
    Parameter(
        "simulated.humidity",
        0.5,
        "Relative humidity of the simulated place, 0 to 1; the solver's refraction.humidity has to agree.",
        "",
        0.0,
        1.0,
    ),
    Parameter("simulated.width", 5616, "Width of the simulated frames.", "px", 16, 20000),
    Parameter("simulated.height", 3744, "Height of the simulated frames.", "px", 16, 20000),
    Parameter("simulated.seed", 1, "Seed of the simulated noise.", "", 0, 2**31 - 1, read_only=True),
)


def path_of(url: str) -> Path:
    """The file a `calibration_url` names: file:///a/b.yaml or a path; InstrumentError for anything else."""
    parts = urlsplit(url)
    if not parts.scheme:
        return Path(url).expanduser()
    if parts.scheme != "file" or parts.netloc not in ("", "localhost") or not parts.path:
        raise InstrumentError(f"calibration_url {url!r}: give file:///path/to/camera.yaml, or a path.")
    return Path(unquote(parts.path))
