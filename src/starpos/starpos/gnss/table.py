# SPDX-License-Identifier: Apache-2.0
"""The table of a GNSS receiver: a CSV with a row a fix."""

import csv
import io
import math
from collections import Counter
from pathlib import Path

import numpy as np

from starpos.errors import GnssError, one_line
from starpos.files import read_regular
from starpos.gnss.place import GnssPlace, checked
from starpos.gnss.track import GnssTrack

NEEDED = ("utc_unix_s", "latitude", "longitude", "sigma_east_m", "sigma_north_m")
COLUMNS = ("utc_unix_s", "latitude", "longitude", "altitude_m", "sigma_east_m", "sigma_north_m", "status")
# a month of 1 Hz
MAX_BYTES = 300_000_000
CURE = f"give a CSV with a line of names, {','.join(COLUMNS)}, and a row a fix, deg on WGS 84"


def read_gnss_csv(path: Path | str) -> tuple[GnssTrack, tuple[str, ...]]:
    """Read the fixes of a receiver, and a sentence for each kind of row that was left out; GnssError if it cannot be.

    Columns: utc_unix_s, latitude, longitude in deg on WGS 84, sigma_east_m, sigma_north_m; status as NavSatStatus's (0 if
    there is no such column).  Cells may be empty.  Rows may come in any order.
    """
    try:
        text = read_regular(path, MAX_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise GnssError(f"{path}: there is no such file: {CURE}") from None
    except (OSError, UnicodeDecodeError) as e:
        reason = getattr(e, "strerror", None) or one_line(e)
        raise GnssError(f"{path}: not a readable table of GNSS ({reason}): {CURE}") from None
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    names = [name.strip().lstrip("# ") for name in reader.fieldnames or ()]
    reader.fieldnames = names
    lacking = [name for name in NEEDED if names.count(name) != 1]
    if lacking:
        raise GnssError(
            f"{path}: not a readable table of GNSS (it has no column {lacking[0]}, or two): {CURE}"
        )
    places: list[GnssPlace] = []
    faults: Counter[str] = Counter()
    try:
        for row in reader:
            try:
                places.append(_place(row))
            except GnssError as error:
                faults[str(error)] += 1
    except csv.Error as e:
        raise GnssError(f"{path}: not a readable table of GNSS ({one_line(e)}): {CURE}") from None
    track = GnssTrack(places)
    if len(track) < len(places):
        faults["places of one moment contradict each other: give the fixes of one receiver"] += len(
            places
        ) - len(track)
    return track, tuple(f"{path}: {number} rows left out: {why}" for why, number in faults.most_common())


def _place(row: dict[str, str]) -> GnssPlace:
    t, latitude, longitude, east, north = (_number(row.get(name)) for name in NEEDED)
    status = _number(row.get("status", "0"))
    covariance = np.diag(np.square([east, north])) if min(east, north) > 0 else np.full((2, 2), np.nan)
    return checked(t, latitude, longitude, covariance, status)


def _number(cell: str | None) -> float:
    try:
        return float(cell or "nan")
    except (TypeError, ValueError):
        return math.nan
