# SPDX-License-Identifier: Apache-2.0
"""Which frames are left out if too many come, and the diagnostics of it."""

import math
from collections import deque

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
        self._number: int | None = None
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

    def numbered(self, number: int | None, now_s: float) -> None:
        """Drop the frames that the middleware lost before this one, by its number among its publisher's messages.

        None: the middleware reports none.  A lower number is another publisher's.
        """
        last, self._number = self._number, number
        if last is not None and number is not None and number > last + 1:
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
