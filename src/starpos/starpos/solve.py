# SPDX-License-Identifier: Apache-2.0
"""Stars and tilt in, a solution out: the chain that the command line and the node share."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import erfa
import numpy as np

from starpos import identification as ident
from starpos import triangles
from starpos.atmosphere import Atmosphere
from starpos.camera import Camera
from starpos.catalogue import Catalogue
from starpos.earth import earth_state
from starpos.errors import FixError, InstrumentError, StarposError, TiltError, TiltRangeError, TimeError
from starpos.fix import Fix, solve_fix
from starpos.inclinometer import Tilt, a2_matrix
from starpos.instrument import Instrument
from starpos.stars import SATURATED, Stars

J2000 = 2000.0
SMALLEST_FIELD_DEG, LARGEST_FIELD_DEG = 0.5, 60.0


class Status(str, Enum):
    """How a frame ended."""

    OK = "ok"
    TOO_FEW_STARS = "too few stars"
    NOT_IDENTIFIED = "not identified"
    NO_TILT = "no tilt"
    TILT_OUT_OF_RANGE = "tilt out of range"
    TIME_OUTSIDE_TABLES = "time outside tables"
    BAD_INPUT = "bad input"
    POOR_FIT = "poor fit"


@dataclass(frozen=True)
class Attitude:
    """Where the camera looks: ICRS of the frame's centre pixel, and the position angle of its top (rad)."""

    ra: float
    dec: float
    roll: float
    focal_px: float
    residual_arcsec: float
    log_odds: float
    mirrored: bool


@dataclass(frozen=True)
class Solution:
    """What became of one frame: status and a sentence, and as much of the answer as there is."""

    status: Status
    message: str
    source: str
    utc_unix_s: float | None
    stars_detected: int
    names: tuple[str, ...] = ()
    star: np.ndarray | None = None  # (M,) rows of the input's stars, one per name
    attitude: Attitude | None = None
    fix: Fix | None = None
    tilt: Tilt | None = None
    identify_s: float = 0.0
    fix_s: float = 0.0

    @property
    def ok(self) -> bool:
        return self.status is Status.OK


@dataclass(frozen=True)
class Solver:
    """The instrument and its surroundings; `solve` for a fix, `identify` for a pointing alone."""

    instrument: Instrument
    catalogue: Catalogue
    atmosphere: Atmosphere = field(default_factory=lambda: Atmosphere.measured(None, None))
    min_stars: int = 5
    progress: Callable[[str, float], None] = lambda what, done: None

    def prepare(self, width: int, height: int) -> None:
        """Have the triangles of this frame size at hand, building them if need be; raises StarposError."""
        triangles.cached(self.catalogue, self._camera(width, height).half_diagonal_rad, self.progress)

    def identify(self, stars: Stars) -> Solution:
        """Which stars these are and where the camera looked.  Without a time: J2000 places, no aberration."""
        begin = time.perf_counter()
        try:
            camera = self._camera(stars.width, stars.height)
            year, velocity = J2000, (0.0, 0.0, 0.0)
            if stars.mid_unix_s is not None:
                state = earth_state(stars.mid_unix_s)
                year, velocity = state.year, tuple(state.velocity)
            found, sky = self._identify(stars, camera, camera.directions(stars.x, stars.y), year, velocity)
        except StarposError as e:
            return self._failure(stars, e)
        spent = time.perf_counter() - begin
        if not found.ok:
            return self._unidentified(stars, found, spent)
        return Solution(
            Status.OK,
            "identified",
            stars.source,
            stars.mid_unix_s,
            len(stars),
            tuple(self.catalogue.names(found.catalogue)),
            found.star,
            _attitude(found, sky, camera),
            identify_s=spent,
        )

    def solve(self, stars: Stars, tilt: Tilt | Callable[[float, float], Tilt]) -> Solution:
        """The fix of one frame; never raises for what the frame, the tilt or the time does wrong.

        tilt: the average over the exposure, or a function of (mid_unix_s, exposure_s) that gives it.
        """
        try:
            if stars.mid_unix_s is None:
                raise TimeError(
                    f"{stars.source}: no time of exposure (DATE-OBS): a position needs it to a millisecond"
                )
            state = earth_state(stars.mid_unix_s)
            if callable(tilt):
                tilt = tilt(stars.mid_unix_s, stars.exposure_s or 0.0)
            camera = self._camera(stars.width, stars.height)
            g = a2_matrix(tilt.theta_x, tilt.theta_y) @ self.instrument.mounting.a3
            begin = time.perf_counter()
            directions = self.atmosphere.refraction().unbend(camera.directions(stars.x, stars.y) @ g.T) @ g
            found, sky = self._identify(stars, camera, directions, state.year, tuple(state.velocity))
        except StarposError as e:
            return self._failure(stars, e)
        identified = time.perf_counter()
        if not found.ok:
            return self._unidentified(stars, found, identified - begin)
        attitude = _attitude(found, sky, camera)
        try:
            if len(found.star) < self.min_stars:
                raise FixError(
                    f"only {len(found.star)} stars identified, min_stars is {self.min_stars}: no fix"
                )
            if found.mirrored:
                raise InstrumentError(
                    "the frame is mirrored (its rows run bottom-up): flip it, a position needs to know which side is up"
                )
            fix = solve_fix(
                np.stack([stars.x, stars.y], -1)[found.star],
                stars.covariance[found.star],
                self.catalogue.directions(found.catalogue, state.year),
                self.catalogue.sigma(found.catalogue, state.year),
                camera.scaled(found.focal_scale),
                tilt,
                self.instrument.mounting,
                self.atmosphere,
                state,
                self.instrument.clock_stddev_s,
            )
        except StarposError as e:
            failed = self._failure(stars, e)
            return Solution(
                failed.status, failed.message, stars.source, stars.mid_unix_s, len(stars), (), None, attitude, None, tilt,
                identified - begin,
            )  # fmt: skip
        return Solution(
            Status.OK,
            "fix",
            stars.source,
            stars.mid_unix_s,
            len(stars),
            tuple(self.catalogue.names(found.catalogue[fix.used])),
            found.star[fix.used],
            attitude,
            fix,
            tilt,
            identified - begin,
            time.perf_counter() - identified,
        )

    def _camera(self, width: int, height: int) -> Camera:
        camera = self.instrument.camera_for(width, height)
        field_deg = np.degrees(2 * camera.half_diagonal_rad)
        if not SMALLEST_FIELD_DEG <= field_deg <= LARGEST_FIELD_DEG:
            raise InstrumentError(
                f"focal length {camera.fx:.0f} px makes a field of {field_deg:.2f} deg across, this program works from "
                f"{SMALLEST_FIELD_DEG:g} to {LARGEST_FIELD_DEG:g} deg: check focal length and pixel size"
            )
        return camera

    def _identify(self, stars: Stars, camera: Camera, directions, year, velocity):
        # of square pixels, which is what identify fits
        ideal = Camera(camera.width, camera.height, camera.fx, camera.fx, camera.cx, camera.cy)
        table = triangles.cached(self.catalogue, camera.half_diagonal_rad, self.progress)
        sky = ident.Sky(self.catalogue, table, year, velocity)
        sigma = np.sqrt(np.trace(stars.covariance, axis1=1, axis2=2) / 2)
        return ident.identify(ideal.project(directions), sigma, ideal, sky), sky

    def _unidentified(self, stars: Stars, found: ident.Identification, spent: float) -> Solution:
        place = stars.source or "the frame"
        if found.status is ident.Status.TOO_FEW_STARS:
            saturated = int(np.sum((stars.flags & SATURATED) != 0))
            hint = f" ({saturated} saturated)" if saturated else ""
            message = (
                f"{place}: {len(stars)} stars detected{hint}, at least 4 are needed: check clouds and focus"
            )
            return Solution(
                Status.TOO_FEW_STARS, message, stars.source, stars.mid_unix_s, len(stars), identify_s=spent
            )
        message = (
            f"{place}: none of the sky fits its {len(stars)} stars: check the focal length "
            f"({self.instrument.focal_px:.0f} px given, 3 % is allowed), clouds and exposure"
        )
        return Solution(
            Status.NOT_IDENTIFIED, message, stars.source, stars.mid_unix_s, len(stars), identify_s=spent
        )

    def _failure(self, stars: Stars, error: StarposError) -> Solution:
        kinds = (
            (TiltRangeError, Status.TILT_OUT_OF_RANGE),
            (TiltError, Status.NO_TILT),
            (TimeError, Status.BAD_INPUT if stars.mid_unix_s is None else Status.TIME_OUTSIDE_TABLES),
            (FixError, Status.POOR_FIT),
        )
        status = next((s for kind, s in kinds if isinstance(error, kind)), Status.BAD_INPUT)
        return Solution(status, str(error), stars.source, stars.mid_unix_s, len(stars))


def _attitude(found: ident.Identification, sky: ident.Sky, camera: Camera) -> Attitude:
    """The pointing of the frame's centre; for a mirrored frame, of the frame turned the right way up."""
    seen = camera.scaled(found.focal_scale)
    x, y = camera.centre_px
    centre, above = (sky.unaberrated(v) for v in seen.directions([x, x], [y, y - 1.0]) @ found.attitude)
    ra, dec = erfa.c2s(centre)
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    up = above - centre
    if found.mirrored:
        up = -up
    return Attitude(
        float(ra % (2 * np.pi)),
        float(dec),
        float(np.arctan2(up @ east, up @ north) % (2 * np.pi)),
        float(seen.fx),
        float(found.residual_px * seen.scale_arcsec),
        found.log_odds,
        found.mirrored,
    )
