# SPDX-License-Identifier: Apache-2.0
"""`starpos simulate`: a night on disk, frames, tilts and the truth, from a place you choose."""

import numpy as np

from starpos import catalogue
from starpos.cli import common
from starpos.errors import FrameError
from starpos.night import write_night
from starpos.simulate import scene_of


def define(parser) -> None:
    parser.add_argument("out", metavar="FOLDER", help="where frame_0000.fits ..., tilt.csv and truth.json go")
    parser.add_argument("-n", "--frames", type=int, default=5, help="how many (5)")
    parser.add_argument("--latitude", type=float, default=35.7046, help="deg, astronomic")
    parser.add_argument("--longitude", type=float, default=51.4106, help="deg, east positive")
    parser.add_argument(
        "--start", default="2026-11-02T18:00:00", metavar="UTC", help="start of the first exposure"
    )
    parser.add_argument("--cadence", type=float, default=5.0, help="s between frames (5)")
    parser.add_argument("--exposure", type=float, default=0.5, help="s (0.5)")
    parser.add_argument("--azimuth", type=float, default=40.0, help="deg, of the optical axis")
    parser.add_argument("--altitude", type=float, default=78.0, help="deg, of the optical axis")
    parser.add_argument("--roll", type=float, default=15.0, help="deg, about the optical axis")
    parser.add_argument("--turn", type=float, default=0.0, help="deg of azimuth between frames")
    parser.add_argument("--focal-mm", type=float, default=600.0)
    parser.add_argument("--pixel-um", type=float, default=6.4)
    parser.add_argument(
        "--size", type=int, nargs=2, default=(5616, 3744), metavar=("WIDTH", "HEIGHT"), help="px"
    )
    parser.add_argument(
        "--misalignment", type=float, nargs=3, default=(0.0, 0.0, 0.0), metavar=("RX", "RY", "RZ")
    )
    parser.add_argument(
        "--tilt-noise", type=float, default=0.0035, help="deg, of one reading (0.0035, the SCA100T's)"
    )
    parser.add_argument(
        "--tilt-zero", type=float, nargs=2, default=(0.0, 0.0), metavar=("X", "Y"), help="deg"
    )
    parser.add_argument(
        "--stars-only", action="store_true", help="lists of detected stars (CSV) instead of frames"
    )
    parser.add_argument("--seed", type=int, default=1)
    common.add_air(parser)
    parser.set_defaults(run=run)


def run(args) -> int:
    if args.frames < 1 or args.exposure <= 0 or min(args.size) < 16:
        raise FrameError("a night needs at least one frame of at least 16 x 16 px and an exposure above 0 s")
    scene = scene_of(
        size=tuple(args.size),
        focal_px=args.focal_mm * 1000 / args.pixel_um,
        latitude_deg=args.latitude,
        longitude_deg=args.longitude,
        atmosphere=common.atmosphere_of(args),
        pointing_deg=(args.azimuth, args.altitude, args.roll),
        misalignment_deg=tuple(args.misalignment),
        tilt_noise_deg=args.tilt_noise,
        tilt_zero_deg=tuple(args.tilt_zero),
    )
    write_night(
        args.out,
        scene,
        catalogue.load(),
        start_utc=args.start,
        frames=args.frames,
        cadence_s=args.cadence,
        exposure_s=args.exposure,
        turn_deg=args.turn,
        stars_only=args.stars_only,
        rng=np.random.default_rng(args.seed),
        progress=common.ProgressBar(),
    )
    return 0
