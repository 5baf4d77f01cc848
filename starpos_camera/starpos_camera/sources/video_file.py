# SPDX-License-Identifier: Apache-2.0
"""Frames of a video file, each with the time of its place in the file."""

import math
import os
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from starpos.errors import FrameError
from starpos.frames.frame import MAX_PIXELS, Frame
from starpos_camera.sources.opencv_video import quiet
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, SourceEnded
from starpos_camera.sources.timing import read_utc
from starpos_interfaces.msg import Capture

if TYPE_CHECKING:
    from cv2 import VideoCapture

# A QuickTime or MP4 file begins with one of these.
BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
BEGINNINGS = {
    ".avi": (0, (b"RIFF",)),
    ".mkv": (0, (b"\x1aE\xdf\xa3",)),
    ".mov": (4, BOXES),
    ".mp4": (4, BOXES),
}
SUFFIXES = tuple(BEGINNINGS)
# In frames a second.
MAX_RATE = 1000.0
# The longest time between two frames.
MAX_GAP_S = 3600.0
# Cut-off or damaged frames are dropped, and a file must not lead to the network.
OPTIONS = "fflags;discardcorrupt|err_detect;explode|protocol_whitelist;file"
OPTIONS_IN = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
# FFmpeg's tags of pixel formats: Y800, and Y1 of 16 bits.
GREY_8, GREY_16 = 0x30303859, 0x10003159


class Film:
    """Plays a file once. If its disk goes away and comes back, it goes on at the next frame."""

    # Set by the source; a frame of a file takes no time, so nothing waits for it.
    closing = False

    def __init__(self, path: str, start: str) -> None:
        self._path = path
        started = read_utc(start)
        # Video.refusal has checked it.
        assert started is not None
        self._start_s, self._start_resolution_s = started
        self._capture: VideoCapture | None = None
        self._grey = False
        self._period_s = 0.0
        self._taken = 0
        # In the file's own time.
        self._first_s = self._last_s = -math.inf
        self._ended = ""

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        if self._ended:
            raise SourceEnded(self._ended)
        if not Path(self._path).is_file():
            self.close()
            raise CaptureError(f"{self._path}: it is not there; correct video.device, or mount its disk.")
        with quiet() as cv2:
            if self._capture is None:
                self._capture = self._opened(cv2)
            came, pixels = self._capture.read()
            at_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            frames = self._capture.get(cv2.CAP_PROP_FRAME_COUNT)
        if not came:
            self._ended = f"all {self._taken} frames of {self._path} are played."
            if self._taken < frames:
                raise FrameError(
                    f"{self._path}: it breaks off after {self._taken} of {frames:.0f} frames; copy it again."
                )
            raise SourceEnded(self._ended)
        if not self._last_s < at_s <= max(self._last_s, 0.0) + MAX_GAP_S:
            self._ended = f"{self._path}: the times of its frames make no sense."
            raise FrameError(
                f"{self._ended[:-1]}: {self._last_s:g} s, then {at_s:g} s; convert it to a steady rate."
            )
        self._first_s = at_s if not self._taken else self._first_s
        self._last_s = at_s
        self._taken += 1
        # OpenCV 4.6 makes three channels of one.
        if self._grey and pixels.ndim == 3:
            pixels = np.ascontiguousarray(pixels[..., 0])
        # The exposure is somewhere within the period of the frame; its length is not known.
        mid_s = self._start_s + at_s - self._first_s + self._period_s / 2
        stddev_s = math.hypot(self._period_s, self._start_resolution_s) / math.sqrt(12)
        frame = Frame(pixels, mid_unix_s=mid_s, source=self._path, stamp_stddev_s=stddev_s)
        return CapturedFrame(frame, Capture.FILE)

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture = None

    def _opened(self, cv2: ModuleType) -> "VideoCapture":
        at, beginnings = BEGINNINGS[Path(self._path).suffix.lower()]
        try:
            with open(self._path, "rb") as file:
                head = file.read(16)
        except OSError as error:
            raise CaptureError(
                f"{self._path}: it cannot be read ({error.strerror}); check its disk."
            ) from None
        # FFmpeg would take a playlist of other files under any name.
        if head[at : at + 4] not in beginnings:
            raise FrameError(
                f"{self._path}: this is no {Path(self._path).suffix[1:].upper()} file; convert it to one."
            )
        before = os.environ.get(OPTIONS_IN)
        os.environ[OPTIONS_IN] = OPTIONS
        try:
            capture = cv2.VideoCapture(self._path, cv2.CAP_FFMPEG)
        finally:
            if before is None:
                del os.environ[OPTIONS_IN]
            else:
                os.environ[OPTIONS_IN] = before
        if not capture.isOpened():
            raise FrameError(
                f"{self._path}: this is not a video that OpenCV's FFmpeg can read; convert it to FFV1."
            )
        width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        rate = capture.get(cv2.CAP_PROP_FPS)
        if not (1 <= width * height <= MAX_PIXELS and 0 < rate <= MAX_RATE):
            raise FrameError(
                f"{self._path}: {width:g} x {height:g} px at {rate:g} frames a second are no video."
            )
        kind = int(capture.get(cv2.CAP_PROP_CODEC_PIXEL_FORMAT)) & 0xFFFFFFFF
        self._grey = kind in (GREY_8, GREY_16)
        if self._grey and not capture.set(cv2.CAP_PROP_CONVERT_RGB, 0) and kind == GREY_16:
            raise FrameError(
                f"{self._path}: OpenCV {cv2.__version__} makes 8 bits of its 16; use 4.7 or newer."
            )
        self._period_s = 1 / rate
        for _ in range(self._taken):
            capture.grab()
        return capture
