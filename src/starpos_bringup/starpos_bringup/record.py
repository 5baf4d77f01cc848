# SPDX-License-Identifier: Apache-2.0
"""The executables `record`, which writes a night as a rosbag2, and `folder`, which writes it as a night's folder."""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.errors import BagError
from starpos_bringup.bag import BagWriter

if TYPE_CHECKING:
    from starpos_bringup.recorder import FolderWriter, Recorder

# Types by relative names.
TOPICS = {
    "camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "camera/capture": "starpos_interfaces/msg/Capture",
    "stars": "starpos_interfaces/msg/StarArray",
    "tilt": "starpos_interfaces/msg/Tilt",
    "attitude": "starpos_interfaces/msg/Attitude",
    "fix": "sensor_msgs/msg/NavSatFix",
    "fix_averaged": "sensor_msgs/msg/NavSatFix",
    "gnss/fix": "sensor_msgs/msg/NavSatFix",
    "gnss/check": "starpos_interfaces/msg/GnssCheck",
    "heading/imu": "sensor_msgs/msg/Imu",
    "solver/solution": "starpos_interfaces/msg/Solution",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
IMAGES = {"camera/image_raw": "sensor_msgs/msg/Image"}
# Exit statuses.
SAVED, BROKEN_OFF, REFUSED = 0, 1, 2


def record() -> int:
    """Run the executable."""
    from starpos_common.node_main import own_arguments, run

    options = _parser().parse_args(own_arguments(sys.argv[1:])[0])
    topics = TOPICS | (IMAGES if options.images else {})
    try:
        writer = BagWriter(options.bag)
    except BagError as error:
        say(str(error))
        return REFUSED
    recorders: list[Recorder] = []

    def make_nodes() -> "Iterator[Recorder]":
        from starpos_bringup.recorder import Recorder

        recorders.append(Recorder(writer, topics, say))
        yield recorders[0]

    status = run(make_nodes)
    return status or (BROKEN_OFF if any(r.trouble for r in recorders) else SAVED)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="record",
        description="Record what the instrument publishes and what it is made of, until Ctrl-C.",
        epilog="Exit status: 0 saved, 1 broken off (a full disk), 2 a bad call.",
    )
    parser.add_argument("bag", type=Path, metavar="BAG", help="a folder to make")
    parser.add_argument("--images", action="store_true", help="the frames too: 16 MB each of 21 megapixels")
    return parser


def say(sentence: str) -> None:
    print(f"record: {' '.join(sentence.split())}", file=sys.stderr, flush=True)


def folder() -> int:
    """Run the executable."""
    from starpos_common.node_main import own_arguments, run

    parser = argparse.ArgumentParser(
        prog="folder",
        description="Write the instrument's stars and tilts into a folder, new or there already, until Ctrl-C.",
    )
    parser.add_argument("folder", type=Path, metavar="NIGHT")
    path = parser.parse_args(own_arguments(sys.argv[1:])[0]).folder
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"folder: {path}: it cannot be made ({error.strerror})", file=sys.stderr)
        return REFUSED

    def make_nodes() -> "Iterator[FolderWriter]":
        from starpos_bringup.recorder import FolderWriter

        yield FolderWriter(path)

    return run(make_nodes)
