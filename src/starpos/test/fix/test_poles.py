# SPDX-License-Identifier: Apache-2.0
"""Fixes at the poles: with every step longitude and heading change, but the place and its errors are as anywhere."""

from dataclasses import replace

import numpy as np
import pytest

from starpos import rotation
from starpos.earth.ellipsoid import EARTH_RADIUS_M, curvature_radii_m, enu_axes, meridian_turn, zenith_of
from starpos.earth.orientation import earth_state
from starpos.earth.vertical import Deflection, geodetic
from starpos.fix.attitude import heading_of
from starpos.fix.budget import level_rows, local_north
from starpos.units import ARCSEC
from starpos_testing.skies.fields import UTC, SkyField, random_field

STATE = earth_state(UTC)
LATITUDES = [89.9999, -89.9999, 90.0, -90.0]


@pytest.mark.parametrize("latitude", LATITUDES)
def test_place_and_heading_together_are_the_attitude_on_the_earth(latitude, rng):
    for _ in range(4):
        field = random_field(rng, latitude=latitude)
        xy, places = field.places(STATE, rng)
        fix = field.solve(xy, places, STATE)
        site = enu_axes(*np.radians([field.latitude, field.longitude]))
        found = enu_axes(fix.latitude, fix.longitude)
        np.testing.assert_allclose(found[2], site[2], atol=1e-11)
        np.testing.assert_allclose(found.T @ fix.link_to_enu[:, 2], site.T @ field.attitude[:, 2], atol=1e-9)
        east, north, _ = found
        level = np.sin(fix.heading) * east + np.cos(fix.heading) * north
        true = np.sin(field.heading) * site[0] + np.cos(field.heading) * site[1]
        np.testing.assert_allclose(level, true, atol=1e-9)


@pytest.mark.parametrize("latitude", [89.9999, 90.0, 60.0])
def test_the_covariance_of_a_geodetic_place_at_a_pole_is_true(latitude, rng):
    """Errors of the tilt, 20 arcsec, are many times the 11 m to the pole; the mean of D2 of two axes is 2."""
    d, sigma, draws = Deflection(8.0, -5.0, 0.0), 20 * ARCSEC, 300
    field = SkyField(latitude=latitude)
    xy, places = field.places(STATE, rng)
    tilt = field.tilt(np.eye(2) * sigma**2)
    distances2 = []
    for x, y in rng.normal(0, sigma, (draws, 2)):
        fix = field.solve(
            xy, places, STATE, tilt=replace(tilt, theta_x=tilt.theta_x + x, theta_y=tilt.theta_y + y)
        )
        ground = geodetic(fix.latitude, fix.longitude, fix.heading, fix.covariance, d)
        assert np.isfinite(ground.covariance).all()
        # the truth is the true zenith, turned as the fix's
        found = enu_axes(fix.latitude, fix.longitude)
        turned = rotation.shortest_turn(found[2], zenith_of(ground.latitude, ground.longitude))
        true = turned @ zenith_of(*np.radians([field.latitude, field.longitude]))
        axes = enu_axes(ground.latitude, ground.longitude)[:2] * np.c_[curvature_radii_m(ground.latitude)].T
        off = axes @ true
        distances2.append(off @ np.linalg.solve(ground.covariance[:2, :2], off))
        assert np.sqrt(np.trace(ground.covariance[:2, :2])) < 3 * sigma * EARTH_RADIUS_M
    assert np.mean(distances2) == pytest.approx(2.0, abs=5 * 2 / np.sqrt(draws))


@pytest.mark.parametrize("latitude", LATITUDES)
def test_a_heading_at_a_pole_claims_nothing_and_one_against_the_place_as_much_as_anywhere(latitude, rng):
    tilt_rad2 = np.eye(2) * (20 * ARCSEC) ** 2
    here, far = (
        f.solve(*f.places(STATE, rng), STATE, tilt=f.tilt(tilt_rad2))
        for f in (SkyField(latitude=latitude), SkyField(latitude=45.0))
    )
    assert np.sqrt(here.covariance[2, 2]) > np.pi

    def against_the_place(fix):
        prime, _ = curvature_radii_m(fix.latitude)
        row = np.array([-meridian_turn(fix.latitude) / prime, 0.0, 1.0])
        return np.sqrt(row @ fix.covariance @ row)

    assert against_the_place(here) < 3 * against_the_place(far)


@pytest.mark.parametrize("latitude", [47.0, -75.0])
def test_heading_and_attitude_change_with_the_place_as_a_fixed_camera_shows(latitude, rng):
    """A level that is off by a small angle is another place, from which the camera's attitude is another."""
    phi, step = np.radians(latitude), 1e-6
    axes, link = enu_axes(phi, 0.7), rotation.from_vector(rng.normal(size=3))
    level = level_rows(local_north(axes), link)
    for k in range(3):
        turn = rotation.from_vector(np.eye(3)[k] * step)
        place = local_north(turn @ axes)
        moved = axes[:2] @ zenith_of(place.latitude, place.longitude) * curvature_radii_m(phi) / step
        seen = enu_axes(place.latitude, place.longitude) @ axes.T @ link
        turned = rotation.to_small_vector(seen @ link.T) / step
        heading = rotation.half_turn(heading_of(seen) - heading_of(link)) / step
        np.testing.assert_allclose(level[:2, k], moved, rtol=1e-4, atol=30)
        np.testing.assert_allclose(level[2:, k], [heading, *turned], atol=1e-4)
