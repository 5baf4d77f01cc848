# SPDX-License-Identifier: Apache-2.0
"""The Sun's disc and its glow on drawn frames; lamps, clouds and walls that are neither."""

import cv2
import numpy as np
import pytest

from starpos.detection.discs import find_disc
from starpos_testing.skies.suns import disc_frame, glow_frame

SHAPE = (300, 400)


@pytest.mark.parametrize("hidden", [2.0, 0.6, 0.1])
@pytest.mark.parametrize("radius", [6.0, 20.0, 90.0])
def test_a_limb_gives_its_centre(radius: float, hidden: float) -> None:
    squares = []
    for seed in range(4):
        x, y = np.random.default_rng(seed).uniform([120, 110], [280, 190])
        found = find_disc(disc_frame(x, y, radius, SHAPE, hidden, seed))
        assert found is not None
        assert found.sharp
        assert found.radius_px == pytest.approx(radius, rel=0.05, abs=1.0)
        off = np.array([found.x - x, found.y - y])
        squares.append(off @ np.linalg.solve(found.covariance, off) / 2)
    assert np.mean(squares) < 2.5


def test_a_disc_over_the_edge_of_the_frame_is_not_pulled_inwards() -> None:
    found = find_disc(disc_frame(12.0, 150.0, 30.0, SHAPE))
    assert found is not None
    assert abs(found.x - 12.0) < 0.5


def test_a_glow_gives_its_middle_with_a_larger_error() -> None:
    off = []
    for seed in range(10):
        x, y = np.random.default_rng(seed).uniform([120, 110], [280, 190])
        found = find_disc(glow_frame(x, y, 6.0, SHAPE, seed))
        assert found is not None
        assert not found.sharp
        sigma = np.sqrt(found.covariance[0, 0])
        assert 0.2 < sigma < 1.0
        off.append(np.array([found.x - x, found.y - y]) / sigma)
    assert np.mean(np.square(off)) < 2.0


def test_clouds_walls_and_edges_are_no_discs() -> None:
    rng = np.random.default_rng(1)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for k in range(12):
        noise = cv2.GaussianBlur(rng.standard_normal(SHAPE), (0, 0), rng.uniform(8, 40))
        cloud = 120 + 90 * noise / noise.std()
        wall = np.where(columns * np.cos(k) + rows * np.sin(k) > rng.uniform(50, 200), 200.0, 40.0)
        window = np.where((abs(columns - 200) < 40) & (abs(rows - 150) < 60), 255.0, 30.0)
        for light in (cloud, wall, window):
            frame = (light + rng.standard_normal(SHAPE)).clip(0, 255).astype(np.uint8)
            assert find_disc(frame) is None


def test_stars_are_no_discs() -> None:
    rng = np.random.default_rng(2)
    frame = np.zeros(SHAPE)
    frame[rng.integers(5, 295, 40), rng.integers(5, 395, 40)] = rng.exponential(3e5, 40)
    frame = cv2.GaussianBlur(frame, (0, 0), 1.2) + rng.poisson(100, SHAPE)
    assert find_disc(frame.clip(0, 65535).astype(np.uint16)) is None


@pytest.mark.parametrize("lit_deg", [0.0, 130.0, None], ids=["half lit", "half lit", "full"])
def test_by_day_the_moon_is_a_second_disc_by_its_lit_limb(lit_deg) -> None:
    """The Sun's glow is far off; alone it has no second disc."""
    rows, columns = np.mgrid[:600, :800]
    sun = glow_frame(200.0, 180.0, 6.0, (600, 800)).astype(float)
    off_x, off_y = columns - 600.3, rows - 400.6
    moon = 60 / (1 + np.exp(np.clip((np.hypot(off_x, off_y) - 12.0) / 0.6, -50, 50)))
    if lit_deg is not None:
        along = off_x * np.cos(np.radians(lit_deg)) + off_y * np.sin(np.radians(lit_deg))
        moon /= 1 + np.exp(np.clip(-along / 0.6, -50, 50))
    quiet = cv2.GaussianBlur(sun, (0, 0), 1.5)
    found = find_disc((quiet + moon).clip(0, 255).astype(np.uint8))
    assert found is not None and not found.sharp and found.other is not None
    other = found.other
    assert other.sharp and other.radius_px == pytest.approx(12.0, rel=0.05)
    assert np.hypot(other.x - 600.3, other.y - 400.6) < 4 * np.sqrt(other.covariance[0, 0])
    assert find_disc(quiet.astype(np.uint8)).other is None
