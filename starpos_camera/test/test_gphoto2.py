# SPDX-License-Identifier: Apache-2.0
"""The source `gphoto2`, on libgphoto2 with its virtual USB camera, a Nikon D750 that returns the pictures of a folder."""

import re
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from attempts import SHORT, attempt, in_thread, made, values
from sensor_msgs.msg import Image

from starpos_camera.sources import gphoto2 as gphoto2_source
from starpos_camera.sources.gphoto2 import RAW_ALONE, Gphoto2, named_off_s, nearest, seconds, sentence
from starpos_camera.sources.source import CaptureError, CaptureSettings
from starpos_interfaces.msg import Capture
from starpos_interfaces.srv import SetCapture
from starpos_testing.lacking import require
from starpos_testing.patience import WAIT_S
from starpos_testing.skies import raws

AS_IT_IS = CaptureSettings(None, None, 5.0)
MOSAIC = raws.mosaic()
GREY = (MOSAIC >> 8).astype(np.uint8)
JPEG = cv2.imencode(".jpg", GREY, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
# Frames the virtual camera has room for.
FULL_AFTER = 26
OK, ERROR = 0, 2


class Folder:
    """What the virtual camera has on its card; every exposure gives another copy of `picture`."""

    def __init__(self, path, monkeypatch):
        self._path, self._away = path / "card", path / "away"
        self._patch = monkeypatch
        (self._path / "DCIM" / "100TEST").mkdir(parents=True)
        self.put(JPEG)
        # Before gphoto2 is imported.
        monkeypatch.setenv("VCAMERADIR", str(self._path))
        # libgphoto2 keeps settings there.
        monkeypatch.setenv("HOME", str(path))
        import gphoto2

        self._libraries = Path(gphoto2.__file__).parent / "libgphoto2"
        monkeypatch.setenv("IOLIBS", str(self._libraries / "vusb"))

    def put(self, picture: bytes):
        (self._path / "DCIM" / "100TEST" / "a.jpg").write_bytes(picture)

    def unplug(self):
        """Its files fail from now on, and the bus has no camera: it is looked for on the real one."""
        self._path.rename(self._away)
        self._patch.setenv("IOLIBS", str(self._libraries / "iolibs"))

    def plug(self):
        self._away.rename(self._path)
        self._patch.setenv("IOLIBS", str(self._libraries / "vusb"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    require("gphoto2", "exifread", "rawpy")
    return Folder(tmp_path, monkeypatch)


@pytest.fixture
def make(folder):
    sources = []

    def make(**changes):
        sources.append(made(values("gphoto2", **changes)))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def on_the_card():
    """The pictures that a second program sees in the camera."""
    import gphoto2

    camera = gphoto2.Camera()
    camera.init()
    root = "/store_00010001/DCIM"
    folders, files = camera.folder_list_folders(root), []
    for name in (folders.get_name(k) for k in range(folders.count())):
        found = camera.folder_list_files(f"{root}/{name}")
        files += [found.get_name(k) for k in range(found.count())]
    camera.exit()
    return files


def test_a_jpeg_has_its_rows_on_top_the_shutters_exposure_and_the_commands_time(make):
    source = make(command_lag=0.5, command_lag_stddev=0.02)
    begin = time.time()
    taken = source.capture(SHORT)
    frame = taken.frame
    assert abs(frame.pixels.astype(int) - GREY).max() < 5 and frame.pattern == ""
    assert begin + 0.55 < frame.mid_unix_s < time.time() + 0.55
    assert frame.exposure_s == pytest.approx(0.1)
    assert taken.stamp_source == Capture.COMMAND
    assert taken.frame.stamp_stddev_s == pytest.approx(np.hypot(0.02, named_off_s(0.1) / 2))
    assert taken.remark == ""


def test_a_raw_file_is_the_mosaic_and_tells_its_exposure(make, folder):
    folder.put(raws.dng(MOSAIC, "gbrg", exposure=(1, 10)))
    taken = make().capture(SHORT)
    assert np.array_equal(taken.frame.pixels, MOSAIC) and taken.frame.pattern == "gbrg"
    assert (taken.frame.exposure_s, taken.remark) == (0.1, "")


def test_the_exposure_is_the_one_the_file_says_it_had(make, folder):
    folder.put(raws.with_exif(JPEG, exposure=(1, 4)))
    taken = make().capture(SHORT)
    assert taken.frame.exposure_s == 0.25
    assert "0.25 s" in taken.remark and "0.1 s" in taken.remark


def test_only_what_was_taken_is_deleted(make):
    source = make()
    for _ in range(3):
        source.capture(SHORT)
    assert on_the_card() == ["a.jpg"]


def test_frames_stay_in_the_camera_where_they_should(make):
    source = make(gphoto2__keep=True, gphoto2__target="card")
    for _ in range(3):
        source.capture(SHORT)
    assert len(on_the_card()) == 4


def test_exposures_are_the_cameras_own_to_five_percent(make):
    source = make()
    assert source.capture(AS_IT_IS).frame.exposure_s == pytest.approx(0.01)
    assert source.capture(CaptureSettings(0.0515, None, 5.0)).frame.exposure_s == pytest.approx(0.05)
    assert source.capture(AS_IT_IS).frame.exposure_s == pytest.approx(0.05)
    said = attempt(source, CaptureSettings(0.3, None, 5.0))
    assert "no shutterspeed of 0.3 s" in said and "0.1000s and 1.0000s" in said
    # Longer than any that it has.
    assert "the nearest are 1.0000s" in attempt(source, CaptureSettings(3.0, None, 5.0))
    assert source.capture(SHORT).frame.exposure_s == pytest.approx(0.1)


def test_the_gain_is_a_setting_the_camera_has(make):
    assert "no setting 'iso'" in attempt(make(), CaptureSettings(0.1, 400.0, 5.0))
    # The only one of numbers that it has.
    source = make(gphoto2__iso_setting="exposurecompensation")
    assert source.capture(CaptureSettings(0.1, 2.0, 5.0)).frame is not None
    assert "nearest are 2 and 2.5" in attempt(source, CaptureSettings(0.1, 2.2, 5.0))
    assert "no setting 'speed'" in attempt(make(gphoto2__shutter_setting="speed"))


@pytest.mark.parametrize("keep", [0.1, 0.6, 0.98])
@pytest.mark.parametrize("raw", [False, True])
def test_short_files_are_never_frames(make, folder, raw, keep, record_property):
    whole = raws.dng(MOSAIC) if raw else JPEG
    source = make()
    wrong = 0
    for cut in (whole[: int(keep * len(whole))], whole[: int(keep * len(whole))] + bytes(5000)):
        folder.put(cut)
        wrong += not isinstance(attempt(source), str)
    folder.put(whole)
    good = attempt(source)
    assert wrong == 0 and good.frame.pixels.shape == MOSAIC.shape
    record_property("fault", f"PTP camera returns short {'raw files' if raw else 'JPEGs'}")
    record_property("result", "none published, each said; the next whole one is taken")


def test_a_camera_unplugged_and_back(make, folder, record_property):
    source = make()
    source.capture(SHORT)
    folder.unplug()
    said = [attempt(source) for _ in range(3)]
    assert all(isinstance(s, str) for s in said)
    assert "no camera is on the bus" in said[-1]
    folder.plug()
    begin = time.monotonic()
    assert attempt(source).frame.exposure_s == pytest.approx(0.1)
    record_property("fault", "PTP camera unplugged and back")
    after = time.monotonic() - begin
    record_property("result", f"said; frames again {after:.1f} s after it came back, at the first attempt")


def test_a_full_card_is_said(make, record_property):
    source = make()
    taken = [attempt(source) for _ in range(FULL_AFTER + 1)]
    assert not any(isinstance(t, str) for t in taken[:-1])
    assert "full" in taken[-1]
    assert not isinstance(attempt(source), str)
    record_property("fault", "PTP camera's card full")
    record_property("result", f"said after {FULL_AFTER} frames; frames again once there is room")


def test_a_camera_that_is_not_there_is_said_with_those_that_are(make):
    assert "Nikon DSC D750 at usb:001,001" in attempt(make(gphoto2__model="Canon"))
    assert "0 fit" in attempt(make(gphoto2__port="usb:009,009"))
    assert "no such model" in attempt(make(gphoto2__model="Canon EOS 0", gphoto2__port="usb:001,001"))
    assert "no such port" in attempt(make(gphoto2__model="Nikon DSC D750", gphoto2__port="air:1"))
    there = make(gphoto2__model="dsc d750")
    assert not isinstance(attempt(there), str)
    there = make(gphoto2__model="Nikon DSC D750", gphoto2__port="usb:001,001")
    assert not isinstance(attempt(there), str)


@pytest.mark.parametrize("exposure_s", [0.5, 30.0])
def test_the_waiting_time_that_is_named_is_the_one_that_was_waited(folder, monkeypatch, exposure_s):
    """On a clock of its own, which the waiting alone moves, of a camera that never gives a file."""
    now, closing = [100.0], threading.Event()
    monkeypatch.setattr(gphoto2_source.time, "monotonic", lambda: now[0])
    camera = gphoto2_source.Gphoto2Camera("", "", closing)

    def wait(ms):
        now[0] += ms / 1000
        return camera._gp.GP_EVENT_TIMEOUT, None

    camera._camera = SimpleNamespace(wait_for_event=wait, exit=lambda: None)
    monkeypatch.setattr(closing, "wait", lambda seconds: wait(1000 * seconds))
    with pytest.raises(CaptureError) as given_up:
        camera.files(exposure_s)
    (named_s,) = re.findall(r"in (\d+) s", str(given_up.value))
    # with noise reduction a dark frame as long as the exposure comes first
    assert float(named_s) == pytest.approx(now[0] - 100, abs=0.6) and now[0] - 100 > 2 * exposure_s


def test_closing_ends_a_capture_soon(make):
    source = make()
    source.capture(SHORT)
    capture = in_thread(attempt, source)
    source.close()
    said, _ = capture.result(WAIT_S)
    assert not isinstance(said, str) or "the node ends" in said


def test_the_node_takes_frames_and_says_when_the_camera_is_gone(folder, start, listener, record_property):
    captures, images = listener.hear(Capture, "camera/capture"), listener.hear(Image, "camera/image_raw")
    start("camera", "source:=gphoto2", "exposure:=0.1", "cadence:=1.0", "gphoto2.raw:=false")
    listener.wait(lambda: images)
    assert (images[0].encoding, images[0].height, images[0].width) == ("mono8", *GREY.shape)
    answer = listener.call(SetCapture, "camera/set_capture", SetCapture.Request(exposure=0.05))
    assert answer.success
    listener.wait(lambda: captures and captures[-1].exposure == pytest.approx(0.05))
    folder.unplug()
    listener.wait_for_state("camera: Capture", ERROR, "gphoto2")
    folder.plug()
    begin, before = time.monotonic(), len(images)
    listener.wait(lambda: len(images) > before)
    record_property("fault", "PTP camera gone and back, the node running")
    after = time.monotonic() - begin
    record_property("result", f"an error in the diagnostics; frames again {after:.1f} s after it came back")


def test_what_is_refused_before_a_camera_is_looked_for():
    require("gphoto2")
    assert "longer than `cadence`" in Gphoto2.refusal(values("gphoto2"), CaptureSettings(6.0, None, 5.0))


def test_a_camera_that_another_program_holds_is_said(folder):
    import gphoto2

    assert "gvfs" in sentence(gphoto2.GP_ERROR_IO_USB_CLAIM)
    assert "(-7)" in sentence(gphoto2.GP_ERROR_IO)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1/30", 1 / 30),
        ("0.5", 0.5),
        ("13/10", 1.3),
        ("0.0100s", 0.01),
        ('30"', 30.0),
        ("1/1.3", 1 / 1.3),
        ("bulb", None),
        ("Auto", None),
        ("0", None),
        ("1/0", None),
        ("", None),
        ("-1", None),
        ("1e5", None),
    ],
)
def test_shutter_speeds_as_cameras_write_them(text, expected):
    assert seconds(text) == (expected if expected is None else pytest.approx(expected))


def test_the_nearest_speed_is_named_on_either_side():
    speeds = {"30": 30.0, "1/2": 0.5, "1": 1.0}
    assert nearest(speeds, 0.52, "x") == "1/2"
    for wanted, words in ((0.7, "1/2 and 1"), (0.1, "are 1/2"), (60.0, "are 30")):
        with pytest.raises(CaptureError, match=words):
            nearest(speeds, wanted, "x")
    with pytest.raises(CaptureError, match="dial"):
        nearest({}, 1.0, "x")


@pytest.mark.parametrize(
    ("choice", "alone"),
    [
        ("RAW", True),
        ("cRAW", False),
        ("NEF (Raw)", True),
        ("NEF+Fine", False),
        ("RAW + Large Fine JPEG", False),
        ("Large Fine JPEG", False),
        ("JPEG Normal", False),
    ],
)
def test_only_raw_alone_is_raw(choice, alone):
    assert bool(re.search(RAW_ALONE, choice, re.I)) is alone


@pytest.mark.parametrize(
    ("called", "true"), [(30.0, 32.0), (15.0, 16.0), (0.5, 0.5), (1.3, 1.26), (1 / 60, 1 / 64)]
)
def test_exposures_are_not_quite_what_they_are_called(called, true):
    assert named_off_s(called) == pytest.approx(abs(true - called), abs=0.002)
