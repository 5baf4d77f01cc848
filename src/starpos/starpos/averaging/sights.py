# SPDX-License-Identifier: Apache-2.0
"""Sights by hand: altitudes of the Sun, the Moon, planets and stars by a sextant, and the place that they give together.

The corrections are the Nautical Almanac's: index error, dip, refraction, semidiameter, parallax.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from starpos import rotation
from starpos.averaging.altitudes import place_of_circles
from starpos.averaging.average import Average
from starpos.earth.ellipsoid import EARTH_RADIUS_M, enu_axes, zenith_of
from starpos.earth.orientation import earth_state
from starpos.earth.refraction import MIN_COS_ZENITH, Atmosphere
from starpos.errors import FixError, FrameError, StarposError
from starpos.files import bytes_of, open_regular
from starpos.fix.circle import Circle
from starpos.fix.terms import ALWAYS, ErrorTerm
from starpos.sky.bodies import BODIES, ERFA, SolarSystem, body_at
from starpos.sky.catalogue import Catalogue
from starpos.tables import packaged
from starpos.units import unix_of

ARCMIN = math.radians(1 / 60)
LIMBS = {"lower": 1, "upper": -1, "centre": 0, "": 0}
NEEDED = ("body", "utc", "altitude_deg")
# of the optional columns: what an empty cell means, and the limits
NUMBERS = {
    "altitude_deg": (math.nan, -2.0, 180.0),
    "index_error_arcmin": (0.0, -120.0, 120.0),
    "height_of_eye_m": (math.nan, 0.0, 10_000.0),
    "artificial_horizon": (0.0, 0.0, 1.0),
    "sigma_arcmin": (0.7, 0.001, 60.0),
    "course_deg": (0.0, -360.0, 360.0),
    "speed_knots": (0.0, 0.0, 2000.0),
}
CURE = f"give a CSV with a line of names, {','.join(NEEDED)}[,limb,{','.join(list(NUMBERS)[1:])}]"
MAX_BYTES, MAX_SIGHTS = 5_000_000, 5_000
# Dip of the sea's horizon at a height of 1 m, with the air's usual bending. Errors of that bending and of a stated index
# error are alike in all sights. A vessel's way errs by a share of it.
DIP, DIP_STDDEV, INDEX_STDDEV, WAY_SHARE = 1.76 * ARCMIN, 0.5 * ARCMIN, 0.2 * ARCMIN, 0.05
KNOT = 1852 / 3600
WAY_ROUNDS = 4


@dataclass(frozen=True, kw_only=True)
class SextantSight:
    """One altitude, rad; limb: 1 for the lower, -1 for the upper, 0 for the centre.

    apparent: of the limb above the horizontal, with refraction.  artificial: whether twice the body's was read, over its
    image in a mirror that is level; by_sea: whether the sea's horizon is used.
    course (rad), speed_m_s: of the way from the sight before.
    """

    source: str
    body: str
    limb: int
    utc_unix_s: float
    apparent: float
    artificial: bool
    by_sea: bool
    sigma: float
    course: float
    speed_m_s: float


def read_sights(path: Path | str) -> list[SextantSight]:
    """The sights of a CSV in order of time; FrameError where it cannot be used."""
    try:
        with open_regular(path) as file:
            text = bytes_of(file, MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise FrameError(f"{path}: it cannot be read ({error.strerror or error}): {CURE}") from None
    except UnicodeDecodeError:
        raise FrameError(f"{path}: this is not a text file: {CURE}") from None
    rows = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        names = [str(name).strip().lower() for name in rows.fieldnames or ()]
        rows.fieldnames = names
        if missing := [name for name in NEEDED if name not in names]:
            raise FrameError(f"{path}: no column {missing[0]}: {CURE}")
        sights = [_sight(row, f"{path}:{rows.line_num}") for row in rows]
    except csv.Error as error:
        raise FrameError(f"{path}: {error}: {CURE}") from None
    if not 0 < len(sights) <= MAX_SIGHTS:
        raise FrameError(f"{path}: {len(sights)} sights, and 1 to {MAX_SIGHTS} can be worked: {CURE}")
    return sorted(sights, key=lambda s: s.utc_unix_s)


def _sight(row: dict, where: str) -> SextantSight:
    """The sight of a row; FrameError names the cell that cannot be used."""
    cells = {name: (row.get(name) or "").strip() for name in (*NUMBERS, "body", "limb", "utc")}
    values = {}
    for name, (empty, low, high) in NUMBERS.items():
        try:
            values[name] = float(cells[name]) if cells[name] else empty
        except ValueError:
            values[name] = math.nan
        if not low <= values[name] <= high and (cells[name] or name in NEEDED):
            raise FrameError(
                f"{where}: {name} is {cells[name][:40]!r}: give a number from {low:g} to {high:g}"
            )
    if cells["limb"].lower() not in LIMBS:
        raise FrameError(f"{where}: the limb is {cells['limb'][:40]!r}: give lower, upper or centre")
    try:
        utc_unix_s = unix_of(cells["utc"])
    except StarposError as error:
        raise FrameError(f"{where}: {error}") from None
    artificial, eye_m = values["artificial_horizon"] >= 0.5, values["height_of_eye_m"]
    by_sea = not (artificial or math.isnan(eye_m))
    read = math.radians(values["altitude_deg"]) - values["index_error_arcmin"] * ARCMIN
    return SextantSight(
        source=where,
        body=" ".join(cells["body"].lower().split()),
        limb=LIMBS[cells["limb"].lower()],
        utc_unix_s=utc_unix_s,
        apparent=(read / 2 if artificial else read) - (DIP * math.sqrt(eye_m) if by_sea else 0.0),
        artificial=artificial,
        by_sea=by_sea,
        sigma=values["sigma_arcmin"] * ARCMIN,
        course=math.radians(values["course_deg"]),
        speed_m_s=values["speed_knots"] * KNOT,
    )


def circle_of_sight(
    sight: SextantSight,
    catalogue: Catalogue,
    atmosphere: Atmosphere,
    clock_stddev_s: float,
    ephemeris: SolarSystem = ERFA,
) -> Circle:
    """The circle of equal altitude of a sight; StarposError if its body or its altitude cannot be."""
    state, apparent = earth_state(sight.utc_unix_s), sight.apparent
    if not MIN_COS_ZENITH < math.sin(apparent) < 1 or apparent > math.pi / 2:
        raise FixError(
            f"{sight.source}: an altitude of {math.degrees(apparent):.2f} deg after index error, horizon and dip: 3 to "
            "90 can be used: check the reading and its corrections"
        )
    radius = parallax = 0.0
    if sight.body in BODIES:
        body = body_at(sight.body, state, ephemeris)
        itrs, sigma, parallax = body.itrs, math.hypot(sight.sigma, body.sigma), body.parallax
        # nearer than from the Earth's centre, by the altitude
        radius = body.radius * (1 + parallax * math.sin(apparent))
    else:
        row = _star_row(sight, catalogue)
        itrs = state.to_itrs(catalogue.directions(row, state.year, state.observer_au))[0]
        sigma = sight.sigma
    seen = np.array([0.0, math.cos(apparent), math.sin(apparent)])
    true = atmosphere.refraction().unbend(seen)
    altitude = math.atan2(true[2], math.hypot(true[0], true[1]))
    half = 0.5 if sight.artificial else 1.0
    errors = {
        "index": INDEX_STDDEV * half,
        "horizon": DIP_STDDEV * sight.by_sea,
        "refraction": (altitude - apparent) * atmosphere.relative_sigma,
    }
    return Circle(
        utc_unix_s=sight.utc_unix_s,
        itrs=itrs,
        ray=np.array([0.0, 0.0, 1.0]),
        up=np.array([0.0, 0.0, 1.0]),
        axes=2,
        zenith_distance=math.pi / 2 - altitude - sight.limb * radius,
        sigma=sigma * half,
        terms=tuple(ErrorTerm(name, np.array([[e]]), shared=ALWAYS) for name, e in errors.items()),
        earth=state,
        clock_stddev_s=clock_stddev_s,
        stamp_stddev_s=0.0,
        parallax=parallax,
    )


def place_of_sights(
    sights: Sequence[SextantSight], circles: Sequence[Circle], near: tuple[float, float] | None = None
) -> Average:
    """The place at the last sight; FixError as `place_of_circles`, whose `near` it takes.

    sights, circles: in order of time.  The way between sights moves each circle along: a running fix.
    """
    place = place_of_circles(circles, near)
    if not any(s.speed_m_s for s in sights):
        return place
    for _ in range(WAY_ROUNDS):
        place = place_of_circles(_advanced(sights, circles, place), near)
    return place


def _advanced(sights: Sequence[SextantSight], circles: Sequence[Circle], place: Average) -> list[Circle]:
    """The circles moved by the way from each sight to the last one, which ended at about this place."""
    turn, far, zenith = np.eye(3), 0.0, zenith_of(place.latitude, place.longitude)
    moved = [circles[-1]]
    for k in range(len(sights) - 1, 0, -1):
        later = sights[k]
        way = later.speed_m_s * (later.utc_unix_s - sights[k - 1].utc_unix_s) / EARTH_RADIUS_M
        here = turn @ zenith
        east, north, _ = enu_axes(math.asin(here[2]), math.atan2(here[1], here[0]))
        ahead = math.sin(later.course) * east + math.cos(later.course) * north
        turn, far = rotation.from_vector(-way * np.cross(here, ahead)) @ turn, far + way
        earlier = circles[k - 1]
        sigma = math.hypot(earlier.sigma, WAY_SHARE * far)
        moved.append(replace(earlier, itrs=turn.T @ earlier.itrs, sigma=sigma))
    return moved[::-1]


def _star_row(sight: SextantSight, catalogue: Catalogue) -> np.ndarray:
    """Row (1,) of a star in the catalogue, by its name or its Hipparcos number."""
    name = sight.body.removeprefix("hip").strip()
    hip = (
        int(name)
        if name.isdecimal() and len(name) < 7
        else {n.lower(): hip for n, hip in star_names().items()}.get(sight.body, 0)
    )
    rows = np.flatnonzero(catalogue.hip == hip)
    if not hip or not len(rows):
        raise FixError(
            f"{sight.source}: no body {sight.body[:40]!r}: give {', '.join(BODIES)}, a navigator's star by its name, or "
            "a star as HIP 91262"
        )
    # of a pair's components the brighter one
    return rows[[catalogue.vmag(rows).argmin()]]


@lru_cache(maxsize=1)
def star_names() -> dict[str, int]:
    """Hipparcos numbers of the Nautical Almanac's stars and Polaris, by their names."""
    return {row["name"]: int(row["hip"]) for row in packaged("starpos.sky", "navigation_stars.csv")}
