# SPDX-License-Identifier: Apache-2.0
"""OpenCV without its messages, for V4L2 cameras and video files."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def quiet() -> Iterator[ModuleType]:
    """Import cv2 and keep it from printing meanwhile: our own sentences report the errors."""
    import cv2

    # OpenCV 4.6 has the function at the top level.
    log: Any = getattr(cv2.utils, "logging", cv2)
    level = log.setLogLevel(0)
    try:
        yield cv2
    finally:
        log.setLogLevel(level)
