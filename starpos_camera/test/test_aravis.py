# SPDX-License-Identifier: Apache-2.0
"""The source `aravis`, against Aravis's own fake camera; times, formats and clocks against buffers and numbers alone.

The fake camera knows triggers but does not obey them: it sends frames all the time, each with the host's time.
"""

import sys
import threading
import time
import warnings
from importlib.util import find_spec
from pathlib import Path

import attempts
import numpy as np
import pytest
from attempts import attempt, in_thread, made

from starpos.frames.encodings import ENCODINGS
from starpos.frames.frame import Frame
from starpos_camera.sources import aravis as source_module
from starpos_camera.sources.aravis import (
    FORMATS,
    AravisCamera,
    best_format,
    clock_relation,
    library,
    stamp_of_camera,
)
from starpos_camera.sources.source import CaptureError, CaptureSettings, decoded
from starpos_interfaces.msg import Capture
from starpos_testing.lacking import lacks

SHORT = CaptureSettings(0.05, None, 1.0)
# Where Debian and Ubuntu put PyGObject, for their own Python.
DEBIAN = Path("/usr/lib/python3/dist-packages/gi")


def values(**changes):
    return attempts.values("aravis", **{f"aravis.{name}": value for name, value in changes.items()})


@pytest.fixture(scope="module")
def fake(tmp_path_factory):
    """Aravis with its fake camera, Fake_1: 2048 x 2048 px, of which it sends 512 x 512 by default."""
    if not find_spec("gi"):
        if not DEBIAN.is_dir():
            lacks("python3-gi gir1.2-aravis-0.8")
        folder = tmp_path_factory.mktemp("gi")
        (folder / "gi").symlink_to(DEBIAN)
        sys.path.append(str(folder))
    try:
        import gi  # noqa: F401
    except ImportError:
        pytest.skip("PyGObject is not for this Python")
    try:
        with warnings.catch_warnings():
            # Debian's PyGObject 3.42 has an importer of the old kind.
            warnings.simplefilter("ignore", ImportWarning)
            aravis = library()
    except ValueError:
        lacks("gir1.2-aravis-0.8")
    # Looking for others takes a second.
    for kind in ("GigEVision", "USB3Vision"):
        aravis.disable_interface(kind)
    aravis.enable_interface("Fake")
    return aravis


@pytest.fixture
def make(fake):
    sources = []

    def make(**changes):
        sources.append(made(values(**{"region_as_set": True} | changes), SHORT))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def test_a_frame_is_the_whole_sensor_with_its_exposure_and_a_time_between_command_and_arrival(make):
    begin = time.time()
    exposure = make(region_as_set=False).capture(SHORT)
    frame, end = exposure.frame, time.time()
    assert (frame.width, frame.height, frame.pixels.dtype, frame.pattern) == (2048, 2048, np.uint16, "")
    assert frame.exposure_s == pytest.approx(0.05)
    assert begin + 0.025 <= frame.mid_unix_s <= end
    assert np.ptp(frame.pixels) > 0


def test_the_moment_of_the_cameras_time_is_found_where_only_one_is_possible(make):
    # The fake camera's time is the arrival's, so that the exposure can only have ended then.
    for _ in range(3):
        begin = time.time()
        exposure = make().capture(CaptureSettings(0.3, None, 1.0))
        if exposure.stamp_source == Capture.HARDWARE:
            break
    assert exposure.stamp_source == Capture.HARDWARE
    assert exposure.frame.stamp_stddev_s < 0.1
    assert exposure.frame.mid_unix_s >= begin + 0.15 - 0.005


def test_frames_are_new_ones_and_exposure_and_gain_are_set(make, fake, monkeypatch):
    source = make(device="Fake_1")
    # Unrequested frames wait meanwhile.
    source.capture(SHORT)
    time.sleep(0.3)
    begin = time.time()
    frame = source.capture(CaptureSettings(0.1, 5.0, 1.0)).frame
    assert frame.mid_unix_s >= begin
    assert frame.exposure_s == pytest.approx(0.1)
    assert source._device.camera.get_gain() == 5.0
    monkeypatch.setattr(fake.Camera, "get_exposure_time", lambda _: 2e5)
    assert "it exposes for 0.2 s, not for 0.1 s" in source.capture(CaptureSettings(0.1, 5.0, 1.0)).remark


def test_bayer_and_eight_bits_are_taken_as_the_camera_names_them(make):
    frame = make(pixel_format="BayerGB8").capture(SHORT).frame
    assert (frame.pattern, frame.pixels.dtype) == ("gbrg", np.uint8)
    refused = attempt(make(pixel_format="RGB8"), SHORT)
    assert "aravis.pixel_format is RGB8; it offers" in refused


def test_a_part_of_the_sensor_is_taken_where_it_is_meant(make):
    frame = make(region_as_set=True).capture(SHORT).frame
    assert (frame.width, frame.height) == (512, 512)


def test_a_region_that_the_camera_keeps_is_refused(fake, monkeypatch):
    monkeypatch.setattr(fake.Camera, "set_region", lambda *_: None)
    with pytest.raises(
        CaptureError, match=r"512 x 512 px, its sensor 2048 x 2048; set aravis\.region_as_set"
    ):
        AravisCamera(values())


def test_a_camera_that_is_not_there_is_named_with_those_that_are(make):
    assert "aravis.device must be one of: Fake_1" in attempt(make(device="Basler-1234"), SHORT)


def test_a_trigger_that_never_comes_is_said_and_the_node_ends_at_once(make, monkeypatch):
    monkeypatch.setattr(AravisCamera, "pop", lambda self, patience_s: time.sleep(patience_s))
    source = make(trigger="Line0")
    capture = in_thread(attempt, source, SHORT)
    closer = threading.Thread(target=source.close)
    closer.start()
    assert "the node ends" in capture.result(10)[0]
    closer.join()
    monkeypatch.setattr(source_module, "READOUT_S", 0.1)
    assert "check the trigger (Line0)" in attempt(make(trigger="Line0"), SHORT)


def test_an_incomplete_frame_is_refused(make, monkeypatch):
    source = make()
    source.capture(SHORT)
    monkeypatch.setattr(source._device, "_encoding", "mono8")
    assert "a frame has 524288 bytes instead of 262144" in attempt(source, SHORT)
    monkeypatch.undo()
    source.capture(SHORT)


def test_formats_become_pixels_row_by_row():
    for name, (encoding, bits) in FORMATS.items():
        assert name.endswith(str(bits)) and encoding.endswith("8" if bits == 8 else "16")
        assert ENCODINGS[encoding].pattern[:2].upper() == name.rstrip("0123456789")[5:]
    twelve = np.arange(6, dtype="<u2").reshape(2, 3) + 4000
    assert np.array_equal(decoded(FORMATS["Mono12"][0], twelve.tobytes(), (3, 2))[0], twelve)
    assert np.array_equal(decoded(FORMATS["Mono8"][0], bytes(range(6)), (3, 2))[0], [[0, 1, 2], [3, 4, 5]])
    with pytest.raises(CaptureError, match="11 bytes instead of 12"):
        decoded(FORMATS["Mono12"][0], twelve.tobytes()[:-1], (3, 2))


def test_the_deepest_format_is_taken_and_of_a_colour_sensor_its_mosaic():
    assert best_format(["Mono8", "Mono12Packed", "Mono12"], "Mono8") == "Mono12"
    assert best_format(["Mono16", "BayerRG8", "BayerRG12", "RGB8"], "Mono16") == "BayerRG12"
    several = ["BayerBG8", "BayerGB8", "Mono8", "Mono16"]
    assert best_format(several, "Mono8") == "Mono16"
    assert best_format(several, "BayerGB8") == "BayerGB8"
    assert best_format(several, "RGB8") == best_format(several, "BayerRG12p") == "Mono16"
    assert best_format(several, "BayerGB12p") == "BayerGB8"
    with pytest.raises(CaptureError, match="unpacked Mono and Bayer"):
        best_format(["Mono12p", "RGB8"], "RGB8")


def dated(at_s=20.01, relation=(980.0, 1e-4), commanded_s=1000.0, received_s=1000.6, moment="unknown"):
    frame = Frame(np.zeros((8, 8), np.uint8))
    return stamp_of_camera(frame, at_s, relation, 0.5, commanded_s, received_s, values(timestamp=moment))


@pytest.mark.parametrize(
    ("given", "middle_s", "source"),
    [
        # Start or end of the exposure: only one fits between trigger and arrival.
        ({}, 1000.26, Capture.HARDWARE),
        ({"at_s": 20.55}, 1000.30, Capture.HARDWARE),
        ({"moment": "start"}, 1000.26, Capture.HARDWARE),
        # Both fit, if a frame comes late.
        ({"at_s": 20.55, "received_s": 1001.1}, 1000.55, Capture.HARDWARE),
        ({"at_s": 20.55, "received_s": 1001.1, "moment": "start"}, 1000.80, Capture.HARDWARE),
        # Impossible stated values, and impossible exposures.
        ({"moment": "end"}, 1000.25, Capture.COMMAND),
        ({"at_s": 19.0}, 1000.25, Capture.COMMAND),
        ({"at_s": 21.0}, 1000.25, Capture.COMMAND),
        # A clock that cannot be read may keep UTC.
        ({"relation": None, "at_s": 1000.01}, 1000.26, Capture.HARDWARE),
        ({"relation": None}, 1000.25, Capture.COMMAND),
        ({"at_s": None}, 1000.25, Capture.COMMAND),
        # A line has triggered.
        ({"commanded_s": None, "at_s": 20.55}, 1000.30, Capture.HARDWARE),
        ({"commanded_s": None, "at_s": None}, 1000.35, Capture.DRIVER),
        ({"commanded_s": None, "relation": None, "at_s": 1000.55, "moment": "end"}, 1000.35, Capture.DRIVER),
    ],
)
def test_the_stamp_is_the_middle_wherever_the_cameras_time_is_of(given, middle_s, source):
    taken = dated(**given)
    assert taken.stamp_source == source
    assert taken.frame.mid_unix_s == pytest.approx(middle_s, abs=1e-9)


def test_the_stamps_error_holds_what_is_not_known():
    assert dated().frame.stamp_stddev_s == pytest.approx(np.hypot(1e-3, 1e-4))
    either = dated(at_s=20.55, received_s=1001.1)
    # At 0.25 s from one or the other.
    assert either.frame.stamp_stddev_s == pytest.approx(0.25, rel=1e-3)
    utc = dated(relation=None, at_s=1000.01)
    assert utc.frame.stamp_stddev_s == pytest.approx(np.hypot(0.1 / np.sqrt(3), 1e-3))
    assert "contradict" in dated(moment="end").remark


class Clock:
    """A camera's clock of a given rate that a command takes 2 ms to hold, but for one that takes 40."""

    def __init__(self, host, latch, value, frequency, ticks_a_second):
        self.names = {latch, value, frequency}
        self.host, self.value, self.frequency, self.ticks = host, value, frequency, ticks_a_second
        self.held = self.commands = 0

    def is_feature_available(self, name):
        return name in self.names

    def execute_command(self, name):
        way_s = 0.02 if self.commands == 0 else 0.001
        self.commands += 1
        self.host[0] += way_s
        self.held = round((self.host[0] - 500.0) * self.ticks)
        self.host[0] += way_s

    def get_integer(self, name):
        self.host[0] += 0.01
        return self.ticks if name == self.frequency else self.held


@pytest.mark.parametrize(
    "names",
    [
        ("TimestampLatch", "TimestampLatchValue", "", 10**9),
        ("GevTimestampControlLatch", "GevTimestampValue", "GevTimestampTickFrequency", 125_000_000),
    ],
)
def test_the_cameras_clock_is_related_by_its_quickest_reading(names):
    host = [1000.0]
    relation = clock_relation(Clock(host, *names), lambda: host[0])
    assert relation == pytest.approx((500.0, 0.002 / np.sqrt(12)), rel=1e-6)


def test_a_clock_without_a_latch_is_not_related():
    assert clock_relation(Clock([0.0], "a", "b", "c", 1), time.time) is None
