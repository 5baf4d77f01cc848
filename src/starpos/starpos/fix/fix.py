# SPDX-License-Identifier: Apache-2.0
"""A4 from one frame, by its stars or a plate solver's pointing: place and attitude of the instrument, with their
covariance.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from starpos import rotation
from starpos._numeric.roots import symmetric_root
from starpos.earth.ellipsoid import EARTH_RADIUS_M, curvature_radii_m, enu_axes
from starpos.earth.vertical import Geodetic, Vertical, geodetic
from starpos.fix.attitude import Attitude, heading_of
from starpos.fix.budget import (
    Circumstances,
    level_rows,
    link_attitude,
    local_north,
    mount_term,
    sky_rows,
    sky_terms,
    tilt_terms,
)
from starpos.fix.sighting import FittedSighting, fitted_fields, seen_fields
from starpos.fix.star_fit import MatchedStars, apparent, fit_stars
from starpos.fix.terms import EACH_POSE, ErrorTerm, Origin, total_covariance
from starpos.frames.tables import Pointing
from starpos.frozen import at_once
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import LocalLevel
from starpos.units import ARCSEC

# lengths from here on are given in km
LONG_M = 10_000.0


def length_text(metres: float, digits: int = 0) -> str:
    """A length in m, or where metres mean nothing in km."""
    return f"{metres:.{digits}f} m" if abs(metres) < LONG_M else f"{metres / 1000:.0f} km"


def angle_text(rad: float) -> str:
    """An angle in arcsec, or from 1 deg in deg."""
    arcsec = rad / ARCSEC
    return f"{arcsec:.0f} arcsec" if arcsec < 3600 else f"{arcsec / 3600:.2f} deg"


def zenith_variance(terms: Iterable[ErrorTerm]) -> float:
    """Variance per axis in rad2 of the zenith, by terms of a fix."""
    return float(sum(np.trace(t.covariance[:2, :2]) for t in terms)) / 2 / EARTH_RADIUS_M**2


@dataclass(frozen=True, kw_only=True)
class InDegrees:
    """A place and a heading in degrees, with 1 sigma of each; a heading that is not known is NaN.

    Attributes
    ----------
    latitude, longitude, heading, sigma_heading : deg
    sigma_east_m, sigma_north_m : of the place

    Examples
    --------
    >>> answer = starpos.open_night("night", instrument="instrument.yaml").solve().wgs84
    >>> round(answer.latitude, 1), round(answer.longitude, 1)
    (35.7, 51.4)
    """

    latitude: float
    longitude: float
    heading: float
    sigma_east_m: float
    sigma_north_m: float
    sigma_heading: float

    @classmethod
    def of(cls, latitude: float, longitude: float, heading: float, covariance: np.ndarray) -> "InDegrees":
        """Make it of angles in rad and the covariance (3, 3) of east m, north m, heading rad."""
        east, north, turn = np.sqrt(np.diag(covariance)).tolist()
        return cls(
            latitude=math.degrees(latitude),
            longitude=math.degrees(longitude),
            heading=math.degrees(heading),
            sigma_east_m=east,
            sigma_north_m=north,
            sigma_heading=math.degrees(turn),
        )

    @property
    def where(self) -> str:
        """The place with its errors."""
        errors = f"+- {length_text(self.sigma_north_m)} N {length_text(self.sigma_east_m)} E"
        return f"{self.latitude:+.6f} {self.longitude:+.6f} {errors}"

    @property
    def facing(self) -> str:
        """The heading with its error; that it is not known."""
        if math.isnan(self.heading):
            return "heading not known: of elevations alone, or the camera was touched"
        return f"heading {self.heading:.4f} +- {self.sigma_heading:.4f} deg"

    def __str__(self) -> str:
        return f"{self.where}, {self.facing}"


@at_once
@dataclass(frozen=True, kw_only=True)
class PlaceFix:
    """Astronomic latitude, longitude and heading at one time, with the budget of their errors.

    Attributes
    ----------
    utc_unix_s : s
    latitude, longitude : rad, by the plumb line
    heading : rad; NaN where none is known
    terms : the sources of error, of which `covariance` is the sum

    Examples
    --------
    >>> fix = starpos.open_night("night", instrument="instrument.yaml").solve().combined
    >>> fix.sigma.shape  # east m, north m, heading rad
    (3,)
    """

    utc_unix_s: float
    latitude: float
    longitude: float
    heading: float
    terms: tuple[ErrorTerm, ...]

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (3, 3) of east m, north m, heading rad; its last row and column are NaN if the heading is."""
        covariance = total_covariance(self.terms)[:3, :3]
        if math.isnan(self.heading):
            covariance[2] = covariance[:, 2] = np.nan
        return covariance

    @property
    def own(self) -> np.ndarray:
        """Covariance (3, 3) of the errors that are new in each frame, by which the frames differ from each other."""
        return sum((t.covariance[:3, :3] for t in self.terms if not t.common), np.zeros((3, 3)))

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations (3,) of east m, north m, heading rad."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def in_degrees(self) -> InDegrees:
        """Place and heading in degrees."""
        return InDegrees.of(self.latitude, self.longitude, self.heading, self.covariance)

    def budget(self, ground: Geodetic) -> dict[str, np.ndarray]:
        """1 sigma (3,) of each source: east m, north m, heading rad; the deflection's acts on the geodetic place only."""
        roots = {t.name: np.sqrt(np.diag(t.covariance)[:3]) for t in self.terms}
        return roots | {"deflection (geodetic only)": np.sqrt(np.diag(ground.deflection_covariance))}

    def on_ground(self, vertical: Vertical) -> Geodetic:
        """The geodetic place, with the deflection of the vertical removed."""
        return geodetic(self.latitude, self.longitude, self.heading, self.covariance, vertical)


@at_once
@dataclass(frozen=True, kw_only=True)
class Fix(PlaceFix, FittedSighting):
    """The place and attitude of the instrument, from one frame and its level.

    Attributes
    ----------
    link_to_enu : (3, 3), attitude of the base link
    levelling : (6, 2), change of the rows of an ErrorTerm for errors, in rad, of up about two axes fixed to the
        inclinometer

    Examples
    --------
    >>> shots = starpos.open_night("night", instrument="instrument.yaml").solve().shots
    >>> print(shots[0].place.in_degrees)
    +35.70... +51.4...
    """

    tilt: Tilt
    link_to_enu: np.ndarray
    levelling: np.ndarray

    def __repr__(self) -> str:
        return f"<Fix: {self.in_degrees}>"

    @cached_property
    def link(self) -> Attitude:
        """Attitude of the base link in east, north, up."""
        return link_attitude(self.link_to_enu, self.terms)

    @cached_property
    def zenith_by_stars(self) -> np.ndarray:
        """Covariance (3, 3) in rad2 of the zenith in ITRS by the errors of the stars, the air and the time."""
        radii = np.array(curvature_radii_m(self.latitude))
        axes = enu_axes(self.latitude, self.longitude)[:2] / radii[:, None]
        of_stars = total_covariance([t for t in self.terms if t.origin is Origin.OTHER])
        return axes.T @ of_stars[:2, :2] @ axes


def levelled_fix(
    seen: dict[str, Any],
    a4: np.ndarray,
    level: LocalLevel,
    tilt: Tilt,
    about: Circumstances,
    terms_of: Callable[[np.ndarray], tuple[Iterable[ErrorTerm], Iterable[ErrorTerm]]],
) -> Fix:
    """The fix by a level and A4 (3, 3), ITRS into the level's axes L; seen: the fields that say what the frame shows.

    terms_of: the terms of what is seen, by the factors' rows (6, 3) for a small rotation of the sky about L's axes; those
    that a budget has before the level's terms, and those after them.
    """
    instrument, place = about.instrument, local_north(a4)
    link_to_enu = place.local_to_enu @ level.camera @ instrument.link_to_camera
    of_sky, of_level = sky_rows(place), level_rows(place, link_to_enu)
    # the two axes go with the inclinometer, however it leans
    axes = rotation.shortest_turn(np.array([0.0, 0.0, 1.0]), level.up)[:, :2]
    before, after = terms_of(of_sky)
    terms = (
        *before,
        *tilt_terms(of_level, level, tilt, instrument, about.earth.utc_unix_s),
        *after,
        *sky_terms(of_sky, about.earth, about.clock_stddev_s, about.stamp_stddev_s, a4),
        *mount_term(link_to_enu, instrument),
    )
    return Fix(
        **seen,
        tilt=tilt,
        latitude=place.latitude,
        longitude=place.longitude,
        heading=heading_of(link_to_enu),
        link_to_enu=link_to_enu,
        terms=terms,
        levelling=of_level @ (level.turns @ axes),
    )


def solve_fix(stars: MatchedStars, tilt: Tilt, about: Circumstances) -> Fix:
    """The fix of one frame from identified stars; FixError if the stars are too few or do not agree."""
    level, stddev = about.instrument.level(tilt), about.instrument.lens_stddev_rad
    g = level.camera
    seen = fit_stars(stars, about.camera, g, about.atmosphere.refraction(), apparent(stars, about))

    def terms_of(rows: np.ndarray) -> tuple[Iterable[ErrorTerm], Iterable[ErrorTerm]]:
        centroids, catalogue, *rest = seen.terms(rows, about)
        # what is not known of the lens moves directions in C, newly at each pose
        lens = [ErrorTerm("lens", rows @ g[:, :2] * stddev, shared=EACH_POSE)] if stddev else []
        return (centroids, catalogue), (*rest, *lens)

    a4 = seen.fit.a4
    return levelled_fix(fitted_fields(seen, about, g, a4), a4, level, tilt, about, terms_of)


# the camera that sees the stars, in place of an unknown one: only its axes count
IDEAL = Camera.from_focal(201, 201, 10_000.0)
RING_STARS, RING_PX = 6, 40.0


def frame_axes(camera: Camera) -> np.ndarray:
    """Rotation (3, 3) of C into the axes of the frame: z through its centre, y down from there, x to the right."""
    x, y = camera.centre_px
    axis, above = camera.directions([x, x], [y, y - 1.0])
    up = rotation.normalised(above - (above @ axis) * axis)
    return np.stack([np.cross(axis, up), -up, axis])


def pointing_fix(pointing: Pointing, tilt: Tilt, about: Circumstances) -> Fix:
    """The fix of a frame whose pointing and roll are known; FixError if it cannot be."""
    level = about.instrument.level(tilt)
    to_level = level.camera @ frame_axes(about.camera).T
    angle = 2 * np.pi * np.arange(RING_STARS) / RING_STARS
    xy = np.array(IDEAL.centre_px) + RING_PX * np.stack([np.cos(angle), np.sin(angle)], -1)
    # so large that refraction's and aberration's effect on the ring's shape is negligible
    spread = RING_STARS * (pointing.sigma * IDEAL.fx) ** 2
    stars = MatchedStars(
        xy,
        np.tile(np.eye(2) * spread, (RING_STARS, 1, 1)),
        IDEAL.directions(*xy.T) @ frame_to_icrs(pointing.ra, pointing.dec, pointing.roll).T,
        np.zeros(RING_STARS),
    )
    seen = fit_stars(stars, IDEAL, to_level, about.atmosphere.refraction(), apparent(stars, about))
    # the centre's error turns the frame about two axes across its own, the roll's error about its own axis
    own = np.diag([pointing.sigma, pointing.sigma, pointing.sigma_roll]) ** 2
    own = to_level @ own @ to_level.T

    def terms_of(rows: np.ndarray) -> tuple[Iterable[ErrorTerm], Iterable[ErrorTerm]]:
        # the pointing's error replaces the errors of the ring's stars
        _, _, *rest = seen.terms(rows, about)
        return (ErrorTerm("pointing", rows @ symmetric_root(own)),), rest

    a4 = seen.fit.a4
    fields = seen_fields(about, level.camera, a4, own)
    fields |= {"residual_arcsec": math.nan, "focal_scale": seen.fit.scale}
    return levelled_fix(fields, a4, level, tilt, about, terms_of)


def frame_to_icrs(ra: float, dec: float, roll: float) -> np.ndarray:
    """Rotation (3, 3) into ICRS of the axes of a frame with this centre, and this position angle of its top, in rad."""
    east, north = np.array([-np.sin(ra), np.cos(ra), 0.0]), rotation.unit_vector(ra, dec + np.pi / 2)
    centre, up = rotation.unit_vector(ra, dec), np.cos(roll) * north + np.sin(roll) * east
    return np.stack([np.cross(centre, up), -up, centre], 1)
