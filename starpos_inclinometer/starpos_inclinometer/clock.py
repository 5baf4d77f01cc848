# SPDX-License-Identifier: Apache-2.0
"""The MCU's milliseconds to the time of a sample, without the jitter of the serial line and of the scheduler.

A line can come late but never early. So the lower envelope of (arrival - MCU time) over a window relates the
two clocks, and what lies above it is delay. The envelope is a line, because the clocks' rates differ: the
lower hull's edge over the window's middle, the linear-programming fit of Moon, Skelly and Towsley (1999).
"""

from collections import deque

WINDOW_S = 30.0
MIN_SPAN_S = 10.0  # less says too little about the rate
REFIT_S = 1.0
MAX_RATE_ERROR = 0.05  # an RC oscillator, not a crystal, and then some
EARLY_S = 0.2  # a sample so far ahead of the envelope: the MCU's clock jumped
LATE_S = 2.0  # so far behind: it was reset, or stood still
MAX_POINTS = 4096


class ArrivalFilter:
    """How late each sample arrived beyond the shortest delay seen lately. Starts anew after an MCU reset."""

    def __init__(self):
        self.restarts = -1  # of the filter; the first sample starts it
        self._points: deque[tuple[float, float]] = deque(maxlen=MAX_POINTS)
        self._last_ms = 0
        self._time = 0.0
        self._level = self._slope = 0.0
        self._next_fit = 0.0

    @property
    def rate_ppm(self) -> float:
        """How much the MCU's clock is slow against the host's, 1e-6; 0 until it is known."""
        return self._slope * 1e6

    def restart(self):
        """Forget the MCU's clock: it was reset, or may have been while nobody listened."""
        self._points.clear()

    def delay(self, milliseconds: int, arrival_s: float) -> float:
        """Seconds (>= 0) by which this sample arrived later than the line is quick.

        milliseconds: the sample's, 32 bits.  arrival_s: of a clock that does not step (time.monotonic).
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

    def _fit(self):
        points = self._points
        first, last = points[0][0], points[-1][0]
        if last - first >= MIN_SPAN_S:
            hull = _lower_hull(points)
            middle = (first + last) / 2
            index = next(i for i in range(1, len(hull)) if hull[i][0] >= middle)
            (t0, o0), (t1, o1) = hull[index - 1], hull[index]
            self._slope = min(max((o1 - o0) / (t1 - t0), -MAX_RATE_ERROR), MAX_RATE_ERROR)
        self._level = min(offset - self._slope * time for time, offset in points)


def _lower_hull(points) -> list[tuple[float, float]]:
    """The lower convex hull of points in the order of time (Andrew's monotone chain)."""
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
