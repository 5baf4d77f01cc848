# SPDX-License-Identifier: Apache-2.0
"""What frames leave behind for a calibration: the newest of them, and one for each pose; bounded for good."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from starpos.averaging.slip import slip_s
from starpos.errors import TiltError
from starpos.fix.fix import Fix
from starpos.frames.stars import Stars
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog

MOST_POSES = 36
MOST_TILTS = 64  # of a pose, the newest


@dataclass(frozen=True)
class Seen:
    """The stars of a frame, which have a time, with the tilt."""

    stars: Stars
    tilt: Tilt


class RecentFrames:
    """The newest frames with stars and a tilt."""

    def __init__(self, most: int):
        self._frames: deque[Seen] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, seen: Seen) -> None:
        if len(seen.stars):
            self._frames.append(seen)

    def keep(self, most: int) -> None:
        """From now on so many; of those here the newest stay."""
        self._frames = deque(self._frames, maxlen=most)

    def newest(self, count: int) -> list[Seen]:
        """In the order they came; fewer where there are fewer."""
        return list(self._frames)[max(0, len(self._frames) - count) :]

    def clear(self) -> None:
        self._frames.clear()


@dataclass
class _Pose:
    """A camera that stands still against the Earth since `first`."""

    first: Fix
    newest: Seen
    frames: int = 0
    tilts: deque[Tilt] = field(default_factory=lambda: deque(maxlen=MOST_TILTS))

    def add(self, seen: Seen) -> None:
        self.newest = seen
        self.frames += 1
        self.tilts.append(seen.tilt)


class PoseMemory:
    """The stars of the last frame of each pose, with the mean tilt of its frames; the oldest pose goes."""

    def __init__(self):
        self._poses: deque[_Pose] = deque(maxlen=MOST_POSES)

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, seen: Seen, fix: Fix) -> bool:
        """One more frame; whether this is worth a look at all of them: a new pose, or one with twice the frames."""
        if not self._poses or slip_s(fix, self._poses[-1].first) != 0:
            self._poses.append(_Pose(fix, seen))
        pose = self._poses[-1]
        pose.add(seen)
        return pose.frames & (pose.frames - 1) == 0

    def frames(self) -> list[Seen]:
        """One for each pose whose tilts agree, the oldest first."""
        made = []
        for pose in self._poses:
            try:
                made.append(replace(pose.newest, tilt=mean_tilt(pose.tilts)))
            except TiltError:  # two that contradict each other: nobody knows which is right
                continue
        return made

    def forget_before(self, utc_unix_s: float) -> None:
        """The instrument has moved then."""
        while self._poses and self._poses[0].newest.stars.mid_unix_s < utc_unix_s:
            self._poses.popleft()

    def clear(self) -> None:
        self._poses.clear()


def mean_tilt(tilts: Sequence[Tilt]) -> Tilt:
    """Of an instrument at rest; one far from the others is left out.  TiltError where they contradict each other."""
    times = np.array([t.utc_unix_s for t in tilts])
    log = TiltLog(
        times,
        np.array([t.theta_x for t in tilts]),
        np.array([t.theta_y for t in tilts]),
        np.array([t.temperature_c for t in tilts]),
        np.array([t.covariance for t in tilts]),
    )
    mean = log.average((times.min() + times.max()) / 2, float(np.ptp(times)))
    return replace(mean, samples=sum(t.samples for t in tilts))


def tilts_of(seen: Sequence[Seen]) -> Callable[[float, float], Tilt]:
    """What `starpos.calibration.misalignment` asks for the tilt of an exposure."""
    by_time = {s.stars.mid_unix_s: s.tilt for s in seen}
    return lambda mid_unix_s, _: by_time[mid_unix_s]
