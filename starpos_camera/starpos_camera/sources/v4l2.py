# SPDX-License-Identifier: Apache-2.0
"""A camera of Video4Linux through OpenCV: the sensor's pixels where it gives them, the kernel's time of each frame.

OpenCV's V4L2 backend (tried: 4.6 and 5.0) gives the kernel's buffer time as CAP_PROP_POS_MSEC, and with
CAP_PROP_CONVERT_RGB at 0 the buffer itself, in its format's shape or as plain bytes. It waits for a frame no longer than
10 s. Exposure is V4L2_CID_EXPOSURE_ABSOLUTE, in 100 us, where the menu of auto exposure is at 1. It does not tell when a
buffer is short: the kernel's uvcvideo throws such frames away (its parameter nodrop is 0).
"""

import math
import time
from collections.abc import Callable, Mapping

import numpy as np

from starpos.frames.frame import MAX_PIXELS, Frame
from starpos_camera.sources.opencv_video import quiet
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings
from starpos_interfaces.msg import Capture

EXPOSURE_UNIT_S = 1e-4
MANUAL = 1  # V4L2_EXPOSURE_MANUAL
AUTOMATIC = (0, 3)  # V4L2_EXPOSURE_AUTO, V4L2_EXPOSURE_APERTURE_PRIORITY
MAX_EXPOSURE_S = 60.0
SETTLE_FRAMES = 4  # that a camera still takes with the settings before
MAX_WAIT_S = 10.0  # besides what the frames themselves take
DEFAULT_RATE = 5.0  # frames a second where the driver tells none: slow is careful
MAX_AGE_S = 600.0
MONO = {"GREY": "u1", "Y16 ": "<u2", "Y12 ": "<u2", "Y10 ": "<u2"}
LUMA = {"YUYV": 0, "YVYU": 0, "UYVY": 1, "VYUY": 1}  # where in its pair of bytes
PLANAR = ("NV12", "NV21", "YU12", "YV12")  # all Y comes first
MOSAIC = {  # of 8, then 10, 12, 16 bits
    letters: (pattern, "<u2" if deep else "u1")
    for pattern, family in {
        "rggb": ("RGGB", "RG10", "RG12", "RG16"),
        "bggr": ("BA81", "BG10", "BG12", "BYR2"),
        "grbg": ("GRBG", "BA10", "BA12", "GR16"),
        "gbrg": ("GBRG", "GB10", "GB12", "GB16"),
    }.items()
    for deep, letters in enumerate(family)
}
COLOUR = ("BGR3", "RGB3")
JPEG = ("MJPG", "JPEG")
FORMATS = (*MONO, *LUMA, *PLANAR, *MOSAIC, *COLOUR, *JPEG)


class V4l2Device:
    """Keeps the camera streaming; `capture` gives the first frame that was exposed after it was asked for."""

    def __init__(self, path: str, values: Mapping, now: Callable[[], float]):
        self.closing = False
        self._path = path
        self._values = values
        self._now = now
        self._capture = None
        self._format, self._size = "", (0, 0)
        self._set: tuple | None = None  # exposure and gain as they were set last
        self._not_before_s = 0.0  # steady time: frames before it have other settings

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        try:
            with quiet() as cv2:
                if self._capture is None:
                    self._open(cv2)
                exposure_s, remark = self._settings(cv2, settings)
                mid_s, stddev_s, stamp = self._grab(cv2, exposure_s)
                came, raw = self._capture.retrieve()
                if not came:
                    raise CaptureError("it gave no frame.")
                pixels, pattern = self._pixels(cv2, raw)
        except Exception as error:
            self.close()
            text = str(error) if isinstance(error, CaptureError) else f"{type(error).__name__}: {error}."
            raise CaptureError(f"{self._path}: {' '.join(text.split())}") from error
        frame = Frame(
            pixels,
            pattern=pattern,
            mid_unix_s=mid_s,
            exposure_s=exposure_s,
            source=self._path,
            stamp_stddev_s=stddev_s,
        )
        return CapturedFrame(frame, stamp, remark=remark and f"{self._path}: {remark}")

    def close(self):
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _open(self, cv2):
        capture = cv2.VideoCapture(self._path, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise CaptureError(
                "it cannot be opened as a camera; it is unplugged, in use, or not yours (be in the group video)."
            )
        self._capture, self._set = capture, None
        capture.set(cv2.CAP_PROP_MODE, 0)  # controls in the driver's units, whatever the environment says
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
        self._size = tuple(int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        width, height = self._size
        if self._format not in FORMATS or (wanted and self._format != wanted):
            raise CaptureError(
                f"it sends {self._format!r}, not {wanted or 'a known format'}; set video.format."
            )
        if min(width, height) < 1 or width * height > MAX_PIXELS or (size[0] and size != (width, height)):
            raise CaptureError(
                f"it has frames of {width} x {height} px; correct video.width and video.height."
            )

    def _settings(self, cv2, settings):
        """Exposure time (s, None unknown) as the driver tells it, and what is to be remarked."""
        capture, remark = self._capture, ""
        if self._set != (settings.exposure_s, settings.gain):
            if settings.exposure_s is not None:
                capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL)
                capture.set(cv2.CAP_PROP_EXPOSURE, max(1, round(settings.exposure_s / EXPOSURE_UNIT_S)))
            if settings.gain is not None:
                capture.set(cv2.CAP_PROP_GAIN, settings.gain)
            self._set = settings.exposure_s, settings.gain
            self._not_before_s = time.monotonic() + SETTLE_FRAMES * self._period_s(cv2)
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

    def _period_s(self, cv2):
        rate = self._capture.get(cv2.CAP_PROP_FPS)
        return 1 / rate if 0.01 < rate < 10000 else 1 / DEFAULT_RATE

    def _grab(self, cv2, exposure_s):
        """Middle, its standard deviation (s) and where it comes from, of the frame that `retrieve` then gives."""
        asked_s = max(time.monotonic(), self._not_before_s)
        buffers = int(self._capture.get(cv2.CAP_PROP_BUFFERSIZE))
        stale = buffers if 1 <= buffers <= 32 else 4
        period_s = max(self._period_s(cv2), exposure_s or 0.0)
        end_s = asked_s + MAX_WAIT_S + (stale + SETTLE_FRAMES) * period_s
        before_s, apart_s, unstamped = None, [], 0
        while time.monotonic() < end_s and not self.closing:
            if not self._capture.grab():
                raise CaptureError("it gives no frame; look after its plug.")
            steady_s, now_s = self._clocks()
            stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            age_s = min(steady_s - stamp_s, time.time() - stamp_s, key=abs)  # drivers stamp with either clock
            stamped = stamp_s > 0 and -0.1 < age_s < MAX_AGE_S
            if not stamped:
                age_s, unstamped = 0.0, unstamped + 1
            at_s = steady_s - age_s
            if before_s is not None:  # in the dark a camera may be slower than it says
                apart_s.append(at_s - before_s)  # of reads: one that was late makes the next look early
                frame_s = min(apart_s) if stamped else max(apart_s)
                lag_s, stddev_s, latest_s = self._lag(exposure_s, max(period_s, frame_s))
                # Without stamps: after the buffers that had been filled before, and one that was being so.
                if at_s - latest_s >= asked_s and (stamped or unstamped > stale + 1):
                    return now_s - age_s - lag_s, stddev_s, Capture.HARDWARE if stamped else Capture.DRIVER
            before_s = at_s
        if self.closing:
            raise CaptureError("the node ends.")
        raise CaptureError(
            "it gives frames, but none that was exposed after it was asked for; its clock is wrong."
        )

    def _clocks(self):
        """Steady time and the node's (s) of one moment, to half a millisecond: other threads may come between."""
        for _ in range(5):
            before_s, now_s, after_s = time.monotonic(), self._now(), time.monotonic()
            if after_s - before_s < 1e-3:
                break
        return (before_s + after_s) / 2, now_s

    def _lag(self, exposure_s, period_s):
        """From an exposure's middle to its stamp, the standard deviation of that, and the most from its start (s)."""
        exposed_s = exposure_s or period_s  # an unknown one is no longer
        lag_s = self._values["video.lag"]
        if not math.isnan(lag_s):
            return lag_s, self._values["command_lag_stddev"], lag_s + exposed_s / 2
        # Drivers stamp the start of the exposure, its end, or the end of the transfer, one period later at most.
        return period_s / 2, (period_s + exposed_s) / math.sqrt(12), period_s + exposed_s

    def _pixels(self, cv2, raw):
        """Pixels and the pattern of their mosaic; CaptureError of a frame that is not whole."""
        width, height = self._size
        raw = np.ascontiguousarray(raw).view(np.uint8).ravel()
        if self._format in JPEG:
            return _from_jpeg(cv2, raw, width, height), ""
        pattern, kind = MOSAIC.get(self._format, ("", MONO.get(self._format, "u1")))
        each = {"NV12": 1.5, "NV21": 1.5, "YU12": 1.5, "YV12": 1.5, "BGR3": 3, "RGB3": 3}.get(self._format)
        each = each or (2 if self._format in LUMA else np.dtype(kind).itemsize)
        if len(raw) != int(width * height * each):
            raise CaptureError(f"a frame has {len(raw)} bytes instead of {int(width * height * each)}.")
        if self._format in LUMA:
            pixels = raw.reshape(height, width, 2)[..., LUMA[self._format]]
        elif self._format in PLANAR:
            pixels = raw[: width * height].reshape(height, width)
        elif self._format in COLOUR:
            pixels = raw.reshape(height, width, 3)[..., :: 1 if self._format == "BGR3" else -1]
        else:
            pixels = raw.view(kind).astype(kind.lstrip("<"), copy=False).reshape(height, width)
        return np.array(pixels, order="C"), pattern  # OpenCV's memory may be the driver's


def _from_jpeg(cv2, raw, width, height):
    """Its brightness, (height, width) uint8."""
    data = raw.tobytes().rstrip(b"\0")
    pixels = (
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if data.endswith(b"\xff\xd9")
        else None
    )
    if pixels is None or pixels.shape != (height, width):
        raise CaptureError(f"a frame of {len(data)} bytes is no whole JPEG of {width} x {height} px.")
    return pixels
