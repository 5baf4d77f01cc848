# SPDX-License-Identifier: Apache-2.0
"""`ros2 run starpos_bringup folder NIGHT`: what the instrument publishes as a night's folder, as it comes.

`starpos first-night`, `starpos solve` and `starpos report` read it: lists of stars, and tilt.csv.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from starpos_bringup.recording.record import REFUSED

if TYPE_CHECKING:
    from starpos_bringup.recording.folder_writer import FolderWriter


def folder() -> int:
    """Run the executable."""
    from starpos_common.node_main import run

    k = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    parser = argparse.ArgumentParser(
        prog="folder",
        description="Write the instrument's stars and tilts into a folder, new or there already, until Ctrl-C.",
    )
    parser.add_argument("folder", type=Path, metavar="NIGHT")
    path = parser.parse_args(sys.argv[1:k]).folder
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        print(f"folder: {path}: it cannot be made ({error.strerror})", file=sys.stderr)
        return REFUSED

    def make_nodes() -> "Iterator[FolderWriter]":
        from starpos_bringup.recording.folder_writer import FolderWriter

        yield FolderWriter(path)

    return run(make_nodes)
