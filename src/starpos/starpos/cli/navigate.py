# SPDX-License-Identifier: Apache-2.0
"""`starpos navigate`: place, heading and velocity of a voyage from its frames and an IMU, without standing still."""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

from starpos.cli import console, inputs, options
from starpos.cli.fix_output import FIX_KEYS
from starpos.earth.orientation import earth_orientation
from starpos.earth.vertical import Geodetic, Vertical
from starpos.navigation.estimate import VoyageFix
from starpos.navigation.voyage import Voyage
from starpos.night import under_way

OK, CARRIED, NO_READINGS, BAD_INPUT = "ok", "carried", "no inertial readings", "bad input"
# the keys of --json that come from a fix
KEYS: dict[str, Callable[[Any, Geodetic], Any]] = {
    "utc_unix_s": lambda fix, _: fix.utc_unix_s,
    **{key: FIX_KEYS[key] for key in ("latitude", "longitude", "heading", "covariance")},
    "velocity": lambda fix, _: fix.velocity,
    "gyro_bias": lambda fix, _: fix.gyro_bias,
    "accel_bias": lambda fix, _: fix.accel_bias,
    **{key: FIX_KEYS[key] for key in ("latitude_geodetic", "longitude_geodetic", "covariance_geodetic")},
    **{key: FIX_KEYS[key] for key in ("xi_arcsec", "eta_arcsec", "deflection_stddev_arcsec")},
}


def run(args: argparse.Namespace) -> int:
    args.frames = inputs.frames_among(args.frames, args.imu, args.velocity)
    vertical, read = options.vertical_of(args), inputs.reader_of(args)
    about = under_way.first_of(read, args.frames)
    frames, voyage = under_way.voyage_of(
        about,
        inputs.each_of(args, read, args.frames),
        inputs.given_of(args, about),
        args.imu,
        args.velocity,
        options.atmosphere_of(args),
        console.complain,
        console.ProgressBar(),
        mount_stddev_deg=args.mount_stddev,
        height_m=args.altitude_m,
        imu_model=args.imu_model,
        vehicle=args.vehicle,
        drift_stddev=args.drift_stddev,
    )
    return tell(args, frames, voyage, vertical)


def tell(
    args: argparse.Namespace, frames: list[under_way.VoyageFrame], voyage: Voyage, vertical: Vertical
) -> int:
    """Write the answer for each frame; returns the exit status."""
    output = console.Output(args, "voyage")
    console.complain(*voyage.faults)
    for path, frame, fix in zip(args.frames, frames, voyage.fixes, strict=True):
        status = _status(frame, fix)
        output.put(
            {"file": path} | json_of(fix, vertical) | {"status": status},
            f"{path}: {status if fix is None else text_of(fix)}",
        )
    fixes = [fix for fix in voyage.fixes if fix is not None]
    if not fixes:
        return console.NOTHING
    last = fixes[-1]
    options.tell_unknown(args, vertical.at(last.latitude, last.longitude))
    beyond = earth_orientation(last.utc_unix_s).extrapolated_days
    if beyond > 0:
        console.complain(f"the Earth's rotation is extrapolated {beyond:.0f} days beyond the IERS table: "
                        "upgrade astropy-iers-data")  # fmt: skip
    return console.UNREADABLE if any(frame.utc_unix_s is None for frame in frames) else 0


def _status(frame: under_way.VoyageFrame, fix: VoyageFix | None) -> str:
    if fix is None:
        return BAD_INPUT if frame.utc_unix_s is None else NO_READINGS
    return CARRIED if frame.sighting is None else OK


def json_of(fix: VoyageFix | None, vertical: Vertical) -> dict:
    """The keys of --json that come from a fix; all None without a fix."""
    if fix is None:
        return dict.fromkeys(KEYS)
    ground = fix.on_ground(vertical)
    return {key: value(fix, ground) for key, value in KEYS.items()}


def text_of(fix: VoyageFix) -> str:
    """The line of a fix for people."""
    return f"{fix.in_degrees}, {np.hypot(*fix.velocity[:2]):.2f} m/s"
