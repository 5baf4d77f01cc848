# SPDX-License-Identifier: Apache-2.0
"""When bytes were read, on the host's clock and the monotonic one at once, and when a device took its samples.

The time of a sample comes from the device's milliseconds, free of the jitter of the serial line and of the scheduler. A
line can come late but never early. So the lower envelope of (arrival - MCU time) over a window relates the two clocks,
and whatever lies above it is delay. The envelope is a straight line with a slope, because the rates of the clocks
differ. Of all lines below the points it is the highest at the middle of the window: the linear-programming fit of Moon,
Skelly and Towsley (1999).
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from starpos.system_clock import StepWatch

# If reading both clocks takes longer, they are read again.
QUICK_S = 1e-3
TRIES = 4


@dataclass(frozen=True, slots=True)
class Moment:
    """One instant on both clocks."""

    monotonic_s: float
    host_ns: int

    def stamp_ns(self, late_s: float) -> int:
        """The host's time so long before."""
        return max(self.host_ns - round(late_s * 1e9), 0)


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


WINDOW_S = 30.0
# A shorter span says too little about the rate.
MIN_SPAN_S = 10.0
REFIT_S = 1.0
# More than the error of an RC oscillator, let alone of a crystal.
MAX_RATE_ERROR = 0.05
RATE_RESOLUTION = 1e-9
# If a sample is further ahead of the envelope, the MCU's clock has jumped.
EARLY_S = 0.2
# A sample further behind comes from a backlog, or the MCU's clock stood still.
LATE_S = 2.0
# Samples that are read later than this, and fast, come from a backlog.
BACKLOG_S = 0.25
# Samples that come closer than this share of their spacing are read from a backlog.
FASTEST_PACE = 0.5
# Time that a new relation of the clocks must hold, to BACKLOG_S, before it is used: in a backlog it changes faster.
HELD_S = 1.0
# Delay of a line on a busy machine that still counts as coming at its pace.
JITTER_S = 0.05
# Lines come at their pace again after this number in a row at this share of their usual interval; a backlog comes faster.
PACED, SLOWEST_BACKLOG = 4, 0.75
# The time at which a line is due runs a little slow, so that it follows the earliest lines.
DUE_CREEP = 1.05
MAX_POINTS = 4096
# Number of lines whose mean interval is the usual one.
USUAL_OF = 21


class ArrivalFilter:
    """Finds how late each sample arrived beyond the shortest recent delay, from the device's own milliseconds.

    After this process stood still it reads a backlog, whose samples keep the times at which they were taken. The time of
    a sample is unknown in two cases: after the start or a reset, until the clocks have kept one relation for HELD_S; and
    at a leap, until it is clear whether a backlog follows or the device's clock stood still.
    """

    def __init__(self) -> None:
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_POINTS)
        self._last_ms = 0
        self._last_arrival_s = 0.0
        self._time = 0.0
        self._level = self._slope = 0.0
        self._next_fit = 0.0
        # Whether the relation of the clocks is known.
        self._live = False
        # Whether the present samples are read from a backlog.
        self._backlog = False
        # Time and offset of the first sample of a relation that is not believed yet.
        self._new: tuple[float, float] | None = None

    @property
    def rate_ppm(self) -> float:
        """How slow the device's clock is against the host's, 1e-6; 0 until it is known."""
        return self._slope * 1e6

    def arrival_s(self, milliseconds: int, now_s: float) -> float | None:
        """When a line with this device time would come at the earliest, on the monotonic clock.

        None while the clocks' relation is not known, and for a time impossible for a line that came at now_s.
        """
        ahead_s = ((milliseconds - self._last_ms + (1 << 31)) % (1 << 32) - (1 << 31)) * 1e-3
        if not self._live or not self._points or abs(ahead_s) > LATE_S:
            return None
        time = self._time + ahead_s
        arrival_s = time + self._level + self._slope * time
        return arrival_s if -LATE_S < arrival_s - now_s < LATE_S else None

    def restart(self) -> None:
        """Forget the device's clock: it was reset, or may have been reset unnoticed."""
        self._points.clear()

    def delay(self, milliseconds: int, arrival_s: float) -> float | None:
        """Delay of this sample in s (>= 0) beyond the shortest delay of the line; None if it cannot be known.

        milliseconds: the device's time of the sample, 32 bits.
        arrival_s: when it arrived, on a clock that does not step (time.monotonic).
        """
        elapsed = (milliseconds - self._last_ms) & 0xFFFFFFFF
        if not self._points or elapsed >= 1 << 31:
            self._start(milliseconds, arrival_s)
            return None
        time, apart_s = self._time + elapsed * 1e-3, arrival_s - self._last_arrival_s
        offset = arrival_s - time
        late = offset - (self._level + self._slope * time)
        if late < -EARLY_S and self._live:
            self._start(milliseconds, arrival_s)
            return None
        catching_up = apart_s < FASTEST_PACE * elapsed * 1e-3
        self._last_ms, self._last_arrival_s, self._time = milliseconds, arrival_s, time
        if not self._live:
            self._live = self._has_held(offset)
            self._keep(time, offset)
            self._level = min(o for _, o in self._points)
            return max(offset - self._level, 0.0) if self._live else None
        # Before the rates of the clocks are known, lateness may come from them.
        rates_known = self._points[-1][0] - self._points[0][0] >= MIN_SPAN_S
        if late > (BACKLOG_S if rates_known else LATE_S):
            return self._too_late(late, offset, arrival_s, catching_up)
        self._new = None
        # The samples of a backlog do not show the delay of the line, and would replace those that do.
        self._backlog = catching_up and (self._backlog or late > BACKLOG_S)
        if self._backlog:
            return max(late, 0.0)
        if time - self._points[-1][0] > REFIT_S:
            # The first samples after a gap may be late: an edge of the hull to one of them would show a wrong rate.
            self._next_fit = time + REFIT_S
        self._keep(time, offset)
        if time >= self._next_fit:
            self._next_fit = time + REFIT_S
            self._fit()
            late = offset - (self._level + self._slope * time)
        if late < 0:
            self._level += late
        return max(late, 0.0)

    def _too_late(self, late: float, offset: float, arrival_s: float, catching_up: bool) -> float | None:
        """Delay of a sample that is very late: this process stood still, or the device's clock did."""
        self._backlog = True
        if self._has_held(offset):
            self._start(self._last_ms, arrival_s)
            self._live = True
            return 0.0
        return late if catching_up or late <= LATE_S else None

    def _has_held(self, offset: float) -> bool:
        """Whether the offset of the clocks has been about this one for HELD_S; forgets the points of another one."""
        if self._new is None or abs(offset - self._new[1]) > BACKLOG_S:
            self._new = self._time, offset
            if not self._live:
                self._points.clear()
        return self._time - self._new[0] >= HELD_S

    def _keep(self, time: float, offset: float) -> None:
        self._points.append((time, offset))
        while self._points[0][0] < time - WINDOW_S:
            self._points.popleft()

    def _start(self, milliseconds: int, arrival_s: float) -> None:
        self._last_ms, self._last_arrival_s, self._time = milliseconds, arrival_s, 0.0
        self._level, self._slope = arrival_s, 0.0
        self._points.clear()
        self._points.append((0.0, arrival_s))
        self._next_fit = REFIT_S
        self._live, self._backlog, self._new = False, False, (0.0, arrival_s)

    def _fit(self) -> None:
        times, offsets = np.array(self._points).T
        first, last = times[0], times[-1]
        if last - first >= MIN_SPAN_S:
            low, high = -MAX_RATE_ERROR, MAX_RATE_ERROR
            while high - low > RATE_RESOLUTION:
                self._slope = (low + high) / 2
                # A line that is lowered to touch the points touches on the side to which it has to turn.
                touches = times[np.argmin(offsets - self._slope * times)]
                low, high = (self._slope, high) if 2 * touches < first + last else (low, self._slope)
        self._level = float((offsets - self._slope * times).min())


class PaceWatch:
    """Judges whether lines without a clock of their own were just sent: lines after a silence may be a backlog."""

    def __init__(self) -> None:
        self._spacings: deque[float] = deque(maxlen=USUAL_OF)
        self._last_s: float | None = None
        # When the present line was to come at the latest.
        self._due_s = 0.0
        # The spacings since the last silence, while it is not clear whether a backlog is read.
        self._doubtful: deque[float] | None = None

    def on_time(self, arrival_s: float) -> bool:
        """Whether this line was sent about when it arrived, judged by the pace of the lines."""
        if self._last_s is None:
            self._last_s = self._due_s = arrival_s
            return True
        apart_s, self._last_s = arrival_s - self._last_s, arrival_s
        usual_s = sum(self._spacings) / len(self._spacings) if self._spacings else apart_s
        self._due_s = min(arrival_s, self._due_s + DUE_CREEP * usual_s)
        if self._doubtful is None:
            if arrival_s - self._due_s <= usual_s + JITTER_S:
                self._spacings.append(apart_s)
                return True
            self._doubtful = deque(maxlen=PACED)
            return False
        self._doubtful.append(apart_s)
        if usual_s and apart_s > 2 * usual_s + JITTER_S:
            # Another silence.
            self._doubtful.clear()
        # A single pause in the reading of a backlog does not count for all of them.
        took_s = sum(min(spacing, 2 * usual_s or spacing) for spacing in self._doubtful)
        if len(self._doubtful) < PACED or took_s <= SLOWEST_BACKLOG * PACED * usual_s:
            return False
        self._spacings.extend(self._doubtful)
        self._doubtful, self._due_s = None, arrival_s
        return True
