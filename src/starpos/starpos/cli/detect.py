# SPDX-License-Identifier: Apache-2.0
"""`starpos detect`: the stars of frames."""

import time

from starpos.cli import common
from starpos.detection import detect
from starpos.errors import FrameError
from starpos.stars import Stars


def define(parser) -> None:
    common.add_frames(parser)
    parser.set_defaults(run=run)


def run(args) -> int:
    status = 0
    for path, item in common.frames_of(args.frames):
        if isinstance(item, FrameError):
            common.complain("detect", item)
            status = common.UNREADABLE
            if args.json:
                common.print_json({"file": path, "stars": [], "cpu_ms": 0.0, "status": "bad input"})
            continue
        begin = time.process_time()
        found = None if isinstance(item, Stars) else detect(item)
        stars = found.stars if found else item
        cpu_ms = 1000 * (time.process_time() - begin)
        if args.json:
            common.print_json({"file": path, "stars": _rows(stars), "cpu_ms": cpu_ms})
        elif found:
            print(
                f"{path}: {len(stars)} stars, background {found.background:.1f} DN, noise {found.noise:.2f} DN, "
                f"FWHM {found.fwhm_px:.2f} px, {cpu_ms:.0f} ms"
            )
        else:
            print(f"{path}: a list of {len(stars)} stars")
    return status


def _rows(stars: Stars) -> list[list[float]]:
    sigma_x, sigma_y = stars.covariance[:, 0, 0] ** 0.5, stars.covariance[:, 1, 1] ** 0.5
    columns = (stars.x, stars.y, stars.flux, stars.snr, sigma_x, sigma_y, stars.flags)
    return [list(row) for row in zip(*(c.tolist() for c in columns), strict=True)]
