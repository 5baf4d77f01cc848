# SPDX-License-Identifier: Apache-2.0
"""The Sun and the Moon on one frame: a fix by both and the level, a heading by both at a known place; drawn frames."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from levelled_by_day import A3_ARCSEC, AIR, FOCAL, LEANING, POSE, SIGMA_PX, SIZE, solver

from starpos import rotation
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.fix.fix import Fix
from starpos.fix.solution import Solution, Status
from starpos.fix.sun import LENS_SHARE, by_sun
from starpos.frames.frame import Disc, no_stars
from starpos.instrument.inclinometer import Tilt
from starpos.sky.bodies import MOON, SUN, body_at
from starpos.units import ARCSEC, unix_of

# the Sun and the Moon 27 and 78 deg high, 72 deg apart
WHEN, HERE = unix_of("2024-11-07T19:30:00"), Place.by_gravity(-20.0, -50.0)


def seen_from_here(name: str) -> np.ndarray:
    """Direction (3,) in east, north, up, in the air."""
    a4 = HERE.plumb_axes
    return AIR.refraction().bend(a4 @ body_at(name, earth_state(WHEN)).from_place(a4[2]))


@dataclass
class Shot:
    """A frame of both bodies and its truth, heading in rad; moved_deg: of the fainter disc, that is not the Moon then."""

    rng: np.random.Generator
    moved_deg: float = 0.0

    def __post_init__(self) -> None:
        sun, moon = (seen_from_here(name) for name in (SUN, MOON))
        middle = rotation.normalised(sun + moon)
        right = rotation.normalised(np.cross(middle, sun - moon))
        camera = np.stack([np.cross(right, middle), right, middle], 1)
        camera = camera @ rotation.from_vector(self.rng.normal(0, 0.03, 3))
        if camera[2, 1] > 0:
            camera = camera @ np.diag([-1.0, -1.0, 1.0])
        moon = rotation.from_vector(np.cross(sun, moon) * np.radians(self.moved_deg)) @ moon
        optics = solver().instrument.camera_for(*SIZE)
        xy = optics.project(np.array([sun, moon]) @ camera)
        middle_px = np.array([optics.cx, optics.cy])
        xy = middle_px + (xy - middle_px) * (1 + self.rng.normal(0, LENS_SHARE))
        xy += self.rng.normal(0, SIGMA_PX, (2, 2))
        radius = [
            FOCAL * body_at(name, earth_state(WHEN)).radius / (camera[:, 2] @ ray) ** 1.5
            for name, ray in ((SUN, sun), (MOON, moon))
        ]
        fainter = disc_at(xy[1], radius[1])
        self.disc = replace(disc_at(xy[0], radius[0]), other=fainter)
        top = -camera[:, 1]
        self.heading = np.arctan2(top[0], top[1])
        a3 = rotation.from_vector(self.rng.normal(0, A3_ARCSEC * ARCSEC, 3)) @ rotation.about_axis(
            0, np.radians(LEANING)
        )
        theta = np.arcsin((a3 @ camera[2])[:2]) + self.rng.normal(0, POSE, 2)
        self.tilt = Tilt(*theta, np.eye(2) * 1e-12, utc_unix_s=WHEN)

    def answer(self, place: Place | None, disc: Disc | None = None) -> Solution:
        disc = disc or self.disc
        stars = replace(no_stars(*SIZE, mid_unix_s=WHEN, exposure_s=0.0), disc=disc)
        return by_sun(solver(), stars, disc, self.tilt, place)


def disc_at(xy: np.ndarray, radius: float) -> Disc:
    return Disc(x=xy[0], y=xy[1], covariance=np.eye(2) * SIGMA_PX**2, radius_px=radius, sharp=True)


def nees(fix: Fix, heading: float) -> float:
    off = np.array(
        [
            rotation.half_turn(fix.longitude - HERE.plumb[1]) * 6.37e6 * np.cos(fix.latitude),
            (fix.latitude - HERE.plumb[0]) * 6.36e6,
            rotation.half_turn(fix.heading - heading),
        ]
    )
    return float(off @ np.linalg.solve(fix.covariance, off))


def test_one_frame_of_both_gives_place_and_heading_as_it_claims() -> None:
    found, rng = [], np.random.default_rng(4)
    for _ in range(40):
        shot = Shot(rng)
        answer = shot.answer(None)
        assert answer.status is Status.OK and answer.bodies == (SUN, MOON)
        found.append((nees(answer.fix, shot.heading), *answer.fix.sigma[:2]))
    # three degrees of freedom
    assert 1.8 < np.mean([row[0] for row in found]) < 4.6
    assert np.max([row[1:] for row in found]) < 3000.0


def test_at_a_known_place_both_give_a_better_heading_than_the_sun_alone() -> None:
    squares, claims, rng = [], [], np.random.default_rng(5)
    for _ in range(40):
        shot = Shot(rng)
        both, alone = shot.answer(HERE), shot.answer(HERE, replace(shot.disc, other=None))
        assert both.bodies == (SUN, MOON) and alone.bodies == (SUN,)
        sigma = [np.sqrt(a.at_place.plumb.angles_covariance[0, 0]) for a in (both, alone)]
        squares.append((rotation.half_turn(both.at_place.plumb.heading - shot.heading) / sigma[0]) ** 2)
        claims.append(sigma)
    assert 0.6 < np.mean(squares) < 1.6
    assert np.mean(claims, 0)[0] < 0.9 * np.mean(claims, 0)[1]


@pytest.mark.parametrize("place", [HERE, None], ids=["known place", "no place"])
def test_a_second_disc_elsewhere_than_the_moon_is_left_out(place) -> None:
    answer = Shot(np.random.default_rng(6), moved_deg=3.0).answer(place)
    assert answer.bodies == (SUN,) and answer.fix is None
    assert (answer.at_place is None) == (place is None)
