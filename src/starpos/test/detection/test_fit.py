# SPDX-License-Identifier: Apache-2.0
"""PSF and fit of compiled code against their plain forms."""

import numpy as np
import pytest
from numpy.polynomial import hermite_e

from starpos.detection._fit import Rules, fit_stamps
from starpos.detection._psf import evaluated
from starpos.detection.fit import FAINT, FIT_WIDTHS, OUTLIER, SETTLED

SIZE = 15
MISFIT, DN_PER_PHOTON, SPREAD = 0.01, 0.4, 0.3


def hermite(n, u):
    """Hermite polynomial of order n over sqrt(n!)."""
    return hermite_e.hermeval(u, np.eye(n + 1)[n]) / np.sqrt(np.prod(np.arange(1.0, n + 1)))


def scaled(axes, left, top, size):
    """Offsets u, v (N, size, size) of a stamp's pixels in widths of the PSF."""
    grid = np.arange(size)
    d = np.stack(
        np.broadcast_arrays((left[:, None] + grid)[:, None, :], (top[:, None] + grid)[:, :, None]), -1
    )
    return np.moveaxis(d @ np.swapaxes(axes, 1, 2)[:, None], -1, 0)


def plain_psf(axes, series, left, top, size):
    """The PSF and its derivatives by the star's x and y, term by term."""
    u, v = scaled(axes, left, top, size)
    gauss = np.exp(-0.5 * (u * u + v * v)) * np.abs(np.linalg.det(axes))[:, None, None] / (2 * np.pi)
    value, by_u, by_v = np.zeros((3, *u.shape))
    for i, j in np.ndindex(series.shape[1:]):
        c = series[:, i, j, None, None] * gauss
        value += c * hermite(i, u) * hermite(j, v)
        by_u += c * np.sqrt(i + 1) * hermite(i + 1, u) * hermite(j, v)
        by_v += c * np.sqrt(j + 1) * hermite(i, u) * hermite(j + 1, v)
    a = axes[:, :, :, None, None]
    return value, a[:, 0, 0] * by_u + a[:, 1, 0] * by_v, a[:, 0, 1] * by_u + a[:, 1, 1] * by_v


def plain_fit(signal, noise, good, phase, column, row, x, y, axes, series, gain, rounds):
    """The fit of all stars at once: what `fitted` does with one after the other."""
    n, own_gains = len(x), len(gain) if len(gain) > 1 else 0
    colour, outlier = np.zeros((n, len(gain))), np.zeros(signal.shape, bool)
    for round_ in range(rounds):
        gains = gain * (1 + colour)
        own = gains[np.arange(n)[:, None, None], phase]
        left, top = column - SIZE // 2 - x, row - SIZE // 2 - y
        value, by_x, by_y = plain_psf(axes, series, left, top, SIZE)
        u, v = scaled(axes, left, top, SIZE)
        inside, unit = u * u + v * v < FIT_WIDTHS**2, value * own
        if round_ == 0:
            weight = good * inside / noise.astype(float) ** 2
            flux = (weight * unit * signal).sum((1, 2)) / (weight * unit * unit).sum((1, 2))
        amount = flux[:, None, None]
        light = np.maximum(amount * unit, 0)
        variance = noise.astype(float) ** 2 + DN_PER_PHOTON * light + MISFIT**2 * light**2
        used = good & inside & ~outlier
        columns = [amount * by_x * own, amount * by_y * own, unit]
        columns += [amount * value * np.where(phase == p, gain[p], 0) for p in range(own_gains)]
        design = np.stack([c.reshape(n, -1) for c in columns], 2)
        weight, residual = (used / variance).reshape(n, -1, 1), signal - amount * unit
        normal = np.swapaxes(design, 1, 2) @ (design * weight)
        right = (np.swapaxes(design, 1, 2) @ (weight * residual.reshape(n, -1, 1)))[..., 0]
        for p in range(own_gains):
            normal[:, 3 + p, 3 + p] += SPREAD**-2
            right[:, 3 + p] -= colour[:, p] * SPREAD**-2
        covariance = np.linalg.inv(normal)
        if round_ == rounds - 1:
            break
        if round_ > 0:
            most = (unit * inside).max((1, 2), keepdims=True)
            outlier = (residual > OUTLIER * np.sqrt(variance)) & (residual > FAINT * amount * most) & inside
        step = (covariance @ right[..., None])[..., 0]
        x, y, flux = x + np.clip(step[:, 0], -1, 1), y + np.clip(step[:, 1], -1, 1), flux + step[:, 2]
        if own_gains:
            colour = np.clip(colour + step[:, 3:], -0.9, 3.0)
    chi2 = (used * residual**2 / variance).sum((1, 2)) / np.maximum(used.sum((1, 2)) - 3, 1)
    leverage = (((design @ covariance) * design).sum(2) * weight[..., 0]).reshape(signal.shape)
    return (
        x, y, flux, normal[:, 2, 2] ** -0.5, covariance[:, :2, :2], gains, chi2, residual, amount * unit, used,
        outlier & good & inside, leverage,
    )  # fmt: skip


def psfs(rng, n):
    """Axes and series of n stars: trailed, with terms of many orders."""
    axes = np.array([[0.45, 0.1], [-0.15, 0.7]]) + rng.normal(0, 0.02, (n, 2, 2))
    series = rng.normal(0, 0.01, (n, 5, 3))
    series[:, 0, 1] = series[:, 1, 0] = series[:, 3, 2] = 0
    series[:, 0, 0] = 1
    return axes, series


def stamps(rng, n, gain):
    """Noisy stamps of n stars with a hot pixel next to the second and a bad one on the third."""
    axes, series = psfs(rng, n)
    column, row = rng.integers(SIZE, 100, (2, n))
    x, y = np.stack([column, row]) + rng.uniform(-1, 1, (2, n))
    phase = np.zeros((n, SIZE, SIZE), np.uint8)
    if len(gain) > 1:
        grid = np.arange(SIZE) - SIZE // 2
        down, across = (row[:, None] + grid)[:, :, None], (column[:, None] + grid)[:, None]
        phase = (2 * (down % 2) + across % 2).astype(np.uint8)
    light = plain_psf(axes, series, column - SIZE // 2 - x, row - SIZE // 2 - y, SIZE)[0] * gain[phase]
    light *= rng.uniform(3e3, 3e4, (n, 1, 1))
    noise = np.full(light.shape, 7, np.float32)
    signal = (light + rng.normal(0, 1, light.shape) * np.sqrt(49 + DN_PER_PHOTON * light)).astype(np.float32)
    signal[1, 4, 9] += 5000
    good = np.ones(light.shape, bool)
    good[2, SIZE // 2, SIZE // 2] = False
    x, y = x + rng.uniform(-0.3, 0.3, n), y + rng.uniform(-0.3, 0.3, n)
    return signal, noise, good, phase, column, row, x, y, axes, series


def rules(gain, settled=0.0):
    """Rules by which all rounds are made, unless a star may be off by a number of sigmas."""
    return Rules(gain, SPREAD, DN_PER_PHOTON, MISFIT, FIT_WIDTHS, OUTLIER, FAINT, settled)


def fit_singles(signal, noise, good, phase, column, row, x, y, *given):
    """The columns of single stars."""
    columns = fit_stamps(signal, noise, good, phase, column, row, x[None], y[None], *given)
    return tuple(c[0] if k in (*range(6), 9, 13) else c for k, c in enumerate(columns))


@pytest.mark.parametrize("gain", [np.ones(1), np.array([0.7, 1.1, 1.2, 1.0])], ids=["grey", "mosaic"])
@pytest.mark.parametrize("rounds", [1, 3, 5])
def test_fit_is_that_of_plain_sums(gain, rounds, rng):
    """Places agree to 1e-9 px, all else to what single precision keeps of images."""
    given = stamps(rng, 12, gain)
    found, expected = fit_singles(*given, rules(gain), rounds, True, True), plain_fit(*given, gain, rounds)
    for column, plain in zip(found[:7], expected[:7], strict=True):
        np.testing.assert_allclose(column, plain, rtol=1e-9, atol=1e-9)
    for image, plain in zip(found[8:13], expected[7:], strict=True):
        np.testing.assert_allclose(image, plain, rtol=1e-5, atol=1e-3)
    residual, model, used, outlier, _, snr, foreign = found[8:]
    np.testing.assert_allclose(snr, np.sqrt((used * (model / given[1]) ** 2).sum((1, 2))), rtol=1e-5)
    np.testing.assert_allclose(foreign, (outlier * np.maximum(residual, 0)).sum((1, 2)), rtol=1e-5)
    assert expected[10][1].any() == (rounds > 2)
    assert not fit_singles(*given, rules(gain), rounds, False, True)[12].size


@pytest.mark.parametrize("gain", [np.ones(1), np.array([0.7, 1.1, 1.2, 1.0])], ids=["grey", "mosaic"])
def test_a_settled_fit_is_that_of_many_rounds(gain, rng):
    """To a hundredth of a sigma, with the same outliers; and it is not made in all rounds."""
    given = stamps(rng, 40, gain)
    found, many = (
        fit_singles(*given, rules(gain, SETTLED), 20, True, True),
        fit_singles(*given, rules(gain), 20, True, True),
    )
    sigma = np.sqrt(np.einsum("nii->ni", many[4]))
    off = np.abs(np.stack(found[:2], 1) - np.stack(many[:2], 1)) / sigma
    assert 1e-9 < off.max() < 0.01
    np.testing.assert_allclose(found[2], many[2], rtol=1e-4)
    np.testing.assert_allclose(found[6], many[6], rtol=0.01)
    np.testing.assert_array_equal(found[11], many[11])


def test_a_model_ends_where_the_fit_does_unless_the_whole_is_wanted(rng):
    given = stamps(rng, 12, np.ones(1))
    whole, found = (fit_singles(*given, rules(np.ones(1)), 5, False, w) for w in (True, False))
    reach = whole[10] | whole[11] | ~given[2]
    np.testing.assert_array_equal(found[9], np.where(reach, whole[9], 0))
    np.testing.assert_array_equal(found[8], np.where(reach, whole[8], given[0]))
    assert np.abs(whole[9][~reach]).max() > 0
    for column in (0, 1, 2, 3, 4, 6, 7, 10, 11):
        np.testing.assert_array_equal(found[column], whole[column])


def test_phases_that_do_not_alternate_are_refused(rng):
    gain = np.array([0.7, 1.1, 1.2, 1.0])
    given = list(stamps(rng, 3, gain))
    given[3][1, 4, 7] ^= 1
    with pytest.raises(ValueError, match="alternate"):
        fit_singles(*given, rules(gain), 5, False, False)


def test_psf_is_the_sum_of_its_terms(rng):
    axes, series = psfs(rng, 6)
    left, top = -7 + rng.uniform(-1, 1, (2, 6))
    plain = plain_psf(axes, series, left, top, SIZE)[0]
    np.testing.assert_allclose(evaluated(axes, series, left, top, SIZE), plain, rtol=1e-5, atol=1e-7)


def test_a_star_without_light_has_no_place(rng):
    given = list(stamps(rng, 3, np.ones(1)))
    given[0] = given[0].copy()
    given[0][0] = 0
    x, _, flux, _, covariance, _, chi2, *_ = fit_singles(*given, rules(np.ones(1)), 5, True, True)
    for column in (x, flux, covariance, chi2):
        assert np.isnan(column[0]).all() and np.isfinite(column[1:]).all()


@pytest.mark.parametrize(
    ("which", "change"),
    [(1, lambda a: a[:2]), (2, lambda a: a[:, :-1].copy()), (3, lambda a: a + 1), (4, lambda a: a[:2]),
     (7, lambda a: a[:2]), (8, lambda a: a[:2].copy()), (9, lambda a: np.ones((3, 33, 1)))],
    ids=["noise", "good", "phase", "column", "y", "axes", "series"],
)  # fmt: skip
def test_what_does_not_fit_together_is_refused(which, change, rng):
    given = list(stamps(rng, 3, np.ones(1)))
    given[which] = change(given[which])
    with pytest.raises(ValueError, match=r"px|shape|needed|phase|of each|terms|axes"):
        fit_singles(*given, rules(np.ones(1)), 5, True, True)
