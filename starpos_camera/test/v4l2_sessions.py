# SPDX-License-Identifier: Apache-2.0
"""Runs under the emulated V4L2 camera: `v4l2_sessions.py SESSION [PARAMETERS]`, JSON in and on its last line out."""

import ctypes
import json
import os
import sys
import time
from pathlib import Path

import numpy as np

from starpos.parameters.table import defaults_of
from starpos_camera.sources.source import CaptureError, CaptureSettings
from starpos_camera.sources.video import Video

FOLDER = Path(os.environ["STARPOS_V4L2"])
SETTINGS = CaptureSettings(None, None, 5.0)
# Waits until the camera's buffers are full of old frames.
fill = ctypes.CDLL(None).starpos_emulated_fill


def told(source, settings=SETTINGS):
    """What a capture gave, times in s after it was asked for."""
    asked_s, asked_unix_s = time.monotonic(), time.time()
    try:
        exposure = source.capture(settings)
    except CaptureError as error:
        return {"error": str(error), "took_s": time.monotonic() - asked_s}
    frame = exposure.frame
    first = frame.pixels.reshape(-1)[:8]
    began_us = sum(int(value & 255) << 8 * k for k, value in enumerate(first))
    rows, columns = np.indices(frame.pixels.shape[:2])
    good = (frame.pixels.reshape(-1)[8:] & 255) == ((rows * 5 + columns * 3) % 256).reshape(-1)[8:]
    return {
        "size": [frame.width, frame.height],
        "type": str(frame.pixels.dtype),
        "pattern": frame.pattern,
        "pixels_good": bool(good.all()),
        "began_s": began_us / 1e6 - asked_s,
        "mid_s": frame.mid_unix_s - asked_unix_s,
        "stddev_s": exposure.frame.stamp_stddev_s,
        "readout_stddev_s": frame.shutter.readout_stddev_s,
        "stamp": exposure.stamp_source,
        "exposure_s": frame.exposure_s,
        "remark": exposure.remark,
        "took_s": time.monotonic() - asked_s,
    }


def frames(source, settings=((None, None),)):
    """Frames of each pair of exposure and gain, one after the other."""
    out = []
    for exposure_s, gain in settings:
        out.append(told(source, CaptureSettings(exposure_s, gain, 5.0)))
        fill()
    return out


def unplugged(source):
    """Between two frames, in the middle of one, and back."""
    plug, pull = FOLDER / "plugged", FOLDER / "pull"
    out = [told(source)]
    plug.unlink()
    out += [told(source), told(source)]
    plug.touch()
    out.append(told(source))
    pull.touch()
    out.append(told(source, CaptureSettings(0.08, None, 5.0)))
    pull.unlink()
    plug.touch()
    return [*out, told(source)]


if __name__ == "__main__":
    session, given = sys.argv[1], json.loads(sys.argv[2])
    options = given.pop("options", {})
    values = defaults_of("camera") | {"video.device": "/dev/starpos-emulated"} | given
    assert Video.refusal(values, SETTINGS) is None
    source = Video(values, time.time)
    print(json.dumps(globals()[session](source, **options)))
    source.close()
