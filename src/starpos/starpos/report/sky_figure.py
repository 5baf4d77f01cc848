# SPDX-License-Identifier: Apache-2.0
"""Map of the sky with the frames of a night: their outlines and stars, and the brightest stars around."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.earth.orientation import EarthState, earth_state
from starpos.fix.solution import Attitude
from starpos.instrument.camera import Camera
from starpos.night.night import Night, Shot
from starpos.report.style import BLUE, GREY, ORANGE
from starpos.sky.catalogue import Catalogue
from starpos.sky.site import Site

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# maximum number of frames shown with outline and stars
OUTLINES = 12
# number of the brightest stars that are shown, whether a frame saw them or not
BRIGHT = 60
REACHES_DEG = (5, 10, 15, 20, 30, 45, 60, 90)
FAINTEST_DOT = 11.0


@dataclass(frozen=True)
class View:
    """A frame whose pointing is known, with its size in px."""

    shot: Shot
    pointing: Attitude
    size: tuple[int, int]

    def directions(self, xy: np.ndarray) -> np.ndarray:
        """ICRS directions (N, 3) of pixels xy (N, 2), without distortion."""
        camera = Camera.from_focal(*self.size, self.pointing.focal_px, self.pointing.model)
        return camera.directions(*xy.T) @ _axes(self.pointing)


def views(night: Night) -> list[View]:
    """The frames of a night of which it is known where they looked."""
    return [
        View(s, s.pointing, s.size)
        for s in night.shots
        if s.pointing is not None and s.size is not None and np.isfinite(s.utc_unix_s)
    ]


def draw_sky(figure: "Figure", night: Night, catalogue: Catalogue) -> None:
    """Draw north on top, east to the right, the zenith in the middle; needs a fix and one of the `views`."""
    axes: Any = figure.subplots(subplot_kw={"projection": "polar"})
    place = night.combined or night.places[0]
    site = Site(np.degrees(place.latitude), np.degrees(place.longitude), night.atmosphere)
    seen = views(night)
    centres = np.concatenate(
        [site.refracted(_axes(v.pointing)[2:], earth_state(v.shot.utc_unix_s)) for v in seen]
    )
    shown = _different(seen, centres)
    outlines = [site.refracted(_outline(v), earth_state(v.shot.utc_unix_s)) for v in shown]
    reach = _reach(np.concatenate(outlines))
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    middle_unix_s = float(np.median([v.shot.utc_unix_s for v in seen]))
    _bright(axes, site, earth_state(middle_unix_s), catalogue, reach)
    for view, outline in zip(shown, outlines, strict=True):
        shot = view.shot
        axes.plot(*polar(outline), color=ORANGE, lw=1.3)
        if len(shot.xy):
            stars = site.refracted(view.directions(shot.xy), earth_state(shot.utc_unix_s))
            axes.scatter(*polar(stars), s=_dot(shot.magnitudes), color=BLUE, lw=0, zorder=3)
    axes.plot(*polar(centres), "+", color=ORANGE, ms=7, mew=1.4, zorder=4)
    axes.set_rlim(0, reach)
    axes.set_xticks(np.radians(np.arange(0, 360, 45)), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    rings = np.linspace(0, reach, 4)[1:]
    axes.set_rgrids(rings, [f"{r:.3g}°" for r in rings], angle=22.5, fontsize=8, color=GREY)
    axes.grid(alpha=0.3, lw=0.6)
    _legend(axes)


def _legend(axes: "Axes") -> None:
    from matplotlib.lines import Line2D

    def dot(colour: str, magnitude: float, text: str, **more: Any) -> Line2D:
        size = np.sqrt(_dot(np.array([magnitude]))[0])
        return Line2D([], [], ls="none", marker="o", color=colour, ms=size, mew=0, label=text, **more)

    axes.legend(
        handles=[
            Line2D([], [], color=ORANGE, marker="+", ms=7, lw=1.3, label="a frame and its centre"),
            *(dot(BLUE, m, f"identified, V {m}") for m in (6, 8, 10)),
            dot(GREY, 3, "bright star, V 3", alpha=0.6),
        ],
        loc="upper center", bbox_to_anchor=(0.5, -0.07), ncols=3, fontsize=9, frameon=False,
    )  # fmt: skip


def _dot(magnitude: np.ndarray) -> np.ndarray:
    """Area of a star's dot in points squared."""
    return 1.2 + 1.1 * np.clip(FAINTEST_DOT - np.nan_to_num(magnitude, nan=9.0), 0, None) ** 1.7


def _bright(axes: "Axes", site: Site, state: EarthState, catalogue: Catalogue, reach: float) -> None:
    """Draw the brightest stars up to a zenith distance `reach` in deg."""
    index = site.overhead(catalogue, state, np.array([0.0, 0.0, 1.0]), np.radians(reach), 6.5)[:BRIGHT]
    v = site.observed(catalogue, index, state)
    theta, r = polar(v)
    inside = r < reach
    size = _dot(catalogue.vmag(index))
    axes.scatter(theta[inside], r[inside], s=size[inside], color=GREY, alpha=0.6, lw=0, zorder=2)


def polar(enu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth (N,) in rad and zenith distance (N,) in deg of directions (N, 3) in ENU."""
    return np.arctan2(enu[:, 0], enu[:, 1]), np.degrees(np.arctan2(np.hypot(enu[:, 0], enu[:, 1]), enu[:, 2]))


def _axes(a: Attitude) -> np.ndarray:
    """Camera axes (3, 3) in ICRS: its rows are x (along columns), y (along rows) and z."""
    ca, sa, cd, sd = np.cos(a.ra), np.sin(a.ra), np.cos(a.dec), np.sin(a.dec)
    east, north = np.array([-sa, ca, 0.0]), np.array([-sd * ca, -sd * sa, cd])
    cr, sr = np.cos(a.roll), np.sin(a.roll)
    x = sr * north - cr * east
    return np.stack([-x if a.mirrored else x, -(cr * north + sr * east), [cd * ca, cd * sa, sd]])


def _outline(view: View) -> np.ndarray:
    """ICRS directions (N, 3) along the edge of a frame."""
    width, height = view.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], float) - 0.5
    steps = np.linspace(0, 1, 9)[:-1, None]
    sides = [a + (b - a) * steps for a, b in pairwise(corners)]
    return view.directions(np.concatenate([*sides, corners[:1]]))


def _different(seen: Sequence[View], centres: np.ndarray) -> list[View]:
    """Frames that look elsewhere than all before them, OUTLINES at most."""
    kept: list[int] = []
    for k, view in enumerate(seen):
        field = 0.5 * view.size[1] / view.pointing.focal_px
        if all(np.linalg.norm(centres[k] - centres[j]) > field for j in kept):
            kept.append(k)
        if len(kept) == OUTLINES:
            break
    return [seen[k] for k in kept]


def _reach(enu: np.ndarray) -> float:
    """Zenith distance in deg at the edge of the map, so that all directions (N, 3) are on it."""
    furthest = 1.08 * polar(enu)[1].max()
    return next((r for r in REACHES_DEG if r >= furthest), 90)
