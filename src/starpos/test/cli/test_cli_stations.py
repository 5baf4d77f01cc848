# SPDX-License-Identifier: Apache-2.0
"""`starpos stations`: tables and GeoJSON."""

import csv
import io
import json

import numpy as np
import pytest
from cli_calls import objects

from starpos_testing.skies.deflections import result

# 2 km to the north-east, arcsec at the geoid
PLACES = {"P1": (47.0, 8.0, 3.0, -1.0), "P2": (47.0128, 8.0186, 3.4, -1.2)}


@pytest.fixture
def sessions(tmp_path):
    """Two stations, the first one measured twice, and a flat geoid grid with a slope."""
    paths = [result(tmp_path / f"{name}.json", *place, station=name) for name, place in PLACES.items()]
    paths.append(result(tmp_path / "again.json", 47.0, 8.0, 3.05, -1.03, station="P1"))
    phi, lam = np.meshgrid(np.arange(46, 48.01, 0.1), np.arange(7, 9.01, 0.1), indexing="ij")
    # 3 arcsec to the south, m by deg: 111.2 km a degree
    heights = -3.0 / 206265 * 111_170 * (phi - 47) + 0 * lam
    head = np.array([46.0, 7.0, 0.1, 0.1], ">f8").tobytes() + np.array(phi.shape, ">i4").tobytes()
    (tmp_path / "geoid.gtx").write_bytes(head + heights.astype(">f4").tobytes())
    return paths


def test_a_table_of_stations_with_a_grid(run, sessions, tmp_path):
    grid = ("--geoid", tmp_path / "geoid.gtx")
    status, out, err = run("stations", *sessions, *grid, "--json")
    first, second = objects(out)
    assert (
        status == 0 and not err and (first["station"], first["sessions"], second["sessions"]) == ("P1", 2, 1)
    )
    assert first["geoid_arcsec"] == pytest.approx([3.025, -1.015])
    assert first["grid_arcsec"] == pytest.approx([3.0, 0.0], abs=0.01)
    assert first["minus_grid_arcsec"] == pytest.approx([0.025, -1.015], abs=0.01)
    status, out, _ = run("stations", *sessions, *grid)
    assert status == 0 and "P1: 47.000000 8.000000" in out


def test_tables_for_other_programs(run, sessions):
    _, out, _ = run("stations", *sessions, "--csv")
    rows = list(csv.DictReader(io.StringIO(out)))
    assert [row["station"] for row in rows] == ["P1", "P2"] and float(
        rows[1]["xi_geoid_arcsec"]
    ) == pytest.approx(3.4)
    _, out, _ = run("stations", *sessions, "--geojson")
    features = json.loads(out)["features"]
    assert features[1]["geometry"] == {"type": "Point", "coordinates": [8.0186, 47.0128, 500.0]}
    assert features[0]["properties"]["sessions"] == 2 and "grid_arcsec" not in features[0]["properties"]


def test_what_cannot_be_is_a_sentence(run, sessions, tmp_path):
    (tmp_path / "none.json").write_text("{}")
    status, _, err = run("stations", tmp_path / "none.json")
    assert status == 2 and "starpos deflection --json" in err[0]
