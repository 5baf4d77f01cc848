# SPDX-License-Identifier: Apache-2.0
"""A header's pointing: a hint that finds fields of a few stars, and that is never believed without them."""

import numpy as np
import pytest

from starpos import rotation
from starpos.frames.header import aim_deg
from starpos.identification.pose import stars_at
from starpos.identification.prior import AimPrior
from starpos.identification.search import identify_near
from starpos.instrument.camera import Camera

WIDTH, HEIGHT, FOCAL_PX = 1080, 1920, 86_200.0
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=FOCAL_PX, fy=FOCAL_PX, cx=539.5, cy=959.5)
FALSE_STARS = 30


def field_of(sky, toward, rng, stars=5):
    """A field of the brightest catalogue stars there, among others that the catalogue lacks; its scale is 0.9 % off."""
    around = rotation.shortest_turn(toward, np.array([0.0, 0.0, 1.0]))
    attitude = rotation.about_axis(2, rng.uniform(0, 2 * np.pi)) @ around
    w = sky.directions(sky.catalogue.cone(toward, 0.01)) @ attitude.T
    xy = CAMERA.centre_px + 1.009 * FOCAL_PX * w[:, :2] / w[:, 2:]
    xy = xy[((xy > 5) & (xy < [WIDTH - 5, HEIGHT - 5])).all(1)][:stars]
    if len(xy) < stars:
        return None
    false = rng.uniform([0, 0], [WIDTH, HEIGHT], (FALSE_STARS, 2))
    xy = np.concatenate([xy + rng.normal(0, 0.1, xy.shape), false])
    return stars_at(CAMERA, xy, np.full(len(xy), 0.1))


def fields(sky, rng, number):
    """Fields, each with the direction of its middle."""
    while number:
        toward = rotation.unit_vector(rng.uniform(0, 2 * np.pi), np.arcsin(rng.uniform(-1, 1)))
        if (field := field_of(sky, toward, rng)) is not None:
            number -= 1
            yield toward, field


def off(toward, deg, rng):
    """A direction that is some degrees from another one."""
    side = np.cross(toward, rng.normal(size=3))
    return rotation.from_vector(np.radians(deg) * side / np.linalg.norm(side)) @ toward


def test_a_pointing_that_is_right_to_some_tenths_of_a_degree_finds_a_field_of_five_stars(sky, rng):
    found = 0
    for toward, field in fields(sky, rng, 12):
        near = identify_near(field, sky, [AimPrior(off(toward, 0.3, rng))])
        if near is not None:
            found += 1
            assert np.degrees(np.arccos(near.attitude[2] @ toward)) < 0.01
    assert found >= 10


def test_a_wrong_pointing_finds_no_place(sky, rng):
    for toward, field in fields(sky, rng, 12):
        assert identify_near(field, sky, [AimPrior(off(toward, 3.0, rng))]) is None


@pytest.mark.parametrize(
    ("header", "aim"),
    [
        ({"RA": 193.04166, "DEC": 40.970556}, (193.04166, 40.970556)),
        ({"OBJCTRA": "12 52 10", "OBJCTDEC": "-00 30 00"}, (193.0416667, -0.5)),
        ({"RA": "12:52:10.0", "DEC": "+40:58:14"}, (193.0416667, 40.9705556)),
        ({"RA": "193.5", "DEC": "-12.5"}, (193.5, -12.5)),
        ({"TELRA": "12h52m10s", "TELDEC": "+40d58m14s"}, (193.0416667, 40.9705556)),
        ({"RA": "nan", "DEC": 1.0}, None),
        ({"RA": 400.0, "DEC": 1.0}, None),
        ({"RA": "M 94", "DEC": 1.0}, None),
        ({"RA": 12.0}, None),
        ({}, None),
    ],
)
def test_a_headers_pointing_is_read_as_programs_write_it(header, aim):
    assert aim_deg(header) == (None if aim is None else pytest.approx(aim))
