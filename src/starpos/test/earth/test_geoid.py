# SPDX-License-Identifier: Apache-2.0
"""Slopes of grids that are known exactly, in every orientation; the stated error; invalid grids."""

import os
import struct
import zlib

import numpy as np
import pytest

from starpos.earth import geoid
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.geoid import find
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, Deflection, geodetic
from starpos.errors import GeoidError
from starpos.units import ARCSEC

EVERYWHERE = [(90, 0), (90, 77), (89.9, -130), (-90, 10), (-89.95, 200), (85.03, 33), (60, 179.99), (47.3, -179.99),
              (0, 0), (0.01, -0.01), (-33.4, 123.456), (12.5, 180), (-70.1, 359.9), (45, -540.2)]  # fmt: skip
# South, west, columns' step, columns, rows.
WORLDS = {
    "-180 to 179.5": (-90, -180, 0.5, 720, 361),
    "0 to 359.5": (-90, 0, 0.5, 720, 361),
    "the first column again": (-90, -180, 0.5, 721, 361),
    "poles half a row away": (-89.75, -179.75, 0.5, 720, 360),
    "beyond 360": (-90, 200, 0.5, 720, 361),
    "columns wider than rows": (-90, -180, 1.0, 360, 361),
}


def gtx(path, heights, south=-90.0, west=-180.0, step=0.5, step_longitude=None):
    """Heights (rows from the south, columns from the west) as a file."""
    header = struct.pack(">4d2i", south, west, step, step_longitude or step, *np.shape(heights))
    path.write_bytes(header + np.asarray(heights, ">f4").tobytes())
    return path


def tiff(
    path, heights, tie, scale, *, point=True, order="<", tile=None, extra=(), model=2, kind="f4", samples=1
):
    """Heights (rows from the north) as a GeoTIFF of one strip, or of deflated tiles with predictor 3 as PROJ has them."""
    heights = np.asarray(heights)
    rows, columns = heights.shape[:2]
    if tile:
        padded = np.zeros((-(-rows // tile) * tile, -(-columns // tile) * tile), ">f4")
        padded[:rows, :columns] = heights
        blocks = [
            zlib.compress(_predicted(padded[r : r + tile, c : c + tile]))
            for r in range(0, len(padded), tile)
            for c in range(0, padded.shape[1], tile)
        ]
        layout = [(259, "H", (8,)), (317, "H", (3,)), (322, "H", (tile,)), (323, "H", (tile,))]
        where, sizes = 324, 325
    else:
        blocks = [np.ascontiguousarray(heights, order + kind).tobytes()]
        layout, where, sizes = [(259, "H", (1,)), (278, "I", (rows,))], 273, 279
    offsets = np.cumsum([8, *(len(b) for b in blocks)]).tolist()
    keys = (1, 1, 0, 2, 1024, 0, 1, model, 1025, 0, 1, 2 if point else 1)
    bits, form = 8 * int(kind[1]), {"f": 3, "u": 1}[kind[0]]
    tags = [(256, "I", (columns,)), (257, "I", (rows,)), (258, "H", (bits,) * samples), (262, "H", (1,)),
            (277, "H", (samples,)), (339, "H", (form,) * samples), (where, "I", tuple(offsets[:-1])),
            (sizes, "I", tuple(len(b) for b in blocks)), (33550, "d", (*scale, 0.0)),
            (33922, "d", (0.0, 0.0, 0.0, *tie, 0.0)), (34735, "H", keys), *layout, *extra]  # fmt: skip
    numbers = {"B": 1, "s": 2, "H": 3, "I": 4, "d": 12}
    start, entries, spill = offsets[-1], b"", b""
    after = start + 2 + 12 * len(tags) + 4
    for tag, code, values in sorted(tags):
        raw = values if code == "s" else struct.pack(f"{order}{len(values)}{code}", *values)
        entries += struct.pack(order + "HHI", tag, numbers[code], len(values))
        entries += raw.ljust(4, b"\0") if len(raw) <= 4 else struct.pack(order + "I", after + len(spill))
        spill += raw if len(raw) > 4 else b""
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, start)
    directory = struct.pack(order + "H", len(tags)) + entries + bytes(4) + spill
    path.write_bytes(head + b"".join(blocks) + directory)
    return path


def _predicted(block):
    """Predictor 3: of each row the bytes by their weight, each less the one before."""
    planes = np.ascontiguousarray(block, ">f4").view(np.uint8).reshape(*block.shape, 4)
    row_bytes = planes.transpose(0, 2, 1).reshape(len(block), -1)
    return np.diff(row_bytes, axis=1, prepend=np.uint8(0)).astype(np.uint8).tobytes()


def harmonic(phi, lam):
    """N of degrees 1 to 3 and its slopes to the north and to the east, the latter / cos(phi): of the directions alone."""
    phi, lam = np.broadcast_arrays(phi, lam)
    x, y, z = np.cos(phi) * np.cos(lam), np.cos(phi) * np.sin(lam), np.sin(phi)
    n = 20 * x - 9 * y + 13 * z + 30 * x * y + 11 * x * z * z
    gradient = np.stack([20 + 30 * y + 11 * z * z, -9 + 30 * x, 13 + 22 * x * z])
    north = np.stack([-np.sin(phi) * np.cos(lam), -np.sin(phi) * np.sin(lam), np.cos(phi)])
    east = np.stack([-np.sin(lam), np.cos(lam), 0 * phi])
    return n, (gradient * north).sum(0), (gradient * east).sum(0)


def deflection(phi, north, east):
    """xi, eta in arcsec of slopes in m per rad."""
    prime, meridian = curvature_radii_m(phi)
    return -north / meridian / ARCSEC, -east / prime / ARCSEC


def world(south, west, step_longitude, columns, rows):
    phi = np.radians(south + 0.5 * np.arange(rows))[:, None]
    return harmonic(phi, np.radians(west + step_longitude * np.arange(columns))[None, :])[0]


@pytest.mark.parametrize("name", WORLDS)
def test_slopes_of_a_harmonic_all_over_the_globe(tmp_path, name):
    south, west, step_longitude, *_ = WORLDS[name]
    grid = geoid.read(gtx(tmp_path / "world.gtx", world(*WORLDS[name]), south, west, 0.5, step_longitude))
    for place in np.radians(EVERYWHERE):
        d = grid.at(*place)
        at = np.array([np.clip(place[0], -np.radians(89.999), np.radians(89.999)), place[1]])
        xi, eta = deflection(at[0], *harmonic(*at)[1:])
        assert (d.xi_arcsec, d.eta_arcsec) == pytest.approx((xi, eta), abs=0.01), np.degrees(place)
        # There is nothing in it that half a degree could not resolve.
        assert d.stddev_arcsec < 1


def test_a_plane_in_degrees_is_exact(tmp_path):
    """1 m a degree of latitude, 2 a degree of longitude."""
    heights = np.arange(20)[:, None] * 0.25 + np.arange(30) * 0.5
    d = geoid.read(gtx(tmp_path / "plane.gtx", heights, 45, 7, 0.25)).at(np.radians(47.1), np.radians(10.3))
    expected = deflection(np.radians(47.1), np.degrees(1), np.degrees(2) / np.cos(np.radians(47.1)))
    assert (d.xi_arcsec, d.eta_arcsec) == pytest.approx(expected, rel=1e-6)
    # 1 m in 111.18 km; the plumb line leans away from the height.
    assert d.xi_arcsec == pytest.approx(-1.855, abs=0.001)


def hill(height_m, width_deg, step, centre=(46.0, 8.0)):
    """A Gaussian hill of a geoid about a centre in deg; its grid and its slopes."""

    def n(phi, lam):
        east = (lam - centre[1]) * np.cos(np.radians(centre[0]))
        return height_m * np.exp(-((phi - centre[0]) ** 2 + east**2) / (2 * width_deg**2))

    phi, lam = centre[0] - 4 + np.arange(8 / step) * step, centre[1] - 4 + np.arange(8 / step) * step
    return n(phi[:, None], lam[None, :]), phi[0], lam[0], n


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.11, -0.32), (-0.4, 0.27), (0.3125, 0.125)])
def test_slopes_of_a_hill_three_nodes_wide(tmp_path, offset):
    """Where a bilinear grid, or central differences, miss arcseconds."""
    heights, south, west, n = hill(10.0, 0.375, 0.125)
    phi, lam = 46 + offset[0], 8 + offset[1]
    d = geoid.read(gtx(tmp_path / "hill.gtx", heights, south, west, 0.125)).at(*np.radians([phi, lam]))
    north = -(phi - 46) / 0.375**2 * n(phi, lam) * np.degrees(1)
    east = -(lam - 8) * np.cos(np.radians(46)) ** 2 / 0.375**2 * n(phi, lam) * np.degrees(1)
    expected = deflection(np.radians(phi), north, east / np.cos(np.radians(phi)))
    assert (d.xi_arcsec, d.eta_arcsec) == pytest.approx(expected, abs=0.25)
    assert np.hypot(*expected) > 15 or offset == (0.0, 0.0)


def test_the_slope_does_not_jump_at_a_node(tmp_path):
    heights, south, west, _ = hill(10.0, 0.375, 0.125)
    grid = geoid.read(gtx(tmp_path / "hill.gtx", heights, south, west, 0.125))
    for axis in (0, 1):
        sides = [46.25, 7.75], [46.25, 7.75]
        sides[0][axis] -= 1e-7
        sides[1][axis] += 1e-7
        a, b = (grid.at(*np.radians(side)) for side in sides)
        assert (a.xi_arcsec, a.eta_arcsec) == pytest.approx((b.xi_arcsec, b.eta_arcsec), abs=2e-3)


def test_the_error_grows_with_the_roughness_and_with_the_spacing(tmp_path):
    rng = np.random.default_rng(2)
    rough = rng.normal(size=(80, 80))

    def stddev(heights, step):
        path = gtx(tmp_path / "rough.gtx", heights, 40, 5, step)
        return geoid.read(path).at(*np.radians([40 + 39.6 * step, 5 + 40.3 * step])).stddev_arcsec

    plain, hills, mountains = (stddev(scale * rough, 0.25) for scale in (0.0, 0.01, 0.1))
    assert plain == geoid.FLOOR_ARCSEC
    assert plain < hills < mountains
    assert mountains == pytest.approx(10 * np.sqrt(hills**2 - plain**2), rel=0.01)
    # second differences of white noise have sqrt(6) of it; east the nodes are cos(phi) as far apart
    step_m, cos_phi = np.radians(0.25) * 6.37e6, np.cos(np.radians(49.9))
    expected = 1.5 * 0.1 * np.sqrt(6 * (1 + cos_phi**-4) / 2) / step_m / ARCSEC
    assert mountains == pytest.approx(expected, rel=0.15)
    coarse = [stddev(hill(10.0, 0.5, step)[0], step) for step in (0.05, 0.1, 0.2)]
    assert coarse[0] < coarse[1] < coarse[2]


def test_outside_nothing_is_known(tmp_path):
    """Nothing is known within one node of the edge, at a place that is no number, and where the file has no data."""
    heights = np.fromfunction(lambda r, c: 30 + 0.2 * r - 0.1 * c, (60, 80))
    heights[20:22, 30] = -88.8888
    heights[40, 30] = np.nan
    heights[50, 60] = -2147479936
    # Over the date line: to -170.25.
    grid = geoid.read(gtx(tmp_path / "region.gtx", heights, 30, 170, 0.25))
    unknown = Deflection(0.0, 0.0, UNKNOWN_STDDEV_ARCSEC)
    for place in [(29.9, 175), (30.1, 175), (44.6, 175), (35, 169.9), (35, -170.3), (35, 0), (35, -10), (-35, 175),
                  (90, 175), (35.1, 177.4), (40, 177.5), (42.6, -175.1), (np.nan, 175), (35, np.inf)]:  # fmt: skip
        assert grid.at(*np.radians(place)) == unknown, place
    phi = np.radians(36.1)
    expected = deflection(phi, np.degrees(0.8), -np.degrees(0.4) / np.cos(phi))
    # Next to the hole it answers.
    for longitude in (175.1, 179.99, 180, -180, -179.6, -175, 177, 178.9, 185 - 720):
        d = grid.at(phi, np.radians(longitude))
        assert (d.xi_arcsec, d.eta_arcsec) == pytest.approx(expected, rel=1e-4), longitude


def test_a_cliff_is_no_slope_and_a_cap_without_surroundings_no_answer(tmp_path):
    heights = np.where(np.arange(40) < 20, 0.0, 100.0) * np.ones((40, 1))
    cliff = geoid.read(gtx(tmp_path / "cliff.gtx", heights, 40, 5, 0.25))
    assert cliff.at(*np.radians([45, 9.85])) == Deflection()
    cap = geoid.read(gtx(tmp_path / "cap.gtx", np.ones((11, 3600)), 89, -180, 0.1))
    assert cap.at(*np.radians([89.4, 9.85])) == Deflection()


def test_what_is_unknown_widens_the_geodetic_place(tmp_path):
    grid = geoid.read(gtx(tmp_path / "plane.gtx", np.ones((20, 20)), 45, 7, 0.25))
    inside, outside = (
        geodetic(np.radians(47), np.radians(lam), 0.0, np.zeros((3, 3)), grid) for lam in (9.5, 50)
    )
    assert np.sqrt(inside.covariance[1, 1]) == pytest.approx(geoid.FLOOR_ARCSEC * 30.9, rel=0.01)
    assert np.sqrt(outside.covariance[1, 1]) == pytest.approx(UNKNOWN_STDDEV_ARCSEC * 30.9, rel=0.01)


# Rows from the south.
HEIGHTS = np.fromfunction(lambda r, c: 20 + 0.3 * r + 0.02 * r * c - 0.5 * c, (40, 50))
TIFFS = {
    "a strip, little endian": {},
    "big endian": {"order": ">"},
    "tiles, deflated, predictor 3": {"tile": 32},
    "pixel is area": {"point": False, "tie": (9.9, 48.95)},
    "64 bits": {"kind": "f8"},
    "its type": {
        "extra": [(42112, "s", b'<GDALMetadata><Item name="TYPE">VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL</Item>'
                   b"</GDALMetadata>\0")],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", TIFFS)
def test_a_geotiff_says_what_the_gtx_says(tmp_path, name):
    about = {"heights": HEIGHTS[::-1], "tie": (10.0, 48.9), "scale": (0.2, 0.1)} | TIFFS[name]
    one = geoid.read(gtx(tmp_path / "a.gtx", HEIGHTS, 45, 10, 0.1, 0.2))
    other = geoid.read(tiff(tmp_path / "a.tif", **about))
    for place in np.radians([(46.03, 13.3), (48.2, 17), (45.12, 10.3)]):
        a, b = one.at(*place), other.at(*place)
        assert (a.xi_arcsec, a.eta_arcsec) == pytest.approx((b.xi_arcsec, b.eta_arcsec), abs=1e-3)
        assert a.stddev_arcsec == pytest.approx(b.stddev_arcsec, abs=1e-3)
        assert a.stddev_arcsec < UNKNOWN_STDDEV_ARCSEC


def test_no_data_of_a_geotiff(tmp_path):
    heights = HEIGHTS[::-1].copy()
    # 0.6 m off, no cliff; exact in single precision, and no other node has it.
    heights[20, 30] = 21.53125
    path = tiff(tmp_path / "a.tif", heights, (10.0, 48.9), (0.2, 0.1), extra=[(42113, "s", b"21.53125\0")])
    assert geoid.read(path).at(*np.radians([46.95, 16.1])) == Deflection()
    assert geoid.read(path).at(*np.radians([46.1, 12.0])) != Deflection()


@pytest.mark.parametrize("order", "<>")
def test_a_grid_of_ngs_says_what_the_gtx_says_in_either_byte_order(tmp_path, order):
    """Its header has one word more than a GTX's: taken for one, each node would be a column off."""
    heights, south, west, _ = hill(30.0, 0.3, 0.1)
    plain = gtx(tmp_path / "a.gtx", heights, south, west, 0.1)
    header = struct.pack(order + "4d3i", south, west, 0.1, 0.1, *heights.shape, 1)
    (tmp_path / "a.bin").write_bytes(header + heights.astype(order + "f4").tobytes())
    told, expected = geoid.read(tmp_path / "a.bin"), geoid.read(plain)
    assert np.array_equal(told.values, expected.values)
    assert (told.south, told.west, told.step_longitude) == (south, west, 0.1)


BROKEN_GTX = {
    "empty": (b"", "shorter"),
    "a text": (b"latitude longitude undulation, all of them in one line\n", "nodes"),
    "cut off": (struct.pack(">4d2i", 40, 5, 1, 1, 20, 20) + bytes(1596), "4 bytes are missing"),
    "no rows": (struct.pack(">4d2i", 40, 5, 1, 1, 0, 20), "20 x 0"),
    "too many": (struct.pack(">4d2i", 40, 5, 1, 1, 2**31 - 1, 2**31 - 1), "nodes"),
    "little endian": (struct.pack("<4d2i", 40, 5, 1, 1, 20, 20) + bytes(1600), "nodes"),
    "few": (struct.pack(">4d2i", 40, 5, 1, 1, 3, 20) + bytes(240), "too few"),
    "a step of nan": (struct.pack(">4d2i", 40, 5, np.nan, 1, 20, 20) + bytes(1600), "finite"),
    "a step back": (struct.pack(">4d2i", 40, 5, -1, 1, 20, 20) + bytes(1600), "apart"),
    "steps in arcsec": (struct.pack(">4d2i", 40, 5, 900, 900, 20, 20) + bytes(1600), "apart"),
    "beyond the pole": (struct.pack(">4d2i", 80, 5, 1, 1, 20, 20) + bytes(1600), "globe"),
    "more than around": (struct.pack(">4d2i", 40, 5, 1, 1, 4, 400) + bytes(6400), "globe"),
    "nowhere": (struct.pack(">4d2i", 40, 1e9, 1, 1, 20, 20) + bytes(1600), "globe"),
    "nothing in it": (
        struct.pack(">4d2i", 40, 5, 1, 1, 20, 20) + b"\x7f\xc0\0\0" * 400,
        "none of its values",
    ),
    "metres of a mountain": (
        struct.pack(">4d2i", 40, 5, 1, 1, 20, 20) + struct.pack(">f", 3000) * 400,
        "none of its values",
    ),
}


@pytest.mark.parametrize("name", BROKEN_GTX)
def test_a_gtx_that_is_none(tmp_path, name):
    path = tmp_path / "broken.gtx"
    content, words = BROKEN_GTX[name]
    path.write_bytes(content)
    refused(path, words)


def refused(path, words):
    with pytest.raises(GeoidError, match=words) as e:
        geoid.read(path)
    assert str(path) in str(e.value)
    assert "\n" not in str(e.value)


BROKEN_TIFF = {
    "in a projection": ({"model": 1}, "projection"),
    "too wide": ({"extra": [(256, "I", (2**31,))]}, "claims"),
    # 18000 x 9000 nodes of 32 bits would be few enough
    "too many bytes": (
        {"extra": [(256, "I", (18_000,)), (257, "I", (9_000,)), (258, "H", (64,))]},
        "64 bits",
    ),
    "three bands": ({"heights": np.zeros((40, 50, 3)), "samples": 3}, "3 bands"),
    "whole numbers": ({"kind": "u2"}, "uint16"),
    "a shift between heights": (
        {"extra": [(42112, "s", b'<Item name="TYPE">VERTICAL_OFFSET_VERTICAL_TO_VERTICAL</Item>\0')]},
        "VERTICAL_TO_VERTICAL",
    ),
    "heights of the tide": (
        {"extra": [(42112, "s", b'<Item name="DESCRIPTION" sample="0">hydroid_height</Item>\0')]},
        "hydroid_height",
    ),
    "a scale": ({"extra": [(42112, "s", b'<Item name="SCALE">0.1</Item>\0')]}, "-unscale"),
    "an offset": ({"extra": [(42112, "s", b'<Item name="OFFSET">3</Item>\0')]}, "OFFSET"),
    "no data of letters": ({"extra": [(42113, "s", b"nothing\0")]}, "no data"),
    "a tag without an end": ({"extra": [(42113, "s", b"7" * (2 << 20))]}, "tag 42113"),
    "two widths": ({"extra": [(256, "I", (25,))]}, "decoded"),
    "a step of nan": ({"scale": (0.2, np.nan)}, "finite"),
    "a step of nothing": ({"scale": (0.0, 0.1)}, "apart"),
}


@pytest.mark.parametrize("name", BROKEN_TIFF)
def test_a_geotiff_that_is_none(tmp_path, name):
    changes, words = BROKEN_TIFF[name]
    about = {"heights": HEIGHTS[::-1], "tie": (10.0, 48.9), "scale": (0.2, 0.1)} | changes
    refused(tiff(tmp_path / "broken.tif", **about), words)


@pytest.mark.parametrize("order", "<>")
def test_a_bigtiff_is_named(tmp_path, order):
    head = b"II+\0" if order == "<" else b"MM\0+"
    (tmp_path / "big.tif").write_bytes(head + struct.pack(order + "HHQ", 8, 0, 16) + bytes(200))
    refused(tmp_path / "big.tif", "BigTIFF.*gdal_translate")


def test_a_picture_is_no_grid(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "plain.tif"), HEIGHTS.astype(np.float32))
    refused(tmp_path / "plain.tif", "where it lies")


def test_files_that_are_cut_off_or_changed_raise_one_error_or_still_hold(tmp_path):
    good = tiff(tmp_path / "good.tif", HEIGHTS[::-1], (10.0, 48.9), (0.2, 0.1), tile=32).read_bytes()
    path, rng = tmp_path / "changed.tif", np.random.default_rng(3)
    read = 0
    for _ in range(300):
        changed = bytearray(good[: rng.integers(4, len(good) + 1)] if rng.random() < 0.3 else good)
        for at in rng.integers(4, len(changed), rng.integers(1, 4)):
            # Its directory is at the end.
            changed[-at if rng.random() < 0.7 else at] = rng.integers(256)
        path.write_bytes(changed)
        try:
            d = geoid.read(path).at(*np.radians([46.5, 13.0]))
        except GeoidError as e:
            assert str(path) in str(e)
        else:
            read += 1
            assert np.isfinite([d.xi_arcsec, d.eta_arcsec, d.stddev_arcsec]).all()
    assert 10 < read < 290


def test_files_that_cannot_be_read(tmp_path):
    refused(tmp_path / "missing.gtx", "No such file")
    refused(tmp_path, "directory")
    os.mkfifo(tmp_path / "pipe.gtx")
    refused(tmp_path / "pipe.gtx", "no regular file")
    refused("/dev/zero", "no regular file")


def test_a_bare_name_is_found_among_projs_grids(tmp_path, monkeypatch):
    folder = tmp_path / "grids"
    folder.mkdir()
    gtx(folder / "of_proj.gtx", HEIGHTS, 45, 10, 0.1)
    with pytest.raises(GeoidError, match=r"of_proj\.gtx"):
        geoid.read("of_proj.gtx")
    monkeypatch.setenv("PROJ_DATA", f"/nowhere:{folder}")
    assert geoid.read("of_proj.gtx").at(*np.radians([46.5, 13.0])) != Deflection()
    with pytest.raises(GeoidError, match=r"sub/of_proj\.gtx"):
        geoid.read("sub/of_proj.gtx")


@pytest.fixture(scope="module")
def egm96():
    if not find("egm96_15.gtx").is_file():
        pytest.skip("proj-data is not installed")
    return geoid.read("egm96_15.gtx")


def test_the_undulations_are_those_nga_publishes(egm96):
    """The test values of its program F477; between nodes 0.5 m is what the rows' and columns' order must keep."""
    for phi, lam, n in [(38.6281550, 269.7791550, -31.628), (-14.6212170, 305.0211140, -2.969),
                        (46.8743190, 102.4487290, -43.575), (-23.6174460, 133.8747120, 15.871),
                        (38.6254730, 359.9995000, 50.066), (-0.4667440, 0.0023000, 17.329)]:  # fmt: skip
        row, column = egm96.grid.locate(phi, lam)
        r, c = int(row), int(column)
        (a, b), (d, e) = egm96.grid.undulations(np.array([r, r + 1]), np.array([c, c + 1]))
        y, x = row - r, column - c
        assert (a * (1 - x) + b * x) * (1 - y) + (d * (1 - x) + e * x) * y == pytest.approx(n, abs=0.15)


@pytest.mark.parametrize(
    ("place", "missed"), [((52.2, 5.5), 1.0), ((46.5, 8.0), 7.0), ((19.6, -155.5), 13.0)]
)
def test_the_error_is_honest_in_plains_and_in_mountains(egm96, place, missed):
    """What its slopes miss in the Netherlands, in Switzerland and in Hawaii."""
    assert missed <= egm96.at(*np.radians(place)).stddev_arcsec < 1.8 * missed


def test_it_answers_everywhere(egm96):
    rng = np.random.default_rng(4)
    z, lam = rng.uniform(-1, 1, 300), rng.uniform(-np.pi, np.pi, 300)
    found = [egm96.at(phi, east) for phi, east in zip(np.arcsin(z), lam, strict=True)]
    slopes = np.array([(d.xi_arcsec, d.eta_arcsec) for d in found])
    # of all the globe, sea and land: EGM96 has 5.3 arcsec (root mean square a component), nowhere 100
    assert np.sqrt(np.mean(slopes**2)) == pytest.approx(5, abs=1.2)
    assert abs(slopes).max() < 60
    assert 1 < np.median([d.stddev_arcsec for d in found]) < 4


@pytest.mark.parametrize("name", ["x" * 100_000, "a\0b", "a/" + "x" * 300])
def test_a_name_that_no_file_can_have_is_refused_as_one_that_is_not_there(name):
    with pytest.raises(GeoidError):
        geoid.read(name)
