# SPDX-License-Identifier: Apache-2.0
"""What `solve` is given: the frames of one night with their table of tilts, or an archive, a folder a night."""

import os
from dataclasses import dataclass
from pathlib import Path

from starpos.errors import FrameError, TiltError


@dataclass(frozen=True)
class NightFolder:
    """Frames that share one table of tilts, and make one fix together; folder: None where they were named one by one."""

    frames: tuple[str, ...]
    tilt: str  # absolute
    folder: str | None = None


def nights_of(given: list[str], tilt: str | None) -> list[NightFolder | FrameError]:
    """One night of frames and a table; without a table, a night of each folder, or why it is none.

    FITS where there are any, else CSV, by name: as `report` takes a folder.  FrameError for what is not there,
    TiltError for frames without a table.
    """
    if tilt is not None:
        return [NightFolder(tuple(given), os.path.abspath(tilt))]
    if missing := next((path for path in given if not os.path.exists(path)), None):
        raise FrameError(f"{missing}: there is no such file or folder")
    if single := next((path for path in given if not os.path.isdir(path)), None):
        raise TiltError(
            f"{single}: no tilts: give --tilt with frames, or nights alone: folders of frames, each with its tilt.csv"
        )
    return [_night(folder) for folder in given]


def _night(folder: str) -> NightFolder | FrameError:
    from starpos.report.folder import TILTS, frames_in

    try:
        frames = tuple(map(str, frames_in(Path(folder))))
    except FrameError as error:
        return error
    return NightFolder(frames, os.path.abspath(os.path.join(folder, TILTS)), folder)
