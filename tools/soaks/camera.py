# SPDX-License-Identifier: Apache-2.0
"""Half an hour of one source of the camera, as fast as it gives frames: whether its memory grows.

    soak.py camera files files.path:=/nights/1 files.loop:=true
    soak.py camera simulated simulated.width:=1404 simulated.height:=936 focal_mm:=150.0

The parameters are as for the node `camera`; a camera, or the server of one, has to be there.  Exit status 1 if the
last half's memory has grown by more than 2 MB against the half before, or a frame did not come.
"""

import gc
import time

import yaml
from runner import Memory, Progress

from starpos.errors import StarposError
from starpos.parameters.table import ParameterError, defaults_of, parameters_of
from starpos_camera.sources.registry import SOURCES
from starpos_camera.sources.source import CaptureSettings

ALLOWED_MB = 2.0


def options(parser) -> None:
    parser.add_argument("source", choices=tuple(SOURCES))
    parser.add_argument("parameters", nargs="*", metavar="NAME:=VALUE")
    parser.add_argument("--frames", type=int, default=360, help="360: 30 minutes of one every 5 s")


def run(options) -> int:
    name, frames = options.source, options.frames
    try:
        values = values_of(options.parameters) | {"source": name}
    except ParameterError as error:
        print(error)
        return 2
    if frames < 1:
        print(f"{frames} frames are no soak: give 1 or more.")
        return 2
    settings = CaptureSettings(
        set_or_none(values["exposure"]), set_or_none(values["gain"]), values["cadence"]
    )
    if refusal := SOURCES[name].refusal(values, settings):
        print(refusal)
        return 2
    source = SOURCES[name](values, time.time)
    failed, begin, progress = 0, time.monotonic(), Progress(frames, "frames")
    try:
        for k in range(1, frames + 1):
            try:
                frame = source.capture(settings).frame
                said = f"{frame.width} x {frame.height} px {frame.pixels.dtype}"
                del frame
            except StarposError as error:
                failed += 1
                said = str(error)
            gc.collect()
            # By then everything that is made only once has been made.
            if k <= max(1, frames // 10):
                memory = Memory()
            memory.look()
            progress.at(k, memory, said)
    finally:
        source.close()
    each_s = (time.monotonic() - begin) / frames
    print(
        f"{frames} frames of {name}, {failed} did not come: {each_s:.3f} s each; the last half's memory "
        f"{memory.grown:+.2f} MB"
    )
    return int(memory.grown > ALLOWED_MB or failed > 0)


def values_of(words: list[str]) -> dict:
    """Make the camera's parameters from words NAME:=VALUE; ParameterError in a sentence."""
    table = {p.name: p for p in parameters_of("camera")}
    values = defaults_of("camera")
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
