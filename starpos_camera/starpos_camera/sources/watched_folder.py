# SPDX-License-Identifier: Apache-2.0
"""The files that come into a folder, each once, when it has come to rest. By polling: a network's disks send no events.

A look costs one stat of the folder and of the files that are being written; the folder is listed only where it has
changed, and listing takes at most a tenth of the time. Of the files that are there 8 bytes each are remembered.
"""

import os
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

TICK_S = (
    3.0  # the coarsest time stamps of folders (FAT: 2 s): what comes later in the same tick does not show
)
IDLE_S = 60.0  # a listing in spite of an unchanged folder: some network disks do not tell its time
LISTING_SHARE = 0.1  # of the time, at most
PATIENCE = 10.0  # a file that cannot be read is given up after so many times the time of rest
MOST_LOOKED_AT = 200  # files that have come, in one look; the others wait


@dataclass(frozen=True)
class NewFile:
    """A file that has come: its size (-1: not looked at) and time, since when it has had them, whether it was tried."""

    size: int
    modified_ns: int
    since_s: float
    tried: bool = False


class WatchedFolder:
    """New files of a folder. What is there at the first look is not new; a folder that comes later is new altogether.

    A name counts once; where the folder itself has gone and another is in its place (a disk that is mounted again), what
    is older than the newest file that was taken is not new.
    """

    def __init__(
        self,
        folder: Path,
        wanted: Callable[[str], bool],
        rest_s: float,
        clock: Callable[[], float] = time.monotonic,
    ):
        """wanted: whether a name is a frame's; rest_s: a file is whole once it has not changed for so long."""
        self._folder, self._wanted, self._rest_s, self._clock = folder, wanted, rest_s, clock
        self._arrivals: dict[str, NewFile] = {}
        self._known = np.zeros(0, np.int64)  # hashes of the names of the last listing
        self._is: tuple[int, int] | None = None  # the folder's device and inode
        self._modified_ns = 0  # the folder's time, and when it was seen to change
        self._changed_s = -np.inf
        self._listed_s = -np.inf
        self._listing_s = 0.0  # how long it took
        # time of the newest file that is new no more; None before the first look
        self._newest_ns: int | None = None

    def next(self) -> tuple[Path, bool] | None:
        """The oldest file at rest, and whether it is its last chance; None: there is none.

        It is to be followed by `try_again` or `done`. OSError where there is no such folder.
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
        """Whether it is as it was when `next` gave it."""
        before = self._arrivals[path.name]
        self._follow(path.name, before)
        return self._arrivals.get(path.name) == before

    def try_again(self, path: Path):
        """It could not be read: it may be still on its way."""
        if path.name in self._arrivals:
            self._arrivals[path.name] = replace(self._arrivals[path.name], tried=True)

    def done(self, path: Path):
        """It has been taken, or given up."""
        arrival = self._arrivals.pop(path.name)
        self._newest_ns = max(self._newest_ns or 0, min(arrival.modified_ns, time.time_ns()))

    def _look(self):
        """Take note of what has come, and of what of it is at rest."""
        try:
            status = os.stat(self._folder)
        except OSError:
            if self._newest_ns is None:
                self._newest_ns = 0  # all that comes is new
            self._modified_ns = 0
            raise
        now = self._clock()
        if status.st_mtime_ns != self._modified_ns:
            self._modified_ns, self._changed_s = status.st_mtime_ns, now
        settled = self._listed_s >= self._changed_s + TICK_S
        idle_s = max(IDLE_S, self._listing_s / LISTING_SHARE**2)
        if now >= self._listed_s + (idle_s if settled else self._listing_s / LISTING_SHARE):
            self._list(status)
        for name, arrival in list(self._arrivals.items())[:MOST_LOOKED_AT]:
            self._follow(name, arrival)

    def _list(self, status):
        begin = self._clock()
        names = sorted(filter(self._wanted, os.listdir(self._folder)))
        hashes = np.fromiter(map(hash, names), np.int64, len(names))
        same = self._is == (status.st_dev, status.st_ino)
        if self._newest_ns is None:
            new, self._newest_ns = [], status.st_mtime_ns
        elif same:
            new = [names[k] for k in np.flatnonzero(~np.isin(hashes, self._known))]
        else:
            new = [name for name in names if self._is_newer(name)]
        for name in new:
            self._arrivals.setdefault(name, NewFile(-1, 0, begin))
        self._known, self._is = hashes, (status.st_dev, status.st_ino)
        self._listed_s, self._listing_s = begin, self._clock() - begin

    def _is_newer(self, name):
        try:
            return os.stat(self._folder / name).st_mtime_ns > self._newest_ns
        except OSError:
            return False

    def _follow(self, name, arrival):
        """Whether it has changed since the last look; what is no file any more is forgotten."""
        try:
            status = os.stat(self._folder / name)
        except OSError:
            del self._arrivals[name]
            return
        if not stat.S_ISREG(status.st_mode):
            del self._arrivals[name]
        elif (status.st_size, status.st_mtime_ns) != (arrival.size, arrival.modified_ns):
            self._arrivals[name] = NewFile(status.st_size, status.st_mtime_ns, self._clock())
