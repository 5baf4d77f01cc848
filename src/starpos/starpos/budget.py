# SPDX-License-Identifier: Apache-2.0
"""CPU time that a search may take."""

import math
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """A limit of CPU time: `end_s`, on the clock of this process's CPU time, is when work that asks for it stops."""

    end_s: float = math.inf

    @classmethod
    def of(cls, seconds: float) -> "Budget":
        """The limit of a number of seconds from now."""
        return cls(time.process_time() + seconds)

    @property
    def left_s(self) -> float:
        """How many seconds are left."""
        return max(self.end_s - time.process_time(), 0.0)

    @property
    def spent(self) -> bool:
        """Whether the time is over."""
        return time.process_time() >= self.end_s


# Work goes on until it is done.
ENDLESS = Budget()
