# SPDX-License-Identifier: Apache-2.0
"""Tables of a night on disk: star lists, a plate solver's pointings, and the names of files next to the frames."""

import io
import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.errors import FrameError
from starpos.files import bytes_of
from starpos.frames.exposure import Exposure
from starpos.frames.frame import Stars
from starpos.frames.header import focal_mm, fwhm_px, read_exposure
from starpos.tables import TableForm
from starpos.units import ARCSEC

# readings of the inclinometer; fixes of a GNSS receiver; true values of the night
TILTS, GNSS, TRUTH = "tilt.csv", "gnss.csv", "truth.json"
# in truth.json, of a simulated night: its other files, each with the digest of what was written
SIMULATED = "simulated_files"
# of a list of stars or of pointings
MAX_CSV_BYTES = 20_000_000
# Error of a centroid if its file gives no sigma.
DEFAULT_SIGMA_PX = 0.1
STAR_LIST = TableForm(
    what="list of stars",
    error=FrameError,
    needed=("x", "y", "flux"),
    optional=("sigma", "flags"),
    limits={"sigma": (1e-6, 1e3)},
    may_be_empty=True,
)


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
    rest, counted_from, in_magnitudes = _as_ours(rest)
    table = STAR_LIST.read_text(io.StringIO(rest), place, before=1)
    column, sigma = dict(table.columns), table.column("sigma", DEFAULT_SIGMA_PX)
    column["x"], column["y"] = column["x"] - counted_from, column["y"] - counted_from
    if in_magnitudes:
        column["flux"] = 10 ** (-0.4 * np.clip(column["flux"], -50, 50))
    order = np.argsort(-column["flux"], kind="stable")
    return Stars(
        x=column["x"][order],
        y=column["y"][order],
        flux=column["flux"][order],
        snr=1.0 / sigma[order],
        covariance=(sigma[order] ** 2)[:, None, None] * np.eye(2),
        flags=table.column("flags", 0.0)[order],
        width=width,
        height=height,
        fwhm_px=fwhm_px(header),
        **read_exposure(header, place).facts,
    )


# Names that programs give to a star's place, and from where they count the first pixel's centre: SExtractor, IRAF's
# daofind, photutils' DAOStarFinder. Names of their
# fluxes, and of their magnitudes, where there is no flux.
PLACES = {
    ("x_image", "y_image"): 1.0,
    ("xcenter", "ycenter"): 1.0,
    ("xcentroid", "ycentroid"): 0.0,
    ("x_centroid", "y_centroid"): 0.0,
}
FLUXES = ("flux", "flux_auto", "flux_best", "flux_iso", "flux_aper", "flux_psf")
MAGNITUDES = ("mag", "mag_auto", "mag_best", "mag_iso", "mag_aper", "mag_psf")


# A line of the head that SExtractor writes as ASCII_HEAD: a column's number, its name, what it is.
HEAD_LINE = re.compile(r"# +(\d+) +(\w+)", re.ASCII)


def _of_ascii_head(rows: str) -> str:
    """Rows with SExtractor's ASCII_HEAD as CSV; others as they are."""
    head = HEAD_LINE.match(rows)
    if head is None:
        return rows
    lines = rows.splitlines()
    named = {int(m[1]): m[2] for m in map(HEAD_LINE.match, lines) if m}
    cells = [line.split() for line in lines if line and not line.startswith("#")]
    # an array has one name and several columns
    names = [named.get(k + 1, f"column_{k + 1}") for k in range(max(map(len, cells), default=max(named)))]
    return "\n".join(map(",".join, [names, *cells])) + "\n"


def _as_ours(rows: str) -> tuple[str, float, bool]:
    """Rows of stars under our own names of columns.

    Also what x and y of the first pixel's centre are in them, and whether their light is a magnitude.
    """
    rows = _of_ascii_head(rows)
    names, line, rest = rows.partition("\n")
    given = [name.strip('" \t\r').lower() for name in names.lstrip("# ").split(",")]
    for place, counted_from in PLACES.items():
        if set(place) <= set(given) and not {"x", "y"} & set(given):
            light = next((name for name in (*FLUXES, *MAGNITUDES) if name in given), "flux")
            # their flags have other meanings
            ours = {**dict(zip(place, "xy", strict=True)), light: "flux", "flags": "their_flags"}
            text = ",".join(ours.get(name, name) for name in given) + line + rest
            return text, counted_from, light in MAGNITUDES
    return rows, 0.0, False


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
    rows = "".join(
        f"{x:.5f},{y:.5f},{f:.2f},{s:.5f},{flags}\n"
        for x, y, f, s, flags in zip(stars.x, stars.y, stars.flux, stars.sigma, stars.flags, strict=True)
    )
    Path(path).write_text(f"# {json.dumps(header)}\nx,y,flux,sigma,flags\n{rows}", encoding="utf-8")


# limits of a stated sigma: with an error of a degree a pointing is useless, an error of 0 is a mistake
MIN_ARCSEC, MAX_ARCSEC = 1e-4, 3600.0
MAX_ROLL_ARCSEC = 36_000.0
POINTINGS = TableForm(
    what="table of pointings",
    error=FrameError,
    needed=("utc_unix_s", "ra_deg", "dec_deg", "sigma_arcsec"),
    optional=("roll_deg", "sigma_roll_arcsec", "exposure_s"),
    limits={
        "utc_unix_s": (-1e11, 1e11),
        "ra_deg": (-360.0, 360.0),
        "dec_deg": (-90.0, 90.0),
        "roll_deg": (-360.0, 360.0),
        "sigma_arcsec": (MIN_ARCSEC, MAX_ARCSEC),
        "sigma_roll_arcsec": (MIN_ARCSEC, MAX_ROLL_ARCSEC),
        "exposure_s": (0.0, 3600.0),
    },
    most_bytes=MAX_CSV_BYTES,
)


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
    table = POINTINGS.read(path)
    roll, sigma_roll = table.column("roll_deg"), table.column("sigma_roll_arcsec")
    for line in table.lines[np.isnan(roll) != np.isnan(sigma_roll)][:1]:
        raise FrameError(
            f"{path}:{line}: roll_deg and sigma_roll_arcsec belong together; give both or neither"
        )
    sigma, sigma_roll = table.columns["sigma_arcsec"] * ARCSEC, sigma_roll * ARCSEC
    ra, dec, roll = np.radians([table.columns["ra_deg"], table.columns["dec_deg"], roll])
    exposure_s = table.column("exposure_s")
    return [
        Pointing(
            mid_unix_s=float(utc_unix_s),
            exposure_s=None if math.isnan(exposure_s[k]) else float(exposure_s[k]),
            source=f"{path}:{table.lines[k]}",
            ra=float(ra[k]),
            dec=float(dec[k]),
            sigma=float(sigma[k]),
            roll=float(roll[k]),
            sigma_roll=float(sigma_roll[k]),
        )
        for k, utc_unix_s in enumerate(table.columns["utc_unix_s"])
    ]
