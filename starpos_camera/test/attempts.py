# SPDX-License-Identifier: Apache-2.0
"""Sources by their parameters, captures that may fail or go on while a test does something to the camera."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from starpos.errors import StarposError
from starpos.parameters.table import defaults_of
from starpos_camera.sources.registry import SOURCES
from starpos_camera.sources.source import CapturedFrame, CaptureError, CaptureSettings, FrameSource

SHORT = CaptureSettings(0.1, None, 5.0)


def values(source: str, **changes) -> dict:
    """Parameters of the node with this source; in the names of the changed ones __ stands for a dot."""
    table = defaults_of("camera") | {"source": source}
    return table | {name.replace("__", "."): value for name, value in changes.items()}


def made(given: dict, settings: CaptureSettings = SHORT, now: Callable[[], float] = time.time) -> FrameSource:
    """The source of these parameters, which it does not refuse."""
    kind = SOURCES[given["source"]]
    assert kind.refusal(given, settings) is None
    return kind(given, now)


def play(source: FrameSource, count: int, settings: CaptureSettings) -> list:
    """What each of `count` calls gave: an exposure, or its error."""
    out = []
    for _ in range(count):
        try:
            out.append(source.capture(settings))
        except StarposError as error:
            out.append(error)
    return out


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
