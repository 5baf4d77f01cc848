# SPDX-License-Identifier: Apache-2.0
"""Writes the stations of a zenith camera as one HTML page that a surveyor hands in."""

from collections.abc import Callable, Sequence
from functools import partial
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from starpos import __version__
from starpos.report import station_figures
from starpos.report.html import Picture, document, figures, sexagesimal, table, wide_table
from starpos.report.style import new_figure, png_of
from starpos.utc import utc_text
from starpos.zenith.session_file import SessionResult
from starpos.zenith.stations import AgainstGrid, Station

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# more stations get the table and the map only
ALL_FIGURES = 12
XI, ETA = "&xi;", "&eta;"
MAP = (
    "North on top. An arrow goes from the zenith of the ellipsoid to the zenith of the plumb line; a red arrow is the "
    "difference from the geoid grid. Suspicious: one red arrow unlike its neighbours (a wrong mark, a bad session)."
)
FRAMES = (
    "Each frame alone, with 1 sigma of what is new in it; grey, the session and its whole error. Suspicious: a step or a "
    "slope within a face, a face that stands off."
)
FACES = (
    "Each face minus all others, 1 sigma. Suspicious: a face more than three sigma off (wind, a foot that settled, "
    "clouds)."
)
ERRORS = "1 sigma of each source of error. Only a better instrument or clock makes smaller what more frames do not."
REPEATS = (
    "Each session minus the station, with 1 sigma of what is new in it; grey, the station's whole error."
)


def station_page(
    stations: Sequence[Station], compared: Sequence[AgainstGrid | None], grid_name: str, made_utc: str
) -> tuple[str, dict[str, Picture]]:
    """The HTML of stations, and its pictures by the names of files.

    compared: each station against a grid, None without one; grid_name: the grid's, '' without one.
    """
    title = f"Station {stations[0].name}" if len(stations) == 1 else f"{len(stations)} stations"
    parts, pictures = [f"<h1>Deflection of the vertical: {escape(title)}</h1>"], {}
    if len(stations) > 1:
        shown = _drawn("map", "Map", MAP, 6.0, lambda f: station_figures.draw_map(f, stations, compared))
        pictures["map"] = shown
        parts += [_table_of_stations(stations, compared), figures([shown])]
    for k, (station, against) in enumerate(zip(stations, compared, strict=True), 1):
        parts.append(f'<h2 id="station{k}">Station {escape(station.name)}</h2>')
        drawn = _pictures(station) if len(stations) <= ALL_FIGURES else []
        pictures |= {f"station{k}-{p.name}": p for p in drawn}
        parts += [
            _value(station),
            _summary(station, against, grid_name),
            _sessions(station),
            figures(drawn),
        ]
    parts.append(
        f"<footer><p>Made by starpos {escape(__version__)} on {escape(made_utc)}. {XI} is the deflection to the north, "
        f"{ETA} to the east: astronomic minus geodetic latitude, and the same of longitude times the cosine of latitude, "
        "on WGS 84. Values are tide free: the pull of Moon and Sun is taken off, its permanent part too. Errors are 1 "
        "sigma. At the geoid: by the curvature of the normal plumb line (Heiskanen &amp; Moritz 1967, section 5-6).</p>"
        "</footer>"
    )
    return document(f"starpos: {title}", parts), pictures


def _drawn(
    name: str, title: str, caption: str, height_in: float, draw: "Callable[[Figure], None]"
) -> Picture:
    figure = new_figure(height_in)
    draw(figure)
    return Picture(name, title, caption, png_of(figure))


def _pictures(station: Station) -> list[Picture]:
    """The figures of a station: of its sessions, and of their repeats."""
    made = []
    if len(station.sessions) > 1:
        made.append(
            _drawn(
                "repeats",
                f"{station.name}: repeats",
                REPEATS,
                5.0,
                lambda f: station_figures.draw_repeats(f, station),
            )
        )
    for k, session in enumerate(station.sessions, 1):
        of = f"{station.name}, session {k}" if len(station.sessions) > 1 else station.name
        made += [
            _drawn(f"{name}{k}", f"{of}: {title}", caption, height_in, partial(draw, session=session))
            for there, name, title, caption, height_in, draw in (
                (session.frames, "frames", "frame by frame", FRAMES, 5.6, station_figures.draw_frames),
                (session.faces, "faces", "face by face", FACES, 4.2, station_figures.draw_faces),
                (session.terms, "errors", "errors", ERRORS, 4.6, station_figures.draw_errors),
            )
            if there
        ]
    return made


def _pair(values: np.ndarray, sigma: np.ndarray, decimals: int = 3) -> str:
    """Two components in arcsec with their errors."""
    return ", ".join(
        f"{name} {value:+.{decimals}f} &plusmn; {error:.{decimals}f}&Prime;"
        for name, value, error in zip((XI, ETA), values, sigma, strict=True)
    )


def _value(station: Station) -> str:
    return f'<p class="place">{_pair(station.at_mark, station.sigma)} at the mark, tide free</p>'


def _summary(station: Station, against: AgainstGrid | None, grid_name: str) -> str:
    c, (sigma_xi, sigma_eta) = station.covariance, station.sigma
    sessions = (
        "one session" if len(station.sessions) == 1 else f"the mean of {len(station.sessions)} sessions"
    )
    shared = np.sqrt(np.diag(station.common))
    rows = [
        (
            "Mark (WGS 84)",
            f"{sexagesimal(station.latitude, 'NS', 4)}, {sexagesimal(station.longitude, 'EW', 4)}, ellipsoidal height "
            f"{station.height_m:.3f} m",
        ),
        ("At the mark", f"{_pair(station.at_mark, station.sigma)}, {sessions}"),
        ("At the geoid", f"{_pair(station.at_geoid, station.sigma)}, by the normal plumb line"),
        (
            "Covariance",
            f"{c[0, 0]:.6f}, {c[1, 1]:.6f} arcsec&sup2;, correlation {c[0, 1] / sigma_xi / sigma_eta:+.2f}; of this the "
            f"sessions share {shared[0]:.3f}, {shared[1]:.3f}&Prime; (catalogue, refraction, clock, Earth rotation)",
        ),
    ]
    if station.degrees:
        text = f"chi-square {station.chi2:.1f} of {station.degrees}, probability {station.probability:.2g}"
        rows.append(
            ("Repeats", f'<span class="bad">{escape(station.doubt)}</span>' if station.doubt else text)
        )
    if against is not None:
        grid = against.grid
        rows.append(
            (
                "Geoid grid",
                f"{escape(grid_name)}: {XI} {grid.xi_arcsec:+.2f}, {ETA} {grid.eta_arcsec:+.2f} &plusmn; "
                f"{grid.stddev_arcsec:.2f}&Prime;; the station at the geoid minus the grid: "
                f"{_pair(against.off, against.stddev, 2)}",
            )
        )
    elif grid_name:
        rows.append(("Geoid grid", f"{escape(grid_name)} has no data here"))
    return table(rows)


def _sessions(station: Station) -> str:
    titles = (
        "", "Middle, UTC", "Minutes", "Faces", "Frames", "Stars", "Image motion", f"{XI}, {ETA} as observed", "1 sigma",
        "Tide", "Minus the station", "File",
    )  # fmt: skip
    return wide_table(titles, [_row(k, s, station) for k, s in enumerate(station.sessions, 1)])


def _row(number: int, s: SessionResult, station: Station) -> list[str]:
    def two(values: np.ndarray, form: str = "+.3f") -> str:
        return ", ".join(f"{v:{form}}&Prime;" for v in values)

    return [
        str(number),
        escape(utc_text(s.utc_unix_s)[:19].replace("T", " ")),
        f"{s.duration_s / 60:.0f}",
        str(s.face_count),
        str(s.frame_count),
        str(s.stars),
        f"{s.motion_arcsec:.2f}&Prime;",
        two(s.seen),
        two(np.sqrt(np.diag(s.covariance)), ".3f"),
        two(s.tide),
        two(station.off[number - 1]),
        escape(s.path.name),
    ]


def _table_of_stations(stations: Sequence[Station], compared: Sequence[AgainstGrid | None]) -> str:
    titles = [
        "Station",
        "Latitude, longitude",
        "Height",
        f"{XI} at the mark",
        f"{ETA} at the mark",
        "At the geoid",
        "Sessions",
    ]
    if any(c is not None for c in compared):
        titles.append("At the geoid minus the grid")
    rows = []
    for k, (s, against) in enumerate(zip(stations, compared, strict=True), 1):
        (xi, eta), (sigma_xi, sigma_eta) = s.at_mark, s.sigma
        row = [
            f'<a href="#station{k}">{escape(s.name)}</a>',
            f"{np.degrees(s.latitude):.6f}&deg;, {np.degrees(s.longitude):.6f}&deg;",
            f"{s.height_m:.1f} m",
            f"{xi:+.3f} &plusmn; {sigma_xi:.3f}&Prime;",
            f"{eta:+.3f} &plusmn; {sigma_eta:.3f}&Prime;",
            f"{s.at_geoid[0]:+.3f}&Prime;, {s.at_geoid[1]:+.3f}&Prime;",
            str(len(s.sessions)),
        ]
        if len(titles) > len(row):
            row.append("" if against is None else _pair(against.off, against.stddev, 2))
        rows.append(row)
    return wide_table(titles, rows)
