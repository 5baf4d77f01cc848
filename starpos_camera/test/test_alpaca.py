# SPDX-License-Identifier: Apache-2.0
"""The source `alpaca`, against PyPI's alpaca-simulators, and against a server that lies."""

import math
import signal
import threading
import time
from datetime import datetime, timezone

import numpy as np
import pytest
from alpaca_servers import HEIGHT, WIDTH, Liar, Simulator, free_port, image_bytes
from attempts import SHORT, attempt, in_thread, made, values
from sensor_msgs.msg import Image

from starpos_camera.sources.alpaca import Alpaca
from starpos_camera.sources.source import CaptureSettings
from starpos_interfaces.msg import Capture
from starpos_testing.patience import WAIT_S, until

LONG = CaptureSettings(6.0, None, 7.0)
# One of ASCOM's camera states.
EXPOSING = 2


def make(server, **changes):
    return made(values("alpaca", alpaca__address=server.address, **changes))


def exposing(source, camera):
    """Begin a long capture in a thread; returns its result to come once the camera exposes."""
    capture = in_thread(attempt, source, LONG)
    until(lambda: camera.CameraState == EXPOSING)
    return capture


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    simulator = Simulator(tmp_path_factory.mktemp("alpaca"))
    simulator.start()
    yield simulator
    simulator.kill()


@pytest.fixture
def liar():
    liar = Liar()
    yield liar
    liar.close()


def test_a_frame_has_its_rows_on_top_its_exposure_and_the_drivers_time(simulator):
    begin = time.time()
    exposure = make(simulator).capture(SHORT)
    frame = exposure.frame
    assert (frame.height, frame.width, frame.pixels.dtype, frame.pattern) == (HEIGHT, WIDTH, np.uint16, "")
    level = frame.pixels.astype(float) - np.median(frame.pixels)
    assert level[0, 1:].mean() > 2 * level[1:, 0].mean() > 10 * abs(level[1:, 1:].mean())
    assert frame.exposure_s == 0.1
    assert begin + 0.05 <= frame.mid_unix_s <= time.time() - 0.05
    assert (exposure.stamp_source, exposure.frame.stamp_stddev_s) == (
        Capture.DRIVER,
        pytest.approx(0.05, rel=1e-3),
    )


def test_the_mosaic_is_that_of_the_bayer_offset_and_other_sensors_are_refused(simulator):
    assert make(simulator, alpaca__device=1).capture(SHORT).frame.pattern == "grbg"
    assert "type 1; monochrome and RGGB" in attempt(make(simulator, alpaca__device=2))
    assert "not found" in attempt(make(simulator, alpaca__device=7))


def test_exposure_and_gain_are_set_at_run_time_and_what_cannot_be_is_refused(simulator):
    source = make(simulator)
    exposure = source.capture(CaptureSettings(0.2, 6.0, 5.0))
    assert exposure.frame.exposure_s == 0.2
    # The simulator's Gain is one more than the index that was set.
    assert simulator.client().Gain == 7
    assert "its gain is 7, though 6 was set" in exposure.remark
    assert "out of range" in attempt(source, CaptureSettings(0.1, 99.0, 5.0))
    assert "too long" in attempt(source, CaptureSettings(4000.0, None, 5000.0))
    given = values("alpaca", alpaca__address=simulator.address)
    assert "whole number" in Alpaca.refusal(given, CaptureSettings(0.1, 1.5, 5.0))


def test_another_program_disconnects_bins_or_aborts(simulator, record_property):
    source, other = make(simulator), simulator.client()
    source.capture(SHORT)
    other.Connected = False
    source.capture(SHORT)
    assert other.Connected
    other.BinX = other.BinY = 2
    other.NumX, other.NumY = WIDTH // 2, HEIGHT // 2
    assert "no other program may bin it" in attempt(source)
    assert source.capture(SHORT).frame.width == WIDTH
    capture = exposing(source, other)
    aborted_s = time.monotonic()
    other.AbortExposure()
    said, noticed_s = capture.result(WAIT_S)
    assert "ended by another program" in said
    simulator_settles(other)
    source.capture(SHORT)
    record_property("fault", "Alpaca: another client disconnects, bins, aborts")
    record_property(
        "result",
        f"connected again, refused, noticed after {noticed_s - aborted_s:.1f} s; frames go on, none wrong",
    )


def simulator_settles(camera):
    """Its exposure goes on after an abort, and makes it busy once more at the end."""
    until(lambda: camera.ImageReady)


def test_a_server_killed_in_mid_exposure_and_back(tmp_path, record_property):
    simulator = Simulator(tmp_path)
    simulator.start()
    try:
        source = make(simulator)
        source.capture(SHORT)
        capture = exposing(source, simulator.client())
        killed_s = time.monotonic()
        simulator.kill()
        said, noticed_s = capture.result(WAIT_S)
        assert "no Alpaca server, or it has gone" in said
        assert "no Alpaca server" in attempt(source)
        simulator.start()
        begin = time.monotonic()
        assert source.capture(SHORT).frame.exposure_s == 0.1
        back_s = time.monotonic() - begin
    finally:
        simulator.kill()
    record_property("fault", "Alpaca: server killed in mid-exposure, and back")
    record_property(
        "result", f"noticed after {noticed_s - killed_s:.1f} s; a frame {back_s:.1f} s after it was back"
    )


def test_nobody_there_and_addresses_that_are_none():
    assert "no Alpaca server" in attempt(made(values("alpaca", alpaca__address=f"127.0.0.1:{free_port()}")))
    for address in ("", "127.0.0.1", "http://127.0.0.1:1", "a@b:1", "::1:1", "host:0", "host:99999"):
        assert "HOST:PORT" in Alpaca.refusal(values("alpaca", alpaca__address=address), SHORT)


def test_close_ends_an_exposure(simulator):
    source = make(simulator, alpaca__device=1)
    camera = simulator.client(1)
    source.capture(SHORT)
    capture = exposing(source, camera)
    closed_s = time.monotonic()
    source.close()
    said, ended_s = capture.result(WAIT_S)
    assert "the node ends" in said and ended_s - closed_s < 5.0
    simulator_settles(camera)


def test_a_gain_is_set_once_and_kept(liar):
    source = make(liar)
    assert source.capture(CaptureSettings(0.1, 50.0, 5.0)).remark == "" and liar.values["gain"] == 50
    assert "its gain is 100, though 300 was set" in source.capture(CaptureSettings(0.1, 300.0, 5.0)).remark
    liar.values["gain"] = 3
    assert "its gain is 3" in source.capture(CaptureSettings(0.1, 300.0, 5.0)).remark


def test_the_node_ends_within_a_long_exposure(simulator, start):
    process = start(
        "camera", "source:=alpaca", f"alpaca.address:={simulator.address}", "exposure:=60.0", "cadence:=0.5"
    )
    camera = simulator.client()
    until(lambda: camera.CameraState == EXPOSING)
    begin = time.monotonic()
    status, out = process.end(signal.SIGINT)
    assert status == 0 and time.monotonic() - begin < 30, out
    camera.AbortExposure()


ROWS = np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize(
    ("dtype", "sent_as", "pixels"),
    [
        (np.int16, 1, ROWS),
        (np.int32, 2, ROWS * 16),
        (np.uint8, 6, ROWS % 251),
        (np.uint16, 8, ROWS),
        (np.uint32, 9, ROWS),
    ],
)
def test_pixels_of_every_whole_type(liar, dtype, sent_as, pixels):
    liar.picture = image_bytes(pixels.astype(dtype), sent_as)
    frame = make(liar).capture(SHORT).frame
    np.testing.assert_array_equal(frame.pixels, pixels)
    assert frame.pixels.dtype == (np.uint8 if sent_as == 6 else np.uint16)


GOOD = image_bytes(ROWS.astype(np.uint16), 8)


@pytest.mark.parametrize(
    ("picture", "sentence"),
    [
        (b"", "within its metadata"),
        (GOOD[:43], "within its metadata"),
        (GOOD[:-1], "ended after 6143 of 6144 bytes"),
        (GOOD[:44], "ended after 0 of 6144 bytes"),
        (GOOD + b"x", "more than its 6144 bytes"),
        (image_bytes(ROWS, 8, version=2), "not of version 1"),
        (image_bytes(ROWS, 8, begin=-1), "not of version 1"),
        (image_bytes(ROWS, 8, begin=2**31 - 1), "not of version 1"),
        (image_bytes(ROWS, 8, columns=2**31 - 1, rows=2**31 - 1), "no other program may"),
        (image_bytes(ROWS, 8, rank=3, planes=3), "in 3 dimensions"),
        (image_bytes(ROWS, 3), "type 3"),
        (image_bytes(ROWS, 99), "type 99"),
        (image_bytes(ROWS, 8, error=0x500)[:44] + b"it is\nbroken", "no picture: it is broken"),
        (image_bytes((ROWS - 1).astype(np.int16), 1), "pixels are -1 to"),
        (image_bytes((ROWS * 100).astype(np.int32), 2), "they must be 0 to 65535"),
    ],
)
def test_short_and_mangled_pictures_are_never_frames(liar, picture, sentence, record_property):
    source = make(liar)
    liar.picture = picture
    assert sentence in attempt(source)
    liar.picture = GOOD
    np.testing.assert_array_equal(source.capture(SHORT).frame.pixels, ROWS)
    record_property("fault", "Alpaca: short, long and mangled ImageBytes")
    record_property("result", "each refused in one sentence, the next picture is a frame")


def test_pictures_as_json_are_refused(liar):
    liar.picture, liar.kind = b'{"Value": [[1]], "ErrorNumber": 0}', "application/json"
    assert "ImageBytes" in attempt(make(liar))


@pytest.mark.parametrize(
    ("member", "value", "sentence"),
    [
        ("cameraxsize", -5, "sensor of -5 x 48 px is not valid"),
        ("cameraxsize", 10**9, "is not valid"),
        ("cameraxsize", "many", "(ValueError)"),
        ("cameraysize", None, "(TypeError)"),
        ("camerastate", 77, "77"),
        ("sensortype", 4, "type 4"),
        ("lastexposureduration", math.nan, "exposed for nan s"),
        ("lastexposureduration", -1.0, "exposed for -1 s"),
        ("lastexposureduration", 900.0, "exposed for 900 s"),
        ("lastexposureduration", [], "(TypeError)"),
    ],
)
def test_absurd_answers_are_one_sentence(liar, member, value, sentence):
    source = make(liar)
    liar.values[member] = value
    said = attempt(source)
    assert sentence in said and said.startswith("Alpaca camera 0 at 127.0.0.1:")


@pytest.mark.parametrize("body", [b"", b"no JSON", b"[]", b"{}", b'{"Value": 1}', b"[" * 100_000])
def test_what_is_no_alpaca_is_one_sentence(liar, body):
    liar.answers["connected"] = lambda handler: handler.answer(body, "application/json")
    assert attempt(make(liar)).startswith("Alpaca camera 0 at 127.0.0.1:")


def test_it_is_not_sent_on_to_another_server(liar):
    def elsewhere(handler):
        handler.send_response(302)
        handler.send_header("Location", f"http://{liar.address}/api/v1/camera/0/elsewhere")
        handler.send_header("Content-Length", "0")
        handler.end_headers()

    liar.answers["connected"] = elsewhere
    assert "answers 302" in attempt(make(liar))
    assert "elsewhere" not in liar.asked


def test_a_reply_without_end_is_given_up(liar):
    def endless(handler):
        handler.send_response(200)
        handler.end_headers()
        while True:
            handler.wfile.write(bytes(65536))

    liar.answers["connected"] = endless
    assert "longer than any" in attempt(make(liar))


@pytest.mark.parametrize("member", ["connected", "imagearray"])
def test_a_server_that_drips_is_given_up_in_time(liar, member, monkeypatch):
    from starpos_camera.sources import alpaca

    stop = threading.Event()

    def drip(handler):
        handler.send_response(200)
        handler.send_header("Content-Type", "application/imagebytes")
        handler.send_header("Content-Length", "1000000")
        handler.end_headers()
        while not stop.wait(0.05):
            handler.wfile.write(b" ")
            handler.wfile.flush()

    monkeypatch.setattr(alpaca, "PICTURE_S", 1.0)
    source = make(liar)
    liar.answers[member] = drip
    assert "in time" in attempt(source)
    stop.set()


def iso(unix_s, decimals):
    """Cut off at a decimal that is not 0."""
    text = datetime.fromtimestamp(unix_s, timezone.utc).isoformat(timespec="microseconds")[: 20 + decimals]
    return (text[:-1] + "1" if text.endswith("0") else text).rstrip(".")


@pytest.mark.parametrize(
    ("decimals", "stamp", "stddev_s"),
    [
        (6, Capture.DRIVER, 0.05),
        (3, Capture.DRIVER, 0.05),
        (1, Capture.DRIVER, 0.0661),
        (0, Capture.COMMAND, 0.3),
    ],
)
def test_the_drivers_time_counts_with_its_resolution(liar, decimals, stamp, stddev_s):
    liar.values["lastexposurestarttime"] = lambda: iso(liar.started_s, decimals)
    exposure = make(liar).capture(SHORT)
    assert exposure.stamp_source == stamp and exposure.remark == ""
    assert abs(exposure.frame.mid_unix_s - liar.started_s - 0.05) < 0.13
    assert exposure.frame.stamp_stddev_s == pytest.approx(stddev_s, rel=0.01)


@pytest.mark.parametrize("off_s", [-7200.0, -0.3, 0.3, 3600.0])
def test_a_drivers_clock_that_is_off_is_not_believed_and_said(liar, off_s):
    liar.values["lastexposurestarttime"] = lambda: iso(liar.started_s + off_s, 3)
    exposure = make(liar, command_lag=0.25, command_lag_stddev=0.03).capture(SHORT)
    assert (exposure.stamp_source, exposure.frame.stamp_stddev_s) == (Capture.COMMAND, 0.03)
    assert exposure.frame.mid_unix_s == pytest.approx(liar.started_s + 0.25 + 0.05, abs=0.1)
    assert "set its machine's clock, to UTC" in exposure.remark


def test_the_clock_of_another_machine_is_used_where_its_error_is_given(liar, monkeypatch):
    from starpos_camera.sources import timing

    monkeypatch.setattr(timing, "LOCAL", ())
    liar.values["lastexposurestarttime"] = lambda: iso(liar.started_s, 6)
    assert make(liar).capture(SHORT).stamp_source == Capture.COMMAND
    exposure = make(liar, alpaca__clock_stddev=0.02).capture(SHORT)
    assert exposure.stamp_source == Capture.DRIVER
    assert (exposure.frame.stamp_stddev_s, exposure.frame.clock_stddev_s) == (
        pytest.approx(0.05, rel=1e-3),
        0.02,
    )


@pytest.mark.parametrize(
    "text", ["", "never", "2026-13-01T00:00:00", "0001-01-01T00:00:00.5", "9999-12-31T23:59:59.9"]
)
def test_a_time_that_is_none_leaves_the_commands(liar, text):
    liar.values["lastexposurestarttime"] = text
    assert make(liar).capture(SHORT).stamp_source == Capture.COMMAND


def test_the_node_publishes_what_the_simulator_sees(simulator, start, listener):
    images = listener.hear(Image, "camera/image_raw")
    captures = listener.hear(Capture, "camera/capture")
    start("camera", "source:=alpaca", f"alpaca.address:={simulator.address}", "exposure:=0.1", "cadence:=0.5")
    listener.wait(lambda: images and captures)
    assert (images[0].width, images[0].encoding) == (WIDTH, "mono16")
    assert captures[0].exposure == 0.1 and captures[0].stamp_source == Capture.DRIVER
    state = listener.wait_for_state("camera: Capture", 0, "taking frames")
    assert state["stamp from"] == "driver"
