# SPDX-License-Identifier: Apache-2.0
"""`starpos identify`: where frames look, from their stars alone."""

import time
from contextlib import suppress

import numpy as np

from starpos import catalogue
from starpos.cli import common
from starpos.errors import FrameError, StarposError
from starpos.solve import Solution, Solver, Status


def define(parser) -> None:
    common.add_frames(parser)
    common.add_exif(parser)
    common.add_optics(parser)
    parser.set_defaults(run=run)


def run(args) -> int:
    solver, any_found, unreadable = None, False, False
    for path, item in common.frames_of(args.frames, common.clock_of(args)):
        if isinstance(item, FrameError):
            common.complain("identify", item)
            unreadable = True
            answer = Solution(Status.BAD_INPUT, str(item), path, None, 0)
            cpu_ms = 0.0
        else:
            if solver is None:
                solver = Solver(
                    common.instrument_of(args, item), catalogue.load(), progress=common.ProgressBar()
                )
            with suppress(StarposError):  # identify says it
                solver.prepare(item.width, item.height)
            begin = time.process_time()
            answer = solver.identify(common.stars_of(item))
            cpu_ms = 1000 * (time.process_time() - begin)
            if not answer.ok:
                common.complain("identify", answer.message)
        any_found |= answer.ok
        if args.json:
            common.print_json(as_json(path, answer) | {"cpu_ms": cpu_ms})
        else:
            print(_line(path, answer))
    return common.UNREADABLE if unreadable else 0 if any_found else 1


def as_json(path: str, s: Solution) -> dict:
    a = s.attitude
    return {
        "file": path,
        "ra": np.degrees(a.ra) if a else None,
        "dec": np.degrees(a.dec) if a else None,
        "roll": np.degrees(a.roll) if a else None,
        "focal_px": a.focal_px if a else None,
        "stars_detected": s.stars_detected,
        "stars_matched": len(s.names),
        "residual_arcsec": a.residual_arcsec if a else None,
        "log_odds": a.log_odds if a else None,
        "mirrored": a.mirrored if a else None,
        "status": s.status.value,
    }


def _line(path: str, s: Solution) -> str:
    if s.attitude is None:
        return f"{path}: {s.status.value}, {s.stars_detected} stars detected"
    a = s.attitude
    return (
        f"{path}: RA {np.degrees(a.ra):.5f} Dec {np.degrees(a.dec):+.5f} top at {np.degrees(a.roll):.3f} deg, "
        f"{len(s.names)} of {s.stars_detected} stars, residual {a.residual_arcsec:.2f} arcsec, "
        f"focal length {a.focal_px:.1f} px, log-odds {a.log_odds:.0f}" + (", mirrored" if a.mirrored else "")
    )
