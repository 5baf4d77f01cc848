# SPDX-License-Identifier: Apache-2.0
"""Where on the sky the frames looked: azimuth and zenith distance of outlines, their stars and the brightest ones."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from starpos.earth.orientation import EarthState, earth_state
from starpos.fix.solver import Attitude
from starpos.report.frame_figures import pointed
from starpos.report.night import Night, Shot
from starpos.report.style import BLUE, GREY, ORANGE
from starpos.rotation import normalised
from starpos.sky.catalogue import Catalogue
from starpos.sky.site import Site

OUTLINES = 12  # frames whose stars are shown
BRIGHT = 60  # stars shown that no frame need have seen
REACHES_DEG = (5, 10, 15, 20, 30, 45, 60, 90)
FAINTEST_DOT = 11.0


def draw_sky(figure, night: Night, catalogue: Catalogue) -> None:
    """North on top, east to the right, the zenith in the middle; needs a place and a frame that points."""
    axes = figure.subplots(subplot_kw={"projection": "polar"})
    place = night.combined or night.fixed[0][1].place
    site = Site(np.degrees(place.latitude), np.degrees(place.longitude), night.atmosphere)
    shots = [s for s in night.shots if pointed(s)]
    centres = np.concatenate(
        [site.refracted(_axes(s.pointing)[2:], earth_state(s.utc_unix_s)) for s in shots]
    )
    shown = _different(shots, centres)
    outlines = [site.refracted(_outline(s), earth_state(s.utc_unix_s)) for s in shown]
    reach = _reach(np.concatenate(outlines))
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    _bright(axes, site, earth_state(np.median([s.utc_unix_s for s in shots])), catalogue, reach)
    for shot, outline in zip(shown, outlines, strict=True):
        axes.plot(*polar(outline), color=ORANGE, lw=1.3)
        if len(shot.xy):
            stars = site.refracted(looking(shot, shot.xy), earth_state(shot.utc_unix_s))
            axes.scatter(*polar(stars), s=_dot(shot.magnitudes), color=BLUE, lw=0, zorder=3)
    axes.plot(*polar(centres), "+", color=ORANGE, ms=7, mew=1.4, zorder=4)
    axes.set_rlim(0, reach)
    axes.set_xticks(np.radians(np.arange(0, 360, 45)), ["N", "NE", "E", "SE", "S", "SW", "W", "NW"])
    rings = np.linspace(0, reach, 4)[1:]
    axes.set_rgrids(rings, [f"{r:.3g}°" for r in rings], angle=22.5, fontsize=8, color=GREY)
    axes.grid(alpha=0.3, lw=0.6)
    _legend(axes)


def _legend(axes) -> None:
    from matplotlib.lines import Line2D

    def dot(colour, magnitude, text, **more):
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
    """Area in points squared."""
    return 1.2 + 1.1 * np.clip(FAINTEST_DOT - np.nan_to_num(magnitude, nan=9.0), 0, None) ** 1.7


def _bright(axes, site: Site, state: EarthState, catalogue: Catalogue, reach: float) -> None:
    """The brightest stars of the part of the sky that is shown."""
    index = site.overhead(catalogue, state, np.array([0.0, 0.0, 1.0]), np.radians(reach), 6.5)[:BRIGHT]
    v = site.observed(catalogue, index, state)
    theta, r = polar(v)
    inside = r < reach
    size = _dot(catalogue.vmag(index))
    axes.scatter(theta[inside], r[inside], s=size[inside], color=GREY, alpha=0.6, lw=0, zorder=2)


def polar(enu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth in rad and zenith distance in deg."""
    return np.arctan2(enu[:, 0], enu[:, 1]), np.degrees(np.arctan2(np.hypot(enu[:, 0], enu[:, 1]), enu[:, 2]))


def _axes(a: Attitude) -> np.ndarray:
    """Rows x (columns), y (rows) and z of the camera in ICRS (3, 3)."""
    ca, sa, cd, sd = np.cos(a.ra), np.sin(a.ra), np.cos(a.dec), np.sin(a.dec)
    east, north = np.array([-sa, ca, 0.0]), np.array([-sd * ca, -sd * sa, cd])
    cr, sr = np.cos(a.roll), np.sin(a.roll)
    x = sr * north - cr * east
    return np.stack([-x if a.mirrored else x, -(cr * north + sr * east), [cd * ca, cd * sa, sd]])


def looking(shot: Shot, xy: np.ndarray) -> np.ndarray:
    """ICRS directions (N, 3) of pixels, without distortion."""
    centre = (np.array(shot.size) - 1) / 2
    plane = (xy - centre) / shot.pointing.focal_px
    v = np.column_stack([plane, np.ones(len(plane))]) @ _axes(shot.pointing)
    return normalised(v)


def _outline(shot: Shot) -> np.ndarray:
    width, height = shot.size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height], [0, 0]], float) - 0.5
    steps = np.linspace(0, 1, 9)[:-1, None]
    sides = [a + (b - a) * steps for a, b in pairwise(corners)]
    return looking(shot, np.concatenate([*sides, corners[:1]]))


def _different(shots: Sequence[Shot], centres: np.ndarray) -> list[Shot]:
    """Frames that look elsewhere than those before, a dozen at most."""
    kept: list[int] = []
    for k, shot in enumerate(shots):
        field = 0.5 * shot.size[1] / shot.pointing.focal_px
        if all(np.linalg.norm(centres[k] - centres[j]) > field for j in kept):
            kept.append(k)
        if len(kept) == OUTLINES:
            break
    return [shots[k] for k in kept]


def _reach(enu: np.ndarray) -> float:
    furthest = 1.08 * polar(enu)[1].max()
    return next((r for r in REACHES_DEG if r >= furthest), 90)
