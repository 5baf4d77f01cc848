# SPDX-License-Identifier: Apache-2.0
"""The report's map of the Earth."""

import numpy as np
import pytest

from starpos.report.coast import coast_lines, draw_map

figures = pytest.importorskip("matplotlib.figure")


def points(latitude_deg, longitude_deg):
    """What globe and lens hold: graticule, coast, place, each (N, 2) in radii of the Earth."""
    figure = figures.Figure()
    draw_map(figure, *np.radians([latitude_deg, longitude_deg]))
    [globe] = figure.axes
    return [[np.array(line.get_xydata()) for line in axes.lines] for axes in (globe, *globe.child_axes)]


def test_the_coast_is_where_it_is():
    """Known capes, to the half degree that lines of 1:110m leave."""
    coast = np.concatenate(coast_lines())
    assert np.abs(coast).max(axis=0) == pytest.approx([180.0, 85.6], abs=0.1)
    for latitude, longitude in ((-34.8, 20.0), (-55.98, -67.27), (71.1, 26.0), (8.08, 77.5)):
        off = np.hypot(coast[:, 0] - longitude, coast[:, 1] - latitude)
        assert off.min() < 1.0, (latitude, longitude)


@pytest.mark.parametrize("latitude, longitude", [(36.5, 179.9), (-90.0, 0.0), (-34.8, 20.0)])
def test_the_near_half_of_the_earth_is_drawn_about_the_place(latitude, longitude):
    discs = points(latitude, longitude)
    assert len(discs) == 2
    for _, coast, place in discs:
        seen = coast[np.isfinite(coast[:, 0])]
        assert 500 < len(seen) < 0.9 * len(coast)
        assert np.hypot(*seen.T).max() <= 1 + 1e-9 and np.array_equal(place, [[0, 0]])


def test_east_is_right_and_north_is_up():
    """From Cape Agulhas: Africa's coast lies north, most of Antarctica's south; Madagascar is north-east."""
    _, coast, _ = points(-34.8, 20.0)[0]
    madagascar = np.array([np.sin(np.radians(49 - 20)) * np.cos(np.radians(-16)), 0.35])
    assert np.nanmin(np.hypot(*(coast - madagascar).T)) < 0.05
