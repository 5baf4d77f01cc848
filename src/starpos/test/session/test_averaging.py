# SPDX-License-Identifier: Apache-2.0
"""What becomes of the average when fixes go astray, the instrument moves, or a turn on the spot has found the place."""

import math

import numpy as np
import pytest
from fixes import fix_at, north_of

from starpos.averaging.average import average
from starpos.session.driver import Level
from starpos.session.standing import Averaging, News


def averaging_of(fixes) -> Averaging:
    made = Averaging()
    for fix in fixes:
        made.include(fix)
    return made


def test_before_the_first_fix_there_is_no_place():
    assert Averaging().place is None
    assert Averaging().report().level == Level.OK


def test_it_is_the_average_of_its_fixes():
    fixes = [north_of(fix_at(10.0 * k), 50.0 * (-1) ** k) for k in range(8)]
    place, whole = averaging_of(fixes).place, average(fixes)
    assert (place.latitude, place.longitude) == (whole.latitude, whole.longitude)
    np.testing.assert_array_equal(place.covariance, whole.covariance)


def test_a_fix_far_off_is_left_out_and_told():
    a = averaging_of(fix_at(10.0 * k) for k in range(5))
    before = a.place.latitude
    assert a.include(north_of(fix_at(50.0), 5000.0)) is News.LEFT_OUT
    assert a.place.latitude == before
    assert a.report().level == Level.WARN and a.report().values["left out"] == 1
    assert a.include(fix_at(60.0)) is News.USED
    assert a.report().level == Level.OK


def moved_after(a: Averaging, seconds: float) -> list[News]:
    """Fixes of a turned camera, 11 km to the north."""
    return [a.include(fix_at(seconds + 10.0 * k, 130.0, latitude_deg=40.1)) for k in range(4)]


def test_a_move_is_told_and_the_average_is_of_the_new_place():
    a = averaging_of(fix_at(10.0 * k) for k in range(5))
    assert News.MOVED in moved_after(a, 100.0)
    assert math.degrees(a.place.latitude) == pytest.approx(40.1, abs=1e-6)
    assert a.report().level == Level.WARN and a.report().values["moved"] == 1
    for k in range(20):
        a.include(fix_at(200.0 + 10 * k, 130.0, latitude_deg=40.1))
    assert a.report().level == Level.OK


def turned() -> Averaging:
    fixes = [fix_at(10.0 * k, 90.0 * k) for k in range(4)]
    a = Averaging()
    a.turned_on_the_spot(average([north_of(f, 20.0) for f in fixes]))
    return a


def test_the_place_of_a_turn_stays_while_the_instrument_does():
    a = turned()
    place = a.place
    for k in range(50):
        assert a.include(north_of(fix_at(100.0 + 10 * k, 10.0), 30.0)) is News.USED
    assert a.place is place
    assert "turn on the spot" in a.report().message


def test_the_place_of_a_turn_is_given_up_when_the_instrument_moves():
    a = turned()
    assert News.MOVED in moved_after(a, 100.0)
    assert math.degrees(a.place.latitude) == pytest.approx(40.1, abs=1e-6)
    # The turn's frames have determined A3: they do not count any more.
    assert a.place.frames == 4
    first = averaging_of([fix_at(0.0, 130.0)]).place
    assert np.linalg.eigvalsh(a.place.covariance)[0] <= np.linalg.eigvalsh(first.covariance)[0]


def test_begun_anew_nothing_is_left():
    a = turned()
    a.begin_anew()
    assert a.place is None
