# SPDX-License-Identifier: Apache-2.0
"""Time of a sample from the MCU's milliseconds, free of the jitter of the serial line and of the scheduler.

A line can come late but never early. So the lower envelope of (arrival - MCU time) over a window relates the two
clocks, and whatever lies above it is delay. The envelope is a straight line with a slope, because the rates of the
clocks differ. It is the edge of the lower hull at the middle of the window: the linear-programming fit of Moon, Skelly
and Towsley (1999).
"""

from collections import deque
from collections.abc import Iterable

WINDOW_S = 30.0
# A shorter span says too little about the rate.
MIN_SPAN_S = 10.0
REFIT_S = 1.0
# More than the error of an RC oscillator, let alone of a crystal.
MAX_RATE_ERROR = 0.05
# With a sample so far ahead of the envelope the MCU's clock has jumped.
EARLY_S = 0.2
# With a sample so far behind it the MCU was reset, or stood still.
LATE_S = 2.0
MAX_POINTS = 4096


class ArrivalFilter:
    """Finds how late each sample arrived beyond the shortest recent delay; starts again after a reset of the MCU."""

    def __init__(self) -> None:
        # How often the filter started again; its first sample makes it 0.
        self.restarts = -1
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_POINTS)
        self._last_ms = 0
        self._time = 0.0
        self._level = self._slope = 0.0
        self._next_fit = 0.0

    @property
    def rate_ppm(self) -> float:
        """How slow the MCU's clock is against the host's, 1e-6; 0 until it is known."""
        return self._slope * 1e6

    def restart(self) -> None:
        """Forget the MCU's clock: it was reset, or may have been reset while nobody listened."""
        self._points.clear()

    def delay(self, milliseconds: int, arrival_s: float) -> float:
        """Delay of this sample in s (>= 0) beyond the shortest delay of the line.

        milliseconds: the MCU's time of the sample, 32 bits.
        arrival_s: when it arrived, on a clock that does not step (time.monotonic).
        """
        if not self._points:
            return self._restart(milliseconds, arrival_s)
        elapsed = (milliseconds - self._last_ms) & 0xFFFFFFFF
        if elapsed >= 1 << 31:
            return self._restart(milliseconds, arrival_s)
        time = self._time + elapsed * 1e-3
        offset = arrival_s - time
        late = offset - (self._level + self._slope * time)
        if not -EARLY_S <= late <= LATE_S:
            return self._restart(milliseconds, arrival_s)
        self._last_ms, self._time = milliseconds, time
        self._points.append((time, offset))
        while self._points[0][0] < time - WINDOW_S:
            self._points.popleft()
        if time >= self._next_fit:
            self._next_fit = time + REFIT_S
            self._fit()
            late = offset - (self._level + self._slope * time)
        if late < 0:
            self._level += late
        return max(late, 0.0)

    def _restart(self, milliseconds: int, arrival_s: float) -> float:
        self.restarts += 1
        self._last_ms, self._time = milliseconds, 0.0
        self._level, self._slope = arrival_s, 0.0
        self._points.clear()
        self._points.append((0.0, arrival_s))
        self._next_fit = REFIT_S
        return 0.0

    def _fit(self) -> None:
        points = self._points
        first, last = points[0][0], points[-1][0]
        if last - first >= MIN_SPAN_S:
            hull = _lower_hull(points)
            middle = (first + last) / 2
            index = next(i for i in range(1, len(hull)) if hull[i][0] >= middle)
            (t0, o0), (t1, o1) = hull[index - 1], hull[index]
            self._slope = min(max((o1 - o0) / (t1 - t0), -MAX_RATE_ERROR), MAX_RATE_ERROR)
        self._level = min(offset - self._slope * time for time, offset in points)


def _lower_hull(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Find the lower convex hull of points in the order of time (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for t, o in points:
        if hull and t == hull[-1][0]:
            if o >= hull[-1][1]:
                continue
            hull.pop()
        while len(hull) > 1:
            (t0, o0), (t1, o1) = hull[-2], hull[-1]
            if (o1 - o0) * (t - t0) < (o - o0) * (t1 - t0):
                break
            hull.pop()
        hull.append((t, o))
    return hull
