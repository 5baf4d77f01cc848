# SPDX-License-Identifier: Apache-2.0
"""The residual map: arrows of the right length at the right place, and their key."""

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from starpos.calibration import residual_map
from starpos.calibration.camera import fit_camera
from starpos.calibration.residual_map import MAX_ARROWS, draw_residuals, draw_rms
from starpos_testing.skies.lenses import VACUUM, ideal, sightings


def drawn(xy, residual, width=1000, height=700):
    axes = Figure().subplots()
    draw_residuals(axes, xy, residual, width, height)
    (arrows,) = axes.collections
    (key,) = axes.artists
    return axes, arrows, key


def test_each_of_a_few_stars_has_its_arrow(rng):
    xy, residual = rng.uniform(0, 700, (50, 2)), rng.normal(0, 0.1, (50, 2))
    axes, arrows, key = drawn(xy, residual)
    np.testing.assert_array_equal(arrows.get_offsets(), xy)
    np.testing.assert_array_equal(np.stack([arrows.U, arrows.V], -1), residual)
    # The top of the frame on top.
    assert axes.get_ylim() == (699.5, -0.5)
    assert axes.get_xlim() == (-0.5, 999.5)
    assert key.label == "0.1 px"
    assert key.U == 0.1


def test_many_stars_are_the_means_of_their_cells(rng):
    n = 20 * MAX_ARROWS
    xy = rng.uniform(-0.5, [999.5, 699.5], (n, 2))
    residual = np.stack([xy[:, 0] / 1000, -xy[:, 1] / 1000], -1) + rng.normal(0, 0.01, (n, 2))
    _, arrows, _ = drawn(xy, residual)
    at = np.asarray(arrows.get_offsets())
    assert 200 < len(at) < 500
    np.testing.assert_allclose(arrows.U, at[:, 0] / 1000, atol=0.02)
    np.testing.assert_allclose(arrows.V, -at[:, 1] / 1000, atol=0.02)


@pytest.mark.parametrize(
    ("length", "label"), [(0.019, "0.01 px"), (0.02, "0.02 px"), (7.0, "5 px"), (0.0, "1 px")]
)
def test_the_key_is_a_round_number(length, label):
    _, _, key = drawn(np.array([[10.0, 10.0], [20.0, 30.0]]), np.array([[length, 0.0], [0.0, length]]))
    assert key.label == label


def test_no_star_at_all():
    drawn(np.zeros((0, 2)), np.zeros((0, 2)))


def test_rms_of_each_cell(rng):
    xy = rng.uniform(-0.5, [999.5, 699.5], (40_000, 2))
    sigma = np.where(xy[:, 0] < 500, 0.1, 0.3)
    axes = Figure().subplots()
    image = draw_rms(axes, xy, rng.normal(0, sigma[:, None], xy.shape), 1000, 700)
    values = image.get_array().reshape(9, 12)
    np.testing.assert_allclose(values[:, :6], 0.1, rtol=0.25)
    np.testing.assert_allclose(values[:, 6:], 0.3, rtol=0.25)


def test_cells_without_stars_have_no_colour(rng):
    axes = Figure().subplots()
    image = draw_rms(axes, rng.uniform(0, 80, (100, 2)), rng.normal(0, 1, (100, 2)), 1000, 700)
    assert np.isfinite(np.ma.filled(image.get_array(), np.nan)).sum() == 1


def test_a_picture_of_a_fit(tmp_path, rng):
    fit = fit_camera(sightings(ideal(11), 3, 60, rng), ideal(11), VACUUM)
    residual_map.draw(tmp_path / "map.png", fit, "a title")
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert picture.shape[1] > 2.5 * picture.shape[0]
    assert picture.std() > 10
