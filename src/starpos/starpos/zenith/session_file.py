# SPDX-License-Identifier: Apache-2.0
"""Reads the result of a session, which `starpos deflection --json` printed."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

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

    station: name of the mark; '' for none.  latitude, longitude (rad), height_m: of the mark on WGS 84.
    seen (2,): as the plumb line stood.  tide (2,), curvature: what tide and normal plumb line added.
    mark, geoid (2,): without the tide, at the mark and at the geoid.
    covariance (2, 2), and common (2, 2): the part that the sessions of an instrument share.
    terms: 1 sigma of xi and eta for each source of error.  stars: their number.
    """

    path: Path
    station: str
    latitude: float
    longitude: float
    height_m: float
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


def read(path: Path | str) -> SessionResult:
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
        latitude=float(np.radians(latitude)),
        longitude=float(np.radians(longitude)),
        height_m=height_m,
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
