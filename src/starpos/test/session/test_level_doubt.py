# SPDX-License-Identifier: Apache-2.0
"""A level that is set to zero while the camera stands still gives no fix; what errors and motion explain does."""

from dataclasses import replace

import pytest
from fixes import fix_at, north_of

from starpos import rotation
from starpos.session.standing import OUTVOTE_ONE, LevelDoubt

STATED_S = 0.01
STANDS = fix_at(0.0)
# the level was set to zero: the camera stands, the place is another
ZEROED = north_of(STANDS, 1.5e6)


def turned(fix, deg=30.0):
    """A fix of a camera that was turned by hand."""
    turn = rotation.about_axis(0, deg / 57.3)
    return replace(fix, camera=replace(fix.camera, rotation=turn @ fix.camera.rotation))


def judged(*fixes):
    doubt = LevelDoubt()
    return [doubt.contradicts(fix, STATED_S) for fix in fixes]


@pytest.mark.parametrize("metres", [0.0, 300.0, -600.0])
def test_what_the_claims_allow_is_believed(metres):
    assert not any(judged(STANDS, north_of(STANDS, metres), STANDS))


@pytest.mark.parametrize("metres", [2e3, -3e4, 1.5e6])
def test_another_place_while_the_camera_stands_is_not_believed_until_the_level_is_back(metres):
    assert judged(STANDS, STANDS, north_of(STANDS, metres), STANDS) == [False, False, True, False]


def test_a_zero_that_was_set_is_not_believed_after_the_camera_is_turned_either():
    assert judged(STANDS, STANDS, ZEROED, ZEROED, turned(ZEROED), turned(ZEROED)) == [False] * 2 + [True] * 4


def test_a_single_frame_says_nothing_of_the_next_pose():
    assert judged(STANDS, STANDS, ZEROED, turned(STANDS)) == [False, False, True, False]


def test_a_first_frame_alone_is_outvoted():
    believed = judged(ZEROED, *[STANDS] * (OUTVOTE_ONE + 1))
    assert believed == [False] + [True] * (OUTVOTE_ONE - 1) + [False] * 2


def test_one_that_is_carried_elsewhere_is_believed():
    assert not any(judged(STANDS, STANDS, turned(ZEROED), turned(ZEROED)))


@pytest.mark.parametrize(("fixes", "believed"), [((ZEROED,), True), ((ZEROED, ZEROED), False)])
def test_confirmed_the_level_is_believed_and_in_other_air_unless_the_doubt_lasts(fixes, believed):
    for other_air in (False, True):
        doubt = LevelDoubt()
        for fix in (STANDS, STANDS, *fixes):
            doubt.contradicts(fix, STATED_S)
        if other_air:
            doubt.begin_anew()
        else:
            doubt.clear()
        assert doubt.contradicts(ZEROED, STATED_S) == (other_air and not believed)
