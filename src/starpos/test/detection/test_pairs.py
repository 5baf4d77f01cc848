# SPDX-License-Identifier: Apache-2.0
"""The fit of two stars at once of compiled code against its plain form."""

import numpy as np
import pytest
from test_fit import DN_PER_PHOTON, MISFIT, SIZE, SPREAD, plain_psf, psfs, rules, scaled

from starpos.detection._fit import fit_stamps
from starpos.detection.fit import FIT_WIDTHS, SETTLED

LEAST = 0.05


def inverses(normal):
    """Inverses of (N, K, K), whose fluxes are a million times larger than pixels."""
    scale = np.sqrt(np.einsum("nii->ni", normal))
    scale = scale[:, :, None] * scale[:, None, :]
    return np.linalg.inv(normal / scale) / scale


def plain_pairs(signal, noise, good, phase, column, row, first, least_flux, axes, series, gain, rounds):
    """The fit of all pairs at once: what `fit_stamps` does with one after the other."""
    n, own = len(signal), len(gain) if len(gain) > 1 else 0
    x, y, colour = first[..., 0].copy(), first[..., 1].copy(), np.zeros((2, n, len(gain)))
    each, noise2 = [slice(k * (3 + own), (k + 1) * (3 + own)) for k in (0, 1)], noise.astype(float) ** 2
    for round_ in range(rounds + 1):
        gains, images, inside = gain * (1 + colour), [], np.zeros(signal.shape, bool)
        for k in (0, 1):
            offset = column - SIZE // 2 - x[k], row - SIZE // 2 - y[k]
            at = gains[k][np.arange(n)[:, None, None], phase]
            images.append([image * at for image in plain_psf(axes, series, *offset, SIZE)])
            u, v = scaled(axes, *offset, SIZE)
            inside |= u * u + v * v < FIT_WIDTHS**2
        used = good & inside
        a, b = images[0][0], images[1][0]
        if round_ == 0:
            weight = used / noise2
            aa, ab, bb, sa, sb = (
                (weight * p).sum((1, 2)) for p in (a * a, a * b, b * b, a * signal, b * signal)
            )
            flux = np.stack([bb * sa - ab * sb, aa * sb - ab * sa]) / (aa * bb - ab * ab)
            flux = np.maximum(flux, least_flux)
        models = flux[:, :, None, None] * np.stack([a, b])
        light = np.maximum(models.sum(0), 0)
        weight = used / (noise2 + DN_PER_PHOTON * light + MISFIT**2 * light**2)
        columns = []
        for k in (0, 1):
            value, by_x, by_y = images[k]
            amount = flux[k][:, None, None]
            columns += [amount * by_x, amount * by_y, value]
            for p in range(own):
                columns.append(amount * value * gain[p] / gains[k][:, p, None, None] * (phase == p))
        design = np.stack([c.reshape(n, -1) for c in columns], 2)
        residual, weighted = (signal - models.sum(0)).reshape(n, -1, 1), weight.reshape(n, -1, 1)
        normal = np.swapaxes(design, 1, 2) @ (design * weighted)
        right = (np.swapaxes(design, 1, 2) @ (weighted * residual))[..., 0]
        for k in (0, 1):
            for p in range(own):
                at = each[k].start + 3 + p
                normal[:, at, at] += SPREAD**-2
                right[:, at] -= colour[k][:, p] * SPREAD**-2
        covariance = inverses(normal)
        if round_ == rounds:
            break
        step = (covariance @ right[..., None])[..., 0]
        for k in (0, 1):
            x[k] += np.clip(step[:, each[k]][:, 0], -0.5, 0.5)
            y[k] += np.clip(step[:, each[k]][:, 1], -0.5, 0.5)
            flux[k] = np.maximum(flux[k] + step[:, each[k]][:, 2], LEAST * flux[k])
            if own:
                colour[k] = np.clip(colour[k] + step[:, each[k]][:, 3:], -0.9, 3.0)
    grey = np.concatenate([np.arange(s.start, s.start + 3) for s in each])
    known = inverses(normal[:, grey[:, None], grey])
    sigma = np.sqrt(np.stack([known[:, 2, 2], known[:, 5, 5]]))
    covariances = np.stack([covariance[:, s, s][:, :2, :2] for s in each])
    chi2 = (weighted * residual**2).sum((1, 2)) / np.maximum(used.sum((1, 2)) - 6, 1)
    return x, y, flux, sigma, covariances, gains, chi2, used.sum((1, 2)), signal - models.sum(0), models, used


def pairs_of_stars(rng, n, gain):
    """Noisy stamps of n pairs, their first places, and least fluxes; a pixel of the second is bad."""
    axes, series = psfs(rng, n)
    corner = 2 * rng.integers(0, 50, (n, 2))
    place = corner + SIZE // 2 + np.array([[[-2.0, -1.0]], [[2.5, 1.0]]]) + rng.uniform(-1, 1, (2, n, 2))
    phase = np.zeros((n, SIZE, SIZE), np.uint8)
    if len(gain) > 1:
        phase[:, 1::2] += 2
        phase[:, :, 1::2] += 1
    light = sum(
        plain_psf(axes, series, *(corner - star).T, SIZE)[0] * rng.uniform(3e3, 3e4, (n, 1, 1))
        for star in place
    )
    light *= gain[phase]
    noise = np.full(light.shape, 7, np.float32)
    signal = (light + rng.normal(0, 1, light.shape) * np.sqrt(49 + DN_PER_PHOTON * light)).astype(np.float32)
    good = np.ones(light.shape, bool)
    good[1, 4, 5] = False
    first = place + rng.uniform(-0.3, 0.3, place.shape)
    column, row = np.ascontiguousarray(corner.T) + SIZE // 2
    return signal, noise, good, phase, column, row, first, np.full(n, 100.0), axes, series


def fit_pairs(signal, noise, good, phase, column, row, first, least_flux, axes, series, rules, rounds):
    """The columns of pairs, whose last round moves nothing."""
    x, y = np.ascontiguousarray(np.moveaxis(first, -1, 0))
    return fit_stamps(
        signal, noise, good, phase, column, row, x, y, axes, series, rules, rounds + 1, False, True, least_flux, LEAST
    )  # fmt: skip


@pytest.mark.parametrize("gain", [np.ones(1), np.array([0.7, 1.1, 1.2, 1.0])], ids=["grey", "mosaic"])
@pytest.mark.parametrize("rounds", [1, 3, 12])
def test_pairs_are_those_of_plain_sums(gain, rounds, rng):
    given = pairs_of_stars(rng, 12, gain)
    found = fit_pairs(*given, rules(gain), rounds)
    expected = plain_pairs(*given, gain, rounds)
    for k in range(8):
        np.testing.assert_allclose(found[k], expected[k], rtol=1e-7, atol=1e-8)
    for k in (8, 9):
        np.testing.assert_allclose(found[k], expected[k], rtol=1e-5, atol=3e-3)
    np.testing.assert_array_equal(found[10], expected[10])
    assert not found[11].any() and not found[12].size


@pytest.mark.parametrize("gain", [np.ones(1), np.array([0.7, 1.1, 1.2, 1.0])], ids=["grey", "mosaic"])
def test_settled_pairs_are_those_of_many_rounds(gain, rng):
    """To a hundredth of a sigma; and they are not made in all rounds."""
    given = pairs_of_stars(rng, 40, gain)
    found = fit_pairs(*given, rules(gain, SETTLED), 20)
    many = fit_pairs(*given, rules(gain), 20)
    sigma = np.sqrt(np.einsum("knii->kni", many[4]))
    off = np.abs(np.stack(found[:2], -1) - np.stack(many[:2], -1)) / sigma
    assert 1e-9 < off.max() < 0.01
    np.testing.assert_allclose(found[2], many[2], rtol=1e-4)
    np.testing.assert_allclose(found[6], many[6], rtol=0.01)


def test_two_stars_at_one_place_have_no_errors(rng):
    given = list(pairs_of_stars(rng, 3, np.ones(1)))
    given[6] = given[6].copy()
    given[6][1, 0] = given[6][0, 0]
    x, _, _, sigma, covariance, _, chi2, _, _, models, *_ = fit_pairs(*given, rules(np.ones(1)), 10)
    for column in (x, sigma, covariance, models, chi2[None]):
        assert np.isnan(column[:, 0]).all() and np.isfinite(column[:, 1:]).all()


def test_places_of_as_many_pairs_are_needed(rng):
    given = list(pairs_of_stars(rng, 3, np.ones(1)))
    given[6] = given[6][:, :2].copy()
    with pytest.raises(ValueError, match="of each"):
        fit_pairs(*given, rules(np.ones(1)), 10)
