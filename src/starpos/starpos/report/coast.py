# SPDX-License-Identifier: Apache-2.0
"""Coast lines of the Earth, and the map that shows where on it a place is. The dashboard serves the same file.

Natural Earth 1:110m as world-atlas has it: TopoJSON, lines of steps on a grid
(https://github.com/topojson/topojson-specification).
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.earth.ellipsoid import EARTH_RADIUS_M, enu_axes
from starpos.report.style import BLUE, GREY, ORANGE
from starpos.rotation import unit_vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COAST_FILE = Path(__file__).with_name("data") / "land-110m.json"
# radius of the lens, and steps of the graticule on the globe and in the lens, in degrees
LENS, STEPS = 10, (30, 5)
# sizes of the place's mark there, points
MARKERS = (8.0, 2.5)
# radius of an ellipse that holds a place with 95 %, in sigma
SIGMAS_95 = 2.4477


def coast_lines() -> list[np.ndarray]:
    """Coast lines, each (N, 2): longitude and latitude in deg."""
    topology = json.loads(COAST_FILE.read_text(encoding="utf-8"))
    grid = topology["transform"]
    return [np.cumsum(arc, axis=0) * grid["scale"] + grid["translate"] for arc in topology["arcs"]]


def draw_map(
    figure: "Figure", latitude: float, longitude: float, covariance: np.ndarray | None = None
) -> None:
    """Draw the Earth from above a place in rad, north on top, and a lens with the lands around.

    covariance: (2, 2) of east and north in m, for the lens to show the ellipse that holds the place with 95 %.
    """
    globe = figure.subplots()
    lens = globe.inset_axes((0.64, 0.0, 0.36, 0.36))
    coast = _joined(coast_lines())
    for axes, reach, step, size in zip((globe, lens), (90, LENS), STEPS, MARKERS, strict=True):
        _draw_disc(axes, np.sin(np.radians(reach)), size, *(
            _projected(latitude, longitude, lines) for lines in (_graticule(step), coast)
        ))  # fmt: skip
    if covariance is not None:
        around = np.linspace(0, 2 * np.pi, 73)
        root = SIGMAS_95 * np.linalg.cholesky(covariance) / EARTH_RADIUS_M
        lens.plot(*(root @ [np.cos(around), np.sin(around)]), color=ORANGE, lw=1.2)


def _draw_disc(axes: "Axes", radius: float, size: float, graticule: np.ndarray, coast: np.ndarray) -> None:
    from matplotlib.patches import Circle

    rim = axes.add_patch(Circle((0, 0), radius, fc="#eef4f8", ec=GREY, lw=1.0))
    for lines, colour, width in ((graticule, "#c3cdd4", 0.6), (coast, BLUE, 1.0)):
        (line,) = axes.plot(*lines.T, color=colour, lw=width)
        line.set_clip_path(rim)
    axes.plot(0, 0, "o", color=ORANGE, ms=size, mec="black", mew=size / 10)
    limits = (-1.01 * radius, 1.01 * radius)
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    axes.set_axis_off()


def _projected(latitude: float, longitude: float, lines: np.ndarray) -> np.ndarray:
    """Orthographic projection (N, 2), in radii of the Earth, of longitudes and latitudes (N, 2) in deg; NaN behind it."""
    v = unit_vector(*np.radians(lines).T) @ enu_axes(latitude, longitude).T
    return np.where(v[:, 2:] >= 0, v[:, :2], np.nan)


def _graticule(step: int) -> np.ndarray:
    """Parallels and meridians (N, 2) in deg."""
    around, upward = np.arange(-180.0, 181.0), np.arange(-90.0, 91.0)
    parallels = [np.column_stack([around, np.full_like(around, at)]) for at in range(-90 + step, 90, step)]
    meridians = [np.column_stack([np.full_like(upward, at), upward]) for at in range(-180, 180, step)]
    return _joined(parallels + meridians)


def _joined(lines: list[np.ndarray]) -> np.ndarray:
    """Lines as one (N, 2), with a row of NaN after each."""
    return np.concatenate([part for line in lines for part in (line, np.full((1, 2), np.nan))])
