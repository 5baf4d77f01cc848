# SPDX-License-Identifier: Apache-2.0
"""Frames that are left out where more come than are wanted: evenly, and said."""

import math

import numpy as np
import pytest

from starpos.session.pace import Pace

T0 = 1_793_642_400.0


def wanted(stamps, most_hz) -> np.ndarray:
    pace = Pace()
    return np.array([pace.wants(t, most_hz) for t in stamps])


@pytest.mark.parametrize(
    ("rate", "most", "share"), [(30, 10, 1 / 3), (30, 20, 2 / 3), (25, 1, 1 / 25), (10, 30, 1.0)]
)
def test_a_rate_is_kept_and_the_frames_are_spread_evenly(rate, most, share):
    stamps = T0 + np.arange(600) / rate
    chosen = np.flatnonzero(wanted(stamps, most))
    assert len(chosen) == pytest.approx(600 * share, abs=1)
    # the second may come a little early
    assert np.ptp(np.diff(chosen)[1:]) <= 1


def test_a_camera_at_just_the_rate_loses_none_by_jitter():
    rng = np.random.default_rng(1)
    stamps = T0 + np.arange(500) / 30 + rng.uniform(-0.004, 0.004, 500)
    assert wanted(stamps, 30.0).all()


def test_frames_without_a_rate_or_a_stamp_are_all_wanted():
    assert wanted(T0 + np.arange(50) / 100, math.nan).all()
    assert wanted([None] * 50, 1.0).all()


def test_stamps_that_begin_anew_are_wanted_at_once():
    pace = Pace()
    assert pace.wants(T0, 1.0) and not pace.wants(T0 + 0.1, 1.0)
    assert pace.wants(T0 - 1000.0, 1.0)


def test_most_frames_dropped_are_said_with_their_share_until_it_is_over():
    pace = Pace()
    for k in range(100):
        (pace.took if k % 4 == 0 else pace.drop)(k / 30)
    assert pace.complaint.startswith("75 % of the frames") and pace.dropped == 75
    for k in range(100, 700):
        pace.took(k / 30)
    assert pace.complaint == ""


def test_few_dropped_frames_and_those_that_were_asked_for_are_no_complaint():
    pace = Pace()
    for k in range(100):
        (pace.drop if k % 3 == 0 else pace.took)(k / 30)
    assert pace.complaint == ""
    pace = Pace()
    for k in range(100):
        if pace.wants(T0 + k / 30, 3.0):
            pace.took(k / 30)
    assert pace.complaint == "" and pace.left_out > 80


def test_frames_that_the_middleware_lost_are_counted():
    pace = Pace()
    pace.took(0.0)
    pace.drop(0.1, 30)
    assert pace.dropped == 30 and pace.complaint
