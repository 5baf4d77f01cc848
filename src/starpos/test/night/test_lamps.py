# SPDX-License-Identifier: Apache-2.0
"""A lamp as high as the Sun, over several frames of a camera at rest: it does not move with the sky."""

from dataclasses import replace

import numpy as np
import pytest

from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.fix.glows import Glow, Glows
from starpos.fix.searching import Sight
from starpos.fix.solver import Solver
from starpos.fix.sun import by_sun
from starpos.frames.frame import Disc, no_stars
from starpos.instrument.camera import EQUIDISTANT
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.night.reading import Instruments
from starpos.night.solving import answers_of
from starpos.night.together import FrameAnswer
from starpos.night.work import Solving
from starpos.rotation import from_vector
from starpos.sky.bodies import body_at
from starpos.sky.catalogue import load_catalogue
from starpos.units import unix_of

SIZE = 1200
HERE, AIR = Place.on_ellipsoid(48.0, 11.0), Atmosphere.measured(95000.0, 15.0)
NOON = unix_of("2025-06-01T11:10:00")
INSTRUMENT = Instrument(
    SIZE / np.pi,
    model=EQUIDISTANT,
    calibration=Calibration.of((0.0, 0.0, 0.0), (60.0,) * 3),
    inclinometer=InclinometerErrors(
        pose_rad=np.radians(0.02), quantum_rad=0.0, drift_rad_per_sqrt_hour=0.0, scale=0.0
    ),
    clock_stddev_s=0.02,
)
SOLVER = Solver(INSTRUMENT, load_catalogue(), AIR)


def answers(seconds, lamp: bool):
    """Make the answers to frames of an upright fisheye at rest, around noon, when the Sun keeps its altitude."""
    tilt, made = Tilt(0.0, 0.0, np.eye(2) * 1e-10, utc_unix_s=NOON), []
    for s in seconds:
        seen_s = NOON + (seconds[0] if lamp else s)
        sun = AIR.refraction().bend(HERE.axes @ body_at("sun", earth_state(seen_s)).from_place(HERE.zenith))
        # x east, y north
        xy = INSTRUMENT.camera_for(SIZE, SIZE).project(sun)
        disc = Disc(x=xy[0], y=xy[1], covariance=np.eye(2) * 0.3, radius_px=20.0, sharp=False)
        stars = replace(no_stars(SIZE, SIZE, mid_unix_s=NOON + s, exposure_s=0.0), disc=disc)
        made.append((stars, by_sun(SOLVER, stars, disc, replace(tilt, utc_unix_s=NOON + s), HERE)))
    return made


def test_a_glow_counts_once_it_has_moved_as_the_sun_and_a_lamp_never():
    for lamp, wanted in ((True, [False] * 4), (False, [False, False, True, True])):
        glows = Glows()
        assert [s.beside(glows).ok for _, s in answers([0, 30, 500, 600], lamp)] == wanted


@pytest.mark.parametrize("moved_px, still", [(0.5, True), (30.0, None), (700.0, False)])
def test_a_camera_that_was_turned_meanwhile_may_have_the_sun_near_its_old_pixel(moved_px, still):
    def glow(hours, px):
        sun, ray = (np.array([np.cos(a), np.sin(a), 0.0]) for a in (hours * np.pi / 12, px * np.pi / SIZE))
        return Glow(NOON + hours * 3600.0, ray, sun, sigma=0.6 * np.pi / SIZE)

    assert glow(0.0, 0.0).stood_still(glow(6.7, moved_px)) is still


@pytest.mark.parametrize("lamp", [True, False])
def test_all_frames_of_a_lamp_are_refused_where_they_are_solved_together(lamp):
    sights = [(f"{k}", Sight(stars, s)) for k, (stars, s) in enumerate(answers([0, 30, 500, 600], lamp))]
    work = Solving(Instruments(INSTRUMENT), atmosphere=AIR)
    told: list[FrameAnswer] = list(answers_of(sights, work, Deflection()).each)
    assert [a.name for a in told] == ["0", "1", "2", "3"]
    assert [a.solution.ok for a in told] == [not lamp] * 4
    if lamp:
        assert all("lamp" in a.solution.message and a.solution.at_place is None for a in told)


def test_a_glow_that_nothing_proves_has_no_heading():
    sights = [(f"{k}", Sight(stars, s)) for k, (stars, s) in enumerate(answers([0, 30], lamp=False))]
    told = list(answers_of(sights, Solving(Instruments(INSTRUMENT), atmosphere=AIR), Deflection()).each)
    assert [a.solution.ok for a in told] == [False, False]
    assert all("some minutes later" in a.solution.message for a in told)


def test_a_lamp_that_shifts_a_little_does_not_become_the_sun():
    """Its last glow has neither kept its place nor moved as the Sun."""
    rows = answers([0, 30, 500, 600], lamp=True)
    stars, last = rows[-1]
    shifted = replace(last.glow, ray=from_vector([0.012, 0.0, 0.0]) @ last.glow.ray)
    rows[-1] = stars, replace(last, glow=shifted)
    assert rows[0][1].glow.stood_still(shifted) is None
    sights = [(f"{k}", Sight(stars, s)) for k, (stars, s) in enumerate(rows)]
    told = list(answers_of(sights, Solving(Instruments(INSTRUMENT), atmosphere=AIR), Deflection()).each)
    assert [a.solution.ok for a in told] == [False] * 4
    assert "some minutes later" in told[-1].solution.message
