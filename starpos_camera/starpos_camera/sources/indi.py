# SPDX-License-Identifier: Apache-2.0
"""Cameras behind an INDI server (indilib.org), through PyPI's indipyclient."""

import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace

from starpos.errors import StarposError, one_line
from starpos.frames.fits import decode_fits
from starpos.frames.frame import MAX_PIXELS
from starpos_camera.sources.indi_camera import Wish, connect, expose, find, set_up
from starpos_camera.sources.indi_server import Blob, IndiServer
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, FrameSource, missing
from starpos_camera.sources.timing import CLOCK_TOLERANCE_S, clock_stddev_of, server_clock, stamp_of
from starpos_common.parameters import Parameter

DEFAULT_EXPOSURE_S = 0.5
# In bytes.
BLOB_MAX = 4 * MAX_PIXELS
PARAMETERS = (
    Parameter(
        "indi.host",
        "127.0.0.1",
        "Host that runs indiserver. Use a trusted network: INDI has no passwords.",
        read_only=True,
    ),
    Parameter("indi.port", 7624, "Port of indiserver.", unit="", minimum=1, maximum=65535, read_only=True),
    Parameter(
        "indi.device",
        "",
        "The camera's name, such as `CCD Simulator`, on the left of what `indi_getprop` prints.",
        read_only=True,
    ),
    Parameter(
        "indi.binning",
        1,
        "Binning: pixels that become one, along each axis. A calibration and pixel_um hold for one "
        "binning only.",
        unit="px",
        minimum=1,
        maximum=16,
    ),
    Parameter(
        "indi.readout",
        15.0,
        "Longest time from the end of an exposure to the arrival of its frame. If too short for the "
        "camera or the network, every frame is given up; if too long, a camera that hangs is "
        "noticed late.",
        unit="s",
        minimum=0.5,
        maximum=600.0,
    ),
    server_clock("indi"),
)


class Indi(FrameSource):
    """Takes whole light frames as FITS. Connects the device if need be; aborts an exposure that is given up."""

    parameters = PARAMETERS
    waits_for_listener = False

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        if lack := missing("indipyclient", "indipyclient"):
            return lack
        for name, what in (
            ("indi.host", "the machine that indiserver runs on"),
            ("indi.device", "the camera"),
        ):
            if not values[name]:
                return f"{name} must name {what}; it is empty."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        self._host, self._port = values["indi.host"], values["indi.port"]
        self._device = values["indi.device"]
        self.hardware_id = f"{self._device} of indiserver at {self._host}:{self._port}"
        self._values = values
        self._now = now
        self._server: IndiServer | None = None
        self._closing = False

    def lacking(self) -> None:
        """Return None, because only the server knows."""

    def update(self, values: Mapping) -> None:
        self._values = values

    def close(self) -> None:
        """Close the connection; a `capture` that runs ends, and its exposure is aborted."""
        self._closing = True
        if server := self._server:
            server.close()

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        try:
            return self._exposure(*self._take(settings))
        except StarposError as error:
            self._leave()
            raise CaptureError(f"{self.hardware_id}: {error}") from error
        except Exception:
            self._leave()
            raise

    def _take(self, settings: CaptureSettings) -> tuple[Blob, float, float, float]:
        """Expose; return the BLOB, the exposure asked for (s), and when it was commanded and ready (Unix time)."""
        if self._closing:
            raise CaptureError("the node ends.")
        if self._server is None:
            self._server = IndiServer(self._host, self._port)
            # The node may have ended meanwhile.
            if self._closing:
                raise CaptureError("the node ends.")
        server = self._server

        async def take() -> tuple[Blob, float, float, float]:
            wish = Wish(
                settings.exposure_s or DEFAULT_EXPOSURE_S,
                settings.gain,
                self._values["indi.binning"],
                self._values["indi.readout"],
            )
            device = await find(server, self._device)
            await connect(device)
            await set_up(device, wish)
            commanded_s = self._now()
            blob = await expose(device, wish)
            return blob, wish.exposure_s, commanded_s, self._now()

        return server.run(take())

    def _leave(self) -> None:
        if self._server:
            self._server.close()
        self._server = None

    def _exposure(self, blob: Blob, wanted_s: float, commanded_s: float, ready_s: float) -> CapturedFrame:
        frame, header = decode_fits(_unpacked(blob), "its frame")
        if frame.untimed:
            raise CaptureError(f"the header of its frame cannot be used: {frame.untimed}.")
        exposure_s = frame.exposure_s or wanted_s
        if exposure_s > ready_s - commanded_s + CLOCK_TOLERANCE_S:
            raise CaptureError(
                f"it says that it has exposed for {exposure_s:g} s, when {wanted_s:g} s were asked."
            )
        told = str(header.get("DATE-OBS", ""))
        clock_s = clock_stddev_of("indi", self._host, self._values)
        stamp = stamp_of(told, clock_s, exposure_s, commanded_s, ready_s, self._values)
        frame = replace(
            frame,
            mid_unix_s=stamp.mid_s,
            exposure_s=exposure_s,
            source=self.hardware_id,
            stamp_stddev_s=stamp.stddev_s,
            clock_stddev_s=stamp.clock_stddev_s,
        )
        remark = f"{self.hardware_id}: {stamp.remark}." if stamp.remark else ""
        return CapturedFrame(frame, stamp.source, remark=remark)


def _unpacked(blob: Blob) -> bytes:
    """Unpack the FITS file of a BLOB; CaptureError if it is of another format or incomplete."""
    if not 0 < blob.size <= BLOB_MAX:
        raise CaptureError(f"its frame claims {blob.size} bytes; a frame has at most {BLOB_MAX}.")
    data = blob.data
    # astropy unpacks this format; the stated size is the unpacked image's.
    if blob.format == ".fits.fz":
        return data
    if blob.format == ".fits.z":
        try:
            data = zlib.decompressobj().decompress(data, blob.size + 1)
        except zlib.error as error:
            raise CaptureError(f"its frame cannot be unpacked ({one_line(error)}).") from error
    elif blob.format != ".fits":
        raise CaptureError(f"it sends {one_line(blob.format)!r}, not FITS: set its driver's transfer format.")
    if len(data) != blob.size:
        raise CaptureError(f"its frame has {len(data)} of {blob.size} bytes; it is left out.")
    return data
