# SPDX-License-Identifier: Apache-2.0
"""Frame sources by themselves."""

import attempts
import cv2
import numpy as np
import pytest
from attempts import made

from starpos.detection import detect
from starpos.errors import FrameError
from starpos.frames.exposure import UNKNOWN_LATENCY_S
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import focal_px_of
from starpos.simulation.scene import expose
from starpos.sky.catalogue import load_catalogue
from starpos_camera.sources.registry import SOURCES
from starpos_camera.sources.source import CaptureSettings, SourceEnded
from starpos_interfaces.msg import Capture
from starpos_testing.lacking import require
from starpos_testing.skies import raws

NOW_S = 1793642400.0
SETTINGS = CaptureSettings(None, None, 5.0)


def values(source="files", **changes):
    return attempts.values(source, **changes)


def make(**changes):
    return made(values(**changes), SETTINGS, lambda: NOW_S)


def play(source, count):
    return attempts.play(source, count, SETTINGS)


def test_files_in_order_with_a_truncated_one_between(folder):
    first, broken, last, end, still_ended = play(make(files__path=str(folder)), 5)
    assert (first.frame.mid_unix_s, last.frame.mid_unix_s) == (NOW_S + 0.25, NOW_S + 10.25)
    assert first.stamp_source == Capture.FILE and first.frame.exposure_s == 0.5
    assert isinstance(broken, FrameError) and "1.fits" in str(broken)
    assert isinstance(end, SourceEnded) and isinstance(still_ended, SourceEnded)


def test_files_loop_passes_over_what_was_bad_and_finds_what_is_new(folder):
    source = make(files__path=str(folder), files__loop=True)
    play(source, 3)
    (folder / "3.fits").write_bytes((folder / "0.fits").read_bytes())
    names = [e.frame.source.rsplit("/", 1)[1] for e in play(source, 4)]
    assert names == ["0.fits", "2.fits", "3.fits", "0.fits"]


def test_files_by_pattern(folder):
    (only,) = play(make(files__path=str(folder / "2*")), 1)
    assert only.frame.source.endswith("2.fits")


def test_frames_without_a_time_are_refused_or_stamped(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.full((48, 64), 7, np.uint16))
    refused, ended = play(make(files__path=str(tmp_path)), 2)
    assert "a.png" in str(refused) and "files.restamp" in str(refused)
    assert isinstance(ended, SourceEnded)
    (stamped,) = play(make(files__path=str(tmp_path), files__restamp=True), 1)
    assert (stamped.frame.mid_unix_s, stamped.stamp_source) == (NOW_S, Capture.DRIVER)


def test_restamped_frames_have_just_ended(folder):
    (stamped,) = play(make(files__path=str(folder), files__restamp=True), 1)
    assert stamped.frame.mid_unix_s == NOW_S - 0.25


def test_a_folder_may_come_later_and_one_without_frames_is_said(tmp_path, folder):
    source = make(files__path=str(tmp_path / "later"))
    (error,) = play(source, 1)
    assert "no frames here" in str(error) and str(error) == source.lacking()
    assert "no frames here" in make(files__path="~no_such_user/x").lacking()
    (tmp_path / "later").mkdir()
    (tmp_path / "later" / "a.fits").write_bytes((folder / "0.fits").read_bytes())
    (exposure,) = play(source, 1)
    assert exposure.frame.width == 640


def test_a_loop_of_nothing_but_bad_files_says_so(tmp_path):
    (tmp_path / "a.fits").write_bytes(b"no FITS")
    source = make(files__path=str(tmp_path), files__loop=True)
    assert [("none of its 1 files" in str(e)) for e in play(source, 3)] == [False, True, True]


def test_files_refuse_what_they_cannot_do():
    files = SOURCES["files"]
    assert "files.path" in files.refusal(values(), SETTINGS)
    given = values(files__path="/x")
    assert files.refusal(given, SETTINGS) is None
    assert "`exposure`" in files.refusal(given, CaptureSettings(0.5, None, 5.0))
    assert "`gain`" in files.refusal(given, CaptureSettings(None, 3.0, 5.0))


SMALL = {"source": "simulated", "focal_mm": 50.0, "simulated__width": 640, "simulated__height": 480}


def test_simulated_stars_are_where_starpos_says(scene):
    exposure = make(**SMALL).capture(SETTINGS)
    frame = exposure.frame
    assert frame.mid_unix_s == NOW_S - 0.25 and frame.exposure_s == 0.5
    assert exposure.stamp_source == Capture.SIMULATED
    # the ideal camera that the node publishes while it has no calibration
    given = values(**SMALL)
    focal_px = focal_px_of(given["focal_mm"], given["pixel_um"])
    assert Camera.from_focal(frame.width, frame.height, focal_px) == scene.camera
    truth = expose(scene, load_catalogue(), NOW_S - 0.5, 0.5, np.random.default_rng(9)).middle
    stars = detect(frame).stars
    assert len(stars) >= 10
    away = np.hypot(stars.x[:10, None] - truth[:, 0], stars.y[:10, None] - truth[:, 1]).min(1)
    assert away.max() < 0.3


def test_simulated_sky_follows_its_parameters(scene):
    given = values(**SMALL)
    source = made(given, SETTINGS, lambda: NOW_S)
    before = source.capture(SETTINGS).frame
    given["simulated.azimuth"] = 130.0
    after = source.capture(CaptureSettings(1.0, None, 5.0)).frame
    assert after.exposure_s == 1.0
    assert abs(before.pixels.astype(int) - after.pixels).max() > 1000
    with pytest.raises(AssertionError):
        np.testing.assert_array_equal(before.pixels, source.capture(SETTINGS).frame.pixels)


@pytest.mark.parametrize(
    ("settings", "changes", "sentence"),
    [
        (CaptureSettings(11.0, None, 60.0), {}, "at most 10 s"),
        (CaptureSettings(2.0, None, 1.0), {}, "longer than `cadence`"),
        (CaptureSettings(None, None, 0.1), {}, "longer than `cadence`"),
        (CaptureSettings(None, 1.0, 5.0), {}, "gain"),
        (SETTINGS, {"simulated__width": 20000, "simulated__height": 20000}, "at most 100000000 px"),
    ],
)
def test_simulated_sky_refuses_what_it_cannot_do(settings, changes, sentence):
    given = values(**(SMALL | changes))
    assert sentence in SOURCES["simulated"].refusal(given, settings)


def raw_files(folder, **exif):
    (folder / "a.dng").write_bytes(raws.dng(raws.mosaic(), **exif))
    return str(folder)


def test_a_cameras_clock_counts_only_where_somebody_vouches_for_it(tmp_path):
    require("rawpy", "exifread")
    # The second is 18:00:00.
    path = raw_files(tmp_path, subsec="25", offset="+01:00")
    (refused,) = play(make(files__path=path), 1)
    assert "a.dng" in str(refused) and "files.exif" in str(refused)
    (taken,) = play(make(files__path=path, files__exif=True), 1)
    assert taken.stamp_source == Capture.EXIF
    assert taken.frame.mid_unix_s == pytest.approx(NOW_S - 3600 + 0.255 + 0.25)
    assert taken.frame.stamp_stddev_s == pytest.approx(np.hypot(0.01 / np.sqrt(12), UNKNOWN_LATENCY_S))
    assert taken.frame.clock_stddev_s == 60.0
    own = {"files__exif_utc_offset": -2.5, "files__exif_clock_stddev": 2.0}
    (taken,) = play(make(files__path=path, files__exif=True, **own), 1)
    assert taken.frame.mid_unix_s == pytest.approx(NOW_S + 2.5 * 3600 + 0.255 + 0.25)
    assert taken.frame.clock_stddev_s == 2.0
    raw_files(tmp_path)
    (refused,) = play(make(files__path=path, files__exif=True), 1)
    assert "no zone" in str(refused)


def test_an_offset_without_leave_is_refused():
    given = values(files__path="/x", files__exif_utc_offset=1.0)
    assert "set files.exif too" in SOURCES["files"].refusal(given, SETTINGS)
