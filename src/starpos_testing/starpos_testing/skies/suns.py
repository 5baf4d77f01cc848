# SPDX-License-Identifier: Apache-2.0
"""Frames of the Sun: a disc with limb darkening as behind a filter, or a saturated glow."""

import numpy as np


def disc_frame(
    x: float, y: float, radius: float, shape: tuple[int, int], hidden: float = 2.0, seed: int = 1
) -> np.ndarray:
    """A disc at x, y px, uint16, a little blurred; a cloud hides what is further to the right than `hidden` radii."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    share = np.hypot(columns - x, rows - y) / radius
    dark = 1 - 0.6 * (1 - np.sqrt(np.clip(1 - share**2, 0, 1)))
    # the mean over a pixel of a sharp limb, and the blur of the lens
    light = dark / (1 + np.exp(np.clip((share - 1) * radius / 0.6, -50, 50)))
    light /= 1 + np.exp(np.clip(((columns - x) / radius - hidden) / 0.05, -50, 50))
    ghost = 0.004 * np.roll(light, (40, 70), (0, 1))
    light = 30000 * (light + ghost)
    rng = np.random.default_rng(seed)
    return (light + rng.standard_normal(shape) * np.sqrt(light + 40) + 500).clip(0, 65535).astype(np.uint16)


def glow_frame(x: float, y: float, width: float, shape: tuple[int, int], seed: int = 1) -> np.ndarray:
    """A saturated spot with a halo at x, y px in a blue sky, uint8."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    light = 70 + 1500 / (1 + (np.hypot(columns - x, rows - y) / width) ** 2) ** 1.2
    noise = np.random.default_rng(seed).standard_normal(shape) * np.sqrt(light)
    return (light + noise).clip(0, 255).astype(np.uint8)
