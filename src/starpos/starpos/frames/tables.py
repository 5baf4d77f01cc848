# SPDX-License-Identifier: Apache-2.0
"""Tables of a night on disk: star lists, a plate solver's pointings, and the names of files next to the frames."""

import csv
import json
import math
import reprlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.errors import FrameError, one_line
from starpos.files import bytes_of, read_regular
from starpos.frames.exposure import Exposure
from starpos.frames.frame import Stars
from starpos.frames.header import focal_mm, fwhm_px, read_exposure
from starpos.units import ARCSEC

# readings of the inclinometer; fixes of a GNSS receiver; true values of the night
TILTS, GNSS, TRUTH = "tilt.csv", "gnss.csv", "truth.json"
# in truth.json, of a simulated night: its other files, each with the digest of what was written
SIMULATED = "simulated_files"
# of a list of stars or of pointings
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
        **read_exposure(header, place).facts,
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


MAX_ROWS = 100_000
NEEDED = ("utc_unix_s", "ra_deg", "dec_deg", "sigma_arcsec")
ROLL = ("roll_deg", "sigma_roll_arcsec")
# limits of a stated sigma: with an error of a degree a pointing is useless, an error of 0 is a mistake
MIN_ARCSEC, MAX_ARCSEC = 1e-4, 3600.0
MAX_ROLL_ARCSEC = 36_000.0
# what each column may hold, in its own unit
LIMITS = {
    "utc_unix_s": (-1e11, 1e11),
    "ra_deg": (-360.0, 360.0),
    "dec_deg": (-90.0, 90.0),
    "roll_deg": (-360.0, 360.0),
    "sigma_arcsec": (MIN_ARCSEC, MAX_ARCSEC),
    "sigma_roll_arcsec": (MIN_ARCSEC, MAX_ROLL_ARCSEC),
    "exposure_s": (0.0, 3600.0),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Pointing(Exposure):
    """ICRS place of a frame's centre at the middle of its exposure, as a plate solver has it without refraction.

    ra, dec     rad, of the star that is seen at the frame's centre
    sigma       rad, of the centre along each of two axes on the sky
    roll        rad, position angle of the frame's top from north over east; NaN: unknown
    sigma_roll  rad, of the turn about the centre
    """

    ra: float
    dec: float
    sigma: float
    roll: float = float("nan")
    sigma_roll: float = float("nan")

    @property
    def has_roll(self) -> bool:
        """Whether the whole attitude is known."""
        return not math.isnan(self.roll)


def read_pointings(path: Path | str) -> list[Pointing]:
    """Read a CSV whose first line names utc_unix_s, ra_deg, dec_deg, roll_deg, sigma_arcsec, sigma_roll_arcsec.

    The columns of the roll may be empty or absent, exposure_s may be added; other columns are not read.
    `source` of a pointing: the table and the line.  FrameError says why a table cannot be used.
    """
    try:
        text = read_regular(path, MAX_CSV_BYTES).decode("utf-8-sig")
    except OSError as e:
        raise FrameError(f"{path}: no readable table of pointings ({e.strerror})") from None
    except UnicodeDecodeError:
        raise FrameError(f"{path}: this is not a text file; give a CSV of pointings") from None
    try:
        lines = csv.reader(text.splitlines())
        rows = [(lines.line_num, row) for row in lines if any(cell.strip() for cell in row)]
    except csv.Error as e:
        raise FrameError(f"{path}: this is not a CSV ({one_line(e)}); write one pointing a line") from None
    names = [name.strip().lower() for name in rows[0][1]] if rows else []
    if names:
        names[0] = names[0].lstrip("# ")
    if not set(NEEDED) <= set(names) or len(set(names)) < len(names) or len(rows) < 2:
        raise FrameError(
            f"{path}: a table of pointings needs a first line with the names {', '.join(NEEDED)}, and may have "
            f"{', '.join(ROLL)}, exposure_s, each once, and a row a frame"
        )
    if len(rows) - 1 > MAX_ROWS:
        raise FrameError(f"{path}: {len(rows) - 1} pointings, of which {MAX_ROWS} are read: split the table")
    return [_pointing(f"{path}:{number}", dict(zip(names, row, strict=False)), len(row) == len(names))
            for number, row in rows[1:]]  # fmt: skip


def _pointing(source: str, row: dict[str, str], whole: bool) -> Pointing:
    if not whole:
        raise FrameError(
            f"{source}: the row has not as many cells as there are columns; write one pointing a line"
        )
    value = {name: _number(source, name, row[name]) for name in LIMITS if name in row}
    if missing := next((name for name in NEEDED if math.isnan(value[name])), None):
        raise FrameError(f"{source}: {missing} is empty; leave such a row out")
    roll, sigma_roll = (value.get(name, math.nan) for name in ROLL)
    if math.isnan(roll) != math.isnan(sigma_roll):
        raise FrameError(f"{source}: roll_deg and sigma_roll_arcsec belong together; give both or neither")
    exposure_s = value.get("exposure_s", math.nan)
    return Pointing(
        mid_unix_s=value["utc_unix_s"],
        exposure_s=None if math.isnan(exposure_s) else exposure_s,
        source=source,
        ra=math.radians(value["ra_deg"]),
        dec=math.radians(value["dec_deg"]),
        sigma=value["sigma_arcsec"] * ARCSEC,
        roll=math.radians(roll),
        sigma_roll=sigma_roll * ARCSEC,
    )


def _number(source: str, name: str, cell: str) -> float:
    """The number in a cell; NaN if it is empty."""
    low, high = LIMITS[name]
    try:
        value = float(cell) if cell.strip() else math.nan
        if cell.strip() and not low <= value <= high:
            raise ValueError
    except ValueError:
        raise FrameError(
            f"{source}: {name} is {one_line(repr(cell))}; give a number from {low:g} to {high:g}"
        ) from None
    return value
