# SPDX-License-Identifier: Apache-2.0
"""The frames that wait for their tilts, or for the processor, and whether another one can be answered in time."""

import math
import statistics
from collections import deque

from starpos.session.frames import Waiting

# Maximum number of waiting frames. While the triangles are built, only the newest few: others would be answered late.
MAX_WAITING, MAX_NEWEST = 1000, 4
# Number of answers whose median is the usual time of an answer.
COSTS = 9
# Tolerated delay of an answer behind others: short load by other programs then loses no frame.
MAX_LATE_S = 0.1


class Backlog:
    """Frames in the order in which they came.

    A new frame is taken if those before it can be answered by the time its own tilts come or within MAX_LATE_S, or if at
    most one is before it. So no frame pushes out another one that waits, the processor always has work while too many
    frames come, and answers come at an even rate and hardly later than their tilts allow.
    """

    def __init__(self) -> None:
        self._frames: deque[Waiting] = deque()
        self._costs_s: deque[float] = deque(maxlen=COSTS)
        # when the last answer was begun, if another frame was ready behind it; NaN otherwise
        self._begun_s = math.nan

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def first(self) -> Waiting:
        return self._frames[0]

    @first.setter
    def first(self, frame: Waiting) -> None:
        self._frames[0] = frame

    def clear(self) -> None:
        self._frames.clear()

    def has_room(self, delay_s: float) -> bool:
        """Whether another frame can be answered in time; delay_s: for how long frames wait for their tilts."""
        if len(self) >= MAX_WAITING:
            return False
        cost_s = statistics.median(self._costs_s) if self._costs_s else 0.0
        return len(self) * cost_s <= max(delay_s, MAX_LATE_S) + cost_s

    def add(self, frame: Waiting) -> None:
        self._frames.append(frame)

    def keep_newest(self) -> int:
        """Drop all but the newest few; returns how many were dropped."""
        dropped = max(len(self) - MAX_NEWEST, 0)
        for _ in range(dropped):
            self._frames.popleft()
        return dropped

    def pop(self, now_s: float) -> Waiting:
        """The first frame, which is answered from now on."""
        if not math.isnan(self._begun_s):
            self._costs_s.append(now_s - self._begun_s)
        self._begun_s = now_s
        return self._frames.popleft()

    def pause(self) -> None:
        """Note that no frame is ready: until the next one the processor is idle."""
        self._begun_s = math.nan
