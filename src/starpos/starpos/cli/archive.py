# SPDX-License-Identifier: Apache-2.0
"""The input of `solve`: one night's frames with a table of tilts, or an archive with a folder per night."""

import os
from dataclasses import dataclass
from pathlib import Path

from starpos.errors import FrameError, TiltError
from starpos.frames.night_files import TILTS, TRUTH


@dataclass(frozen=True)
class NightFolder:
    """Frames with one table of tilts that make one fix together.

    tilt: absolute path; None where none is needed.  folder: None if the frames were named one by one.
    """

    frames: tuple[str, ...]
    tilt: str | None
    folder: str | None = None


def frames_among(given: list[str], *tables: str | None) -> list[str]:
    """The frames among files that a shell's *.csv, or *, has taken in: without tables, tilt.csv and truth.json.

    Other files stay, and each one reports why it is not a frame.
    """
    beside = {os.path.realpath(table) for table in tables if table is not None}
    frames = [
        p for p in given if os.path.basename(p) not in (TILTS, TRUTH) and os.path.realpath(p) not in beside
    ]
    return frames or given


def nights_of(
    given: list[str], tilt: str | None, needs_no_tilt: bool = False
) -> list[NightFolder | FrameError]:
    """One night from frames and a table, or without one for a camera fixed to the ground or at a known place.

    Else a night for each folder, or its error.

    A folder's frames are its FITS files, or without FITS files its CSV files, in the order of their names.
    Raises FrameError for a path that does not exist, TiltError for frames without a table.
    """
    if tilt is not None:
        return [NightFolder(tuple(given), os.path.abspath(tilt))]
    if needs_no_tilt:
        return [NightFolder(tuple(given), None)]
    if missing := next((path for path in given if not os.path.exists(path)), None):
        raise FrameError(f"{missing}: there is no such file or folder")
    if single := next((path for path in given if not os.path.isdir(path)), None):
        raise TiltError(
            f"{single}: no tilts: give --tilt with frames, or nights alone: folders of frames, each with its tilt.csv"
        )
    return [_night(folder) for folder in given]


def _night(folder: str) -> NightFolder | FrameError:
    from starpos.night.folder import frames_in

    try:
        frames = tuple(map(str, frames_in(Path(folder))))
    except FrameError as error:
        return error
    return NightFolder(frames, os.path.abspath(os.path.join(folder, TILTS)), folder)
