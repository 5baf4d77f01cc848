# SPDX-License-Identifier: Apache-2.0
"""About the focal length from EXIF: as cameras write it, of reduced pictures, and where it is nonsense."""

import cv2
import numpy as np
import pytest

from starpos.frames.reading import read_frame
from starpos_testing.lacking import needs
from starpos_testing.skies import raws

pytestmark = needs("exifread")
# of a full-frame camera of 5616 x 3744 px, 6.4 um
PLANE = {"focal": (50, 1), "plane": (3744000, 958), "unit": 2, "size": (5616, 3744)}


def focal_px(tmp_path, width=300, height=200, **exif):
    data = cv2.imencode(".jpg", np.zeros((height, width), np.uint8))[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(raws.with_exif(data, **exif))
    frame = read_frame(tmp_path / "a.jpg")
    # it is too rough for a fix
    assert frame.focal_px is None
    return frame.rough_focal_px


@needs("rawpy")
def test_a_dng_tells_it_too(tmp_path):
    (tmp_path / "a.dng").write_bytes(raws.dng(raws.mosaic(96, 128), film_mm=50))
    frame = read_frame(tmp_path / "a.dng")
    assert frame.rough_focal_px == pytest.approx(50 / 43.27 * np.hypot(128, 96), rel=1e-3)


@pytest.mark.parametrize(("film_mm", "field_deg"), [(50, 46.8), (24, 84.1), (400, 6.2)])
def test_the_equivalent_of_35_mm_film_gives_the_field_of_film(tmp_path, film_mm, field_deg):
    f = focal_px(tmp_path, film_mm=film_mm)
    assert 2 * np.degrees(np.arctan(np.hypot(300, 200) / 2 / f)) == pytest.approx(field_deg, abs=0.1)


def test_focal_length_and_resolution_of_the_sensor(tmp_path):
    assert focal_px(tmp_path, 5616, 3744, **PLANE) == pytest.approx(50 / 0.0065, rel=0.02)
    # a picture reduced to a tenth, in either position
    assert focal_px(tmp_path, 562, 374, **PLANE) == pytest.approx(5.0 / 0.0065, rel=0.02)
    assert focal_px(tmp_path, 374, 562, **PLANE) == pytest.approx(5.0 / 0.0065, rel=0.02)


@pytest.mark.parametrize(
    ("unit", "per_mm"), [(2, 25.4), (3, 10.0), (4, 1.0), (5, 1e-3), (None, 25.4), (9, 25.4)]
)
def test_units_of_the_resolution(tmp_path, unit, per_mm):
    plane = (round(154 * per_mm * 1000), 1000)
    assert focal_px(tmp_path, 562, 374, focal=(10, 1), plane=plane, unit=unit) == pytest.approx(
        1540, rel=0.01
    )


@pytest.mark.parametrize(
    "exif",
    [{}, {"film_mm": 0}, {"film_mm": 1}, {"focal": (50, 1)}, {"focal": (0, 1), "plane": (1000, 1)},
     {"focal": (50, 0), "plane": (1000, 1)}, {"focal": (50, 1), "plane": (0, 0)},
     {"focal": (4294967295, 1), "plane": (4294967295, 1)}],
)  # fmt: skip
def test_nonsense_is_no_focal_length(tmp_path, exif):
    assert focal_px(tmp_path, **exif) is None
