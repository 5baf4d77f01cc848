# SPDX-License-Identifier: Apache-2.0
"""Pointings that a plate solver found for frames: a CSV with a row a frame, read with the care that frames are."""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

from starpos.errors import FrameError, one_line
from starpos.files import read_regular
from starpos.frames.exposure import Exposure
from starpos.units import ARCSEC

MAX_CSV_BYTES, MAX_ROWS = 20_000_000, 100_000
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
