# SPDX-License-Identifier: Apache-2.0
"""Gaussian-windowed moments: where a star is and how wide, for any symmetric image, without a model of it.

The moments of a star seen through an elliptical Gaussian window of covariance W are those of a Gaussian of
covariance V = (C^-1 + W^-1)^-1, if the star is one of covariance C (Bernstein & Jarvis 2002, AJ 123, 583).
"""

import numpy as np

NARROWEST = 0.2  # px2: a pixel alone has 1/12, and starlight never falls on one alone
NARROWEST_WINDOW = 1.2  # px2: under narrower ones a sum over pixels is no integral


def at_least(shape, floor):
    """The covariance shape (..., 2, 2) px2 with no principal axis below floor px2."""
    values, vectors = np.linalg.eigh(shape)
    return (vectors * np.maximum(values, floor)[..., None, :]) @ np.swapaxes(vectors, -1, -2)


def moments(stamps, x, y, window):
    """One look through the window (2, 2) px2, or one each (N, 2, 2), at the points x, y (N,).

    Returns mass (N,), the mean offset (N, 2) px from x, y and the covariance (N, 2, 2) px2 of the windowed image;
    NaN where there is nothing. Pixels off the frame or saturated hold what they hold: without them the moments
    would lean away from the edge.
    """
    dx, dy = stamps.offsets(x, y)
    inverse = np.linalg.inv(window)[..., None, None].astype(np.float32)
    xx, xy, yy = (inverse[..., i, j, :, :] for i, j in ((0, 0), (0, 1), (1, 1)))
    exponent = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
    weighted = np.exp(-0.5 * exponent) * stamps.signal
    rows, columns = weighted.sum(2), weighted.sum(1)  # the separable sums, over (N, S) from here on
    dx, dy = dx[:, 0, :], dy[:, :, 0]
    mass = columns.sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(mass > 0, 1 / mass, np.nan)
    mx, my = (columns * dx).sum(1) * scale, (rows * dy).sum(1) * scale
    xx, yy = (columns * dx * dx).sum(1) * scale - mx * mx, (rows * dy * dy).sum(1) * scale - my * my
    xy = np.einsum("nij,ni,nj->n", weighted, dy, dx) * scale - mx * my
    return mass, np.stack([mx, my], 1), np.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2)


def window_for(shape):
    """The window (..., 2, 2) px2 that suits stars of covariance shape: the same, unless too narrow for sums."""
    return at_least(shape, NARROWEST_WINDOW)


def frame_shape(stamps, blur=0.0, rounds=12):
    """The typical covariance C (2, 2) px2 of the stars in stamps, their own measurement through a matched window.

    blur px2: how much wider smoothing has made the stamps' images. Returns None if they agree on nothing.
    """
    window = np.eye(2) * max(1.5, stamps.reach / 4) ** 2
    x, y = stamps.x.astype(float), stamps.y.astype(float)
    shape = None
    for _ in range(rounds):
        _, step, seen = moments(stamps, x, y, window)
        with np.errstate(invalid="ignore"):
            usable = (np.abs(step).max(1) < 1.5) & (np.linalg.det(seen) > 0.01)
        if not usable.any():
            return shape
        seen = np.median(seen[usable], axis=0)
        narrower = np.linalg.inv(seen) - np.linalg.inv(window)
        values, vectors = np.linalg.eigh(narrower)
        limit = (stamps.reach / 2.0) ** 2  # wider than this the stamp does not hold the star
        own = vectors @ np.diag(1 / np.clip(values, 1 / limit, 1 / NARROWEST)) @ vectors.T
        gain = np.eye(2) + own @ np.linalg.inv(window)
        step = np.where(usable[:, None], step @ gain.T, 0)
        x, y = x + np.clip(step[:, 0], -1, 1), y + np.clip(step[:, 1], -1, 1)
        change = np.inf if shape is None else np.abs(own - shape).max() / own.max()
        shape = own
        window = window_for(own)
        if change < 1e-3:
            break
    return at_least(shape - blur * np.eye(2), NARROWEST)


def own_shape(seen, window):
    """Covariances (N, 2, 2) px2 of stars from those of their windowed images (N, 2, 2); NaN where there are none."""
    sound = np.isfinite(seen).all((1, 2)) & (np.abs(np.linalg.det(np.nan_to_num(seen))) > 1e-6)
    narrower = np.linalg.inv(np.where(sound[:, None, None], seen, np.eye(2))) - np.linalg.inv(window)
    sound &= np.abs(np.linalg.det(narrower)) > 1e-9
    own = np.linalg.inv(np.where(sound[:, None, None], narrower, np.eye(2)))
    return np.where(sound[:, None, None], own, np.nan)


def relative_widths(seen, shape, window):
    """(N, 2): the smaller and the larger squared width of windowed images over that of stars of `shape` (..., 2, 2).

    1 for a star like the frame's, towards 0 across a hot pixel; along a streak it reaches 2 if window = shape.
    NaN counts as 0.
    """
    expected = np.linalg.inv(np.linalg.inv(shape) + np.linalg.inv(window))
    root = np.linalg.inv(np.linalg.cholesky(expected))
    with np.errstate(invalid="ignore"):
        return np.linalg.eigvalsh(np.nan_to_num(root @ seen @ np.swapaxes(root, -1, -2)))
