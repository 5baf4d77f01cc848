# SPDX-License-Identifier: Apache-2.0
"""Star lists on disk: a CSV of centroids, read and written."""

import csv
import json
import reprlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.files import bytes_of
from starpos.frames.header import about, focal_mm, fwhm_px
from starpos.frames.stars import Stars

MAX_CSV_BYTES = 20_000_000
# Error of a centroid if its file gives no sigma.
DEFAULT_SIGMA_PX = 0.1


def read_star_list(file: BinaryIO, place: str) -> Stars:
    """Read Stars from an open CSV by the rules of `reading.read_frame`; FrameError if it is not one.

    place says where it is, for messages. OSError if it is larger than MAX_CSV_BYTES.
    """
    try:
        text = bytes_of(file, MAX_CSV_BYTES).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        raise FrameError(f"{place}: this is not a text file; give a CSV of centroids.") from None
    first, _, rest = text.partition("\n")
    try:
        header = json.loads(first.removeprefix("#"))
        width, height = header["NAXIS1"], header["NAXIS2"]
        if not first.startswith("#") or not isinstance(width, int) or not isinstance(height, int):
            raise ValueError
    except (ValueError, KeyError, TypeError, RecursionError):
        line = '# {"NAXIS1": 5616, "NAXIS2": 3744, "DATE-OBS": "...", "EXPTIME": 0.5}'
        raise FrameError(
            f"{place}: its first line does not give the frame's size; write it like {line}."
        ) from None
    try:
        rows = [row for row in csv.reader(rest.splitlines()) if row]
    except csv.Error as e:
        raise FrameError(f"{place}: this is not a CSV ({one_line(e)}); write one star a line.") from None
    names = [name.strip().lower() for name in rows[0]] if rows else []
    if not {"x", "y", "flux"} <= set(names):
        raise FrameError(
            f"{place}: its second line names the columns {reprlib.repr(names)}; it must name x, y, flux."
        )
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:]]).reshape(-1, len(names))
        if len(table) != len(rows) - 1:
            raise ValueError
    except ValueError:
        raise FrameError(f"{place}: a row is not {len(names)} numbers; write one star a line.") from None
    column = dict(zip(names, table.T, strict=True))
    sigma = column.get("sigma", np.full(len(table), DEFAULT_SIGMA_PX))
    if not np.all((sigma > 0) & (sigma < 1e3)):
        raise FrameError(
            f"{place}: a star's sigma is not between 0 and 1000 px; correct or remove the column."
        )
    order = np.argsort(-column["flux"], kind="stable")
    return Stars(
        x=column["x"][order],
        y=column["y"][order],
        flux=column["flux"][order],
        snr=1.0 / sigma[order],
        covariance=(sigma[order] ** 2)[:, None, None] * np.eye(2),
        flags=column.get("flags", np.zeros(len(table)))[order],
        width=width,
        height=height,
        fwhm_px=fwhm_px(header),
        **about(header, place),
    )


def write_star_list(path: Path | str, stars: Stars, start_utc: str, pixel_um: float = 1.0) -> None:
    """Write a list of stars as CSV, in the form that `read_frame` reads.

    pixel_um: with the focal length in px it makes FOCALLEN, mm; a list of stars without a focal length states neither.
    """
    header = {
        "DATE-OBS": start_utc,
        "EXPTIME": stars.exposure_s,
        "NAXIS1": stars.width,
        "NAXIS2": stars.height,
    }
    if stars.focal_px is not None:
        header |= {"FOCALLEN": focal_mm(stars.focal_px, pixel_um), "XPIXSZ": pixel_um}
    if stars.shutter is not None:
        header["ROLLSHUT"] = stars.shutter.readout_s
    if stars.fwhm_px is not None:
        header["FWHM"] = round(stars.fwhm_px, 3)
    sigma = np.sqrt(np.trace(stars.covariance, axis1=1, axis2=2) / 2)
    rows = "".join(
        f"{x:.5f},{y:.5f},{f:.2f},{s:.5f},{flags}\n"
        for x, y, f, s, flags in zip(stars.x, stars.y, stars.flux, sigma, stars.flags, strict=True)
    )
    Path(path).write_text(f"# {json.dumps(header)}\nx,y,flux,sigma,flags\n{rows}")
