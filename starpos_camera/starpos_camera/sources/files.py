# SPDX-License-Identifier: Apache-2.0
"""Frames from files of a folder or a pattern, in the order of their names, or as they come into a folder."""

import fnmatch
import glob
import math
import os
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starpos.errors import FrameError
from starpos.frames.exif import CameraClock
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
from starpos_interfaces.msg import Capture

# Largest share of the time for listing.
LISTING_SHARE = 0.1
# A file that cannot be read is given up after this multiple of the time of rest.
PATIENCE = 10.0
# Most new files in one look; the others wait.
MAX_LOOKED_AT = 200


@dataclass(frozen=True)
class NewFile:
    """A new file: its size (-1: not looked at yet) and time, since when both are unchanged, whether reading was tried."""

    size: int
    modified_ns: int
    since_s: float
    tried: bool = False


class WatchedFolder:
    """Finds the new files of a folder, each once, when it is complete; what is there at the first look is not new.

    The folder is polled: network disks send no events, and some do not update a folder's time. Listing takes at most a
    tenth of the time. For each file in the folder 8 bytes are kept.

    If the folder itself comes later, all its files are new. A name counts once. If another folder takes its place (a
    disk is mounted again), only files newer than the newest one taken so far are new.
    """

    def __init__(
        self,
        folder: Path,
        wanted: Callable[[str], bool],
        rest_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Watch a folder; wanted: whether a name is a frame's; rest_s: a file unchanged for so long is complete."""
        self._folder, self._wanted, self._rest_s, self._clock = folder, wanted, rest_s, clock
        self._arrivals: dict[str, NewFile] = {}
        # Hashes of the names of the last listing.
        self._known: np.ndarray = np.zeros(0, np.int64)
        # The folder's device and inode.
        self._is: tuple[int, int] | None = None
        # When the folder was listed last, and how long that took.
        self._listed_s = -np.inf
        self._listing_s = 0.0
        # Time of the newest file that is not new any more; None before the first look.
        self._newest_ns: int | None = None

    def next(self) -> tuple[Path, bool] | None:
        """Return the oldest complete file, and whether this is its last chance; None without one.

        Call `try_again` or `done` afterwards. Raises OSError if there is no such folder.
        """
        self._look()
        now = self._clock()
        ready = [
            (arrival.modified_ns, name, arrival.tried)
            for name, arrival in self._arrivals.items()
            if arrival.size >= 0
            and now - arrival.since_s >= self._rest_s * (PATIENCE if arrival.tried else 1)
        ]
        if not ready:
            return None
        _, name, tried = min(ready)
        return self._folder / name, tried

    def at_rest(self, path: Path) -> bool:
        """Whether a file is unchanged since `next` returned it."""
        before = self._arrivals[path.name]
        self._follow(path.name, before)
        return self._arrivals.get(path.name) == before

    def try_again(self, path: Path) -> None:
        """Note that a file could not be read: it may be incomplete."""
        if path.name in self._arrivals:
            self._arrivals[path.name] = replace(self._arrivals[path.name], tried=True)

    def done(self, path: Path) -> None:
        """Note that a file has been taken, or given up."""
        arrival = self._arrivals.pop(path.name)
        self._newest_ns = max(self._newest_ns or 0, min(arrival.modified_ns, time.time_ns()))

    def _look(self) -> None:
        """Look for new files, and for changes of those that are known."""
        try:
            status = os.stat(self._folder)
        except OSError:
            if self._newest_ns is None:
                # All files that come are new.
                self._newest_ns = 0
            raise
        if self._clock() >= self._listed_s + self._listing_s / LISTING_SHARE:
            self._list(status)
        for name, arrival in list(self._arrivals.items())[:MAX_LOOKED_AT]:
            self._follow(name, arrival)

    def _list(self, status: os.stat_result) -> None:
        begin = self._clock()
        names = sorted(filter(self._wanted, os.listdir(self._folder)))
        hashes = np.fromiter(map(hash, names), np.int64, len(names))
        same = self._is == (status.st_dev, status.st_ino)
        newest_ns = self._newest_ns
        new: list[str] = []
        if newest_ns is None:
            self._newest_ns = status.st_mtime_ns
        elif same:
            new = [names[k] for k in np.flatnonzero(~np.isin(hashes, self._known))]
        else:
            new = [name for name in names if self._is_newer(name, newest_ns)]
        for name in new:
            self._arrivals.setdefault(name, NewFile(-1, 0, begin))
        self._known, self._is = hashes, (status.st_dev, status.st_ino)
        self._listed_s, self._listing_s = begin, self._clock() - begin

    def _is_newer(self, name: str, than_ns: int) -> bool:
        try:
            return os.stat(self._folder / name).st_mtime_ns > than_ns
        except OSError:
            return False

    def _follow(self, name: str, arrival: NewFile) -> None:
        """Note changes of a file since the last look; forget it if it is no file any more."""
        try:
            status = os.stat(self._folder / name)
        except OSError:
            del self._arrivals[name]
            return
        if not stat.S_ISREG(status.st_mode):
            del self._arrivals[name]
        elif (status.st_size, status.st_mtime_ns) != (arrival.size, arrival.modified_ns):
            self._arrivals[name] = NewFile(status.st_size, status.st_mtime_ns, self._clock())


SUFFIXES = FITS + PICTURE + RAW


class Files(FrameSource):
    """Plays files.path once, or again and again with files.loop (each round lists the files again), or new files.

    A file that cannot be read raises FrameError and is left out in later rounds; the next call takes the next file.
    """

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
        if values["files.exif"]:
            return missing("exifread", "exifread")
        if not math.isnan(values["files.exif_utc_offset"]):
            return "files.exif_utc_offset says how to take EXIF's times: set files.exif too."
        return None

    def __init__(self, values: Mapping, now: Callable[[], float]) -> None:
        super().__init__(values, now)
        self.hardware_id = self._path = values["files.path"]
        # Of the camera that wrote the files' EXIF; None: it is not believed.
        self._clock: CameraClock | None = None
        if values["files.exif"]:
            offset_h = values["files.exif_utc_offset"]
            known_h = None if math.isnan(offset_h) else offset_h
            self._clock = CameraClock(known_h, values["files.exif_clock_stddev"])
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
        except OSError as error:
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

    def _read(self, path: Path) -> CapturedFrame:
        frame = read_frame(path, self._clock)
        if not isinstance(frame, Frame):
            raise FrameError(f"{path}: it is a list of stars, not a frame; give FITS, TIFF, PNG or raw.")
        if self._values["files.restamp"]:
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
        if self._queue is not None and not self._values["files.loop"]:
            raise SourceEnded(f"all frames of {self._path} are played.")
        if lack := self.lacking():
            raise FrameError(lack)
        files = sorted(find_files(self._path))
        good = [file for file in files if file not in self._bad]
        if not good:
            raise FrameError(f"{self._path}: none of its {len(files)} files is a frame; give others.")
        return good[::-1]


def split(path: str) -> tuple[Path, str]:
    """Split a path into the folder to watch and the pattern of names, '' for all frames."""
    place = Path(os.path.expanduser(path))
    return (place.parent, place.name) if glob.has_magic(place.name) else (place, "")


def fits(name: str, pattern: str) -> bool:
    """Whether a name belongs to a frame; hidden files are not finished, and names of other encodings cannot be shown."""
    if not name.isprintable() or name.startswith("."):
        return False
    return fnmatch.fnmatchcase(name, pattern) if pattern else name.lower().endswith(SUFFIXES)


def find_files(path: str) -> Iterator[Path]:
    """Find the frames in a folder, or all files that a pattern matches, in no order; none if there is no such place."""
    place = Path(os.path.expanduser(path))
    if place.is_dir():
        found = (file for file in place.iterdir() if fits(file.name, ""))
    else:
        found = (Path(name) for name in glob.iglob(str(place), recursive=True))
    return (file for file in found if file.is_file())
