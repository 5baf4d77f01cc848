# SPDX-License-Identifier: Apache-2.0
"""The one number a pixel that detection works on, and whether a colour mosaic lies over it."""

import cv2
import numpy as np

NATIVE = 1.1  # times noisier than interpolated numbers the measured ones must be


def plane_of(frame):
    """The pixels (h, w) of a Frame as measured, and whether they are a mosaic: True, False, or None where only they
    can tell, since files often do not say.

    Colours made from a mosaic are interpolated: two thirds of the numbers are averages of the others. That ties
    neighbours' noise together and spreads a hot pixel to a star's width, so only what was measured is taken.
    Other colours are added, as uint16.
    """
    pixels = frame.pixels
    if pixels.ndim == 2:
        return pixels, True if frame.pattern else None
    measured = _measured(pixels)
    if measured is None:
        blue, green, red = cv2.split(pixels)
        return cv2.add(cv2.add(blue, green, dtype=cv2.CV_16U), red, dtype=cv2.CV_16U), False
    plane = np.empty(pixels.shape[:2], np.uint8)
    for row, column in np.ndindex(2, 2):
        colour = measured[:, row, column].argmax()
        plane[row::2, column::2] = pixels[row::2, column::2, colour]
    return plane, True


def _measured(pixels):
    """(3, 2, 2) bool: at which (row, column) modulo 2 each colour was measured; None where all were everywhere.

    An average is less noisy than what it is made of, so each colour is noisiest where it was measured.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 32:
        return None
    step = 2 * max(1, height // 400)  # 200 rows of a phase are enough
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
