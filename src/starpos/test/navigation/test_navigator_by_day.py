# SPDX-License-Identifier: Apache-2.0
"""The navigator by day: the Sun at a known place, gravity by the IMU, drawn drives."""

from dataclasses import asdict
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from navigator_calls import LATE_S, Navigator, attitude_message, events_of, header_of

from starpos import rotation
from starpos.earth.ellipsoid import enu_axes
from starpos.earth.orientation import earth_state
from starpos.fix.attitude import ANY_TURN
from starpos.session.driver import Level
from starpos.sky.bodies import SUN, body_at
from starpos_testing.voyages import INDUSTRIAL, made

SECONDS, SIGMA = 90, np.radians(20 / 3600)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("imu") / "imu.yaml"
    path.write_text(yaml.safe_dump({name: float(value) for name, value in asdict(INDUSTRIAL).items()}))
    return str(path)


def drive(seed):
    """A rover in the morning, under a Sun that rises by 13 arcsec a second."""
    return made("rover", SECONDS, seed, rate_hz=50, latitude_deg=20.0, longitude_deg=-38.0, mount_deg=0.1)


def sun_message(record, k, rng, lamp=None):
    """The solver's message of frame k, on which it has seen the Sun, or a lamp (3,) that stands there in ITRS."""
    state = earth_state(record.frames_s[k])
    phi, lam = record.latitude[k], record.longitude[k]
    zenith = rotation.unit_vector(lam, phi)
    body = body_at(SUN, state)
    there = body.from_place(zenith) if lamp is None else lamp
    ray = there @ (record.body_to_itrs[k] @ record.mount)
    ray = rotation.normalised(ray + rng.normal(0, SIGMA, 3))
    turn = rotation.shortest_turn(ray, state.gcrs_to_itrs.T @ body.itrs)
    x, y, z, w = rotation.to_quaternion(turn)
    across = np.eye(3) - np.outer(ray, ray)
    return SimpleNamespace(
        header=header_of(record.frames_s[k]),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        covariance=(across * SIGMA**2 + np.outer(ray, ray) * ANY_TURN).ravel(),
        stars_matched=0,
        log_odds=0.0,
        stamp_stddev=0.0,
        clock_stddev=1e-4,
    )


def by_day(record, frames=slice(None), lamps=None, seed=0):
    rng = np.random.default_rng(seed)
    return [
        (
            record.frames_s[k] + LATE_S,
            "attitude",
            sun_message(record, k, rng, None if lamps is None else lamps[k]),
        )
        for k in range(len(record.frames_s))[frames]
    ]


def lamps_of(record, higher_deg, away_m=np.inf):
    """Directions (F, 3) in ITRS of a lamp that stands so much higher than the Sun at the begin, elsewhere."""
    axes = enu_axes(record.latitude[0], record.longitude[0])
    sun = axes @ body_at(SUN, earth_state(record.frames_s[0])).from_place(axes[2])
    there = rotation.unit_vector(2.0, np.arcsin(sun[2]) + np.radians(higher_deg)) @ axes
    return rotation.normalised(there - (record.place - record.place[0]) / away_m)


def gnss(record, seed=0):
    rng = np.random.default_rng(seed)
    return [
        (
            t,
            "gnss",
            SimpleNamespace(
                header=header_of(t), status=SimpleNamespace(status=0),
                position_covariance=np.diag([4.0, 4.0, 9.0]).ravel(), position_covariance_type=2,
                latitude=np.degrees(phi) + rng.normal(0, 2e-5), longitude=np.degrees(lam) + rng.normal(0, 2e-5),
            ),
        )
        for t, phi, lam in zip(record.frames_s, record.latitude, record.longitude, strict=True)
    ]  # fmt: skip


def site_of(record):
    place = np.degrees([record.latitude[0], record.longitude[0]])
    return {"site.latitude": place[0], "site.longitude": place[1], "site.stddev": 5.0}


def pulls(outputs, record):
    """Errors of the headings over their claims, and the claims, deg."""
    found = []
    for output in outputs:
        k = np.abs(record.frames_s - output.utc_unix_s).argmin()
        if output.at_place is not None and abs(record.frames_s[k] - output.utc_unix_s) < 1e-3:
            sigma = np.sqrt(output.at_place.angles_covariance[0, 0])
            off = rotation.half_turn(output.at_place.heading - record.heading[k])
            found.append((off / sigma, np.degrees(sigma)))
    return np.array(found).T


def without(record, *kinds):
    return [e for e in events_of(record) if e[1] not in kinds]


@pytest.mark.parametrize("known_by", ["gnss", "site"])
def test_a_drive_by_day_has_headings_within_their_claims_and_no_fix(model, known_by):
    record = drive(2)
    values = {"gnss": {"gnss.use": True}, "site": site_of(record)}[known_by]
    events = without(record, "attitude", "velocity") + by_day(record) + gnss(record)
    navigator = Navigator(imu_model=model, mount_stddev=0.1, **values).play(events)
    pull, claim = pulls(navigator.outputs, record)
    # a lamp that stands still is excluded after a minute
    assert len(pull) > 15 and np.abs(pull).max() < 3.5
    # level by an accelerometer whose bias is 3 mg
    assert claim[-1] < 0.06 and claim[-1] < claim[0]
    assert not any(output.fix for output in navigator.outputs)
    report = navigator.session.report()
    assert report.level == Level.OK and "by the Sun" in report.message


@pytest.mark.parametrize(
    ("higher_deg", "away_m"), [(8.0, np.inf), (1.4, np.inf), (0.3, np.inf), (0.0, 250.0), (-0.5, 2000.0)]
)
def test_a_lamp_gives_no_heading(model, higher_deg, away_m):
    """The sky's turn shows one as high as the Sun, the vehicle's way one nearby."""
    record = drive(2)
    lamps = lamps_of(record, higher_deg, away_m)
    events = without(record, "attitude", "velocity") + by_day(record, lamps=lamps) + gnss(record)
    navigator = Navigator(imu_model=model, mount_stddev=0.1, **{"gnss.use": True}).play(events)
    assert not any(output.at_place for output in navigator.outputs)
    assert navigator.session.report().level == Level.WARN


def test_the_sun_near_the_zenith_gives_headings_within_their_claims(model):
    """The place is known and settles at once: the heading takes more rounds, most where the Sun is high."""
    record = made("rover", SECONDS, 5, rate_hz=50, latitude_deg=-17.0, longitude_deg=22.0, mount_deg=0.1)
    events = without(record, "attitude", "velocity") + by_day(record) + gnss(record)
    navigator = Navigator(imu_model=model, mount_stddev=0.1, **{"gnss.use": True}).play(events)
    pull, claim = pulls(navigator.outputs, record)
    assert len(pull) > 10 and np.abs(pull).max() < 3.5 and 0.1 < claim[-1] < 1.0


def test_stars_first_and_then_the_sun_go_on_as_one_voyage(model):
    """At dawn: as if its stars were seen until the middle of the drive."""
    record = drive(3)
    half = SECONDS // 2
    stars = [(f.utc_unix_s + LATE_S, "attitude", attitude_message(f)) for f in record.frames[:half]]
    events = (
        without(record, "attitude", "velocity") + stars + by_day(record, slice(half, None)) + gnss(record)
    )
    navigator = Navigator(imu_model=model, mount_stddev=0.1, **{"gnss.use": True}).play(events)
    pull, claim = pulls([o for o in navigator.outputs if o.utc_unix_s > record.frames_s[half]], record)
    assert len(pull) > 30 and np.abs(pull).max() < 3.5 and claim[-1] < 0.05
    assert any(output.fix for output in navigator.outputs)


def test_the_sun_without_a_place_is_refused_with_what_to_set(model):
    record = drive(2)
    navigator = Navigator(imu_model=model).play(by_day(record, slice(0, 2)))
    (_, sentence), _ = navigator.told.refused
    assert "set site.latitude" in sentence


def test_a_direction_that_is_not_the_suns_is_refused(model):
    record = drive(2)
    ((at, kind, message),) = by_day(record, slice(0, 1))
    message.orientation.w, message.orientation.x = -message.orientation.x, message.orientation.w
    navigator = Navigator(**site_of(record)).play([(at, kind, message)])
    ((_, sentence),) = navigator.told.refused
    assert "not the Sun's" in sentence
