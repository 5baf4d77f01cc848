# SPDX-License-Identifier: Apache-2.0
"""Captures that may fail, and captures that go on while a test does something to the camera."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, FrameSource

SHORT = CaptureSettings(0.1, None, 5.0)


def attempt(source: FrameSource, settings: CaptureSettings = SHORT) -> CapturedFrame | str:
    """What a call gave: an exposure or the sentence of its error."""
    try:
        return source.capture(settings)
    except CaptureError as error:
        return str(error)


def in_thread(call: Callable, *args) -> Future:
    """Begin a call in a thread; the result is what it gave, and when (monotonic)."""
    pool = ThreadPoolExecutor(1)
    result = pool.submit(lambda: (call(*args), time.monotonic()))
    pool.shutdown(wait=False)
    return result
