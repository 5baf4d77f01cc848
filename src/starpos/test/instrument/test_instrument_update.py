# SPDX-License-Identifier: Apache-2.0
"""Instrument files that are there already: comments of people are seen, keys of people stay."""

from dataclasses import replace

import pytest

from starpos.errors import InstrumentError
from starpos.instrument import instrument_file
from starpos.instrument.instrument import Calibration, Instrument
from starpos.instrument.yaml_file import line_of_comment, own_comment, text_of

WRITTEN = text_of({"a": [1], "b": "x # no comment"}, "one line\n\nanother # of them")


def test_the_comment_that_was_written_is_known_until_it_is_changed():
    assert own_comment(WRITTEN) == "one line\n\nanother # of them\n"
    assert line_of_comment(WRITTEN) == 0
    assert own_comment(WRITTEN.replace("another", "and another")) == ""
    assert line_of_comment(WRITTEN.replace("another", "and another")) == 3
    assert line_of_comment(WRITTEN + "# more\n") == 3
    # a key below it is no change of it
    assert line_of_comment(WRITTEN + "c: 3\n") == 0


@pytest.mark.parametrize(
    ("text", "line"),
    {
        "# first\na: 1\n": 1,
        "a: 1 # behind\n": 1,
        "a: [1, # within\n 2]\n": 1,
        "a: 1\nb: 'x # y'\nc: x#y\n": 0,
        'a: "x # y"\n# last': 2,
        "a: | # of a block\n  text\n": 1,
        "a: 1\n": 0,
        "": 0,
    }.items(),
)
def test_a_comment_is_found_and_text_is_none(text, line):
    assert line_of_comment(text) == line


def test_a3_is_replaced_and_all_else_stays(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "starpos_instrument: 1\nremounted_arcsec: 300\nshutter: {readout_s: 0.03, readout_stddev_s: 0}\n"
        "camera: {focal_mm: 600, pixel_um: 6.4}\nmisalignment_deg: [9, 9, 9]\ncalibration_stddev_arcsec: [1, 2, 3]\n"
        "inclinometer: {model: scl3300}\n"
    )
    before = instrument_file.read(path)
    new = Instrument(93750.0, calibration=Calibration.of((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)))
    instrument_file.check_fits(path, new)
    instrument_file.update(path, new, "about it")
    after = instrument_file.read(path)
    assert after.calibration.misalignment_deg == (1, 2, 3)
    assert after.calibration.covariance_arcsec2 == new.calibration.covariance_arcsec2
    assert after.calibration.remounted_arcsec == 300
    assert (after.inclinometer, after.shutter) == (before.inclinometer, before.shutter)
    assert "focal_mm: 600" in path.read_text() and "# about it" in path.read_text()


def test_the_size_of_the_frames_goes_with_a3_and_one_of_other_frames_is_refused(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("starpos_instrument: 1\ncamera: {focal_mm: 600, pixel_um: 6.4}\n")
    new = Instrument(93750.0, calibration=Calibration.of((1.0, 2.0, 3.0)), frame_size=(2808, 1872))
    instrument_file.check_fits(path, new)
    instrument_file.update(path, new, "about it")
    assert instrument_file.read(path).size == (2808, 1872) and "focal_mm: 600" in path.read_text()
    with pytest.raises(InstrumentError, match="another frame size"):
        instrument_file.check_fits(path, replace(new, frame_size=(1600, 1200)))
