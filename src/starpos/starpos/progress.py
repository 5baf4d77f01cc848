# SPDX-License-Identifier: Apache-2.0
"""Long work: reports of its progress, what it says meanwhile, and a limit of its CPU time."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

# Called with a text about the work, and the share that is done, 0..1.
Progress = Callable[[str, float], None]


# Called with sentences on what looks wrong, or '' where nothing does.
Say = Callable[..., None]


def quiet(*said: object) -> None:
    """Ignore a progress report, or sentences."""


@dataclass(frozen=True)
class CpuLimit:
    """A limit of CPU time: `end_s`, on the clock of this process's CPU time, is when work that asks for it stops."""

    end_s: float = math.inf

    @classmethod
    def of(cls, seconds: float) -> "CpuLimit":
        """The limit of a number of seconds from now."""
        return cls(time.process_time() + seconds)

    @property
    def left_s(self) -> float:
        """How many seconds are left."""
        return max(self.end_s - time.process_time(), 0.0)

    @property
    def reached(self) -> bool:
        """Whether the time is over."""
        return time.process_time() >= self.end_s


# Work goes on until it is done.
UNLIMITED = CpuLimit()
