# SPDX-License-Identifier: Apache-2.0
"""The solution of a frame: its status, what was found, planets among its stars, and what is suspicious about it."""

import math
import time
from dataclasses import KW_ONLY, dataclass, replace
from enum import Enum
from typing import Any

import numpy as np

from starpos.earth.orientation import earth_state
from starpos.errors import FixError, PlaceError, StarposError, TiltError, TiltRangeError, TimeError
from starpos.fix.circle import Circle
from starpos.fix.fix import Fix
from starpos.fix.glows import Glow, Glows
from starpos.fix.heading import AttitudeAtPlace
from starpos.frames.frame import Stars
from starpos.frames.tables import Pointing
from starpos.frozen import at_once
from starpos.identification import Identification, Sky, fisheye
from starpos.identification._frame import FrameStars
from starpos.identification.evidence import Explained, explained_by
from starpos.identification.prior import Hint
from starpos.identification.two_skies import two_skies
from starpos.instrument.camera import PLUMB_BOB, Camera
from starpos.instrument.inclinometer import Tilt
from starpos.sky.bodies import body_at
from starpos.sky.catalogue import NamedStars, named_stars
from starpos.units import ARCSEC, utc_text

# Names in `Solution.warnings`. TWO_SKIES: unidentified bright stars form a sky of their own. UNEXPLAINED: most bright
# detections are not identified, and bright stars that should be there are missing.
TWO_SKIES, UNEXPLAINED = "two_skies", "unexplained"


class Status(str, Enum):
    """Result of the work on one frame.

    Examples
    --------
    >>> starpos.identify("night/stars_0000.csv").status is starpos.Status.OK
    True
    """

    OK = "ok"
    TOO_FEW_STARS = "too few stars"
    NOT_IDENTIFIED = "not identified"
    NO_TILT = "no tilt"
    TILT_OUT_OF_RANGE = "tilt out of range"
    TIME_OUTSIDE_TABLES = "time outside tables"
    BAD_INPUT = "bad input"
    POOR_FIT = "poor fit"


# Of a frame on which another search may succeed; and no identified stars.
LOST = Status.NOT_IDENTIFIED, Status.TOO_FEW_STARS
NO_STARS = named_stars((), np.zeros(0))


@at_once
@dataclass(frozen=True, kw_only=True)
class FieldPointing:
    """Pointing of the camera: ICRS place of the frame's centre pixel, and the position angle `roll` of its top (rad).

    model: of its lens.
    focal_stddev_px: error of focal_px by the stars' residuals, refraction left out; NaN where it is unknown.
    """

    ra: float
    dec: float
    roll: float
    focal_px: float
    residual_arcsec: float
    log_odds: float
    mirrored: bool
    model: str = PLUMB_BOB
    focal_stddev_px: float = math.nan


@at_once
@dataclass(frozen=True)
class Solution:
    """Solution of one frame: a status, a sentence, and the part of the answer that was found.

    Attributes
    ----------
    named, star : (M,) the identified stars of the catalogue, and their rows in the input's stars
    identify_s, fix_s : seconds that the two steps took
    extrapolated_days : how far behind the end of the IERS table the frame's date lies; 0 within it
    warnings : sorted names of suspicions about an identification: TWO_SKIES, UNEXPLAINED. There is no fix then.
    explained : how much of the frame the identification explains
    at_place : heading, pitch and roll at a known place; None if not asked for or not found
    found : the identification itself; its rows refer to the input's stars
    negative : whether the stars are dark on a bright sky
    hint : helps to identify the next frame
    remark : a warning on an identified frame; '' without one
    planets : names of those among the stars, and their rows there
    bodies : names of the Sun, the Moon and planets that it rests on
    circle : of equal altitude, by the Sun where no place is known; None without
    glow : the saturated spot that was taken for the Sun, or was not; None without

    Examples
    --------
    >>> solution = starpos.identify("night/stars_0000.csv")
    >>> solution.ok, len(solution.names) == len(solution.star)
    (True, True)
    """

    status: Status
    message: str
    _: KW_ONLY
    source: str
    utc_unix_s: float | None
    stars_detected: int
    named: NamedStars = NO_STARS
    star: np.ndarray | None = None
    pointing: FieldPointing | None = None
    fix: Fix | None = None
    tilt: Tilt | None = None
    identify_s: float = 0.0
    fix_s: float = 0.0
    extrapolated_days: float = 0.0
    hint: Hint | None = None
    warnings: tuple[str, ...] = ()
    explained: Explained | None = None
    at_place: AttitudeAtPlace | None = None
    found: Identification | None = None
    negative: bool = False
    remark: str = ""
    planets: tuple[tuple[str, int], ...] = ()
    bodies: tuple[str, ...] = ()
    circle: Circle | None = None
    glow: Glow | None = None

    @classmethod
    def of(
        cls, frame: Stars | Pointing, message: str = "identified", status: Status = Status.OK, **found: Any
    ) -> "Solution":
        """The solution of a frame; found: the known parts of the answer, by the names of the fields."""
        number, negative = (len(frame.x), frame.negative) if isinstance(frame, Stars) else (0, False)
        return cls(
            status,
            message,
            source=frame.source,
            utc_unix_s=frame.mid_unix_s,
            stars_detected=number,
            negative=negative,
            **found,
        )

    @classmethod
    def failed(cls, frame: Stars | Pointing, status: Status, message: str) -> "Solution":
        """A solution with only its status and message."""
        return cls.of(frame, message, status)

    @classmethod
    def refused(cls, frame: Stars | Pointing, error: StarposError) -> "Solution":
        """A solution with only the error that ended the work on its frame."""
        return cls.failed(frame, status_of(frame, error), str(error))

    @classmethod
    def unreadable(cls, source: str, error: StarposError) -> "Solution":
        """A solution of a file that holds no frame."""
        return cls(Status.BAD_INPUT, str(error), source=source, utc_unix_s=None, stars_detected=0)

    def with_remark(self, sentence: str) -> "Solution":
        """The solution with a sentence, which may be '', before its other remarks."""
        return replace(self, remark="; ".join(filter(None, (sentence, self.remark))))

    def beside(self, glows: Glows) -> "Solution":
        """The solution after the glows before it: refused unless its own has moved as the Sun does."""
        if self.glow is None:
            return self
        still, since_unix_s = glows.before(self.glow)
        return self.unproven() if still is None else self.as_lamp(since_unix_s) if still else self

    def as_lamp(self, since_unix_s: float) -> "Solution":
        """The solution of a frame whose glow has stood still since then, or until then, while the Sun moved on."""
        return self._no_sun(
            f"its bright spot stands where it stood at {utc_text(since_unix_s)}, and the Sun has moved on in between: it "
            "is a lamp or a reflection, or the camera follows the Sun"
        )

    def unproven(self) -> "Solution":
        """The solution of a frame whose glow has not been seen to move as the Sun does."""
        return self._no_sun(
            "its bright spot may be the Sun, or a lamp that stands as high: give a further frame, some minutes later, "
            "which shows whether it moves"
        )

    def _no_sun(self, message: str) -> "Solution":
        if self.status is not Status.OK or self.glow is None:
            return self
        return replace(
            self,
            status=Status.POOR_FIT,
            message=f"{self.source}: {message}",
            at_place=None,
            circle=None,
            bodies=(),
        )

    def among(self, stars: Stars, rows: np.ndarray) -> "Solution":
        """The solution of `stars` that is found by the stars in `rows` (n,) alone."""
        star = None if self.star is None else rows[self.star]
        found = self.found and self.found.but(star=rows[self.found.star])
        planets = tuple((name, int(rows[row])) for name, row in self.planets)
        return replace(self, star=star, found=found, planets=planets, stars_detected=len(stars))

    def __repr__(self) -> str:
        found = self.fix.in_degrees if self.fix else self.message
        return f"<Solution {self.status.value}: {found}; {len(self.named)} of {self.stars_detected} stars>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the identified stars."""
        return self.named.labels[0]

    @property
    def magnitudes(self) -> np.ndarray | None:
        """V magnitudes (M,) of the identified stars by the catalogue; None where no star was identified."""
        return None if self.star is None else self.named.labels[1]

    @property
    def lost(self) -> bool:
        """Whether nothing was identified, so that another search may succeed."""
        return self.status in LOST

    @property
    def ok(self) -> bool:
        """Whether everything asked for was found."""
        return self.status is Status.OK


def status_of(stars: Stars | Pointing, error: StarposError) -> Status:
    """The status of a frame whose work ended with an error."""
    kinds = (
        (TiltRangeError, Status.TILT_OUT_OF_RANGE),
        (TiltError, Status.NO_TILT),
        (TimeError, Status.BAD_INPUT if stars.mid_unix_s is None else Status.TIME_OUTSIDE_TABLES),
        ((FixError, PlaceError), Status.POOR_FIT),
    )
    return next((s for kind, s in kinds if isinstance(error, kind)), Status.BAD_INPUT)


def solution_of(
    stars: Stars,
    field: FrameStars | fisheye.WideField,
    sky: Sky,
    camera: Camera,
    found: Identification,
    begin_s: float,
) -> Solution:
    """The solution of stars that are identified: a success without a fix.

    field: the stars as they were searched.
    begin_s: when their search began, by time.perf_counter.
    """
    planets = planets_among(stars, found, camera)
    warnings, explained = suspicions(stars, field, sky, found, tuple(row for _, row in planets))
    return Solution.of(
        stars,
        named=sky.catalogue.named(found.catalogue),
        star=found.star,
        pointing=pointing_of(found, sky, camera, found.spread_px(stars.x, stars.y)),
        warnings=warnings,
        explained=explained,
        planets=planets,
        found=found,
        identify_s=time.perf_counter() - begin_s,
    )


# of a planet from its predicted place: px, and sigma of the ephemeris
NEAR_PX, NEAR_SIGMAS = 6.0, 3.0
# Planets that outshine most stars, and the number of a frame's brightest detections that are looked at.
BRIGHTEST = 12
BRIGHT = "mercury", "venus", "mars", "jupiter", "saturn"


def planets_among(stars: Stars, found: Identification, camera: Camera) -> tuple[tuple[str, int], ...]:
    """Names of planets on a frame and the rows of `stars` that they are; () without a time, and for a mirrored frame."""
    if stars.mid_unix_s is None or found.mirrored:
        return ()
    known = set(found.star[:BRIGHTEST].tolist())
    others = np.array([row for row in range(min(len(stars), BRIGHTEST)) if row not in known])
    if not len(others):
        return ()
    seen = camera.scaled(found.focal_scale)
    try:
        state = earth_state(stars.mid_unix_s)
        rays = seen.directions(stars.x[others], stars.y[others])
    except StarposError:
        return ()
    # rays are compared, not pixels: distortion's formula has no place for a planet far outside the frame
    sky = rays @ found.attitude @ state.gcrs_to_itrs.T
    named = []
    for name in BRIGHT:
        body = body_at(name, state)
        off = np.linalg.norm(sky - body.itrs, axis=1)
        near = int(np.argmin(off))
        if off[near] < NEAR_PX / seen.fx + NEAR_SIGMAS * body.sigma + body.radius:
            named.append((name, int(others[near])))
    return tuple(named)


def suspicions(
    stars: Stars,
    field: FrameStars | fisheye.WideField,
    sky: Sky,
    found: Identification,
    planets: tuple[int, ...] = (),
) -> tuple[tuple[str, ...], Explained]:
    """Sorted names of suspicions about the stars' identification, and how much it explains.

    For a fisheye, the part with most identified stars is judged.  planets: rows of the stars that are no false ones.
    """
    flux, rows = stars.flux, None
    if isinstance(field, fisheye.WideField):
        part, found = fisheye.part_of(field, sky, found)
        field, flux, rows = part.field, flux[part.row], part.row
    explained = explained_by(found, field)
    if planets:
        bright = np.arange(explained.bright) if rows is None else rows[: explained.bright]
        explained = replace(explained, bright=explained.bright - int(np.isin(bright, planets).sum()))
    names = (TWO_SKIES,) * two_skies(field, flux, sky, found, explained) + (UNEXPLAINED,) * (
        not explained.enough
    )
    return names, explained


def pointing_of(found: Identification, sky: Sky, camera: Camera, spread_px: float) -> FieldPointing:
    """Pointing of the frame's centre; of a mirrored frame, after it was turned the right way up.

    spread_px: of the identified stars on the frame, as `Identification.spread_px` has it.
    """
    scale = found.focal_scale
    if camera.is_ideal:
        across, down, row = camera.centre_from_axis
        centre, above = (across, down, scale), (across, down - row, scale)
    else:
        # a mirrored fisheye's attitude is given for its picture flipped about the axis, which need not be the middle
        turned = found.mirrored and fisheye.is_wide(camera)
        x, y = camera.centre_px
        centre, above = camera.scaled(scale).directions([x, x], [y, y + 1.0 if turned else y - 1.0])
        if turned:
            centre, above = fisheye.FLIP @ centre, fisheye.FLIP @ above
    ra, dec, roll = found.pointing(centre, above, sky.velocity)
    return FieldPointing(
        ra=ra,
        dec=dec,
        roll=roll,
        focal_px=camera.fx * scale,
        focal_stddev_px=camera.fx * scale * found.residual_px / spread_px,
        residual_arcsec=found.residual_px / (scale * math.sqrt(camera.fx * camera.fy)) / ARCSEC,
        log_odds=found.log_odds,
        mirrored=found.mirrored,
        model=camera.model,
    )
