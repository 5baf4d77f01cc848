# SPDX-License-Identifier: Apache-2.0
"""Which frames are left out if too many come, and which wait for their tilts or for the processor."""

import math
import statistics
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from starpos.frames.frame import Stars
from starpos.session.driver import Now

# the detector loads this module too, and not what a solution consists of
if TYPE_CHECKING:
    from starpos.fix.solution import Solution

# Interval over which the share of dropped frames is taken, and minimum number of frames.
LATELY_S, MIN_FRAMES = 10.0, 10
MAX_KEPT = 2000
MAX_DROPPED = 0.5
# Share of the interval by which a frame may come early, so that jitter of the stamps costs none.
JITTER = 0.25
MAX_RATE = 1000.0


class Pace:
    """Thins frames to a rate, evenly by their stamps, and counts those that were left out.

    left_out: frames left out by max_rate.  dropped: frames left out for lack of time.
    """

    def __init__(self) -> None:
        self.left_out = self.dropped = 0
        self._answers = self._fixes = 0
        # the rate, the stamp of the last frame, and when the next one is due that is wanted
        self._most_hz = self._before_s = self._due_s = math.nan
        # the topic of the last frame, and its number there
        self._number: tuple[object, int | None] = (None, None)
        # when each frame came, and whether it was taken
        self._lately: deque[tuple[float, bool]] = deque(maxlen=MAX_KEPT)

    def wants(self, unix_s: float | None, most_hz: float) -> bool:
        """Whether a frame of this stamp is wanted at a rate of at most most_hz; NaN: all, as without a stamp."""
        if math.isnan(most_hz) or unix_s is None:
            return True
        period_s = 1 / most_hz
        # the first one, and where stamps begin anew
        if most_hz != self._most_hz or not unix_s >= self._before_s:
            self._due_s = unix_s
        self._most_hz, self._before_s = most_hz, unix_s
        if unix_s < self._due_s - JITTER * period_s:
            self.left_out += 1
            return False
        self._due_s = max(self._due_s, unix_s - period_s) + period_s
        return True

    def numbered(self, number: int | None, now_s: float, topic: object = None) -> None:
        """Drop the frames that the middleware lost before this one, by its number among its publisher's messages.

        None: the middleware reports none.  A lower number is another publisher's, as is one on another topic.
        """
        (before, last), self._number = self._number, (topic, number)
        if topic == before and last is not None and number is not None and number > last + 1:
            self.drop(now_s, number - last - 1)

    def answered(self, fix: bool) -> None:
        """Count an answer, and whether it is a fix."""
        self._answers += 1
        self._fixes += fix

    @property
    def counts(self) -> dict[str, int]:
        """How many frames were answered, by a fix, or left out."""
        return {
            "frames": self._answers,
            "fixes": self._fixes,
            "dropped frames": self.dropped,
            "left out by max_rate": self.left_out,
        }

    def took(self, now_s: float) -> None:
        """Note a frame that is worked on."""
        self._note(now_s, True)

    def drop(self, now_s: float, frames: int = 1) -> None:
        """Note frames that cannot be worked on."""
        self.dropped += frames
        for _ in range(min(frames, MAX_KEPT)):
            self._note(now_s, False)

    def _note(self, now_s: float, taken: bool) -> None:
        self._lately.append((now_s, taken))
        while not 0 <= now_s - self._lately[0][0] <= LATELY_S and len(self._lately) > 1:
            self._lately.popleft()

    @property
    def complaint(self) -> str:
        """Sentence, where most of the latest frames were dropped; '' where they were not."""
        frames = len(self._lately)
        dropped = sum(not taken for _, taken in self._lately)
        if frames < MIN_FRAMES or dropped <= MAX_DROPPED * frames:
            return ""
        return (
            f"{100 * dropped / frames:.0f} % of the frames of the last {LATELY_S:.0f} s were dropped: more come than "
            "this machine can work on; set max_rate to the rate you need, or slow the camera"
        )


# Maximum number of waiting frames. While the triangles are built, only the newest few: others would be answered late.
MAX_WAITING, MAX_NEWEST = 1000, 4
# Number of answers whose median is the usual time of an answer.
COSTS = 9
# Tolerated delay of an answer behind others: short load by other programs then loses no frame.
MAX_LATE_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Waiting:
    """A frame that waits: the header of its message, and its stars with the error of their time.

    since_s: when it came, by the clock in which waiting is counted.
    ahead_s: how far the middle of its exposure was ahead of the session's clock then.
    doubted: whether earlier frames contradict its time or its level.
    refused: its answer where these leave it no fix; None otherwise.
    """

    header: Any
    stars: Stars
    since_s: float
    ahead_s: float
    doubted: bool = False
    refused: "Solution | None" = None

    def dated(self, now: Now) -> "Waiting":
        """Correct how far it is ahead of a played clock, whose tick may have arrived only after the frame."""
        if not now.played:
            return self
        return replace(self, ahead_s=min(now.ahead_s(self.stars.mid_unix_s), self.ahead_s))


class Backlog(deque[Waiting]):
    """Frames in the order in which they came.

    A new frame is taken if those before it can be answered by the time its own tilts come or within MAX_LATE_S, or if at
    most one is before it. So no frame pushes out another one that waits, the processor always has work while too many
    frames come, and answers come at an even rate and hardly later than their tilts allow.
    """

    def __init__(self) -> None:
        super().__init__()
        self._costs_s: deque[float] = deque(maxlen=COSTS)
        # when the last answer was begun, if another frame was ready behind it; NaN otherwise
        self._begun_s = math.nan

    def has_room(self, delay_s: float) -> bool:
        """Whether another frame can be answered in time; delay_s: for how long frames wait for their tilts."""
        if len(self) >= MAX_WAITING:
            return False
        cost_s = statistics.median(self._costs_s) if self._costs_s else 0.0
        return len(self) * cost_s <= max(delay_s, MAX_LATE_S) + cost_s

    def keep_newest(self) -> int:
        """Drop all but the newest few; returns how many were dropped."""
        dropped = max(len(self) - MAX_NEWEST, 0)
        for _ in range(dropped):
            self.popleft()
        return dropped

    def pop_first(self, now_s: float) -> Waiting:
        """Pop the first frame, which is answered from now on."""
        if not math.isnan(self._begun_s):
            self._costs_s.append(now_s - self._begun_s)
        self._begun_s = now_s
        return self.popleft()

    def pause(self) -> None:
        """Note that no frame is ready: until the next one the processor is idle."""
        self._begun_s = math.nan
