# SPDX-License-Identifier: Apache-2.0
"""`starpos identify`: where frames look, from their stars alone."""

import argparse
import math

import numpy as np

from starpos.cli import console, inputs
from starpos.errors import FrameError
from starpos.fix.solution import Solution, Status
from starpos.frames.frame import Stars
from starpos.instrument.camera import EQUIDISTANT
from starpos.units import ARCSEC


def run(args: argparse.Namespace) -> int:
    args.frames = inputs.frames_among(args.frames)
    any_found, unreadable = False, False
    lost: Stars | None = None
    complaints = console.FrameComplaints()
    read, output = inputs.reader_of(args), console.Output(args, "field")
    solving = inputs.identifying(args, args.frames, read, args.search_time)
    for path, answer in inputs.each_of(args, read, args.frames)(solving):
        if isinstance(answer, FrameError):
            unreadable, found, cpu_ms = True, Solution.unreadable(path, answer), 0.0
        else:
            found, cpu_ms = answer.solution, answer.cpu_ms
            lost = answer.stars if lost is None and found.status is Status.NOT_IDENTIFIED else lost
        any_found |= found.ok
        if not found.ok or found.remark:
            complaints(path, found.remark or found.message)
        output.put(as_json(path, found) | {"cpu_ms": cpu_ms}, _line(path, found))
    complaints.end()
    if lost is not None and not any_found:
        console.complain(solving.fitting(lost))
    return console.UNREADABLE if unreadable else 0 if any_found else 1


def as_json(path: str, s: Solution) -> dict:
    """The solution of a frame as JSON has it; angles in deg, None for missing values."""
    a = s.pointing
    return {
        "file": path,
        "ra": np.degrees(a.ra) if a else None,
        "dec": np.degrees(a.dec) if a else None,
        "roll": np.degrees(a.roll) if a else None,
        "focal_px": a.focal_px if a else None,
        "focal_stddev_px": a.focal_stddev_px if a else None,
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.named),
        "residual_arcsec": a.residual_arcsec if a else None,
        "log_odds": a.log_odds if a else None,
        "lens": a.model if a else None,
        "mirrored": a.mirrored if a else None,
        "negative": s.negative,
        "planets": dict(s.planets),
        "status": s.status.value,
        "warnings": list(s.warnings),
        "bright_explained": [s.explained.explained, s.explained.bright] if s.explained else None,
        "bright_seen": [s.explained.seen, s.explained.due] if s.explained else None,
        "remark": s.remark or None,
    }


def _line(path: str, s: Solution) -> str:
    if s.pointing is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    a = s.pointing
    digits = 1 - math.floor(math.log10(min(max(a.focal_stddev_px, 1e-3), 1.0)))
    return (
        f"{path}: RA {np.degrees(a.ra):.5f} Dec {np.degrees(a.dec):+.5f} top at {np.degrees(a.roll):.3f} deg, "
        f"{len(s.named)} of {s.stars_detected} stars, residual {a.residual_arcsec:.2f} arcsec, "
        f"focal length {a.focal_px:.{digits}f} +- {a.focal_stddev_px:.{digits}f} px "
        f"({1 / a.focal_px / ARCSEC:.5g} arcsec/px), log-odds {a.log_odds:.0f}"
        + (", a fisheye" if a.model == EQUIDISTANT else "")
        + (", mirrored" if a.mirrored else "")
        + (", a negative" if s.negative else "")
        + "".join(f", {name.title()}" for name, _ in s.planets)
        + "".join(f", {name}" for name in s.warnings)
    )
