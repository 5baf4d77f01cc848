# SPDX-License-Identifier: Apache-2.0
"""Converts recorded stars and solutions (messages) into a night's."""

from typing import Any

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.vertical import Deflection, geodetic
from starpos.errors import FrameError, StarposError
from starpos.fix.budget import ALWAYS, ErrorTerm
from starpos.fix.solution import Attitude, Status
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.stars import message_to_stars
from starpos.night.night import NO_TILT, ReportedPlace, Shot
from starpos.rotation import full_turn
from starpos.units import ARCSEC
from starpos.utc import utc_text

# by the number in Solution.status
STATUS = (Status.OK, Status.TOO_FEW_STARS, Status.NOT_IDENTIFIED, Status.NO_TILT, Status.TILT_OUT_OF_RANGE,
          Status.TIME_OUTSIDE_TABLES, Status.BAD_INPUT, Status.POOR_FIT)  # fmt: skip


def named_stars(m: Any) -> tuple[str, Stars | FrameError]:
    """A name for a StarArray, and its stars, or the error."""
    name = _name("stars", stamp_to_unix(m.header.stamp))
    try:
        return name, message_to_stars(m, name)
    except FrameError as error:
        return name, error


def _name(what: str, utc_unix_s: float | None) -> str:
    return f"{what} " + ("of unknown time" if utc_unix_s is None else utc_text(utc_unix_s))


def shot_of(m: Any, cameras: dict[tuple[int, int], Camera]) -> Shot:
    """The frame of a Solution message, whose geodetic heading becomes astronomic.  cameras: by size of frame."""
    status = STATUS[m.status] if m.status < len(STATUS) else Status.BAD_INPUT
    at = stamp_to_unix(m.header.stamp)
    utc = float("nan") if at is None else at
    place = pointing = None
    unit = np.array([1.0, 1.0, np.radians(1.0)])
    covariance = np.asarray(m.covariance, float).reshape(3, 3) * np.outer(unit, unit)
    angles = np.radians([m.latitude, m.longitude, m.heading])
    sane = np.isfinite(angles).all() and abs(m.latitude) <= 90 and np.abs([m.xi, m.eta]).max() < 3600
    sane &= bool(np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all())
    if status is Status.OK and sane:
        applied = Deflection(m.xi, m.eta, 0.0)
        heading = angles[2] - geodetic(angles[0], angles[1], 0.0, covariance, applied).azimuth_turn
        terms = tuple(
            ErrorTerm(
                t.name,
                np.vstack([np.diag([t.east, t.north, np.radians(t.heading)]), np.zeros((3, 3))]),
                shared=ALWAYS if t.common else None,
            )
            for t in m.budget
            if t.name != "deflection" and np.isfinite([t.east, t.north, t.heading]).all()
        )
        place = ReportedPlace(
            utc_unix_s=utc,
            latitude=float(angles[0]),
            longitude=float(angles[1]),
            heading=full_turn(heading),
            covariance=covariance,
            terms=terms,
        )
    elif status is Status.OK:
        status = Status.BAD_INPUT
    looking = np.radians([m.right_ascension, m.declination, m.roll])
    if np.isfinite([*looking, m.focal_px]).all() and m.focal_px > 0:
        ra, dec, roll = looking.tolist()
        pointing = Attitude(
            ra=ra,
            dec=dec,
            roll=roll,
            focal_px=m.focal_px,
            residual_arcsec=m.residual,
            log_odds=m.log_odds,
            mirrored=bool(m.mirrored),
        )
    return Shot(
        name=_name("solution", at),
        status=status,
        message=m.status_text,
        utc_unix_s=utc,
        place=place,
        pointing=pointing,
        size=next(iter(cameras)) if len(cameras) == 1 else None,
        stars_detected=int(m.stars_detected),
        stars_matched=int(m.stars_matched),
        residual_arcsec=_finite(m.residual),
        tilt=(_finite(m.tilt.x), _finite(m.tilt.y)) if m.tilt_samples else NO_TILT,
        identify_s=_finite(m.identify_seconds),
        fix_s=_finite(m.fix_seconds),
        # older bags do not have it
        warnings=tuple(getattr(m, "warnings", ())),
    )


def _finite(value: float) -> float:
    """The value, or NaN if it is impossible."""
    return float(value) if abs(value) < 1e9 else float("nan")


def deflection_of(m: Any) -> Deflection | None:
    """The deflection that the solver applied; its sigma follows from the excess of the geodetic covariance."""
    prime, meridian = curvature_radii_m(np.radians(m.latitude))
    # east and north together, because the axes turn close to a pole
    wider = sum(m.covariance_geodetic[k] - m.covariance[k] for k in (0, 4))
    try:
        return Deflection(m.xi, m.eta, float(np.sqrt(max(wider, 0.0)) / np.hypot(prime, meridian) / ARCSEC))
    except StarposError:
        return None
