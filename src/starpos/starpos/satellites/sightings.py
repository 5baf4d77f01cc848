# SPDX-License-Identifier: Apache-2.0
"""Trails from tables of sightings, and from observers' reports in the IOD format."""

import math
import re
from pathlib import Path

import erfa
import numpy as np

from starpos.earth.orientation import TT_MINUS_UTC_S
from starpos.errors import SatelliteError, TimeError
from starpos.files import read_regular
from starpos.rotation import unit_vector
from starpos.satellites.trails import SatelliteTrail
from starpos.tables import TableForm
from starpos.units import ARCSEC, DAY_S, UNIX_EPOCH_JD, unix_of

# a sighting's own error is never smaller
LEAST_STDDEV_ARCSEC = 0.01
MOST_IOD_BYTES = 30_000_000
SIGHTINGS = TableForm(
    what="table of sightings",
    error=SatelliteError,
    needed=("track", "utc", "ra_deg", "dec_deg", "stddev_arcsec"),
    optional=("satellite", "time_stddev_s"),
    limits={
        "track": (0, 1e9),
        "utc": (0, 1e10),
        "ra_deg": (-360, 720),
        "dec_deg": (-90, 90),
        "stddev_arcsec": (LEAST_STDDEV_ARCSEC, 36000),
        "satellite": (1, 1e9),
        "time_stddev_s": (0, 3600),
    },
    times=("utc",),
)


def read_sightings(path: Path | str) -> list[SatelliteTrail]:
    """The trails of a CSV, whose rows of one track are its ends; SatelliteError."""
    table = SIGHTINGS.read(path)
    columns = {name: table.column(name) for name in (*SIGHTINGS.needed, *SIGHTINGS.optional)}
    trails = []
    for track in np.unique(columns["track"]):
        rows = np.flatnonzero(columns["track"] == track)
        rows = rows[np.argsort(columns["utc"][rows], kind="stable")]
        if len(rows) > 2 or len(set(columns["utc"][rows])) < len(rows):
            raise SatelliteError(
                f"{path}:{table.lines[rows[-1]]}: track {track:.0f} has {len(rows)} rows: a trail has one, or two at the "
                "opening and the closing of the shutter"
            )
        number = columns["satellite"][rows[0]]
        late = columns["time_stddev_s"][rows[0]]
        variance = (columns["stddev_arcsec"][rows] * ARCSEC) ** 2
        trails.append(
            SatelliteTrail(
                track=int(track),
                directions=unit_vector(*np.radians([columns["ra_deg"][rows], columns["dec_deg"][rows]])),
                covariance=variance[:, None, None] * np.eye(2),
                utc_unix_s=columns["utc"][rows],
                time_stddev_s=0.0 if math.isnan(late) else float(late),
                satellite=None if math.isnan(number) else int(number),
            )
        )
    return trails


# Columns of the IOD format (satobs.org/position/IODformat.html): number, designation, station, its status, time, error
# of the time, formats of angle and epoch, both angles, their error.
IOD_LINE = re.compile(
    r"(?P<number>[\d ]{5}) (?P<designation>.{9}) (?P<station>\d{4}) (?P<status>.) (?P<time>\d{8}[\d ]{9}) "
    r"(?P<late>\d\d) (?P<angles>\d)(?P<epoch>[\d ]) (?P<first>[\d ]{7})(?P<second>[+-][\d ]{6})(?: (?P<error>\d\d))?"
)
# units of the angles' error, arcsec, by the format of the angles; formats 4 to 6 are azimuth and elevation
ERROR_UNIT = {"1": 1.0, "2": 60.0, "3": 3600.0, "7": 3600.0}
# where a report states no error
UNSTATED_ARCSEC, UNSTATED_S = 120.0, 0.2


def read_iod(path: Path | str) -> tuple[list[SatelliteTrail], list[str]]:
    """The sightings of a file of IOD lines, each a trail of one end, and a sentence about lines that cannot be used."""
    try:
        lines = read_regular(path, MOST_IOD_BYTES).decode("latin-1").splitlines()
    except OSError as e:
        raise SatelliteError(f"{path}: not readable ({e.strerror}): give a file of IOD lines") from None
    trails: list[SatelliteTrail] = []
    bad = []
    for number, line in enumerate(lines, 1):
        if not (found := IOD_LINE.match(line)):
            if re.match(r"\d{5} ", line):
                bad.append(f"line {number} is not as the format has it")
            continue
        try:
            trails.append(_of_iod(found, len(trails)))
        except (ValueError, TimeError) as e:
            bad.append(f"line {number}: {e}")
    if not trails:
        raise SatelliteError(
            f"{path}: no sighting in the IOD format{f' ({bad[0]})' if bad else ''}: give one a line"
        )
    return trails, [f"{path}: {len(bad)} lines cannot be used ({bad[0]})"] if bad else []


def _of_iod(line: re.Match, track: int) -> SatelliteTrail:
    if line["angles"] not in ERROR_UNIT:
        raise ValueError("azimuth and elevation are no place among the stars")
    digits = line["time"].replace(" ", "0")
    y, mo, d, h, mi, s, ms = (
        digits[a:b] for a, b in ((0, 4), (4, 6), (6, 8), (8, 10), (10, 12), (12, 14), (14, 17))
    )
    utc = unix_of(f"{y}-{mo}-{d}T{h}:{mi}:{s}.{ms}")
    hours, degrees = _angles(
        line["angles"], line["first"].replace(" ", "0"), line["second"].replace(" ", "0")
    )
    error = _error(line["error"]) * ERROR_UNIT[line["angles"]] if line["error"] else UNSTATED_ARCSEC
    late = _error(line["late"]) or UNSTATED_S
    number = line["number"].strip()
    direction = unit_vector(math.radians(15 * hours), math.radians(degrees))
    return SatelliteTrail(
        track=track,
        directions=to_icrs(direction, line["epoch"].replace(" ", "0"), utc)[None],
        covariance=(max(error or UNSTATED_ARCSEC, LEAST_STDDEV_ARCSEC) * ARCSEC) ** 2 * np.eye(2)[None],
        utc_unix_s=np.array([utc]),
        time_stddev_s=late,
        satellite=int(number) if number else None,
    )


def _error(digits: str) -> float:
    """Mantissa and exponent, MX: M x 10^(X - 8)."""
    return int(digits[0]) * 10.0 ** (int(digits[1]) - 8)


def _angles(kind: str, first: str, second: str) -> tuple[float, float]:
    """Right ascension (h) and declination (deg) of a format's digits."""
    minutes = int(first[2:4]) + int(first[4:6]) / 60 + int(first[6]) / 600
    if kind in "23":
        minutes = int(first[2:7]) / 1000
    hours = int(first[:2]) + minutes / 60
    degrees, rest = int(second[1:3]), second[3:]
    if kind == "1":
        part = int(rest[:2]) / 60 + int(rest[2:4]) / 3600
    elif kind == "2":
        part = int(rest) / 6000
    else:
        part = int(rest) / 10000
    if hours >= 24 or degrees + part > 90:
        raise ValueError("its angles are no place in the sky")
    return hours, (degrees + part) * (-1 if second[0] == "-" else 1)


def to_icrs(direction: np.ndarray, epoch: str, utc_unix_s: float) -> np.ndarray:
    """ICRS direction (3,) of one against mean equator and equinox of an epoch: 0 of date, 4 B1950, 5 J2000, 6 J2050."""
    if epoch == "5":
        return direction
    if epoch == "4":
        ra, dec, *_ = erfa.fk45z(math.atan2(direction[1], direction[0]), math.asin(direction[2]), 1950.0)
        return unit_vector(ra, dec)
    if epoch not in "06":
        raise ValueError(f"its epoch code is {epoch}: 0 (of date), 4 (1950), 5 (2000) and 6 (2050) are read")
    julian = UNIX_EPOCH_JD, (utc_unix_s + TT_MINUS_UTC_S) / DAY_S
    if epoch == "6":
        julian = erfa.DJ00, 50 * erfa.DJY
    # bias and precession of IAU 2006; nutation is in no mean place
    return erfa.pmat06(*julian).T @ direction
