# SPDX-License-Identifier: Apache-2.0
"""Frames from files: a folder, or all that a pattern matches, in the order of their names."""

import glob
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from starpos.errors import FrameError
from starpos.frame import Frame
from starpos.reading import FITS, PICTURE, RAW, read_frame
from starpos_camera.sources import Exposure, Settings, SourceEnded
from starpos_common.parameters import Parameter
from starpos_interfaces.msg import Capture

SUFFIXES = FITS + PICTURE + RAW
PARAMETERS = (
    Parameter(
        "files.path",
        "",
        "Folder of frames (FITS, TIFF, PNG, raw), or a pattern like /nights/1/*.fits; played by name.",
        read_only=True,
    ),
    Parameter("files.loop", False, "Begin again after the last frame.", read_only=True),
    Parameter(
        "files.restamp",
        False,
        "Stamp the frames with the node's clock instead of their own time. For frames without a time; old ones "
        "restamped give a wrong longitude, 15 arcsec for each second.",
        read_only=True,
    ),
)


class Files:
    """Plays files.path once, or round and round with files.loop; each round lists the files anew.

    A file that cannot be read raises FrameError, is passed over in later rounds, and the next call takes the
    next one.
    """

    parameters = PARAMETERS
    waits_for_listener = True  # else the first frames of a night are gone before the detector is up

    @staticmethod
    def refusal(values: Mapping, settings: Settings) -> str | None:
        if not values["files.path"]:
            return (
                "parameter files.path must name a folder or a pattern of frames; it is empty "
                "(for a simulated sky instead set source to simulated)."
            )
        if settings.exposure_s is not None:
            return "frames from files have their own exposure: leave `exposure` unset."
        if settings.gain:
            return "frames from files have their own gain: leave `gain` unset."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]):
        self.hardware_id = self._path = values["files.path"]
        self._loop = values["files.loop"]
        self._restamp = values["files.restamp"]
        self._now = now
        self._queue: list[Path] | None = None  # what this round has left, last first
        self._bad: set[Path] = set()

    def lacking(self) -> str | None:
        try:
            if next(find_files(self._path), None) is None:
                return f"{self._path}: there are no frames here; check files.path."
        except (OSError, RuntimeError) as error:  # no permission, no such user's home
            return f"{self._path}: it cannot be looked into ({error}); check files.path."
        return None

    def capture(self, settings: Settings) -> Exposure:
        if not self._queue:
            self._queue = self._next_round()
        path = self._queue.pop()
        try:
            frame = read_frame(path)
            if not isinstance(frame, Frame):
                raise FrameError(f"{path}: it is a list of stars, not a frame; give FITS, TIFF, PNG or raw.")
            if self._restamp:
                # as if the exposure had just ended: the tilts that belong to it are there
                frame = replace(frame, mid_unix_s=self._now() - (frame.exposure_s or 0.0) / 2)
                return Exposure(frame, Capture.DRIVER)
            if frame.mid_unix_s is None:
                raise FrameError(
                    f"{path}: it does not say when it was taken; add DATE-OBS and EXPTIME to it, or set "
                    "files.restamp."
                )
        except Exception:
            self._bad.add(path)
            raise
        return Exposure(frame, Capture.FILE)

    def update(self, values: Mapping):
        """Nothing of it changes at run time."""

    def close(self):
        """Nothing is held open."""

    def _next_round(self) -> list[Path]:
        if self._queue is not None and not self._loop:
            raise SourceEnded(f"all frames of {self._path} are played.")
        if lack := self.lacking():
            raise FrameError(lack)
        files = sorted(find_files(self._path))
        good = [file for file in files if file not in self._bad]
        if not good:
            raise FrameError(f"{self._path}: none of its {len(files)} files is a frame; give others.")
        return good[::-1]


def find_files(path: str) -> Iterator[Path]:
    """The frames in a folder, or whatever files a pattern matches, in no order; none where there is no such place."""
    place = Path(path).expanduser()
    if place.is_dir():
        found = (file for file in place.iterdir() if file.suffix.lower() in SUFFIXES)
    else:
        found = (Path(name) for name in glob.iglob(str(place), recursive=True))
    return (file for file in found if file.is_file())
