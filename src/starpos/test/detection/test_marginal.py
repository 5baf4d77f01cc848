# SPDX-License-Identifier: Apache-2.0
"""Normal equations of a PSF's terms, of compiled code, against their plain form."""

import numpy as np
import pytest
from test_fit import SIZE, hermite, plain_psf, psfs, scaled

from starpos.detection._learn import marginal_equations

ORDERS = np.array([(2, 0), (1, 1), (0, 2), (3, 0), (4, 2)], np.int32)


def plain_marginal(axes, series, left, top, brightness, weight, phase, phases, orders):
    """The equations of all stars at once, with places and gains eliminated by a Schur complement."""
    n, count = len(left), len(orders)
    value, by_x, by_y = plain_psf(axes, series, left, top, SIZE)
    u, v = scaled(axes, left, top, SIZE)
    gauss = np.exp(-0.5 * (u * u + v * v)) * np.abs(np.linalg.det(axes))[:, None, None] / (2 * np.pi)
    columns = [gauss * hermite(i, u) * hermite(j, v) for i, j in orders]
    columns += [value * (phase == p) for p in range(phases)] + [by_x, by_y]
    design = np.stack([c.reshape(n, -1) for c in columns], 1)
    weighted = design * weight.reshape(n, 1, -1)
    normal = weighted @ design.transpose(0, 2, 1)
    right = (weighted @ (brightness - gauss).reshape(n, -1, 1))[..., 0]
    share = normal[:, :count, count:] @ np.linalg.inv(normal[:, count:, count:])
    return (
        normal[:, :count, :count] - share @ normal[:, count:, :count],
        right[:, :count] - np.einsum("ntk,nk->nt", share, right[:, count:]),
    )


def given(rng, n, phases):
    """Stars of unit flux with a little noise, of which some pixels are not used."""
    axes, series = psfs(rng, n)
    left, top = -(SIZE // 2) + rng.uniform(-0.5, 0.5, (2, n))
    phase = np.zeros((n, SIZE, SIZE), np.uint8)
    if phases > 1:
        phase[:, 1::2] += 2
        phase[:, :, 1::2] += 1
    light = plain_psf(axes, series, left, top, SIZE)[0] + rng.normal(0, 1e-3, (n, SIZE, SIZE))
    weight = rng.uniform(1, 2, light.shape) * (rng.random(light.shape) < 0.8)
    return axes, series, left, top, light.astype(np.float32), weight.astype(np.float32), phase, phases


@pytest.mark.parametrize("phases", [1, 4])
@pytest.mark.parametrize("count", [1, 5])
def test_equations_are_those_of_plain_sums(phases, count, rng):
    """To what single precision keeps of the pixels."""
    stars = given(rng, 8, phases)
    expected = plain_marginal(*stars, ORDERS[:count])
    for found, plain in zip(marginal_equations(*stars, ORDERS[:count]), expected, strict=True):
        np.testing.assert_allclose(found, plain, rtol=0, atol=3e-6 * np.abs(plain).max())


def test_a_star_without_pixels_says_nothing(rng):
    stars = list(given(rng, 3, 1))
    stars[5][1] = 0
    normal, right = marginal_equations(*stars, ORDERS)
    assert not normal[1].any() and not right[1].any()
    assert normal[0].any() and right[2].any()


@pytest.mark.parametrize(
    ("which", "value", "message"),
    [(5, np.ones((2, SIZE, SIZE), np.float32), "pixels"), (7, 3, "phases")],
    ids=["weight", "phases"],
)
def test_what_does_not_fit_together_is_refused(which, value, message, rng):
    stars = list(given(rng, 3, 1))
    stars[which] = value
    with pytest.raises(ValueError, match=message):
        marginal_equations(*stars, ORDERS)
    with pytest.raises(ValueError, match="orders"):
        marginal_equations(*given(rng, 3, 1), np.full((1, 2), 33, np.int32))
