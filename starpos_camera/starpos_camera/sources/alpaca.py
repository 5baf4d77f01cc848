# SPDX-License-Identifier: Apache-2.0
"""Cameras behind an ASCOM Alpaca server, through PyPI's alpyca."""

import re
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from starpos.frames.frame import MAX_PIXELS, Frame
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource, missing
from starpos_camera.sources.timing import check_exposed, clock_stddev_of, stamp_of

if TYPE_CHECKING:
    from alpaca.camera import Camera

T = TypeVar("T")
DEFAULT_EXPOSURE_S = 0.5
# From the end of an exposure to its picture; slow CCDs take 15 s.
READOUT_S = 20.0
POLL_S = 0.02
# Interval of looks at the server during an exposure, so that a dead server is noticed.
WATCH_S = 0.5
# ASCOM's sensor types.
MONOCHROME, RGGB = 0, 2
# Patterns by BayerOffsetX and BayerOffsetY.
PATTERNS = {(0, 0): "rggb", (1, 0): "grbg", (0, 1): "gbrg", (1, 1): "bggr"}
# ASCOM's camera states.
IDLE, ERROR = 0, 5


class Alpaca(DeviceSource["Camera"]):
    """Takes whole, unbinned frames; `capture` commands an exposure, waits for it and fetches it."""

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        if lack := missing("alpaca", "alpyca"):
            return lack
        host, _, port = values["alpaca.address"].rpartition(":")
        if not (re.fullmatch(r"[A-Za-z0-9.-]+", host) and port.isdecimal() and 0 < int(port) < 65536):
            return f"alpaca.address must be HOST:PORT, not {values['alpaca.address']!r}."
        if settings.gain is not None and settings.gain != int(settings.gain):
            return f"the `gain` of an Alpaca camera is a whole number, not {settings.gain:g}."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        self._address = values["alpaca.address"]
        self._number = values["alpaca.device"]
        self.hardware_id = f"Alpaca camera {self._number} at {self._address}"
        self._size = (0, 0)
        self._pattern = ""
        # The gain that was set last.
        self._gain: float | None = None

    def _open(self) -> "Camera":
        from alpaca.camera import Camera

        from starpos_camera.sources.alpaca_http import Session

        camera = Camera(self._address, self._number)
        camera.rqs = Session()
        if not camera.Connected:
            camera.Connected = True
        # A session before, or a fault, may have left an exposure.
        if camera.CameraState != IDLE:
            camera.AbortExposure()
        width, height = int(camera.CameraXSize), int(camera.CameraYSize)
        if min(width, height) < 1 or width * height > MAX_PIXELS:
            raise CaptureError(f"its sensor of {width} x {height} px is not valid.")
        camera.BinX = camera.BinY = 1
        camera.StartX = camera.StartY = 0
        camera.NumX, camera.NumY = width, height
        self._size, self._pattern, self._gain = (width, height), _pattern(camera), None
        return camera

    def _expose(self, camera: "Camera", settings: CaptureSettings) -> CapturedFrame:
        # Another program may have disconnected the camera.
        if not camera.Connected:
            camera = self._device = self._open()
        wanted_s = settings.exposure_s or DEFAULT_EXPOSURE_S
        remark = self._set_gain(camera, settings.gain)
        commanded_s = self._now()
        camera.StartExposure(wanted_s, True)
        self._wait(camera, wanted_s)
        ready_s = self._now()
        exposure_s = _optional(camera, "LastExposureDuration", wanted_s)
        check_exposed(exposure_s, wanted_s, commanded_s, ready_s)
        pixels = camera.rqs.picture(f"{camera.base_url}/imagearray", *self._size)
        told = _optional(camera, "LastExposureStartTime", "")
        clock_s = clock_stddev_of("alpaca", self._address.rpartition(":")[0], self._values)
        stamp = stamp_of(told, clock_s, exposure_s, commanded_s, ready_s, self._values)
        frame = Frame(_unsigned(pixels), pattern=self._pattern, exposure_s=exposure_s)
        return stamp.captured(frame, self.hardware_id, remark)

    def _explain(self, error: Exception) -> str:
        # alpyca, requests and urllib3 have many exceptions, and an absurd reply causes others.
        import requests
        import urllib3

        if isinstance(error, CaptureError):
            return str(error)
        if isinstance(error, (requests.Timeout, urllib3.exceptions.TimeoutError)):
            return "it does not answer in time; check the server and the network."
        if isinstance(error, (requests.ConnectionError, urllib3.exceptions.ProtocolError, ConnectionError)):
            return "there is no Alpaca server, or it has gone; start it, or correct alpaca.address."
        words = " ".join(str(getattr(error, "message", error)).split())[:160].rstrip(".")
        return f"{words or 'no reason given'} ({type(error).__name__})."

    def _set_gain(self, camera: "Camera", gain: float | None) -> str:
        """Set the gain if it was not set last; return a remark if the camera has another one."""
        if gain is None:
            return ""
        if gain != self._gain:
            camera.Gain = int(gain)
            self._gain = gain
        has = camera.Gain
        return "" if has == gain else f"its gain is {has}, though {gain:g} was set."

    def _wait(self, camera: "Camera", exposure_s: float) -> None:
        """Wait until the picture is there."""
        begin = time.monotonic()
        while not camera.ImageReady:
            left_s = begin + exposure_s - time.monotonic()
            state = camera.CameraState
            if state == ERROR:
                raise CaptureError("it reports an error; see the server's log.")
            if state == IDLE and not camera.ImageReady:
                raise CaptureError(
                    "its exposure was ended by another program, or the server has started anew."
                )
            if left_s < -READOUT_S:
                raise CaptureError(f"no picture has come {READOUT_S:g} s after the end of the exposure.")
            if self._closing.wait(min(WATCH_S, max(POLL_S, left_s))):
                raise CaptureError("the node ends.")


def _optional(camera: "Camera", member: str, otherwise: T) -> T:
    """Read a member that a driver need not have; `otherwise` if it has none."""
    from alpaca.exceptions import InvalidOperationException, NotImplementedException

    try:
        kind: Callable[[Any], T] = type(otherwise)
        return kind(getattr(camera, member))
    except (NotImplementedException, InvalidOperationException):
        return otherwise


def _pattern(camera: "Camera") -> str:
    kind = int(_optional(camera, "SensorType", MONOCHROME))
    if kind == MONOCHROME:
        return ""
    if kind != RGGB:
        raise CaptureError(f"its sensor is of ASCOM's type {kind}; monochrome and RGGB ones are known here.")
    offsets = int(camera.BayerOffsetX), int(camera.BayerOffsetY)
    if offsets not in PATTERNS:
        raise CaptureError(f"its Bayer offsets are {offsets}; they must be 0 or 1.")
    return PATTERNS[offsets]


def _unsigned(pixels: np.ndarray) -> np.ndarray:
    """Convert whole numbers of any width to uint8 or uint16."""
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype != np.dtype("<u2"):
        low, high = int(pixels.min()), int(pixels.max())
        if low < 0 or high > 65535:
            raise CaptureError(f"its pixels are {low} to {high}; they must be 0 to 65535.")
    return np.ascontiguousarray(pixels, np.uint16)
