# SPDX-License-Identifier: Apache-2.0
"""A night: its frames, the answer of each, and their average."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m, enu_axes, zenith_of
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.fix.fix import InDegrees, PlaceFix
from starpos.fix.heading import AttitudeAtPlace
from starpos.fix.solution import FieldPointing, Solution, Status
from starpos.frames.frame import Stars

if TYPE_CHECKING:
    from starpos.night.beside_gnss import WatchedNight

NO_TILT = (float("nan"), float("nan"))
NO_STARS = np.zeros((0, 2))
# maximum number of frames shown in a notebook
SHOWN = 20


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """One frame: its status, and the part of its answer that was found.

    Attributes
    ----------
    utc_unix_s : NaN if unknown
    size : of the frame in px
    tilt : rad
    xy, residual_px : (M, 2), seen places of the stars of its fix, and these minus the fitted ones
    magnitudes, names : (M,) of them
    camera_to_itrs : (3, 3), attitude against the Earth by the stars alone
    at_place : heading, pitch and roll at a known place; None without one
    warnings : what is suspicious about its identification, as `Solution.warnings`

    Examples
    --------
    >>> shot = starpos.open_night("night", instrument="instrument.yaml").solve().shots[0]
    >>> shot.name, shot.status.value
    ('stars_0000.csv', 'ok')
    """

    name: str
    status: Status
    message: str
    utc_unix_s: float = float("nan")
    place: PlaceFix | None = None
    pointing: FieldPointing | None = None
    size: tuple[int, int] | None = None
    xy: np.ndarray = field(default_factory=lambda: NO_STARS)
    residual_px: np.ndarray = field(default_factory=lambda: NO_STARS)
    magnitudes: np.ndarray = field(default_factory=lambda: np.zeros(0))
    names: tuple[str, ...] = ()
    stars_detected: int = 0
    stars_matched: int = 0
    residual_arcsec: float = float("nan")
    tilt: tuple[float, float] = NO_TILT
    identify_s: float = float("nan")
    fix_s: float = float("nan")
    camera_to_itrs: np.ndarray | None = None
    at_place: AttitudeAtPlace | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(cls, name: str, s: Solution, stars: Stars | None) -> "Shot":
        """The part of a solution that is shown; stars: its stars, None for a frame that cannot be read."""
        told: dict[str, Any] = {}
        if s.pointing:
            told["residual_arcsec"] = s.pointing.residual_arcsec
        if stars is not None and s.star is not None and s.magnitudes is not None:
            told |= {
                "xy": np.stack([stars.x, stars.y], -1)[s.star],
                "magnitudes": s.magnitudes,
                "names": s.names,
            }
        if s.fix is not None:
            told |= {"residual_px": -s.fix.residual_px, "residual_arcsec": s.fix.residual_arcsec}
            told["camera_to_itrs"] = s.fix.camera.rotation
        return cls(
            name=name,
            status=s.status,
            message=s.message,
            utc_unix_s=float("nan") if s.utc_unix_s is None else s.utc_unix_s,
            place=s.fix,
            pointing=s.pointing,
            size=None if stars is None else (stars.width, stars.height),
            stars_detected=s.stars_detected,
            stars_matched=len(s.names),
            tilt=(s.tilt.theta_x, s.tilt.theta_y) if s.tilt else NO_TILT,
            identify_s=s.identify_s,
            fix_s=s.fix_s,
            at_place=s.at_place,
            warnings=s.warnings,
            **told,
        )

    def __repr__(self) -> str:
        return f"<{self.name}: {self.place.in_degrees if self.place else self.message}>"


def why_none(shots: Sequence[Shot]) -> str:
    """A sentence that says why a night has no fix."""
    if not shots:
        return "there is no frame in it"
    return f"none of its {len(shots)} frames gave a fix; the first: {shots[0].message}"


@dataclass(frozen=True)
class Truth:
    """The true place of the instrument (astronomic, rad); headings: (mid_unix_s, rad) of frames.

    simulated: whether no camera took these frames.
    """

    latitude: float
    longitude: float
    headings: tuple[tuple[float, float], ...] = ()
    simulated: bool = False


def offset_m(place: PlaceFix | Truth, latitude: float, longitude: float) -> tuple[float, float]:
    """East, north in m of a place from another (rad)."""
    across = enu_axes(latitude, longitude)[:2] @ zenith_of(place.latitude, place.longitude)
    east, north = across * curvature_radii_m(latitude)
    return float(east), float(north)


@dataclass(frozen=True, eq=False, kw_only=True)
class Night:
    """All frames of one place; printed, and in a notebook shown, in a few lines.

    Attributes
    ----------
    origin : a sentence that says where the fixes come from
    shots : one for each frame
    combined : the average, astronomic and in rad; None without one, and why_not says why
    wgs84 : the same for a map, in deg
    steady : (N, 3), latitude, longitude, heading (rad) of the fixes with one tilt for all; None if the camera moved
    watched : what GNSS taught and what its guard said, of each frame that can be read; None without GNSS

    Examples
    --------
    >>> starpos.open_night("night", instrument="instrument.yaml").solve()
    <night: 5 of 5 frames fixed; +35.70... +51.4...>
    """

    name: str
    origin: str
    shots: Sequence[Shot]
    combined: PlaceFix | None
    why_not: str
    vertical: Vertical
    atmosphere: Atmosphere
    truth: Truth | None = None
    steady: np.ndarray | None = None
    watched: "WatchedNight | None" = None
    remarks: tuple[str, ...] = ()

    @property
    def simulated(self) -> bool:
        """Whether its truth.json says that no camera took its frames."""
        return self.truth is not None and self.truth.simulated

    @property
    def wgs84(self) -> InDegrees | None:
        """Where the night was, on WGS 84, in degrees; None if there is no average."""
        if self.combined is None:
            return None
        ground = self.combined.on_ground(self.vertical)
        return InDegrees.of(ground.latitude, ground.longitude, ground.heading, ground.covariance)

    @property
    def fixed(self) -> list[tuple[int, Shot]]:
        """The frames with a fix, each with its number from 1."""
        return [(k, s) for k, s in enumerate(self.shots, 1) if s.place]

    @property
    def places(self) -> list[PlaceFix]:
        """The places of the frames with a fix."""
        return [s.place for s in self.shots if s.place]

    def __repr__(self) -> str:
        found = self.why_not if self.wgs84 is None else f"{self.wgs84} (WGS 84)"
        return f"<{self.name}: {len(self.fixed)} of {len(self.shots)} frames fixed; {found}>"

    def _repr_html_(self) -> str:
        """The night as a table, for notebooks."""
        rows = [
            (s.name, s.status.value, s.place.in_degrees.where, s.place.in_degrees.facing)
            if s.place
            else (s.name, s.status.value, s.message, "")
            for s in self.shots[:SHOWN]
        ]
        if len(self.shots) > SHOWN:
            rows.append((f"{len(self.shots) - SHOWN} frames more", "", "", ""))
        head = ("frame", "status", "place (astronomic) and 1 sigma", "")
        table = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
        titles = "".join(f"<th>{title}</th>" for title in head)
        said = "".join(f"<p>{escape(remark)}</p>" for remark in self.remarks)
        return f"<p><b>{escape(repr(self)[1:-1])}</b></p><table><tr>{titles}</tr>{table}</table>{said}"
