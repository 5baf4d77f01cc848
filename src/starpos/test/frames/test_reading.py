# SPDX-License-Identifier: Apache-2.0
import contextlib
import io
import os
import struct
import sys
import warnings
import zlib
from datetime import datetime, timezone

import cv2
import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time, TimeDelta
from astropy.utils import iers

from starpos.errors import LETTERS, FrameError, one_line
from starpos.frames.fits import read_fits
from starpos.frames.frame import Frame
from starpos.frames.header import read_times
from starpos.frames.reading import read_frame, why_no_time

PIXELS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
NIGHT = {"DATE-OBS": "2026-11-02T18:00:00.125", "EXPTIME": 0.5}


def write_fits(path, data=PIXELS, **cards):
    header = fits.Header()
    for key, value in cards.items():
        header[key.replace("_", "-")] = value
    fits.PrimaryHDU(data, header).writeto(path)
    return path


def unix(*date):
    return datetime(*date, tzinfo=timezone.utc).timestamp()


def test_fits_rows_time_and_focal_length(tmp_path):
    frame = read_frame(write_fits(tmp_path / "a.fits", **NIGHT, FOCALLEN=600.0, XPIXSZ=6.4, BAYERPAT="RGGB"))
    assert np.array_equal(frame.pixels, PIXELS) and frame.pixels.dtype == np.uint16
    assert frame.pixels.dtype.isnative
    assert frame.mid_unix_s == pytest.approx(unix(2026, 11, 2, 18) + 0.375, abs=1e-6)
    assert (frame.exposure_s, frame.pattern) == (0.5, "rggb")
    assert frame.focal_px == pytest.approx(93750.0)


@pytest.mark.parametrize(
    ("right", "down", "pattern"), [(0, 0, "rggb"), (1, 0, "grbg"), (0, 1, "gbrg"), (3, -1, "bggr")]
)
def test_a_mosaic_that_is_shifted_begins_with_another_colour(tmp_path, right, down, pattern):
    cards = {"BAYERPAT": "RGGB", "XBAYROFF": right, "YBAYROFF": down}
    assert read_frame(write_fits(tmp_path / "a.fits", **cards)).pattern == pattern


def test_an_exposure_across_a_leap_second_is_counted_in_real_seconds(tmp_path):
    # 23:59:59.5 + 3 s / 2 = 24:00:01.0 - one second inserted = 00:00:00.0 of the next day
    cards = {"DATE-OBS": "2016-12-31T23:59:59.5", "EXPTIME": 3.0}
    assert read_frame(write_fits(tmp_path / "a.fits", **cards)).mid_unix_s == pytest.approx(
        unix(2017, 1, 1), abs=1e-6
    )


@pytest.mark.parametrize(
    ("cards", "middle"),
    [
        ({"DATE-BEG": "2026-11-02T18:00:00Z", "EXPOSURE": 2}, unix(2026, 11, 2, 18, 0, 1)),
        ({"MJD-OBS": 61346.75, "EXPTIME": 0.5}, unix(2026, 11, 2, 18) + 0.25),
        ({"DATE-OBS": "2026-11-02", "TIME-OBS": "18:00:00", "EXPTIME": 2}, unix(2026, 11, 2, 18, 0, 1)),
        ({"DATE-OBS": "2026-11-02", "UT": "18:00:00", "EXPTIME": 2}, unix(2026, 11, 2, 18, 0, 1)),
        ({"DATE-OBS": "2026-11-02", "MJD-OBS": 61346.75, "EXPTIME": 2}, unix(2026, 11, 2, 18, 0, 1)),
        ({"DATE-OBS": "2026-11-02T18:00:37", "TIMESYS": "TAI", "EXPTIME": 2}, unix(2026, 11, 2, 18, 0, 1)),
        (
            {"DATE-OBS": "2026-11-02 18:00:00", "TIME-OBS": "18:00:00", "EXPTIME": 2},
            unix(2026, 11, 2, 18, 0, 1),
        ),
        ({"DATE-OBS": "02/11/97", "TIME-OBS": "18:00:00", "EXPTIME": 2}, unix(1997, 11, 2, 18, 0, 1)),
        ({"DATE-AVG": "2026-11-02T18:00:01"}, unix(2026, 11, 2, 18, 0, 1)),
        ({"DATE-OBS": "2026-11-02T18:00:00", "EXPTIME": 0}, None),
        ({"DATE-OBS": "2026-11-02", "EXPTIME": 1}, None),
        ({"DATE-OBS": "02/11/97", "EXPTIME": 1}, None),
        ({"DATE-OBS": "2026-11-02T18:00:00"}, None),
        ({}, None),
    ],
)
def test_the_ways_a_header_can_tell_the_time_or_not(tmp_path, cards, middle):
    found = read_frame(write_fits(tmp_path / "a.fits", **cards)).mid_unix_s
    assert found is None if middle is None else found == pytest.approx(middle, abs=2e-6)


@pytest.mark.parametrize(
    ("mjd", "sigma_s"),
    [(61346.75, 864 / np.sqrt(3)), (61346.75017, 0.864 / np.sqrt(3)), (61346.750173611, 0.0),
     (61346, 86400 / np.sqrt(3))],
)  # fmt: skip
def test_an_mjd_of_few_decimals_has_the_error_of_its_last(tmp_path, mjd, sigma_s):
    frame = read_frame(write_fits(tmp_path / "a.fits", **{"MJD-OBS": mjd, "EXPTIME": 1}))
    assert frame.stamp_stddev_s == pytest.approx(sigma_s, rel=1e-6)


HARD_TIMES = [
    "2016-12-31T23:59:60.5", "2016-12-31T23:59:59.9", "2015-06-30T23:59:60", "2026-11-02T18:00", "2026-11-02T24:00:00",
    "2026-02-30T18:00:00", "1955-01-01T00:00:00", "1969-06-01T00:00:00.25", "2026-11-02T18:60:00",
    "2026-11-02t18:00:00", "2026-11-02T18:00:00+01:00", "2026-11-02T18:00:00.", "2026-11-02T18:00:0", "2026-306T18:00:00",
    "-026-11-02T18:00:00", "2050-07-01T12:00:00.123456", 60000.25, 57753.99999, -1e4,
]  # fmt: skip


@pytest.mark.parametrize("scale", ["UTC", "TAI", "TT", "TDB"])
def test_times_are_those_of_astropy(scale):
    """Leap seconds, years without them, invalid dates: the middle of exposures to a microsecond, or a refusal."""
    iers.conf.auto_download = False
    for start in HARD_TIMES:
        key, form = ("DATE-OBS", "isot") if isinstance(start, str) else ("MJD-OBS", "mjd")
        for exposure_s in (0.25, 1.5, 3600.0):
            header = {key: start, "EXPTIME": exposure_s, "TIMESYS": scale}
            try:
                # astropy takes any seconds up to 60, and other scales have no leap seconds
                if scale != "UTC" and ":60" in str(start):
                    raise ValueError
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    begin = Time(start, format=form, scale=scale.lower())
                    middle = float((begin.utc + TimeDelta(exposure_s / 2, format="sec")).unix)
            except ValueError:
                assert "no time" in read_times(header).untimed
                continue
            assert read_times(header).mid_unix_s == pytest.approx(middle, abs=1e-6), (start, exposure_s)


@pytest.mark.parametrize("key", ["DATE-OBS", "DATE-BEG"])
def test_a_date_that_is_a_number_is_no_time(tmp_path, key):
    frame = read_frame(write_fits(tmp_path / "a.fits", **{key: 61346.75, "EXPTIME": 1}))
    assert frame.mid_unix_s is None and f"{key} is 61346.75, which is no text" in why_no_time(frame)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (np.array([[0, 200]], np.uint8), [[0, 200]]),
        (np.array([[-5, 100]], np.int16), [[0, 105]]),
        (np.array([[0, 70000]], np.int32), [[0, 65535]]),
        (np.array([[10.4, 60000.6]], np.float32), [[10, 60001]]),
        (np.array([[0.0, 0.5, 1.0]], np.float64), [[0, 32768, 65535]]),
        (np.array([[7.0, 7.0]], np.float64), [[7, 7]]),
    ],
)
def test_every_kind_of_number_becomes_an_unsigned_one_by_the_stated_rule(tmp_path, values, expected):
    assert read_frame(write_fits(tmp_path / "a.fits", values)).pixels.tolist() == expected


def test_a_few_pixels_without_a_value_take_the_median(tmp_path):
    values = np.full((20, 20), 5000.0)
    values[0, 0], values[3, 4], values[5, 5] = 10000, np.nan, 0
    assert read_frame(write_fits(tmp_path / "a.fits", values)).pixels[3, 4] == 5000


def test_compressed_fits_is_read_like_plain(tmp_path):
    header = fits.Header(NIGHT)
    big = np.tile(PIXELS, (40, 40))
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(big, header, compression_type="RICE_1")])
    hdus.writeto(tmp_path / "a.fits.fz")
    frame = read_frame(tmp_path / "a.fits.fz")
    assert np.array_equal(frame.pixels, big) and frame.exposure_s == 0.5


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_pictures_keep_their_depth_and_have_no_time(tmp_path, suffix):
    path = str(tmp_path / f"a{suffix}")
    for pixels in (PIXELS, PIXELS.astype(np.uint8), np.dstack([PIXELS // 300] * 3).astype(np.uint8)):
        assert cv2.imwrite(path, pixels)
        frame = read_frame(path)
        assert np.array_equal(frame.pixels, pixels) and frame.pixels.dtype == pixels.dtype
        assert frame.mid_unix_s is None
    assert cv2.imwrite(path, np.dstack([PIXELS, PIXELS, PIXELS]))
    assert np.abs(read_frame(path).pixels.astype(int) - PIXELS).max() <= 1


CSV = '# {"DATE-OBS": "2026-11-02T18:00:00", "EXPTIME": 0.5, "NAXIS1": 640, "NAXIS2": 480}\n'


def test_a_list_of_centroids_becomes_stars_brightest_first(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(CSV + "x,y,flux,sigma\n1.5,2.5,10,0.05\n3,4,20,0.02\n")
    stars = read_frame(path)
    assert stars.x.tolist() == [3, 1.5] and stars.flux.tolist() == [20, 10]
    assert stars.covariance[1] == pytest.approx(np.diag([0.0025, 0.0025]))
    assert stars.snr == pytest.approx([50, 20])
    assert (stars.width, stars.height) == (640, 480)
    assert stars.mid_unix_s == pytest.approx(unix(2026, 11, 2, 18) + 0.25, abs=1e-6)
    path.write_text('# {"NAXIS1": 640, "NAXIS2": 480}\nx,y,flux\n1,2,3\n')
    assert read_frame(path).covariance[0] == pytest.approx(np.diag([0.01, 0.01]))
    assert read_frame(path).mid_unix_s is None
    path.write_text('# {"NAXIS1": 640, "NAXIS2": 480}\nx,y,flux\n')
    assert len(read_frame(path)) == 0


def test_a_missing_rawpy_is_told_with_the_line_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    (tmp_path / "a.nef").write_bytes(b"MM\0*")
    with pytest.raises(FrameError, match="pip install rawpy"):
        read_frame(tmp_path / "a.nef")


def huge_png():
    head = b"IHDR" + struct.pack(">IIBBBBB", 90000, 90000, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


def huge_fits():
    cards = [
        "SIMPLE  =                    T",
        "BITPIX  =                   16",
        "NAXIS   =                    2",
    ]
    cards += ["NAXIS1  =            999999999", "NAXIS2  =            999999999", "END"]
    return "".join(card.ljust(80) for card in cards).ljust(2880).encode()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.fits", b""),
        ("a.fits", b"not a fits file " * 300),
        ("a.fits", huge_fits()),
        # No pixels follow.
        ("a.fits", huge_fits().replace(b"999999999", b"        3")),
        ("a.fits", huge_fits().replace(b"999999999", b"       -3")),
        ("a.fits", huge_fits().replace(b"999999999", b"        0")),
        ("a.fits", huge_fits().replace(b"BITPIX  =                   16", b"BITPIX  =                   17")),
        ("a.png", b"\x89PNG\r\n\x1a\n"),
        ("a.png", huge_png()),
        ("a.tif", b"II*\0\x08\0\0\0\xff\xff"),
        ("a.tif", b"II*\0\xff\xff\xff\xff"),
        ("a.jpg", b"\xff\xd8\xff"),
        ("a.csv", b"x,y,flux\n1,2,3\n"),
        ("a.csv", b"\xff\xfe\0x"),
        ("a.csv", b'# {"NAXIS1": "a", "NAXIS2": 2}\nx,y,flux\n'),
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 0}\nx,y,flux\n'),
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y\n1,2\n'),
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y,flux\n1,2\n'),
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y,flux\n1,2,nan\n'),
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y,flux,sigma\n1,2,3,0\n'),
        ("a.csv", b"# [1, 2]\nx,y,flux\n"),
        # Over csv's field limit.
        ("a.csv", b'# {"NAXIS1": 9, "NAXIS2": 9}\nx,y,flux\n' + b"1" * 200_000),
        # Longer than a file system's names.
        (f"{'a' * 300}.fits", None),
        ("a\0.fits", None),
    ],
)
def test_a_file_that_is_no_frame_is_refused_in_one_sentence(tmp_path, name, content):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FrameError) as raised:
        read_frame(path)
    text = str(raised.value)
    assert text.startswith(f"{path}") and "\n" not in text


@pytest.mark.parametrize(
    ("data", "cards"),
    [
        (np.zeros((4, 4, 5), np.uint16), {}),
        (np.full((4, 4), np.nan, np.float32), {}),
        (np.array([[0.0, np.inf]]), {}),
        (PIXELS, {"BAYERPAT": "CMYG"}),
        (None, {}),
    ],
)
def test_an_absurd_header_is_refused(tmp_path, data, cards):
    with pytest.raises(FrameError):
        read_frame(write_fits(tmp_path / "a.fits", data, **cards))


@pytest.mark.parametrize(
    ("name", "content"), [("a.png", huge_png()), ("a.fits", huge_fits().replace(b"999999999", b"    99999"))]
)
def test_a_header_that_claims_gigabytes_is_refused_before_any_is_taken(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FrameError, match="claims"):
        read_frame(tmp_path / name)


def test_a_truncated_file_is_refused(tmp_path):
    big = np.tile(PIXELS, (100, 100))
    whole = write_fits(tmp_path / "a.fits", big, **NIGHT).read_bytes()
    cv2.imwrite(
        str(tmp_path / "b.tif"), np.random.default_rng(1).integers(0, 65535, (300, 300)).astype(np.uint16)
    )
    (tmp_path / "a.fits").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "b.tif").write_bytes((tmp_path / "b.tif").read_bytes()[:5000])
    for name in ("a.fits", "b.tif"):
        with pytest.raises(FrameError, match="image"):
            read_frame(tmp_path / name)


def test_nothing_but_a_frame_error_comes_of_damaged_bytes(tmp_path):
    rng = np.random.default_rng(2)
    write_fits(tmp_path / "a.fits", **NIGHT)
    cv2.imwrite(str(tmp_path / "a.png"), PIXELS)
    cv2.imwrite(str(tmp_path / "a.tif"), PIXELS)
    for name in ("a.fits", "a.png", "a.tif"):
        whole = bytearray((tmp_path / name).read_bytes())
        for _ in range(60):
            bad = bytearray(whole)
            for place in rng.integers(0, min(len(whole), 900), rng.integers(1, 12)):
                bad[place] = rng.integers(256)
            (tmp_path / f"bad-{name}").write_bytes(bad)
            with contextlib.suppress(FrameError):
                assert isinstance(read_frame(tmp_path / f"bad-{name}"), Frame)


def test_damaged_pictures_are_told_in_the_error_only(tmp_path, capfd):
    """Neither libpng nor OpenCV prints of its own accord."""
    pixels = np.random.default_rng(1).integers(0, 65535, (300, 300)).astype(np.uint16)
    for name in ("a.png", "a.tif"):
        path = tmp_path / name
        cv2.imwrite(str(path), pixels)
        whole = path.read_bytes()
        flipped = bytearray(whole)
        flipped[len(whole) // 2] ^= 255
        for damaged in (whole[: len(whole) // 2], whole[:-1], flipped):
            path.write_bytes(damaged)
            with pytest.raises(FrameError, match="PNG, TIFF, JPEG or BMP"):
                read_frame(path)
    # OpenCV before 4.7 cannot be kept from it for a TIFF
    told = [line for line in capfd.readouterr().err.splitlines() if line and "imdecode_" not in line]
    assert told == []


def test_what_a_png_says_besides_its_image_is_passed_over(tmp_path, capfd):
    cv2.imwrite(str(tmp_path / "a.png"), PIXELS)
    whole = (tmp_path / "a.png").read_bytes()
    profile = b"iCCPnothing of the kind"
    chunk = struct.pack(">I", len(profile) - 4) + profile + struct.pack(">I", zlib.crc32(profile))
    (tmp_path / "a.png").write_bytes(whole[:33] + chunk + whole[33:])
    assert np.array_equal(read_frame(tmp_path / "a.png").pixels, PIXELS)
    assert capfd.readouterr().err == ""


def test_what_is_no_file_is_told_as_what_it_is(tmp_path):
    folder = tmp_path / "night.fits"
    folder.mkdir()
    for path, words in (
        (tmp_path / "missing.fits", "no such file"),
        (write_fits(tmp_path / "a.fits") / "b.fits", "no such file"),
        (folder, r"folder.*night.fits/\*.fits"),
        ("/dev/null", "no regular file"),
    ):
        with pytest.raises(FrameError, match=words):
            read_frame(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
@pytest.mark.parametrize("name", ["a.fits", "a.png", "a.csv"])
def test_a_file_that_may_not_be_read(tmp_path, name):
    (tmp_path / name).write_bytes(b"x")
    (tmp_path / name).chmod(0)
    with pytest.raises(FrameError, match="Permission denied"):
        read_frame(tmp_path / name)


def test_a_file_that_may_not_be_opened(tmp_path):
    loop = tmp_path / "a.fits"
    loop.symlink_to(loop)
    with pytest.raises(FrameError, match="cannot be read"):
        read_frame(loop)


def test_the_bytes_of_a_fits_file_are_read_like_the_file_and_short_ones_refused(tmp_path):
    data = write_fits(tmp_path / "a.fits", np.tile(PIXELS, (50, 50)), **NIGHT).read_bytes()
    frame, header = read_fits(io.BytesIO(data), "the camera's frame")
    assert header == NIGHT
    assert np.array_equal(frame.pixels, read_frame(tmp_path / "a.fits").pixels)
    assert (frame.mid_unix_s, frame.source) == (unix(2026, 11, 2, 18) + 0.375, "the camera's frame")
    for length in (0, 100, 2880, 2881, len(data) - 2880):
        with pytest.raises(FrameError, match=r"^the camera's frame: .*\.$"):
            read_fits(io.BytesIO(data[:length]), "the camera's frame")


def test_what_a_library_says_is_cut_between_words():
    said = one_line("not a\nword of it " * 100)
    assert len(said) <= LETTERS + 4 and "\n" not in said
    assert said.split()[-2] in ("not", "a", "word", "of", "it") and said.endswith(" ...")
    assert one_line(ValueError()) == "ValueError"
