# SPDX-License-Identifier: Apache-2.0
"""Cameras behind an ASCOM Alpaca server that may be slow, dead or hostile: each exchange is limited in time and in size.

Source: ASCOM Alpaca API Reference; the picture's format is its ImageBytes (metadata version 1).
"""

import json
import re
import socket
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from http.client import HTTPConnection, HTTPException, HTTPResponse
from itertools import count
from typing import Any, TypeVar
from urllib.parse import urlencode

import numpy as np

from starpos.errors import one_line
from starpos.frames.frame import MAX_PIXELS, Frame
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource
from starpos_camera.sources.timing import check_exposed, clock_stddev_of, dated_by_driver

T = TypeVar("T")
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
# ASCOM's errors of members that a driver does not have, or not now.
NOT_THERE = 0x400, 0x40B
# The longest time for an answer, for a whole picture (40 MB at 0.7 MB/s), and between two pieces of either.
CALL_S, PICTURE_S, STALL_S = 5.0, 60.0, 5.0
# Most bytes of an answer, and of a picture's metadata.
MAX_REPLY, MAX_METADATA = 1_000_000, 65536
METADATA = struct.Struct("<4i7i")
# The types of the standard that pixels may have.
SENT_AS = {1: "<i2", 2: "<i4", 6: "u1", 8: "<u2", 9: "<u4"}
# The standard wants a number of the program, and one of each call.
CLIENT = 1


class MemberError(CaptureError):
    """The server refuses a call, with one of ASCOM's numbers."""

    def __init__(self, number: int, sentence: str) -> None:
        super().__init__(sentence)
        self.number = number


class _Socket(socket.socket):
    """A socket that gives up at a time, however often something comes before."""

    end_s: float

    def recv_into(self, *args: Any) -> int:
        left_s = min(STALL_S, self.end_s - time.monotonic())
        if left_s <= 0:
            raise TimeoutError("timed out")
        self.settimeout(left_s)
        return super().recv_into(*args)


class AlpacaCamera:
    """One camera of a server, by the members of the standard; without a proxy and without redirects."""

    def __init__(self, address: str, number: int) -> None:
        self._address, self._place = address, f"/api/v1/camera/{number}"
        self._calls = count(1)

    def release(self) -> None:
        """Nothing is kept open between two calls."""

    def get(self, member: str) -> Any:
        """Value of a member; MemberError if the camera has none."""
        return self._json("GET", member, {})["Value"]

    def put(self, member: str, **values: object) -> None:
        """Set a member, or call a method."""
        self._json("PUT", member, values)

    def optional(self, member: str, otherwise: T) -> T:
        """Value of a member that a driver need not have; `otherwise` if it has none."""
        kind: Callable[[Any], T] = type(otherwise)
        try:
            return kind(self.get(member))
        except MemberError as e:
            if e.number in NOT_THERE:
                return otherwise
            raise

    def picture(self, width: int, height: int) -> np.ndarray:
        """Fetch the newest picture, (height, width) with row 0 on top, as transmitted; CaptureError without one."""
        accept = {"Accept": "application/imagebytes"}
        with self._ask("GET", "imagearray", {}, PICTURE_S, accept) as response:
            if "application/imagebytes" not in response.headers.get("Content-Type", ""):
                raise CaptureError(
                    f"it answers with {_words(response.read(200))!r} instead of a picture in ImageBytes, which "
                    "servers have had since 2022: update it."
                )
            return _decode(response, width, height)

    def _json(self, method: str, member: str, values: Mapping[str, object]) -> Any:
        with self._ask(method, member, values, CALL_S) as response:
            body = response.read(MAX_REPLY + 1)
        if len(body) > MAX_REPLY:
            raise CaptureError("the server's reply is longer than any that has a meaning.")
        if response.status != 200:
            raise CaptureError(f"the server answers {response.status} {_words(body)}.".replace("..", "."))
        if not body:
            raise HTTPException("the server ended before its answer")
        answer = json.loads(body)
        if number := int(answer["ErrorNumber"]):
            said = _words(str(answer.get("ErrorMessage") or "no reason given").encode()).rstrip(".")
            raise MemberError(number, f"{said} ({member}).")
        return answer

    @contextmanager
    def _ask(
        self, method: str, member: str, values: Mapping, seconds: float, headers: Mapping[str, str] = {}
    ) -> Iterator[HTTPResponse]:
        given = urlencode({**values, "ClientID": CLIENT, "ClientTransactionID": next(self._calls)})
        path = f"{self._place}/{member}"
        with closing(HTTPConnection(self._address, timeout=STALL_S)) as connection:
            connection.connect()
            connection.sock = _Socket(fileno=connection.sock.detach())
            connection.sock.end_s = time.monotonic() + seconds
            if method == "GET":
                connection.request(method, f"{path}?{given}", headers=headers)
            else:
                form = {"Content-Type": "application/x-www-form-urlencoded"}
                connection.request(method, path, given, form)
            yield connection.getresponse()


def _decode(stream: HTTPResponse, width: int, height: int) -> np.ndarray:
    head = stream.read(METADATA.size)
    if len(head) < METADATA.size:
        raise CaptureError("a picture ended within its metadata.")
    version, error, _, _, begin, _, sent_as, rank, columns, rows, _ = METADATA.unpack(head)
    if error:
        raise CaptureError(f"it has no picture: {_words(stream.read(200))}.")
    if version != 1 or not METADATA.size <= begin <= MAX_METADATA:
        raise CaptureError("a picture's metadata are not of version 1.")
    if (rank, columns, rows) != (2, width, height):
        raise CaptureError(
            f"a picture of {columns} x {rows} px in {rank} dimensions came from a sensor of {width} x {height} px: "
            "no other program may bin it or cut it."
        )
    if sent_as not in SENT_AS:
        raise CaptureError(
            f"a picture's pixels are of ASCOM's type {sent_as}, not whole numbers of 8 to 32 bits."
        )
    stream.read(begin - METADATA.size)
    pixels = np.empty((width, height), SENT_AS[sent_as])
    came = stream.readinto(pixels.data.cast("B"))
    if came < pixels.nbytes:
        raise CaptureError(f"a picture ended after {came} of {pixels.nbytes} bytes.")
    if stream.read(1):
        raise CaptureError(f"a picture has more than its {pixels.nbytes} bytes.")
    # The standard's order is [x][y].
    return pixels.T


def _words(text: bytes) -> str:
    return " ".join(text.decode("utf-8", "replace").split())[:120]


class Alpaca(DeviceSource[AlpacaCamera]):
    """Takes whole, unbinned frames; `capture` commands an exposure, waits for it and fetches it."""

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
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

    def _open(self) -> AlpacaCamera:
        camera = AlpacaCamera(self._address, self._number)
        if not camera.get("connected"):
            camera.put("connected", Connected=True)
        # A session before, or a fault, may have left an exposure.
        if _state(camera) != IDLE:
            camera.put("abortexposure")
        width, height = int(camera.get("cameraxsize")), int(camera.get("cameraysize"))
        if min(width, height) < 1 or width * height > MAX_PIXELS:
            raise CaptureError(f"its sensor of {width} x {height} px is not valid.")
        whole = {"BinX": 1, "BinY": 1, "StartX": 0, "StartY": 0, "NumX": width, "NumY": height}
        for member, value in whole.items():
            camera.put(member.lower(), **{member: value})
        self._size, self._pattern, self._gain = (width, height), _pattern(camera), None
        return camera

    def _expose(self, camera: AlpacaCamera, settings: CaptureSettings) -> CapturedFrame:
        # Another program may have disconnected the camera.
        if not camera.get("connected"):
            camera = self._device = self._open()
        wanted_s = settings.definite_exposure_s
        remark = self._set_gain(camera, settings.gain)
        commanded_s = self._now()
        camera.put("startexposure", Duration=wanted_s, Light=True)
        self._wait(camera, wanted_s)
        between_s = commanded_s, self._now()
        exposure_s = camera.optional("lastexposureduration", wanted_s)
        # before a picture is fetched that cannot be dated
        check_exposed(exposure_s, wanted_s, between_s)
        pixels = camera.picture(*self._size)
        told = camera.optional("lastexposurestarttime", "")
        clock_s = clock_stddev_of("alpaca", self._address.rpartition(":")[0], self._values)
        frame = Frame(_unsigned(pixels), pattern=self._pattern, exposure_s=exposure_s)
        taken = dated_by_driver(frame, told, clock_s, between_s, self._values)
        return replace(taken, remark=taken.remark or remark)

    def _explain(self, error: Exception) -> str:
        if isinstance(error, TimeoutError):
            return "it does not answer in time; check the server and the network."
        if isinstance(error, (OSError, HTTPException)):
            return "there is no Alpaca server, or it has gone; start it, or correct alpaca.address."
        # an absurd answer raises many kinds
        return f"{one_line(error) or 'no reason given'} ({type(error).__name__})."

    def _set_gain(self, camera: AlpacaCamera, gain: float | None) -> str:
        """Set the gain if it was not set last; return a remark if the camera has another one."""
        if gain is None:
            return ""
        if gain != self._gain:
            camera.put("gain", Gain=int(gain))
            self._gain = gain
        has = camera.get("gain")
        return "" if has == gain else f"its gain is {has}, though {gain:g} was set."

    def _wait(self, camera: AlpacaCamera, exposure_s: float) -> None:
        begin = time.monotonic()
        while not camera.get("imageready"):
            left_s = begin + exposure_s - time.monotonic()
            state = _state(camera)
            if state == ERROR:
                raise CaptureError("it reports an error; see the server's log.")
            if state == IDLE and not camera.get("imageready"):
                raise CaptureError(
                    "its exposure was ended by another program, or the server has started anew."
                )
            if left_s < -READOUT_S:
                raise CaptureError(f"no picture has come {READOUT_S:g} s after the end of the exposure.")
            if self._closing.wait(min(WATCH_S, max(POLL_S, left_s))):
                raise CaptureError("the node ends.")


def _state(camera: AlpacaCamera) -> int:
    state = int(camera.get("camerastate"))
    if not IDLE <= state <= ERROR:
        raise CaptureError(f"its state is {state}, which no camera has.")
    return state


def _pattern(camera: AlpacaCamera) -> str:
    kind = camera.optional("sensortype", MONOCHROME)
    if kind == MONOCHROME:
        return ""
    if kind != RGGB:
        raise CaptureError(f"its sensor is of ASCOM's type {kind}; monochrome and RGGB ones are known here.")
    offsets = int(camera.get("bayeroffsetx")), int(camera.get("bayeroffsety"))
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
