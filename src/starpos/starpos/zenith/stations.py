# SPDX-License-Identifier: Apache-2.0
"""Results of sessions read from files, joined to stations, and levelled: how much the geoid rises between stations.

N_B - N_A = - integral of epsilon ds, with epsilon = xi cos(alpha) + eta sin(alpha) at the geoid, along the azimuth alpha
(Hofmann-Wellenhof and Moritz, Physical Geodesy (2005), equation 5-116).  Between two stations epsilon is taken to be
linear, so that the integral is the mean of both times the distance; how far it is not linear is in the error.  A geoid
grid has the shape between the stations: with one, only what the stations have more than the grid is linear.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.geoid import Geoid
from starpos.earth.place import Place
from starpos.earth.vertical import UNKNOWN_STDDEV_ARCSEC, Deflection
from starpos.errors import StarposError, StationError
from starpos.files import read_regular
from starpos.rotation import half_turns
from starpos.units import ARCSEC, unix_of

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


@dataclass(frozen=True, kw_only=True)
class FrameResult:
    """The deflection of one frame alone, arcsec, with its 1 sigma; face: number of its face, from 1."""

    utc_unix_s: float
    face: int
    xi: float
    eta: float
    sigma_xi: float
    sigma_eta: float


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceResult:
    """A face against the others, arcsec: off, stddev (2,) of xi and eta."""

    face: int
    heading_deg: float
    frames: int
    off: np.ndarray
    stddev: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionResult:
    """A session's deflection at a mark, arcsec: xi, eta.

    station: name of the mark; '' for none.  place: of the mark, with its height.
    seen (2,): as the plumb line stood.  tide (2,), curvature: what tide and normal plumb line added.
    mark, geoid (2,): without the tide, at the mark and at the geoid.
    covariance (2, 2), and common (2, 2): the part that the sessions of an instrument share.
    terms: 1 sigma of xi and eta for each source of error.  stars: their number.
    """

    path: Path
    station: str
    place: Place
    utc_unix_s: float
    duration_s: float
    seen: np.ndarray
    tide: np.ndarray
    curvature: float
    mark: np.ndarray
    geoid: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    terms: tuple[tuple[str, float, float], ...]
    motion_arcsec: float
    stars: int
    face_count: int
    frame_count: int
    frames: tuple[FrameResult, ...]
    faces: tuple[FaceResult, ...]

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
        return _session(
            path, whole[0], [line for line in lines if line.get("status") == "ok" and "face" in line]
        )
    except OSError as e:
        raise StationError(
            f"{path}: cannot be read ({e.strerror or e}): give the output of `{MADE_BY}`"
        ) from None
    except StationError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, StarposError) as e:
        said = f"no {e}" if isinstance(e, KeyError) else str(e)
        raise StationError(f"{path}: no session's result ({said[:100]}): make it with `{MADE_BY}`") from None


def _session(path: Path, value: Mapping, frames: list) -> SessionResult:
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
        duration_s=float(value["duration_s"]),
        seen=_array([value["xi_arcsec"], value["eta_arcsec"]], (2,)),
        tide=_array(reduced["tide_arcsec"], (2,)),
        curvature=float(reduced["curvature_arcsec"][0]),
        mark=_array(reduced["mark_arcsec"], (2,)),
        geoid=_array(reduced["geoid_arcsec"], (2,)),
        covariance=covariance,
        common=common,
        terms=terms,
        motion_arcsec=float(value["image_motion_arcsec"]),
        stars=int(value["stars"]),
        face_count=int(value["faces"]),
        frame_count=int(value["frames"]),
        frames=tuple(_frame(line) for line in frames),
        faces=tuple(_face(line) for line in value["by_face"]),
    )


def _array(values: list, shape: tuple[int, ...]) -> np.ndarray:
    array = np.array(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{values} are not {shape} finite numbers")
    return array


def _frame(line: Mapping) -> FrameResult:
    return FrameResult(
        utc_unix_s=unix_of(line["utc"]),
        face=int(line["face"]),
        xi=float(line["xi_arcsec"]),
        eta=float(line["eta_arcsec"]),
        sigma_xi=float(line["sigma_xi_arcsec"]),
        sigma_eta=float(line["sigma_eta_arcsec"]),
    )


def _face(line: Mapping) -> FaceResult:
    return FaceResult(
        face=int(line["face"]),
        heading_deg=float(line["heading"]),
        frames=int(line["frames"]),
        off=np.array(line["off_arcsec"], float),
        stddev=np.array(line["stddev_arcsec"], float),
    )


# Sessions so close to each other are of one mark: GNSS knows it to centimetres, and 1 m is 0.03 arcsec.
SAME_MARK_M = 1.0
# so near a pole east and west have no meaning, rad
NEAREST_POLE = 1e-6
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
    north, east = offset_m(a.place, b.place)
    apart = float(np.hypot(north, east))
    named = a.station and a.station == b.station
    if named and apart > SAME_MARK_M:
        raise StationError(
            f"{a.path} and {b.path}: both are of station {a.station}, but their marks are {apart:.1f} m apart: give the "
            "same --site, or other names"
        )
    return bool(named) or (apart < SAME_MARK_M and not (a.station and b.station))


def offset_m(a: Place, b: Place) -> tuple[float, float]:
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
    grid = geoid.at(station.place.latitude, station.place.longitude)
    if not grid.known:
        return None
    return AgainstGrid(
        grid=grid,
        off=station.at_geoid - [grid.xi_arcsec, grid.eta_arcsec],
        stddev=np.hypot(station.sigma, grid.stddev_arcsec),
    )


# Correlation length of deflections over land, m, where no grid shows their field.  Deflections of UNKNOWN_STDDEV_ARCSEC
# then change by 0.75 arcsec a kilometre, as under a horizontal gradient of gravity of 36 Eotvos, which hills have; high
# mountains have more.
FIELD_LENGTH_M = 8_000.0
# points of the path at which the field is evaluated
POINTS = 65
# The mean latitude serves for distance and azimuth, to 1e-6 of the distance up to here.
MAX_STEP_M = 200_000.0


@dataclass(frozen=True, eq=False, kw_only=True)
class GeoidStep:
    """The rise of the geoid from one station to the next.

    rise_m, stddev_m: N_B - N_A, with 1 sigma.  measured_m: its part by the deflections' errors.  between_m: by the field
    between the stations.  azimuth (rad), distance_m: from A to B.
    """

    begin: Station
    end: Station
    distance_m: float
    azimuth: float
    rise_m: float
    stddev_m: float
    measured_m: float
    between_m: float


def levelled(line: Sequence[Station], geoid: Geoid | None) -> tuple[GeoidStep, ...]:
    """The steps along a line of stations; with more than one, the last one is from the first station to the last.

    geoid: a grid whose shape is taken between the stations.  Raises StationError if it has no data there, or a step is
    too long.
    """
    steps = [_Step.of(a, b, geoid) for a, b in pairwise(line)]
    rises = [_joined([step]) for step in steps]
    return (*rises, _joined(steps)) if len(steps) > 1 else tuple(rises)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Step:
    """A step, linear in the deflections.

    slope (2,): derivative of rise_m by xi, eta in arcsec at either end.  between_m: 1 sigma by the field between.
    """

    begin: Station
    end: Station
    north: float
    east: float
    rise_m: float
    slope: np.ndarray
    between_m: float

    @classmethod
    def of(cls, begin: Station, end: Station, geoid: Geoid | None) -> "_Step":
        north, east = offset_m(begin.place, end.place)
        distance = float(np.hypot(north, east))
        if distance > MAX_STEP_M:
            raise StationError(
                f"{begin.name} and {end.name} are {distance / 1000:.0f} km apart, levelling takes steps of at most "
                f"{MAX_STEP_M / 1000:.0f} km: add stations between them"
            )
        # s times the unit vector along the azimuth is (north, east)
        slope = -0.5 * ARCSEC * np.array([north, east])
        seen = begin.at_geoid + end.at_geoid
        if geoid is None:
            rise, stddev, length = 0.0, UNKNOWN_STDDEV_ARCSEC, FIELD_LENGTH_M
        else:
            grids = [geoid.at(s.latitude, s.longitude) for s in (begin.place, end.place)]
            heights = [geoid.undulation_m(s.latitude, s.longitude) for s in (begin.place, end.place)]
            if not (np.isfinite(heights).all() and all(g.known for g in grids)):
                raise StationError(f"{begin.name} to {end.name}: the geoid grid has no data at both of them")
            seen = seen - np.sum([[g.xi_arcsec, g.eta_arcsec] for g in grids], 0)
            rise = heights[1] - heights[0]
            # what the grid does not resolve changes within its spacing
            stddev, length = max(g.stddev_arcsec for g in grids), geoid.node_m(begin.place.latitude)
        return cls(
            begin=begin,
            end=end,
            north=north,
            east=east,
            rise_m=float(rise + slope @ seen),
            slope=slope,
            between_m=between_m(distance, stddev, length),
        )


def _joined(steps: Sequence[_Step]) -> GeoidStep:
    north, east = sum(s.north for s in steps), sum(s.east for s in steps)
    # a station between two steps counts in both; what all stations share, along the whole way
    slopes: dict[int, np.ndarray] = {}
    stations: dict[int, Station] = {}
    for step in steps:
        for station in (step.begin, step.end):
            slopes[id(station)] = slopes.get(id(station), np.zeros(2)) + step.slope
            stations[id(station)] = station
    own = sum(float(slopes[k] @ (s.covariance - s.common) @ slopes[k]) for k, s in stations.items())
    whole = np.sum(list(slopes.values()), 0)
    common = max(float(whole @ s.common @ whole) for s in stations.values())
    measured = float(np.sqrt(own + common))
    between = float(np.sqrt(sum(s.between_m**2 for s in steps)))
    return GeoidStep(
        begin=steps[0].begin,
        end=steps[-1].end,
        distance_m=float(np.hypot(north, east)),
        azimuth=float(np.arctan2(east, north) % (2 * np.pi)),
        rise_m=sum(s.rise_m for s in steps),
        stddev_m=float(np.hypot(measured, between)),
        measured_m=measured,
        between_m=between,
    )


def between_m(distance_m: float, stddev_arcsec: float, length_m: float) -> float:
    """1 sigma (m) of the mean of both ends times the distance, for the integral of a random field between them.

    The field is a Gauss-Markov process of second order with that standard deviation and correlation length.
    """
    at = np.linspace(0, distance_m, POINTS)
    far = np.abs(at[:, None] - at) / length_m
    field = (1 + far) * np.exp(-far)
    weight = np.full(POINTS, distance_m / (POINTS - 1))
    weight[[0, -1]] /= 2
    weight[[0, -1]] -= distance_m / 2
    return float(stddev_arcsec * ARCSEC * np.sqrt(max(weight @ field @ weight, 0.0)))
