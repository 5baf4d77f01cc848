# SPDX-License-Identifier: Apache-2.0
"""`starpos simulate`: writes a night of frames, tilts and their truth, from a place you choose."""

import argparse

import numpy as np

from starpos.cli import console, options
from starpos.instrument.instrument import focal_px_of
from starpos.simulation.scene import scene_of, write_night
from starpos.sky import catalogue


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
    longest_s = scene.longest_s
    if args.exposure >= longest_s and not args.stars_only:
        console.complain(
            f"the sky alone saturates these frames, they show no stars: give --exposure {longest_s / 3:.1g}, or "
            "--stars-only (the simulated telescope has the same aperture at any focal length)"
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
