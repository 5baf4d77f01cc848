# SPDX-License-Identifier: Apache-2.0
"""The plane that detection works on, one number a pixel, and whether it is a colour mosaic."""

import cv2
import numpy as np

from starpos.frames.frame import Frame

# Minimum noise of measured pixels over the noise of interpolated ones.
NATIVE = 1.1


def plane_of(frame: Frame) -> tuple[np.ndarray, bool | None]:
    """The pixels (h, w) of a Frame as they were measured, and whether they are a mosaic.

    The second value is True, False, or None if the file does not say: then only the pixels can show it. In colours made
    from a mosaic two thirds of the numbers are interpolated. That correlates the noise of neighbours and spreads a hot
    pixel to a star's width, so only the measured third is taken. Other colours are added, as uint16.
    """
    pixels = frame.pixels
    if pixels.ndim == 2:
        return np.ascontiguousarray(pixels), True if frame.pattern else None
    measured = _measured(pixels)
    if measured is None:
        blue, green, red = cv2.split(pixels)
        return cv2.add(cv2.add(blue, green, dtype=cv2.CV_16U), red, dtype=cv2.CV_16U), False
    plane = np.empty(pixels.shape[:2], np.uint8)
    for row, column in np.ndindex(2, 2):
        colour = measured[:, row, column].argmax()
        plane[row::2, column::2] = pixels[row::2, column::2, colour]
    return plane, True


def halved(plane: np.ndarray) -> tuple[np.ndarray, int]:
    """The plane (h // 2, w // 2), uint16, of sums over squares of 2 x 2 px, and the flux of 1 DN in it.

    Sums that would not fit into 16 bits are means, rounded. A mosaic becomes grey.
    """
    height, width = (n // 2 * 2 for n in plane.shape)
    four = plane[:height, :width].reshape(height // 2, 2, width // 2, 2).sum((1, 3), dtype=np.uint32)
    gain = 1 if plane.dtype == np.uint8 or four.max(initial=0) < 1 << 16 else 4
    return ((four + gain // 2) // gain).astype(np.uint16), gain


def _measured(pixels: np.ndarray) -> np.ndarray | None:
    """Whether each colour was measured at (row, column) modulo 2, (3, 2, 2) bool; None if no mosaic is seen.

    An average is less noisy than the values it is made of, so each colour is noisiest where it was measured.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 32:
        return None
    # 200 rows of a phase are enough
    step = 2 * max(1, height // 400)
    noise = np.empty((3, 2, 2))
    for row, column in np.ndindex(2, 2):
        phase = pixels[row::step, column::2].astype(np.int16)
        noise[:, row, column] = np.abs(np.diff(phase, axis=1)).mean((0, 1))
    noise /= np.maximum(noise.mean((1, 2), keepdims=True), 1e-9)
    for row, column in np.ndindex(2, 2):
        measured = np.zeros((3, 2, 2), bool)
        measured[2, row, column] = measured[0, 1 - row, 1 - column] = True
        measured[1] = ~(measured[0] | measured[2])
        low, high = np.where(measured, noise, np.inf).min((1, 2)), np.where(measured, 0, noise).max((1, 2))
        if np.all(low > high) and noise[measured].mean() > NATIVE * noise[~measured].mean():
            return measured
    return None
