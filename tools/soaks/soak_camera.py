# SPDX-License-Identifier: Apache-2.0
"""Half an hour of one source of the camera, as fast as it gives frames: its memory, and whether it grows.

    python tools/soaks/soak_camera.py SOURCE [NAME:=VALUE ...] [FRAMES]       360: 30 minutes of a frame every 5 s
    python tools/soaks/soak_camera.py files files.path:=/nights/1 files.loop:=true
    python tools/soaks/soak_camera.py simulated simulated.width:=1404 simulated.height:=936 focal_mm:=150.0

The parameters are those of the node `camera`; a camera, or the server of one, has to be there. Prints the resident
memory at each tenth. Exit status 0; 1 if the last half's memory has grown by more than 2 MB against the half
before, or a frame did not come.
"""

import gc
import sys
import time

import yaml

from starpos.errors import StarposError
from starpos_camera.camera_parameters import PARAMETERS
from starpos_camera.sources.registry import SOURCES
from starpos_camera.sources.source import CaptureSettings
from starpos_common.parameters import ParameterError
from starpos_testing.processes import memory_mb

HALF_HOUR, ALLOWED_MB = 360, 2.0


def main() -> int:
    name, *words = sys.argv[1:] or ["--help"]
    if name not in SOURCES:
        print(__doc__)
        return 2
    frames = int(words.pop()) if words and words[-1].isdecimal() else HALF_HOUR
    try:
        values = values_of(words) | {"source": name}
    except ParameterError as error:
        print(error)
        return 2
    if not frames:
        print("0 frames are no soak: give 1 or more.")
        return 2
    settings = CaptureSettings(
        set_or_none(values["exposure"]), set_or_none(values["gain"]), values["cadence"]
    )
    if refusal := SOURCES[name].refusal(values, settings):
        print(refusal)
        return 2
    source = SOURCES[name](values, time.time)
    sizes, failed, begin = [], 0, time.monotonic()
    try:
        for k in range(1, frames + 1):
            try:
                frame = source.capture(settings).frame
                size = f"{frame.width} x {frame.height} px {frame.pixels.dtype}"
                del frame
            except StarposError as error:
                failed += 1
                size = str(error)
            # By then everything that is made only once has been made.
            if k > frames // 10:
                sizes.append(memory_mb())
            if k % max(1, frames // 10) == 0:
                gc.collect()
                print(f"{k:6d} frames  {memory_mb():7.1f} MB  {size}", flush=True)
    finally:
        source.close()
    half = len(sizes) // 2
    grown = max(sizes[half:]) - max(sizes[:half] or sizes)
    each_s = (time.monotonic() - begin) / frames
    print(
        f"{frames} frames of {name}, {failed} did not come: {each_s:.3f} s each; the last half's memory {grown:+.2f} MB "
        "against the half's before"
    )
    return int(grown > ALLOWED_MB or failed > 0)


def values_of(words: list[str]) -> dict:
    """Make the camera's parameters from words NAME:=VALUE; ParameterError in a sentence."""
    table = {p.name: p for p in PARAMETERS}
    values = {p.name: p.default for p in PARAMETERS}
    for word in words:
        key, given, value = word.partition(":=")
        if not given or key not in table:
            raise ParameterError(
                f"{word} is no NAME:=VALUE of a parameter of the node camera: see its README."
            )
        text = isinstance(table[key].default, str)
        try:
            values[key] = table[key].convert(value if text else yaml.safe_load(value))
        except yaml.YAMLError:
            raise ParameterError(f"{word}: the value is no YAML.") from None
    return values


def set_or_none(value: float) -> float | None:
    return None if value != value else value


if __name__ == "__main__":
    sys.exit(main())
