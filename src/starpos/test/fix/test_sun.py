# SPDX-License-Identifier: Apache-2.0
"""Heading by the Sun and the level at a known place, against azimuths and altitudes that astropy computed."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.averaging.altitudes import place_of_circles, place_of_discs
from starpos.earth.orientation import earth_state
from starpos.earth.place import Place
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.errors import FixError
from starpos.fix.searching import Question, answer_frame
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.fix.sun import by_sun, sun_alone
from starpos.frames.frame import Disc, Stars, no_stars
from starpos.instrument.inclinometer import InclinometerErrors, Tilt
from starpos.instrument.instrument import Calibration, Instrument
from starpos.rotation import unit_vector
from starpos.sky.bodies import body_at
from starpos.sky.catalogue import load_catalogue
from starpos.sky.site import camera_to_enu
from starpos.units import ARCSEC, unix_of

AIR = Atmosphere(pressure_pa=90000.0, temperature_c=15.0, humidity=0.3)
POSE, A3 = np.radians(0.02), 60.0
LEANING = -45.0
# UTC, latitude, longitude, azimuth and altitude of the Sun: astropy 7's AltAz with 900 hPa, 15 deg C, 0.55 um
SUNS = [
    ("2025-06-01T09:00:00", 48.0, 11.0, 122.261538, 52.840143),
    ("2024-12-20T21:00:00", -35.0, 149.0, 102.320686, 24.634581),
    ("2025-03-20T15:30:00", 5.0, -75.0, 100.662794, 65.220427),
]
WHEN, LATITUDE, LONGITUDE, AZIMUTH, ALTITUDE = SUNS[0]
HERE = Place.on_ellipsoid(LATITUDE, LONGITUDE)
SIZE = 1936, 1216


def solver_of(a3_arcsec: float = A3) -> Solver:
    instrument = Instrument(
        4266.0,
        calibration=Calibration.of((LEANING, 0.0, 0.0), (a3_arcsec,) * 3),
        inclinometer=InclinometerErrors(
            pose_rad=POSE, quantum_rad=0.0, drift_rad_per_sqrt_hour=0.0, scale=0.0
        ),
        clock_stddev_s=0.02,
    )
    return Solver(instrument, load_catalogue(), AIR)


class View:
    """A camera near the Sun, its frame's disc and its tilt, without errors; heading, pitch: of the frame's top, rad."""

    def __init__(
        self, azimuth_deg: float, altitude_deg: float, beside=(3.0, -2.0), roll_deg: float = 20.0
    ) -> None:
        attitude = camera_to_enu(azimuth_deg + beside[0], altitude_deg + beside[1], roll_deg)
        sun = unit_vector(np.pi / 2 - np.radians(azimuth_deg), np.radians(altitude_deg))
        self.xy = solver_of().instrument.camera_for(*SIZE).project(sun @ attitude)
        top = -attitude[:, 1]
        self.heading, self.pitch = np.arctan2(top[0], top[1]), np.arcsin(top[2])
        self.up = rotation.about_axis(0, np.radians(LEANING)) @ attitude[2]

    def answer(self, utc: str, place: Place | None, solver: Solver, **more) -> Solution:
        """The answer to its frame; moved: px of the disc, tilted: rad of the two angles, turned: of A3."""
        xy = self.xy + more.get("moved", 0.0)
        up = more.get("turned", np.eye(3)) @ self.up
        theta = np.arcsin(up[:2]) + more.get("tilted", 0.0)
        tilt = Tilt(*theta, np.eye(2) * 1e-10, utc_unix_s=unix_of(utc))
        disc = Disc(
            x=xy[0],
            y=xy[1],
            covariance=np.eye(2) * 0.04,
            radius_px=more.get("radius", 19.7),
            sharp=more.get("sharp", True),
        )
        stars: Stars = replace(no_stars(*SIZE, mid_unix_s=unix_of(utc), exposure_s=0.0), disc=disc)
        return by_sun(solver, stars, disc, tilt, place)


@pytest.mark.parametrize(("utc", "latitude", "longitude", "azimuth", "altitude"), SUNS)
def test_the_heading_is_where_the_sun_stands(utc, latitude, longitude, azimuth, altitude) -> None:
    view = View(azimuth, altitude)
    found = view.answer(utc, Place.on_ellipsoid(latitude, longitude), solver_of())
    assert found.bodies == ("sun",)
    assert rotation.half_turn(found.at_place.plumb.heading - view.heading) == pytest.approx(
        0, abs=1.0 * ARCSEC
    )
    assert found.at_place.plumb.pitch - view.pitch == pytest.approx(0, abs=1.0 * ARCSEC)


def test_errors_of_heading_pitch_and_roll_are_as_claimed() -> None:
    rng, solver, squares = np.random.default_rng(3), solver_of(), []
    for _ in range(120):
        view = View(AZIMUTH, ALTITUDE, rng.uniform(-5, 5, 2), rng.uniform(0, 360))
        found = view.answer(
            WHEN,
            HERE,
            solver,
            moved=rng.normal(0, 0.2, 2),
            tilted=rng.normal(0, POSE, 2),
            turned=rotation.from_vector(rng.normal(0, A3 * ARCSEC, 3)),
        ).at_place
        off = rotation.half_turn(found.plumb.heading - view.heading)
        squares.append(off**2 / found.plumb.angles_covariance[0, 0])
    assert 0.75 < np.mean(squares) < 1.3


def test_an_unknown_deflection_is_in_the_claim_of_north_by_the_ellipsoid_too() -> None:
    lean = Deflection(0.0, 0.0, 30.0)
    found = View(AZIMUTH, ALTITUDE).answer(
        WHEN, Place.on_ellipsoid(LATITUDE, LONGITUDE, lean), solver_of(1.0)
    )
    terms = {t.name: t for t in found.at_place.ellipsoid.terms}
    # the level shows the plumb line, so that its lean is an error of the ellipsoid's level
    assert np.sqrt(terms["deflection"].covariance[3, 3]) > 10 * ARCSEC


def test_what_is_not_the_sun_gives_no_heading() -> None:
    solver, at_sun = solver_of(), View(AZIMUTH, ALTITUDE)
    lamp = View(AZIMUTH, ALTITUDE - 1.0).answer(WHEN, HERE, solver)
    wide = at_sun.answer(WHEN, HERE, solver, radius=40.0)
    by_night = at_sun.answer("2025-06-01T23:00:00", HERE, solver)
    an_hour_off = at_sun.answer("2025-06-01T10:00:00", HERE, solver)
    for found, word in (
        (lamp, "altitude"),
        (wide, "deg wide"),
        (by_night, "altitude of -"),
        (an_hour_off, "the clock"),
    ):
        assert found.status is Status.POOR_FIT
        assert found.at_place is None
        assert word in found.message


def test_a_glow_that_is_a_degree_off_is_a_lamp() -> None:
    lamp = View(AZIMUTH, ALTITUDE - 1.0).answer(WHEN, HERE, solver_of(), sharp=False, radius=60.0)
    assert lamp.at_place is None


def test_a_frame_is_answered_by_what_it_shows() -> None:
    view = View(AZIMUTH, ALTITUDE)
    disc = Disc(x=view.xy[0], y=view.xy[1], covariance=np.eye(2) * 0.04, radius_px=19.7, sharp=True)
    stars = replace(no_stars(*SIZE, mid_unix_s=unix_of(WHEN), exposure_s=0.0), disc=disc)
    tilt = Tilt(*np.arcsin(view.up[:2]), np.eye(2) * 1e-10, utc_unix_s=unix_of(WHEN))
    sight = answer_frame(solver_of(), Question(item=stars, stars=stars, tilts=tilt, places=HERE))
    assert sight.solution.ok
    assert sight.solution.bodies == ("sun",)


@pytest.mark.parametrize("sharp", [True, False])
def test_a_disc_as_wide_as_the_sun_among_stars_is_not_the_sun(night, sharp) -> None:
    scene, stars, tilt, solver = night
    radius_px = scene.camera.fx * np.radians(0.266)
    disc = Disc(x=300.0, y=200.0, covariance=np.eye(2) * 0.04, radius_px=radius_px, sharp=sharp)
    stars = replace(stars, disc=disc)
    solution = answer_frame(solver, Question(item=stars, stars=stars, tilts=tilt)).solution
    assert solution.found is not None and solution.bodies != ("sun",)
    assert np.isfinite(solution.fix.latitude)


def test_without_the_level_or_a3_it_says_so() -> None:
    unknown = Solver(Instrument(4266.0), load_catalogue(), AIR)
    assert "A3" in View(AZIMUTH, ALTITUDE).answer(WHEN, HERE, unknown).message


def sun_at(hours: float, latitude: float, longitude: float) -> tuple[str, float, float]:
    """UTC, azimuth and altitude (deg) of the refracted Sun on 1 June 2025, for circles that come from one camera."""
    utc = f"2025-06-01T{int(hours):02d}:{int(hours % 1 * 60):02d}:00"
    place = Place.on_ellipsoid(latitude, longitude)
    seen = AIR.refraction().bend(
        place.axes @ body_at("sun", earth_state(unix_of(utc))).from_place(place.zenith)
    )
    return utc, np.degrees(np.arctan2(seen[0], seen[1])), np.degrees(np.arcsin(seen[2]))


def circles_of(name: str, hours, rng) -> list:
    """Circles of equal altitude of a body that a level of good poses sees, turned each time."""
    solver, made = solver_of(1.0), []
    for hour in hours:
        when = unix_of("2025-06-05T00:00:00") + 3600 * hour
        body = body_at(name, earth_state(when))
        seen = AIR.refraction().bend(HERE.axes @ body.from_place(HERE.zenith))
        azimuth, altitude = np.degrees([np.arctan2(seen[0], seen[1]), np.arcsin(seen[2])])
        view = View(azimuth, altitude, rng.uniform(-4, 4, 2), rng.uniform(-50, 50))
        utc = np.datetime_as_string(np.datetime64(round(when), "s"))
        radius = (
            body.radius * 4266 * (1 + np.sin(np.radians(altitude)) * (body.parallax if name == "moon" else 0))
        )
        made.append(view.answer(utc, None, solver, tilted=rng.normal(0, POSE, 2), radius=radius).circle)
    return made


@pytest.mark.parametrize(
    ("name", "hours"), [("sun", np.arange(7, 12, 0.5)), ("moon", np.arange(16, 21, 0.5))]
)
def test_discs_of_an_unknown_place_are_the_bodys_whose_circles_meet(name, hours) -> None:
    circles = circles_of(name, hours, np.random.default_rng(2))
    place, found = place_of_discs(circles)
    assert found == name
    off = HERE.offset_m(place.latitude, place.longitude)
    assert off @ np.linalg.solve(place.covariance[:2, :2], off) < 12
    near, chosen = place_of_discs(circles[:5:2], (HERE.plumb[0] + 0.02, HERE.plumb[1] - 0.03))
    assert chosen == name
    assert np.linalg.norm(HERE.offset_m(near.latitude, near.longitude)) < 60_000


def test_discs_that_both_bodies_explain_give_no_place() -> None:
    rng = np.random.default_rng(2)
    circles = [replace(c, instead=c) for c in circles_of("sun", np.arange(7, 12, 0.5), rng)]
    with pytest.raises(FixError, match="the Sun's or the Moon's"):
        place_of_discs(circles)


def test_many_suns_of_a_turned_level_give_a_place_and_of_one_at_rest_one_as_bad_as_its_pose() -> None:
    rng, solver = np.random.default_rng(5), solver_of(1.0)
    nees = []
    for _ in range(5):
        circles = []
        for hours in np.linspace(7, 12, 12):
            utc, azimuth, altitude = sun_at(hours, LATITUDE, LONGITUDE)
            view = View(azimuth, altitude, rng.uniform(-4, 4, 2), rng.uniform(-50, 50))
            found = view.answer(utc, None, solver, moved=rng.normal(0, 0.2, 2), tilted=rng.normal(0, POSE, 2))
            circles.append(found.circle)
        place = place_of_circles(circles)
        off = HERE.offset_m(place.latitude, place.longitude)
        nees.append(off @ np.linalg.solve(place.covariance[:2, :2], off))
    assert 0.6 < np.mean(nees) < 4.5
    assert np.sqrt(place.covariance[1, 1]) < 0.7 * POSE * 6.37e6
    attitude = camera_to_enu(AZIMUTH, ALTITUDE - 3, 20.0)
    circles = []
    for hours in np.linspace(8.6, 9.2, 8):
        utc, azimuth, altitude = sun_at(hours, LATITUDE, LONGITUDE)
        view = View(azimuth, altitude)
        sun = unit_vector(np.pi / 2 - np.radians(azimuth), np.radians(altitude))
        view.xy = solver.instrument.camera_for(*SIZE).project(sun @ attitude)
        view.up = rotation.about_axis(0, np.radians(LEANING)) @ attitude[2]
        circles.append(view.answer(utc, None, solver).circle)
    assert np.sqrt(place_of_circles(circles).covariance[:2, :2].trace()) > 0.95 * POSE * 6.37e6


def test_a_frame_for_the_navigator_is_the_suns_direction_and_no_turn_about_it() -> None:
    view, solver = View(AZIMUTH, ALTITUDE), solver_of()
    disc = Disc(x=view.xy[0], y=view.xy[1], covariance=np.eye(2) * 0.04, radius_px=19.7, sharp=True)
    stars = replace(no_stars(*SIZE, mid_unix_s=unix_of(WHEN), exposure_s=0.0), disc=disc)
    seen = sun_alone(solver, stars, disc, "camera")
    assert seen is not None
    ray = solver.instrument.camera_for(*SIZE).directions(view.xy[:1], view.xy[1:])[0]
    assert seen.ray == pytest.approx(ray, abs=1e-9)
    sun = body_at("sun", earth_state(unix_of(WHEN)))
    assert earth_state(unix_of(WHEN)).gcrs_to_itrs @ seen.camera_to_gcrs @ seen.ray == pytest.approx(
        sun.itrs, abs=1e-9
    )
    across = np.sqrt(np.linalg.eigvalsh(seen.covariance)[:2])
    assert 0.19 / 4266 < across[0] < across[1] < 1e-3
    assert sun_alone(solver, stars, replace(disc, radius_px=40.0), "camera") is None


@pytest.mark.parametrize("altitude_deg", [3.5, 2.0, 0.5])
def test_low_as_it_is_the_sun_gives_a_heading_whose_altitude_may_be_off(altitude_deg) -> None:
    """Days differ by arcminutes in how high they raise the Sun: the heading stays."""
    utc, place = low_sun(altitude_deg)
    true = place.plumb_axes @ body_at("sun", earth_state(unix_of(utc))).from_place(place.plumb_axes[2])
    bent, sigma = AIR.raised(true)
    azimuth, altitude = np.degrees([np.arctan2(true[0], true[1]), np.arcsin(bent[2])])
    view = View(azimuth, altitude + np.degrees(2 * sigma), beside=(1.0, 0.5))
    found = view.answer(utc, place, solver_of())
    assert found.bodies == ("sun",)
    off = rotation.half_turn(found.at_place.plumb.heading - view.heading)
    assert abs(off) < 2.5 * np.sqrt(found.at_place.plumb.angles_covariance[0, 0])
    # about up; the frame's top, which stands upright, leans as the level errs
    assert found.at_place.plumb.covariance[2, 2] < np.radians(0.03) ** 2


def test_a_sun_that_has_set_gives_no_heading() -> None:
    utc, place = low_sun(-1.0)
    found = View(250.0, 0.5).answer(utc, place, solver_of())
    assert found.at_place is None
    assert "at an altitude of -1.0 deg" in found.message


def low_sun(altitude_deg: float) -> tuple[str, Place]:
    """A time, and a place on the equator where the Sun stands so high in the west, without refraction."""
    sun = body_at("sun", earth_state(unix_of(WHEN)))
    for longitude in np.arange(60.0, 160.0, 0.01):
        place = Place.on_ellipsoid(0.0, longitude)
        up = place.plumb_axes[2]
        if sun.from_place(up) @ up < np.sin(np.radians(altitude_deg)):
            return WHEN, place
    raise AssertionError
