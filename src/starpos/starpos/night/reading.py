# SPDX-License-Identifier: Apache-2.0
"""Reads what a night consists of: frames and their stars, the table of tilts, the instrument of each frame."""

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from starpos.errors import FrameError
from starpos.fix.fix import IDEAL
from starpos.frames.exif import CameraClock
from starpos.frames.frame import Frame, Stars, no_stars
from starpos.frames.reading import read_frame
from starpos.instrument.camera import Camera
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.instrument import Instrument, with_frame_size
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilt_table import read_tilt_csv
from starpos.parallel.processes import in_turn

# the names of frames, and what a work made of each, or why it cannot be read
Worked = Iterator[tuple[str, Any]]
# goes through all frames with a work
Each = Callable[[Callable[[Frame | Stars], Any]], Worked]


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

    def first(self, paths: Sequence[str], levelled: bool = False) -> Stars | None:
        """The star list of the first frame which can be read, without its stars; None if none can be read.

        levelled: rather of the first one that has gravity.
        """
        first = None
        for path in paths:
            with suppress(FrameError):
                item = self(path)
                self._kept.clear()
                self._kept[path] = item
                about = no_stars(item.width, item.height, **item.facts)
                if not levelled or item.gravity is not None:
                    return about
                first = first or about
        return first

    def one_of(self, paths: Sequence[str]) -> Stars:
        """The star list as by `first`; raises the FrameError of the first path if none can be read."""
        about = self.first(paths)
        if about is None:
            self(paths[0])
        assert about is not None
        return about

    def on(self, work: Callable[[Frame | Stars], Any], path: str) -> Any:
        """What a work makes of the frame or list in a file."""
        return work(self(path))

    def each(self, paths: Sequence[str]) -> Each:
        """Go through files, one after the other."""
        return lambda work: zip(paths, in_turn((partial(self.on, work), p) for p in paths), strict=True)

    def __reduce__(self) -> tuple[type["Reader"], tuple[CameraClock | None, tuple[float, float]]]:
        return Reader, (self.clock, self.delay_s)


def stars_of(item: Frame | Stars) -> Stars:
    """The stars of a list, or those detected on a frame."""
    if isinstance(item, Stars):
        return item
    from starpos.detection.second_look import detect_dark_too

    return detect_dark_too(item).stars


# for pointings only the camera's axes count
NO_CAMERA = no_stars(IDEAL.width, IDEAL.height, focal_px=IDEAL.fx)


@dataclass(frozen=True)
class Instruments:
    """The instrument of each frame of a night.

    instrument: with all frames' A3 and inclinometer; None if nothing is known.
    by_header: whether each frame's own header has its focal length, if it states one.
    cameras: of a bag, by (width, height) of their frames in px.
    any_size: whether frames of other sizes than the cameras' are the instrument's too.
    sought: whether nothing states the focal length; until the stars give it, `instrument` has a stand-in.
    """

    instrument: Instrument | None
    by_header: bool = False
    cameras: Mapping[tuple[int, int], Camera] = field(default_factory=dict)
    any_size: bool = True
    sought: bool = False

    def framed(self, first: Frame | Stars) -> tuple["Instruments", str]:
        """Instruments of a night with this first frame, and a remark if the axis of its frames is not known, else ''."""
        # a lens that is sought may be another one in each frame
        if self.instrument is None or self.sought:
            return self, ""
        instrument, doubt = with_frame_size(self.instrument, first)
        return replace(self, instrument=instrument), doubt

    def of(self, frame: Frame | Stars) -> Instrument | None:
        """The instrument of a frame; None if its focal length is unknown."""
        camera = self.cameras.get((frame.width, frame.height))
        if camera is not None and self.instrument is not None:
            return replace(self.instrument, camera=camera, focal_px=camera.fx)
        if not self.any_size or (self.sought and frame.focal_px is None):
            return None
        if not self.by_header or frame.focal_px is None:
            return self.instrument
        if self.instrument is None:
            return Instrument(frame.focal_px)
        return replace(self.instrument, focal_px=frame.focal_px)


@dataclass(frozen=True)
class TiltFile:
    """The table of tilts in a file, as `Tilts`, which any process or machine reads for itself; path: absolute."""

    path: str
    noise_rad: float

    @property
    def log(self) -> TiltLog:
        """The readings, read again only if the file has changed; raises TiltError as `read_tilt_csv` does."""
        try:
            status = os.stat(self.path)
        except (OSError, ValueError):
            return read_tilt_csv(self.path, self.noise_rad)
        return _log(Path(self.path), self.noise_rad, (status.st_mtime_ns, status.st_size))

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Average over an exposure, as `TiltLog.average` does."""
        return self.log.average(mid_unix_s, exposure_s, spread_s)


@lru_cache(maxsize=4)
def _log(path: Path, noise_rad: float, _time_and_size: tuple[int, int]) -> TiltLog:
    return read_tilt_csv(path, noise_rad)
