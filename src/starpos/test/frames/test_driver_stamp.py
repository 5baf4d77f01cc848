# SPDX-License-Identifier: Apache-2.0
"""The stamps of drivers that say nothing of them: where the middle of the exposure is, and how far it may be off."""

import math

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.exposure import STAMPS, DriverStamp, Shutter
from starpos.frames.frame import Frame

STAMP_S = 1793642400.25
FRAME = Frame(np.zeros((4, 5), np.uint16), mid_unix_s=STAMP_S)


@pytest.mark.parametrize(
    ("kind", "readout_s", "later_s"),
    [
        ("", math.nan, 0.0),
        ("middle", 0.03, 0.0),
        ("start", 0.03, 0.4),
        ("end", 0.03, -0.4),
        # after the last row, whichever is read first
        ("arrival", math.nan, -0.4),
        ("arrival", 0.03, -0.43),
        ("arrival", -0.03, -0.43),
    ],
)
def test_the_middle_of_the_exposure(kind, readout_s, later_s):
    got = DriverStamp(kind, exposure_s=0.8, readout_s=readout_s).apply(FRAME)
    assert got.mid_unix_s == pytest.approx(STAMP_S + later_s, abs=1e-6)
    assert got.exposure_s == 0.8
    assert got.shutter == (None if math.isnan(readout_s) else Shutter(readout_s, 0.0))


@pytest.mark.parametrize(
    ("stamp", "stddev_s"),
    [
        (DriverStamp(), 0.3),
        (DriverStamp(exposure_s=0.4), 0.3),
        # it may be either end of a long exposure
        (DriverStamp(exposure_s=10.0), 5.0),
        (DriverStamp(stddev_s=0.05), 0.05),
        (DriverStamp("arrival", exposure_s=0.4), 0.3),
        (DriverStamp("arrival", stddev_s=0.01, exposure_s=0.4), 0.01),
        (DriverStamp("middle"), 0.02),
        (DriverStamp("start", exposure_s=0.4), 0.02),
        (DriverStamp("start", stddev_s=0.001, exposure_s=0.4), 0.001),
        # the middle of an exposure of unknown length
        (DriverStamp("start", stddev_s=0.001), 0.3),
        (DriverStamp("arrival", stddev_s=0.001), 0.3),
        (DriverStamp("middle", stddev_s=0.001), 0.001),
    ],
)
def test_its_error_is_wide_until_the_moment_is_stated(stamp, stddev_s):
    assert stamp.apply(FRAME).stamp_stddev_s == stamp.middle_stddev_s == stddev_s


def test_a_sentence_says_what_to_set_and_what_it_costs():
    said = DriverStamp().missing_statement
    for word in (*STAMPS[1:], "stamp_stddev", "0.3 s", "139 m"):
        assert word in said
    assert "set the parameter exposure" in DriverStamp("end", stddev_s=0.001).missing_statement
    assert "set the parameter stamp_stddev" in DriverStamp("arrival", exposure_s=0.1).missing_statement
    for stated in (
        DriverStamp("middle"),
        DriverStamp("start", exposure_s=0.1),
        DriverStamp("arrival", 0.05, 0.1),
        DriverStamp(stddev_s=0.05),
    ):
        assert not stated.missing_statement


def test_impossible_ones_are_refused():
    for wrong in ({"kind": "begin"}, {"exposure_s": -1.0}, {"exposure_s": math.nan}):
        with pytest.raises(FrameError):
            DriverStamp(**wrong)
