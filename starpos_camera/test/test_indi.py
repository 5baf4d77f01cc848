# SPDX-License-Identifier: Apache-2.0
"""The source `indi`, against the real indiserver with the real CCD simulator, and with a driver that lies."""

import math
import os
import signal
import socket
import threading
import time

import numpy as np
import pytest
from astropy.io import fits
from attempts import SHORT, in_thread, made, values
from indi_servers import DEVICE, IndiServer, OtherClient, executable_liar

from starpos_camera.sources import indi, timing
from starpos_camera.sources.indi import Indi
from starpos_camera.sources.source import CaptureError, CaptureSettings
from starpos_interfaces.msg import Capture
from starpos_interfaces.srv import SetCapture
from starpos_testing.patience import WAIT_S

LONG = CaptureSettings(60.0, None, 60.0)
# The simulator's own.
SIZE = (1024, 1280)


def make(server, **changes):
    return made(values("indi", **{"indi__port": server.port, "indi__device": DEVICE} | changes))


def sentence(source, settings=SHORT) -> str:
    """Why no frame comes."""
    with pytest.raises(CaptureError) as raised:
        source.capture(settings)
    text = str(raised.value)
    assert text.startswith(source.hardware_id) and text.endswith(".") and "\n" not in text
    return text


@pytest.fixture
def server(tmp_path):
    server = IndiServer(tmp_path).start()
    yield server
    server.kill()


@pytest.fixture
def other(server):
    other = OtherClient(server)
    yield other
    other.close()


@pytest.fixture
def source(server):
    source = make(server)
    yield source
    source.close()


def test_a_device_nobody_has_connected_gives_frames_with_the_drivers_time(source):
    begin = time.time()
    exposure = source.capture(CaptureSettings(0.4, None, 5.0))
    frame = exposure.frame
    assert (frame.pixels.shape, frame.pixels.dtype, frame.pattern) == (SIZE, np.uint16, "")
    assert frame.exposure_s == 0.4
    assert begin + 0.2 <= frame.mid_unix_s <= time.time() - 0.2
    assert (exposure.stamp_source, exposure.frame.stamp_stddev_s) == (
        Capture.DRIVER,
        pytest.approx(0.05, rel=1e-3),
    )
    assert exposure.remark == ""


def show(other, folder, pixels, pattern=None):
    """Have the simulator take its frames from a file."""
    header = fits.Header({"PIXSIZE1": 6.4} | ({"BAYERPAT": pattern} if pattern else {}))
    fits.PrimaryHDU(pixels, header).writeto(folder / "sky.fits")
    other.tell("Text", "CCD_DIRECTORY_LOCATION", LOCATION=folder)
    other.hear("CCD_DIRECTORY_LOCATION", "Ok")
    other.tell("Switch", "CCD_DIRECTORY_TOGGLE", INDI_ENABLED="On", INDI_DISABLED="Off")
    other.hear("CCD_DIRECTORY_TOGGLE", "Ok")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("pattern", [None, "GRBG"])
def test_the_pixels_are_the_sensors_first_row_on_top(source, other, tmp_path, compressed, pattern):
    pixels = np.arange(500 * 700, dtype=np.uint16).reshape(500, 700)
    source.capture(SHORT)
    show(other, tmp_path, pixels, pattern)
    if compressed:
        other.tell("Switch", "CCD_COMPRESSION", INDI_ENABLED="On", INDI_DISABLED="Off")
        other.hear("CCD_COMPRESSION", "Ok")
    # The simulator learns the size of its sensor as it loads.
    source.capture(SHORT)
    frame = source.capture(SHORT).frame
    assert np.array_equal(frame.pixels, pixels)
    assert frame.pattern == (pattern or "").lower()


def test_exposure_and_gain_are_set_at_run_time_and_what_cannot_be_is_refused(source, other):
    assert source.capture(CaptureSettings(0.2, 42.0, 5.0)).frame.exposure_s == 0.2
    other.hear("CCD_GAIN", "Ok")
    assert "its `gain` is 0 to 100, not 1000" in sentence(source, CaptureSettings(0.1, 1000.0, 5.0))
    assert "its `exposure` (s) is 0.01 to 3600, not 0.001" in sentence(
        source, CaptureSettings(0.001, None, 5.0)
    )
    source.capture(SHORT)


def test_what_another_client_has_set_does_not_stay(source, other):
    source.capture(SHORT)
    other.tell("Switch", "UPLOAD_MODE", UPLOAD_LOCAL="On")
    other.tell("Switch", "CCD_FRAME_TYPE", FRAME_DARK="On")
    other.tell("Switch", "CCD_TRANSFER_FORMAT", FORMAT_NATIVE="On")
    other.tell("Number", "CCD_BINNING", HOR_BIN=2, VER_BIN=2)
    other.tell("Number", "CCD_FRAME", X=10, Y=20, WIDTH=300, HEIGHT=200)
    device = source._device
    # All that was set before is there.
    assert device.until(lambda: device.vector("CCD_FRAME").number("X") == 10, WAIT_S)
    assert source.capture(SHORT).frame.pixels.shape == SIZE
    source._values["indi.binning"] = 2
    assert source.capture(SHORT).frame.pixels.shape == (SIZE[0] // 2, SIZE[1] // 2)


def test_the_server_is_killed_in_an_exposure_and_comes_back(server, source, other, record_property):
    source.capture(SHORT)
    other.catch_up()
    capture = in_thread(sentence, source, LONG)
    other.hear("CCD_EXPOSURE", "Busy")
    server.kill()
    killed = time.monotonic()
    text, noticed = capture.result(WAIT_S)
    assert "the INDI server went away during the exposure" in text
    assert noticed - killed < 3
    assert "no INDI server answers" in sentence(source)
    server.start()
    back = time.monotonic()
    source.capture(SHORT)
    record_property("fault", "indiserver killed in an exposure, and started again")
    record_property(
        "result",
        f"noticed after {noticed - killed:.1f} s, a frame {time.monotonic() - back:.1f} s after it was back; none wrong",
    )


def test_the_driver_is_killed_in_an_exposure_and_comes_back(server, source, other, record_property):
    source.capture(SHORT)
    other.catch_up()
    capture = in_thread(sentence, source, LONG)
    other.hear("CCD_EXPOSURE", "Busy")
    server.kill_driver()
    killed = time.monotonic()
    text, noticed = capture.result(WAIT_S)
    assert "the camera or its driver went away during the exposure" in text
    assert noticed - killed < 2
    source.capture(SHORT)
    record_property("fault", "INDI driver killed in an exposure; indiserver starts it again")
    record_property(
        "result",
        f"noticed after {noticed - killed:.1f} s, a frame {time.monotonic() - killed:.1f} s after; none wrong",
    )


@pytest.mark.parametrize(
    ("vector", "members", "said"),
    [
        ("CONNECTION", {"DISCONNECT": "On", "CONNECT": "Off"}, "went away during the exposure"),
        ("CCD_ABORT_EXPOSURE", {"ABORT": "On"}, "was aborted by another client"),
    ],
)
def test_another_client_disconnects_or_aborts(source, other, vector, members, said, record_property):
    source.capture(SHORT)
    other.catch_up()
    capture = in_thread(sentence, source, LONG)
    other.hear("CCD_EXPOSURE", "Busy")
    other.tell("Switch", vector, **members)
    begin = time.monotonic()
    text, noticed = capture.result(WAIT_S)
    assert said in text
    source.capture(SHORT)
    record_property("fault", f"another INDI client sets {vector} in an exposure")
    record_property(
        "result",
        f"noticed after {noticed - begin:.1f} s, a frame {time.monotonic() - begin:.1f} s after; none wrong",
    )


def test_an_exposure_somebody_else_left_running_is_aborted(source, other):
    source.capture(SHORT)
    other.tell("Number", "CCD_EXPOSURE", CCD_EXPOSURE_VALUE=600)
    other.hear("CCD_EXPOSURE", "Busy")
    begin = time.time()
    assert source.capture(SHORT).frame.mid_unix_s > begin


def test_closing_aborts_the_exposure_at_once(source, other):
    source.capture(SHORT)
    other.catch_up()
    capture = in_thread(sentence, source, LONG)
    other.hear("CCD_EXPOSURE", "Busy")
    begin = time.monotonic()
    source.close()
    text, ended = capture.result(WAIT_S)
    assert "closed" in text and ended - begin < LONG.exposure_s / 2
    other.hear("CCD_ABORT_EXPOSURE", "Ok")
    assert "the node ends" in sentence(source)


def test_a_frame_that_does_not_come_in_time_is_given_up(server, source, other):
    source.capture(SHORT)
    impatient = make(server, indi__readout=2.0)
    other.catch_up()
    capture = in_thread(sentence, impatient, CaptureSettings(1.0, None, 5.0))
    other.hear("CCD_EXPOSURE", "Busy")
    (driver,) = server.drivers()
    os.kill(driver, signal.SIGSTOP)
    # As of one that hangs.
    text, _ = capture.result(WAIT_S)
    os.kill(driver, signal.SIGCONT)
    assert "gave no frame in time" in text
    try:
        found = impatient.capture(SHORT)
    except CaptureError as error:
        # the frame of the exposure that was given up, which may come late, is not taken for the one that was asked for
        assert "has exposed for 1 s" in str(error)
        found = impatient.capture(SHORT)
    assert found.frame.exposure_s == pytest.approx(SHORT.exposure_s)
    impatient.close()


def test_a_camera_is_named_and_one_that_is_not_there_said(server):
    assert "indi.device must name the camera" in Indi.refusal(values("indi"), SHORT)
    source = make(server, indi__device="Canon")
    assert f"the server has {DEVICE}: start the camera's driver" in sentence(source)
    source.close()


@pytest.fixture
def liar(tmp_path):
    sources = []
    server = IndiServer(tmp_path, executable_liar(tmp_path))

    def start(**lies):
        server.start(**lies)
        client = OtherClient(server)
        client.meet("Liar")
        client.close()
        sources.append(make(server, indi__device="Liar"))
        return sources[-1]

    yield start
    for source in sources:
        source.close()
    server.kill()


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n<p>", "the server has nothing"),
        (b'<!DOCTYPE a [<!ENTITY b "cc">]><x>&b;</x>', "sends what is no XML"),
        (b"</x>", "sends what is no XML"),
        (b'<setBLOBVector device="Liar" name="CCD1">' + b"A" * 4_000_000, "sends more than any frame has"),
    ],
)
def test_a_server_that_is_none_of_indi_is_one_sentence(sent, said, monkeypatch):
    monkeypatch.setattr(indi, "ELEMENT_MAX", 1_000_000)
    monkeypatch.setattr(indi, "ANSWER_S", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve():
            client, _ = server.accept()
            with client:
                client.sendall(sent)
                client.recv(1 << 20)
                client.recv(1 << 20)

        thread = threading.Thread(target=serve)
        thread.start()
        source = made(values("indi", indi__port=server.getsockname()[1], indi__device="Liar"))
        assert said in sentence(source)
        source.close()
        thread.join()


QUICK = CaptureSettings(0.01, None, 5.0)


@pytest.mark.parametrize(
    ("lies", "said"),
    [
        ({"cut": 100}, "its frame has 5660 of 5760 bytes"),
        ({"cut": 2880, "size": 2880}, "not a whole FITS image"),
        ({"size": 10**12}, "claims 1000000000000 bytes"),
        ({"size": -1}, "claims -1 bytes"),
        ({"format": ".jpeg"}, "it sends '.jpeg', not FITS"),
        ({"format": ".fits.z"}, "it sends '.fits.z', not FITS"),
        ({"header": {"EXPTIME": 1000.0}}, "it has exposed for 1000 s, when 0.01 s were asked"),
        ({"header": {"EXPTIME": -1.0}}, "EXPTIME"),
        ({"header": {"DATE-OBS": "yesterday T"}}, "DATE-OBS"),
        ({"exposure": "Alert"}, "the exposure failed ([ERROR] the shutter is stuck)"),
        ({"connect": "Alert"}, "does not reach its camera ([ERROR] no camera on the bus)"),
    ],
)
def test_what_a_driver_must_not_send_is_refused_in_one_sentence(liar, lies, said, record_property):
    assert said in sentence(liar(**lies), QUICK)
    if lies.keys() == {"cut"}:
        record_property("fault", "INDI driver sends a BLOB that is 100 bytes short")
        record_property("result", f"refused: {said}")


@pytest.mark.parametrize("year", ["1970", "2099"])
def test_a_drivers_clock_that_is_wrong_is_not_used_and_said(liar, year):
    source = liar(header={"DATE-OBS": f"{year}-01-01T00:00:00.000"})
    begin = time.time()
    exposure = source.capture(QUICK)
    assert begin < exposure.frame.mid_unix_s < time.time()
    assert (exposure.stamp_source, exposure.frame.stamp_stddev_s) == (Capture.COMMAND, 0.3)
    assert "set its machine's clock, to UTC" in exposure.remark


@pytest.mark.parametrize("told", ["", "2026-11-21"])
def test_a_driver_that_tells_no_time_leaves_the_commands(liar, told):
    assert liar(header={"DATE-OBS": told}).capture(QUICK).stamp_source == Capture.COMMAND


def test_the_clock_of_another_machine_is_used_where_its_error_is_given(server, monkeypatch):
    monkeypatch.setattr(timing, "LOCAL", ())
    source = make(server)
    assert source.capture(SHORT).stamp_source == Capture.COMMAND
    source.close()
    source = make(server, indi__clock_stddev=0.02)
    exposure = source.capture(SHORT)
    source.close()
    assert exposure.stamp_source == Capture.DRIVER
    assert (exposure.frame.stamp_stddev_s, exposure.frame.clock_stddev_s) == (
        pytest.approx(0.05, rel=1e-3),
        0.02,
    )


def test_the_node_publishes_frames_and_ends_at_once_in_a_long_exposure(server, other, start, listener):
    captures = listener.hear(Capture, "camera/capture")
    options = (f"indi.port:={server.port}", f"indi.device:={DEVICE}", "cadence:=0.5")
    camera = start("camera", "source:=indi", "exposure:=0.1", *options)
    listener.wait(lambda: captures)
    assert captures[0].exposure == 0.1 and captures[0].stamp_source == Capture.DRIVER
    request = SetCapture.Request(exposure=60.0, gain=math.nan, cadence=math.nan)
    assert listener.call(SetCapture, "/camera/set_capture", request).success
    other.catch_up()
    other.hear("CCD_EXPOSURE", "Busy", "60")
    begin = time.monotonic()
    status, out = camera.end(signal.SIGINT)
    assert status == 0 and time.monotonic() - begin < 30, out
    other.hear("CCD_ABORT_EXPOSURE", "Ok")
