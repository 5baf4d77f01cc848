# SPDX-License-Identifier: Apache-2.0
"""The host's clock beside the monotonic one: when something was read, and whether the host's clock was stepped."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from starpos_common.system_clock import StepWatch

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
        self._moment = Moment(0.0, 0)  # the last one
        self._watch: StepWatch | None = None  # of these moments; none over a simulation's

    def monotonic_s(self) -> float:
        """The monotonic clock alone; any thread may ask."""
        return self._monotonic_ns() * 1e-9

    def read(self) -> Moment:
        """Now."""
        for _ in range(TRIES):
            before = self._monotonic_ns()
            host_ns = self.now_ns()
            took_s = (self._monotonic_ns() - before) * 1e-9
            if took_s < QUICK_S:
                break
        self._moment = Moment(before * 1e-9, host_ns)
        if self._simulated():
            self._watch = None
        elif took_s < QUICK_S:  # what was interrupted between the clocks tells nothing
            self._watch = self._watch or StepWatch(self._clocks)
            if step_s := self._watch.step_s():
                self.step = Step(step_s, self._moment.monotonic_s)
        return self._moment

    def _clocks(self) -> tuple[float, float]:
        return self._moment.host_ns * 1e-9, self._moment.monotonic_s
