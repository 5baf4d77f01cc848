# SPDX-License-Identifier: Apache-2.0
"""V4L2 cameras and video files, through OpenCV."""

import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

from starpos_camera.sources.source import CapturedFrame, CaptureSettings, FrameSource
from starpos_camera.sources.timing import read_utc
from starpos_camera.sources.v4l2 import FORMATS, V4l2Device
from starpos_camera.sources.video_file import SUFFIXES, Film
from starpos_common.parameters import Parameter

PARAMETERS = (
    Parameter(
        "video.device",
        "",
        "A V4L2 camera: its number, /dev/videoN, or better a stable path under /dev/v4l/by-id; or a video file "
        f"({', '.join(SUFFIXES)}). Numbers change when cameras are plugged in another order.",
        read_only=True,
    ),
    Parameter(
        "video.format",
        "",
        "Pixel format of a V4L2 camera by its four letters, such as Y16 or RG12; an unknown one is refused with the "
        "list of the known. '' takes OpenCV's first choice. Compressed or 8-bit formats lose faint stars.",
        read_only=True,
    ),
    Parameter(
        "video.width",
        0,
        "Width of a V4L2 camera's frames; it must be one that the camera has. 0: 640.",
        unit="px",
        minimum=0,
        maximum=20000,
        read_only=True,
    ),
    Parameter(
        "video.height",
        0,
        "Height of a V4L2 camera's frames; it must be one that the camera has. 0: 480.",
        unit="px",
        minimum=0,
        maximum=20000,
        read_only=True,
    ),
    Parameter(
        "video.lag",
        math.nan,
        "Time from the middle of an exposure to the kernel's time of the frame; command_lag_stddev "
        "is its error. If unset, a stamp's error covers the exposure and the frame period. "
        "Longitudes err by 15 arcsec for each second that it is wrong.",
        unit="s",
        minimum=-10.0,
        maximum=60.0,
    ),
    Parameter(
        "video.start",
        "",
        "UTC of the start of a video file's first frame, such as 2026-11-02T18:00:00.00, with as "
        "many decimals as are known. Longitudes err by 15 arcsec for each second that it is wrong.",
        read_only=True,
    ),
)


class Video(FrameSource):
    """A live V4L2 camera, or the frames of a video file, one after the other."""

    parameters = PARAMETERS

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        device = values["video.device"]
        if not device or "://" in device:
            return (
                f"video.device must be a V4L2 camera or a video file of this machine, not {device!r}: streams of a "
                "network do not state when a frame was taken."
            )
        if is_camera(device):
            if values["video.format"] and values["video.format"].ljust(4) not in FORMATS:
                known = ", ".join(f.strip() for f in FORMATS)
                return f"video.format must be one of {known}, not {values['video.format']!r}."
            if bool(values["video.width"]) != bool(values["video.height"]):
                return "video.width and video.height must be given together."
            return None
        if Path(device).suffix.lower() not in SUFFIXES:
            return (
                f"video.device must be below /dev, or a video file ({', '.join(SUFFIXES)}), not {device!r}."
            )
        if read_utc(values["video.start"]) is None:
            return (
                "a video file does not state when it was taken: set video.start to the UTC of its first frame, as "
                "2026-11-02T18:00:00.00."
            )
        if settings.exposure_s is not None or settings.gain:
            return "a video file has its own exposure and gain: leave `exposure` and `gain` unset."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        device = values["video.device"]
        # Without a listener the first frames of a file would be played before the detector is ready.
        self.waits_for_listener = not is_camera(device)
        self.hardware_id = f"/dev/video{device}" if device.isdecimal() else str(Path(device).expanduser())
        self._in_use = threading.Lock()
        self._from: V4l2Device | Film = (
            V4l2Device(self.hardware_id, values, now)
            if is_camera(device)
            else Film(self.hardware_id, values["video.start"])
        )

    def lacking(self) -> str | None:
        if not Path(self.hardware_id).exists():
            return f"{self.hardware_id}: it is not there; plug it in, or correct video.device."
        return None

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        with self._in_use:
            return self._from.capture(settings)

    def update(self, values: Mapping) -> None:
        """Do nothing, because parameters that may change are read at each frame."""

    def close(self) -> None:
        self._from.closing = True
        with self._in_use:
            self._from.close()


def is_camera(device: str) -> bool:
    """Whether a device is a camera; otherwise it is a file."""
    return device.isdecimal() or device.startswith("/dev/")
