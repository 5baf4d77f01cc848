# SPDX-License-Identifier: Apache-2.0
"""A camera of an INDI server: found, connected, set up and exposed, by the standard properties of INDI."""

from dataclasses import dataclass

from starpos_camera.sources.indi_server import Blob, IndiDevice, IndiServer
from starpos_camera.sources.source import CaptureError

LINK_S = 2.0
ANSWER_S = 5.0  # of a driver that is asked or told something
CONNECT_S = 15.0  # a driver opens its camera
# Set before each exposure where the driver has them: another client may have had other wishes.
SWITCHES = (
    ("UPLOAD_MODE", "UPLOAD_CLIENT"),
    ("CCD_TRANSFER_FORMAT", "FORMAT_FITS"),
    ("CCD_FRAME_TYPE", "FRAME_LIGHT"),
)
GAINS = (("CCD_GAIN", "GAIN"), ("CCD_CONTROLS", "Gain"))  # drivers have the one or the other


@dataclass(frozen=True)
class Wish:
    """How to expose: for so long (s), with a gain (None: as it is), binned (px each way), read out in time (s)."""

    exposure_s: float
    gain: float | None
    binning: int
    readout_s: float


async def find(server: IndiServer, name: str) -> IndiDevice:
    """The device of that name, once it is there; CaptureError if it is not."""
    if not await server.until(lambda: server.connected, LINK_S):
        raise CaptureError("no INDI server answers: start indiserver, or correct indi.host and indi.port.")
    device = server.device(name)
    if not await server.until(lambda: device.has("CONNECTION"), ANSWER_S):
        there = ", ".join(server.device_names()) or "nothing"
        raise CaptureError(f"the server has {there}: start the camera's driver, or correct indi.device.")
    return device


async def connect(device: IndiDevice) -> None:
    """Have the driver open its camera; it may have been told so already, by anyone."""

    def connected():
        return device.value("CONNECTION", "CONNECT") == "On"

    def refused():
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
            f"the driver does not reach its camera{device.said()}: look after cable and power."
        )
    if lacks := [v for v in wanted if not device.has(v)]:
        raise CaptureError(f"{device.name} has no {lacks[0]}, so it is no camera: correct indi.device.")
    await device.enable_blobs("CCD1")


async def set_up(device: IndiDevice, wish: Wish) -> None:
    """All that an exposure needs; what the camera cannot do is refused."""
    if device.state("CCD_EXPOSURE") == "Busy":  # of a client that was killed
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
        vector, member = next(
            ((v, m) for v, m in GAINS if device.value(v, m) is not None), ("CCD_GAIN", None)
        )
        if member is None:
            raise CaptureError("it has no gain to be set: leave `gain` unset.")
        _check_limits(device, vector, member, wish.gain, "`gain`")
        if device.number(vector, member) != wish.gain:
            # a driver may round it to what there is
            await _set(device, vector, **{member: repr(float(wish.gain))})
    _check_limits(device, "CCD_EXPOSURE", "CCD_EXPOSURE_VALUE", wish.exposure_s, "`exposure` (s)")


async def expose(device: IndiDevice, wish: Wish) -> Blob:
    """The frame of an exposure begun now; it is aborted where it is given up."""
    server = device.server

    def state():
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
            raise CaptureError(f"the exposure {ends.get(state(), 'gave no frame in time')}{device.said()}.")
    except BaseException:  # a cancellation too
        await device.send("CCD_ABORT_EXPOSURE", ABORT="On")
        raise
    await server.until(lambda: state() != "Busy", ANSWER_S)  # the next exposure would abort this one
    blob, server.blob = server.blob, None
    return blob


async def _set(device, vector, **members):
    await device.send(vector, **members)
    if not await device.server.until(lambda: device.state(vector) != "Busy", ANSWER_S):
        raise CaptureError(f"the driver does not answer to {vector}: restart it.")
    if device.state(vector) not in ("Ok", "Idle"):
        asked = ", ".join(f"{m} {v}" for m, v in members.items())
        raise CaptureError(f"the driver refuses {vector} {asked}{device.said()}.")


async def _set_numbers(device, vector, **numbers):
    """Set what is not so yet, and see that it has become so."""
    wrong = {m: n for m, n in numbers.items() if device.number(vector, m) != n}
    if not wrong:
        return
    await _set(device, vector, **{m: repr(float(n)) for m, n in numbers.items()})
    for member, number in wrong.items():
        found = device.number(vector, member)
        if found is None or abs(found - number) > 1e-6 * abs(number):
            raise CaptureError(f"the driver has made its {vector} {member} {found}, not {number:g}.")


def _check_limits(device, vector, member, value, name):
    low, high = device.limits(vector, member)
    if low is not None and high is not None and low < high and not low <= value <= high:
        raise CaptureError(f"its {name} is {low:g} to {high:g}, not {value:g}.")
