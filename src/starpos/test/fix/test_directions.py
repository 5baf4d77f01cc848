# SPDX-License-Identifier: Apache-2.0
"""Azimuths and altitudes of directions fixed to a camera, the axis of a mount, a horizontal circle: with their errors."""

import numpy as np
import pytest

from starpos import rotation
from starpos.errors import FixError
from starpos.fix.attitude import Attitude
from starpos.fix.directions import circle_orientation, horizontal, mount_axis, towards
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.units import ARCSEC


def attitude(turn, error=None, terms=()):
    return Attitude(turn, np.zeros((3, 3)) if error is None else error, of="camera", into="ENU", terms=terms)


def test_directions_and_back():
    azimuth, altitude = np.radians([0.0, 90.0, 200.0, 359.0]), np.radians([10.0, -5.0, 60.0, 89.0])
    v = towards(azimuth, altitude)
    assert v[1] == pytest.approx([np.cos(altitude[1]), 0, np.sin(altitude[1])])
    turn = rotation.from_vector([0.3, -1.0, 0.4])
    seen = horizontal(attitude(turn), v @ turn)
    assert seen.azimuth == pytest.approx(azimuth) and seen.altitude == pytest.approx(altitude)


def test_errors_are_those_of_small_rotations(rng):
    turn, root = rotation.from_vector(rng.normal(0, 1, 3)), np.tril(rng.normal(0, 1e-4, (3, 3)))
    v = turn.T @ towards(np.array([2.0]), np.array([0.7]))[0]
    claimed = horizontal(attitude(turn, root @ root.T), v, 5e-5)
    off = []
    for w, own in zip(rng.normal(0, 1, (1200, 3)), rng.normal(0, 5e-5, (1200, 3)), strict=True):
        h = horizontal(attitude(rotation.from_vector(root @ w) @ turn), rotation.normalised(v + own))
        off.append([(h.azimuth[0] - 2.0) * np.cos(0.7), h.altitude[0] - 0.7])
    assert np.cov(np.transpose(off)) == pytest.approx(claimed.covariance[0], rel=0.25, abs=5e-10)


def frames_of(mount, angles, rng, own=5 * ARCSEC, shared=3 * ARCSEC):
    """Attitudes of a camera that a mount turned about an axis, with errors of their own, and one that all share."""
    pose = rotation.from_vector([0.5, 0.2, 1.0])
    common = rotation.from_vector(rng.normal(0, shared, 3))
    terms = tuple(
        ErrorTerm(name, np.vstack([np.zeros((3, 3)), np.eye(3) * sigma]), shared=kind)
        for name, sigma, kind in (("centroids", own, None), ("clock", shared, ALWAYS))
    )
    turns = [rotation.from_vector(mount * a) @ pose for a in np.radians(angles)]
    error = np.eye(3) * (own**2 + shared**2)
    return [attitude(common @ rotation.from_vector(rng.normal(0, own, 3)) @ t, error, terms) for t in turns]


def test_the_axis_of_a_mount_is_found_within_what_is_claimed(rng):
    # to the right of the pole and above it
    mount = towards(np.array([np.radians(0.2)]), np.array([np.radians(47.5)]))[0]
    z2 = []
    for _ in range(120):
        found = mount_axis(frames_of(mount, (0, 40, 95), rng))
        off = np.degrees(found.from_pole(np.radians(47.0))) - [0.2 * np.cos(np.radians(47.5)), 0.5]
        z2.append(off @ np.linalg.solve(np.degrees(np.degrees(found.covariance)), off))
    assert 1.2 < np.mean(z2) < 2.6
    assert np.degrees(np.arcsin(found.direction[2])) == pytest.approx(47.5, abs=0.02)
    assert np.sqrt(np.diag(found.covariance)).max() < 20 * ARCSEC


def test_in_the_south_right_and_above_are_those_of_the_south_pole(rng):
    mount = towards(np.array([np.radians(180.2)]), np.array([np.radians(30.1)]))[0]
    off = mount_axis(frames_of(-mount, (0, 40, 95), rng, 1e-9, 1e-9)).from_pole(np.radians(-30.0))
    assert np.degrees(off) == pytest.approx([0.2 * np.cos(np.radians(30.1)), 0.1], abs=1e-3)


def test_what_is_no_turn_about_one_axis_is_refused(rng):
    up = np.array([0.0, 0.0, 1.0])
    with pytest.raises(FixError, match="one frame shows no axis"):
        mount_axis(frames_of(up, (0,), rng))
    with pytest.raises(FixError, match="turned by 1 deg"):
        mount_axis(frames_of(up, (0, 1), rng))
    other = frames_of(np.array([1.0, 0, 0]), (0, 60), rng)
    with pytest.raises(FixError, match="do not turn about one axis"):
        mount_axis([*frames_of(up, (0, 60), rng), other[1]])


@pytest.mark.parametrize("sense", [1, -1])
def test_a_circle(sense, rng):
    reading, own = np.radians([350.0, 10.0, 80.0, 200.0]), 4 * ARCSEC
    z = []
    for _ in range(100):
        azimuth = (np.radians(123.0) + sense * reading + rng.normal(0, own, 4)) % (2 * np.pi)
        found = circle_orientation(azimuth, np.full(4, own), np.zeros((4, 1)), reading)
        assert found.sense == sense
        z.append((found.zero - np.radians(123.0)) / found.sigma)
    assert 0.6 < np.std(z) < 1.15


def test_a_clock_that_errs_by_the_direction_and_readings_that_scatter(rng):
    # the azimuth's error by a late clock differs from direction to direction, and at two of them it is zero
    reading, own = np.radians(np.arange(45.0, 360, 45)), np.geomspace(1, 30, 7) * ARCSEC
    by_clock = np.radians(0.25) * (0.8 - 1.1 * np.cos(reading))[:, None]
    z = []
    for _ in range(300):
        off = by_clock[:, 0] * rng.normal() + rng.normal(0, own) + rng.normal(0, np.radians(0.2), 7)
        found = circle_orientation(reading + off, own, by_clock, reading)
        z.append(rotation.half_turn(found.zero) / found.sigma)
    assert 0.8 < np.std(z) < 1.1
