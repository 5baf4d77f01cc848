# SPDX-License-Identifier: Apache-2.0
"""A1: from ICRS to the Earth's own frame ITRS, as the IERS Conventions (2010) have it, through ERFA.

Directions are geocentric apparent ones, with light deflection and annual aberration. Diurnal aberration depends on the
site: it is `station_velocity`, which the fix applies. The IERS table is the one that comes with astropy, so no network is
needed.
"""

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import erfa
import numpy as np

from starpos.earth.ellipsoid import EQUATOR_RADIUS_M, ground_m
from starpos.errors import TimeError
from starpos.frozen import at_once
from starpos.units import ARCSEC, DAY_S, UNIX_EPOCH_JD, utc_text

TT_MINUS_TAI_S = 32.184
# Since 2017; in 1900 it was 72 s less, which changes the aberration by 0.3 mas.
TT_MINUS_UTC_S = 69.184
SPEED_OF_LIGHT = erfa.CMPS
# IERS Conventions (2010), table 1.1.
ROTATION_RAD_S = 7.292115e-5
EQUATOR_M_PER_S = ROTATION_RAD_S * EQUATOR_RADIUS_M
# a time of the first year since 1970 is one that counts from a start
COUNTED_S = 366 * DAY_S
# Days of 1990 to 2090 as astronomers count them: as seconds after 1970 they are of its first month.
DATES = (
    ("Julian date", "2440587.5", (2_447_892.5, 2_484_418.5)),
    ("modified Julian date", "40587", (47_892.0, 84_418.0)),
)
# 1973-01-02: the first day of the IERS table.
FIRST_MJD = 41684.0
# Root mean square error of carrying UT1-UTC on along its last year's slope, over all days of 1973 to 2026, and of
# holding the pole (test_orientation.py computes both).
EXTRAPOLATION_DAYS = (0.0, 30.0, 90.0, 180.0, 365.0, 730.0, 1095.0)
EXTRAPOLATION_SIGMA_S = (0.001, 0.013, 0.033, 0.053, 0.092, 0.25, 0.46)
POLE_SIGMA_RAD = 0.2 * ARCSEC


@dataclass(frozen=True, kw_only=True)
class EarthOrientation:
    """UT1-UTC (s) and the pole (rad) at an instant, with 1 sigma each.

    extrapolated_days  how far the instant lies beyond the end of the table; 0 within it
    """

    ut1_minus_utc_s: float
    ut1_sigma_s: float
    pole_x: float
    pole_y: float
    pole_sigma: float
    extrapolated_days: float = 0.0


@at_once
@dataclass(frozen=True)
class EarthState:
    """All that A1 needs at one instant, computed once for a frame.

    year          Julian year, TT
    astrom        ERFA's geocentric star-independent parameters
    cirs_to_itrs  (3, 3)
    """

    utc_unix_s: float
    year: float
    orientation: EarthOrientation
    astrom: np.ndarray
    cirs_to_itrs: np.ndarray

    @property
    def velocity(self) -> np.ndarray:
        """The Earth's barycentric velocity (3,) in units of c, ICRS axes."""
        return np.array(self.astrom["v"], float)

    @property
    def observer_au(self) -> np.ndarray:
        """The Earth's barycentric place (3,), au, ICRS axes: stars are seen from there."""
        return np.array(self.astrom["eb"], float)

    @property
    def gcrs_to_itrs(self) -> np.ndarray:
        """Rotation (3, 3) of apparent directions, which include aberration, from the axes of ICRS into ITRS."""
        return self.cirs_to_itrs @ np.asarray(self.astrom["bpn"]).reshape(3, 3)

    def to_itrs(self, v: np.ndarray) -> np.ndarray:
        """Turn ICRS directions (N, 3) into geocentric apparent ones (N, 3) in ITRS at this date.

        ERFA's steps of eraAtciqz, without its angles: deflection by the Sun, aberration, bias and precession.
        """
        astrom = self.astrom
        deflected = erfa.ldsun(v, astrom["eh"], astrom["em"])
        return erfa.ab(deflected, astrom["v"], astrom["em"], astrom["bm1"]) @ self.gcrs_to_itrs.T

    def of_itrs(self, v: np.ndarray) -> np.ndarray:
        """Turn geocentric apparent directions (N, 3) in ITRS back into ICRS ones (N, 3); the inverse of `to_itrs`."""
        found = start = v @ self.gcrs_to_itrs
        # each round leaves 1e-4 of the error
        for _ in range(3):
            found = found + start - self.to_itrs(found) @ self.gcrs_to_itrs
        return found / np.linalg.norm(found, axis=-1, keepdims=True)


def earth_state(utc_unix_s: float, orientation: EarthOrientation | None = None) -> EarthState:
    """EarthState at UTC seconds since 1970; TimeError if the Earth orientation of that time is unknown.

    IERS Conventions (2010) chapter 5, equation 5.1 with the CIO; precession-nutation IAU 2006/2000A. orientation is used
    in place of the table's.
    """
    orientation = orientation or earth_orientation(utc_unix_s)
    # computed in seconds, because ERFA's UTC stretches a day that ends in a leap second, and Unix time does not
    tt = UNIX_EPOCH_JD, (utc_unix_s + tai_minus_utc(utc_unix_s) + TT_MINUS_TAI_S) / DAY_S
    ut1 = UNIX_EPOCH_JD, (utc_unix_s + orientation.ut1_minus_utc_s) / DAY_S
    # TT serves as TDB: they differ by 2 ms
    astrom, _ = erfa.apci13(*tt)
    pole = erfa.pom00(orientation.pole_x, orientation.pole_y, erfa.sp00(*tt))
    spin = erfa.rz(erfa.era00(*ut1), np.eye(3))
    year = 2000.0 + (tt[0] - erfa.DJ00 + tt[1]) / erfa.DJY
    return EarthState(utc_unix_s, float(year), orientation, astrom, pole @ spin)


def earth_motion(utc_unix_s: float) -> tuple[float, np.ndarray]:
    """Julian year (TT) and the Earth's barycentric velocity (3,) in units of c, ICRS axes: enough to identify stars.

    From ERFA's eraEpv00, valid from 1900 to 2100, without tables or leap seconds. TimeError outside those years.
    """
    days = (utc_unix_s + TT_MINUS_UTC_S) / DAY_S
    year = 2000.0 + (UNIX_EPOCH_JD - erfa.DJ00 + days) / erfa.DJY
    # true for NaN too
    if not 1900 < year < 2100:
        raise TimeError(
            f"{utc_text(utc_unix_s)} is not between 1900 and 2100: check the clock that stamps the frame"
        )
    _, barycentric = erfa.epv00(UNIX_EPOCH_JD, days)
    return float(year), barycentric["v"] * (erfa.AULT / DAY_S)


def earth_orientation(utc_unix_s: float) -> EarthOrientation:
    """UT1-UTC and the pole from the IERS table; up to three years past its end extrapolated, with a larger sigma.

    TimeError before 1973 and later than that.
    """
    if not np.isfinite(utc_unix_s):
        raise TimeError("the time of the frame is not a finite number: check the clock that stamps it")
    for name, first, days in DATES:
        if days[0] <= utc_unix_s < days[1]:
            raise TimeError(
                f"a time of {utc_unix_s:.5f} s after 1970 looks like a {name}: give s since 1970, (it - {first}) x "
                "86400; or it counts from a start, as time since boot, and stars need UTC"
            )
    if 0 <= utc_unix_s < COUNTED_S:
        raise TimeError(
            f"a time of {utc_unix_s:.3f} s after 1970 is no date: it counts from a start, as simulated time (Gazebo's "
            "/clock) or time since boot, and stars need UTC: start the simulation at a date (gz sim --initial-sim-time), "
            "or have the frames stamped in UTC"
        )
    table = _table()
    mjd = utc_unix_s / DAY_S + UNIX_EPOCH_JD - 2400000.5
    beyond = mjd - table.mjd[-1]
    last_year = 2000 + (table.mjd[-1] - 51544.5) / 365.25
    if mjd < FIRST_MJD or beyond > EXTRAPOLATION_DAYS[-1]:
        raise TimeError(
            f"{utc_text(utc_unix_s)} lies outside the IERS tables (1973 to {last_year:.1f}, and three years "
            "of extrapolation): check the frame's clock, or upgrade astropy-iers-data"
        )
    beyond = max(beyond, 0.0)

    def at(column: np.ndarray) -> float:
        """The value at that day; beyond the table's end its last one."""
        return float(np.interp(mjd, table.mjd, column))

    carried_s = float(np.interp(beyond, EXTRAPOLATION_DAYS, EXTRAPOLATION_SIGMA_S)) if beyond else 0.0
    return EarthOrientation(
        ut1_minus_utc_s=at(table.ut1_minus_tai) + beyond * table.slope + tai_minus_utc(utc_unix_s),
        ut1_sigma_s=math.hypot(at(table.ut1_sigma), carried_s),
        pole_x=at(table.pole_x),
        pole_y=at(table.pole_y),
        pole_sigma=POLE_SIGMA_RAD if beyond else at(table.pole_sigma),
        extrapolated_days=float(beyond),
    )


def measured_until() -> float:
    """Time (UTC, Unix s) of the last measured UT1 in the IERS table; later values are predicted."""
    return (_table().measured_until_mjd - UNIX_EPOCH_JD + 2400000.5) * DAY_S


def table_age_days(utc_unix_s: float) -> float:
    """Days from the last measurement in the IERS table to a time; negative where that is later."""
    return (utc_unix_s - measured_until()) / DAY_S


@at_once
@dataclass(frozen=True, kw_only=True)
class _Table:
    """Daily values (N,): mjd, TAI-UTC (s), UT1-TAI (s; without leap seconds, so it can be interpolated), pole (rad)."""

    mjd: np.ndarray
    tai_minus_utc: np.ndarray
    ut1_minus_tai: np.ndarray
    ut1_sigma: np.ndarray
    pole_x: np.ndarray
    pole_y: np.ndarray
    pole_sigma: np.ndarray
    # How UT1-TAI changed over the last year, s per day.
    slope: float
    measured_until_mjd: float


@lru_cache(maxsize=1)
def _table() -> _Table:
    """Read finals2000A of the IERS from astropy-iers-data; astropy's own reader would take 0.6 s of a node's start."""
    from astropy_iers_data import IERS_A_FILE

    text = Path(IERS_A_FILE).read_bytes()
    lines = np.frombuffer(text, "S1").reshape(-1, text.index(b"\n") + 1)

    def column(first: int, last: int) -> np.ndarray:
        """Numbers in these columns, counted from 1 (IERS, readme.finals2000A); NaN where they are blank."""
        field = np.ascontiguousarray(lines[:, first - 1 : last]).view(f"S{last - first + 1}").ravel()
        return np.where(np.char.strip(field) == b"", b"nan", field).astype(float)

    mjd, ut1_minus_utc = column(8, 15), column(59, 68)
    known = np.flatnonzero(np.isfinite(ut1_minus_utc))[-1] + 1
    mjd = mjd[:known]
    with warnings.catch_warnings():
        # ERFA warns of years whose leap seconds it does not know
        warnings.simplefilter("ignore")
        tai = erfa.utctai(2400000.5, mjd)
    leap = np.round((tai[1] - mjd) * DAY_S)

    def filled(first: int, last: int) -> np.ndarray:
        return np.nan_to_num(column(first, last)[:known], nan=0.0)

    ut1 = filled(59, 68) - leap
    pole_sigma = np.hypot(filled(28, 36), filled(47, 55)) * ARCSEC
    return _Table(
        mjd=mjd,
        tai_minus_utc=leap,
        ut1_minus_tai=ut1,
        ut1_sigma=np.maximum(filled(69, 78), 1e-5),
        pole_x=filled(19, 27) * ARCSEC,
        pole_y=filled(38, 46) * ARCSEC,
        pole_sigma=np.maximum(pole_sigma, 1e-10),
        slope=float((ut1[-1] - ut1[-366]) / 365),
        # I: of IERS Bulletin A, P: predicted
        measured_until_mjd=float(mjd[np.flatnonzero(lines[:known, 57] == b"I")[-1]]),
    )


def tai_minus_utc(utc_unix_s: float) -> float:
    """TAI - UTC (s) of the day; beyond the table's end its last value."""
    table = _table()
    day = int(utc_unix_s // DAY_S + UNIX_EPOCH_JD - 2400000.5 - table.mjd[0])
    return float(table.tai_minus_utc[min(max(day, 0), len(table.mjd) - 1)])


def later(itrs: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Directions (N, 3) in ITRS after a number of seconds (N,), by the Earth's rotation alone."""
    angle = ROTATION_RAD_S * seconds
    c, s, x, y = np.cos(angle), np.sin(angle), itrs[..., 0], itrs[..., 1]
    turned = itrs.copy()
    turned[..., 0], turned[..., 1] = c * x + s * y, c * y - s * x
    return turned


def station_velocity(zenith_itrs: np.ndarray) -> np.ndarray:
    """Velocity (3,) of the rotating ground in units of c, ITRS, at the place whose zenith is zenith_itrs (3,)."""
    x, y, _ = ground_m(zenith_itrs)
    return ROTATION_RAD_S / SPEED_OF_LIGHT * np.array([-y, x, 0.0])
