# SPDX-License-Identifier: Apache-2.0
"""Figures of a zenith camera's stations: a session's frames and faces, its errors, repeats, and a map."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from starpos.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plain
from starpos.zenith.session_file import SessionResult
from starpos.zenith.stations import AgainstGrid, Station

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
    places = np.degrees([[s.longitude, s.latitude] for s in stations])
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
