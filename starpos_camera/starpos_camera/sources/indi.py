# SPDX-License-Identifier: Apache-2.0
"""Cameras behind an INDI server (indilib.org), through PyPI's indipyclient.

Its event loop runs in a thread of its own.
"""

import asyncio
import concurrent.futures
import logging
import threading
import zlib
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

from starpos.errors import one_line
from starpos.frames.fits import decode_fits
from starpos.frames.frame import MAX_PIXELS
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, DeviceSource, missing
from starpos_camera.sources.timing import check_exposed, clock_stddev_of, stamp_of

if TYPE_CHECKING:
    from indipyclient import IPyClient

# A server that has gone is noticed after two of these.
BEAT_S = 0.5
LEAVE_S = 2.0
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Blob:
    """Content of a BLOB vector: bytes, and their format and size as the driver states them (size before compression)."""

    data: bytes
    size: int
    format: str


class IndiServer:
    """One connection to an INDI server, opened at once; make a new one when it is lost.

    The caller's thread calls `run`, any thread `close`; only the coroutine inside `run` uses the rest.
    """

    def __init__(self, host: str, port: int) -> None:
        from indipyclient import IPyClient

        # The library prints errors that are reported here anyway.
        logging.getLogger("indipyclient").setLevel(logging.CRITICAL)
        self._client = IPyClient(host, port)
        self._client.timeout_enable = False
        self._client.rxevent = self._on_event
        self.lost = False
        # The newest one.
        self.blob: Blob | None = None
        # How often each device has defined CONNECTION since it came or was disconnected.
        self.definitions: dict[str, int] = {}
        # The thread sets the loop before `started`.
        self._loop: asyncio.AbstractEventLoop
        self._talking: asyncio.Task[Any] | None = None
        self._working: asyncio.Task[Any] | None = None
        self._leaving = False
        self._changed = asyncio.Event()
        started = threading.Event()
        self._thread = threading.Thread(target=self._run_loop, args=(started,), name="indi", daemon=True)
        self._thread.start()
        started.wait()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Run a coroutine; return or raise as it does; CaptureError if `close` ends it."""
        watched = self._watch(work)
        future: concurrent.futures.Future[T] | None = None
        try:
            future = asyncio.run_coroutine_threadsafe(watched, self._loop)
            while not future.done() and self._thread.is_alive():
                concurrent.futures.wait([future], BEAT_S)
        except RuntimeError:
            # The loop has ended.
            future = None
        if future is None or not future.done() or future.cancelled():
            watched.close()
            work.close()
            raise CaptureError("the connection to the INDI server was closed; the frame is given up.")
        return future.result()

    def close(self) -> None:
        """Cancel the work, which may still send commands to the device, and leave the server."""
        leaving = self._leave()
        try:
            asyncio.run_coroutine_threadsafe(leaving, self._loop)
        except RuntimeError:
            # The loop has ended.
            leaving.close()
            return
        self._thread.join(2 * LEAVE_S)
        # a loop that ended meanwhile has not begun it
        if not self._thread.is_alive():
            leaving.close()

    @property
    def connected(self) -> bool:
        return self._client.connected

    def device_names(self) -> list[str]:
        """Names of the devices that are there now."""
        return [one_line(name) for name, found in self._client.items() if found.enable]

    def device(self, name: str) -> "IndiDevice":
        """Return a device by its name, whether it is there or not."""
        return IndiDevice(self, self._client, name)

    async def until(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait for a condition on what server and devices say; False if the time or the connection ends before."""
        end = self._loop.time() + seconds
        while not (found := condition()) and not self.lost and (left := end - self._loop.time()) > 0:
            # wait_for of Python 3.11 may lose a cancellation.
            if self._leaving:
                raise asyncio.CancelledError
            self._changed.clear()
            try:
                await asyncio.wait_for(self._changed.wait(), min(left, BEAT_S))
            except asyncio.TimeoutError:
                # Only writing shows that a server has gone. No device has this name, so none answers.
                await self._client.send_getProperties("starpos", "CONNECTION")
        return bool(found)

    async def _on_event(self, event: Any) -> None:
        if event.eventtype == "ConnectionLost":
            self.lost = True
        elif event.eventtype == "Delete" and event.vectorname in (None, "CCD1"):
            # The device has gone, or was disconnected.
            self.definitions.pop(event.devicename, None)
        elif event.eventtype == "Define" and event.vectorname == "CONNECTION":
            self.definitions[event.devicename] = self.definitions.get(event.devicename, 0) + 1
        elif event.eventtype == "SetBLOB":
            for name, data in event.items():
                self.blob = Blob(data, *event.sizeformat[name])
                # Otherwise the client keeps the bytes until the next BLOB comes.
                event.vector.member(name).membervalue = b"-"
        self._changed.set()

    def _run_loop(self, started: threading.Event) -> None:
        async def talk() -> None:
            self._loop, self._talking = asyncio.get_running_loop(), asyncio.current_task()
            started.set()
            await self._client.asyncrun()

        try:
            asyncio.run(talk())
        except asyncio.CancelledError:
            pass
        finally:
            self.lost = True

    async def _watch(self, work: Coroutine[Any, Any, T]) -> T:
        self._working = asyncio.current_task()
        return await work

    async def _leave(self) -> None:
        self._leaving = True
        self._changed.set()
        if self._working and not self._working.done():
            self._working.cancel()
            await asyncio.wait({self._working}, timeout=LEAVE_S)
        if self._talking is not None:
            self._talking.cancel()


class IndiDevice:
    """The present vectors of a device, and commands to it. A device that is not there has no vectors."""

    def __init__(self, server: IndiServer, client: "IPyClient", name: str) -> None:
        self.server, self.name = server, name
        self._client = client

    def has(self, vector: str) -> bool:
        return self._vector(vector) is not None

    async def settled(self, seconds: float) -> bool:
        """Wait until the device has defined all its vectors.

        Nothing marks their end, but a device answers questions in order: a second answer comes after the definitions.
        """

        def answers() -> int:
            return self.server.definitions.get(self.name, 0)

        for _ in range(answers(), 2):
            await self._client.send_getProperties(self.name, "CONNECTION")
        return await self.server.until(lambda: answers() > 1, seconds)

    def state(self, vector: str) -> str | None:
        """Idle, Ok, Busy or Alert; None without such a vector."""
        found = self._vector(vector)
        return found.state if found is not None else None

    def value(self, vector: str, member: str) -> str | None:
        """Text of a member; None without one."""
        found = self._vector(vector)
        return found.get(member) if found is not None else None

    def number(self, vector: str, member: str) -> float | None:
        """Value of a member as a number; None without one."""
        return _number(self.value(vector, member))

    def limits(self, vector: str, member: str) -> tuple[float | None, float | None]:
        """Smallest and largest allowed value of a number; None where the device states none."""
        found = self._vector(vector)
        if found is None:
            return None, None
        found = found.member(member)
        return _number(found.min), _number(found.max)

    def last_message(self) -> str:
        """Last message of the device since `forget`, in brackets; "" without one."""
        messages = self._client[self.name].messages if self.name in self._client else ()
        return f" ({one_line(messages[0][1])})" if messages else ""

    def forget(self) -> None:
        """Forget the messages of the device until now, and the BLOB of the server."""
        self.server.blob = None
        if self.name in self._client:
            self._client[self.name].messages.clear()

    async def send(self, vector: str, **members: str) -> None:
        """Set members of a vector, which is Busy until the device answers; does nothing if the device has gone."""
        await self._client.send_newVector(self.name, vector, members=members)

    async def enable_blobs(self, vector: str) -> None:
        """Ask the server to send the BLOBs of a vector, besides everything else."""
        await self._client.send_enableBLOB("Also", self.name, vector)

    def _vector(self, vector: str) -> Any:
        found = self._client[self.name].get(vector) if self.name in self._client else None
        return found if found is not None and found.enable else None


def _number(text: str | None) -> float | None:
    from indipyclient import getfloat

    try:
        return getfloat(text)
    except TypeError:
        return None


LINK_S = 2.0
# For a driver to answer.
ANSWER_S = 5.0
# For a driver to open its camera.
CONNECT_S = 15.0
# Set before each exposure if the driver has them, because another client may have changed them.
SWITCHES = (
    ("UPLOAD_MODE", "UPLOAD_CLIENT"),
    ("CCD_TRANSFER_FORMAT", "FORMAT_FITS"),
    ("CCD_FRAME_TYPE", "FRAME_LIGHT"),
)
# Drivers have one or the other.
GAINS = (("CCD_GAIN", "GAIN"), ("CCD_CONTROLS", "Gain"))


async def find_device(server: IndiServer, name: str) -> IndiDevice:
    """Wait for the device of that name; CaptureError if it does not come."""
    if not await server.until(lambda: server.connected, LINK_S):
        raise CaptureError("no INDI server answers: start indiserver, or correct indi.host and indi.port.")
    device = server.device(name)
    if not await server.until(lambda: device.has("CONNECTION"), ANSWER_S):
        there = ", ".join(server.device_names()) or "nothing"
        raise CaptureError(f"the server has {there}: start the camera's driver, or correct indi.device.")
    return device


async def connect_camera(device: IndiDevice) -> None:
    """Make the driver open its camera; another client may have done so already."""

    def connected() -> bool:
        return device.value("CONNECTION", "CONNECT") == "On"

    def refused() -> bool:
        return device.state("CONNECTION") == "Alert"

    device.forget()
    if not connected():
        await device.send("CONNECTION", CONNECT="On")
    wanted = ("CCD_EXPOSURE", "CCD_INFO", "CCD1")
    await device.server.until(
        lambda: refused() or (connected() and all(device.has(v) for v in wanted)), CONNECT_S
    )
    if refused() or not connected() or not await device.settled(ANSWER_S):
        raise CaptureError(
            f"the driver does not reach its camera{device.last_message()}: check cable and power."
        )
    if lacks := [v for v in wanted if not device.has(v)]:
        raise CaptureError(f"{device.name} has no {lacks[0]}, so it is no camera: correct indi.device.")
    await device.enable_blobs("CCD1")


async def set_up(device: IndiDevice, exposure_s: float, gain: float | None, binning: int) -> None:
    """Make all settings of an exposure; CaptureError if the camera cannot do one of them.

    gain: None leaves it as it is.  binning: px each way.
    """
    # A client that was killed may have left an exposure.
    if device.state("CCD_EXPOSURE") == "Busy":
        await device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        await device.server.until(lambda: device.state("CCD_EXPOSURE") != "Busy", ANSWER_S)
    for vector, member in SWITCHES:
        if device.value(vector, member) == "Off":
            await _set(device, vector, **{member: "On"})
    if device.has("CCD_BINNING"):
        await _set_numbers(device, "CCD_BINNING", HOR_BIN=binning, VER_BIN=binning)
    elif binning != 1:
        raise CaptureError("it cannot bin: set indi.binning to 1.")
    if device.has("CCD_FRAME"):
        width, height = (device.number("CCD_INFO", f"CCD_MAX_{axis}") or 0.0 for axis in "XY")
        if width and height:
            await _set_numbers(device, "CCD_FRAME", X=0.0, Y=0.0, WIDTH=width, HEIGHT=height)
    if gain is not None:
        vector, member = await _gain_of(device)
        _check_limits(device, vector, member, gain, "`gain`")
        if device.number(vector, member) != gain:
            # The driver may round the gain to one that the camera has.
            await _set(device, vector, **{member: repr(float(gain))})
    _check_limits(device, "CCD_EXPOSURE", "CCD_EXPOSURE_VALUE", exposure_s, "`exposure` (s)")


async def _gain_of(device: IndiDevice) -> tuple[str, str]:
    """The vector and member that set the gain; CaptureError if none comes."""

    def there() -> list[tuple[str, str]]:
        return [(v, m) for v, m in GAINS if device.value(v, m) is not None]

    # A driver defines its properties one after the other, and nothing says which is the last.
    if not await device.server.until(there, ANSWER_S):
        raise CaptureError("it has no gain to be set: leave `gain` unset.")
    return there()[0]


async def expose(device: IndiDevice, exposure_s: float, readout_s: float) -> Blob:
    """Expose now and return the frame, which may take readout_s after its end; an exposure given up is aborted."""
    server = device.server

    def state() -> str | None:
        return device.state("CCD_EXPOSURE")

    device.forget()
    try:
        await device.send("CCD_EXPOSURE", CCD_EXPOSURE_VALUE=repr(exposure_s))
        await server.until(lambda: server.blob or state() in (None, "Alert", "Idle"), exposure_s + readout_s)
        if server.lost:
            raise CaptureError("the INDI server went away during the exposure; it is looked for again.")
        if state() is None:
            raise CaptureError(
                "the camera or its driver went away during the exposure; it is looked for again."
            )
        if not server.blob:
            ends = {"Alert": "failed", "Idle": "was aborted by another client"}
            end = ends.get(state() or "", "gave no frame in time")
            raise CaptureError(f"the exposure {end}{device.last_message()}.")
    except BaseException:
        # This is for a cancellation too.
        await device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        raise
    # The next exposure would abort one that is still busy.
    await server.until(lambda: state() != "Busy", ANSWER_S)
    blob, server.blob = server.blob, None
    return blob


async def _set(device: IndiDevice, vector: str, **members: str) -> None:
    await device.send(vector, **members)
    if not await device.server.until(lambda: device.state(vector) != "Busy", ANSWER_S):
        raise CaptureError(f"the driver does not answer to {vector}: restart it.")
    if device.state(vector) not in ("Ok", "Idle"):
        asked = ", ".join(f"{m} {v}" for m, v in members.items())
        raise CaptureError(f"the driver refuses {vector} {asked}{device.last_message()}.")


async def _set_numbers(device: IndiDevice, vector: str, **numbers: float) -> None:
    """Set the numbers that differ, and check that they were taken."""
    wrong = {m: n for m, n in numbers.items() if device.number(vector, m) != n}
    if not wrong:
        return
    await _set(device, vector, **{m: repr(float(n)) for m, n in numbers.items()})
    for member, number in wrong.items():
        found = device.number(vector, member)
        if found is None or abs(found - number) > 1e-6 * abs(number):
            raise CaptureError(f"the driver has made its {vector} {member} {found}, not {number:g}.")


def _check_limits(device: IndiDevice, vector: str, member: str, value: float, name: str) -> None:
    low, high = device.limits(vector, member)
    if low is not None and high is not None and low < high and not low <= value <= high:
        raise CaptureError(f"its {name} is {low:g} to {high:g}, not {value:g}.")


DEFAULT_EXPOSURE_S = 0.5
# In bytes.
BLOB_MAX = 4 * MAX_PIXELS


class Indi(DeviceSource[IndiServer]):
    """Takes whole light frames as FITS. Connects the device if need be; aborts an exposure that is given up."""

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
        super().__init__(values, now)
        self._host, self._port = values["indi.host"], values["indi.port"]
        self._name = values["indi.device"]
        self.hardware_id = f"{self._name} of indiserver at {self._host}:{self._port}"

    def _open(self) -> IndiServer:
        return IndiServer(self._host, self._port)

    def _close(self, device: IndiServer) -> None:
        device.close()

    # It ends the work that runs, and aborts its exposure.
    _interrupt = _close

    def _expose(self, server: IndiServer, settings: CaptureSettings) -> CapturedFrame:
        # The node may have ended while the server was opened.
        if self._closing.is_set():
            raise CaptureError("the node ends.")
        exposure_s = settings.exposure_s or DEFAULT_EXPOSURE_S
        values = self._values

        async def take() -> tuple[Blob, float]:
            device = await find_device(server, self._name)
            await connect_camera(device)
            await set_up(device, exposure_s, settings.gain, values["indi.binning"])
            commanded_s = self._now()
            return await expose(device, exposure_s, values["indi.readout"]), commanded_s

        blob, commanded_s = server.run(take())
        return self._frame(blob, exposure_s, commanded_s, self._now())

    def _frame(self, blob: Blob, wanted_s: float, commanded_s: float, ready_s: float) -> CapturedFrame:
        frame, header = decode_fits(_unpacked(blob), "its frame")
        if frame.untimed:
            raise CaptureError(f"the header of its frame cannot be used: {frame.untimed}.")
        exposure_s = frame.exposure_s or wanted_s
        check_exposed(exposure_s, wanted_s, commanded_s, ready_s)
        told = str(header.get("DATE-OBS", ""))
        clock_s = clock_stddev_of("indi", self._host, self._values)
        stamp = stamp_of(told, clock_s, exposure_s, commanded_s, ready_s, self._values)
        return stamp.captured(replace(frame, exposure_s=exposure_s), self.hardware_id)


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
