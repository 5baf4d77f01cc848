# SPDX-License-Identifier: Apache-2.0
"""Random sequences of fixes: never an exception, never an invalid number, and true of the place."""

import pickle
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.average import Averager, average
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import earth_state
from starpos.errors import FixError
from starpos.instrument.inclinometer import Tilt
from starpos.units import ARCSEC
from starpos_testing.skies.fields import UTC, SkyField

pytestmark = pytest.mark.montecarlo
STATE = earth_state(UTC)
NOISE, A3_ERROR = 12.6 * ARCSEC, 5.0 * ARCSEC
EARTH_RAD_S = 7.292115e-5


@dataclass
class Walk:
    """A robot that stops, turns, is knocked and drives on, and whose readings now and then are nonsense.

    places: truth (latitude, longitude deg) of each fix; sound: which fixes have no error but their own.
    """

    fixes: list = field(default_factory=list)
    places: list = field(default_factory=list)
    sound: list = field(default_factory=list)


def walk(rng, steps, spoil=0.0, drive=0.0, turn=0.2, latitude=None) -> Walk:
    here = SkyField(
        latitude=float(np.degrees(np.arcsin(rng.uniform(-1, 1))) if latitude is None else latitude),
        longitude=float(rng.choice([180.0, rng.uniform(-180, 180)])),
        azimuth=float(rng.uniform(0, 360)), altitude=float(rng.uniform(70, 89.9)), roll=float(rng.uniform(-180, 180)),
        stars=8,
    )  # fmt: skip
    slip = rotation.from_vector(rng.normal(0, A3_ERROR, 3))
    made, now = Walk(), UTC
    for _ in range(steps):
        if rng.random() < drive:
            new = here.latitude + rng.normal(0, 0.5), here.longitude + rng.normal(0, 0.5)
            here = replace(here, latitude=float(np.clip(new[0], -89.99, 89.99)), longitude=(new[1] + 180) % 360 - 180,
                           azimuth=float(rng.uniform(0, 360)))  # fmt: skip
        elif rng.random() < turn:
            here = replace(here, azimuth=(here.azimuth + float(rng.choice([rng.uniform(0, 360), 0.1, 180.0]))) % 360,
                           altitude=float(np.clip(here.altitude + rng.normal(0, 0.05), 70, 89.99)))  # fmt: skip
        now += float(rng.choice([0.5, 5.0, 5.0, 5.0, 3600.0]))
        xy, places = here.places(STATE, rng)
        up = slip @ here.a3 @ here.attitude[2]
        theta = np.arcsin(up[:2]) + rng.normal(0, NOISE, 2)
        f = here.solve(xy + rng.normal(0, 0.05, xy.shape), places, STATE, instrument=here.instrument(5.0),
                       tilt=Tilt(*theta, np.eye(2) * NOISE**2, utc_unix_s=UTC))  # fmt: skip
        f = replace(f, utc_unix_s=now)
        bad = rng.random() < spoil
        made.fixes.append(spoiled(f, rng) if bad else f)
        made.places.append((here.latitude, here.longitude))
        made.sound.append(not bad)
    return made


def spoiled(f, rng):
    """A tilt misread by any amount, or a stamp that is off by as much."""
    if rng.random() < 0.5:
        off = rng.normal(0, 10 ** rng.uniform(-4, -1.5), 2)
        return replace(
            f, latitude=float(np.clip(f.latitude + off[0], -1.57, 1.57)), longitude=f.longitude + off[1]
        )
    angle = EARTH_RAD_S * rng.normal(0, 10 ** rng.uniform(0, 4))
    turned = rotation.about_axis(2, -angle) @ f.camera.rotation
    return replace(
        f, longitude=rotation.half_turn(f.longitude - angle), camera=replace(f.camera, rotation=turned)
    )


def sigmas_off(a, place) -> float:
    """How far an average is from a true place (deg), in sigmas of ENU there."""
    phi, lam = np.radians(place)
    prime, meridian = curvature_radii_m(phi)
    away = np.array(
        [
            np.cos(a.latitude) * np.cos(a.longitude),
            np.cos(a.latitude) * np.sin(a.longitude),
            np.sin(a.latitude),
        ]
    )
    east = np.array([-np.sin(a.longitude), np.cos(a.longitude), 0.0])
    north = np.cross(away, east)
    truth = np.array([np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)])
    off = np.array([-(truth @ east) * prime, -(truth @ north) * meridian])
    return float(np.sqrt(off @ np.linalg.solve(a.covariance[:2, :2], off)))


def run(made):
    """The average after each fix, checked for what must hold whatever came in."""
    averager, answers = Averager(), []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for f in made.fixes:
            averager.include(f)
            a = averager.average
            # No fix since the camera was touched is used.
            rows = 2 if np.isnan(a.heading) else 3
            covariance = a.covariance[:rows, :rows]
            assert np.isfinite([a.utc_unix_s, a.latitude, a.longitude, a.began_unix_s]).all()
            assert np.isfinite(covariance).all() and np.isnan(a.covariance[rows:]).all()
            assert rows == 3 or a.left_out > 0
            assert -np.pi <= a.longitude <= np.pi and not (a.heading < 0 or a.heading >= 2 * np.pi)
            unit = np.sqrt(np.diag(covariance))
            assert np.linalg.eigvalsh(covariance / np.outer(unit, unit))[0] > -1e-9
            assert a.frames >= 1 and a.left_out >= 0 and a.moved >= 0
            answers.append(a)
    return answers, averager


@pytest.mark.parametrize("latitude", [None, 89.5, -89.97, 0.0])
def test_anything_at_all_gives_a_number(latitude, rng):
    made = walk(rng, 30, spoil=0.3, drive=0.1, turn=0.3, latitude=latitude)
    run(made)
    order = rng.permutation(len(made.fixes))
    try:
        average([made.fixes[k] for k in order])
    except FixError as e:
        assert "lie further from the others" in str(e)


def test_sound_fixes_are_not_left_out(rng):
    """Turned, knocked, after hours: less than one in a thousand."""
    left = total = 0
    for _ in range(3):
        made = walk(rng, 40, turn=0.3)
        answers, _ = run(made)
        left += answers[-1].left_out
        total += len(made.fixes)
        assert answers[-1].moved == 0
    assert left <= max(1, 1e-3 * total)


def test_it_is_true_of_the_place_that_it_claims(rng):
    """One place, one fix in ten wrong, whatever is wrong with it: within five sigma, once there were a few."""
    off = []
    for _ in range(3):
        made = walk(rng, 40, spoil=0.1, turn=0.2)
        answers, _ = run(made)
        off += [sigmas_off(a, made.places[0]) for k, a in enumerate(answers) if k >= 12]
    off = np.array(off)
    assert np.mean(off > 5) < 0.005
    assert np.median(off) < 2


def test_after_a_drive_it_is_true_of_the_new_place(rng):
    off = []
    for _ in range(4):
        made = walk(rng, 60, drive=0.04, turn=0.1)
        answers, _ = run(made)
        for k in range(8, 60):
            # It stands there for eight frames.
            if len(set(made.places[k - 8 : k + 1])) == 1:
                off.append(sigmas_off(answers[k], made.places[k]))
    assert len(off) > 60
    assert np.mean(np.array(off) > 5) < 0.005


def test_its_memory_is_bounded(rng):
    made = walk(rng, 30, spoil=0.2, drive=0.1)
    averager, sizes = Averager(), []
    for n in range(10):
        for f in made.fixes:
            averager.include(replace(f, utc_unix_s=f.utc_unix_s + 1e6 * n))
        sizes.append(len(pickle.dumps(vars(averager))))
    assert max(sizes[4:]) <= max(sizes[:4]) + 200
