# SPDX-License-Identifier: Apache-2.0
"""The table of drivers in docs/how-to/existing_robot.md names only what the detector takes."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from starpos.frames.encodings import ENCODINGS, pixels_of
from starpos.frames.exposure import STAMPS
from starpos.parameters.table import defaults_of

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "existing_robot.md"
if not PAGE.is_file():
    pytest.skip("the documents are not here", allow_module_level=True)
TEXT = PAGE.read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in TEXT.split("## What drivers send")[1].splitlines()
    if line.startswith("| ")
][2:]
DRIVERS = ("camera_ros", "usb_cam", "v4l2_camera", "realsense2", "spinnaker", "pylon", "camera_aravis2")
ENCODING = re.compile(r"`((?:mono|rgb|bgr|bayer_|Bayer|Mono|yuv|nv|8|16)[\w]*\d\w*)`")


def test_every_driver_has_a_row():
    assert [any(row[0].startswith(name) for row in ROWS) for name in DRIVERS] == [True] * len(ROWS)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].split()[0])
def test_what_a_driver_sends_becomes_a_frame(row):
    named = ENCODING.findall(row[1]) + ENCODING.findall(row[5])
    assert len(named) >= 4
    for name in named:
        layout = ENCODINGS.get(name) or ENCODINGS[name.lower()]
        step = layout.row_bytes(6)
        pixels, _ = pixels_of(name, bytes(4 * step), 6, 4, step, False, "image_raw")
        assert pixels.shape[:2] == (4, 6) and pixels.dtype in (np.uint8, np.uint16)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0].split()[0])
def test_the_stamps_it_is_to_set_are_there(row):
    assert set(re.findall(r"`(\w+)`", row[4])) <= set(STAMPS) and "`" in row[4]


def test_the_file_of_the_page_says_what_no_driver_does():
    config = PAGE.parents[2] / "src" / "starpos_bringup" / "config" / "existing_robot.yaml"
    stated = yaml.safe_load(config.read_text())["/**/detector"]["ros__parameters"]
    assert list(stated) == ["stamp", "stamp_stddev", "exposure", "readout"]
    assert set(stated) <= set(defaults_of("detector"))
