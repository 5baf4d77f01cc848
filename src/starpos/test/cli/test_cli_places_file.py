# SPDX-License-Identifier: Apache-2.0
"""Places as files for maps: GeoJSON and GPX."""

import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

from starpos.cli import overwriting, places_file
from starpos.errors import InstrumentError, WriteError

GPX = "{http://www.topografix.com/GPX/1/1}"
ANSWER = {
    "utc": "2026-07-25T22:38:36.723Z",
    "heading": 12.5,
    "latitude_geodetic": 60.0,
    "longitude_geodetic": 20.0,
    "sigma_east_m": 3000.0,
    "sigma_north_m": 1000.0,
    "covariance_geodetic": np.diag([9e6, 1e6, 1e-4]),
}


def test_geojson_has_points_and_the_ellipse(tmp_path):
    path = tmp_path / "a.geojson"
    lost = dict.fromkeys(ANSWER) | {"file": "lost.jpg"}
    places_file.write(f"{path}", [ANSWER | {"file": "a.jpg"}, lost, ANSWER | {"combined": True}])
    one, together, ellipse = json.loads(path.read_text())["features"]
    assert one["geometry"] == together["geometry"] == {"type": "Point", "coordinates": [20.0, 60.0]}
    assert one["properties"]["file"] == "a.jpg"
    (ring,) = ellipse["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    east, north = np.transpose(ring) - [[20.0], [60.0]]
    # chi-square of two degrees is 5.991 at 95 %; a degree of longitude is 55.80 km there, one of latitude 111.41 km
    assert east.max() * 55_800 == pytest.approx(3000 * np.sqrt(5.991), rel=1e-3)
    assert north.max() * 111_412 == pytest.approx(1000 * np.sqrt(5.991), rel=1e-3)
    # counter-clockwise, as RFC 7946 has the outer ring
    assert np.sum(east[:-1] * north[1:] - east[1:] * north[:-1]) > 0


def test_gpx_has_a_waypoint_for_each_place(tmp_path):
    path = tmp_path / "A.GPX"
    places_file.write(f"{path}", [ANSWER | {"file": "a<&.jpg"}, ANSWER | {"combined": True, "heading": None}])
    one, together = ElementTree.fromstring(path.read_text()).iter(f"{GPX}wpt")
    assert (float(one.get("lat")), float(one.get("lon"))) == (60.0, 20.0)
    assert one.find(f"{GPX}name").text == "a<&.jpg"
    assert one.find(f"{GPX}time").text == ANSWER["utc"]
    assert "heading unknown" in together.find(f"{GPX}desc").text


def test_only_files_of_starpos_are_replaced(tmp_path):
    path = tmp_path / "a.gpx"
    path.write_text("mine")
    with pytest.raises(InstrumentError, match="not of starpos"):
        overwriting.ours(path)
    for name in ("b.gpx", "b.geojson"):
        places_file.write(f"{tmp_path / name}", [ANSWER])
        overwriting.ours(tmp_path / name)
    with pytest.raises(WriteError, match="cannot be written"):
        places_file.write(f"{path}/b.gpx", [ANSWER])
