# SPDX-License-Identifier: Apache-2.0
"""The input of `solve`: the frames of one night with their table of tilts, or an archive with a folder per night."""

import os
from dataclasses import dataclass
from pathlib import Path

from starpos.errors import FrameError, TiltError
from starpos.frames.night_files import TILTS, TRUTH
from starpos.report.folder import frames_in


@dataclass(frozen=True)
class NightFolder:
    """Frames with one table of tilts that make one fix together.

    tilt: absolute path; None for a camera that is fixed to the ground.  folder: None if the frames were named one by one.
    """

    frames: tuple[str, ...]
    tilt: str | None
    folder: str | None = None


def nights_of(given: list[str], tilt: str | None, own_level: bool = False) -> list[NightFolder | FrameError]:
    """One night from frames and a table, or without one for a camera that is fixed to the ground.

    Else a night for each folder, or the error why it is none. What lies beside frames and is none, as a shell's *.csv
    takes it in, is left out: the table of tilts and truth.json.

    A folder's frames are its FITS files, or if there are none its CSV files, in the order of their names.
    Raises FrameError for a path that does not exist, TiltError for frames without a table.
    """
    if tilt is not None:
        table = os.path.realpath(tilt)
        frames = [p for p in given if os.path.realpath(p) != table and os.path.basename(p) != TRUTH]
        return [NightFolder(tuple(frames or given), os.path.abspath(tilt))]
    if own_level:
        return [NightFolder(tuple(given), None)]
    if missing := next((path for path in given if not os.path.exists(path)), None):
        raise FrameError(f"{missing}: there is no such file or folder")
    if single := next((path for path in given if not os.path.isdir(path)), None):
        raise TiltError(
            f"{single}: no tilts: give --tilt with frames, or nights alone: folders of frames, each with its tilt.csv"
        )
    return [_night(folder) for folder in given]


def _night(folder: str) -> NightFolder | FrameError:
    try:
        frames = tuple(map(str, frames_in(Path(folder))))
    except FrameError as error:
        return error
    return NightFolder(frames, os.path.abspath(os.path.join(folder, TILTS)), folder)
