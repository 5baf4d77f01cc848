# SPDX-License-Identifier: Apache-2.0
"""Raw files and pictures of a camera, and when they were taken by its own clock."""

import contextlib
import gc
import re
import sys
from datetime import datetime, timezone

import cv2
import numpy as np
import pytest

from starpos.errors import FrameError, TimeError
from starpos.frames.exif import CameraClock
from starpos.frames.exposure import UNKNOWN_LATENCY_S
from starpos.frames.frame import Frame
from starpos.frames.reading import decode_frame, read_frame, why_no_time
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

MOSAIC = raws.mosaic()
# raws.START, were it UTC.
SHOWN_S = datetime(2026, 11, 2, 18, tzinfo=timezone.utc).timestamp()
TEHRAN = CameraClock(3.5, 2.0)

needs_rawpy, needs_exifread = needs("rawpy"), needs("exifread")


def jpeg(**exif):
    data = cv2.imencode(".jpg", (MOSAIC >> 8).astype(np.uint8))[1].tobytes()
    return raws.with_exif(data, **exif)


def picture_tiff(image=None, **exif):
    tags = {
        0x100: (raws.LONG, [8]),
        0x101: (raws.LONG, [4]),
        0x102: (raws.SHORT, [8]),
        0x103: (raws.SHORT, [1]),
        0x106: (raws.SHORT, [1]),
        0x115: (raws.SHORT, [1]),
        0x116: (raws.LONG, [4]),
        0x117: (raws.LONG, [32]),
        **(image or {}),
    }
    return raws.tiff(tags, raws.exif_tags(**exif), pixels=bytes(range(32)))


def write(path, data):
    path.write_bytes(data)
    return path


@needs_rawpy
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "grbg", "gbrg"])
@pytest.mark.parametrize("order", "<>")
def test_a_raw_file_is_the_mosaic_the_sensor_gave(tmp_path, pattern, order):
    data = raws.dng(MOSAIC, pattern, order)
    frame = read_frame(write(tmp_path / "a.dng", data))
    assert np.array_equal(frame.pixels, MOSAIC) and frame.pixels.dtype == np.uint16
    assert frame.pattern == pattern
    assert frame.mid_unix_s is None
    assert np.array_equal(decode_frame(data, "IMG_0001.DNG").pixels, MOSAIC)


@needs_rawpy
@pytest.mark.parametrize("kept", [0.02, 0.5, 0.99])
def test_a_raw_file_that_breaks_off_is_no_frame(tmp_path, kept):
    whole = raws.dng(MOSAIC)
    for cut in (whole[: int(kept * len(whole))], whole[:-1]):
        with pytest.raises(FrameError, match="not a whole raw file"):
            read_frame(write(tmp_path / "a.dng", cut))


@needs_rawpy
def test_a_raw_file_whose_rest_was_never_written_is_no_frame(tmp_path):
    whole = raws.dng(MOSAIC)
    with pytest.raises(FrameError, match="last row is empty"):
        read_frame(write(tmp_path / "a.dng", whole[: len(whole) // 2].ljust(len(whole), b"\0")))


@pytest.mark.parametrize("quality", [[], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]])
def test_a_jpeg_that_breaks_off_is_no_frame_and_what_follows_one_does_not_matter(tmp_path, quality):
    whole = cv2.imencode(".jpg", (MOSAIC >> 8).astype(np.uint8), quality)[1].tobytes()
    assert read_frame(write(tmp_path / "a.jpg", whole + b"\0" * 100)).pixels.shape == MOSAIC.shape
    for cut in (whole[:-2], whole[:-1], whole[: len(whole) // 2], whole[: len(whole) // 2] + b"\0" * 5000):
        with pytest.raises(FrameError, match="not a whole"):
            read_frame(write(tmp_path / "a.jpg", cut))


def test_a_picture_stays_as_the_sensor_has_it_however_the_camera_was_held():
    grey = (MOSAIC >> 8).astype(np.uint8)
    data = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    pixels = decode_frame(raws.with_exif(data, orientation=6), "a.jpg").pixels
    assert pixels.shape == grey.shape and abs(pixels.astype(int) - grey).max() < 5


@needs_exifread
@pytest.mark.parametrize(
    ("name", "make"),
    [
        pytest.param("a.dng", lambda **e: raws.dng(MOSAIC, **e), marks=needs_rawpy),
        pytest.param("a.nef", lambda **e: raws.dng(MOSAIC, order=">", **e), marks=needs_rawpy),
        ("a.jpg", jpeg),
        ("a.tif", picture_tiff),
    ],
)
def test_the_cameras_clock_counts_only_where_somebody_vouches_for_it(tmp_path, name, make):
    path = write(tmp_path / name, make(subsec="25"))
    unasked = read_frame(path)
    assert (unasked.mid_unix_s, unasked.exposure_s, unasked.clock_stddev_s) == (None, 0.5, 0.0)
    frame = read_frame(path, TEHRAN)
    assert frame.mid_unix_s == pytest.approx(SHOWN_S - 3.5 * 3600 + 0.255 + 0.25, abs=1e-6)
    assert frame.stamp_stddev_s == pytest.approx(np.hypot(0.01 / np.sqrt(12), UNKNOWN_LATENCY_S))
    assert (frame.exposure_s, frame.clock_stddev_s) == (0.5, 2.0)


@needs_exifread
@pytest.mark.parametrize("subsec", [None, "", "00", "  ", "x"])
def test_whole_seconds_are_known_to_a_third_of_a_second(tmp_path, subsec):
    frame = read_frame(write(tmp_path / "a.jpg", jpeg(subsec=subsec)), CameraClock(0.0))
    assert frame.stamp_stddev_s == pytest.approx(np.hypot(0.2887, UNKNOWN_LATENCY_S), abs=1e-4)
    assert frame.mid_unix_s == pytest.approx(SHOWN_S + 0.5 + 0.25)
    assert frame.clock_stddev_s == 60.0


@needs_exifread
@pytest.mark.parametrize("step", [1.0, 0.1, 0.01])
def test_the_error_of_a_clock_that_counts_in_steps_is_as_large_as_it_is_said_to_be(tmp_path, rng, step):
    away, claimed = [], 0.0
    for true in rng.uniform(0.2, 59.0, 200):
        whole, rest = divmod(true, 1.0)
        subsec = f"{int(rest / step):0{round(-np.log10(step))}d}" if step < 1 else None
        start = f"2026:11:02 18:00:{int(whole):02d}"
        frame = read_frame(write(tmp_path / "a.jpg", jpeg(start=start, subsec=subsec)), CameraClock(0.0))
        if subsec and not int(subsec):
            # Such are taken for no fraction.
            continue
        away.append(frame.mid_unix_s - frame.exposure_s / 2 - SHOWN_S - true)
        claimed = np.sqrt(frame.stamp_stddev_s**2 - UNKNOWN_LATENCY_S**2)
    assert abs(np.mean(away)) < 4 * claimed / np.sqrt(len(away))
    assert np.std(away) == pytest.approx(claimed, rel=0.15)


@needs_exifread
def test_the_zone_is_the_files_own_or_the_users(tmp_path):
    path = write(tmp_path / "a.jpg", jpeg(offset="-02:30"))
    for clock, offset_h in ((CameraClock(), -2.5), (CameraClock(1.0), 1.0)):
        assert read_frame(path, clock).mid_unix_s == pytest.approx(SHOWN_S - 3600 * offset_h + 0.75)
    for offset in (None, "", "Z", "+3", "   :  "):
        path = write(tmp_path / "b.jpg", jpeg(offset=offset))
        assert "no zone" in why_no_time(read_frame(path, CameraClock()))
        assert read_frame(path, CameraClock(0.0)).mid_unix_s == pytest.approx(SHOWN_S + 0.75)


@needs_exifread
@pytest.mark.parametrize(
    "start", ["0000:00:00 00:00:00", "    :  :     :  :  ", "1970:01:01 00:00:00", "now", ""]
)
def test_a_clock_that_was_never_set_is_said(tmp_path, start):
    path = write(tmp_path / "a.jpg", jpeg(start=start))
    frame = read_frame(path, TEHRAN)
    assert frame.mid_unix_s is None and "set the camera's clock" in why_no_time(frame)
    assert "--exif-utc-offset" in why_no_time(read_frame(path))


@needs_exifread
@pytest.mark.parametrize(
    "exif", [{"start": None}, {"exposure": None}, {"exposure": (1, 0)}, {"exposure": (0, 1)}]
)
def test_without_a_start_or_an_exposure_there_is_no_time_and_it_is_said_which_lacks(tmp_path, exif):
    frame = read_frame(write(tmp_path / "a.jpg", jpeg(**exif)), TEHRAN)
    assert frame.mid_unix_s is None
    assert ("ExposureTime" if "exposure" in exif else "DateTimeOriginal") in why_no_time(frame)


@needs_exifread
def test_a_name_has_the_time_where_no_exif_has_one(tmp_path):
    for name in ("image-20261102180000.jpg", "ccd1_20261102_180000.jpg", "2026-11-02T180000_Alt40.jpg"):
        frame = read_frame(write(tmp_path / name, jpeg(start=None, exposure=None)), TEHRAN)
        assert frame.mid_unix_s == SHOWN_S - 3.5 * 3600 and frame.stamp_stddev_s >= 15
        assert read_frame(tmp_path / name).mid_unix_s is None
    # the zone is not in the name; a longer number, a month 13 and a day alone are no times
    assert read_frame(tmp_path / name, CameraClock()).mid_unix_s is None
    for name in ("120261102180000.jpg", "20261332_180000.jpg", "20261102.jpg"):
        assert read_frame(write(tmp_path / name, jpeg(start=None)), TEHRAN).mid_unix_s is None


@needs_exifread
def test_indi_allsky_stamps_the_end_in_local_time_as_gps_time_too(tmp_path):
    image = {0x131: (raws.ASCII, "indi-allsky"), 0x829A: (raws.RATIONAL, (30, 1))}
    gps = ("2026:11:02", (18, 0, 0))
    path = write(tmp_path / "a.tif", picture_tiff(image, exposure=None, gps=gps))
    frame = read_frame(path, TEHRAN)
    assert frame.exposure_s == 30 and frame.mid_unix_s == pytest.approx(SHOWN_S - 3.5 * 3600 + 0.5 - 15)
    assert "no zone" in why_no_time(read_frame(path, CameraClock()))


@needs_exifread
def test_gps_time_gives_the_zone_and_is_held_against_the_one_that_is_stated(tmp_path):
    """18:00:00 in a zone of 3.5 h is 14:30 UTC; GPS gave the time of its last fix, 40 s before."""
    path = write(tmp_path / "a.jpg", jpeg(gps=("2026:11:02", (14, 29, 20))))
    for clock in (CameraClock(), TEHRAN):
        assert read_frame(path, clock).mid_unix_s == pytest.approx(SHOWN_S - 3.5 * 3600 + 0.75)
    frame = read_frame(path, CameraClock(1.0))
    assert frame.mid_unix_s is None and re.search(
        r"GPS.* 3\.51 h ahead of UTC, and not 1 h", why_no_time(frame)
    )
    told = write(tmp_path / "b.jpg", jpeg(offset="+01:00", gps=("2026:11:02", (14, 29, 20))))
    assert "GPS" in why_no_time(read_frame(told, CameraClock()))
    for broken in (("2026:13:02", (14, 29, 20)), ("2026:11:02", (25, 0, 0))):
        path = write(tmp_path / "c.jpg", jpeg(gps=broken))
        assert "no zone" in why_no_time(read_frame(path, CameraClock()))


@needs_exifread
@pytest.mark.parametrize(
    ("lens", "fisheye"),
    [("EF8-15mm f/4L FISHEYE USM", True), ("AF Fish-Eye-Nikkor 16mm f/2.8D", True), ("EF24-105mm f/4L IS USM", False),
     (None, False)],
)  # fmt: skip
def test_a_lens_that_is_called_a_fisheye_is_one(tmp_path, lens, fisheye):
    assert read_frame(write(tmp_path / "a.jpg", jpeg(lens=lens))).fisheye is fisheye


@needs_exifread
@pytest.mark.parametrize(
    ("size", "cropped"), [(None, False), ((1280, 960), False), ((960, 1280), False), ((1280, 720), True)]
)
def test_a_picture_of_another_shape_than_the_cameras_is_a_crop_of_unknown_place(tmp_path, size, cropped):
    origin = read_frame(write(tmp_path / "a.jpg", jpeg(size=size))).origin_px
    assert np.isnan(origin).all() if cropped else origin is None


@pytest.mark.parametrize("given", [(15.0, 1.0), (float("nan"), 1.0), (0.0, -1.0), (0.0, float("inf"))])
def test_a_clock_that_cannot_be_is_refused(given):
    with pytest.raises(TimeError, match="give"):
        CameraClock(*given)


def test_a_missing_exifread_matters_only_to_those_who_want_a_time(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "exifread", None)
    path = write(tmp_path / "a.jpg", jpeg())
    assert read_frame(path).exposure_s is None
    with pytest.raises(FrameError, match="pip install exifread"):
        read_frame(path, TEHRAN)


@needs_exifread
@needs_rawpy
@pytest.mark.parametrize("name", ["a.dng", "a.jpg", "a.tif"])
def test_nothing_but_a_frame_error_comes_of_damaged_camera_files(tmp_path, rng, name):
    exif = {"subsec": "25", "offset": "+03:30"}
    whole = {"a.dng": raws.dng(MOSAIC, **exif), "a.jpg": jpeg(**exif), "a.tif": picture_tiff(**exif)}[name]
    for _ in range(300):
        bad = bytearray(whole)
        for place in rng.integers(0, min(len(whole), 700), rng.integers(1, 12)):
            bad[place] = rng.integers(256)
        with contextlib.suppress(FrameError):
            assert isinstance(read_frame(write(tmp_path / name, bad), TEHRAN), Frame)


@needs_rawpy
@pytest.mark.parametrize("name", ["a.dng", "a.jpg", "a.tif"])
def test_of_a_broken_file_nothing_is_kept(name):
    """Its bytes are many, and the collector of cycles counts objects, not bytes."""
    data = {"a.dng": raws.dng(MOSAIC), "a.jpg": jpeg(), "a.tif": picture_tiff()}[name][:-30]
    held = sys.getrefcount(data)
    gc.disable()
    try:
        for _ in range(3):
            with contextlib.suppress(FrameError):
                decode_frame(data, name)
                pytest.fail("it was taken for whole")
        assert sys.getrefcount(data) == held
    finally:
        gc.enable()
