# SPDX-License-Identifier: Apache-2.0
"""Venus and Jupiter by day, near the Sun or the Moon: a point that stands where one must; directions by astropy."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, get_body
from astropy.time import Time
from astropy.utils import iers
from levelled_by_day import A3_ARCSEC, FOCAL, LEANING, POSE, SIGMA_PX, SIZE, solver

from starpos import rotation
from starpos.earth.place import Place
from starpos.fix.searching import Question, answer_frame
from starpos.fix.solution import Status
from starpos.fix.sun import LENS_SHARE, by_sun
from starpos.frames.frame import Disc, Stars, no_stars
from starpos.instrument.inclinometer import Tilt
from starpos.units import ARCSEC, unix_of

LATITUDE, LONGITUDE = -20.0, -50.0
RADIUS = np.radians(0.266)
# the Moon 3 deg from Venus, Venus 17 deg from the Sun, Jupiter 7 deg from the Moon
CLOSE = "2023-03-24T15:00:00", "moon", "venus"
WIDE = "2023-01-01T12:00:00", "sun", "venus"
JUPITER = "2023-01-25T15:00:00", "moon", "jupiter"


@cache
def seen(when: str, name: str) -> np.ndarray:
    """Direction (3,) in east, north, up, in the air of the place."""
    there = EarthLocation.from_geodetic(LONGITUDE, LATITUDE, 0.0)
    air = {"pressure": 900 * u.hPa, "temperature": 15 * u.deg_C, "relative_humidity": 0.3}
    with warnings.catch_warnings(), iers.conf.set_temp("auto_download", False):
        warnings.simplefilter("ignore")
        time = Time(when, scale="utc")
        body = get_body(name, time, there).transform_to(
            AltAz(obstime=time, location=there, obswl=0.55 * u.um, **air)
        )
    return rotation.unit_vector(np.pi / 2 - body.az.rad, body.alt.rad)


class Shot:
    """A frame of a disc and points; moved_deg: of the planet away from the disc; false: number of other points."""

    def __init__(self, case, rng, *, false=0, moved_deg=0.0, planet=True):
        when, first, name = case
        self.when = when
        disc, point = seen(when, first), seen(when, name)
        middle = rotation.normalised(disc + point)
        right = rotation.normalised(np.cross(middle, disc - point))
        camera = np.stack([np.cross(right, middle), right, middle], 1)
        camera = camera @ rotation.from_vector(rng.normal(0, 0.03, 3))
        if camera[2, 1] > 0:
            camera = camera @ np.diag([-1.0, -1.0, 1.0])
        point = (
            rotation.from_vector(rotation.normalised(np.cross(disc, point)) * np.radians(moved_deg)) @ point
        )
        optics = solver().instrument.camera_for(*SIZE)
        centre = np.array([optics.cx, optics.cy])
        xy = optics.project(np.array([disc, point]) @ camera)
        xy = centre + (xy - centre) * (1 + rng.normal(0, LENS_SHARE)) + rng.normal(0, SIGMA_PX, (2, 2))
        cosine = float(camera[:, 2] @ disc)
        (x, y), error = xy[0], np.eye(2) * SIGMA_PX**2
        radius = FOCAL * RADIUS / cosine**1.5
        self.disc = Disc(x=x, y=y, covariance=error, radius_px=radius, sharp=True)
        points = np.vstack([xy[1:] if planet else np.zeros((0, 2)), rng.uniform(0, SIZE, (false, 2))])
        rng.shuffle(points)
        n = len(points)
        self.stars = Stars(
            x=points[:, 0], y=points[:, 1], flux=np.full(n, 9e3), snr=np.full(n, 90.0),
            covariance=np.tile(np.eye(2) * SIGMA_PX**2, (n, 1, 1)), flags=np.zeros(n, int),
            width=SIZE[0], height=SIZE[1], mid_unix_s=unix_of(when), exposure_s=0.0,
        )  # fmt: skip
        top = -camera[:, 1]
        self.heading = np.arctan2(top[0], top[1])
        a3 = rotation.from_vector(rng.normal(0, A3_ARCSEC * ARCSEC, 3))
        a3 = a3 @ rotation.about_axis(0, np.radians(LEANING))
        theta = np.arcsin((a3 @ camera[2])[:2]) + rng.normal(0, POSE, 2)
        self.tilt = Tilt(*theta, np.eye(2) * 1e-12, utc_unix_s=unix_of(when))

    def answer(self, place=None):
        return by_sun(solver(), replace(self.stars, disc=self.disc), self.disc, self.tilt, place)

    def nees(self, fix) -> float:
        phi, lam = np.radians([LATITUDE, LONGITUDE])
        off = np.array(
            [
                rotation.half_turn(fix.longitude - lam) * 6.37e6 * np.cos(phi),
                (fix.latitude - phi) * 6.36e6,
                rotation.half_turn(fix.heading - self.heading),
            ]
        )
        return float(off @ np.linalg.solve(fix.covariance, off))


HERE = Place.by_gravity(LATITUDE, LONGITUDE)


@pytest.mark.parametrize("case", [CLOSE, WIDE, JUPITER], ids=["moon venus", "sun venus", "moon jupiter"])
def test_a_point_where_a_planet_stands_makes_a_fix_of_one_frame_as_it_claims(case) -> None:
    rng, nees = np.random.default_rng(3), []
    for _ in range(12):
        shot = Shot(case, rng)
        answer = shot.answer()
        assert answer.bodies == case[1:]
        nees.append(shot.nees(answer.fix))
    # three degrees of freedom
    assert 1.4 < np.mean(nees) < 5.5


def test_at_a_known_place_a_planet_is_told_from_other_points_and_the_heading_is_by_both() -> None:
    rng, squares, claims = np.random.default_rng(4), [], []
    for _ in range(12):
        shot = Shot(WIDE, rng, false=2)
        answer = shot.answer(HERE)
        assert answer.bodies == WIDE[1:]
        north = answer.at_place.plumb
        claims.append(np.degrees(np.sqrt(north.angles_covariance[0, 0])))
        squares.append((rotation.half_turn(north.heading - shot.heading) / np.radians(claims[-1])) ** 2)
    assert 0.3 < np.mean(squares) < 2.3 and np.mean(claims) < 0.015


@pytest.mark.parametrize("place", [HERE, None], ids=["known place", "no place"])
def test_points_that_are_no_planet_change_nothing(place) -> None:
    rng = np.random.default_rng(5)
    wrong = [Shot(case, rng, moved_deg=moved) for case in (CLOSE, WIDE) for moved in (0.2, -1.0)]
    wrong += [Shot((CLOSE, WIDE, JUPITER)[k % 3], rng, planet=False, false=1 + k % 3) for k in range(12)]
    for shot in wrong:
        answer, alone = shot.answer(place), by_sun(
            solver(), replace(no_stars(*SIZE, mid_unix_s=shot.stars.mid_unix_s, exposure_s=0.0), disc=shot.disc),
            shot.disc, shot.tilt, place,
        )  # fmt: skip
        assert len(answer.bodies) == 1 and answer.message == alone.message


def test_a_point_alone_is_no_body() -> None:
    stars = Shot(CLOSE, np.random.default_rng(6)).stars
    answer = answer_frame(solver(), Question(item=stars, stars=stars, places=HERE)).solution
    assert answer.status is Status.TOO_FEW_STARS and answer.bodies == ()
