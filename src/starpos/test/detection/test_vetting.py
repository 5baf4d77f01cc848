# SPDX-License-Identifier: Apache-2.0
"""Evidence of pixels for stars, of compiled code, against its plain form."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from starpos.detection._vetting import compare_with_pixel, correct_sky, replace_spikes
from starpos.detection.vet import _own_light
from starpos.units import SIGMA_PER_MAD

N, SIZE = 12, 11


@pytest.fixture
def stamps(rng):
    """Signal, noise, good, full and phase (N, S, S) of noisy stars on a mosaic."""
    grid = np.arange(SIZE) - SIZE // 2
    star = np.exp(-0.2 * (grid[:, None] ** 2 + grid**2))
    signal = 400 * rng.random((N, 1, 1)) * star + rng.normal(0, 5, (N, SIZE, SIZE))
    noise = rng.uniform(4, 6, signal.shape)
    full = rng.random(signal.shape) < 0.02
    good = (rng.random(signal.shape) < 0.97) & ~full
    phase = np.zeros(signal.shape, np.uint8)
    phase[:, 1::2] += 2
    phase[:, :, 1::2] += 1
    return signal.astype(np.float32), noise.astype(np.float32), good, full, phase


@pytest.fixture
def fits(rng, stamps):
    """Residual, model and outlier (N, S, S) of a fit."""
    model = (0.9 * np.maximum(stamps[0], 0)).astype(np.float32)
    return stamps[0] - model, model, rng.random(model.shape) < 0.02


def test_the_sky_at_the_rims_is_taken_off(stamps):
    signal, noise, *_ = stamps
    signal[:4] += 9
    signal[4:6] *= 3
    # a rim that may be the star's own light
    signal[6] += 9
    signal[6, SIZE // 2, SIZE // 2] = 1e6
    rim = np.ones((SIZE, SIZE), bool)
    rim[1:-1, 1:-1] = False
    score = (signal.astype(float) / noise)[:, rim]
    sky = np.median(score, axis=1)
    spread = SIGMA_PER_MAD * np.median(np.abs(score - sky[:, None]), axis=1)
    own = 0.01 * signal.max((1, 2)) / np.median(noise[:, rim], axis=1)
    sky = np.where((sky > 0.6) & (sky > own), sky, 0)[:, None, None]
    spread = np.where((spread > 1.6) & (spread > own), spread, 1)[:, None, None]
    expected = signal - sky * noise, noise * spread
    correct_sky(signal, noise, SIGMA_PER_MAD, 0.6, 1.6, 0.01)
    assert sky[:4].all() and not sky[6] and (spread[4:6] > 1).all()
    for found, plain in zip((signal, noise), expected, strict=True):
        np.testing.assert_allclose(found, plain, rtol=1e-6, atol=1e-5)


def test_spikes_become_the_mean_of_their_neighbours(stamps, rng):
    signal, noise, good, _, phase = stamps
    places = rng.integers(0, SIZE, (2, N))
    signal[np.arange(N), places[0], places[1]] += 3000
    # two side by side
    signal[0, 5, 5:7] = 9000
    gain, sharpest = rng.uniform(0.5, 1.5, 4).astype(np.float32), rng.uniform(3, 5, N).astype(np.float32)
    grey = signal / gain[phase]
    four = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4
    around = ndimage.convolve(grey.astype(float), four[None], mode="nearest")
    expected = (grey > sharpest[:, None, None] * (around + noise)) & (signal > 6 * noise)
    healed, kept = np.where(expected, around * gain[phase], signal), good & ~expected
    found = replace_spikes(signal, noise, good, phase, gain, sharpest, 6.0)
    assert expected.sum() > 5
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(good, kept)
    np.testing.assert_allclose(signal, healed, rtol=1e-6, atol=1e-5)


def test_pixels_that_say_nothing_of_the_star_become_its_model(stamps, fits, rng):
    signal, noise, *_ = stamps
    _, model, outlier = fits
    noise[3, 4:6] *= 4
    outlier[5, :2] = True
    spike = rng.random(signal.shape) < 0.02
    speck = outlier & (outlier.sum((1, 2)) <= 3)[:, None, None]
    expected = np.where(speck | spike | (noise > 3 * noise.min((1, 2), keepdims=True)), model, signal)
    seen = SimpleNamespace(signal=signal, noise=noise, spike=spike)
    own = _own_light(seen, SimpleNamespace(model=model, outlier=outlier))
    np.testing.assert_array_equal(own, expected)


@pytest.mark.parametrize("half", [0, 3, SIZE // 2])
def test_one_pixel_is_compared_with_the_star(half, stamps, fits):
    signal, noise, good, full, _ = stamps
    residual, model, _ = fits
    c = slice(SIZE // 2 - half, SIZE // 2 + half + 1)
    s, n, g, r, m = (a[:, c, c].astype(float) for a in (signal, noise, good, residual, model))
    variance = n**2 + 0.4 * m + 0.01**2 * m**2
    score = g * (s / n) ** 2
    expected = (
        score.sum((1, 2)) - (score * (s > 0)).max((1, 2)),
        (g * (r**2 / variance + np.log(variance / n**2))).sum((1, 2)),
        g.sum((1, 2)),
        full[:, c, c].sum((1, 2)),
    )
    found = compare_with_pixel(signal, noise, good, full, residual, model, 0.4, 0.01, half)
    for one, plain in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, plain, rtol=1e-5, atol=1e-5)


def test_pixels_of_other_stamps_are_refused(stamps):
    signal, noise, good, full, phase = stamps
    with pytest.raises(ValueError, match="stamps"):
        correct_sky(signal, noise[:3].copy(), SIGMA_PER_MAD, 0.6, 1.6, 0.01)
    with pytest.raises(ValueError, match="gains"):
        replace_spikes(signal, noise, good, phase, np.ones(2, np.float32), np.ones(N, np.float32), 6.0)
    with pytest.raises(ValueError, match="middle"):
        compare_with_pixel(signal, noise, good, full, signal, signal, 0.4, 0.01, SIZE)
