# SPDX-License-Identifier: Apache-2.0
"""Stations: the sessions of one mark as one deflection, repeats compared, and the deflections of a geoid grid."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.geoid import Geoid
from starpos.earth.vertical import Deflection
from starpos.errors import StationError
from starpos.rotation import half_turns
from starpos.zenith.session_file import SessionResult

# Sessions so close to each other are of one mark: GNSS knows it to centimetres, and 1 m is 0.03 arcsec.
SAME_MARK_M = 1.0
# so near a pole east and west have no meaning, rad
NEAREST_POLE = 1e-6
# chi-square over its degrees of freedom that repeats reach by chance in one station of a thousand
UNLIKELY = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """The deflection of a mark, tide free, of all its sessions: xi, eta in arcsec.

    latitude, longitude (rad), height_m: on WGS 84.  at_mark, at_geoid (2,), covariance (2, 2).
    common (2, 2): part of the covariance that all stations of the instrument share.
    off (K, 2): each session minus the station.  chi2, degrees: of these against what is new in each session.
    scaled: factor of the new errors, above 1 where the sessions scatter more than they state (Birge 1932).
    """

    name: str
    latitude: float
    longitude: float
    height_m: float
    sessions: tuple[SessionResult, ...]
    at_mark: np.ndarray
    at_geoid: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    off: np.ndarray
    chi2: float
    degrees: int

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (2,) of xi, eta."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def probability(self) -> float:
        """Probability that its sessions differ by as much, by chance; 1 of a single one."""
        # slow to import
        from scipy.stats import chi2

        return float(chi2.sf(self.chi2, self.degrees)) if self.degrees else 1.0

    @property
    def doubt(self) -> str:
        """A sentence if its sessions contradict each other, else ''."""
        if self.probability > UNLIKELY:
            return ""
        xi, eta = np.ptp(self.off, axis=0)
        return (
            f"station {self.name}: its {len(self.sessions)} sessions differ by {xi:.2f} and {eta:.2f} arcsec, "
            f"chi-square {self.chi2:.0f} of {self.degrees}: its error is made larger to match; look for a mark or an "
            "instrument that moved"
        )


def stations_of(sessions: Sequence[SessionResult]) -> list[Station]:
    """Stations in order of their first session in the sequence, of sessions of one name, or within SAME_MARK_M.

    Raises StationError where sessions of one name are of several marks.
    """
    groups: list[list[SessionResult]] = []
    for session in sessions:
        home = next((g for g in groups if _same(g[0], session)), None)
        if home is None:
            groups.append([session])
        else:
            home.append(session)
    return [_station(group, f"{k + 1}") for k, group in enumerate(groups)]


def _same(a: SessionResult, b: SessionResult) -> bool:
    north, east = offset_m(a, b)
    apart = float(np.hypot(north, east))
    named = a.station and a.station == b.station
    if named and apart > SAME_MARK_M:
        raise StationError(
            f"{a.path} and {b.path}: both are of station {a.station}, but their marks are {apart:.1f} m apart: give the "
            "same --site, or other names"
        )
    return bool(named) or (apart < SAME_MARK_M and not (a.station and b.station))


def offset_m(a: "SessionResult | Station", b: "SessionResult | Station") -> tuple[float, float]:
    """How far b is to the north and to the east of a, m, by the radii at their middle latitude (Gauss)."""
    middle = (a.latitude + b.latitude) / 2
    prime, meridian = curvature_radii_m(middle)
    east = half_turns(np.array(b.longitude - a.longitude)) * max(np.cos(middle), NEAREST_POLE)
    return float(meridian * (b.latitude - a.latitude)), float(prime * east)


def _station(sessions: list[SessionResult], number: str) -> Station:
    weights = np.array([np.linalg.inv(s.new) for s in sessions])
    new = np.linalg.inv(weights.sum(0))
    share = new @ weights

    def mean(values: np.ndarray) -> np.ndarray:
        return np.einsum("kij,kj->i", share, values)

    at_mark = mean(np.array([s.mark for s in sessions]))
    off = np.array([s.mark for s in sessions]) - at_mark
    chi2, degrees = float(np.einsum("ki,kij,kj->", off, weights, off)), 2 * len(sessions) - 2
    scaled = max(1.0, chi2 / degrees) if degrees else 1.0
    common = np.einsum("kia,kab,kjb->ij", share, np.array([s.common for s in sessions]), share)
    # errors that all share are not of independent sessions: they do not average
    values, axes = np.linalg.eigh(np.mean([s.common for s in sessions], 0) - common)
    common = common + (axes * np.maximum(values, 0.0)) @ axes.T
    first = sessions[0]
    return Station(
        name=next((s.station for s in sessions if s.station), number),
        latitude=first.latitude,
        longitude=first.longitude,
        height_m=first.height_m,
        sessions=tuple(sessions),
        at_mark=at_mark,
        at_geoid=mean(np.array([s.geoid for s in sessions])),
        covariance=scaled * new + common,
        common=common,
        off=off,
        chi2=chi2,
        degrees=degrees,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class AgainstGrid:
    """A station's deflection at the geoid minus a grid's, arcsec: off, stddev (2,); grid: the grid's own."""

    grid: Deflection
    off: np.ndarray
    stddev: np.ndarray


def against_grid(station: Station, geoid: Geoid) -> AgainstGrid | None:
    """The difference of a station from a grid; None where the grid has no data.

    Both are at the geoid: the station's by the normal plumb line, so that mountains remain in the difference.
    """
    grid = geoid.at(station.latitude, station.longitude)
    if not grid.known:
        return None
    return AgainstGrid(
        grid=grid,
        off=station.at_geoid - [grid.xi_arcsec, grid.eta_arcsec],
        stddev=np.hypot(station.sigma, grid.stddev_arcsec),
    )
