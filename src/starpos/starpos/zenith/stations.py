# SPDX-License-Identifier: Apache-2.0
"""Results of sessions read from files, joined to stations, and compared with a geoid grid."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import special

from starpos.earth.geoid import Geoid
from starpos.earth.place import Place
from starpos.earth.vertical import Deflection
from starpos.errors import StarposError, StationError
from starpos.files import read_regular
from starpos.units import unix_of

MAX_BYTES = 50_000_000
# of a correlation
ROUNDING = 1e-6
MADE_BY = "starpos deflection --json > session.json"
# Errors that are new in each session.  All others are common to the sessions of an instrument, as far as anyone knows,
# and no number of them averages these.
NEW = frozenset(
    {
        "tilt readings",
        "tilt quantisation",
        "tilt drift",
        "tilt temperature",
        "tilt scale",
        "tilt cross",
        "tilt face",
        "centroids",
        "image motion",
        "anomalous refraction",
    }
)


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionResult:
    """A session's deflection at a mark, arcsec: xi, eta.

    station: name of the mark; '' for none.  place: of the mark, with its height.
    mark, geoid (2,): without the tide, at the mark and at the geoid.
    covariance (2, 2), and common (2, 2): the part that the sessions of an instrument share.
    """

    path: Path
    station: str
    place: Place
    utc_unix_s: float
    mark: np.ndarray
    geoid: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    frames: int

    @property
    def new(self) -> np.ndarray:
        """Covariance (2, 2) of what is new in this session."""
        values, axes = np.linalg.eigh(self.covariance - self.common)
        least = 1e-6 * np.trace(self.covariance)
        return (axes * np.maximum(values, least)) @ axes.T


def read_session(path: Path | str) -> SessionResult:
    """Read a session's result; StationError says why a file is not one."""
    path = Path(path)
    try:
        lines = [
            json.loads(line) for line in read_regular(path, MAX_BYTES).decode().splitlines() if line.strip()
        ]
        whole = [line for line in lines if line.get("combined") is True and "xi_arcsec" in line]
        if len(whole) != 1:
            raise StationError(
                f"{path}: {len(whole)} lines with a session's deflection in it, one is wanted: make it with `{MADE_BY}`"
            )
        return _session(path, whole[0])
    except OSError as e:
        raise StationError(
            f"{path}: cannot be read ({e.strerror or e}): give the output of `{MADE_BY}`"
        ) from None
    except StationError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, StarposError) as e:
        said = f"no {e}" if isinstance(e, KeyError) else str(e)
        raise StationError(f"{path}: no session's result ({said[:100]}): make it with `{MADE_BY}`") from None


def _session(path: Path, value: Mapping) -> SessionResult:
    site, reduced = value["site"], value["reduced"]
    covariance = _array(value["covariance_arcsec2"], (2, 2))
    terms = tuple((str(name), float(xi), float(eta)) for name, (xi, eta) in value["errors"].items())
    # sessions from before correlations were written have none
    correlations = value.get("correlations", {})
    common = np.zeros((2, 2))
    for name, *sizes in terms:
        r = 0.0 if name in NEW else float(correlations.get(name, 0.0))
        if not abs(r) <= 1 + ROUNDING:
            raise ValueError(f"correlations has {r} for {name}")
        common += np.outer(sizes, sizes) * [[1.0, r], [r, 1.0]] * (name not in NEW)
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise ValueError("covariance_arcsec2 is no covariance")
    latitude, longitude, height_m = (float(site[k]) for k in ("latitude", "longitude", "height_m"))
    if not (abs(latitude) <= 90 and abs(longitude) <= 360 and np.isfinite(height_m)):
        raise ValueError("site is no place")
    return SessionResult(
        path=path,
        station=str(value["station"]),
        place=Place.on_ellipsoid(latitude, longitude, height_m=height_m),
        utc_unix_s=unix_of(value["utc"]),
        mark=_array(reduced["mark_arcsec"], (2,)),
        geoid=_array(reduced["geoid_arcsec"], (2,)),
        covariance=covariance,
        common=common,
        frames=int(value["frames"]),
    )


def _array(values: list, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{values} are not {shape} finite numbers")
    return array


# Sessions so close to each other are of one mark: GNSS knows it to centimetres, and 1 m is 0.03 arcsec.
SAME_MARK_M = 1.0
# chi-square over its degrees of freedom that repeats reach by chance in one station of a thousand
UNLIKELY = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class Station:
    """The deflection of a mark, tide free, of all its sessions: xi, eta in arcsec.

    place: with its height.  at_mark, at_geoid (2,), covariance (2, 2).
    common (2, 2): part of the covariance that all stations of the instrument share.
    off (K, 2): each session minus the station.  chi2, degrees: of these against what is new in each session.
    scaled: factor of the new errors, above 1 where the sessions scatter more than they state (Birge 1932).
    """

    name: str
    place: Place
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
        return float(special.chdtrc(self.degrees, self.chi2)) if self.degrees else 1.0

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
    apart = float(np.hypot(*a.place.offset_m(b.place.latitude, b.place.longitude)))
    named = a.station and a.station == b.station
    if named and apart > SAME_MARK_M:
        raise StationError(
            f"{a.path} and {b.path}: both are of station {a.station}, but their marks are {apart:.1f} m apart: give the "
            "same --site, or other names"
        )
    return bool(named) or (apart < SAME_MARK_M and not (a.station and b.station))


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
    return Station(
        name=next((s.station for s in sessions if s.station), number),
        place=sessions[0].place,
        sessions=tuple(sessions),
        at_mark=at_mark,
        at_geoid=mean(np.array([s.geoid for s in sessions])),
        covariance=scaled * new + common,
        common=common,
        off=off,
        chi2=chi2,
        degrees=degrees,
    )


def against_grid(station: Station, geoid: Geoid) -> tuple[Deflection, np.ndarray, np.ndarray] | None:
    """A grid's deflection, and the station's at the geoid minus it with 1 sigma (2,) each, arcsec; None without data.

    Both are at the geoid: the station's by the normal plumb line, so that mountains remain in the difference.
    """
    grid = geoid.at(station.place.latitude, station.place.longitude)
    if not grid.known:
        return None
    off = station.at_geoid - [grid.xi_arcsec, grid.eta_arcsec]
    return grid, off, np.hypot(station.sigma, grid.stddev_arcsec)
