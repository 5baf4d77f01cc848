# SPDX-License-Identifier: Apache-2.0
"""Grids of geoid undulations: NOAA's GTX, NGS's .bin and PROJ's GeoTIFF (its specification of geodetic TIFF grids)."""

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.earth.geotiff import read_geotiff
from starpos.errors import GeoidError
from starpos.files import bytes_of, open_regular

# South, west, step in latitude, step in longitude (deg), rows, columns: the whole header of a GTX, always big endian.
GTX_HEADER = struct.Struct(">4d2i")
# In a .bin of NGS one word follows: the kind of its values, of which there is one, REAL*4. NGS gives both byte orders.
NGS_KIND, REAL4 = "i", 1
BYTE_ORDERS = "><"
GTX_NODATA = np.float32(-88.8888)
# A grid of the whole globe with 1 arcmin has 233 million nodes of 4 bytes.
MAX_BYTES = 1_200_000_000
MIN_NODES = 4
STEPS_DEG = (1e-4, 2.0)
# Undulations are -107 to 86 m; a value beyond this limit means "no data".
UNDULATION_LIMIT_M = 150.0
PROJ_FOLDERS = ("/usr/share/proj", "/usr/local/share/proj")
TIFF_MAGIC = (b"II*\0", b"MM\0*")
BIGTIFF_MAGIC = (b"II+\0", b"MM\0+")


@dataclass(frozen=True, eq=False)
class Grid:
    """Geoid undulations on WGS 84.

    values       (rows, columns) float32 m, southernmost row and westernmost column first
    south, west  latitude and longitude of the first node, deg
    step_...     distances between nodes, deg, positive

    GeoidError if the grid cannot lie on the globe or holds no undulations.
    """

    values: np.ndarray
    south: float
    west: float
    step_latitude: float
    step_longitude: float

    def __post_init__(self) -> None:
        rows, columns = self.values.shape
        steps = self.step_latitude, self.step_longitude
        if not np.isfinite([self.south, self.west, *steps]).all():
            raise GeoidError("its corner or spacing is not a finite number")
        if min(rows, columns) < MIN_NODES:
            raise GeoidError(
                f"{columns} x {rows} nodes are too few for slopes: {MIN_NODES} each way are the least"
            )
        if not STEPS_DEG[0] <= min(steps) <= max(steps) <= STEPS_DEG[1]:
            raise GeoidError(
                f"its nodes are {steps[0]:g} and {steps[1]:g} deg apart: {STEPS_DEG[0]:g} to {STEPS_DEG[1]:g} can be used"
            )
        north, turn = self.south + (rows - 1) * steps[0], columns * steps[1]
        if (
            min(self.south, -north) < -90 - 0.01 * steps[0]
            or abs(self.west) > 540
            or turn > 360 + 1.01 * steps[1]
        ):
            raise GeoidError(
                f"it claims latitudes {self.south:g} to {north:g} and {turn:g} deg of longitude from {self.west:g}: "
                "these are no degrees on the globe"
            )
        sample = self._known(self.values[:: max(1, rows // 300), :: max(1, columns // 300)])
        if not np.isfinite(sample).any():
            raise GeoidError(
                f"none of its values is a geoid undulation, which lie within {UNDULATION_LIMIT_M:g} m of 0"
            )

    @property
    def _around(self) -> int:
        """Number of columns in 360 deg; 0 if the grid does not go around the globe."""
        turn = round(360 / self.step_longitude)
        whole = abs(turn * self.step_longitude - 360) < 0.01 * self.step_longitude
        return turn if whole and self.values.shape[1] >= turn else 0

    def locate(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Row and column of a place in deg, with fractions; negative or too large outside the grid."""
        east = (longitude - self.west) % 360
        return (latitude - self.south) / self.step_latitude, east / self.step_longitude

    def undulations(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Undulations (R, C) in m at rows (R,) and columns (C,), NaN where unknown.

        A grid around the globe continues across its seam, and across a pole if its rows reach it.
        """
        rows, over = self._over_the_poles(rows)
        columns = columns[None, :] + over[:, None] * (self._around // 2)
        if self._around:
            columns = columns % self._around
        height, width = self.values.shape
        inside = (rows >= 0)[:, None] & (rows < height)[:, None] & (columns >= 0) & (columns < width)
        taken = self.values[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)]
        return np.where(inside, self._known(taken), np.nan)

    def _over_the_poles(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (R,), with those beyond a pole replaced by the rows half a turn away, and which rows these are (R,)."""
        last = len(self.values) - 1
        if self._around % 2 or not self._around:
            return rows, np.zeros(rows.shape, bool)
        south, north = ((pole - 2 * self.south) / self.step_latitude for pole in (-180, 180))
        beyond = np.zeros(rows.shape, bool)
        # a pole lies on a row (south is 0, north is 2 last) or half a row beyond it (south is -1, north is 2 last + 1)
        if min(abs(south), abs(south + 1)) < 0.01:
            beyond |= rows < 0
            rows = np.where(rows < 0, round(south) - rows, rows)
        if min(abs(north - 2 * last), abs(north - 2 * last - 1)) < 0.01:
            over = rows > last
            beyond |= over
            rows = np.where(over, round(north) - rows, rows)
        return rows, beyond

    @staticmethod
    def _known(values: np.ndarray) -> np.ndarray:
        known = (np.abs(values) < UNDULATION_LIMIT_M) & (values != GTX_NODATA)
        return np.where(known, values, np.nan).astype(float)


def read_grid(path: Path | str) -> Grid:
    """Read a Grid from a GTX, .bin (NGS) or GeoTIFF file; GeoidError says why a file cannot be used."""
    path = find(path)
    try:
        with open_regular(path) as file:
            start = file.read(4)
            if start in TIFF_MAGIC:
                return Grid(*read_geotiff(bytes_of(file, MAX_BYTES), MAX_BYTES))
            if start in BIGTIFF_MAGIC:
                raise GeoidError(
                    "it is a BigTIFF, which is not read: gdal_translate -co BIGTIFF=NO makes a TIFF of it"
                )
            return Grid(*_read_plain(file))
    except OSError as e:
        raise GeoidError(
            f"{path}: the geoid grid cannot be read ({e.strerror or e}): give a GTX, NGS .bin or GeoTIFF file"
        ) from None
    except GeoidError as e:
        raise GeoidError(f"{path}: no geoid grid that can be used: {e}") from None


def find(path: Path | str) -> Path:
    """The path itself, or, for a file name without a folder that does not exist here, its place among PROJ's grids."""
    path = Path(path)
    # not Path.exists, which raises if a name is too long
    if len(path.parts) != 1 or os.path.exists(path):
        return path
    told = [
        folder for name in ("PROJ_DATA", "PROJ_LIB") for folder in os.environ.get(name, "").split(os.pathsep)
    ]
    places = [Path(folder) / path for folder in (*filter(None, told), *PROJ_FOLDERS)]
    return next((place for place in places if os.path.isfile(place)), path)


def _read_plain(file: BinaryIO) -> tuple[np.ndarray, float, float, float, float]:
    """Values, south, west and steps of an open GTX or .bin file: rows from south to north after a short header.

    The values stay in the file until they are used.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(GTX_HEADER.size + struct.calcsize(NGS_KIND))
    if len(head) < GTX_HEADER.size:
        raise GeoidError("it is shorter than a header")
    order, start = _ngs_order(head, size), len(head)
    if not order:
        order, start = ">", GTX_HEADER.size
    south, west, step_latitude, step_longitude, rows, columns = struct.unpack_from(order + "4d2i", head)
    if rows <= 0 or columns <= 0 or 4 * rows * columns > MAX_BYTES:
        raise GeoidError(
            f"its header claims {columns} x {rows} nodes: is it a GTX, NGS .bin or GeoTIFF file?"
        )
    missing = start + 4 * rows * columns - size
    if missing > 0:
        raise GeoidError(f"{missing} bytes are missing at its end: copy it again")
    values = np.memmap(file, f"{order}f4", "r", start, (rows, columns))
    return values, south, west, step_latitude, step_longitude


def _ngs_order(head: bytes, size: int) -> str:
    """The byte order of a .bin of NGS whose file has this size; '' of another file.

    A GTX that is read as one would have a first value of 1e-45 m, and four bytes too many.
    """
    for order in BYTE_ORDERS:
        layout = struct.Struct(order + "4d2i" + NGS_KIND)
        if len(head) == layout.size:
            *_, rows, columns, kind = layout.unpack(head)
            if kind == REAL4 and rows > 0 and columns > 0 and size == layout.size + 4 * rows * columns:
                return order
    return ""
