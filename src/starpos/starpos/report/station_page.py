# SPDX-License-Identifier: Apache-2.0
"""Writes the stations of a zenith camera, with their figures, as one HTML page that a surveyor hands in."""

from collections.abc import Sequence
from functools import partial
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from starpos import __version__
from starpos.report.html import document, figures, sexagesimal, table, wide_table
from starpos.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, Picture, plain
from starpos.units import utc_text
from starpos.zenith.stations import AgainstGrid, SessionResult, Station

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
COMPONENTS = ("\N{GREEK SMALL LETTER XI} (north)", "\N{GREEK SMALL LETTER ETA} (east)")
# sources with a smaller share of the largest are left out of the figure
MIN_SHARE = 0.02
# length of the longest arrow over the width of the map
ARROW = 0.15


def draw_frames(figure: "Figure", session: SessionResult) -> None:
    """Each frame's xi and eta over time, coloured by face, with the session's value."""
    minutes = np.array([f.utc_unix_s for f in session.frames])
    minutes = (minutes - minutes.min()) / 60
    face = np.array([f.face for f in session.frames])
    for k, (axes, name) in enumerate(zip(figure.subplots(2, sharex=True), COMPONENTS, strict=True)):
        value = np.array([(f.xi, f.eta)[k] for f in session.frames])
        sigma = np.array([(f.sigma_xi, f.sigma_eta)[k] for f in session.frames])
        for number in np.unique(face):
            here = face == number
            colour = COLOURS[(number - 1) % len(COLOURS)]
            axes.errorbar(minutes[here], value[here], sigma[here], fmt=".", ms=5, lw=0.7, color=colour)
            axes.text(
                minutes[here].mean(), 1.0, f"{number}", color=colour, fontsize=8, ha="center", va="bottom",
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
        own = float(np.sqrt(session.covariance[k, k]))
        axes.axhspan(session.seen[k] - own, session.seen[k] + own, color=GREY, alpha=0.25, lw=0)
        axes.axhline(session.seen[k], color=GREY, lw=1)
        axes.set_ylabel(f"{name}, arcsec")
        plain(axes)
    axes.set_xlabel("minutes (above: the number of the face)")


def draw_faces(figure: "Figure", session: SessionResult) -> None:
    """Each face minus the others, with 1 sigma."""
    axes = figure.subplots()
    at = np.array([f.face for f in session.faces], float)
    for k, (name, colour) in enumerate(zip(COMPONENTS, (BLUE, ORANGE), strict=True)):
        off, sigma = (np.array([getattr(f, what)[k] for f in session.faces]) for what in ("off", "stddev"))
        axes.errorbar(
            at + 0.12 * (2 * k - 1), off, np.nan_to_num(sigma), fmt="o", ms=4, color=colour, label=name
        )
    axes.axhline(0, color=GREY, lw=1)
    axes.set_xticks(at, [f"{f.face}\n{f.heading_deg:.0f}\N{DEGREE SIGN}" for f in session.faces])
    axes.set_xlabel("face, and azimuth of the top of its frames")
    axes.set_ylabel("minus the other faces, arcsec")
    axes.legend(frameon=False, fontsize=9)
    plain(axes)


def draw_errors(figure: "Figure", session: SessionResult) -> None:
    """1 sigma by each source, the largest on top."""
    axes = figure.subplots()
    most = max(max(xi, eta) for _, xi, eta in session.terms)
    terms = sorted((t for t in session.terms if max(t[1:]) > MIN_SHARE * most), key=lambda t: max(t[1:]))
    at = np.arange(len(terms))
    for k, (name, colour) in enumerate(zip(COMPONENTS, (BLUE, ORANGE), strict=True)):
        axes.barh(at + 0.2 - 0.4 * k, [t[1 + k] for t in terms], 0.4, color=colour, label=name)
    axes.set_yticks(at, [t[0] for t in terms])
    axes.set_xlabel("1 sigma, arcsec")
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    plain(axes)


def draw_repeats(figure: "Figure", station: Station) -> None:
    """Each session minus the station, with what is new in each."""
    for k, (axes, name) in enumerate(zip(figure.subplots(2, sharex=True), COMPONENTS, strict=True)):
        sigma = [float(np.sqrt(s.new[k, k])) for s in station.sessions]
        at = np.arange(1, len(sigma) + 1)
        axes.errorbar(at, station.off[:, k], sigma, fmt="o", ms=4, color=BLUE)
        own = station.sigma[k]
        axes.axhspan(-own, own, color=GREY, alpha=0.25, lw=0)
        axes.axhline(0, color=GREY, lw=1)
        axes.set_ylabel(f"{name}, arcsec")
        plain(axes)
    axes.set_xticks(at)
    axes.set_xlabel("session")


def draw_map(figure: "Figure", stations: Sequence[Station], compared: Sequence[AgainstGrid | None]) -> None:
    """The stations with their deflections as arrows, and in another colour what they have more than a grid."""
    axes = figure.subplots()
    places = np.degrees([[s.place.longitude, s.place.latitude] for s in stations])
    stretch = 1 / np.cos(np.radians(places[:, 1].mean()))
    axes.set_aspect(min(stretch, 20.0))
    middle, half = places.mean(0), max(np.ptp(places, axis=0).max(), 0.01) * 0.75
    axes.set_xlim(middle[0] - half * stretch, middle[0] + half * stretch)
    # the keys of the arrows stand on top
    axes.set_ylim(middle[1] - half, middle[1] + 1.2 * half)
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.plot(*places.T, "o", ms=4, color=GREY)
    for station, place in zip(stations, places, strict=True):
        axes.annotate(station.name, place, (4, 4), textcoords="offset points", fontsize=9)
    # up leans to (eta, xi): east, north
    leans = np.array([s.at_geoid[::-1] for s in stations])
    longest = max(float(np.hypot(*leans.T).max()), 1e-3)
    _arrows(axes, places, leans, longest, BLUE, "deflection at the geoid", 0.97)
    off = [(p, c.off[::-1]) for p, c in zip(places, compared, strict=True) if c is not None]
    if off:
        at, more = (np.array(column) for column in zip(*off, strict=True))
        _arrows(axes, at, more, longest, RED, "minus the grid", 0.93)
    axes.set_xlabel("longitude, deg")
    axes.set_ylabel("latitude, deg")
    plain(axes)


def _arrows(
    axes: "Axes", at: np.ndarray, leans: np.ndarray, longest: float, colour: str, name: str, key_y: float
) -> None:
    """Draw leans (N, 2), arcsec east and north; longest: lean of the longest arrow, on one scale for all."""
    arrows = axes.quiver(
        *at.T, *leans.T, color=colour, scale=longest / ARROW, scale_units="width", width=0.004, zorder=3
    )
    key = 10 ** np.floor(np.log10(longest))
    axes.quiverkey(
        arrows, 0.06, key_y, key, f"{key:g} arcsec, {name}", labelpos="E", fontproperties={"size": 9}
    )


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
        shown = Picture.drawn("map", "Map", MAP, 6.0, lambda f: draw_map(f, stations, compared))
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


def _pictures(station: Station) -> list[Picture]:
    """The figures of a station: of its sessions, and of their repeats."""
    made = []
    if len(station.sessions) > 1:
        title = f"{station.name}: repeats"
        made.append(Picture.drawn("repeats", title, REPEATS, 5.0, lambda f: draw_repeats(f, station)))
    for k, session in enumerate(station.sessions, 1):
        of = f"{station.name}, session {k}" if len(station.sessions) > 1 else station.name
        made += [
            Picture.drawn(f"{name}{k}", f"{of}: {title}", caption, height_in, partial(draw, session=session))
            for there, name, title, caption, height_in, draw in (
                (session.frames, "frames", "frame by frame", FRAMES, 5.6, draw_frames),
                (session.faces, "faces", "face by face", FACES, 4.2, draw_faces),
                (session.terms, "errors", "errors", ERRORS, 4.6, draw_errors),
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
    place, c, (sigma_xi, sigma_eta) = station.place, station.covariance, station.sigma
    sessions = (
        "one session" if len(station.sessions) == 1 else f"the mean of {len(station.sessions)} sessions"
    )
    shared = np.sqrt(np.diag(station.common))
    rows = [
        (
            "Mark (WGS 84)",
            f"{sexagesimal(place.latitude, 'NS', 4)}, {sexagesimal(place.longitude, 'EW', 4)}, ellipsoidal height "
            f"{place.height_m:.3f} m",
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
            f"{np.degrees(s.place.latitude):.6f}&deg;, {np.degrees(s.place.longitude):.6f}&deg;",
            f"{s.place.height_m:.1f} m",
            f"{xi:+.3f} &plusmn; {sigma_xi:.3f}&Prime;",
            f"{eta:+.3f} &plusmn; {sigma_eta:.3f}&Prime;",
            f"{s.at_geoid[0]:+.3f}&Prime;, {s.at_geoid[1]:+.3f}&Prime;",
            str(len(s.sessions)),
        ]
        if len(titles) > len(row):
            row.append("" if against is None else _pair(against.off, against.stddev, 2))
        rows.append(row)
    return wide_table(titles, rows)
