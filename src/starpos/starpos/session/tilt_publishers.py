# SPDX-License-Identifier: Apache-2.0
"""Whether the tilts come from one inclinometer alone.

Any ROS node may publish on `tilt`, and mixed readings of two inclinometers make confident wrong fixes: while two are
heard, neither is used. A killed publisher stays in the graph for a while, so only received messages count. Publishers
are distinguished by the frame of their messages and by DDS's message numbers, which grow with each message of one
publisher.
"""

from dataclasses import dataclass

# time after which a single publisher is used again: a minimum, periods of the other if it sent seldom, a maximum
ALONE_S, ALONE_PERIODS, MAX_ALONE_S = 1.0, 2.5, 10.0
# highest rate of an inclinometer; it bounds how many messages between two received ones can be lost
MAX_HZ = 500.0


@dataclass
class _Voice:
    """One publisher as known from its messages: their frame, the last one's number, arrival and interval."""

    frame_id: str
    number: int | None
    heard_s: float
    period_s: float = 0.0

    def speaks(self, now_s: float) -> bool:
        """Whether it may be going on."""
        silence_s = min(max(ALONE_S, ALONE_PERIODS * self.period_s), MAX_ALONE_S)
        return abs(now_s - self.heard_s) <= silence_s


class TiltPublishers:
    """Notes every message and says whether its publisher is the only one."""

    def __init__(self) -> None:
        self._voices: list[_Voice] = []
        self._speaking: list[_Voice] = []

    def heard(self, frame_id: str, number: int | None, now_s: float) -> None:
        """Note a message; number: its number among its publisher's messages, None where the middleware gives none."""
        mine = self._voice_of(frame_id, number, now_s) or _Voice(frame_id, number, now_s)
        mine.number, mine.heard_s, mine.period_s = number, now_s, abs(now_s - mine.heard_s)
        # one that sends seldom is remembered, to learn how seldom
        others = [v for v in self._voices if v is not mine and abs(now_s - v.heard_s) <= MAX_ALONE_S]
        self._voices = [*others, mine]
        self._speaking = [v for v in self._voices if v.speaks(now_s)]

    def _voice_of(self, frame_id: str, number: int | None, now_s: float) -> _Voice | None:
        """The publisher that this message continues: among equal candidates one still speaking rather than an old one.

        A number that is ahead by more than messages can have been lost is another publisher's.
        """
        of_frame = [v for v in self._voices if v.frame_id == frame_id]
        if number is None:
            return of_frame[0] if of_frame else None
        before = [
            v
            for v in of_frame
            if v.number is not None and v.number < number <= v.number + 1 + abs(now_s - v.heard_s) * MAX_HZ
        ]
        return max(before, key=lambda v: (v.number, v.speaks(now_s), v.heard_s), default=None)

    @property
    def several(self) -> str:
        """A sentence that names the publishers heard at the same time; '' if there is only one."""
        if len(self._speaking) < 2:
            return ""
        frames = sorted({v.frame_id for v in self._speaking})
        named = " and ".join(map(repr, frames)) if len(frames) > 1 else f"both with the frame {frames[0]!r}"
        return (
            f"{len(self._speaking)} inclinometers publish on tilt ({named}): stop all but one, or give each instrument a "
            "namespace of its own"
        )
