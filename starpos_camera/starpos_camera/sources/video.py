# SPDX-License-Identifier: Apache-2.0
"""V4L2 cameras, through OpenCV.

The sensor's own pixels are taken if the camera sends them, and the kernel's time of each frame. OpenCV's V4L2 backend
(tried: 4.6 and 5.0) gives the kernel's buffer time as CAP_PROP_POS_MSEC. With CAP_PROP_CONVERT_RGB at 0 it gives the
buffer itself, in the shape of its format or as plain bytes. It waits at most 10 s for a frame. Exposure is
V4L2_CID_EXPOSURE_ABSOLUTE, in 100 us, if the menu of auto exposure is at 1. OpenCV does not report that a buffer is
short, but the kernel's uvcvideo drops such frames (its parameter nodrop is 0).
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from starpos.frames.exposure import MAX_READOUT_S, Shutter
from starpos.frames.frame import MAX_PIXELS, Frame
from starpos.frames.pictures import quiet_opencv
from starpos.system_clock import both_clocks
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource, decoded
from starpos_camera.sources.timing import dated
from starpos_interfaces.msg import Capture

if TYPE_CHECKING:
    from cv2 import VideoCapture


EXPOSURE_UNIT_S = 1e-4
# V4L2_EXPOSURE_MANUAL
MANUAL = 1
# V4L2_EXPOSURE_AUTO, V4L2_EXPOSURE_APERTURE_PRIORITY.
AUTOMATIC = (0, 3)
MAX_EXPOSURE_S = 60.0
# Number of frames that a camera may still take with the old settings.
SETTLE_FRAMES = 4
# Longest wait besides the time of the frames themselves.
MAX_WAIT_S = 10.0
# Frames per second if the driver reports none; a low value is the cautious one.
DEFAULT_RATE = 5.0
MAX_AGE_S = 600.0
# In these formats all Y come first, and half as many bytes of colour follow.
PLANAR = ("NV12", "NV21", "YU12", "YV12")
JPEG = ("MJPG", "JPEG")
# The formats that are read, by V4L2's four letters, and their encodings.
FORMATS = (
    {"GREY": "mono8", "Y16 ": "mono16", "Y12 ": "mono16", "Y10 ": "mono16", "BGR3": "bgr8", "RGB3": "rgb8"}
    | {"YUYV": "yuyv", "YVYU": "yuyv", "UYVY": "uyvy", "VYUY": "uyvy"}
    | dict.fromkeys(PLANAR, "mono8")
    | {
        letters: f"bayer_{pattern}{16 if deep else 8}"
        # of 8, 10, 12 and 16 bits
        for pattern, family in {
            "rggb": ("RGGB", "RG10", "RG12", "RG16"),
            "bggr": ("BA81", "BG10", "BG12", "BYR2"),
            "grbg": ("GRBG", "BA10", "BA12", "GR16"),
            "gbrg": ("GBRG", "GB10", "GB12", "GB16"),
        }.items()
        for deep, letters in enumerate(family)
    }
    | dict.fromkeys(JPEG, "")
)


class Video(DeviceSource["VideoCapture"]):
    """Keeps the camera streaming; `capture` returns the first frame that was exposed after the call."""

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        device = values["video.device"]
        if not (device.isdecimal() or device.startswith("/dev/")):
            return (
                f"video.device must be a V4L2 camera of this machine, below /dev, not {device!r}: video files and "
                "streams of a network do not state when a frame was taken."
            )
        if values["video.format"] and values["video.format"].ljust(4) not in FORMATS:
            known = ", ".join(f.strip() for f in FORMATS)
            return f"video.format must be one of {known}, not {values['video.format']!r}."
        if bool(values["video.width"]) != bool(values["video.height"]):
            return "video.width and video.height must be given together."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        device = values["video.device"]
        self.hardware_id = f"/dev/video{device}" if device.isdecimal() else device
        self._format, self._size = "", (0, 0)
        # Exposure and gain that were set last.
        self._set: tuple[float | None, float | None] | None = None
        # Frames before this steady time have other settings.
        self._not_before_s = 0.0

    def lacking(self) -> str | None:
        if not Path(self.hardware_id).exists():
            return f"{self.hardware_id}: it is not there; plug it in, or correct video.device."
        return None

    def _expose(self, device: "VideoCapture", settings: CaptureSettings) -> CapturedFrame:
        with quiet_opencv() as cv2:
            exposure_s, remark = self._settings(cv2, device, settings)
            mid_s, stddev_s, stamp = self._grab(cv2, device, exposure_s)
            period_s = _period_s(cv2, device)
            came, raw = device.retrieve()
            if not came:
                raise CaptureError("it gave no frame.")
            pixels, pattern = self._pixels(cv2, raw)
        # from either end, and no longer than from one frame to the next
        shutter = Shutter(0.0, min(period_s, MAX_READOUT_S) / math.sqrt(3))
        frame = Frame(pixels, pattern=pattern, exposure_s=exposure_s, shutter=shutter)
        return replace(dated(frame, mid_s, stddev_s, stamp), remark=remark)

    def _explain(self, error: Exception) -> str:
        return " ".join(f"{type(error).__name__}: {error}.".split())

    def _open(self) -> "VideoCapture":
        with quiet_opencv() as cv2:
            return self._opened(cv2)

    def _opened(self, cv2: ModuleType) -> "VideoCapture":
        capture = cv2.VideoCapture(self.hardware_id, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise CaptureError(
                "it cannot be opened as a camera; it is unplugged, in use, or not yours (be in the group video)."
            )
        self._set = None
        # Controls are in the driver's units, whatever the environment says.
        capture.set(cv2.CAP_PROP_MODE, 0)
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        wanted = self._values["video.format"].ljust(4) if self._values["video.format"] else ""
        if wanted:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*wanted))
        size = self._values["video.width"], self._values["video.height"]
        if size[0]:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        self._format = (
            (int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little").decode("latin-1")
        )
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        self._size = width, height
        if self._format not in FORMATS or (wanted and self._format != wanted):
            raise CaptureError(
                f"it sends {self._format!r}, not {wanted or 'a known format'}; set video.format."
            )
        if min(width, height) < 1 or width * height > MAX_PIXELS or (size[0] and size != (width, height)):
            raise CaptureError(
                f"it has frames of {width} x {height} px; correct video.width and video.height."
            )
        return capture

    def _settings(
        self, cv2: ModuleType, capture: "VideoCapture", settings: CaptureSettings
    ) -> tuple[float | None, str]:
        """Make the settings; return the exposure as the driver reports it (s, None unknown), and a remark."""
        remark = ""
        if self._set != (settings.exposure_s, settings.gain):
            if settings.exposure_s is not None:
                capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
                capture.set(cv2.CAP_PROP_EXPOSURE, max(1, round(settings.exposure_s / EXPOSURE_UNIT_S)))
            if settings.gain is not None:
                capture.set(cv2.CAP_PROP_GAIN, settings.gain)
            self._set = settings.exposure_s, settings.gain
            self._not_before_s = time.monotonic() + SETTLE_FRAMES * _period_s(cv2, capture)
        units = capture.get(cv2.CAP_PROP_EXPOSURE)
        told = 0 < units <= MAX_EXPOSURE_S / EXPOSURE_UNIT_S
        told = told and capture.get(cv2.CAP_PROP_AUTO_EXPOSURE) not in AUTOMATIC
        exposure_s = units * EXPOSURE_UNIT_S if told else None
        if settings.exposure_s is not None:
            if exposure_s is None:
                raise CaptureError("its driver does not let its exposure be set; leave `exposure` unset.")
            if abs(exposure_s - settings.exposure_s) > max(EXPOSURE_UNIT_S, 0.01 * settings.exposure_s):
                remark = f"it exposes for {exposure_s:g} s, not for {settings.exposure_s:g} s."
        if settings.gain is not None and (gain := capture.get(cv2.CAP_PROP_GAIN)) != settings.gain:
            if gain < 0:
                raise CaptureError("its driver does not let its gain be set; leave `gain` unset.")
            remark = f"its gain is {gain:g}, though {settings.gain:g} was set."
        return exposure_s, remark

    def _grab(
        self, cv2: ModuleType, capture: "VideoCapture", exposure_s: float | None
    ) -> tuple[float, float, int]:
        """Grab a frame for `retrieve`; return its middle, its standard deviation (s) and the source of the stamp."""
        asked_s = max(time.monotonic(), self._not_before_s)
        buffers = int(capture.get(cv2.CAP_PROP_BUFFERSIZE))
        stale = buffers if 1 <= buffers <= 32 else 4
        period_s = max(_period_s(cv2, capture), exposure_s or 0.0)
        end_s = asked_s + MAX_WAIT_S + (stale + SETTLE_FRAMES) * period_s
        before_s: float | None = None
        apart_s: list[float] = []
        unstamped = 0
        while time.monotonic() < end_s and not self._closing.is_set():
            if not capture.grab():
                raise CaptureError("it gives no frame; check its plug.")
            now_s, steady_s = both_clocks(self._now)
            stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            # Drivers stamp with one clock or the other.
            age_s = min(steady_s - stamp_s, time.time() - stamp_s, key=abs)
            stamped = stamp_s > 0 and -0.1 < age_s < MAX_AGE_S
            if not stamped:
                age_s, unstamped = 0.0, unstamped + 1
            at_s = steady_s - age_s
            if before_s is not None:
                # In the dark a camera may be slower than it says. After a late read the next one looks early.
                apart_s.append(at_s - before_s)
                frame_s = min(apart_s) if stamped else max(apart_s)
                lag_s, stddev_s, latest_s = self._lag(exposure_s, max(period_s, frame_s))
                # Without stamps: skip the buffers that were filled before, and the one that was being filled.
                if at_s - latest_s >= asked_s and (stamped or unstamped > stale + 1):
                    return now_s - age_s - lag_s, stddev_s, Capture.HARDWARE if stamped else Capture.DRIVER
            before_s = at_s
        if self._closing.is_set():
            raise CaptureError("the node ends.")
        raise CaptureError(
            "it gives frames, but none that was exposed after it was asked for; its clock is wrong."
        )

    def _lag(self, exposure_s: float | None, period_s: float) -> tuple[float, float, float]:
        """Time from an exposure's middle to its stamp, its standard deviation, and the longest from its start (s)."""
        # An unknown exposure is no longer than the period.
        exposed_s = exposure_s or period_s
        lag_s = self._values["video.lag"]
        if not math.isnan(lag_s):
            return lag_s, self._values["command_lag_stddev"], lag_s + exposed_s / 2
        # Drivers stamp the start of the exposure, its end, or the end of the transfer, one period later at most.
        return period_s / 2, (period_s + exposed_s) / math.sqrt(12), period_s + exposed_s

    def _pixels(self, cv2: ModuleType, raw: np.ndarray) -> tuple[np.ndarray, str]:
        """Convert a buffer to pixels and the pattern of their mosaic; CaptureError if it is incomplete."""
        width, height = self._size
        # A copy, because OpenCV's memory may be the driver's.
        data = raw.tobytes()
        if self._format in JPEG:
            return _from_jpeg(cv2, data, width, height), ""
        colours = width * height // 2 if self._format in PLANAR else 0
        return decoded(FORMATS[self._format], data, self._size, colours)


def _period_s(cv2: ModuleType, capture: "VideoCapture") -> float:
    rate = capture.get(cv2.CAP_PROP_FPS)
    return 1 / rate if 0.01 < rate < 10000 else 1 / DEFAULT_RATE


def _from_jpeg(cv2: ModuleType, data: bytes, width: int, height: int) -> np.ndarray:
    """Decode the brightness of a JPEG, (height, width) uint8; zeros may follow it."""
    data = data.rstrip(b"\0")
    pixels = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if data.endswith(b"\xff\xd9")
        else None
    )
    if pixels is None or pixels.shape != (height, width):
        raise CaptureError(f"a frame of {len(data)} bytes is no whole JPEG of {width} x {height} px.")
    return pixels
