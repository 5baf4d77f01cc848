# SPDX-License-Identifier: Apache-2.0
"""Messages, as `rosbags` hands them out, to this package's types; what they get wrong raises the type's error."""

import numpy as np

from starpos.earth.ellipsoid import curvature_radii_m
from starpos.earth.vertical import Deflection
from starpos.errors import FrameError, InstrumentError, StarposError
from starpos.fix.budget import ALWAYS, ErrorTerm
from starpos.fix.solver import Attitude, Status
from starpos.frames.stars import Stars
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import LIMIT_RAD
from starpos.report.folder import StarList
from starpos.report.night import NO_TILT, ReportedPlace, Shot
from starpos.rotation import full_turn
from starpos.units import ARCSEC
from starpos.utc import utc_text

UNUSABLE = 1 | 2 | 4  # of Tilt.flags: out of range, stuck, saturated
STATUS = (Status.OK, Status.TOO_FEW_STARS, Status.NOT_IDENTIFIED, Status.NO_TILT, Status.TILT_OUT_OF_RANGE,
          Status.TIME_OUTSIDE_TABLES, Status.BAD_INPUT, Status.POOR_FIT)  # fmt: skip  # by Solution.status


def tilt_row(m, unknown_rad2: np.ndarray) -> tuple[float, ...] | None:
    """Time, x, y (rad), temperature and the four of the covariance (rad2); None where the reading cannot be used.

    unknown_rad2 (2, 2): covariance of one that states none.
    """
    covariance = np.asarray(m.covariance, float).reshape(2, 2)
    if not covariance.any():
        covariance = unknown_rad2
    at = unix_of_stamp(m.header.stamp)
    inside = max(abs(m.x), abs(m.y)) <= LIMIT_RAD  # NaN is not
    known = np.isfinite(covariance).all() and (np.linalg.eigvalsh(covariance) > 0).all()
    if m.flags & UNUSABLE or at is None or not inside or not known:
        return None
    return at, m.x, m.y, m.temperature, *covariance.ravel().tolist()


def unix_of_stamp(stamp) -> float | None:
    """None for 0, which means that no time is known."""
    return stamp.sec + stamp.nanosec * 1e-9 if stamp.sec or stamp.nanosec else None


def exposure_of(m) -> StarList:
    """Of a StarArray."""
    at = unix_of_stamp(m.header.stamp)
    name = "stars " + ("of unknown time" if at is None else utc_text(at))
    try:
        stars = Stars(
            x=[s.x for s in m.stars],
            y=[s.y for s in m.stars],
            flux=[s.flux for s in m.stars],
            snr=[s.snr for s in m.stars],
            covariance=np.array([s.covariance for s in m.stars], float).reshape(-1, 2, 2),
            flags=[s.flags for s in m.stars],
            width=m.width,
            height=m.height,
            mid_unix_s=at,
            exposure_s=m.exposure or None,
            source=name,
            stamp_stddev_s=m.stamp_stddev,
            clock_stddev_s=getattr(m, "clock_stddev", 0.0),  # bags from before it was told
        )
    except FrameError as error:
        return StarList(name, error)
    return StarList(name, stars)


def camera_of(m) -> Camera:
    """Of a CameraInfo; InstrumentError where it is not that of a calibrated, whole frame."""
    k, d = np.asarray(m.k, float), np.asarray(m.d, float)
    region = m.roi
    whole = (region.x_offset, region.y_offset) == (0, 0) and max(m.binning_x, m.binning_y) <= 1
    whole &= (region.width, region.height) in ((0, 0), (m.width, m.height))
    if len(d) not in (0, 5) or m.distortion_model not in ("plumb_bob", "") or not k[0] or not whole:
        raise InstrumentError("its camera_info is not of a calibrated plumb_bob camera with whole frames")
    fx, fy, cx, cy = k[[0, 4, 2, 5]].tolist()
    distortion = tuple(d.tolist()) or (0.0,) * 5
    return Camera(width=m.width, height=m.height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion)


def shot_of(m, cameras: dict[tuple[int, int], Camera]) -> Shot:
    """Of a Solution; its heading is geodetic, ours astronomic."""
    status = STATUS[m.status] if m.status < len(STATUS) else Status.BAD_INPUT
    at = unix_of_stamp(m.header.stamp)
    utc = float("nan") if at is None else at
    place = pointing = None
    unit = np.array([1.0, 1.0, np.radians(1.0)])
    covariance = np.asarray(m.covariance, float).reshape(3, 3) * np.outer(unit, unit)
    angles = np.radians([m.latitude, m.longitude, m.heading])
    sane = np.isfinite(angles).all() and abs(m.latitude) <= 90 and abs(m.eta) < 3600
    sane &= bool(np.isfinite(covariance).all() and (np.diag(covariance) >= 0).all())
    if status is Status.OK and sane:
        heading = angles[2] + m.eta * ARCSEC * np.tan(np.radians(m.latitude_geodetic))
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
        name="solution " + ("of unknown time" if at is None else utc_text(at)),
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
    )


def _finite(value: float) -> float:
    """NaN for what no instrument says."""
    return float(value) if abs(value) < 1e9 else float("nan")


def deflection_of(m) -> Deflection | None:
    """That the solver applied; its error from what it widened the position by."""
    _, meridian = curvature_radii_m(np.radians(m.latitude))
    wider = max(m.covariance_geodetic[4] - m.covariance[4], 0.0)
    try:
        return Deflection(m.xi, m.eta, float(np.sqrt(wider) / meridian / ARCSEC))
    except StarposError:
        return None
