# SPDX-License-Identifier: Apache-2.0
"""The work of `detect`, `identify` and `solve` on one frame, as small objects that can go to any process or machine.

Each is called with the path of a frame and returns its answer; it raises FrameError if the frame is at fault.
"""

import argparse
import math
import os
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from starpos.cli.options import clock_of
from starpos.earth.refraction import Atmosphere
from starpos.errors import FrameError, StarposError
from starpos.fix.again import PART, identified_otherwise
from starpos.fix.blind import BlindSolver
from starpos.fix.pointing import IDEAL
from starpos.fix.solution import Solution, Status
from starpos.fix.solver import Solver
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Frame
from starpos.frames.reading import read_frame
from starpos.frames.stars import Stars
from starpos.identification.blind import STAGES
from starpos.instrument.instrument import Instrument
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.sky import catalogue

# of the search at every scale, for stars that are detected otherwise
QUICK = STAGES[:2]

if TYPE_CHECKING:
    from starpos.detection import Detection
    from starpos.detection.second_look import SecondLook


@dataclass(frozen=True)
class Reader:
    """Reads frames, and keeps one that will be asked for again, in its own process only.

    delay_s: how much later than its header says a frame was exposed, and the standard deviation of that.
    """

    clock: CameraClock | None = None
    delay_s: tuple[float, float] = (0.0, 0.0)
    _kept: dict = field(default_factory=dict, compare=False)

    def __call__(self, path: str) -> Frame | Stars:
        if path in self._kept:
            return self._kept.pop(path)
        item = read_frame(path, self.clock)
        if item.mid_unix_s is None:
            return item
        late_s, stddev_s = self.delay_s
        stamp_s = math.hypot(item.stamp_stddev_s, stddev_s)
        return replace(item, mid_unix_s=item.mid_unix_s + late_s, stamp_stddev_s=stamp_s)

    def keep(self, path: str, item: Frame | Stars) -> None:
        """Keep a frame for the next call with its path."""
        self._kept.clear()
        self._kept[path] = item

    def __reduce__(self) -> tuple[type["Reader"], tuple[CameraClock | None, tuple[float, float]]]:
        return Reader, (self.clock, self.delay_s)


def reader_of(args: argparse.Namespace) -> Reader:
    """The reader of frames with the clock and the delay of their shutter that the options give."""
    return Reader(clock_of(args), tuple(args.shutter_delay or (0.0, 0.0)))


@dataclass(frozen=True)
class About:
    """Frame size, focal length and place on the sensor in px, as the first frame of a night states them."""

    width: int
    height: int
    focal_px: float | None
    origin_px: tuple[float, float] | None = None


# of pointings only the camera's axes count
NO_CAMERA = About(IDEAL.width, IDEAL.height, IDEAL.fx)


@dataclass(frozen=True)
class Look:
    """Finds the About of the first of several frames that can be read; None if none can."""

    read: Reader

    def __call__(self, paths: tuple[str, ...]) -> About | None:
        for path in paths:
            with suppress(FrameError):
                item = self.read(path)
                self.read.keep(path, item)
                return About(item.width, item.height, item.focal_px, item.origin_px)
        return None


def stars_of(item: Frame | Stars) -> Stars:
    """The stars of a list, or those detected on a frame."""
    if isinstance(item, Stars):
        return item
    from starpos.detection.negative import detect_dark_too

    return detect_dark_too(item).stars


def look_at(item: Frame | Stars, stars: Stars) -> "SecondLook | None":
    """A second look at the frame of the stars; None for a list."""
    if isinstance(item, Stars):
        return None
    from starpos.detection.negative import negative_of
    from starpos.detection.second_look import SecondLook

    return SecondLook.of(negative_of(item) if stars.negative else item, stars)


@dataclass(frozen=True)
class Listing:
    """Gives the stars of a frame."""

    read: Reader

    def __call__(self, path: str) -> Stars:
        return stars_of(self.read(path))


@dataclass(frozen=True)
class Detecting:
    """Work of `detect`: the Detection of a frame, or the Stars of a list, and the CPU time in ms."""

    read: Reader

    def __call__(self, path: str) -> tuple["Detection | Stars", float]:
        from starpos.detection.negative import detect_dark_too

        item = self.read(path)
        begin = time.process_time()
        found = item if isinstance(item, Stars) else detect_dark_too(item)
        return found, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Identifying:
    """Work of `identify`: the Solution of a frame, and the CPU time in ms."""

    read: Reader
    instrument: Instrument

    def __call__(self, path: str) -> tuple[Solution, float]:
        item = self.read(path)
        solver = Solver(self.instrument, catalogue.load_catalogue())
        # `identify` reports the error
        with suppress(StarposError):
            solver.prepare(item.width, item.height)
        begin = time.process_time()
        stars = stars_of(item)

        def identified(stars: Stars) -> Solution:
            answer = solver.identify(stars, look=look_at(item, stars))
            # of a list, points of chance are given up soon
            if answer.status is not Status.NOT_IDENTIFIED or isinstance(item, Stars):
                return answer
            part = solver.identify(stars, look=look_at(item, stars), part=PART)
            return part if part.ok else answer

        answer = identified_otherwise(item, stars, identified(stars), identified)
        return answer, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class IdentifyingBlind:
    """Work of `identify` without a focal length, or with a rough one of EXIF: the Solution, and the CPU time in ms."""

    read: Reader

    def __call__(self, path: str) -> tuple[Solution, float]:
        item = self.read(path)
        solver = BlindSolver(catalogue.load_catalogue())
        solver.prepare()
        begin = time.process_time()
        stars = stars_of(item)
        answer = solver.identify(stars)
        answer = identified_otherwise(item, stars, answer, replace(solver, stages=QUICK).identify)
        return answer, 1000 * (time.process_time() - begin)


@dataclass(frozen=True)
class Solving:
    """Work of `solve`: the Solution of a frame.

    tilt: absolute path of the table; None for a camera that is fixed to the ground.
    """

    read: Reader
    instrument: Instrument
    atmosphere: Atmosphere
    tilt: str | None

    @property
    def files(self) -> tuple[str, ...]:
        """Files that it reads besides the frame."""
        return () if self.tilt is None else (self.tilt,)

    def __call__(self, path: str) -> Solution:
        stars = stars_of(self.read(path))
        solver = Solver(self.instrument, catalogue.load_catalogue(), self.atmosphere)
        if self.tilt is None:
            return solver.solve(stars)
        return solver.solve(stars, tilts(self.tilt, self.instrument.inclinometer.noise_rad).average)


def tilts(path: str, noise_rad: float) -> TiltLog:
    """The table of tilts, read again only if the file has changed; raises TiltError as `read_tilt_csv` does."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return read_tilt_csv(path, noise_rad)
    return _tilts(Path(path), noise_rad, (status.st_mtime_ns, status.st_size))


@lru_cache(maxsize=4)
def _tilts(path: Path, noise_rad: float, _time_and_size: tuple[int, int]) -> TiltLog:
    return read_tilt_csv(path, noise_rad)
