# SPDX-License-Identifier: Apache-2.0
"""Small star fields for the tests of detection, and the Cramer-Rao bound of their stars.

A star is a Gaussian drawn along a straight trail and integrated over each pixel; 1 DN is one electron.
"""

import numpy as np
from scipy.special import erf

SKY, READ_NOISE, BIAS = 20.0, 5.0, 300.0


def star(size, x, y, fwhm, trail=(0.0, 0.0)):
    """A star of unit flux at (x, y) on size (height, width) px, float64."""
    scale = fwhm / 2.3548 * np.sqrt(2)
    steps = int(np.ceil(6 * np.hypot(*trail))) + 1
    t = ((np.arange(steps) + 0.5) / steps - 0.5)[:, None]
    # the edges of columns and rows, from the star at each step
    u = np.arange(size[1] + 1) - 0.5 - x - t * trail[0]
    v = np.arange(size[0] + 1) - 0.5 - y - t * trail[1]
    across, down = (0.5 * np.diff(erf(edges / scale)) for edges in (u, v))
    return down.T @ across / steps


def field(size, stars, fwhm=2.4, trail=(0.0, 0.0), sky=SKY, gains=None):
    """Draw the noiseless electrons (float64) of stars (N, 3): x, y, electrons.

    fwhm (N,) and trail (N, 2): of each, or of all; gains (N + 1, 2, 2): each star's mosaic and last the sky's.
    """
    image = np.zeros(size)
    fwhm, trail = np.broadcast_to(fwhm, len(stars)), np.broadcast_to(trail, (len(stars), 2))
    reach = int(np.max(4 * fwhm + np.hypot(*trail.T), initial=0)) + 3

    def through(gain, light, row=0, column=0):
        if gains is None:
            return light
        rows, columns = np.indices(light.shape)
        return light * gain[(rows + row) % 2, (columns + column) % 2]

    for i, (x, y, electrons) in enumerate(stars):
        r0, c0 = max(0, int(y) - reach), max(0, int(x) - reach)
        r1, c1 = min(size[0], int(y) + reach + 1), min(size[1], int(x) + reach + 1)
        if r1 > r0 and c1 > c0:
            light = electrons * star((r1 - r0, c1 - c0), x - c0, y - r0, fwhm[i], trail[i])
            image[r0:r1, c0:c1] += through(None if gains is None else gains[i], light, r0, c0)
    return image + through(None if gains is None else gains[-1], np.full(size, float(sky)))


def coloured(count, rng):
    """Gains (count + 1, 2, 2) of an RGGB mosaic for stars of any colour, and for the sky."""
    red, blue = rng.uniform(0.3, 1.0, (2, count))
    own = np.stack([np.stack([red, np.ones(count)], 1), np.stack([np.ones(count), blue], 1)], 1)
    return np.concatenate([own, [[[0.5, 1.0], [1.0, 0.6]]]])


def noisy(image, rng, top=65535, dtype=np.uint16):
    """The pixels that a camera writes for these electrons."""
    counts = rng.poisson(image) + rng.normal(0, READ_NOISE, image.shape) + BIAS
    return np.clip(np.rint(counts), 0, top).astype(dtype)


def bound(electrons, fwhm=2.4, trail=(0.0, 0.0), sky=SKY, gain=None):
    """Sigmas in x and y, px, of one star at the limit of Cramer and Rao.

    gain (2, 2): behind a mosaic of known colours.
    """
    size, x, y, h = (41, 41), 20.2, 19.9, 1e-3
    mosaic = np.ones(size) if gain is None else np.tile(gain, (21, 21))[:41, :41]
    value = star(size, x, y, fwhm, trail)
    by_x = (star(size, x + h, y, fwhm, trail) - star(size, x - h, y, fwhm, trail)) / (2 * h)
    by_y = (star(size, x, y + h, fwhm, trail) - star(size, x, y - h, fwhm, trail)) / (2 * h)
    design = np.stack([electrons * by_x, electrons * by_y, value], -1).reshape(-1, 3) * mosaic.reshape(-1, 1)
    variance = (mosaic * (electrons * value + sky)).ravel() + READ_NOISE**2 + 1 / 12
    return np.sqrt(np.diag(np.linalg.inv((design / variance[:, None]).T @ design)))[:2]


def grid(size, spacing, electrons, rng):
    """Stars (N, 3) on a grid of `spacing` px with random offsets, away from the edges."""
    y, x = np.meshgrid(*(np.arange(spacing, n - spacing + 1, spacing) for n in size), indexing="ij")
    x, y = (v.ravel() + rng.uniform(-2, 2, v.size) for v in (x, y))
    return np.stack(
        [x, y, electrons(x.size) if callable(electrons) else np.full(x.size, float(electrons))], 1
    )


def match(found, stars, within=2.0):
    """Index (N,) of the found star nearest to each true one; -1 if none lies within the tolerance in px."""
    if len(found) == 0:
        return np.full(len(stars), -1)
    apart = np.hypot(stars[:, None, 0] - found.x, stars[:, None, 1] - found.y)
    return np.where(apart.min(1) < within, apart.argmin(1), -1)


def errors(found, stars):
    """Errors (N, 2) in px and in sigma of stars, which must all be found."""
    index = match(found, stars)
    assert np.all(index >= 0)
    error = np.stack([found.x[index], found.y[index]], 1) - stars[:, :2]
    return error, error / np.sqrt(np.einsum("nii->ni", found.covariance[index]))


def rms(values):
    return np.sqrt(np.mean(np.square(values)))
