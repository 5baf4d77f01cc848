# SPDX-License-Identifier: Apache-2.0
"""Whether the tilts come from one inclinometer alone.

ROS lets anybody publish on `tilt`, and the readings of two inclinometers, mixed, make confident wrong fixes: while two
are heard, neither is believed. A publisher that was killed stays in the graph for a while, so what counts is who is
heard. One publisher is told from another by the frame of its messages and by the numbers that DDS gives them, which grow
from message to message of one publisher.
"""

from dataclasses import dataclass

# one publisher alone is believed again after so long; where the other sent seldom, after so many of its periods, up to so
# long
ALONE_S, ALONE_PERIODS, MOST_ALONE_S = 1.0, 2.5, 10.0
# no inclinometer sends more often: what is missing between two messages of one publisher was sent between them
MOST_HZ = 500.0


@dataclass
class _Voice:
    """One publisher as far as its messages tell: their frame, the last one's number, when it came and how long after."""

    frame_id: str
    number: int | None
    heard_s: float
    period_s: float = 0.0

    def speaks(self, now_s: float) -> bool:
        """Whether it may be going on."""
        silence_s = min(max(ALONE_S, ALONE_PERIODS * self.period_s), MOST_ALONE_S)
        return abs(now_s - self.heard_s) <= silence_s


class TiltPublishers:
    """Hears of every message and says whether its publisher is the only one."""

    def __init__(self) -> None:
        self._voices: list[_Voice] = []
        self._speaking: list[_Voice] = []

    def heard(self, frame_id: str, number: int | None, now_s: float) -> None:
        """Note a message; number: that of its publisher's messages, None where the middleware tells none."""
        mine = self._voice_of(frame_id, number, now_s) or _Voice(frame_id, number, now_s)
        mine.number, mine.heard_s, mine.period_s = number, now_s, abs(now_s - mine.heard_s)
        # one that sends seldom is remembered, to learn how seldom
        others = [v for v in self._voices if v is not mine and abs(now_s - v.heard_s) <= MOST_ALONE_S]
        self._voices = [*others, mine]
        self._speaking = [v for v in self._voices if v.speaks(now_s)]

    def _voice_of(self, frame_id: str, number: int | None, now_s: float) -> _Voice | None:
        """The publisher that this message continues: of the same number rather one that goes on than one of long ago.

        A number that is further on than messages can have been lost meanwhile is another publisher's.
        """
        of_frame = [v for v in self._voices if v.frame_id == frame_id]
        if number is None:
            return of_frame[0] if of_frame else None
        before = [
            v
            for v in of_frame
            if v.number is not None and v.number < number <= v.number + 1 + abs(now_s - v.heard_s) * MOST_HZ
        ]
        return max(before, key=lambda v: (v.number, v.speaks(now_s), v.heard_s), default=None)

    @property
    def several(self) -> str:
        """A sentence that names those that are heard at a time; '' where there is but one."""
        if len(self._speaking) < 2:
            return ""
        frames = sorted({v.frame_id for v in self._speaking})
        named = " and ".join(map(repr, frames)) if len(frames) > 1 else f"both with the frame {frames[0]!r}"
        return (
            f"{len(self._speaking)} inclinometers publish on tilt ({named}): stop all but one, or give each instrument a "
            "namespace of its own"
        )
