# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from starpos.earth.ellipsoid import enu_axes
from starpos.earth.gravity import geodetic_place, gravity, gravity_gradient, itrs_place, zenith_at


@pytest.mark.parametrize(
    ("latitude_deg", "published"),
    # NIMA TR8350.2, table 3.4: at the equator, at the poles
    [(0, 9.7803253359), (90, 9.8321849378), (-90, 9.8321849378)],
)
def test_published_gravity(latitude_deg, published):
    place = itrs_place(np.radians(latitude_deg), 1.0, 0.0)
    assert np.linalg.norm(gravity(place)) == pytest.approx(published, abs=1e-9)


def test_it_points_down_and_falls_with_height():
    place = itrs_place(0.8, -2.0, 0.0)
    up = enu_axes(0.8, -2.0)[2]
    assert zenith_at(place) == pytest.approx(up, abs=1e-12)
    assert np.cross(gravity(place), up) == pytest.approx(np.zeros(3), abs=1e-12)
    # 0.3086 mGal a metre
    assert (
        np.linalg.norm(gravity(place)) - np.linalg.norm(gravity(place + 1000 * up))
    ) / 1000 == pytest.approx(3.085e-6, rel=2e-3)


@pytest.mark.parametrize("latitude_deg", [0, 48, 90])
def test_the_gradient_is_that_of_differences(latitude_deg):
    place = itrs_place(np.radians(latitude_deg), 2.0, 1000.0)
    steps = np.eye(3) * 1000
    differences = np.stack([(gravity(place + s) - gravity(place - s)) / 2000 for s in steps], -1)
    assert gravity_gradient(place) == pytest.approx(differences, abs=0.015 * 9.8 / 6.4e6)


def test_places_there_and_back():
    latitude, longitude, height = geodetic_place(itrs_place(-1.2, 3.0, 4321.0))
    assert (latitude, longitude, height) == pytest.approx((-1.2, 3.0, 4321.0), abs=1e-8)
