# SPDX-License-Identifier: Apache-2.0
"""`starpos detect`: the stars of frames."""

import argparse
from typing import TYPE_CHECKING

from starpos.cli import console, inputs
from starpos.errors import FrameError
from starpos.frames.frame import Stars
from starpos.night.reading import Reader
from starpos.night.work import detected

if TYPE_CHECKING:
    from starpos.detection import Detection


def run(args: argparse.Namespace) -> int:
    output = console.Output(args, "stars")
    args.frames = inputs.frames_among(args.frames)
    status = 0
    for path, answer in inputs.each_of(args, Reader(), args.frames)(detected):
        if isinstance(answer, FrameError):
            status = console.UNREADABLE
        _tell(path, answer, output)
    return status


def _tell(path: str, answer: "tuple[Detection | Stars, float] | FrameError", output: console.Output) -> None:
    if isinstance(answer, FrameError):
        console.complain(answer)
        output.put(
            {"file": path, "stars": [], "cpu_ms": 0.0, "negative": False, "status": "bad input"}, "", ()
        )
        return
    found, cpu_ms = answer
    stars, left_out = (found, 0) if isinstance(found, Stars) else (found.stars, found.left_out)
    rows = _rows(stars)
    value = {"file": path, "stars": rows, "cpu_ms": cpu_ms, "negative": stars.negative}
    value |= {"left_out": left_out} if left_out else {}
    output.put(
        value,
        _line(path, found, cpu_ms),
        [dict(zip(output.columns, (path, *row), strict=True)) for row in rows],
    )


def _line(path: str, found: "Detection | Stars", cpu_ms: float) -> str:
    if isinstance(found, Stars):
        return f"{path}: a list of {len(found)} stars"
    cut = f"; {found.left_out} fainter peaks were too many and are left out" if found.left_out else ""
    cut += "; a negative: its stars are dark" if found.stars.negative else ""
    return (
        f"{path}: {len(found.stars)} stars, background {found.background:.1f} DN, noise {found.noise:.2f} DN, "
        f"FWHM {found.fwhm_px:.2f} px, chi2 {found.typical_chi2:.2f}, {cpu_ms:.0f} ms{cut}"
    )


def _rows(stars: Stars) -> list[list[float]]:
    sigma_x, sigma_y = stars.covariance[:, 0, 0] ** 0.5, stars.covariance[:, 1, 1] ** 0.5
    columns = (stars.x, stars.y, stars.flux, stars.snr, sigma_x, sigma_y, stars.flags)
    return [list(row) for row in zip(*(c.tolist() for c in columns), strict=True)]
