# SPDX-License-Identifier: Apache-2.0
"""`starpos simulate`: writes a night of frames, tilts and their truth, from a place you choose."""

import argparse

import numpy as np

from starpos.cli import console, options
from starpos.frames.exposure import MAX_READOUT_S
from starpos.instrument.instrument import focal_px_of
from starpos.simulation.scene import scene_of, write_night
from starpos.sky import catalogue


def define(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out",
        metavar="FOLDER",
        help="where frame_0000.fits ..., tilt.csv and truth.json go: a new folder, or one that holds a simulated "
        "night, which is replaced",
    )
    parser.add_argument("-n", "--frames", type=options.number(1, 1e6, int), default=5, help="how many (5)")
    parser.add_argument(
        "--latitude", type=options.number(-90, 90), default=35.7046, help="deg, astronomic (35.7046)"
    )
    parser.add_argument(
        "--longitude", type=options.number(-360, 360), default=51.4106, help="deg, east positive (51.4106)"
    )
    parser.add_argument(
        "--start",
        default="2026-11-02T18:00:00",
        metavar="UTC",
        help="start of the first exposure (2026-11-02T18:00:00)",
    )
    parser.add_argument("--cadence", type=options.number(0, 1e6), default=5.0, help="s between frames (5)")
    parser.add_argument("--exposure", type=options.number(1e-6, 3600), default=0.5, help="s (0.5)")
    parser.add_argument(
        "--azimuth", type=options.number(-360, 360), default=40.0, help="deg, of the optical axis (40)"
    )
    parser.add_argument(
        "--altitude", type=options.number(5, 90), default=78.0, help="deg, of the optical axis (78)"
    )
    parser.add_argument(
        "--roll", type=options.number(-360, 360), default=15.0, help="deg, about the optical axis (15)"
    )
    parser.add_argument(
        "--turn", type=options.number(-360, 360), default=0.0, help="deg of azimuth between frames (0)"
    )
    parser.add_argument("--focal-mm", type=float, default=600.0, metavar="MM", help="focal length (600)")
    parser.add_argument("--pixel-um", type=float, default=6.4, metavar="UM", help="pixel size (6.4)")
    options.add_lens(parser)
    parser.add_argument(
        "--size",
        type=options.number(16, 12000, int),
        nargs=2,
        default=(5616, 3744),
        metavar=("WIDTH", "HEIGHT"),
        help="px (5616 3744)",
    )
    parser.add_argument(
        "--misalignment",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("RX", "RY", "RZ"),
        help="A3 in deg: camera to inclinometer (0 0 0)",
    )
    parser.add_argument(
        "--tilt-noise",
        type=options.number(0, 10),
        default=0.0035,
        help="deg, of one reading (0.0035, the SCA100T's)",
    )
    parser.add_argument(
        "--tilt-zero",
        type=options.number(-30, 30),
        nargs=2,
        default=(0.0, 0.0),
        metavar=("X", "Y"),
        help="deg, of the inclinometer's zero (0 0)",
    )
    parser.add_argument(
        "--readout",
        type=options.number(-MAX_READOUT_S, MAX_READOUT_S),
        default=0.0,
        metavar="S",
        help="rolling shutter: s from the first row to the last, negative: the bottom row is first (0: global)",
    )
    parser.add_argument(
        "--stars-only",
        action="store_true",
        help="lists of detected stars (stars_0000.csv ...) instead of frames",
    )
    parser.add_argument(
        "--seed", type=options.number(0, 2**63, int), default=1, metavar="S", help="of the random numbers (1)"
    )
    options.add_air(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    scene = scene_of(
        size=tuple(args.size),
        focal_px=focal_px_of(args.focal_mm, args.pixel_um),
        latitude_deg=args.latitude,
        longitude_deg=args.longitude,
        atmosphere=options.atmosphere_of(args),
        pointing_deg=(args.azimuth, args.altitude, args.roll),
        misalignment_deg=tuple(args.misalignment),
        tilt_noise_deg=args.tilt_noise,
        tilt_zero_deg=tuple(args.tilt_zero),
        readout_s=args.readout,
        lens=args.lens,
    )
    write_night(
        args.out,
        scene,
        catalogue.load_catalogue(),
        start_utc=args.start,
        frames=args.frames,
        cadence_s=args.cadence,
        exposure_s=args.exposure,
        turn_deg=args.turn,
        stars_only=args.stars_only,
        rng=np.random.default_rng(args.seed),
        progress=console.ProgressBar(),
        pixel_um=args.pixel_um,
    )
    return 0
