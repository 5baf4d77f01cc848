# SPDX-License-Identifier: Apache-2.0
"""Stamps of a camera at rest that contradict each other widen the time, and those that agree do not."""

import math
from dataclasses import replace

import numpy as np
import pytest
from fixes import fix_at, north_of

from starpos import rotation
from starpos.earth.ellipsoid import zenith_of
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.session.standing import ClockDoubt

STATED_S = 0.01


def stamped(off_s: float, azimuth_deg=40.0, **at):
    """The fix of a frame whose stamp is off by so much: the Earth has turned under it."""
    fix = fix_at(0.0, azimuth_deg, **at)
    turn = rotation.about_axis(2, ROTATION_RAD_S * off_s)
    east, north, _ = turn @ zenith_of(fix.latitude, fix.longitude)
    return replace(
        fix,
        camera=replace(fix.camera, rotation=turn @ fix.camera.rotation),
        longitude=math.atan2(north, east),
    )


def doubts_of(*fixes, stated_s=STATED_S) -> list[float]:
    doubt, seconds = ClockDoubt(), []
    for fix in fixes:
        doubt.judge(fix, stated_s)
        seconds.append(doubt.seconds)
    return seconds


def test_stamps_that_agree_are_believed():
    assert doubts_of(*(stamped(0.02 * (-1) ** k) for k in range(20))) == [0.0] * 20


@pytest.mark.parametrize("off_s", [2.0, -2.0, 3600.0, -40000.0])
def test_one_that_is_off_is_as_wide_as_that_and_the_next_is_believed(off_s):
    doubts = doubts_of(stamped(0.0), stamped(0.0), stamped(off_s), stamped(0.0))
    assert doubts == pytest.approx([0.0, 0.0, abs(off_s), 0.0], rel=1e-6)


def test_a_clock_that_was_set_stays_in_doubt_until_it_is_back():
    doubts = doubts_of(*[stamped(0.0)] * 2, *[stamped(3.0)] * 50, stamped(0.0))
    assert doubts == pytest.approx([0.0] * 2 + [3.0] * 50 + [0.0], rel=1e-6)


def test_it_stays_in_doubt_when_the_camera_is_turned():
    doubts = doubts_of(*[stamped(0.0)] * 2, stamped(3.0), *[stamped(3.0, 130.0)] * 4)
    assert doubts == pytest.approx([0.0] * 2 + [3.0] * 5, rel=1e-6)


def test_a_turn_by_itself_is_no_doubt():
    assert doubts_of(stamped(0.0), stamped(0.0, 41.0), stamped(0.0, 39.0), stamped(0.0, 220.0)) == [0.0] * 4


def test_the_first_of_a_pose_alone_is_outvoted():
    doubts = doubts_of(stamped(5.0), *[stamped(0.0)] * 11, stamped(5.0))
    assert doubts == pytest.approx([0.0] + [5.0] * 9 + [0.0, 0.0, 5.0], rel=1e-6)


def test_a_blurred_frame_is_not_what_others_are_held_against():
    # A quarter of a minute of time.
    sharp = stamped(0.0)
    blurred = replace(sharp, camera=replace(sharp.camera, covariance=np.eye(3) * 4e-4**2))
    assert doubts_of(blurred, stamped(0.0), stamped(20.0)) == pytest.approx([0.0, 0.0, 20.0], rel=1e-6)


def test_what_the_clocks_error_allows_is_no_contradiction():
    assert doubts_of(stamped(0.0), stamped(30.0), stated_s=16.0) == [0.0, 0.0]


def test_at_a_pole_a_turn_on_the_spot_is_no_contradiction():
    assert doubts_of(stamped(0.0, latitude_deg=89.9), stamped(100.0, latitude_deg=89.9)) == [0.0, 0.0]


def test_cleared_nothing_is_held_against_the_next():
    doubt = ClockDoubt()
    for off_s in (0.0, 0.0, 3.0):
        doubt.judge(stamped(off_s), STATED_S)
    doubt.clear()
    doubt.judge(stamped(3.0), STATED_S)
    assert doubt.seconds == 0.0


@pytest.mark.parametrize(
    ("off_s", "metres", "otherwise"),
    [(40.0, 0, False), (40.0, 500, False), (40.0, 3000, True), (0.0, 3000, False)],
)
def test_one_that_is_off_and_leans_otherwise_has_the_tilts_of_another_time(off_s, metres, otherwise):
    """A fix errs by 100 m; what comes right in time is the inclinometer's, and for the average to judge."""
    doubt = ClockDoubt()
    doubt.judge(stamped(0.0), STATED_S)
    doubt.judge(north_of(stamped(off_s), metres), STATED_S)
    assert doubt.leans_otherwise is otherwise
    doubt.judge(stamped(0.0), STATED_S)
    assert not doubt.leans_otherwise
