# SPDX-License-Identifier: Apache-2.0
"""Read a GeoTIFF of one float band in geographic degrees: OpenCV decodes the pixels, this module reads their places.

Sources: GeoTIFF 1.1 (OGC 19-008r4), and PROJ's specification of geodetic TIFF grids for two tags of GDAL.
"""

import math
import re
import struct

import numpy as np

from starpos.errors import GeoidError
from starpos.frames.pictures import decode_picture

WIDTH, HEIGHT, BITS, SAMPLES = 256, 257, 258, 277
PIXEL_SCALE, TIEPOINT, GEO_KEYS = 33550, 33922, 34735
GDAL_METADATA, GDAL_NODATA = 42112, 42113
# Two keys, and the value of each that is read.
MODEL_TYPE, RASTER_TYPE, GEOGRAPHIC, PIXEL_IS_POINT = 1024, 1025, 2, 2
# What a band of geoid undulations is called in GDAL's metadata.
UNDULATION = "geoid_undulation"
# The types of these tags: BYTE, ASCII, SHORT, LONG, DOUBLE.
KINDS = {1: "B", 2: "s", 3: "H", 4: "I", 12: "d"}
MAX_TAG_BYTES = 1 << 20


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
    scale, offset = _metadata(tags)
    values = decode_picture(data)
    if values is None or values.shape != (height, width):
        raise GeoidError("its pixels cannot be decoded: copy it again")
    if values.dtype not in (np.float32, np.float64):
        raise GeoidError(f"its pixels are {values.dtype}: convert it to 32-bit floats")
    nodata = _nodata(tags)
    if nodata is not None:
        values[values == values.dtype.type(nodata)] = np.nan
    if (scale, offset) != (1.0, 0.0):
        values = values * values.dtype.type(scale) + values.dtype.type(offset)
    return values.astype(np.float32, copy=False)[::-1], south, west, step_latitude, step_longitude


def _tags(data: bytes) -> dict[int, tuple]:
    """The tags of the first directory that are needed here; GeoidError if the file ends too early."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (start,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, start)
        entries = [struct.unpack_from(order + "HHI", data, start + 2 + 12 * i) for i in range(count)]
        found = {}
        for i, (tag, kind, n) in enumerate(entries):
            if tag not in (
                WIDTH,
                HEIGHT,
                BITS,
                SAMPLES,
                PIXEL_SCALE,
                TIEPOINT,
                GEO_KEYS,
                GDAL_METADATA,
                GDAL_NODATA,
            ):
                continue
            size = struct.calcsize(KINDS.get(kind, "B")) * n
            if kind not in KINDS or size > MAX_TAG_BYTES:
                raise GeoidError(
                    f"its tag {tag} is of {n} values of TIFF's type {kind}, which it should not be"
                )
            at = start + 10 + 12 * i
            if size > 4:
                (at,) = struct.unpack_from(order + "I", data, at)
            found[tag] = struct.unpack_from(f"{order}{n}{KINDS[kind]}", data, at)
    except struct.error:
        raise GeoidError("it ends before its tags do: copy it again") from None
    return found


def _number(tags: dict, tag: int, default: int = 0) -> int:
    values = tags.get(tag, (default,))
    return values[0] if len(values) == 1 and isinstance(values[0], int) else 0


def _text(tags: dict, tag: int) -> str:
    (value,) = tags.get(tag, (b"",))
    return value.decode("ascii", "replace").strip("\0 \n") if isinstance(value, bytes) else ""


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


def _metadata(tags: dict) -> tuple[float, float]:
    """Scale and offset of the values; GeoidError if the metadata say that they are not undulations."""
    text = _text(tags, GDAL_METADATA)
    items = dict(re.findall(r'<Item name="(\w+)"[^>]*>([^<]*)</Item>', text))
    kind = items.get("TYPE", "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL")
    if kind != "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL":
        raise GeoidError(f"it is a grid of {kind[:60]}: geoid undulations are wanted")
    # of the same type are heights of a tidal surface (hydroid_height), which is not level
    if (band := items.get("DESCRIPTION", UNDULATION).strip()) != UNDULATION:
        raise GeoidError(f"its band is {band[:60]!r}: one of {UNDULATION} is wanted")
    try:
        scale, offset = float(items.get("SCALE", 1)), float(items.get("OFFSET", 0))
    except ValueError:
        raise GeoidError("the SCALE or OFFSET in its metadata is no number") from None
    if not (math.isfinite(scale) and math.isfinite(offset) and scale != 0):
        raise GeoidError(f"its metadata claim a scale of {scale:g} and an offset of {offset:g}")
    return scale, offset


def _nodata(tags: dict) -> float | None:
    text = _text(tags, GDAL_NODATA)
    try:
        return float(text) if text else None
    except ValueError:
        raise GeoidError(f"its mark of no data is {text[:30]!r}, which is no number") from None
