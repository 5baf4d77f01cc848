# SPDX-License-Identifier: Apache-2.0
"""What a report is made of: the frames of a night, what each gave, and what they give together."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from starpos.averaging.average import Average
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Geodetic, Vertical, geodetic
from starpos.fix.budget import ErrorTerm
from starpos.fix.fix import Fix
from starpos.fix.solver import Attitude, Status

NO_TILT = (float("nan"), float("nan"))
NO_STARS = np.zeros((0, 2))


@dataclass(frozen=True, eq=False, kw_only=True)
class ReportedPlace:
    """Astronomic latitude, longitude and heading (rad; NaN: no one heading), and what is wrong with them.

    covariance (3, 3) of east m, north m, heading rad; terms: what it is the sum of.  poses: how often the instrument was
    set up for it; the heading is that of the last.
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    covariance: np.ndarray
    terms: tuple[ErrorTerm, ...]
    poses: int = 1

    @classmethod
    def of(cls, fix: Fix | Average) -> "ReportedPlace":
        poses = fix.poses if isinstance(fix, Average) else 1
        return cls(
            utc_unix_s=fix.utc_unix_s,
            latitude=fix.latitude,
            longitude=fix.longitude,
            heading=fix.heading,
            covariance=fix.covariance,
            terms=fix.terms,
            poses=poses,
        )

    @property
    def own(self) -> np.ndarray:
        """(3, 3) of the errors that are new in every frame: what makes the frames differ from each other."""
        return sum((t.covariance[:3, :3] for t in self.terms if not t.common), np.zeros((3, 3)))

    @property
    def sigma(self) -> np.ndarray:
        """(3,): east m, north m, heading rad."""
        return np.sqrt(np.diag(self.covariance))

    def on_ground(self, vertical: Vertical) -> Geodetic:
        return geodetic(self.latitude, self.longitude, self.heading, self.covariance, vertical)


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """One frame: how it ended, and as much of its answer as there is.

    utc_unix_s: NaN where unknown.  xy, residual_px (M, 2): the stars of its fix where they were seen, and that less where
    the fit has them.  size: of the frame, px.  tilt: rad.  camera_to_itrs (3, 3): attitude on the Earth,
    of the stars alone.
    """

    name: str
    status: Status
    message: str
    utc_unix_s: float = float("nan")
    place: ReportedPlace | None = None
    pointing: Attitude | None = None
    size: tuple[int, int] | None = None
    xy: np.ndarray = field(default_factory=lambda: NO_STARS)
    residual_px: np.ndarray = field(default_factory=lambda: NO_STARS)
    magnitudes: np.ndarray = field(default_factory=lambda: np.zeros(0))
    stars_detected: int = 0
    stars_matched: int = 0
    residual_arcsec: float = float("nan")
    tilt: tuple[float, float] = NO_TILT
    identify_s: float = float("nan")
    fix_s: float = float("nan")
    camera_to_itrs: np.ndarray | None = None


@dataclass(frozen=True)
class Truth:
    """Where the instrument really stood (astronomic, rad); headings: (mid_unix_s, rad) of frames."""

    latitude: float
    longitude: float
    headings: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Night:
    """All frames of one place.

    origin: a sentence, whence the fixes are.  combined: None where there is none, why_not then says why.  steady (N, 3):
    the latitude, longitude, heading (rad) that the fixes have with one tilt for all, where the camera stood still.
    """

    name: str
    origin: str
    shots: Sequence[Shot]
    combined: ReportedPlace | None
    why_not: str
    vertical: Vertical
    atmosphere: Atmosphere
    truth: Truth | None = None
    steady: np.ndarray | None = None
    remarks: tuple[str, ...] = ()

    @property
    def fixed(self) -> list[tuple[int, Shot]]:
        """(number from 1, frame) of the frames with a fix."""
        return [(k, s) for k, s in enumerate(self.shots, 1) if s.place]
