# SPDX-License-Identifier: Apache-2.0
"""`starpos stations`: a table of many sessions of `starpos deflection`: repeats, and a geoid grid."""

import argparse
from collections.abc import Mapping, Sequence

import numpy as np

from starpos.cli import console
from starpos.cli.places_file import feature_collection
from starpos.earth import geoid
from starpos.units import utc_text
from starpos.zenith.stations import Station, against_grid, read_session, stations_of


def run(args: argparse.Namespace) -> int:
    stations = stations_of([read_session(path) for path in args.sessions])
    grid = None if args.geoid is None else geoid.read(args.geoid)
    console.complain(*(station.doubt for station in stations))
    values = [station_json(station, grid) for station in stations]
    if grid is not None and (without := [v["station"] for v in values if v["grid_arcsec"] is None]):
        console.complain(f"{args.geoid}: no data at {', '.join(without)}")
    output = console.Output(args, "stations")
    if args.geojson:
        console.print_json(_geojson(values))
    else:
        for value in values:
            output.put(value, _station_line(value), [flat(value)])
    return 0


def station_json(station: Station, grid: geoid.Geoid | None) -> dict:
    """A station for --json; its keys with a grid are None without one, or where that has no data."""
    sigma_xi, sigma_eta = station.sigma
    compared = None if grid is None else against_grid(station, grid)
    of_grid, off, stddev = compared or (None, None, None)
    return {
        "station": station.name,
        "latitude": np.degrees(station.place.latitude),
        "longitude": np.degrees(station.place.longitude),
        "height_m": station.place.height_m,
        "sessions": len(station.sessions),
        "frames": sum(s.frames for s in station.sessions),
        "first_utc": utc_text(min(s.utc_unix_s for s in station.sessions)),
        "last_utc": utc_text(max(s.utc_unix_s for s in station.sessions)),
        "mark_arcsec": station.at_mark,
        "geoid_arcsec": station.at_geoid,
        "sigma_xi_arcsec": sigma_xi,
        "sigma_eta_arcsec": sigma_eta,
        "covariance_arcsec2": station.covariance,
        "session_off_arcsec": station.off,
        "chi2": station.chi2,
        "degrees": station.degrees,
        "probability": station.probability,
        "grid_arcsec": of_grid and [of_grid.xi_arcsec, of_grid.eta_arcsec],
        "minus_grid_arcsec": off,
        "minus_grid_sigma_arcsec": stddev,
    }


def _station_line(value: Mapping) -> str:
    (xi, eta), (xi0, eta0) = value["mark_arcsec"], value["geoid_arcsec"]
    text = (
        f"{value['station']}: {value['latitude']:.6f} {value['longitude']:.6f} {value['height_m']:.1f} m, xi {xi:+.3f} "
        f"+- {value['sigma_xi_arcsec']:.3f}, eta {eta:+.3f} +- {value['sigma_eta_arcsec']:.3f} arcsec at the mark, "
        f"{xi0:+.3f} {eta0:+.3f} at the geoid, {value['sessions']} sessions"
    )
    if value["degrees"]:
        text += f" (chi-square {value['chi2']:.1f} of {value['degrees']})"
    if value["minus_grid_arcsec"] is not None:
        (off_xi, off_eta), (sigma_xi, sigma_eta) = (
            value["minus_grid_arcsec"],
            value["minus_grid_sigma_arcsec"],
        )
        text += f"; minus the grid {off_xi:+.2f} +- {sigma_xi:.2f}, {off_eta:+.2f} +- {sigma_eta:.2f}"
    return text


def flat(value: Mapping) -> dict:
    """A station's values, each pair as two, for tables."""
    row = {k: v for k, v in value.items() if np.ndim(v) == 0 and not k.endswith("_arcsec")}
    for key in ("mark_arcsec", "geoid_arcsec", "grid_arcsec", "minus_grid_arcsec", "minus_grid_sigma_arcsec"):
        xi, eta = (None, None) if value[key] is None else value[key]
        row |= {f"xi_{key}": xi, f"eta_{key}": eta}
    row |= {k: value[k] for k in ("sigma_xi_arcsec", "sigma_eta_arcsec")}
    return row


def _geojson(values: Sequence[Mapping]) -> dict:
    """A FeatureCollection of longitude, latitude in deg and height in m on WGS 84."""
    rows = [flat(value) for value in values]
    places = [[row.pop(name) for name in ("longitude", "latitude", "height_m")] for row in rows]
    return feature_collection(("Point", place, row) for place, row in zip(places, rows, strict=True))
