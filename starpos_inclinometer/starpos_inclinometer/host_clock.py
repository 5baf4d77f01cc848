# SPDX-License-Identifier: Apache-2.0
"""The host's clock beside the monotonic one: when something was read, and whether the host's clock was stepped."""

import time
from collections.abc import Callable
from dataclasses import dataclass

STEP_S = 0.1  # more than any slewing between two readings; adjtime and NTP slew by 0.5 ms a second at most
QUICK_S = 1e-3  # the two clocks are read together within that, or again
TRIES = 4


@dataclass(frozen=True, slots=True)
class Moment:
    """One instant on both clocks."""

    monotonic_s: float
    host_ns: int


@dataclass(frozen=True, slots=True)
class Step:
    """The host's clock was set by `seconds` (positive: forward) at about this monotonic time."""

    seconds: float
    monotonic_s: float


class HostClock:
    """Reads both clocks as one and notices steps; to be read several times a second, by one thread.

    now_ns: the host's clock.  simulated: whether that is a simulation's, which goes as it likes and is not judged.
    monotonic_ns: the one that is never set.
    """

    def __init__(
        self,
        now_ns: Callable[[], int] = time.time_ns,
        simulated: Callable[[], bool] = lambda: False,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ):
        self.step: Step | None = None  # the last one
        self.now_ns = now_ns
        self._monotonic_ns = monotonic_ns
        self._simulated = simulated
        self._offset_ns: int | None = None  # host's clock less the monotonic one

    def monotonic_s(self) -> float:
        """The monotonic clock alone; any thread may ask."""
        return self._monotonic_ns() * 1e-9

    def read(self) -> Moment:
        """Now."""
        for _ in range(TRIES):
            before = self._monotonic_ns()
            host_ns = self.now_ns()
            took_ns = self._monotonic_ns() - before
            if took_ns < QUICK_S * 1e9:
                break
        offset_ns = None if self._simulated() else host_ns - before
        if offset_ns is not None and self._offset_ns is not None:
            jump_s = (offset_ns - self._offset_ns) * 1e-9
            if abs(jump_s) > STEP_S + took_ns * 1e-9:
                self.step = Step(jump_s, before * 1e-9)
        self._offset_ns = offset_ns
        return Moment(before * 1e-9, host_ns)
