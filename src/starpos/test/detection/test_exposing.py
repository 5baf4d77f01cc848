# SPDX-License-Identifier: Apache-2.0
"""The exposure that day and night ask for: an eighth where a frame is overexposed, longer again where it is dark."""

import numpy as np
import pytest

from starpos.detection.discs import find_disc
from starpos.detection.exposing import SHORTEST_S, next_exposure_s
from starpos.frames.frame import Frame
from starpos_testing.skies.suns import disc_frame, glow_frame

SHAPE = (300, 400)


def wanted(pixels: np.ndarray, exposure_s: float | None, longest_s: float = 1.0) -> float | None:
    return next_exposure_s(Frame(pixels, exposure_s=exposure_s), find_disc(pixels), longest_s)


def night(level: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    frame = rng.poisson(level, SHAPE).astype(np.uint16)
    frame[rng.integers(0, 300, 20), rng.integers(0, 400, 20)] = 65535
    return frame


def test_a_white_frame_asks_for_less_and_no_less_than_the_shortest() -> None:
    white = np.full(SHAPE, 255, np.uint8)
    assert wanted(white, 0.8) == pytest.approx(0.1)
    assert wanted(white, 2 * SHORTEST_S) == SHORTEST_S
    assert wanted(white, SHORTEST_S) is None


def test_stars_keep_their_exposure_and_a_dark_frame_goes_back_to_it() -> None:
    assert wanted(night(300), 1.0) is None
    assert wanted(night(300), 1 / 64) == pytest.approx(1 / 8)
    assert wanted(night(300), 0.5) == 1.0
    # twilight
    assert wanted(night(9000), 1 / 64) is None


def test_the_sun_behind_a_filter_keeps_its_exposure_unless_it_is_saturated() -> None:
    sun = disc_frame(200, 150, 30, SHAPE)
    assert wanted(sun, 1e-3) is None
    full = np.minimum(sun.astype(int) * 4, 65535).astype(np.uint16)
    assert wanted(full, 1e-3) == pytest.approx(1e-3 / 8)


def test_a_small_glow_in_a_blue_sky_keeps_its_exposure() -> None:
    assert wanted(glow_frame(200, 150, 5.0, SHAPE), 1e-3) is None


def test_without_a_known_exposure_nothing_is_asked_for() -> None:
    assert wanted(np.full(SHAPE, 255, np.uint8), None) is None
