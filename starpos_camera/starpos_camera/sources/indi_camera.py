# SPDX-License-Identifier: Apache-2.0
"""Control of a camera of an INDI server through INDI's standard properties: find, connect, set up, expose."""

from dataclasses import dataclass

from starpos_camera.sources.indi_server import Blob, IndiDevice, IndiServer
from starpos_camera.sources.source import CaptureError

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


@dataclass(frozen=True)
class Wish:
    """Settings of an exposure: its time (s), gain (None: as it is), binning (px each way), time for the readout (s)."""

    exposure_s: float
    gain: float | None
    binning: int
    readout_s: float


async def find(server: IndiServer, name: str) -> IndiDevice:
    """Wait for the device of that name; CaptureError if it does not come."""
    if not await server.until(lambda: server.connected, LINK_S):
        raise CaptureError("no INDI server answers: start indiserver, or correct indi.host and indi.port.")
    device = server.device(name)
    if not await server.until(lambda: device.has("CONNECTION"), ANSWER_S):
        there = ", ".join(server.device_names()) or "nothing"
        raise CaptureError(f"the server has {there}: start the camera's driver, or correct indi.device.")
    return device


async def connect(device: IndiDevice) -> None:
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
        raise CaptureError(f"the driver does not reach its camera{device.said()}: check cable and power.")
    if lacks := [v for v in wanted if not device.has(v)]:
        raise CaptureError(f"{device.name} has no {lacks[0]}, so it is no camera: correct indi.device.")
    await device.enable_blobs("CCD1")


async def set_up(device: IndiDevice, wish: Wish) -> None:
    """Make all settings of an exposure; CaptureError if the camera cannot do one of them."""
    # A client that was killed may have left an exposure.
    if device.state("CCD_EXPOSURE") == "Busy":
        await device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        await device.server.until(lambda: device.state("CCD_EXPOSURE") != "Busy", ANSWER_S)
    for vector, member in SWITCHES:
        if device.value(vector, member) == "Off":
            await _set(device, vector, **{member: "On"})
    if device.has("CCD_BINNING"):
        await _set_numbers(device, "CCD_BINNING", HOR_BIN=wish.binning, VER_BIN=wish.binning)
    elif wish.binning != 1:
        raise CaptureError("it cannot bin: set indi.binning to 1.")
    if device.has("CCD_FRAME"):
        width, height = (device.number("CCD_INFO", f"CCD_MAX_{axis}") or 0.0 for axis in "XY")
        if width and height:
            await _set_numbers(device, "CCD_FRAME", X=0.0, Y=0.0, WIDTH=width, HEIGHT=height)
    if wish.gain is not None:
        vector, member = await _gain_of(device)
        _check_limits(device, vector, member, wish.gain, "`gain`")
        if device.number(vector, member) != wish.gain:
            # The driver may round the gain to one that the camera has.
            await _set(device, vector, **{member: repr(float(wish.gain))})
    _check_limits(device, "CCD_EXPOSURE", "CCD_EXPOSURE_VALUE", wish.exposure_s, "`exposure` (s)")


async def _gain_of(device: IndiDevice) -> tuple[str, str]:
    """The vector and member that set the gain; CaptureError if none comes."""

    def there() -> list[tuple[str, str]]:
        return [(v, m) for v, m in GAINS if device.value(v, m) is not None]

    # A driver defines its properties one after the other, and nothing says which is the last.
    if not await device.server.until(there, ANSWER_S):
        raise CaptureError("it has no gain to be set: leave `gain` unset.")
    return there()[0]


async def expose(device: IndiDevice, wish: Wish) -> Blob:
    """Expose now and return the frame; an exposure that is given up is aborted."""
    server = device.server

    def state() -> str | None:
        return device.state("CCD_EXPOSURE")

    device.forget()
    try:
        await device.send("CCD_EXPOSURE", CCD_EXPOSURE_VALUE=repr(wish.exposure_s))
        await server.until(
            lambda: server.blob or state() in (None, "Alert", "Idle"), wish.exposure_s + wish.readout_s
        )
        if server.lost:
            raise CaptureError("the INDI server went away during the exposure; it is looked for again.")
        if state() is None:
            raise CaptureError(
                "the camera or its driver went away during the exposure; it is looked for again."
            )
        if not server.blob:
            ends = {"Alert": "failed", "Idle": "was aborted by another client"}
            end = ends.get(state() or "", "gave no frame in time")
            raise CaptureError(f"the exposure {end}{device.said()}.")
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
        raise CaptureError(f"the driver refuses {vector} {asked}{device.said()}.")


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
