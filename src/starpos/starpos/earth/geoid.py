# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical from a grid of geoid undulations, with an error for what the grid cannot resolve.

Grids are NOAA's GTX, NGS's .bin, and GeoTIFFs of one float band in geographic degrees, whose pixels OpenCV decodes.
Sources: GeoTIFF 1.1 (OGC 19-008r4), and PROJ's specification of geodetic TIFF grids for two tags of GDAL.
"""

import math
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.vertical import Deflection
from starpos.errors import GeoidError
from starpos.files import bytes_of, open_regular
from starpos.frames.pictures import BITS, HEIGHT, SAMPLES, WIDTH, decode_picture
from starpos.frames.tiff import TIFF_ORDERS, tiff_directory
from starpos.units import ARCSEC

PIXEL_SCALE, TIEPOINT, GEO_KEYS = 33550, 33922, 34735
GDAL_METADATA, GDAL_NODATA = 42112, 42113
# Two keys, and the value of each that is read.
MODEL_TYPE, RASTER_TYPE, GEOGRAPHIC, PIXEL_IS_POINT = 1024, 1025, 2, 2
# What a band of geoid undulations is called in GDAL's metadata.
UNDULATION = "geoid_undulation"
TAGS = (WIDTH, HEIGHT, BITS, SAMPLES, PIXEL_SCALE, TIEPOINT, GEO_KEYS, GDAL_METADATA, GDAL_NODATA)
MAX_VALUES = 1 << 20


def read_geotiff(data: bytes, most_bytes: int) -> tuple[np.ndarray, float, float, float, float]:
    """Values (rows, columns) float32, south and west of the first, and steps in latitude and in longitude, deg.

    data is the content of a file, and most_bytes what its values may unpack to. Rows run from south to north; NaN where
    the file has no data. GeoidError says why a file cannot be used.
    """
    tags = _tags(data)
    width, height = _number(tags, WIDTH), _number(tags, HEIGHT)
    bits = max(_number(tags, BITS, 1), 8)
    if not 0 < width * height * bits // 8 <= most_bytes:
        raise GeoidError(f"its header claims {width} x {height} nodes of {bits} bits")
    if _number(tags, SAMPLES, 1) != 1:
        raise GeoidError(f"it has {_number(tags, SAMPLES, 1)} bands: one, of undulations, is wanted")
    south, west, step_latitude, step_longitude = _corner(tags, height)
    _check_metadata(tags)
    values = decode_picture(data)
    if values is None or values.shape != (height, width):
        raise GeoidError("its pixels cannot be decoded: copy it again")
    if values.dtype not in (np.float32, np.float64):
        raise GeoidError(f"its pixels are {values.dtype}: convert it to 32-bit floats")
    nodata = _nodata(tags)
    if nodata is not None:
        values[values == values.dtype.type(nodata)] = np.nan
    return values.astype(np.float32, copy=False)[::-1], south, west, step_latitude, step_longitude


def _tags(data: bytes) -> dict[int, tuple]:
    """The tags of the first directory that are needed here; GeoidError if the file ends too early."""
    order = TIFF_ORDERS[data[:4]]
    try:
        (start,) = struct.unpack_from(order + "I", data, 4)
        tags, _ = tiff_directory(data, start, order, TAGS, MAX_VALUES + 1)
    except struct.error:
        raise GeoidError("it ends before its tags do: copy it again") from None
    for tag, values in tags.items():
        if len(values) > MAX_VALUES:
            raise GeoidError(f"its tag {tag} has more than {MAX_VALUES} values")
    return tags


def _number(tags: dict, tag: int, default: int = 0) -> int:
    values = tags.get(tag, (default,))
    return values[0] if len(values) == 1 and isinstance(values[0], int) else 0


def _text(tags: dict, tag: int) -> str:
    text = "".join(chr(c) for c in tags.get(tag, ()) if isinstance(c, int) and c < 128)
    return text.strip("\0 \n")


def _corner(tags: dict, height: int) -> tuple[float, float, float, float]:
    """Latitude and longitude of the south-western pixel's centre, and the steps in both, deg."""
    scale, tie = tags.get(PIXEL_SCALE, ()), tags.get(TIEPOINT, ())
    if len(scale) != 3 or len(tie) != 6 or not all(isinstance(v, float) for v in scale + tie):
        raise GeoidError(
            "it does not say where it lies (ModelPixelScale and one ModelTiepoint): is it a GeoTIFF?"
        )
    keys = tags.get(GEO_KEYS, ())
    of_key = {keys[i]: keys[i + 3] for i in range(4, len(keys) - 3, 4) if keys[i + 1] == 0}
    if of_key.get(MODEL_TYPE, GEOGRAPHIC) != GEOGRAPHIC:
        raise GeoidError("it lies in a map projection: a grid in latitude and longitude is wanted")
    centre = 0.0 if of_key.get(RASTER_TYPE) == PIXEL_IS_POINT else 0.5
    column, row, _, east, north, _ = tie
    west = east + (centre - column) * scale[0]
    return north - (height - 1 + centre - row) * scale[1], west, scale[1], scale[0]


def _check_metadata(tags: dict) -> None:
    """GeoidError if the metadata say that the values are not undulations in m."""
    text = _text(tags, GDAL_METADATA)
    items = dict(re.findall(r'<Item name="(\w+)"[^>]*>([^<]*)</Item>', text))
    kind = items.get("TYPE", "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
    if kind != "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL":
        raise GeoidError(f"it is a grid of {kind[:60]}: geoid undulations are wanted")
    # of the same type are heights of a tidal surface (hydroid_height), which is not level
    if (band := items.get("DESCRIPTION", UNDULATION).strip()) != UNDULATION:
        raise GeoidError(f"its band is {band[:60]!r}: one of {UNDULATION} is wanted")
    if items.get("SCALE", "1") not in ("1", "1.0") or items.get("OFFSET", "0") not in ("0", "0.0"):
        raise GeoidError(
            "its values have a SCALE or an OFFSET: gdal_translate -unscale -ot Float32 applies them"
        )


def _nodata(tags: dict) -> float | None:
    text = _text(tags, GDAL_NODATA)
    try:
        return float(text) if text else None
    except ValueError:
        raise GeoidError(f"its mark of no data is {text[:30]!r}, which is no number") from None


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
BIGTIFF_MAGIC = (b"II+\0", b"MM\0+")


# Nodes under the spline in each direction: with 8 its ends have no effect (0.27^8), with 2 it is a single cubic.
REACHES = (8, 4, 2)
# The error comes from the grid's roughness, the change of slope from node to node, within this distance and number of
# nodes in each direction,
ROUGH_DEG, ROUGH_NODES = 0.5, (8, 60)
# times this factor. With it the slopes of EGM96 differ from the national geoids of Australia, Austria, Iceland,
# the Netherlands, Poland, South Africa, Spain, Switzerland and the USA by 0.3 (islands of the USA) to 1.2 (Iceland)
# sigma, root mean square (tools/data/geoid_sigma.py).
UNRESOLVED = 1.5
FLOOR_ARCSEC = 0.5
# Closer to a pole than this, converging meridians distort the estimate of the geoid's roughness.
ROUGH_NORTH_DEG = 87.0
# 111 m from a pole; closer, east and west have no meaning.
NEAREST_POLE_DEG = 1e-3
WIDEST_STRIDE_DEG = 10.0
# Larger values come from an edge of the data; the Earth's own deflections stay below 100.
LARGEST_ARCSEC = 120.0


@dataclass(frozen=True, eq=False)
class Geoid:
    """A grid of geoid undulations on WGS 84, and the deflections of the vertical from it.

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

    def at(self, latitude: float, longitude: float) -> Deflection:
        """The Deflection at a place in rad; the default Deflection, of unknown value, if the grid has no data there.

        xi = -dN / (M dphi), eta = -dN / (N' cos(phi) dlambda): Heiskanen & Moritz, Physical Geodesy (1967), section 2-22,
        with the radii M, N' of WGS 84 and a cubic spline through the nodes. Undulations N are heights of the geoid above
        the ellipsoid, so these are deflections at the geoid, under the ground; `vertical.AtHeight` takes them up to the
        instrument, by the curvature of normal plumb lines. (Some national grids are of a quasi-geoid. Its undulations are
        height anomalies, which belong to the ground, but are against normal gravity there: the same curvature is
        missing.) In mountains real plumb lines curve by some arcseconds more. No geoid grid shows that; the stated error
        includes it. An astronomic place may be given for a geodetic one: 10 arcsec (300 m) make no difference.
        """
        phi = np.clip(np.degrees(latitude), NEAREST_POLE_DEG - 90, 90 - NEAREST_POLE_DEG)
        lam = np.degrees(longitude)
        if not np.isfinite([phi, lam]).all():
            return Deflection()
        xi, eta = self._slopes(phi, lam)
        stddev = math.hypot(FLOOR_ARCSEC, UNRESOLVED * self._roughness(phi, lam))
        # false for NaN too
        if not all(abs(v) < LARGEST_ARCSEC for v in (xi, eta, stddev)):
            return Deflection()
        return Deflection(xi, eta, stddev)

    def _slopes(self, phi: float, lam: float) -> tuple[float, float]:
        """Components xi and eta in arcsec, by a spline of the undulations around a place; NaN without data."""
        # slow to import, and only needed with a grid
        from scipy.interpolate import RectBivariateSpline

        north_m, east_m, stride = self._spacing_m(phi)
        for reach in REACHES:
            nodes, row, column = self._window(phi, lam, reach, reach, stride)
            if np.isfinite(nodes).all():
                at = np.arange(2 * reach)
                spline = RectBivariateSpline(at, at, nodes)
                xi, eta = -spline(row, column, dx=1) / north_m, -spline(row, column, dy=1) / east_m
                return float(xi.item() / ARCSEC), float(eta.item() / ARCSEC)
        return math.nan, math.nan

    def _roughness(self, phi: float, lam: float) -> float:
        """Root mean square change of the slope from node to node around a place, arcsec; NaN without data."""
        phi = np.clip(phi, -ROUGH_NORTH_DEG, ROUGH_NORTH_DEG)
        north_m, east_m, stride = self._spacing_m(phi)
        up = int(np.clip(round(ROUGH_DEG / self.step_latitude), *ROUGH_NODES))
        across = max(ROUGH_NODES[0], round(up * north_m / east_m))
        nodes, _, _ = self._window(phi, lam, up, across, stride)
        north = np.diff(nodes, 2, axis=0)[:, 1:-1] / north_m**2
        east = np.diff(nodes, 2, axis=1)[1:-1] / east_m**2
        bends = np.concatenate([north.ravel(), east.ravel()])
        bends = bends[np.isfinite(bends)]
        return float(np.sqrt(np.mean(bends**2)) * north_m / ARCSEC) if bends.size else math.nan

    def _spacing_m(self, phi: float) -> tuple[float, float, int]:
        """Distances (m) between nodes to the north and to the east, and the number of columns from one to the next.

        It is more than 1 near the poles, where columns are so close that the rounding of the file would make slopes.
        """
        prime, meridian = curvature_radii_m(np.radians(phi))
        north_m = meridian * np.radians(self.step_latitude)
        column_m = prime * np.cos(np.radians(phi)) * np.radians(self.step_longitude)
        widest = max(1, int(WIDEST_STRIDE_DEG / self.step_longitude))
        stride = int(np.clip(np.ceil(0.1 * north_m / column_m), 1, widest))
        return north_m, stride * column_m, stride

    def _window(
        self, phi: float, lam: float, up: int, across: int, stride: int
    ) -> tuple[np.ndarray, float, float]:
        """Undulations (2 up, 2 across) around a place, NaN where unknown, and row and column of the place in them."""
        row, column = self.locate(phi, lam)
        rows = np.arange(1 - up, 1 + up) + math.floor(row)
        columns = np.arange(1 - across, 1 + across) * stride + math.floor(column)
        nodes = self.undulations(rows, columns)
        return nodes, row - rows[0], (column - columns[0]) / stride


def read(path: Path | str) -> Geoid:
    """Read a Geoid from a GTX, .bin (NGS) or GeoTIFF file; GeoidError says why a file cannot be used.

    A file name without a folder is also looked for among PROJ's grids.
    """
    path = find(path)
    try:
        with open_regular(path) as file:
            start = file.read(4)
            if start in TIFF_ORDERS:
                return Geoid(*read_geotiff(bytes_of(file, MAX_BYTES), MAX_BYTES))
            if start in BIGTIFF_MAGIC:
                raise GeoidError(
                    "it is a BigTIFF, which is not read: gdal_translate -co BIGTIFF=NO makes a TIFF of it"
                )
            return Geoid(*_read_plain(file))
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
    if head.startswith(b"P5"):
        raise GeoidError("it is a PGM, as GeographicLib has them: give the same geoid as a GTX or GeoTIFF")
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
