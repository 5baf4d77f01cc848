# SPDX-License-Identifier: Apache-2.0
"""What `detect`, `identify` and `solve` do with one frame: work that goes to any process or machine, for it is small.

Each takes a frame's path and gives its answer, or the FrameError that is the frame's own.
"""

import os
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.cli.common import stars_of
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError, StarposError
from starpos.fix.solver import Solution, Solver
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import TiltLog, read_tilt_csv
from starpos.instrument.instrument import Instrument
from starpos.sky import catalogue

if TYPE_CHECKING:
    from starpos.detection import Detection


@dataclass(frozen=True)
class Reader:
    """`read_frame`, which keeps one frame that is going to be asked for again: in its own process only."""

    clock: CameraClock | None = None
    _kept: dict = field(default_factory=dict, compare=False)

    def __call__(self, path: str) -> Frame | Stars:
        return self._kept.pop(path) if path in self._kept else read_frame(path, self.clock)

    def keep(self, path: str, item: Frame | Stars) -> None:
        self._kept.clear()
        self._kept[path] = item

    def __reduce__(self):
        return Reader, (self.clock,)


@dataclass(frozen=True)
class About:
    """What a night's first frame says of the instrument."""

    width: int
    height: int
    focal_px: float | None


@dataclass(frozen=True)
class Look:
    """About the first of several frames that can be read; None where none can."""

    read: Reader

    def __call__(self, paths: tuple[str, ...]) -> About | None:
        for path in paths:
            with suppress(FrameError):
                item = self.read(path)
                self.read.keep(path, item)
                return About(item.width, item.height, item.focal_px)
        return None


@dataclass(frozen=True)
class Listing:
    """The stars of a frame."""

    read: Reader

    def __call__(self, path: str) -> Stars:
        return stars_of(self.read(path))


@dataclass(frozen=True)
class Detecting:
    """(Detection, or the Stars of a list, cpu_ms) of `detect`."""

    read: Reader

    def __call__(self, path: str) -> tuple["Detection | Stars", float]:
        from starpos.detection import detect

        item = self.read(path)
        begin = time.process_time()
        found = item if isinstance(item, Stars) else detect(item)
        return found, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Identifying:
    """(Solution, cpu_ms) of `identify`."""

    read: Reader
    instrument: Instrument

    def __call__(self, path: str) -> tuple[Solution, float]:
        item = self.read(path)
        solver = Solver(self.instrument, catalogue.load_catalogue())
        with suppress(StarposError):  # identify says it
            solver.prepare(item.width, item.height)
        begin = time.process_time()
        answer = solver.identify(stars_of(item))
        return answer, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Solving:
    """The Solution of a frame with a table of tilts."""

    read: Reader
    instrument: Instrument
    atmosphere: Atmosphere
    tilt: str  # absolute

    @property
    def files(self) -> tuple[str, ...]:
        """What it reads besides the frame."""
        return (self.tilt,)

    def __call__(self, path: str) -> Solution:
        stars = stars_of(self.read(path))
        solver = Solver(self.instrument, catalogue.load_catalogue(), self.atmosphere)
        return solver.solve(stars, tilts(self.tilt, self.instrument.inclinometer.noise_rad).average)


def tilts(path: str, noise_rad: float) -> TiltLog:
    """The table as it is now, read once; TiltError as `read_tilt_csv` has it."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return read_tilt_csv(path, noise_rad)
    return _tilts(Path(path), noise_rad, (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=4)
def _tilts(path: Path, noise_rad: float, _of: tuple[int, int]) -> TiltLog:
    return read_tilt_csv(path, noise_rad)
