# SPDX-License-Identifier: Apache-2.0
"""`starpos mount`: the axis about which a mount turned between frames, against the pole, and a circle's orientation."""

import argparse
import csv
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from starpos.cli import console, inputs, options
from starpos.earth.place import Place
from starpos.errors import FixError, FrameError, InstrumentError
from starpos.files import open_regular
from starpos.fix.attitude import Attitude, heading_row
from starpos.fix.directions import CircleOrientation, circle_orientation, horizontal, mount_axis
from starpos.fix.heading import AttitudeAtPlace
from starpos.units import ARCSEC

READING = "azimuth_deg"


def run(args: argparse.Namespace) -> int:
    axes = options.axes_of(args)
    readings = None if args.readings is None else _readings(args.readings)
    place = options.camera_place_of(args)
    seen = [(s.sight.stars.source, s.at_place) for s in inputs.seen_at(args, place)]
    if readings is None:
        return _axis(args, place, [a for _, a in seen])
    return _circle(args, seen, readings, axes[list(axes)[-1]])


def _axis(args: argparse.Namespace, place: Place, seen: Sequence[AttitudeAtPlace]) -> int:
    """Print the axis of a mount."""
    found = mount_axis([a.optics for a in seen])
    right, above = np.degrees(found.from_pole(place.plumb[0]))
    east, north, up = found.direction
    sigma = np.degrees(np.sqrt(np.diag(found.covariance)))
    values = {
        "frames": len(seen),
        "azimuth": math.degrees(math.atan2(east, north)) % 360,
        "altitude": math.degrees(math.asin(up)),
        "sigma_across_arcsec": sigma[0] * 3600,
        "sigma_altitude_arcsec": sigma[1] * 3600,
        "right_of_pole_arcsec": right * 3600,
        "above_pole_arcsec": above * 3600,
        "rest_arcsec": (found.rest / ARCSEC).tolist(),
        "axis_in_camera": found.in_camera.tolist(),
    }
    side = ("right", "left")[int(right < 0)], ("above", "below")[int(above < 0)]
    console.tell(
        args,
        values,
        f"the axis of {len(seen)} frames: azimuth {values['azimuth']:.5f}, altitude {values['altitude']:.5f} deg, "
        f"+- {sigma[0] * 3600:.1f} arcsec across, {sigma[1] * 3600:.1f} up; frames are off it by at most "
        f"{found.rest.max() / ARCSEC:.1f} arcsec\n"
        f"it points {abs(right) * 3600:.0f} arcsec {side[0]} of the celestial pole (facing it) and "
        f"{abs(above) * 3600:.0f} arcsec {side[1]} it",
    )
    if len(seen) < 3:
        console.complain("two frames do not show whether it is one axis: give three")
    return 0


def _circle(
    args: argparse.Namespace,
    seen: Sequence[tuple[str, AttitudeAtPlace]],
    readings: dict[str, float],
    axis: Sequence[float],
) -> int:
    """Print the orientation of a horizontal circle."""
    there = [(path, a, readings[Path(path).name]) for path, a in seen if Path(path).name in readings]
    for path in sorted({Path(p).name for p, _ in seen} - set(readings)):
        console.complain(f"{path}: {args.readings} has no reading of it: it is left out")
    if not there:
        raise FixError(
            f"no frame with a heading has a reading in {args.readings}: check the names in its column file"
        )
    optics, along = [a.optics for _, a, _ in there], np.array(axis)
    at = [horizontal(replace(o, covariance=o.unshared), along) for o in optics]
    azimuth, own = (np.concatenate([getattr(h, k) for h in at]) for k in ("azimuth", "sigma_azimuth"))
    shared = np.array([_shared(o, along) for o in optics])
    found = circle_orientation(
        azimuth, np.maximum(own, 0.1 * ARCSEC), shared, np.radians([r for *_, r in there])
    )
    _print_circle(args, found, [path for path, *_ in there])
    return 0


def _shared(optics: Attitude, axis: np.ndarray) -> np.ndarray:
    """The errors (m,) in rad of an axis's azimuth by the sources that all frames of a place share."""
    row = heading_row((optics.rotation @ axis)[:, None])
    return np.concatenate([math.sqrt(t.variance) * row @ t.factor[3:] for t in optics.terms if t.common])


def _print_circle(args: argparse.Namespace, found: CircleOrientation, names: Sequence[str]) -> None:
    zero, sigma, rest = math.degrees(found.zero), found.sigma / ARCSEC, (found.rest / ARCSEC).tolist()
    values = {
        "frames": len(rest),
        "zero": zero,
        "sigma_arcsec": sigma,
        "sense": found.sense,
        "rest_arcsec": rest,
    }
    lines = [f"{name}: {off:+.1f} arcsec" for name, off in zip(names, rest, strict=True)]
    turns = "clockwise" if found.sense > 0 else "anticlockwise"
    lines.append(
        f"the circle counts {turns} from azimuth {zero:.5f} +- {sigma / 3600:.5f} deg, of {len(rest)} readings"
    )
    console.tell(args, values, "\n".join(lines))


def _readings(path: str) -> dict[str, float]:
    """Readings in deg by the names of frames; raises FrameError."""
    cure = f"give a CSV with a line of names, file,{READING}, and a row a frame"
    try:
        with open_regular(path) as file:
            rows = list(csv.DictReader(file.read().decode("utf-8-sig").splitlines()))
        found = {Path(row["file"].strip()).name: float(row[READING]) for row in rows}
    except (OSError, ValueError, KeyError, AttributeError, TypeError, csv.Error):
        raise FrameError(f"{path}: not a readable table of readings: {cure}") from None
    if not found or not np.isfinite(list(found.values())).all():
        raise InstrumentError(f"{path}: it has no readings, or one that is no number: {cure}")
    return found
