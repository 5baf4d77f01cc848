# SPDX-License-Identifier: Apache-2.0
"""Orbits of satellites from files: mean elements (TLE, 3LE; OMM in JSON, XML, CSV), and ephemerides (OEM, SP3).

Mean elements are for SGP4 with the constants of WGS 72 alone (Hoots and Roehrich 1980, Spacetrack Report 3; Vallado et
al. 2006, AIAA 2006-6753), by the package sgp4; OMM and OEM are CCSDS 502.0-B, SP3 is the IGS's (Hilla 2016).
"""

import csv
import io
import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import erfa
import numpy as np
from numpy.polynomial import polynomial

from starpos.earth.orientation import TT_MINUS_TAI_S, EarthState, earth_state, tai_minus_utc
from starpos.errors import SatelliteError, StarposError, one_line
from starpos.files import read_regular
from starpos.tables import packaged
from starpos.units import DAY_S, UNIX_EPOCH_JD, unix_of, utc_text

MOST_BYTES = 300_000_000
# of the epochs of sgp4init: 1949-12-31, as a Julian date
SGP4_EPOCH_JD = 2433281.5
GPS_MINUS_TAI_S = -19.0
# type of ephemeris of elements for another theory
XP = 4
# states of an ephemeris that one polynomial passes through
POINTS = 9


class OrbitErrors(NamedTuple):
    """Prior errors (1 sigma) of a class of orbits, m, at once and per day: along the motion, and across and radially."""

    along_m: float
    along_m_per_day: float
    across_m: float
    across_m_per_day: float
    max_age_days: float

    def sigma(self, age_days: float | np.ndarray) -> np.ndarray:
        """Standard deviations (..., 3) in m: radial, along, across, of orbits that are so old (...)."""
        days = np.abs(age_days)
        across = self.across_m + self.across_m_per_day * days
        return np.stack([across, self.along_m + self.along_m_per_day * days, across], -1)


_ROWS = {row.pop("class"): row for row in packaged("starpos.satellites", "orbit_classes.csv")}
THRUST = tuple(_ROWS["manoeuvring"]["names"].split("|"))
CLASSES = {name: OrbitErrors(*(float(row[f]) for f in OrbitErrors._fields)) for name, row in _ROWS.items()}
GEOSTATIONARY_PER_DAY = 0.9, 1.1


@dataclass(frozen=True, eq=False)
class Ephemeris:
    """States at times (N,), Unix s: positions (N, 3), m, GCRS."""

    utc_unix_s: np.ndarray
    places: np.ndarray

    def at(self, utc_unix_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (3,) in m and m/s by Lagrange's polynomial; NaN outside its times."""
        t = self.utc_unix_s
        if not t[0] <= utc_unix_s <= t[-1]:
            return np.full(3, np.nan), np.full(3, np.nan)
        first = int(np.searchsorted(t, utc_unix_s)) - POINTS // 2
        first = min(max(first, 0), max(len(t) - POINTS, 0))
        span = slice(first, first + POINTS)
        step = t[first + 1] - t[first]
        x = (t[span] - utc_unix_s) / step
        c = polynomial.polyfit(x, self.places[span], len(x) - 1)
        return c[0], c[1] / step


@dataclass(frozen=True, kw_only=True, eq=False)
class Orbit:
    """One satellite's orbit: SGP4's record, or an ephemeris.

    number: of the catalogue.  epoch_unix_s: of the elements, or the first state of an ephemeris.
    """

    number: int
    name: str
    epoch_unix_s: float
    errors: OrbitErrors
    record: Any = None
    ephemeris: Ephemeris | None = None

    def age_days(self, utc_unix_s: float) -> float:
        """Time since the epoch."""
        return (utc_unix_s - self.epoch_unix_s) / DAY_S

    def reaches(self, utc_unix_s: float) -> bool:
        """Whether an ephemeris has that time, or elements are not too old for it."""
        if self.ephemeris is not None:
            return bool(self.ephemeris.utc_unix_s[0] <= utc_unix_s <= self.ephemeris.utc_unix_s[-1])
        return abs(self.age_days(utc_unix_s)) <= self.errors.max_age_days


def read_orbits(path: Path | str) -> tuple[list[Orbit], list[str]]:
    """All orbits of a file, or of each file in a folder, and a sentence about what could not be read; SatelliteError."""
    if Path(path).is_dir():
        files = sorted(p for p in Path(path).iterdir() if p.is_file() and not p.name.startswith("."))
        orbits: list[Orbit] = []
        said: list[str] = []
        for file in files:
            try:
                more, about = read_orbits(file)
            except SatelliteError as e:
                more, about = [], [str(e)]
            orbits += more
            said += about
        if not orbits:
            raise SatelliteError(f"{path}: no file in it has orbits of satellites: {CURE}")
        return orbits, said
    try:
        text = read_regular(path, MOST_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        reason = getattr(e, "strerror", None) or "it is no text"
        raise SatelliteError(f"{path}: no readable orbits ({reason}): {CURE}") from None
    try:
        read = list(_orbits(text))
    except (ValueError, ET.ParseError, csv.Error, StarposError) as e:
        raise SatelliteError(f"{path}: no readable orbits ({one_line(e)}): {CURE}") from None
    except ImportError:
        raise SatelliteError("orbits need the package sgp4: pip install sgp4") from None
    found, bad = [o for o in read if isinstance(o, Orbit)], [o for o in read if isinstance(o, str)]
    if not found:
        raise SatelliteError(f"{path}: it has no orbits of satellites{f' ({bad[0]})' if bad else ''}: {CURE}")
    left = "1 is left out" if len(bad) == 1 else f"{len(bad)} are left out"
    return found, [f"{path}: of {len(found) + len(bad)} orbits {left} ({bad[0]})"] if bad else []


class StoredOrbits:
    """The orbits of a file or folder, read again when it changes; SatelliteError where it has none at the beginning."""

    def __init__(self, path: Path | str) -> None:
        self._path, self.trouble = Path(path), ""
        self._orbits, _ = read_orbits(self._path)
        self._files = self._file_states()

    def read(self) -> list[Orbit]:
        """The orbits as they are now; if they became unreadable, the earlier ones, and `trouble` says why."""
        try:
            if (files := self._file_states()) != self._files:
                self._orbits, said = read_orbits(self._path)
                self._files, self.trouble = files, " ".join(said)
        except (OSError, SatelliteError) as error:
            self.trouble = str(error)
        return self._orbits

    def _file_states(self) -> list[tuple[str, int, int]]:
        """Name, time of writing and size of each file."""
        files = sorted(self._path.iterdir()) if self._path.is_dir() else [self._path]
        return [(f.name, (state := f.stat()).st_mtime_ns, state.st_size) for f in files]


CURE = "give TLE, OMM (JSON, XML or CSV), OEM or SP3"


def _orbits(text: str) -> Iterator[Orbit | str]:
    """The orbits of a text, or for each one that is broken what is wrong with it."""
    start = text.lstrip()[:4000]
    if start.startswith(("{", "[")):
        rows = json.loads(text)
        yield from _from_omm(rows if isinstance(rows, list) else [rows])
    elif start.startswith("<"):
        # an entity may unfold to more than memory holds
        if "<!DOCTYPE" in text or "<!ENTITY" in text:
            raise ValueError("its XML declares a type or entities")
        root = ET.fromstring(text)
        if any(e.tag.rpartition("}")[2] == "stateVector" for e in root.iter()):
            raise ValueError("an OEM in XML: give it as text (KVN)")
        yield from _from_omm(_xml_rows(root))
    elif start.startswith("CCSDS_OEM_VERS"):
        yield from _from_oem(text)
    elif start[:2] in ("#a", "#b", "#c", "#d"):
        yield from _from_sp3(text)
    elif "NORAD_CAT_ID" in start.partition("\n")[0]:
        yield from _from_omm(csv.DictReader(io.StringIO(text)))
    else:
        yield from _from_lines(text)


def _class_of(name: str, per_day: float) -> OrbitErrors:
    if GEOSTATIONARY_PER_DAY[0] < per_day < GEOSTATIONARY_PER_DAY[1]:
        return CLASSES["geostationary"]
    if name.upper().startswith(THRUST):
        return CLASSES["manoeuvring"]
    return CLASSES["passive"] if name else CLASSES["unnamed"]


def _of_record(number: int, name: str, record: Any) -> Orbit | str:
    from sgp4.api import SGP4_ERRORS

    # old versions leave `record.error` undefined before the first state
    error, _, _ = record.sgp4(record.jdsatepoch, record.jdsatepochF)
    if error:
        return f"satellite {number}: {SGP4_ERRORS[error]}"
    epoch = (record.jdsatepoch - UNIX_EPOCH_JD + record.jdsatepochF) * DAY_S
    per_day = record.no_kozai * 1440 / (2 * math.pi)
    if not (math.isfinite(epoch) and 0 < per_day < 20):
        return f"satellite {number}: its mean motion is {per_day:g} a day"
    return Orbit(number=number, name=name, epoch_unix_s=epoch, errors=_class_of(name, per_day), record=record)


def _from_lines(text: str) -> Iterator[Orbit | str]:
    """Two lines a satellite, with or without a line of its name before (Spacetrack Report 3; Kelso 1998)."""
    from sgp4.api import Satrec
    from sgp4.io import compute_checksum

    lines = [line.rstrip() for line in text.splitlines()]
    numbered, before = enumerate(lines, 1), ""
    for number, line in numbered:
        if not line.startswith("1 ") or len(line) < 60:
            before = line.removeprefix("0 ").strip()
            continue
        second = lines[number] if number < len(lines) else ""
        if not second.startswith("2 ") or second[2:7] != line[2:7]:
            yield f"line {number}: no second line of the same satellite follows"
            continue
        next(numbered)
        wrong = [
            n
            for n, text_ in ((number, line), (number + 1, second))
            if text_[68:69] != str(compute_checksum(text_))
        ]
        if wrong:
            yield f"line {wrong[0]}: its check sum is wrong"
        else:
            try:
                record = Satrec.twoline2rv(line, second)
                if record.ephtype == XP:
                    yield f"line {number}: its elements are for SGP4-XP, not for SGP4"
                else:
                    yield _of_record(record.satnum, before, record)
            except ValueError as e:
                yield f"line {number + 1}: {one_line(e)}"
        before = ""


def _xml_rows(root: ET.Element) -> Iterator[dict]:
    """The fields of each OMM in an NDM or a single one."""
    for segment in root.iter():
        if segment.tag.rpartition("}")[2] == "segment":
            yield {e.tag.rpartition("}")[2]: e.text for e in segment.iter()}


def _from_omm(rows: Iterable[Any]) -> Iterator[Orbit | str]:
    for k, row in enumerate(rows, 1):
        try:
            yield _from_fields(row)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, StarposError) as e:
            lacking = "no " if isinstance(e, KeyError) else ""
            yield f"message {k}: {lacking}{one_line(e)}"


def _from_fields(row: Mapping[str, Any]) -> Orbit | str:
    from sgp4.api import WGS72, Satrec

    if (theory := row.get("MEAN_ELEMENT_THEORY") or "SGP4") not in ("SGP4", "SGP/SGP4"):
        return f"satellite {row['NORAD_CAT_ID']}: its elements are for {theory}, not for SGP4"
    number = int(row["NORAD_CAT_ID"])
    if str(row.get("EPHEMERIS_TYPE") or 0).strip() == str(XP):
        return f"satellite {number}: its elements are for SGP4-XP, not for SGP4"
    epoch = _time(str(row["EPOCH"]).strip())
    angles = ("ARG_OF_PERICENTER", "INCLINATION", "MEAN_ANOMALY", "RA_OF_ASC_NODE")
    perigee, inclination, anomaly, node = (math.radians(float(row[name])) for name in angles)
    values = (
        float(row["BSTAR"]),
        # SGP4 makes no use of the derivatives of the mean motion
        0.0,
        0.0,
        float(row["ECCENTRICITY"]),
        perigee,
        inclination,
        anomaly,
        float(row["MEAN_MOTION"]) * 2 * math.pi / 1440,
        node,
    )
    if not all(map(math.isfinite, values)):
        return f"satellite {number}: an element is not finite"
    record = Satrec()
    # a number of six digits has no place in the record
    record.sgp4init(WGS72, "i", 0, epoch / DAY_S + UNIX_EPOCH_JD - SGP4_EPOCH_JD, *values)
    return _of_record(number, str(row.get("OBJECT_NAME") or "").strip(), record)


def _of_states(
    text: str, name: str, errors: OrbitErrors, rows: list[tuple[float, np.ndarray]]
) -> Orbit | str:
    """An ephemeris of times and places in GCRS; text: the object's id."""
    # other ids than catalogue numbers become a negative number of their own
    number = int(text) if text.isdigit() else -sum(ord(c) << 8 * (k % 3) for k, c in enumerate(text))
    rows.sort(key=lambda row: row[0])
    times = np.array([row[0] for row in rows])
    places = np.array([row[1] for row in rows])
    if len(rows) < POINTS or not (np.isfinite(places).all() and (np.diff(times) > 0).all()):
        return f"{name or number}: an ephemeris needs {POINTS} states at different times"
    ephemeris = Ephemeris(times, places)
    return Orbit(number=number, name=name, epoch_unix_s=times[0], errors=errors, ephemeris=ephemeris)


def _from_oem(text: str) -> Iterator[Orbit | str]:
    """Segments of an OEM in GCRF, EME2000, ICRF, ITRF or TEME, and UTC, TAI, TT or GPS (CCSDS 502.0-B)."""
    about: dict[str, str] = {}
    rows: list[tuple[float, np.ndarray]] = []
    skipped = False
    for line in [*text.splitlines(), "META_START"]:
        key, equals, value = (part.strip() for part in line.partition("="))
        if key == "META_START":
            if rows:
                yield _of_states(
                    about.get("OBJECT_ID", ""), about.get("OBJECT_NAME", ""), CLASSES["operators"], rows
                )
            about, rows = {}, []
        elif key.startswith("COVARIANCE_ST"):
            skipped = key == "COVARIANCE_START"
        elif equals:
            about[key] = value
        elif not skipped and len(cells := line.split()) >= 7 and cells[0][:1].isdigit():
            if about.get("CENTER_NAME", "EARTH").upper() != "EARTH":
                raise ValueError(f"it is about {about['CENTER_NAME']}, not about the Earth")
            utc = _utc(_time(cells[0]), about.get("TIME_SYSTEM", "UTC"))
            place = np.array([float(cell) for cell in cells[1:4]]) * 1e3
            rows.append((utc, place @ _to_gcrs(about.get("REF_FRAME", ""), utc).T))


def _time(text: str) -> float:
    """Unix seconds of a time of CCSDS, whose date may be year and day of the year."""
    text = text.rstrip("Z")[:26]
    if found := re.match(r"(\d{4})-(\d{3})T", text):
        return unix_of(f"{found[1]}-01-01{text[8:]}") + (int(found[2]) - 1) * DAY_S
    return unix_of(text)


def _utc(unix_s: float, system: str) -> float:
    """UTC of a time of another scale, all as Unix seconds; ValueError for an unknown scale."""
    if system == "UTC":
        return unix_s
    ahead = {"TAI": 0.0, "TT": TT_MINUS_TAI_S, "GPS": GPS_MINUS_TAI_S}
    if system not in ahead:
        raise ValueError(f"its times are {system}: UTC, TAI, TT and GPS are read")
    tai = unix_s - ahead[system]
    return tai - tai_minus_utc(tai - tai_minus_utc(tai))


def _to_gcrs(frame: str, utc_unix_s: float) -> np.ndarray:
    """Rotation (3, 3) of a reference frame into GCRS; ValueError for an unknown frame."""
    if frame in ("GCRF", "ICRF", "EME2000", "J2000"):
        # the bias of EME2000, 0.02 arcsec, is 0.7 m in a low orbit
        return np.eye(3)
    if frame.startswith(("ITRF", "IGS", "WGS")):
        return earth_state(utc_unix_s).gcrs_to_itrs.T
    if frame == "TEME":
        return teme_to_gcrs(earth_state(utc_unix_s))
    raise ValueError(f"its reference frame is {frame or 'not stated'}: GCRF, EME2000, ITRF and TEME are read")


def teme_to_gcrs(state: EarthState) -> np.ndarray:
    """Rotation (3, 3) of TEME, the axes of SGP4, into GCRS.

    TEME turns into the Earth's by the mean sidereal time of 1982 (Vallado et al. 2006, AIAA 2006-6753, appendix C).
    """
    ut1 = UNIX_EPOCH_JD, (state.utc_unix_s + state.orientation.ut1_minus_utc_s) / DAY_S
    back = erfa.rz(erfa.gmst82(*ut1) - erfa.era00(*ut1), np.eye(3))
    return np.asarray(state.astrom["bpn"]).reshape(3, 3).T @ back


def _from_sp3(text: str) -> Iterator[Orbit | str]:
    """The satellites of an SP3 file: places in the Earth's frame, km, by GPS time or UTC."""
    rows: dict[str, list[tuple[float, np.ndarray]]] = {}
    system, utc, turn = "GPS", math.nan, np.eye(3)
    for line in text.splitlines():
        if line.startswith("%c") and (stated := line[9:12].strip()) not in ("ccc", ""):
            system = stated
        elif line.startswith("* "):
            year, month, day, hour, minute, second = line[1:].split()
            stamp = f"{int(year):04d}-{int(month):02d}-{int(day):02d}T{int(hour):02d}:{int(minute):02d}:00"
            utc = _utc(unix_of(stamp) + float(second), system)
            turn = _to_gcrs("ITRF", utc)
        elif line.startswith("P") and len(line) >= 46:
            place = np.array([float(line[k : k + 14]) for k in (4, 18, 32)]) * 1e3
            # zeros stand for a place that is not known
            if place.any():
                rows.setdefault(line[1:4], []).append((utc, place @ turn.T))
    for name, states in rows.items():
        yield _of_states(name, name, CLASSES["precise"], states)


def chosen(
    orbits: Iterable[Orbit], utc_unix_s: float, *, newer: bool = False
) -> tuple[list[Orbit], list[str]]:
    """Each satellite's newest usable orbit at a time, and sentences about those left out; SatelliteError if none is left.

    newer: also elements whose epoch is after that time.
    """
    best: dict[int, Orbit] = {}
    too_new, too_old = set[int](), set[int]()

    def certain(orbit: Orbit) -> tuple[float, float]:
        days = abs(orbit.age_days(utc_unix_s))
        return orbit.errors.along_m + orbit.errors.along_m_per_day * days, days

    for orbit in sorted(orbits, key=certain):
        if not orbit.reaches(utc_unix_s):
            too_old.add(orbit.number)
        elif orbit.ephemeris is None and orbit.epoch_unix_s > utc_unix_s and not newer:
            too_new.add(orbit.number)
        else:
            best.setdefault(orbit.number, orbit)
    said = []
    if newer_only := len(too_new - set(best)):
        said.append(
            f"the elements of {newer_only} satellites are newer than {utc_text(utc_unix_s)}: they are used with "
            "--newer-elements alone"
        )
    if older_only := len(too_old - set(best)):
        passive, manoeuvring = (CLASSES[name].max_age_days for name in ("passive", "manoeuvring"))
        said.append(
            f"the orbits of {older_only} satellites do not reach {utc_text(utc_unix_s)}, or are older than their class "
            f"allows ({passive:.0f} days, {manoeuvring:.0f} for those that manoeuvre)"
        )
    if not best:
        raise SatelliteError(f"{'; '.join(said) or 'there are no orbits'}: get elements of that day")
    return list(best.values()), said
