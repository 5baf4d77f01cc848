# SPDX-License-Identifier: Apache-2.0
"""Places as a file that maps open: GeoJSON (RFC 7946) and GPX 1.1, on WGS 84."""

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from starpos import __version__
from starpos.cli.console import columns_of, plain
from starpos.earth.ellipsoid import curvature_radii_m
from starpos.files import save
from starpos.report.coast import SIGMAS_95

GPX = ".gpx"
SUFFIXES = (".geojson", GPX)
CREATOR = f"starpos {__version__}"
# corners of an ellipse
CORNERS = 72
NUMBERS = ("latitude_geodetic", "longitude_geodetic")


def is_places(path: str) -> bool:
    """Whether a name has the suffix of such a file."""
    return path.lower().endswith(SUFFIXES)


def feature_collection(features: Iterable[tuple[str, Sequence, Mapping]]) -> dict:
    """A FeatureCollection of kinds of geometry, coordinates (deg; m) and properties, of which None are left out."""
    return {
        "type": "FeatureCollection",
        "generator": CREATOR,
        "features": [
            {
                "type": "Feature",
                "geometry": {"type": kind, "coordinates": coordinates},
                "properties": {k: v for k, v in about.items() if v is not None},
            }
            for kind, coordinates, about in features
        ],
    }


def write(path: str, answers: Iterable[Mapping]) -> None:
    """Write the places of answers as `fix_output.json_of` has them, those that have one; WriteError if it cannot be.

    GeoJSON also has the ellipse of each place together, which holds it with a probability of 95 %.
    """
    found = [a for a in map(plain, answers) if a.get(NUMBERS[0]) is not None]
    text = _gpx(found) if path.lower().endswith(GPX) else json.dumps(_geojson(found), indent=1)
    save(path, text.encode(), "the places")


def _geojson(found: Sequence[Mapping]) -> dict:
    features = []
    for answer in found:
        latitude, longitude = (answer[name] for name in NUMBERS)
        about = {k: answer.get(k) for k in columns_of("fix") if k not in NUMBERS}
        features.append(("Point", [longitude, latitude], about))
        if answer.get("combined"):
            features.append(("Polygon", [_ellipse(answer)], {"name": "95 %"}))
    return feature_collection(features)


def _ellipse(answer: Mapping) -> list[list[float]]:
    """Longitudes and latitudes in deg, counter-clockwise and closed."""
    latitude, longitude = (np.radians(answer[name]) for name in NUMBERS)
    around = np.linspace(0, 2 * np.pi, CORNERS + 1)
    root = np.linalg.cholesky(np.asarray(answer["covariance_geodetic"], float)[:2, :2])
    east, north = SIGMAS_95 * root @ [np.cos(around), np.sin(around)]
    prime, meridian = curvature_radii_m(latitude)
    corners = [longitude + east / (prime * np.cos(latitude)), latitude + north / meridian]
    corners[0][-1], corners[1][-1] = corners[0][0], corners[1][0]
    return np.degrees(corners).T.tolist()


def _gpx(found: Sequence[Mapping]) -> str:
    points = [
        f'<wpt lat="{a[NUMBERS[0]]:.7f}" lon="{a[NUMBERS[1]]:.7f}">'
        f"<time>{a['utc']}</time><name>{escape(_name(a))}</name><desc>+- {a['sigma_north_m']:.0f} m N "
        f"{a['sigma_east_m']:.0f} m E (1 sigma), heading {_heading(a)}</desc></wpt>\n"
        for a in found
    ]
    head = f'<gpx version="1.1" creator="{CREATOR}" xmlns="http://www.topografix.com/GPX/1/1">'
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{head}\n{"".join(points)}</gpx>\n'


def _name(answer: Mapping) -> str:
    return f"{answer.get('night') or 'starpos'}" if answer.get("combined") else str(answer.get("file", ""))


def _heading(answer: Mapping) -> str:
    return "unknown" if answer["heading"] is None else f"{answer['heading']:.3f} deg"
