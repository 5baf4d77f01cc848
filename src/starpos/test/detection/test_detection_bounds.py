# SPDX-License-Identifier: Apache-2.0
"""A frame with any number of blobs is measured in bounded work; what is left out is counted."""

import numpy as np
import pytest
from scipy import ndimage, spatial

from starpos.detection import DetectionSettings, detect, pipeline
from starpos.frames.frame import Frame


def blobs(number, sigma_px, size=(600, 900), seed=1):
    """A frame of a number of Gaussian blobs at random places."""
    rng = np.random.default_rng(seed)
    light = np.zeros(size)
    light[rng.integers(0, size[0], number), rng.integers(0, size[1], number)] += rng.uniform(1e4, 2e5, number)
    light = ndimage.gaussian_filter(light, sigma_px) + rng.normal(1000, 10, size)
    return Frame(np.clip(light, 0, 65535).astype(np.uint16))


@pytest.fixture
def measured(monkeypatch):
    """Pixels that each call of `measure` fits; at most 1000 peaks are looked at."""
    monkeypatch.setattr(pipeline, "PEAKS", 1000)
    pixels, measure = [], pipeline.measure

    def counted(sky, x, y, lesson, *more):
        pixels.append(len(x) * (2 * lesson.reach + 1) ** 2)
        return measure(sky, x, y, lesson, *more)

    monkeypatch.setattr(pipeline, "measure", counted)
    return pixels


@pytest.mark.parametrize(("number", "sigma_px"), [(8000, 1.0), (4000, 2.0), (1000, 4.0)])
def test_the_work_is_bounded_however_many_and_wide_the_blobs_are(number, sigma_px, measured):
    found = detect(blobs(number, sigma_px), DetectionSettings(max_stars=500))
    assert 0 < sum(measured) <= 2 * 1000 * pipeline.PIXELS_PER_PEAK
    assert found.left_out > 0 and len(found.stars) > 20


def test_the_faintest_are_left_out(measured):
    frame = blobs(1500, 1.0)
    whole = detect(frame, DetectionSettings(max_stars=5000))
    some = detect(frame, DetectionSettings(max_stars=500))
    assert whole.left_out == 0 < some.left_out
    tree = spatial.cKDTree(np.stack([some.stars.x, some.stars.y], 1))
    apart, _ = tree.query(np.stack([whole.stars.x, whole.stars.y], 1)[:300])
    assert np.mean(apart < 0.5) > 0.95


def test_of_an_ordinary_frame_nothing_is_left_out(measured):
    assert detect(blobs(300, 1.5), DetectionSettings(max_stars=500)).left_out == 0
