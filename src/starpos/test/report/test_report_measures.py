# SPDX-License-Identifier: Apache-2.0
"""The numbers behind a report's figures: deviations, outliers, what was seen where."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import open_night
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Deflection
from starpos.fix.fix import PlaceFix
from starpos.fix.solution import FieldPointing, Status
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.instrument.camera import EQUIDISTANT, Camera
from starpos.instrument.instrument import Calibration, Instrument
from starpos.night.night import Night, Shot, Truth
from starpos.report import measures, night_figures
from starpos.sky.site import Site, camera_to_enu
from starpos.units import ARCSEC
from starpos_testing.skies.reports import simulate

FOCAL_PX = 29.67e3 / 6.4
AIR = Atmosphere(pressure_pa=100000.0, temperature_c=5.0, humidity=0.3)


@pytest.fixture(scope="module")
def lists(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("lists") / "lists", "--cadence", 30, frames=3)


def work(lists):
    known = Instrument(FOCAL_PX, calibration=Calibration.of((0.0,) * 3, (5.0,) * 3))
    return open_night(lists, instrument=known, atmosphere=AIR).solve()


def night(latitudes, longitudes, headings, truth=None, own_m=100.0, common_m=50.0):
    """Angles in rad; errors the same east and north."""
    scale = np.diag([1.0, 1.0, 0.0])
    pad = np.zeros((3, 3))
    terms = (
        ErrorTerm("tilt", np.vstack([own_m * scale, pad])),
        ErrorTerm("calibration", np.vstack([common_m * scale, pad]), shared=ALWAYS),
    )
    shots = [
        Shot(
            name=str(k),
            status=Status.OK,
            message="",
            utc_unix_s=1.8e9 + k,
            place=PlaceFix(
                utc_unix_s=1.8e9 + k, latitude=angles[0], longitude=angles[1], heading=angles[2], terms=terms
            ),  # fmt: skip,
        )
        for k, angles in enumerate(zip(latitudes, longitudes, headings, strict=True))
    ]
    middle = replace(shots[0].place, latitude=float(np.mean(latitudes)))
    return Night(
        name="made",
        origin="",
        shots=shots,
        combined=middle,
        why_not="",
        vertical=Deflection(),
        atmosphere=AIR,
        truth=truth,
    )


def test_deviations_are_from_the_mean_in_arcsec():
    s = measures.stability(
        night(0.7 + np.array([-2, 0, 2]) * ARCSEC, 0.5 + np.array([3, 0, -3]) * ARCSEC, [1.0] * 3)
    )
    np.testing.assert_allclose(s.arcsec[:, 0], [-2, 0, 2], atol=1e-9)
    np.testing.assert_allclose(s.arcsec[:, 1], [3, 0, -3], atol=1e-9)
    np.testing.assert_allclose(s.mean_absolute, [4 / 3, 2, 0], atol=1e-9)
    prime, meridian = curvature_radii_m(0.7)
    wanted = np.array([100 / meridian, 100 / (prime * np.cos(0.7)), 0]) / ARCSEC
    # What all frames share is not in it.
    np.testing.assert_allclose(s.sigma, [wanted] * 3, rtol=1e-4)


def test_deviations_across_the_date_line_and_north():
    s = measures.stability(night([0.7, 0.7], [np.pi - ARCSEC, ARCSEC - np.pi], [ARCSEC, 2 * np.pi - ARCSEC]))
    np.testing.assert_allclose(np.abs(s.arcsec[:, 1:]), 1, atol=1e-6)
    assert s.heading_from == "mean"


def test_one_frame_that_jumps_is_the_outlier(rng):
    latitudes = 0.7 + rng.normal(0, 3, 30) * ARCSEC
    latitudes[11] += 60 * ARCSEC
    s = measures.stability(night(latitudes, 0.5 + rng.normal(0, 3, 30) * ARCSEC, [1.0] * 30))
    assert np.flatnonzero(s.outlier).tolist() == [11]
    # Too few to decide.
    assert not measures.stability(night([0.7, 0.7, 0.8], [0.5] * 3, [1.0] * 3)).outlier.any()


def test_headings_of_a_turned_instrument_are_held_against_the_truth():
    headings = np.array([0.1, 2.0, 4.0])
    true = Truth(0.7, 0.5, tuple((1.8e9 + k, h - 5 * ARCSEC) for k, h in enumerate(headings)))
    s = measures.stability(night([0.7] * 3, [0.5] * 3, headings, true))
    assert s.heading_from == "truth"
    np.testing.assert_allclose(s.arcsec[:, 2], 5, atol=1e-6)
    s = measures.stability(night([0.7] * 3, [0.5] * 3, headings, replace(true, headings=true.headings[:2])))
    assert s.heading_from == "" and np.isnan(s.arcsec[:, 2]).all()


def test_the_share_inside_is_of_the_frames_own_errors(rng):
    prime, meridian = curvature_radii_m(0.7)
    away = rng.normal(0, 100.0, (4000, 2)) / [meridian, prime * np.cos(0.7)]
    n = night(0.7 + away[:, 0], 0.5 + away[:, 1], [1.0] * 4000)
    n = replace(n, combined=replace(n.combined, latitude=0.7, longitude=0.5))
    assert measures.share_inside(n, measures.INSIDE_1_SIGMA) / 4000 == pytest.approx(0.3935, abs=0.03)
    assert measures.share_inside(n, measures.INSIDE_95) / 4000 == pytest.approx(0.95, abs=0.015)


def test_the_error_is_the_night_less_the_truth():
    n = night([0.7] * 2, [0.5] * 2, [1.0] * 2, Truth(0.7 - 3 * ARCSEC, 0.5 + 4 * ARCSEC))
    np.testing.assert_allclose(measures.error_arcsec(n.combined, n.truth), [3, -4], atol=1e-9)


def test_a_residual_points_to_where_the_star_was_seen(lists):
    before = work(lists).shots[0]
    path = lists / "stars_0000.csv"
    whole = path.read_text()
    head, names, *rows = whole.splitlines()
    # A faint one, whose error allows for what is done to it.
    x, y = before.xy[-1]
    row = next(k for k, r in enumerate(rows) if np.allclose([float(v) for v in r.split(",")[:2]], [x, y]))
    values = rows[row].split(",")
    rows[row] = ",".join([f"{x + 0.1:.5f}", f"{y - 0.15:.5f}", *values[2:]])
    path.write_text("\n".join([head, names, *rows]) + "\n")
    try:
        after = work(lists).shots[0]
    finally:
        path.write_text(whole)
    (k,) = np.flatnonzero(np.isclose(after.xy, [x + 0.1, y - 0.15]).all(1))
    np.testing.assert_allclose(after.residual_px[k] - before.residual_px[-1], [0.1, -0.15], atol=0.02)


def test_stars_are_drawn_where_they_stand_on_the_sky(lists):
    n = work(lists)
    site = Site(np.degrees(n.combined.latitude), np.degrees(n.combined.longitude), AIR)
    for shot in n.shots:
        icrs = night_figures.View(shot, shot.pointing, shot.size).directions(shot.xy)
        azimuth, zenith_deg = night_figures.polar(site.refracted(icrs, earth_state(shot.utc_unix_s)))
        camera = Camera.from_focal(*shot.size, FOCAL_PX)
        # As `simulate` points.
        true = camera.directions(*shot.xy.T) @ camera_to_enu(40.0, 78.0, 15.0).T
        np.testing.assert_allclose(zenith_deg, np.degrees(np.arccos(true[:, 2])), atol=0.02)
        across = np.sin(azimuth - np.arctan2(true[:, 0], true[:, 1])) * np.sin(np.radians(zenith_deg))
        np.testing.assert_allclose(np.degrees(across), 0, atol=0.02)


def test_a_night_at_two_places_is_averaged_at_the_last_and_says_so(tmp_path):
    first = simulate(tmp_path / "first", "--turn", 60, frames=4)
    moved = ("--turn", 60, "--start", "2026-11-02T19:00:00")
    second = simulate(tmp_path / "second", *moved, frames=5, place={"latitude": 47.9, "longitude": -122.8})
    tilts = (second / "tilt.csv").read_text().splitlines()[1:]
    with (first / "tilt.csv").open("a") as file:
        file.write("\n".join(tilts) + "\n")
    for path in second.glob("stars_*.csv"):
        path.rename(first / f"then_{path.name}")
    n = work(first)
    assert np.degrees(n.combined.latitude) == pytest.approx(47.9, abs=0.02)
    assert any("was moved" in remark and "2026-11-02T19:00:00" in remark for remark in n.remarks)


def test_a_fisheye_sees_to_the_horizon_on_the_map():
    looking = FieldPointing(
        ra=1.0,
        dec=0.5,
        roll=2.0,
        focal_px=600.0,
        residual_arcsec=1.0,
        log_odds=99.0,
        mirrored=False,
        model=EQUIDISTANT,
    )
    shot = Shot(name="a", status=Status.OK, message="", pointing=looking, size=(2001, 2001))
    view = night_figures.View(shot, looking, (2001, 2001))
    middle, edge = view.directions(np.array([[1000.0, 1000.0], [1000.0 + 300 * np.pi, 1000.0]]))
    assert abs(middle @ edge) < 1e-12
    assert np.arctan2(middle[1], middle[0]) == pytest.approx(1.0)
