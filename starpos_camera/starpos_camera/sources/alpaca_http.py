# SPDX-License-Identifier: Apache-2.0
"""HTTP to an Alpaca server that may be slow, dead or hostile: each exchange is limited in time and in size.

The timeout of requests starts again with every byte, and requests takes replies of any length; alpyca fetches pictures
without a timeout. Source of the picture's format: ASCOM Alpaca API Reference, ImageBytes (metadata version 1).
"""

import math
import socket
import struct
import time
from typing import Any

import numpy as np
import requests
from requests.adapters import HTTPAdapter
from urllib3 import HTTPConnectionPool
from urllib3.connection import HTTPConnection

from starpos_camera.sources.source import CaptureError

# alpyca's own timeout, for everything but pictures.
CALL_S = 5.0
# The longest time between two pieces of a picture.
STALL_S = 5.0
# The longest time for a whole picture: 40 MB at 0.7 MB/s.
PICTURE_S = 60.0
# Most bytes of everything but pictures.
MAX_REPLY = 1_000_000
MAX_METADATA = 65536
CHUNK = 1 << 20
METADATA = struct.Struct("<4i7i")
# The types of the standard that pixels may have.
SENT_AS = {1: "<i2", 2: "<i4", 6: "u1", 8: "<u2", 9: "<u4"}


class _Socket(socket.socket):
    """A socket whose timeout limits the whole exchange, counted from when it is set."""

    _end_s = math.inf

    def settimeout(self, seconds: float | None) -> None:
        self._end_s = math.inf if seconds is None else time.monotonic() + seconds
        super().settimeout(seconds)

    def recv_into(self, *args: Any) -> int:
        left_s = min(STALL_S, self._end_s - time.monotonic())
        if left_s <= 0:
            raise TimeoutError("timed out")
        super().settimeout(left_s)
        return super().recv_into(*args)


class _Connection(HTTPConnection):
    sock: socket.socket

    def connect(self) -> None:
        super().connect()
        timeout = self.sock.gettimeout()
        self.sock = _Socket(fileno=self.sock.detach())
        self.sock.settimeout(timeout)


class _Pool(HTTPConnectionPool):
    ConnectionCls = _Connection


class _Adapter(HTTPAdapter):
    def init_poolmanager(self, *args: Any, **kwargs: Any) -> None:
        super().init_poolmanager(*args, **kwargs)
        self.poolmanager.pool_classes_by_scheme = {"http": _Pool}


class Session(requests.Session):
    """A requests.Session for alpyca's devices: bounded in time and size, without a proxy and without redirects."""

    def __init__(self) -> None:
        super().__init__()
        self.trust_env = False
        self.max_redirects = 0
        self.mount("http://", _Adapter())

    def request(self, *args: Any, **kwargs: Any) -> requests.Response:
        stream, kwargs["stream"] = kwargs.get("stream", False), True
        response = super().request(*args, **kwargs)
        if not stream:
            with response:
                body = response.raw.read(MAX_REPLY + 1, decode_content=True)
            if len(body) > MAX_REPLY:
                raise CaptureError("the server's reply is longer than any that has a meaning.")
            # requests keeps the body that it has read there.
            response._content = body
        return response

    def picture(self, url: str, width: int, height: int) -> np.ndarray:
        """Fetch the newest picture, (height, width) with row 0 on top, as transmitted; CaptureError without one."""
        accept = {"Accept": "application/imagebytes", "Accept-Encoding": "identity"}
        with self.get(url, headers=accept, timeout=(CALL_S, PICTURE_S), stream=True) as response:
            if "application/imagebytes" not in response.headers.get("Content-Type", ""):
                raise CaptureError(
                    f"it answers with {_words(response.raw.read(200))!r} instead of a picture in ImageBytes, which "
                    "servers have had since 2022: update it."
                )
            return _decode(response.raw, width, height)


def _decode(stream: Any, width: int, height: int) -> np.ndarray:
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
    room, at = pixels.data.cast("B"), 0
    while at < len(room):
        piece = stream.read(min(CHUNK, len(room) - at))
        if not piece:
            raise CaptureError(f"a picture ended after {at} of {len(room)} bytes.")
        room[at : at + len(piece)] = piece
        at += len(piece)
    if stream.read(1):
        raise CaptureError(f"a picture has more than its {len(room)} bytes.")
    # The standard's order is [x][y].
    return pixels.T


def _words(text: bytes) -> str:
    return " ".join(text.decode("utf-8", "replace").split())[:120]
