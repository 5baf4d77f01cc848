# SPDX-License-Identifier: Apache-2.0
"""Reads a night from a folder as `starpos simulate` writes it: frames or lists of stars, tilt.csv, maybe truth.json."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from starpos.earth.known_place import KnownPlace
from starpos.earth.refraction import Atmosphere
from starpos.earth.vertical import Vertical
from starpos.errors import FrameError, TiltError
from starpos.files import read_regular
from starpos.frames.frame import Frame
from starpos.frames.night_files import GNSS, SIMULATED, TILTS, TRUTH
from starpos.frames.reading import FITS, read_frame
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import SCA100T_NOISE_RAD
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.instrument.tilts import NoTilts, Tilts
from starpos.night.night import Truth
from starpos.night.reading import First, Given, Reader
from starpos.night.remarks import of_tilts
from starpos.night.solving import Exposures
from starpos.night.work import Solving

TRUTH_LIMIT = 1 << 26


def exposures(
    folder: Path,
    given: Given,
    atmosphere: Atmosphere,
    vertical: Vertical,
    place: KnownPlace | None = None,
) -> Exposures:
    """The frames of a folder in the order of their names, to be solved.

    place: a known place, where each frame has a heading. If tilt.csv is missing, only headings are computed there;
    without a known place each frame reports that it is missing.

    Raises FrameError if there are no frames, or truth.json cannot be used.
    """
    frames = frames_in(folder)
    first = First(Reader())(tuple(map(str, frames)))
    instruments, remarks = (given, ()) if first is None else given.framed(first)
    known = instruments.instrument
    noise_rad = SCA100T_NOISE_RAD if known is None else known.inclinometer.noise_rad
    tilts: Tilts | None
    try:
        tilts = log = read_tilt_csv(folder / TILTS, noise_rad)
        remarks = (*of_tilts(log, TILTS), *remarks)
    except TiltError as error:
        tilts = None if place is not None and not (folder / TILTS).exists() else NoTilts(str(error))

    def each() -> Iterator[tuple[str, Frame | Stars | FrameError]]:
        for path in frames:
            try:
                yield path.name, read_frame(path)
            except FrameError as error:
                yield path.name, error

    return Exposures(
        name=folder.name or str(folder),
        origin=f"solved from {len(frames)} {'lists of stars' if frames[0].suffix == '.csv' else 'frames'} and {TILTS}",
        count=len(frames),
        each=each,
        work=Solving(instruments, atmosphere, tilts, place),
        vertical=vertical,
        truth=truth_in(folder),
        remarks=remarks,
    )


def frames_in(folder: Path) -> list[Path]:
    """Paths of the frames in a folder by name, at least one; raises FrameError without any."""
    try:
        files = sorted(p for p in folder.iterdir() if p.is_file())
    except OSError as e:
        raise FrameError(f"{folder}: the folder cannot be read ({e.strerror})") from None
    frames = [p for p in files if p.suffix.lower() in FITS]
    frames = frames or [p for p in files if p.suffix.lower() == ".csv" and p.name not in (TILTS, GNSS)]
    if not frames:
        raise FrameError(
            f"{folder}: no frames in it: a night is a folder of FITS frames, or of CSV lists of stars, and {TILTS}"
        )
    return frames


def truth_in(folder: Path) -> Truth | None:
    """The truth from truth.json (latitude_deg, longitude_deg, mid_unix_s and heading_deg of frames); None without it.

    Raises FrameError if the file cannot be read or holds something else.
    """
    path = folder / TRUTH
    if not path.is_file():
        return None
    try:
        content = json.loads(read_regular(path, TRUTH_LIMIT))
        place = [float(content[k]) for k in ("latitude_deg", "longitude_deg")]
        simulated = bool(content.get(SIMULATED))
        frames = content.get("frames", [])
        headings = tuple((float(f["mid_unix_s"]), float(np.radians(f["heading_deg"]))) for f in frames)
        if not (np.isfinite(place).all() and np.isfinite(headings).all() and abs(place[0]) <= 90):
            raise ValueError
    except OSError as e:
        raise FrameError(f"{path}: it cannot be read ({e.strerror})") from None
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise FrameError(
            f"{path}: not what is true of a night: give latitude_deg and longitude_deg, or take the file away"
        ) from None
    latitude, longitude = np.radians(place).tolist()
    return Truth(latitude, longitude, headings, simulated)
