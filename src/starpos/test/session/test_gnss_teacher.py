# SPDX-License-Identifier: Apache-2.0
"""What a running session makes of a receiver's messages: each that cannot be used is a sentence and teaches nothing."""

import math
from types import SimpleNamespace

import pytest

from starpos.frames.frame import no_stars
from starpos.session.driver import JobsInTurn, Now
from starpos.session.gnss import GNSS_TOPIC, KEPT_S, GnssTeacher, RecentPlaces
from starpos.session.settings import Settings

START_S = 1_790_000_000
NORTH_3_KM = 0.027


class Account:
    """Keeps which messages came and which were refused."""

    info = warning = error = staticmethod(print)

    def __init__(self):
        self.taken, self.refused = 0, []

    def came(self, _):
        self.taken += 1

    def refuse(self, name, sentence):
        assert name == GNSS_TOPIC
        self.refused.append(sentence)


@pytest.fixture
def teacher():
    account = Account()
    made = GnssTeacher(Settings.of(None, ("gnss.use:=true",)), JobsInTurn(print), account)
    made.account = account
    return made


def fix(seconds=0.0, status=0, frame_id="gps", kind=2, variance=4.0, **place):
    nanosec = round((seconds % 1) * 1e9)
    stamp = SimpleNamespace(sec=START_S + math.floor(seconds), nanosec=nanosec)
    about = {"latitude": 47.0, "longitude": 8.0, "altitude": math.nan} | place
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=frame_id), status=SimpleNamespace(status=status),
        position_covariance=[variance, 0, 0, 0, variance, 0, 0, 0, 9.0], position_covariance_type=kind, **about,
    )  # fmt: skip


def now(seconds=0.0):
    return Now(START_S + seconds, seconds)


def test_a_fix_without_an_altitude_is_a_place(teacher):
    teacher.receive(fix(), now())
    assert teacher.account.taken == 1 and teacher.places.at(START_S) is not None


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (fix(kind=0), "states no error"),
        (fix(variance=math.nan), "states no error"),
        (fix(latitude=math.nan), "not a number"),
        (fix(latitude=0.0, longitude=0.0), "0 N 0 E"),
        (fix(frame_id="OSGB36"), "another datum"),
        (fix(status=-1), "no fix"),
        (fix(seconds=100.0), "100 s ahead of this clock"),
        (fix(seconds=-100.0), "100 s behind this clock"),
    ],
)
def test_what_tells_no_place_is_a_sentence_and_is_not_kept(teacher, message, said):
    teacher.receive(message, now())
    assert len(teacher.account.refused) == 1 and said in teacher.account.refused[0]
    assert not teacher.account.taken and teacher.places.at(START_S) is None and teacher.learned is None


def test_stamps_that_go_back_are_refused(teacher):
    for seconds in (0.0, 1.0, 0.5):
        teacher.receive(fix(seconds), now(1.0))
    assert teacher.account.taken == 2 and "stamps go back" in teacher.account.refused[0]


def test_one_stamp_of_another_time_costs_no_right_ones(teacher):
    for seconds in (0.0, 7200.0, 2.0, 3.0):
        teacher.receive(fix(seconds), now(min(seconds, 3.0)))
    assert teacher.account.taken == 4 and teacher.places.at(START_S + 2.5) is not None
    assert teacher.places.newest.utc_unix_s == START_S + 3.0


@pytest.mark.parametrize("rate_hz", [1, 5, 10, 20])
@pytest.mark.parametrize("exposure_s", [2.0, 30.0, 120.0])
def test_the_middle_of_an_exposure_has_its_place_whatever_the_receivers_rate(rate_hz, exposure_s):
    """A fast receiver sends hundreds of fixes until a long exposure is over, read, and has its tilts."""
    places, late_s = RecentPlaces(), exposure_s / 2 + 5.0
    until = 700.0
    for k in range(round(until * rate_hz)):
        seconds = k / rate_hz
        places.receive(fix(seconds, latitude=47.0 + 1e-6 * seconds), now(seconds))
    place = places.at(START_S + until - late_s)
    assert math.degrees(place.latitude) == pytest.approx(47.0 + 1e-6 * (until - late_s), abs=1e-8)
    assert places.at(START_S + 1.0) is None
    assert len(places._places) <= 2 * KEPT_S * rate_hz + 1


@pytest.mark.parametrize("rate_hz", [1, 5, 20])
def test_a_place_after_the_last_one_errs_by_the_vehicles_speed_whatever_the_receivers_rate(rate_hz):
    """27 m/s: all but the places of the last moments are left out of the comparison, which once hid the speed."""
    places = RecentPlaces()
    for k in range(20 * rate_hz + 1):
        places.receive(fix(k / rate_hz, latitude=47.0 + NORTH_3_KM * k / rate_hz / 110), now(k / rate_hz))
    assert math.sqrt(places.at(START_S + 22.8).covariance[1, 1]) == pytest.approx(76, rel=0.05)


def test_two_receivers_on_one_topic_are_compared_with_nothing(teacher):
    for k in range(6):
        teacher.receive(fix(float(k), latitude=47.0 + NORTH_3_KM * (k % 2)), now(float(k)))
    stars = no_stars(100, 100, mid_unix_s=START_S + 2.5)
    rough = SimpleNamespace(fix=None, tilt=None, at_place=None, message="")
    solver = SimpleNamespace(instrument=Settings.of().instrument(None))
    answer = teacher.solve(solver, stars, rough)
    assert answer.compared is None and "one receiver publishes, not two" in teacher.account.refused[-1]
    assert teacher.learned is None
