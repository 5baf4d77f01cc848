# SPDX-License-Identifier: Apache-2.0
"""What V4L2 cameras and video files have in common: OpenCV's VideoCapture, kept quiet."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet() -> Iterator:
    """The module cv2, which prints nothing meanwhile: what it would print is said in a sentence."""
    import cv2

    log = getattr(cv2.utils, "logging", cv2)  # OpenCV 4.6 has it at the top
    level = log.setLogLevel(0)
    try:
        yield cv2
    finally:
        log.setLogLevel(level)
