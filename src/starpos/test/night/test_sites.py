# SPDX-License-Identifier: Apache-2.0
"""A place that is far from the site of the frames' header, and the clock that would explain it."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos import rotation
from starpos.earth.orientation import ROTATION_RAD_S
from starpos.night.remarks import Near, doubts

LATITUDE = np.radians(48.0)
# site and hours: the place of a clock that is ahead by them lies as far west as the site lies east
EITHER = {(7.45, 1), (7.59, 1), (15.0, 2)}


def said_of(site_deg, place_deg):
    """What is said of a place, by longitudes of the header's site and of the place."""
    site = Near(LATITUDE, np.radians(site_deg), stated_by="the header's SITELAT", either_sign=True)
    camera, covariance = SimpleNamespace(rotation=np.eye(3)), 250.0**2 * np.eye(3)
    longitude = rotation.half_turn(np.radians(place_deg))
    fix = SimpleNamespace(
        latitude=LATITUDE, longitude=longitude, covariance=covariance, camera=camera, tilt=None
    )
    return "".join(doubts([fix], fix, None, site))


@pytest.mark.parametrize("site_deg", [7.45, 7.59, 11.58, 15.0, -105.0, -118.2])
@pytest.mark.parametrize("ahead_h", [-8, -7, 1, 2])
def test_a_clock_hours_off_is_named_on_either_side_of_greenwich(site_deg, ahead_h):
    said = said_of(site_deg, site_deg - np.degrees(ahead_h * 3600 * ROTATION_RAD_S))
    assert f"its times may be {abs(ahead_h)} h {'ahead of' if ahead_h > 0 else 'behind'} UTC" in said
    assert ("or the header counts longitudes to the west" in said) == ((site_deg, ahead_h) in EITHER)


@pytest.mark.parametrize("site_deg", [-122.8, 8.0, 100.2])
def test_a_header_that_counts_to_the_west_is_no_fault_of_the_clock(site_deg):
    assert said_of(site_deg, site_deg) == said_of(-site_deg, site_deg) == ""
    assert "check the times" in said_of(site_deg, site_deg + 3)
