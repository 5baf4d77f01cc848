# SPDX-License-Identifier: Apache-2.0
"""When the rows of a frame were exposed."""

import json

import numpy as np
import pytest

from starpos.errors import FrameError
from starpos.frames.exposure import GLOBAL_SHUTTER, UNKNOWN_READOUT_S, UNKNOWN_SHUTTER, Shutter
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame
from starpos.simulation.scene import write_fits

ROWS, HEIGHT = np.array([0.0, 50.0, 100.0]), 101


def test_the_row_read_first_has_the_stamps_time_and_the_last_comes_a_readout_later():
    assert Shutter(0.04, 0.0).later_s(ROWS, HEIGHT) == pytest.approx([0.0, 0.02, 0.04])
    assert Shutter(-0.04, 0.0).later_s(ROWS, HEIGHT) == pytest.approx([0.04, 0.02, 0.0])
    assert not GLOBAL_SHUTTER.later_s(ROWS, HEIGHT).any()


def test_an_error_of_the_readout_grows_from_the_row_read_first():
    late = Shutter(-0.04, 0.01).errors_s(ROWS, HEIGHT)
    assert late[:, 0] == pytest.approx([0.01, 0.005, 0.0])
    assert not late[:, 1].any()
    assert not GLOBAL_SHUTTER.errors_s(ROWS, HEIGHT).any()


def test_without_a_direction_rows_err_against_each_other_and_all_come_too_late():
    rows, together = UNKNOWN_SHUTTER.errors_s(ROWS, HEIGHT).T
    assert rows == pytest.approx(np.array([-0.5, 0.0, 0.5]) * UNKNOWN_READOUT_S)
    assert together == pytest.approx([UNKNOWN_READOUT_S / 2] * 3)


@pytest.mark.parametrize("bad", [(np.nan, 0.0), (11.0, 0.0), (-11.0, 0.0), (0.0, -1.0), (0.0, np.inf)])
def test_a_readout_that_cannot_be_is_refused(bad):
    with pytest.raises(FrameError, match="from the first row to the last"):
        Shutter(*bad)


@pytest.mark.parametrize("shutter", [None, GLOBAL_SHUTTER, Shutter(-0.03, 0.0)])
def test_a_fits_header_tells_the_shutter_or_nothing(tmp_path, shutter):
    frame = Frame(np.zeros((20, 30), np.uint16), mid_unix_s=1.7e9, exposure_s=0.5, shutter=shutter)
    write_fits(tmp_path / "a.fits", frame, "2026-11-02T18:00:00")
    assert read_frame(tmp_path / "a.fits").shutter == shutter


@pytest.mark.parametrize("readout", ["fast", 1e3, "nan"])
def test_a_header_whose_readout_is_no_time_is_refused(tmp_path, readout):
    header = json.dumps({"NAXIS1": 100, "NAXIS2": 80, "ROLLSHUT": readout})
    (tmp_path / "a.csv").write_text(f"# {header}\nx,y,flux\n1,2,3\n")
    with pytest.raises(FrameError, match="ROLLSHUT"):
        read_frame(tmp_path / "a.csv")
