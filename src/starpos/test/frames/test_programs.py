# SPDX-License-Identifier: Apache-2.0
"""What the headers of other people's programs say of time, exposure, scale, crop and stack.

Cards and comments are those that the programs write, by: MaxIm DL's help (FITS File Header Definitions, SBFITSEXT 1.0),
INDI's `CCD::addFITSKeywords`, Siril's FITS keywords, and headers that users of the others have published.
"""

from datetime import datetime, timezone

import cv2
import numpy as np
import pytest
from astropy.io import fits

from starpos.frames.exif import CameraClock
from starpos.frames.exposure import UNKNOWN_LATENCY_S
from starpos.frames.header import site
from starpos.frames.reading import read_frame, why_no_time
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

PIXELS = np.arange(48, dtype=np.uint16).reshape(6, 8)
WHOLE = (0.0, 0.0)


def written(path, cards):
    """A FITS file with these cards, each a value or a value and its comment."""
    header = fits.Header(
        [(key, *(told if isinstance(told, tuple) else (told,))) for key, told in cards.items()]
    )
    fits.PrimaryHDU(PIXELS, header).writeto(path)
    return path


def unix(text):
    return datetime.fromisoformat(text).replace(tzinfo=timezone.utc).timestamp()


# name: (cards, middle of the exposure or words of the reason, its length, focal length in px, place on the sensor)
FITS = {
    "MaxIm DL": (
        {"DATE-OBS": "2018-07-04T14:03:03", "EXPTIME": 300.0, "EXPOSURE": 300.0, "XPIXSZ": 7.4, "FOCALLEN": 1425.0,
         "XBINNING": 1, "XORGSUBF": (0, "Subframe X position in binned pixels"), "YORGSUBF": 0, "SNAPSHOT": 1},
        "2018-07-04T14:05:33", 300.0, 1425e3 / 7.4, WHOLE),
    "MaxIm DL, a subframe of 2 x 2 pixels": (
        {"DATE-OBS": "2017-06-22T12:28:02", "EXPTIME": 10.0, "EXPOSURE": 10.0, "XPIXSZ": 12.0, "FOCALLEN": 577.0,
         "XBINNING": 2, "YBINNING": 2, "XORGSUBF": 768, "YORGSUBF": 1136},
        "2017-06-22T12:28:07", 10.0, 577e3 / 12, (768.0, 1136.0)),
    "MaxIm DL, a stack": (
        {"DATE-OBS": "2018-07-04T14:03:03", "EXPTIME": 300.0, "EXPOSURE": 300.0, "SNAPSHOT": 4},
        "stack of 4", None, None, None),
    "N.I.N.A.": (
        {"EXPOSURE": 30.0, "EXPTIME": 30.0, "DATE-LOC": "2021-03-02T21:19:00.455", "XBINNING": 1,
         "DATE-OBS": "2021-03-02T20:19:00.455", "XPIXSZ": 4.63, "FOCALLEN": 400.0, "ROWORDER": "TOP-DOWN"},
        "2021-03-02T20:19:15.455", 30.0, 400e3 / 4.63, None),
    "N.I.N.A. 3": (
        {"EXPOSURE": 30.0, "EXPTIME": 30.0, "DATE-LOC": "2024-03-02T21:19:00.455", "XPIXSZ": 3.76,
         "DATE-OBS": "2024-03-02T20:19:00.455", "DATE-AVG": "2024-03-02T20:19:15.4671", "MJD-OBS": 60371.8465330440,
         "MJD-AVG": 60371.8467067950, "FOCALLEN": 400.0},
        "2024-03-02T20:19:15.467", 30.0, 400e3 / 3.76, None),
    "SharpCap 4": (
        {"EXPTIME": 2, "XPIXSZ": 2.4, "DATE-OBS": ("2025-03-19T22:51:59.3846323", "System Clock:Est. Frame Start"),
         "DATE-END": ("2025-03-19T22:52:01.3846323", "System Clock:Est. Frame End"),
         "DATE-AVG": ("2025-03-19T22:52:00.3846323", "System Clock:Est. Frame Mid Point")},
        "2025-03-19T22:52:00.384632", 2.0, None, None),
    "SharpCap 4, a live stack": (
        {"EXPTIME": 280, "DATE-OBS": "2025-03-19T22:51:59.3846323", "DATE-END": "2025-03-19T23:03:40.4689935",
         "DATE-AVG": "2025-03-19T22:57:49.9268129"},
        "contradict", None, None, None),
    "SharpCap 3": (
        {"EXPTIME": 2, "DATE-OBS": ("2019-04-29T20:25:29.8219583", "System Clock-Frame Grabbed")},
        "2019-04-29T20:25:28.821958", 2.0, None, None),
    "ASIAIR": (
        {"EXPOSURE": 300.0, "EXPTIME": 300.0, "DATE-OBS": "2025-09-08T02:46:15.614262", "FOCALLEN": 247,
         "XPIXSZ": 2.40000009536743, "IMAGEW": 5496, "IMAGEH": 3672, "CCDXBIN": 1},
        "2025-09-08T02:48:45.614262", 300.0, 247e3 / 2.40000009536743, None),
    "Seestar, a stack": (
        {"STACKCNT": 187, "EXPOSURE": 10.0, "EXPTIME": 10.0, "TOTALEXP": 1870.0, "XORGSUBF": 0, "YORGSUBF": 0,
         "DATE-OBS": ("2025-05-13T22:48:35.751879", "Image created time"), "FOCALLEN": 250,
         "XPIXSZ": 2.90000009536743},
        "stack of 187", None, 250e3 / 2.90000009536743, WHOLE),
    "Seestar": (
        {"EXPOSURE": 10.0, "EXPTIME": 10.0, "DATE-OBS": ("2025-05-13T22:48:35.751879", "Image created time")},
        "Image created time", 10.0, None, None),
    "DWARF II": (
        {"DATE-OBS": ("2023-06-10T21:38:19.442", "Time start to exposure"), "DATE": "2023-06-10T21:38:35.938",
         "EXP": (15.0, "[s] Sub Exposure Time"), "BINNING": "2*2"},
        "2023-06-10T21:38:26.942", 15.0, None, None),
    "DWARF 3, a header of little": ({"EXPTIME": 15.0}, "needs DATE-OBS", 15.0, None, None),
    "Siril": (
        {"DATE-OBS": "2023-03-02T20:19:00.455", "EXPTIME": 30.0, "STACKCNT": 1, "LIVETIME": 30.0, "XPIXSZ": 3.76,
         "FOCALLEN": 400.0},
        "2023-03-02T20:19:15.455", 30.0, 400e3 / 3.76, None),
    "Siril, a stack": (
        {"DATE-OBS": "2023-03-02T20:19:00.455", "EXPTIME": 30.0, "STACKCNT": 20, "LIVETIME": 600.0,
         "EXPSTART": 2460006.34653304, "EXPEND": 2460006.35347748},
        "stack of 20", None, None, None),
    "Siril, a stack without its number": (
        {"DATE-OBS": "2023-03-02T20:19:00.455", "EXPTIME": 30.0, "LIVETIME": 600.0}, "LIVETIME", None, None, None),
    "INDI": (
        {"DATE-OBS": "2023-03-02T20:19:00.455", "EXPTIME": 2.0, "PIXSIZE1": 3.76, "XBINNING": 2, "XPIXSZ": 7.52,
         "FOCALLEN": 400.0, "SCALE": 3.87844, "ROWORDER": "TOP-DOWN"},
        "2023-03-02T20:19:01.455", 2.0, 400e3 / 7.52, None),
    "INDI, by its scale alone": (
        {"DATE-OBS": "2023-03-02T20:19:00.455", "EXPTIME": 2.0, "SCALE": 3.87844},
        "2023-03-02T20:19:01.455", 2.0, 206264.8 / 3.87844, None),
    "a cut-out by IRAF": ({"LTV1": -603.0, "LTV2": -335.0, "LTM1_1": 1.0}, "needs DATE-OBS", None, None, (603.0, 335.0)),
    "a reduced one by IRAF": ({"LTV1": -603.0, "LTV2": 0.0, "LTM1_1": 0.5}, "needs DATE-OBS", None, None, "unknown"),
    "a subframe that is no number": ({"XORGSUBF": "left", "YORGSUBF": 0}, "needs DATE-OBS", None, None, "unknown"),
}  # fmt: skip


@pytest.mark.parametrize("program", FITS)
def test_a_header_says_when_how_long_how_large_and_where_on_the_sensor(tmp_path, program):
    cards, middle, exposure_s, focal_px, origin = FITS[program]
    frame = read_frame(written(tmp_path / "a.fits", cards))
    if middle[:2] == "20":
        assert frame.mid_unix_s == pytest.approx(unix(middle), abs=2e-4)
    else:
        assert frame.mid_unix_s is None and middle in why_no_time(frame)
    assert frame.exposure_s == exposure_s
    assert frame.focal_px == (focal_px if focal_px is None else pytest.approx(focal_px, rel=1e-6))
    if origin == "unknown":
        assert np.isnan(frame.origin_px).all()
    else:
        assert frame.origin_px == origin


def test_a_frame_that_was_grabbed_came_later_than_its_exposure_ended(tmp_path):
    frame = read_frame(written(tmp_path / "a.fits", FITS["SharpCap 3"][0]))
    assert frame.stamp_stddev_s == pytest.approx(UNKNOWN_LATENCY_S)


# name: (EXIF, the picture's size, hours of the zone that the user states, start, focal length in px, whether cropped)
CAMERAS = {
    "Canon": (
        {"start": "2026:11:02 18:00:00", "subsec": "47", "offset": "+03:30", "exposure": (4, 1), "focal": (200, 1),
         "plane": (5616000, 1459), "unit": 2, "size": (5616, 3744)},
        (150, 100), None, "2026-11-02T14:30:00.475", 200 * 5616000 / 1459 / 25.4 / 5616 * 150, False),
    "Nikon, of before zones": (
        {"start": "2026:11:02 18:00:00", "subsec": "50", "exposure": (1, 2), "focal": (500, 10), "film_mm": 75,
         "size": (6000, 4000)},
        (160, 120), 1.0, "2026-11-02T17:00:00.505", 75 / 43.267 * np.hypot(160, 120), True),
    "Apple": (
        {"start": "2026:11:02 18:00:00", "subsec": "123", "offset": "-07:00", "exposure": (1, 1), "film_mm": 26,
         "size": (4032, 3024), "gps": ("2026:11:03", (1, 0, 0))},
        (160, 120), None, "2026-11-03T01:00:00.1235", 26 / 43.267 * np.hypot(160, 120), False),
    "Raspberry Pi": (
        {"start": "2026:11:02 18:00:00", "exposure": (2000000, 1000000)},
        (160, 120), 0.0, "2026-11-02T18:00:00.500", None, False),
}  # fmt: skip


@needs("exifread")
@pytest.mark.parametrize("camera", CAMERAS)
def test_a_cameras_picture_says_when_how_long_how_large_and_whether_it_was_cropped(tmp_path, camera):
    exif, size, zone_h, start, focal_px, cropped = CAMERAS[camera]
    jpeg = cv2.imencode(".jpg", np.zeros(size[::-1], np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(raws.with_exif(jpeg, **exif))
    frame = read_frame(tmp_path / "a.jpg", CameraClock(zone_h, 2.0))
    exposure_s = exif["exposure"][0] / exif["exposure"][1]
    assert frame.exposure_s == exposure_s
    assert frame.mid_unix_s == pytest.approx(unix(start[:23]) + exposure_s / 2, abs=1e-3)
    assert frame.rough_focal_px == (focal_px if focal_px is None else pytest.approx(focal_px, rel=1e-4))
    assert (frame.origin_px is not None) == cropped


SITES = [
    ({"SITELAT": 47.1, "SITELONG": -11.3}, (47.1, -11.3)),
    ({"SITELAT": "+47 06", "SITELONG": "-11:18:00"}, (47.1, -11.3)),
    ({"LAT-OBS": "S33 52 12", "LONG-OBS": "151.2 E"}, (-33.87, 151.2)),
    ({"LAT-OBS": "44.5 N", "LONG-OBS": "W 8.2"}, (44.5, -8.2)),
    ({"OBSGEO-B": 50.0, "OBSGEO-L": 350.0}, (50.0, 350.0)),
    # programs leave 0, 0 for none
    ({"SITELAT": 0.0, "SITELONG": 0.0, "LAT-OBS": 44.5, "LONG-OBS": 8.2}, (44.5, 8.2)),
    ({"SITELAT": "home", "SITELONG": 8.2, "LAT-OBS": 44.5, "LONG-OBS": 8.2}, (44.5, 8.2)),
    ({"SITELAT": 0, "SITELONG": 0}, None),
    ({"SITELAT": 95, "SITELONG": 8}, None),
    ({"SITELAT": "", "SITELONG": "", "LAT-OBS": None}, None),
    ({"SITELAT": 44.5}, None),
    ({"SITELAT": "nan", "SITELONG": "nan"}, None),
]


@pytest.mark.parametrize(("header", "deg"), SITES)
def test_the_site_is_of_the_first_cards_that_state_one(header, deg):
    found = site(header)
    if deg is None:
        assert found == {}
    else:
        assert found["site_deg"] == pytest.approx(deg)
        assert found["site_cards"].startswith(list(header)[-2])
