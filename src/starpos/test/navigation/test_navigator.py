# SPDX-License-Identifier: Apache-2.0
"""The session behind the node `navigator`: voyages given to it message by message."""

from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from navigator_calls import (
    Navigator,
    attitude_message,
    events_of,
    header_of,
    imu_message,
    off,
    output_nees,
    velocity_message,
)
from voyage_calls import EARTH_M, navigated

from starpos import rotation
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.navigation.sightings import body_attitude
from starpos.navigation.vessel import Vessel
from starpos.session.driver import Level, Now
from starpos_testing.voyages import INDUSTRIAL, made

SECONDS = 60


@pytest.fixture(scope="module")
def record():
    return made("rover", SECONDS, 3, rate_hz=50)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("imu") / "imu.yaml"
    path.write_text(yaml.safe_dump({name: float(value) for name, value in asdict(INDUSTRIAL).items()}))
    return str(path)


@pytest.fixture(scope="module")
def told(record, model):
    return Navigator(imu_model=model).play(events_of(record))


def claimed_m(output):
    return float(np.sqrt(np.trace(output.fix.covariance[:2, :2]) / 2))


def test_claims_hold_from_the_first_output_on(told, record):
    fixes = [o for o in told.outputs if o.fix and o.utc_unix_s % 1 == 0.5]
    assert len(fixes) > SECONDS - 15
    # of three degrees of freedom one in a million is beyond 31
    assert max(output_nees(o, record) for o in fixes) < 31
    assert claimed_m(fixes[0]) > 20 * claimed_m(fixes[-1])


def test_it_says_what_the_command_line_says_of_the_same_record(told, record):
    """The last adjustment has all but the last ten seconds, which the IMU carries on."""
    fix, output = navigated(record).fixes[-1], told.at(record.frames_s[-1])
    apart = off(output, record) - off(replace(output, fix=fix), record)
    assert np.abs(apart[:2]).max() < 2 * claimed_m(output) < 1000
    assert abs(apart[2]) < 2 * np.sqrt(output.fix.covariance[2, 2])


def test_without_stars_there_is_no_fix(record, model):
    events = [e for e in events_of(record) if e[1] != "attitude"]
    navigator = Navigator(imu_model=model).play(events)
    assert navigator.outputs and not any(o.fix for o in navigator.outputs)
    report = navigator.session.report()
    assert report.level == Level.WARN and "no frame with stars" in report.message


def test_frames_of_another_clock_are_told(record, model):
    early = replace(record.imu, utc_unix_s=record.imu.utc_unix_s - 500.0)
    events = [e for e in events_of(record, velocity=False, imu=early) if e[0] < record.frames_s[20]]
    navigator = Navigator(imu_model=model).play(events)
    assert not any(o.fix for o in navigator.outputs)
    assert "set their clocks by one source" in navigator.session.report().message


def test_a_frame_at_the_very_last_reading_is_adjusted(record, model):
    """Its attitude comes first, as from an IMU whose messages are slow."""
    events = [e for e in events_of(record) if e[1] != "attitude"]
    first = [(f.utc_unix_s - 0.5, "attitude", attitude_message(f)) for f in record.frames]
    navigator = Navigator(imu_model=model, adjust_period=1.0).play(
        [e for e in [*first, *events] if e[0] <= record.frames_s[12]]
    )
    assert navigator.session.counts["adjustments"] > 1
    assert navigator.outputs[-1].fix is not None


def test_the_imu_carries_on_without_stars_with_a_wider_claim_and_not_for_ever(record, model):
    begin = record.frames_s[0]
    events = [e for e in events_of(record) if e[1] != "attitude" or e[0] < begin + 30]
    navigator = Navigator(imu_model=model, stars_timeout=20.0).play(events)
    near, far = (navigator.at(begin + s).fix for s in (32.0, 48.0))
    assert np.trace(far.velocity_covariance) > np.trace(near.velocity_covariance)
    assert far.covariance[2, 2] > near.covariance[2, 2]
    assert navigator.at(record.frames_s[-1]).fix is None
    assert "no frame with stars for" in navigator.session.report().message


def test_an_adjustment_that_does_not_keep_up_is_not_said_to_be_a_want_of_stars(record, model):
    begin = record.frames_s[0]
    events = events_of(record)
    navigator = Navigator(imu_model=model, stars_timeout=20.0).play([e for e in events if e[0] < begin + 25])
    navigator.works = False
    navigator.play([e for e in events if e[0] >= begin + 25])
    assert navigator.at(record.frames_s[-1]).fix is None
    said = navigator.session.report().message
    assert "the newest adjustment ends" in said and "shorten window" in said


def test_odometry_counts_from_a_place_that_is_known(told, record):
    known = [o for o in told.outputs if o.displacement is not None]
    assert known and claimed_m(known[0]) < 1000 < claimed_m(next(o for o in told.outputs if o.fix))
    assert np.abs(known[0].displacement[0]).max() < 1e-6


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda g, a: (g, a / 9.80665), "in g: give m/s2"),
        (lambda g, a: (np.degrees(g), a), "in deg/s: give rad/s"),
        (lambda g, a: (g, a - [0, 0, 9.8]), "gravity is not taken off"),
        (lambda g, a: (g, a[:, [2, 1, 0]]), "accelerometer's axes"),
    ],
)
def test_what_no_place_can_come_from_is_told_and_makes_no_fix(record, model, change, said):
    gyro, force = change(record.imu.gyro, record.imu.force)
    wrong = replace(record.imu, gyro=gyro, force=force)
    events = [e for e in events_of(record, imu=wrong) if e[0] < record.frames_s[30]]
    navigator = Navigator(imu_model=model).play(events)
    assert not any(o.fix for o in navigator.outputs)
    assert said in navigator.session.report().message


def test_a_standing_vehicle_is_asked_to_turn(model):
    record = made("parked", 20, 4, rate_hz=50)
    navigator = Navigator(imu_model=model, vehicle="parked").play(events_of(record, velocity=False))
    report = navigator.session.report()
    assert report.level == Level.WARN and "turn once: " in report.message
    assert claimed_m(navigator.at(record.frames_s[-1])) > 10_000


@pytest.mark.parametrize(("off_deg", "said"), [(0.0, False), (0.2, True)])
def test_a_gnss_elsewhere_is_told_and_not_followed(record, model, off_deg, said):
    navigator = Navigator(imu_model=model).play(events_of(record))
    at, before = record.frames_s[-1], navigator.at(record.frames_s[-1]).fix
    place = np.degrees([record.latitude[-1], record.longitude[-1]])
    message = SimpleNamespace(
        header=header_of(at),
        status=SimpleNamespace(status=0),
        latitude=place[0] + off_deg,
        longitude=place[1],
        position_covariance=np.diag([4.0, 4.0, 9.0]).ravel(),
        position_covariance_type=2,
    )
    navigator.session.receive_gnss(message, Now(at, at))
    report = navigator.session.report()
    assert ("one of them is wrong" in report.message) is said
    assert report.values["GNSS from here (m)"] == pytest.approx(off_deg * 111_200, abs=1500)
    assert navigator.at(at).fix is before


NOW = Now(1.7e9, 0.0)
NO_G = [0.0, 0.0, 9.8]


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (imu_message(1.7e9, [0, 0, np.nan], NO_G), "NaN"),
        (imu_message(1.7e9, [0, 0, 0], [0, 0, 1e200]), "beyond"),
        (imu_message(0.0, [0, 0, 0], NO_G), "no time stamp"),
        (imu_message(1.7e9 + 60, [0, 0, 0], NO_G), "in the future"),
    ],
)
def test_a_reading_that_cannot_be_is_refused_with_a_sentence(message, said):
    navigator = Navigator()
    assert navigator.session.receive_imu(message, NOW) == []
    ((name, sentence),) = navigator.told.refused
    assert name == "imu/data" and said in sentence


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"orientation": SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.9)}, "not of length 1"),
        ({"orientation": SimpleNamespace(x=np.nan, y=0.0, z=0.0, w=1.0)}, "not of length 1"),
        ({"covariance": [0.0] * 9}, "not symmetric, positive"),
        ({"covariance": [np.inf] * 9}, "not a finite number"),
        ({"stamp_stddev": -1.0}, "at least 0"),
        ({"header": header_of(0.0)}, "no time stamp"),
        ({"header": header_of(2.1e9)}, "IERS"),
    ],
)
def test_an_attitude_that_cannot_be_is_refused_with_a_sentence(record, change, said):
    navigator, message = Navigator(), attitude_message(record.frames[0])
    vars(message).update(change)
    navigator.session.receive_attitude(message, Now(None, 0.0))
    ((name, sentence),) = navigator.told.refused
    assert name == "attitude" and said in sentence


def test_doubled_stamps_and_short_steps_back_are_left_out():
    navigator = Navigator()
    for unix_s in (1.7e9 - 1, 1.7e9 - 1, 1.7e9 - 1.2):
        navigator.session.receive_imu(imu_message(unix_s, [0, 0, 0], NO_G), NOW)
    assert [sentence for _, sentence in navigator.told.refused] == [
        "an inertial reading is not later than the one before: it is left out"
    ] * 2


@pytest.mark.parametrize("jump_s", [-100.0, 100.0])
def test_a_clock_that_jumps_begins_a_new_voyage(record, model, jump_s):
    navigator = Navigator(imu_model=model).play([e for e in events_of(record) if e[0] < record.frames_s[20]])
    assert navigator.outputs[-1].fix is not None
    at = navigator.outputs[-1].utc_unix_s + jump_s
    (output,) = navigator.session.receive_imu(imu_message(at, [0, 0, 0], NO_G), Now(at, at))
    assert output.fix is None
    assert any("begun anew" in sentence for sentence in navigator.told.said)


@pytest.mark.parametrize(
    ("velocity", "sigma", "said"), [([np.nan, 0, 0], 0.1, "NaN"), ([1, 0, 0], 1e6, "not between")]
)
def test_a_velocity_that_cannot_be_is_refused_with_a_sentence(velocity, sigma, said):
    navigator = Navigator()
    navigator.session.receive_velocity(velocity_message(1.7e9, velocity, sigma), NOW, "odom")
    assert said in navigator.told.refused[0][1]


def gnss_message(unix_s, latitude, longitude):
    return SimpleNamespace(
        header=header_of(unix_s), status=SimpleNamespace(status=0), position_covariance=np.diag([4.0, 4.0, 9.0]).ravel(),
        position_covariance_type=2, latitude=np.degrees(latitude), longitude=np.degrees(longitude),
    )  # fmt: skip


@pytest.mark.parametrize("known_by", ["gnss", "site", "nobody"])
def test_at_a_known_place_there_is_a_heading_before_a_fix(record, known_by):
    """Without an IMU there never is a fix."""
    latitude, longitude = record.latitude[0], record.longitude[0]
    site = {"site.latitude": np.degrees(latitude), "site.longitude": np.degrees(longitude)}
    values = {"gnss": {"gnss.use": True}, "site": site, "nobody": {}}[known_by]
    navigator = Navigator(**values)
    frames = [(f.utc_unix_s + 0.5, "attitude", attitude_message(f)) for f in record.frames]
    gnss = [
        (t, "gnss", gnss_message(t, *place))
        for t, *place in zip(record.frames_s, record.latitude, record.longitude, strict=True)
    ]
    navigator.play([*frames, *gnss])
    if known_by == "nobody":
        assert navigator.outputs == []
        return
    assert len(navigator.outputs) == len(record.frames) and navigator.outputs[0].fix is None
    nees = []
    for output, true in zip(navigator.outputs, record.heading, strict=True):
        seen = output.at_place
        heading = np.arctan2(*seen.rotation[:2, 0])
        off_rad = np.remainder(heading - true + np.pi, 2 * np.pi) - np.pi
        nees.append(off_rad**2 / seen.covariance[2, 2])
    # the mount's error is the same in all, 1 deg; all others are far below
    assert np.mean(nees) < 9 and np.sqrt(seen.covariance[2, 2]) < np.radians(1.01)
    assert np.std([np.sqrt(x) for x in nees]) < 0.2


@pytest.mark.parametrize("stated_s", [np.nan, 1e-4], ids=["unstated", "stated"])
def test_a_frames_clock_counts_in_a_heading_and_in_a_fix_until_the_user_states_a_better_one(
    record, model, stated_s
):
    site = {
        "site.latitude": np.degrees(record.latitude[0]),
        "site.longitude": np.degrees(record.longitude[0]),
    }
    navigator = Navigator(imu_model=model, clock_stddev=stated_s, mount_stddev=0.01, **site)
    messages = [(f.utc_unix_s + 0.5, attitude_message(f)) for f in record.frames]
    for _, message in messages:
        message.clock_stddev = 20.0
    others = [e for e in events_of(record) if e[1] != "attitude"]
    navigator.play([*others, *((t, "attitude", message) for t, message in messages)])
    # 20 s are 0.08 deg of the Earth's turn
    headings = [o.at_place.angles_covariance[0, 0] for o in navigator.outputs if o.at_place is not None]
    fixes = [o.fix.covariance[0, 0] for o in navigator.outputs if o.fix is not None]
    turn, latitude = 0.9 * 20.0 * ROTATION_RAD_S, record.latitude[0]
    assert headings and fixes
    assert np.isnan(stated_s) == (min(headings) > (turn * np.sin(latitude)) ** 2)
    assert np.isnan(stated_s) == (min(fixes) > (turn * EARTH_M * np.cos(latitude)) ** 2)


def test_a_heading_at_a_known_place_claims_what_it_errs_by_when_the_mount_is_known(record):
    air = Atmosphere(pressure_pa=0.0)
    there = Vessel(vehicle=None, model=INDUSTRIAL, camera_to_body=record.mount, mount_stddev=1e-9, atmosphere=air,
                   clock_stddev_s=1e-4)  # fmt: skip
    nees = []
    truth = zip(record.latitude, record.longitude, record.body_to_itrs, strict=True)
    for frame, (latitude, longitude, body_to_itrs) in zip(record.frames, truth, strict=True):
        place = Place.by_gravity(*np.degrees([latitude, longitude]), Deflection(0.0, 0.0, 0.0))
        found = body_attitude(frame, place, there)
        off = rotation.to_small_vector(found.rotation @ (enu_axes(latitude, longitude) @ body_to_itrs).T)
        nees.append(off @ np.linalg.solve(found.covariance, off))
    # three degrees of freedom; 60 frames
    assert 2.0 < np.mean(nees) < 4.2
