# SPDX-License-Identifier: Apache-2.0
"""New files of a folder, each once, when it is complete. The folder is polled: network disks send no events.

A look costs one stat of the folder and of each file that is being written. The folder is listed only if it has changed,
and listing takes at most a tenth of the time. For each file in the folder 8 bytes are kept.
"""

import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

# More than the coarsest time stamps of folders (FAT: 2 s): a second change within the same tick does not show.
TICK_S = 3.0
# Interval at which the folder is listed even if it seems unchanged: some network disks do not update its time.
IDLE_S = 60.0
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
    """Finds the new files of a folder. Files that are there at the first look are not new.

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
        # The folder's time, and when it was seen to change.
        self._modified_ns = 0
        self._changed_s = -np.inf
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
            self._modified_ns = 0
            raise
        now = self._clock()
        if status.st_mtime_ns != self._modified_ns:
            self._modified_ns, self._changed_s = status.st_mtime_ns, now
        settled = self._listed_s >= self._changed_s + TICK_S
        idle_s = max(IDLE_S, self._listing_s / LISTING_SHARE**2)
        if now >= self._listed_s + (idle_s if settled else self._listing_s / LISTING_SHARE):
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
