# SPDX-License-Identifier: Apache-2.0
"""Frames kept for a calibration: the newest ones, and one for each pose; their number is bounded."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from starpos.averaging.slip import slip_s
from starpos.errors import TiltError
from starpos.fix.fix import Fix
from starpos.frames.stars import Stars
from starpos.identification import Identification
from starpos.instrument.inclinometer import Tilt
from starpos.instrument.tilt_log import TiltLog
from starpos.instrument.tilts import TiltsByTime

MAX_POSES = 36
# The newest tilts of a pose.
MAX_TILTS = 64


@dataclass(frozen=True)
class Seen:
    """The stars of a frame that has a time, with its tilt; found: their identification, None without one."""

    stars: Stars
    tilt: Tilt
    found: Identification | None = None

    @property
    def mid_unix_s(self) -> float:
        """Middle of the exposure."""
        assert self.stars.mid_unix_s is not None
        return self.stars.mid_unix_s


class RecentFrames:
    """The newest frames with stars and a tilt."""

    def __init__(self, most: int) -> None:
        self._frames: deque[Seen] = deque(maxlen=most)

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, seen: Seen) -> None:
        if len(seen.stars):
            self._frames.append(seen)

    def keep(self, most: int) -> None:
        """Keep this number of frames from now on; the newest of the present ones stay."""
        self._frames = deque(self._frames, maxlen=most)

    def newest(self, count: int) -> list[Seen]:
        """Return up to this number of the newest frames in the order they came."""
        return list(self._frames)[max(0, len(self._frames) - count) :]

    def clear(self) -> None:
        self._frames.clear()


@dataclass
class _Pose:
    """A camera that has stood still on the Earth since `first`."""

    first: Fix
    newest: Seen
    frames: int = 0
    tilts: deque[Tilt] = field(default_factory=lambda: deque(maxlen=MAX_TILTS))

    def add(self, seen: Seen) -> None:
        self.newest = seen
        self.frames += 1
        self.tilts.append(seen.tilt)


class PoseMemory:
    """Keeps each pose's last frame with the mean tilt of the pose; drops the oldest poses."""

    def __init__(self) -> None:
        self._poses: deque[_Pose] = deque(maxlen=MAX_POSES)

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, seen: Seen, fix: Fix) -> bool:
        """Add a frame; return whether a new calibration is worthwhile: a new pose, or one with twice as many frames."""
        if not self._poses or slip_s(fix, self._poses[-1].first) != 0:
            self._poses.append(_Pose(fix, seen))
        pose = self._poses[-1]
        pose.add(seen)
        return pose.frames & (pose.frames - 1) == 0

    def frames(self) -> list[Seen]:
        """Return a frame for each pose whose tilts agree, the oldest first."""
        made = []
        for pose in self._poses:
            try:
                made.append(replace(pose.newest, tilt=mean_tilt(pose.tilts)))
            except TiltError:
                # The tilts contradict each other, and it is unknown which is right.
                continue
        return made

    def forget_before(self, utc_unix_s: float) -> None:
        """Drop the poses before that time, because the instrument has moved then."""
        while self._poses and self._poses[0].newest.mid_unix_s < utc_unix_s:
            self._poses.popleft()

    def clear(self) -> None:
        self._poses.clear()


def mean_tilt(tilts: Sequence[Tilt]) -> Tilt:
    """Average the tilts of an instrument at rest without outliers; TiltError if the tilts contradict each other."""
    mean = TiltLog.of_readings(tilts).mean()
    return replace(mean, samples=sum(t.samples for t in tilts))


def tilts_of(seen: Sequence[Seen]) -> TiltsByTime:
    """The tilts of frames, as a solver takes them."""
    return TiltsByTime({s.mid_unix_s: s.tilt for s in seen})


def known_of(seen: Sequence[Seen]) -> dict[int, Identification]:
    """Identifications of the frames' stars, by the frames' numbers."""
    return {k: s.found for k, s in enumerate(seen) if s.found is not None}
