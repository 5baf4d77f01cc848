# SPDX-License-Identifier: Apache-2.0
"""The host's clock and the monotonic clock read together: when bytes were read, and steps of the host's clock."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from starpos.session.system_clock import StepWatch

# If reading both clocks takes longer, they are read again.
QUICK_S = 1e-3
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
    """Reads both clocks at one moment and notices steps; one thread has to read it several times a second.

    now_ns: the host's clock.
    simulated: whether the host's clock is simulated; no steps are looked for then.
    monotonic_ns: the clock that is never set.
    """

    def __init__(
        self,
        now_ns: Callable[[], int] = time.time_ns,
        simulated: Callable[[], bool] = lambda: False,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        # The last step.
        self.step: Step | None = None
        self.now_ns = now_ns
        self._monotonic_ns = monotonic_ns
        self._simulated = simulated
        # The last moment.
        self._moment = Moment(0.0, 0)
        # Finds steps between the moments; None while the clock is simulated.
        self._watch: StepWatch | None = None

    def monotonic_s(self) -> float:
        """Read the monotonic clock alone; any thread may ask."""
        return self._monotonic_ns() * 1e-9

    def read(self) -> Moment:
        """Read both clocks."""
        for _ in range(TRIES):
            before = self._monotonic_ns()
            host_ns = self.now_ns()
            took_s = (self._monotonic_ns() - before) * 1e-9
            if took_s < QUICK_S:
                break
        self._moment = Moment(before * 1e-9, host_ns)
        if self._simulated():
            self._watch = None
        elif took_s < QUICK_S:
            # A reading that was interrupted between the two clocks says nothing of a step.
            self._watch = self._watch or StepWatch(self._clocks)
            if step_s := self._watch.step_s():
                self.step = Step(step_s, self._moment.monotonic_s)
        return self._moment

    def _clocks(self) -> tuple[float, float]:
        return self._moment.host_ns * 1e-9, self._moment.monotonic_s
