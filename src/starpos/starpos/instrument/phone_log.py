# SPDX-License-Identifier: Apache-2.0
"""Logs of a telephone's accelerometer as tilts: phyphox (zip, or a CSV with its meta/time.csv), Sensor Logger (zip,
CSV or JSON).

A telephone's x points to the right of its screen, y to its top, z out of it.  S has the axes of the pictures that its
back camera stores, as iPhones hold them: columns along -y, rows along -x, so that A3 is about zero for that camera.
phyphox writes the specific force, upward, on iOS too (its source: phyphox-ios, kG = -9.81).  Sensor Logger writes gravity
downward on iOS unless its setting "Standardise Units & Frames" is on, and upward on Android (its own documents).
"""

import csv
import io
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from starpos.errors import TiltError, one_line
from starpos.files import open_regular, read_regular, unpacked
from starpos.instrument.tilt_log import TiltLog
from starpos.tables import TableForm
from starpos.units import STANDARD_GRAVITY

FORM = TableForm(
    what="telephone's log", error=TiltError, needed=("time", "x", "y", "z"), broken_rows_are_nan=True
)
MAX_FILES = 5000
START, DEVICE = "meta/time.csv", "metadata.csv"
# Sensors of Sensor Logger, the best first; on iOS, and on most Androids, its Accelerometer is without gravity.
SENSORS = ("gravity", "totalacceleration", "accelerometeruncalibrated", "accelerometer")
# a column of an axis or of the time, in any language of the app; its unit is missing in Sensor Logger's own names
AXIS = re.compile(r"(?:.* )?([xyz])(?: \(m/s(?:\^2|\u00b2)\))?")
TIME = re.compile(r"time|.* \(s\)")
# A reading's length over gravity's may differ from 1 by this while the telephone rests; the usual one, of any recording.
AT_REST, GRAVITY = 0.03, 0.1
# nanoseconds since 1970 are more, seconds since the start are fewer
NANOSECONDS = 1e15
HEAD, ZIP = 4096, b"PK\x03\x04"
CURE = "give the app's zip as it exports it, of gravity or of the acceleration with gravity"


def is_phone_log(path: Path) -> bool:
    """Whether a file looks like a telephone's log."""
    head = _head(path)
    return head.startswith((ZIP, b"[")) or _is_header(head.decode("utf-8-sig", "replace").partition("\n")[0])


def _head(path: Path) -> bytes:
    """The beginning of a file, without white space; empty if it cannot be read."""
    try:
        with open_regular(path) as file:
            return file.read(HEAD).lstrip(b"\xef\xbb\xbf \r\n")
    except OSError:
        return b""


def read(path: Path, noise_rad: float) -> TiltLog | None:
    """The readings of a telephone's log; None if the file is of another kind.  Raises TiltError if it cannot be used.

    noise_rad: 1 sigma of the white noise of a reading.
    """
    if not is_phone_log(path):
        return None
    head = _head(path)
    try:
        if head.startswith(ZIP):
            return _log(path, _texts(unpacked(path, FORM.most_bytes, MAX_FILES, _is_wanted)), noise_rad)
        if head.startswith(b"["):
            return _log(path, _tables_of_json(read_regular(path, FORM.most_bytes)), noise_rad)
        beside = [path, path.parent / START, path.parent / "Metadata.csv"]
        found = {p: read_regular(p, FORM.most_bytes) for p in beside if p is path or p.is_file()}
        return _log(path, _texts({f"{p.relative_to(path.parent)}": found[p] for p in found}), noise_rad)
    except TiltError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as e:
        reason = getattr(e, "strerror", None) or one_line(e)
        raise TiltError(f"{path}: not a readable telephone's log ({reason}): {CURE}") from None


def _is_wanted(name: str) -> bool:
    return name.lower().endswith(".csv") and not PurePosixPath(name).name.startswith("._")


def _texts(files: Mapping[str, bytes]) -> dict[str, str]:
    """The tables by their names in lower case, with commas between cells and points in numbers."""
    texts = {}
    for name, content in files.items():
        head, line_end, rest = content.decode("utf-8-sig").replace("\r\n", "\n").partition("\n")
        between = next((c for c in "\t;" if c in head), ",")
        if between != ",":
            head, rest = head.replace(between, ","), rest.replace(",", ".").replace(between, ",")
        place = PurePosixPath(name.lower())
        texts[START if place.parts[-2:] == ("meta", "time.csv") else place.name] = head + line_end + rest
    return texts


def _tables_of_json(content: bytes) -> dict[str, str]:
    """Make such tables of Sensor Logger's JSON, an array of objects, one a reading; of the sensors that are read here."""
    tables: dict[str, list[str]] = {}
    for row in json.loads(content):
        sensor = str(row["sensor"]).lower()
        if sensor == "metadata":
            tables[sensor] = [",".join(map(str, row)), ",".join(json.dumps(str(v)) for v in row.values())]
        elif sensor in SENSORS:
            lines = tables.setdefault(sensor, ["time,x,y,z"])
            lines.append(",".join(str(row[name]) for name in FORM.needed))
    return {f"{name}.csv": "\n".join(lines) for name, lines in tables.items()}


def _names(head: str) -> list[str]:
    """The columns of a table, those that are read by the names of FORM."""
    names = [name.strip('" \t\r\n').lower() for name in head.split(",")]
    axes = [AXIS.fullmatch(name) for name in names]
    times = [k for k, name in enumerate(names) if TIME.fullmatch(name)]
    return [
        axis[1] if axis else "time" if k in times[:1] else name
        for k, (name, axis) in enumerate(zip(names, axes, strict=True))
    ]


def _is_header(head: str) -> bool:
    between = next((c for c in "\t;" if c in head), ",")
    return set(FORM.needed) <= set(_names(head.replace(between, ",")))


def _readings(texts: Mapping[str, str], path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """The tables that may hold gravity, the likeliest first, as rows (N, 4) of time and three axes."""
    rank = {f"{name}.csv": k for k, name in enumerate(SENSORS)}
    for name in sorted(texts, key=lambda name: rank.get(name, len(rank))):
        head, _, rest = texts[name].partition("\n")
        if name not in (START, DEVICE) and _is_header(head):
            text = io.StringIO(f"{','.join(_names(head))}\n{rest}")
            place = f"{path}" if name == path.name.lower() else f"{path}: {name}"
            columns = FORM.read_text(text, place).columns
            yield name, np.stack([columns[c] for c in FORM.needed], -1)


def _log(path: Path, texts: Mapping[str, str], noise_rad: float) -> TiltLog:
    seen = []
    for name, rows in _readings(texts, path):
        strength = np.linalg.norm(rows[:, 1:], axis=1)
        usual = float(np.nanmedian(strength))
        unit = next((u for u in (STANDARD_GRAVITY, 1.0) if abs(usual / u - 1) <= GRAVITY), None)
        seen.append(f"{name} is {usual:.2g} long")
        if unit is None:
            continue
        upward = _upward(texts)
        up = (upward or 1) * -rows[:, [2, 1, 3]] / strength[:, None]
        up[~(abs(strength / unit - 1) <= AT_REST)] = np.nan
        at = rows[:, 0] * 1e-9 if np.nanmedian(rows[:, 0]) > NANOSECONDS else _unix_s(rows[:, 0], texts)
        order = np.argsort(at, kind="stable")[: np.isfinite(at).sum()]
        x, y, z = np.arcsin(np.clip(up[order], -1, 1)).T
        log = TiltLog.of(at[order], x, y, np.full(len(x), np.nan), noise_rad, theta_z=z)
        return replace(log, either_way=not upward)
    raise TiltError(
        f"{path}: no gravity in it, which is 9.81 m/s2 or 1 g long ({', '.join(seen) or 'no table of x, y, z'}): {CURE}"
    )


def _upward(texts: Mapping[str, str]) -> int:
    """1 where the readings point up at rest, -1 where down, 0 where the files do not say."""
    if START in texts:
        return 1
    told = next(iter(csv.DictReader(io.StringIO(texts.get(DEVICE, "").lower()))), {})
    if told.get("platform") == "android" or told.get("standardisation") == "true":
        return 1
    return -1 if (told.get("platform"), told.get("standardisation")) == ("ios", "false") else 0


def _unix_s(experiment_s: np.ndarray, texts: Mapping[str, str]) -> np.ndarray:
    """Unix times of phyphox's experiment times (N,), which stand still while it pauses."""
    rows = list(csv.DictReader(io.StringIO(texts.get(START, ""))))
    starts = [(float(r["experiment time"]), float(r["system time"])) for r in rows if r["event"] == "START"]
    if not starts:
        raise ValueError("phyphox states the time in meta/time.csv, which is not here")
    begun, unix = np.array(sorted(starts)).T
    k = np.maximum(np.searchsorted(begun, experiment_s, side="right") - 1, 0)
    return experiment_s + (unix - begun)[k]
