# SPDX-License-Identifier: Apache-2.0
"""Cameras behind an INDI server (indilib.org): its protocol 1.7, XML over TCP, of one device."""

import base64
import binascii
import io
import select
import socket
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from starpos.errors import one_line
from starpos.frames.fits import read_fits
from starpos.frames.frame import MAX_PIXELS
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource
from starpos_camera.sources.timing import check_exposed, clock_stddev_of, dated_by_driver

# A server that has gone is noticed after two of these.
BEAT_S = 0.5
LINK_S = 2.0
READ_BYTES = 1 << 20
# Maximum size of a BLOB, and of an element of the protocol: a BLOB in base64.
BLOB_MAX = 4 * MAX_PIXELS
ELEMENT_MAX = 2 * BLOB_MAX


@dataclass
class Vector:
    """A property of a device: kind (Switch, Number, Text ...), texts of its members and limits of its numbers.

    state: Idle, Ok, Busy or Alert; '' of one that the device does not have.
    asked: whether it was set, and the device has not answered yet.
    """

    kind: str = ""
    state: str = ""
    members: dict[str, str] = field(default_factory=dict)
    limits: dict[str, tuple[str | None, str | None]] = field(default_factory=dict)
    asked: bool = False

    def number(self, member: str) -> float | None:
        return _number(self.members.get(member))


class IndiDevice:
    """The present vectors of a device of a server, and commands to it; has no vectors while the device is not there.

    One connection, opened at once; make a new one when it is `lost`. Only the thread that captures uses it, and it hears
    the server only in `until`. closing: ends the waiting.
    """

    def __init__(self, host: str, port: int, name: str, closing: threading.Event) -> None:
        self.name, self._closing = name, closing
        try:
            self._socket = socket.create_connection((host, port), LINK_S)
        except OSError:
            raise CaptureError(
                "no INDI server answers: start indiserver, or correct indi.host and indi.port."
            ) from None
        self.lost = False
        # The newest one.
        self.blob: ET.Element | None = None
        # Names of the devices that are there.
        self.there: set[str] = set()
        self.vectors: dict[str, Vector] = {}
        self._message = ""
        # How often the device has defined CONNECTION since it came or was disconnected.
        self._definitions = 0
        self._parser: Any = ET.XMLPullParser(("start", "end"))
        # What the server sends has no root.
        self._parser.feed("<indi>")
        begun: Any = self._parser.read_events()
        ((_, self._root),) = begun
        self._depth = self._pending = 0
        self._ask()

    def release(self) -> None:
        """Leave the server once it has read all that was sent to it."""
        end = time.monotonic() + LINK_S
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_WR)
            while time.monotonic() < end and self._socket.recv(READ_BYTES):
                pass
        self._socket.close()

    def until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait for a condition on what server and device say; False if the time or the connection ends before."""
        end = time.monotonic() + seconds
        while not (found := condition()) and not self.lost and (left := end - time.monotonic()) > 0:
            if self._closing.is_set():
                raise CaptureError("the node ends: the connection to the INDI server is closed.")
            self._hear(min(left, BEAT_S))
        return bool(found)

    def settled(self, seconds: float) -> bool:
        """Wait until the device has defined all its vectors.

        Nothing marks their end, but a device answers questions in order: a second answer comes after the definitions.
        """
        for _ in range(self._definitions, 2):
            self._ask(device=self.name, name="CONNECTION")
        return self.until(lambda: self._definitions > 1, seconds)

    def vector(self, name: str) -> Vector:
        """A vector as it is now; an empty one where the device has none."""
        return self.vectors.get(name) or Vector()

    def last_message(self) -> str:
        """Last message of the device since `forget`, in brackets; "" without one."""
        return f" ({one_line(self._message)})" if self._message else ""

    def forget(self) -> None:
        """Forget the messages of the device until now, and its BLOB."""
        self.blob, self._message = None, ""

    def send(self, vector: str, **members: str) -> None:
        """Set members of a vector, which is Busy until the device answers; does nothing if the device has gone."""
        found = self.vectors.get(vector)
        if found is None:
            return
        element = ET.Element(f"new{found.kind}Vector", device=self.name, name=vector)
        for name, text in members.items():
            ET.SubElement(element, f"one{found.kind}", name=name).text = text
        found.state, found.asked = "Busy", True
        self._send(element)

    def enable_blobs(self, vector: str) -> None:
        """Ask the server to send the BLOBs of a vector, besides everything else."""
        element = ET.Element("enableBLOB", device=self.name, name=vector)
        element.text = "Also"
        self._send(element)

    def _ask(self, **what: str) -> None:
        self._send(ET.Element("getProperties", {"version": "1.7", **what}))

    def _send(self, element: ET.Element) -> None:
        try:
            self._socket.sendall(ET.tostring(element))
        except OSError:
            self.lost = True

    def _hear(self, seconds: float) -> None:
        """Take what the server sends; waits for it so long."""
        ready, _, _ = select.select([self._socket], [], [], seconds)
        if not ready:
            # Only writing shows that a server has gone. No device has this name, so none answers.
            self._ask(device="starpos", name="CONNECTION")
            return
        try:
            data = self._socket.recv(READ_BYTES)
        except OSError:
            data = b""
        self.lost |= not data
        self._pending += len(data)
        self._parser.feed(data)
        try:
            for event, element in self._parser.read_events():
                self._depth += 1 if event == "start" else -1
                # An element has come whole.
                if self._depth == 0:
                    self._receive(element)
                    self._root.clear()
                    self._pending = 0
        except ET.ParseError as error:
            raise CaptureError(f"the INDI server sends what is no XML ({one_line(error)}).") from None
        if self._pending > ELEMENT_MAX:
            raise CaptureError("the INDI server sends more than any frame has.")

    def _receive(self, element: ET.Element) -> None:
        kind, name = element.tag, element.get("name", "")
        device = element.get("device", "")
        if kind.startswith("def"):
            self.there.add(device)
        elif kind == "delProperty" and not name:
            self.there.discard(device)
        if device != self.name:
            return
        self._message = element.get("message", self._message)
        if kind == "delProperty":
            for gone in [name] if name else list(self.vectors):
                self.vectors.pop(gone, None)
            if name in ("", "CCD1"):
                # The device has gone, or was disconnected.
                self._definitions = 0
        elif kind.startswith("def"):
            self.vectors[name] = Vector(
                kind=kind[3:].removesuffix("Vector"),
                state=element.get("state", "Idle"),
                members={m.get("name", ""): (m.text or "").strip() for m in element},
                limits={m.get("name", ""): (m.get("min"), m.get("max")) for m in element},
            )
            self._definitions += name == "CONNECTION"
        elif kind.startswith("set") and (vector := self.vectors.get(name)) is not None:
            vector.state = element.get("state", vector.state)
            if vector.asked and vector.state == "Busy":
                # It begins now: a frame that has come is of an exposure before.
                self.blob = None
            vector.asked = False
            for m in element:
                if m.tag == "oneBLOB":
                    self.blob = m
                else:
                    vector.members[m.get("name", "")] = (m.text or "").strip()


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


# For what the server has sent meanwhile.
DRAIN_S = 0.02
# For a driver to answer.
ANSWER_S = 5.0
# For a driver to open its camera.
CONNECT_S = 15.0
# Set before each exposure if the driver has them, because another client may have changed them.
SWITCHES = (
    ("UPLOAD_MODE", "UPLOAD_CLIENT"),
    ("CCD_TRANSFER_FORMAT", "FORMAT_FITS"),
    ("CCD_FRAME_TYPE", "FRAME_LIGHT"),
    # By its newer and its older name.
    ("CCD_COMPRESSION", "INDI_DISABLED"),
    ("CCD_COMPRESSION", "CCD_RAW"),
)
# Drivers have one or the other.
GAINS = (("CCD_GAIN", "GAIN"), ("CCD_CONTROLS", "Gain"))


def check_there(device: IndiDevice) -> None:
    """Wait for the device; CaptureError if it does not come."""
    if not device.until(lambda: "CONNECTION" in device.vectors, ANSWER_S):
        there = ", ".join(map(one_line, sorted(device.there))) or "nothing"
        raise CaptureError(f"the server has {there}: start the camera's driver, or correct indi.device.")


def connect_camera(device: IndiDevice) -> None:
    """Make the driver open its camera; another client may have done so already."""

    def connected() -> bool:
        return device.vector("CONNECTION").members.get("CONNECT") == "On"

    def refused() -> bool:
        return device.vector("CONNECTION").state == "Alert"

    device.forget()
    if not connected():
        device.send("CONNECTION", CONNECT="On")

    def lacks() -> list[str]:
        return [name for name in ("CCD_EXPOSURE", "CCD_INFO", "CCD1") if name not in device.vectors]

    device.until(lambda: refused() or (connected() and not lacks()), CONNECT_S)
    if refused() or not connected() or not device.settled(ANSWER_S):
        raise CaptureError(
            f"the driver does not reach its camera{device.last_message()}: check cable and power."
        )
    if lacks():
        raise CaptureError(f"{device.name} has no {lacks()[0]}, so it is no camera: correct indi.device.")
    device.enable_blobs("CCD1")


def set_up(device: IndiDevice, exposure_s: float, gain: float | None, binning: int) -> None:
    """Make all settings of an exposure; CaptureError if the camera cannot do one of them.

    gain: None leaves it as it is.  binning: px each way.
    """
    # A client that was killed may have left an exposure.
    if device.vector("CCD_EXPOSURE").state == "Busy":
        device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        device.until(lambda: device.vector("CCD_EXPOSURE").state != "Busy", ANSWER_S)
    for vector, member in SWITCHES:
        if device.vector(vector).members.get(member) == "Off":
            _set(device, vector, **{member: "On"})
    if "CCD_BINNING" in device.vectors:
        _set_numbers(device, "CCD_BINNING", HOR_BIN=binning, VER_BIN=binning)
    elif binning != 1:
        raise CaptureError("it cannot bin: set indi.binning to 1.")
    if "CCD_FRAME" in device.vectors:
        width, height = (device.vector("CCD_INFO").number(f"CCD_MAX_{axis}") or 0.0 for axis in "XY")
        if width and height:
            _set_numbers(device, "CCD_FRAME", X=0.0, Y=0.0, WIDTH=width, HEIGHT=height)
    if gain is not None:
        # A driver defines its properties one after the other, and nothing says which is the last.
        if not device.until(lambda: _gains_of(device), ANSWER_S):
            raise CaptureError("it has no gain to be set: leave `gain` unset.")
        vector, member = _gains_of(device)[0]
        _check_limits(device, vector, member, gain, "`gain`")
        if device.vector(vector).number(member) != gain:
            # The driver may round the gain to one that the camera has.
            _set(device, vector, **{member: repr(float(gain))})
    _check_limits(device, "CCD_EXPOSURE", "CCD_EXPOSURE_VALUE", exposure_s, "`exposure` (s)")


def _gains_of(device: IndiDevice) -> list[tuple[str, str]]:
    """The vectors and members that set the gain."""
    return [(v, m) for v, m in GAINS if m in device.vector(v).members]


def expose(device: IndiDevice, exposure_s: float, readout_s: float) -> ET.Element:
    """Expose now and return the frame, which may take readout_s after its end; an exposure given up is aborted."""

    def state() -> str:
        return device.vector("CCD_EXPOSURE").state

    device.forget()
    try:
        device.send("CCD_EXPOSURE", CCD_EXPOSURE_VALUE=repr(exposure_s))

        def ended() -> bool:
            # before the answer a frame is of an exposure that was given up
            done = device.blob is not None and not device.vector("CCD_EXPOSURE").asked
            return done or state() in ("", "Alert", "Idle")

        device.until(ended, exposure_s + readout_s)
        if device.lost:
            raise CaptureError("the INDI server went away during the exposure; it is looked for again.")
        if not state():
            raise CaptureError(
                "the camera or its driver went away during the exposure; it is looked for again."
            )
        if device.blob is None:
            ends = {"Alert": "failed", "Idle": "was aborted by another client"}
            end = ends.get(state(), "gave no frame in time")
            raise CaptureError(f"the exposure {end}{device.last_message()}.")
    except BaseException:
        # This is for the node's end too.
        device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        raise
    # The next exposure would abort one that is still busy.
    device.until(lambda: state() != "Busy", ANSWER_S)
    blob, device.blob = device.blob, None
    return blob


def _set(device: IndiDevice, vector: str, **members: str) -> None:
    device.send(vector, **members)
    if not device.until(lambda: device.vector(vector).state != "Busy", ANSWER_S):
        raise CaptureError(f"the driver does not answer to {vector}: restart it.")
    if device.vector(vector).state not in ("Ok", "Idle"):
        asked = ", ".join(f"{m} {v}" for m, v in members.items())
        raise CaptureError(f"the driver refuses {vector} {asked}{device.last_message()}.")


def _set_numbers(device: IndiDevice, vector: str, **numbers: float) -> None:
    """Set the numbers that differ, and check that they were taken."""
    wrong = {m: n for m, n in numbers.items() if device.vector(vector).number(m) != n}
    if not wrong:
        return
    _set(device, vector, **{m: repr(float(n)) for m, n in numbers.items()})
    for member, number in wrong.items():
        found = device.vector(vector).number(member)
        if found is None or abs(found - number) > 1e-6 * abs(number):
            raise CaptureError(f"the driver has made its {vector} {member} {found}, not {number:g}.")


def _check_limits(device: IndiDevice, vector: str, member: str, value: float, name: str) -> None:
    low, high = map(_number, device.vector(vector).limits.get(member, (None, None)))
    if low is not None and high is not None and low < high and not low <= value <= high:
        raise CaptureError(f"its {name} is {low:g} to {high:g}, not {value:g}.")


class Indi(DeviceSource[IndiDevice]):
    """Takes whole light frames as FITS. Connects the device if need be; aborts an exposure that is given up."""

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        for name, what in (
            ("indi.host", "the machine that indiserver runs on"),
            ("indi.device", "the camera"),
        ):
            if not values[name]:
                return f"{name} must name {what}; it is empty."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        self._host, self._port = values["indi.host"], values["indi.port"]
        self._name = values["indi.device"]
        self.hardware_id = f"{self._name} of indiserver at {self._host}:{self._port}"

    def _open(self) -> IndiDevice:
        return IndiDevice(self._host, self._port, self._name, self._closing)

    def _expose(self, device: IndiDevice, settings: CaptureSettings) -> CapturedFrame:
        exposure_s = settings.definite_exposure_s
        # What has come since the last frame: perhaps the end of the connection.
        device.until(lambda: False, DRAIN_S)
        if device.lost:
            device.release()
            device = self._device = self._open()
        check_there(device)
        connect_camera(device)
        set_up(device, exposure_s, settings.gain, self._values["indi.binning"])
        commanded_s = self._now()
        blob = expose(device, exposure_s, self._values["indi.readout"])
        between_s = commanded_s, self._now()
        frame, header = read_fits(io.BytesIO(_fits_of(blob)), "its frame")
        if frame.untimed:
            raise CaptureError(f"the header of its frame cannot be used: {frame.untimed}.")
        exposed_s = frame.exposure_s or exposure_s
        check_exposed(exposed_s, exposure_s, between_s)
        frame = replace(frame, exposure_s=exposed_s)
        told, clock_s = str(header.get("DATE-OBS", "")), clock_stddev_of("indi", self._host, self._values)
        return dated_by_driver(frame, told, clock_s, between_s, self._values)


def _fits_of(blob: ET.Element) -> bytes:
    """Take the FITS file out of a BLOB, which is emptied; CaptureError if it is of another format or incomplete."""
    kind = blob.get("format", "")
    try:
        data, size = base64.b64decode(blob.text or ""), int(blob.get("size", ""))
    except (binascii.Error, ValueError) as error:
        raise CaptureError(f"its frame is no BLOB ({one_line(error)}).") from None
    blob.clear()
    if not 0 < size <= BLOB_MAX:
        raise CaptureError(f"its frame claims {size} bytes; a frame has at most {BLOB_MAX}.")
    if kind != ".fits":
        raise CaptureError(f"it sends {one_line(kind)!r}, not FITS: set its driver's transfer format.")
    if len(data) != size:
        raise CaptureError(f"its frame has {len(data)} of {size} bytes; it is left out.")
    return data
