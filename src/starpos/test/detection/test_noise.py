# SPDX-License-Identifier: Apache-2.0
"""The noise that grows with light, of compiled code, against its plain form."""

import numpy as np
import pytest

from starpos.detection._learn import light_noise, phase_fluxes

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


def test_fluxes_of_phases_are_weighted_means(rng):
    signal, noise = (
        rng.normal(50, 20, (8, 7, 7)).astype(np.float32),
        rng.uniform(2, 4, (8, 7, 7)).astype(np.float32),
    )
    value, good = rng.uniform(0, 0.1, (8, 7, 7)).astype(np.float32), rng.random((8, 7, 7)) < 0.8
    phase = rng.integers(0, 4, (8, 7, 7)).astype(np.uint8)
    light = np.maximum(signal, 0)
    weight = good / (noise**2 + 0.7 * light + (0.05 * light) ** 2)
    flux, information = phase_fluxes(signal, noise, good, phase, value, 0.7, 0.05, 4)
    for k in range(4):
        own = weight * (phase == k)
        np.testing.assert_allclose(information[:, k], (own * value**2).sum((1, 2)), rtol=1e-5)
        np.testing.assert_allclose(
            flux[:, k] * information[:, k], (own * value * signal).sum((1, 2)), rtol=1e-5
        )
