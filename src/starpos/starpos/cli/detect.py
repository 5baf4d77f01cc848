# SPDX-License-Identifier: Apache-2.0
"""`starpos detect`: the stars of frames."""

import argparse
from typing import TYPE_CHECKING

from starpos.cli import common, jobs
from starpos.cli.frame_work import Detecting, Reader
from starpos.errors import FrameError
from starpos.frames.stars import Stars

if TYPE_CHECKING:
    from starpos.detection import Detection


def define(parser: argparse.ArgumentParser) -> None:
    common.add_frames(parser)
    jobs.add_jobs(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    status, work, number = 0, Detecting(Reader()), len(args.frames)
    with jobs.workers_of(args, number) as workers:
        answers = jobs.watched(workers.map((work, path) for path in args.frames), number)
        for path, answer in zip(args.frames, answers, strict=True):
            if isinstance(answer, FrameError):
                status = common.UNREADABLE
            _tell(path, answer, args.json)
    return status


def _tell(path: str, answer: "tuple[Detection | Stars, float] | FrameError", as_json: bool) -> None:
    if isinstance(answer, FrameError):
        common.complain("detect", answer)
        if as_json:
            common.print_json({"file": path, "stars": [], "cpu_ms": 0.0, "status": "bad input"})
        return
    found, cpu_ms = answer
    stars = found if isinstance(found, Stars) else found.stars
    left_out = 0 if isinstance(found, Stars) else found.left_out
    if as_json:
        cut = {"left_out": left_out} if left_out else {}
        common.print_json({"file": path, "stars": _rows(stars), "cpu_ms": cpu_ms} | cut)
    elif isinstance(found, Stars):
        print(f"{path}: a list of {len(stars)} stars", flush=True)
    else:
        print(
            f"{path}: {len(stars)} stars, background {found.background:.1f} DN, noise {found.noise:.2f} DN, "
            f"FWHM {found.fwhm_px:.2f} px, chi2 {found.typical_chi2:.2f}, {cpu_ms:.0f} ms"
            + (f"; {left_out} fainter peaks were too many and are left out" if left_out else ""),
            flush=True,
        )


def _rows(stars: Stars) -> list[list[float]]:
    sigma_x, sigma_y = stars.covariance[:, 0, 0] ** 0.5, stars.covariance[:, 1, 1] ** 0.5
    columns = (stars.x, stars.y, stars.flux, stars.snr, sigma_x, sigma_y, stars.flags)
    return [list(row) for row in zip(*(c.tolist() for c in columns), strict=True)]
