# SPDX-License-Identifier: Apache-2.0
"""The noise that grows with light, of compiled code, against its plain form."""

import numpy as np
import pytest

from starpos.detection._learn import light_noise, strangeness, typical_gains

N, SIZE = 20, 9


def plain_noise(noise2, light, square, photon, misfit2):
    """Four rounds of weighted least squares over the pixels (K,)."""
    for _ in range(4):
        variance = noise2 + photon * light + misfit2 * light**2
        keep = square < 25 * variance if photon + misfit2 > 0 else np.ones(len(square), bool)
        terms = (np.stack([light, light**2]) / variance)[:, keep]
        normal, right = terms @ terms.T, terms @ ((square - noise2) / variance)[keep]
        both = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        if both.min() < 0:
            alone = np.maximum(right / np.diag(normal), 0)
            both = np.where(np.arange(2) == np.argmax(right * alone), alone, 0)
        photon, misfit2 = both
    return photon + np.sqrt(2 / ((light / variance) ** 2).sum()), np.sqrt(misfit2)


def fits(rng, photon, misfit, most):
    """Noise, model, residual, used and leverage (N, S, S) of stars."""
    model = (most * rng.random((N, SIZE, SIZE)) ** 4 - 1).astype(np.float32)
    noise = rng.uniform(5, 9, model.shape).astype(np.float32)
    light = np.maximum(model, 0)
    sigma = np.sqrt(noise**2 + photon * light + (misfit * light) ** 2)
    residual = (sigma * rng.normal(0, 1, model.shape)).astype(np.float32)
    residual[0, 0] *= 100
    used = rng.random(model.shape) < 0.8
    return noise, model, residual, used, rng.uniform(0, 1, model.shape).astype(np.float32)


@pytest.mark.parametrize(
    ("photon", "misfit", "most"),
    [(0.4, 0.02, 3e3), (0.4, 0.0, 3e3), (0.0, 0.02, 3e3), (0.0, 0.0, 100), (0.3, 0.01, 6e4)],
)
@pytest.mark.parametrize("before", [(0.0, 0.0), (0.5, 0.01)])
def test_noise_is_that_of_least_squares(photon, misfit, most, before, rng):
    noise, model, residual, used, leverage = fits(rng, photon, misfit, most)
    expected = plain_noise(
        noise[used].astype(float) ** 2,
        np.maximum(model[used].astype(float), 0),
        residual[used].astype(float) ** 2 / np.maximum(1 - leverage[used].astype(float), 0.1),
        before[0],
        before[1] ** 2,
    )
    found = light_noise(noise, model, residual, used, leverage, *before, 5.0)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)


def test_without_light_there_is_hardly_a_photon(rng):
    noise, model, residual, used, leverage = fits(rng, 0.4, 0.0, 0.5)
    photon, misfit = light_noise(noise, model, residual, used, leverage, 0.0, 0.0, 5.0)
    assert photon == np.sqrt(2e12) and misfit == 0


def test_images_of_other_shapes_are_refused(rng):
    given = fits(rng, 0.4, 0.0, 10)
    with pytest.raises(ValueError, match="as many"):
        light_noise(given[0][1:], *given[1:], 0.0, 0.0, 5.0)
    with pytest.raises(ValueError, match="as many"):
        light_noise(*given[:4], np.zeros((N, 0, 0), np.float32), 0.0, 0.0, 5.0)


def test_strangeness_is_that_of_plain_sums(rng):
    """A star that was not fitted has none, whatever its pixels are."""
    noise, model, residual, used, leverage = fits(rng, 0.4, 0.02, 1e3)
    used[3], model[3] = False, np.nan
    noise2, light = (np.where(used, v.astype(float), 0) ** 2 for v in (noise, model))
    left = (np.where(used, residual.astype(float), 0) ** 2 - noise2 * (1 - leverage)).sum((1, 2))
    light2 = np.maximum(light.sum((1, 2)), 1e-9)
    found = strangeness(noise, model, residual, used, leverage, 1e-9)
    np.testing.assert_allclose(
        found, (left / light2, np.sqrt(2 * (noise2**2).sum((1, 2))) / light2), rtol=1e-7
    )
    with pytest.raises(ValueError, match="as many"):
        strangeness(noise[1:], model, residual, used, leverage, 1e-9)


def plain_gains(own, information):
    """Gains of phases and the scatter of single stars' gains about them, all stars at once."""
    mean = np.maximum(own.mean(1, keepdims=True), 1e-3)
    own, error2 = own / mean, 1 / np.maximum(information * mean**2, 1e-12)
    gain, spread2 = np.median(own, 0), 0.0
    for _ in range(4):
        weight = 1 / (error2 + spread2 + 1e-6)
        weight = weight * ((own - gain) ** 2 * weight < 16)
        gain = np.maximum((weight * own).sum(0) / np.maximum(weight.sum(0), 1e-12), 0.02)
        gain = gain / gain.mean()
        spread2 = max(0.0, (weight * ((own / gain - 1) ** 2 - error2)).sum() / max(weight.sum(), 1e-12))
    return gain, np.sqrt(spread2)


@pytest.mark.parametrize("n", [1, 2, 31])
def test_gains_are_those_of_plain_sums(n, rng):
    light, gain = rng.uniform(1e3, 1e5, (n, 1)), np.array([0.6, 1.1, 1.2, 1.1])
    information = 1 / (50 + light * gain)
    own = light * gain * rng.normal(1, 0.08, (n, 4)) + rng.normal(0, 1, (n, 4)) / np.sqrt(information)
    own[n // 2, 2] *= 4
    found, spread = typical_gains(own, information, 1e-3, 0.02, 4.0, 4)
    expected = plain_gains(own, information)
    np.testing.assert_allclose(found, expected[0], rtol=1e-11)
    assert spread == pytest.approx(expected[1], rel=1e-9)
    if n > 2:
        np.testing.assert_allclose(found, gain, atol=0.1)
