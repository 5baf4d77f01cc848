# SPDX-License-Identifier: Apache-2.0
"""Reads a night from a folder as `starpos simulate` writes it: frames or lists of stars, tilt.csv, maybe truth.json."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starpos.detection import detect
from starpos.errors import FrameError, TiltError
from starpos.files import read_regular
from starpos.frames.night_files import SIMULATED, TILTS, TRUTH
from starpos.frames.reading import FITS, read_frame
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_doubt import like_radians
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.report.night import Truth

TRUTH_LIMIT = 1 << 26


@dataclass(frozen=True)
class StarList:
    """The stars of a frame, or the error for which there are none."""

    name: str
    stars: Stars | FrameError


@dataclass(frozen=True, kw_only=True)
class StarLists:
    """Exposures to solve: each call of `read` goes through all `count` of them, one at a time.

    tilt: a function of (mid_unix_s, exposure_s, spread_s) that may raise TiltError.  remarks: what looks wrong.
    """

    name: str
    origin: str
    count: int
    read: Callable[[], Iterator[StarList]]
    tilt: Callable[[float, float, float], Tilt]
    truth: Truth | None = None
    remarks: tuple[str, ...] = ()


def exposures(folder: Path, tilt_noise_rad: float) -> StarLists:
    """The frames of a folder in the order of their names: its FITS files, or if there are none its CSV files.

    Pictures are left out, because without a time they give no place.  If tilt.csv is missing, each frame says so.
    Raises FrameError if there are no frames, or truth.json cannot be used.
    """
    frames = frames_in(folder)
    tilt: Callable[[float, float, float], Tilt]
    doubt = ""
    try:
        log = read_tilt_csv(folder / TILTS, tilt_noise_rad)
        tilt, doubt = log.average, like_radians(log)
    except TiltError as error:
        tilt = _no_tilt(str(error))

    def read() -> Iterator[StarList]:
        for path in frames:
            try:
                item = read_frame(path)
                yield StarList(path.name, item if isinstance(item, Stars) else detect(item).stars)
            except FrameError as error:
                yield StarList(path.name, error)

    origin = f"solved from {len(frames)} {'lists of stars' if frames[0].suffix == '.csv' else 'frames'} and {TILTS}"
    return StarLists(
        name=folder.name or str(folder),
        origin=origin,
        count=len(frames),
        read=read,
        tilt=tilt,
        truth=truth_in(folder),
        remarks=(f"{TILTS}: {doubt}",) if doubt else (),
    )


def frames_in(folder: Path) -> list[Path]:
    """Paths of the frames in a folder by name, at least one; raises FrameError if there is none."""
    try:
        files = sorted(p for p in folder.iterdir() if p.is_file())
    except OSError as e:
        raise FrameError(f"{folder}: the folder cannot be read ({e.strerror})") from None
    frames = [p for p in files if p.suffix.lower() in FITS]
    frames = frames or [p for p in files if p.suffix.lower() == ".csv" and p.name != TILTS]
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


def _no_tilt(reason: str) -> Callable[[float, float, float], Tilt]:
    def tilt(mid_unix_s: float, exposure_s: float, spread_s: float) -> Tilt:
        raise TiltError(reason)

    return tilt
