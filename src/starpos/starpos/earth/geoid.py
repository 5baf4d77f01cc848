# SPDX-License-Identifier: Apache-2.0
"""The deflection of the vertical from the slopes of a geoid grid, with an error for what the grid cannot resolve."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.geoid_file import Grid, read_grid
from starpos.earth.vertical import Deflection
from starpos.units import ARCSEC

if TYPE_CHECKING:
    from scipy.interpolate import RectBivariateSpline

# Nodes under the spline in each direction: with 8 its ends have no effect (0.27^8), with 2 it is a single cubic.
REACHES = (8, 4, 2)
# The error comes from the grid's roughness, the change of slope from node to node, within this distance and number of
# nodes in each direction,
ROUGH_DEG, ROUGH_NODES = 0.5, (8, 60)
# times this factor. With it the slopes of EGM96 differ from the national geoids of Australia, Austria, Iceland,
# the Netherlands, Poland, South Africa, Spain, Switzerland and the USA by 0.3 (islands of the USA) to 1.2 (Iceland)
# sigma, root mean square (tools/data/geoid_sigma.py).
UNRESOLVED = 1.5
FLOOR_ARCSEC = 0.5
# Closer to a pole than this, converging meridians distort the estimate of the geoid's roughness.
ROUGH_NORTH_DEG = 87.0
# 111 m from a pole; closer, east and west have no meaning.
NEAREST_POLE_DEG = 1e-3
WIDEST_STRIDE_DEG = 10.0
# Larger values come from an edge of the data; the Earth's own deflections stay below 100.
LARGEST_ARCSEC = 120.0


@dataclass(frozen=True, eq=False)
class Geoid:
    """Deflections of the vertical from a Grid of geoid undulations."""

    grid: Grid

    def at(self, latitude: float, longitude: float) -> Deflection:
        """The Deflection at a place in rad; the default Deflection, of unknown value, if the grid has no data there.

        xi = -dN / (M dphi), eta = -dN / (N' cos(phi) dlambda): Heiskanen & Moritz, Physical Geodesy (1967), section 2-22,
        with the radii M, N' of WGS 84 and a cubic spline through the nodes. Undulations N are heights of the geoid above
        the ellipsoid, so these are deflections at the geoid, under the ground; `vertical.AtHeight` takes them up to the
        instrument, by the curvature of normal plumb lines. (Some national grids are of a quasi-geoid. Its undulations are
        height anomalies, which belong to the ground, but are against normal gravity there: the same curvature is
        missing.) In mountains real plumb lines curve by some arcseconds more. No geoid grid shows that; the stated error
        includes it. An astronomic place may be given for a geodetic one: 10 arcsec (300 m) make no difference.
        """
        phi = np.clip(np.degrees(latitude), NEAREST_POLE_DEG - 90, 90 - NEAREST_POLE_DEG)
        lam = np.degrees(longitude)
        if not np.isfinite([phi, lam]).all():
            return Deflection()
        xi, eta = self._slopes(phi, lam)
        stddev = math.hypot(FLOOR_ARCSEC, UNRESOLVED * self._roughness(phi, lam))
        # false for NaN too
        if not all(abs(v) < LARGEST_ARCSEC for v in (xi, eta, stddev)):
            return Deflection()
        return Deflection(xi, eta, stddev)

    def undulation_m(self, latitude: float, longitude: float) -> float:
        """Height (m) of the geoid above WGS 84 at a place in rad; NaN without data."""
        spline, row, column, _, _ = self._spline(float(np.degrees(latitude)), float(np.degrees(longitude)))
        return math.nan if spline is None else float(spline(row, column).item())

    def node_m(self, latitude: float) -> float:
        """Distance (m) between nodes to the north at a latitude in rad."""
        return self._spacing_m(float(np.degrees(latitude)))[0]

    def _slopes(self, phi: float, lam: float) -> tuple[float, float]:
        """Components xi and eta in arcsec; NaN without data."""
        spline, row, column, north_m, east_m = self._spline(phi, lam)
        if spline is None:
            return math.nan, math.nan
        xi, eta = -spline(row, column, dx=1) / north_m, -spline(row, column, dy=1) / east_m
        return float(xi.item() / ARCSEC), float(eta.item() / ARCSEC)

    def _spline(
        self, phi: float, lam: float
    ) -> "tuple[RectBivariateSpline | None, float, float, float, float]":
        """Spline of undulations (m) around a place, None without data; its row and column there; m for one of each."""
        # slow to import, and only needed with a grid
        from scipy.interpolate import RectBivariateSpline

        north_m, east_m, stride = self._spacing_m(phi)
        for reach in REACHES:
            nodes, row, column = self._window(phi, lam, reach, reach, stride)
            if np.isfinite(nodes).all():
                at = np.arange(2 * reach)
                return RectBivariateSpline(at, at, nodes), row, column, north_m, east_m
        return None, math.nan, math.nan, north_m, east_m

    def _roughness(self, phi: float, lam: float) -> float:
        """Root mean square change of the slope from node to node around a place, arcsec; NaN without data."""
        phi = np.clip(phi, -ROUGH_NORTH_DEG, ROUGH_NORTH_DEG)
        north_m, east_m, stride = self._spacing_m(phi)
        up = int(np.clip(round(ROUGH_DEG / self.grid.step_latitude), *ROUGH_NODES))
        across = max(ROUGH_NODES[0], round(up * north_m / east_m))
        nodes, _, _ = self._window(phi, lam, up, across, stride)
        north = np.diff(nodes, 2, axis=0)[:, 1:-1] / north_m**2
        east = np.diff(nodes, 2, axis=1)[1:-1] / east_m**2
        bends = np.concatenate([north.ravel(), east.ravel()])
        bends = bends[np.isfinite(bends)]
        return float(np.sqrt(np.mean(bends**2)) * north_m / ARCSEC) if bends.size else math.nan

    def _spacing_m(self, phi: float) -> tuple[float, float, int]:
        """Distances (m) between nodes to the north and to the east, and the number of columns from one to the next.

        It is more than 1 near the poles, where columns are so close that the rounding of the file would make slopes.
        """
        prime, meridian = curvature_radii_m(np.radians(phi))
        north_m = meridian * np.radians(self.grid.step_latitude)
        column_m = prime * np.cos(np.radians(phi)) * np.radians(self.grid.step_longitude)
        widest = max(1, int(WIDEST_STRIDE_DEG / self.grid.step_longitude))
        stride = int(np.clip(np.ceil(0.1 * north_m / column_m), 1, widest))
        return north_m, stride * column_m, stride

    def _window(
        self, phi: float, lam: float, up: int, across: int, stride: int
    ) -> tuple[np.ndarray, float, float]:
        """Undulations (2 up, 2 across) around a place, NaN where unknown, and row and column of the place in them."""
        row, column = self.grid.locate(phi, lam)
        rows = np.arange(1 - up, 1 + up) + math.floor(row)
        columns = np.arange(1 - across, 1 + across) * stride + math.floor(column)
        nodes = self.grid.undulations(rows, columns)
        return nodes, row - rows[0], (column - columns[0]) / stride


def read(path: Path | str) -> Geoid:
    """Read a Geoid from a GTX, .bin (NGS) or GeoTIFF file.

    A file name without a folder is also looked for among PROJ's grids.

    GeoidError says why a file cannot be used.
    """
    return Geoid(read_grid(path))
