# SPDX-License-Identifier: Apache-2.0
"""Frames from files of a folder or a pattern, in the order of their names, or as they come into a folder."""

import fnmatch
import glob
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from starpos.errors import FrameError
from starpos.frames.exif import UNTENDED_STDDEV_S, ZONES_H, CameraClock
from starpos.frames.frame import Frame
from starpos.frames.reading import FITS, JPEG, PICTURE, RAW, read_frame
from starpos_camera.sources.source import (
    CapturedFrame,
    CaptureError,
    CaptureSettings,
    FrameSource,
    NothingYet,
    SourceEnded,
    missing,
)
from starpos_camera.sources.watched_folder import WatchedFolder
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
        "files.watch",
        False,
        "Take the frames that are written into the folder from now on, until the node stops; each "
        "name is taken once. If `cadence` is longer than the time between them, the node falls "
        "behind.",
        read_only=True,
    ),
    Parameter(
        "files.rest",
        2.0,
        "A file counts as complete if it has not changed for this time. If it cannot be read then, "
        "it is given up after ten times this time. If too short, frames that are written with "
        "pauses are lost.",
        unit="s",
        minimum=0.01,
        maximum=600.0,
        read_only=True,
    ),
    Parameter(
        "files.restamp",
        False,
        "Stamp the frames with the node's clock instead of their own time. Only for frames without "
        "a time: old frames get a wrong longitude, by 15 arcsec for each second.",
        read_only=True,
    ),
    Parameter(
        "files.exif",
        False,
        "Take the time of raw files and TIFF from EXIF, that is from the camera's own clock, which "
        "was set by hand. An error of 1 s is 464 m at the equator.",
        read_only=True,
    ),
    Parameter(
        "files.exif_utc_offset",
        math.nan,
        "Hours that the camera's clock is ahead of UTC, summer time included. Unset takes what each "
        "file states; files of older cameras state nothing. An hour wrong is 15 deg of longitude.",
        unit="h",
        minimum=-ZONES_H,
        maximum=ZONES_H,
        read_only=True,
    ),
    Parameter(
        "files.exif_clock_stddev",
        UNTENDED_STDDEV_S,
        "Error of the camera's clock, 1 sigma. That it counts whole seconds is added to it.",
        unit="s",
        minimum=0.0,
        maximum=86400.0,
        read_only=True,
    ),
)


class Files(FrameSource):
    """Plays files.path once, or again and again with files.loop (each round lists the files again), or new files.

    A file that cannot be read raises FrameError and is left out in later rounds; the next call takes the next file.
    """

    parameters = PARAMETERS

    @staticmethod
    def refusal(values: Mapping, settings: CaptureSettings) -> str | None:
        path, watch = values["files.path"], values["files.watch"]
        if not path:
            return (
                "parameter files.path must name a folder or a pattern of frames; it is empty "
                "(for a simulated sky instead set source to simulated)."
            )
        if settings.exposure_s is not None:
            return "frames from files have their own exposure: leave `exposure` unset."
        if settings.gain:
            return "frames from files have their own gain: leave `gain` unset."
        if watch and values["files.loop"]:
            return "files.watch takes frames once as they come: leave files.loop unset."
        if watch and glob.has_magic(str(Path(path).parent)):
            return (
                "files.watch looks into one folder: the pattern of files.path must be in its last part only."
            )
        if watch and (lack := _no_home(path)):
            return lack
        if values["files.exif"]:
            return missing("exifread", "exifread")
        if not math.isnan(values["files.exif_utc_offset"]):
            return "files.exif_utc_offset says how to take EXIF's times: set files.exif too."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        self.hardware_id = self._path = values["files.path"]
        self._loop = values["files.loop"]
        self._restamp = values["files.restamp"]
        self._now = now
        self._clock = camera_clock(values)
        # The files that this round has left, last first; None before the first round.
        self._queue: list[Path] | None = None
        self._bad: set[Path] = set()
        self._watched: WatchedFolder | None = None
        if values["files.watch"]:
            folder, pattern = split(self._path)
            self._watched = WatchedFolder(folder, lambda name: fits(name, pattern), values["files.rest"])
        # Without a listener the first frames of a night would be played before the detector is ready.
        self.waits_for_listener = self._watched is None

    def lacking(self) -> str | None:
        try:
            if self._watched is not None:
                folder, _ = split(self._path)
                return (
                    None if folder.is_dir() else f"{folder}: there is no such folder yet; check files.path."
                )
            if next(find_files(self._path), None) is None:
                return f"{self._path}: there are no frames here; check files.path."
        except (OSError, RuntimeError) as error:
            # There is no permission, or no home of such a user.
            return f"{self._path}: it cannot be listed ({error}); check files.path."
        return None

    def capture(self, settings: CaptureSettings) -> CapturedFrame:
        if self._watched is not None:
            return self._next_arrived(self._watched)
        if not self._queue:
            self._queue = self._next_round()
        path = self._queue.pop()
        try:
            return self._read(path)
        except Exception:
            self._bad.add(path)
            raise

    def update(self, values: Mapping) -> None:
        """Do nothing, because no parameter of this source changes at run time."""

    def close(self) -> None:
        """Do nothing, because no file is held open."""

    def _read(self, path: Path) -> CapturedFrame:
        frame = read_frame(path, self._clock)
        if not isinstance(frame, Frame):
            raise FrameError(f"{path}: it is a list of stars, not a frame; give FITS, TIFF, PNG or raw.")
        if self._restamp:
            # The exposure is taken to have just ended, so that the tilts of its time are there.
            middle_s = self._now() - (frame.exposure_s or 0.0) / 2
            frame = replace(frame, mid_unix_s=middle_s, stamp_stddev_s=0.0)
            return CapturedFrame(frame, Capture.DRIVER)
        by_camera = path.suffix.lower() in PICTURE + JPEG + RAW
        if frame.mid_unix_s is None:
            lack = frame.untimed or (
                "vouch for its camera's clock (files.exif)" if by_camera else "add DATE-OBS and EXPTIME to it"
            )
            raise FrameError(f"{path}: it does not say when it was taken: {lack}, or set files.restamp.")
        return CapturedFrame(frame, Capture.EXIF if by_camera else Capture.FILE)

    def _next_arrived(self, watched: WatchedFolder) -> CapturedFrame:
        try:
            found = watched.next()
        except OSError as error:
            reason = error.strerror or error
            raise CaptureError(f"{self._path}: it cannot be listed ({reason}); check files.path.") from None
        if found is None:
            raise NothingYet(f"waiting for frames that come into {self._path}.")
        path, last_chance = found
        try:
            exposure = self._read(path)
        except FrameError:
            if last_chance:
                watched.done(path)
                raise
            watched.try_again(path)
            raise NothingYet(f"waiting for the rest of {path}.") from None
        except Exception:
            watched.done(path)
            raise
        # Somebody may have begun to write it again.
        if not watched.at_rest(path):
            raise NothingYet(f"waiting for the rest of {path}.")
        watched.done(path)
        return exposure

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


def camera_clock(values: Mapping) -> CameraClock | None:
    """Make the clock of the camera that wrote the files' EXIF; None unless files.exif is set."""
    if not values["files.exif"]:
        return None
    offset_h = values["files.exif_utc_offset"]
    return CameraClock(None if math.isnan(offset_h) else offset_h, values["files.exif_clock_stddev"])


def _no_home(path: str) -> str | None:
    try:
        split(path)
    except RuntimeError as error:
        return f"files.path {path}: {error}; check it."
    return None


def split(path: str) -> tuple[Path, str]:
    """Split a path into the folder to watch and the pattern of names, '' for all frames."""
    place = Path(path).expanduser()
    return (place.parent, place.name) if glob.has_magic(place.name) else (place, "")


def fits(name: str, pattern: str) -> bool:
    """Whether a name belongs to a frame; hidden files are not finished, and names of other encodings cannot be shown."""
    if not name.isprintable() or name.startswith("."):
        return False
    return fnmatch.fnmatchcase(name, pattern) if pattern else name.lower().endswith(SUFFIXES)


def find_files(path: str) -> Iterator[Path]:
    """Find the frames in a folder, or all files that a pattern matches, in no order; none if there is no such place."""
    place = Path(path).expanduser()
    if place.is_dir():
        found = (file for file in place.iterdir() if fits(file.name, ""))
    else:
        found = (Path(name) for name in glob.iglob(str(place), recursive=True))
    return (file for file in found if file.is_file())
