# SPDX-License-Identifier: Apache-2.0
"""The time that a session receives with each message."""

import math
from dataclasses import dataclass

# Times that differ by more are not of the same evening.
ANOTHER_TIME_S = 3600.0


@dataclass(frozen=True)
class Sent:
    """What the middleware reports of a message.

    number: its place among its publisher's messages; None where that is unknown.
    unix_s: when it was written, by the clock of its publisher's host; None where that is unknown.
    """

    number: int | None = None
    unix_s: float | None = None


@dataclass(frozen=True)
class Now:
    """A moment.

    unix_s: by the clock of whoever takes the messages; None while it is not known.
    waiting_s: by the clock in which waiting is counted; NaN while it is not known.
    played: whether both are the clock of recorded data: then nothing depends on speed.
    """

    unix_s: float | None
    waiting_s: float
    played: bool = False

    @classmethod
    def in_data(cls, unix_s: float | None) -> "Now":
        """A moment by the clock of recorded data."""
        return cls(unix_s, math.nan if unix_s is None else unix_s, played=True)

    def ahead_s(self, unix_s: float | None) -> float:
        """How far a time is ahead of this one (s); 0 if one of them is not known.

        It is also 0 if the two are not of the same evening: a night is played without /clock, or the robot does not
        know the date.
        """
        if unix_s is None or self.unix_s is None:
            return 0.0
        ahead_s = unix_s - self.unix_s
        return 0.0 if ahead_s > ANOTHER_TIME_S and not self.played else ahead_s
