# SPDX-License-Identifier: Apache-2.0
"""A bag as a command's input: its options, and what it holds of one instrument."""

import argparse
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.cli import console, options
from starpos.errors import FrameError
from starpos.frames.stars import no_stars
from starpos.session.parameter_file import drivers_of

if TYPE_CHECKING:
    from starpos.night.bag import Recorded
    from starpos.night.recorded import OfBag

PIP = "pip install matplotlib rosbags"


def add_bag(parser: argparse.ArgumentParser) -> None:
    """Add the options that `read_bag` reads."""
    parser.add_argument("--namespace", metavar="NAME", help="of the instrument, in a bag that holds several")
    options.add_parameters(
        parser,
        "of detector and inclinometer, where stars and tilts are made of a robot's images and IMU; what the solver's are "
        "is given by the other options",
        "detector:stamp:=start",
    )
    options.add_remaps(parser)


def read_bag(path: Path, args: argparse.Namespace) -> "tuple[Recorded, OfBag]":
    """One instrument's part of a bag, and the instrument of its frames; raises StarposError."""
    if find_spec("rosbags") is None:
        raise FrameError(f"{path}: bags are read with rosbags, which is not here: {PIP}")
    from starpos.night import bag, recorded

    any_camera = options.instrument_of(args, no_stars(100, 100, focal_px=1000.0))
    drivers = drivers_of(args.params_file, args.param, args.namespace, options.remaps_of(args))
    found = bag.read(path, args.namespace, any_camera.inclinometer.noise_rad, drivers, console.ProgressBar())
    told = (args.instrument, args.focal_mm) != (None, None)
    cameras = found.cameras if args.focal_mm is None else {}
    return found, recorded.OfBag(any_camera, cameras, any_size=told)
