# SPDX-License-Identifier: Apache-2.0
"""Times of the edges that the board has timed: on the host's clock, or by a GNSS receiver's pulse per second.

The host's clock is good enough to say which second a pulse begins. Between two pulses the board's clock counts, at the
rate that the last two have shown: so an edge has the receiver's time, whatever the serial line and the host's clock add.
"""

from collections import deque

from starpos_inclinometer.host_clock import Moment
from starpos_inclinometer.sources.mcu_protocol import Input, Pulse
from starpos_inclinometer.sources.reading import TimedPulse

# Error of a time through the serial line: an adapter's latency timer of 16 ms, evenly distributed.
LINE_STDDEV_S = 0.016 / 12**0.5
# Error of one by the receiver's second: the handler's latency, and a resonator's drift within a second.
SECOND_STDDEV_S = 2e-5
# A pulse that the host's clock sees further than this from a whole second has no number.
MAX_OFF_S = 0.3
# A ceramic resonator is off by less.
MAX_RATE_ERROR = 0.01
# The board's clock is not trusted longer than this after a pulse.
MAX_AGE_S = 2.5
QUEUE = 256


class PulseTimes:
    """Dates the edges of one board."""

    def __init__(self) -> None:
        self.dated = self.undated = 0
        # The state of the receiver's second, for a person to read.
        self.second = "no pulse yet"
        self._queue: deque[TimedPulse] = deque(maxlen=QUEUE)
        self._sequences: dict[int, tuple[int, int]] = {}
        # (device s, UTC s) of the last two pulses that fit each other.
        self._seconds: deque[tuple[float, int]] = deque(maxlen=2)

    def restart(self) -> None:
        """Forget the receiver's pulses, because the board's clock was reset."""
        self._seconds.clear()

    def take(self) -> list[TimedPulse]:
        taken = list(self._queue)
        self._queue.clear()
        return taken

    def add(self, pulse: Pulse, moment: Moment, edge_s: float | None) -> None:
        """Take an edge whose line came at a moment; edge_s: when it was, on the monotonic clock, by the lines alone."""
        sequence = self._continued(pulse)
        device_s = pulse.milliseconds * 1e-3 + pulse.microseconds * 1e-6
        if edge_s is None:
            self.undated += 1
            return
        edge_s += pulse.microseconds * 1e-6
        host_ns = moment.host_ns - round((moment.monotonic_s - edge_s) * 1e9)
        if pulse.input == Input.PPS:
            self._follow(device_s, host_ns)
        utc_s = self._by_second(device_s)
        self.dated += 1
        self._queue.append(
            TimedPulse(
                input=pulse.input,
                rising=pulse.rising,
                sequence=sequence,
                bounces=pulse.bounces,
                device_time_s=device_s,
                stamp_ns=host_ns if utc_s is None else utc_s[0] * 10**9 + round(utc_s[1] * 1e9),
                stddev_s=LINE_STDDEV_S if utc_s is None else SECOND_STDDEV_S,
                disciplined=utc_s is not None,
            )
        )

    def _continued(self, pulse: Pulse) -> int:
        """Number of the edge, counted on over wraps; after a reset of the board it jumps, as for lost edges."""
        raw, sequence = self._sequences.get(pulse.input, (pulse.number - 1, -1))
        sequence = (sequence + ((pulse.number - raw) & 0xFF or 0x100)) & 0xFFFFFFFF
        self._sequences[pulse.input] = (pulse.number, sequence)
        return sequence

    def _follow(self, device_s: float, host_ns: int) -> None:
        """Take a pulse of the receiver as the begin of the second that the host's clock says."""
        second = (host_ns + 5 * 10**8) // 10**9
        off_s = (host_ns - second * 10**9) * 1e-9
        if abs(off_s) > MAX_OFF_S:
            self._seconds.clear()
            self.second = (
                f"the host's clock is {off_s:+.2f} s off the receiver's pulses, or more: set it, to know which second "
                "each begins"
            )
            return
        if self._seconds:
            before_s, before = self._seconds[-1]
            if not _agree(device_s - before_s, second - before):
                # Either may be wrong; the next one decides.
                self._seconds.clear()
        self._seconds.append((device_s, second))
        self.second = f"kept; the host's clock is off by {off_s * 1e3:+.0f} ms, the line's latency included"

    def _by_second(self, device_s: float) -> tuple[int, float] | None:
        """UTC of a time of the board, whole seconds and the rest; None without two pulses just before it."""
        if len(self._seconds) < 2:
            return None
        (first_s, first), (last_s, last) = self._seconds
        if not -1 <= device_s - last_s <= MAX_AGE_S:
            return None
        return last, (device_s - last_s) * (last - first) / (last_s - first_s)


def _agree(device_s: float, seconds: int) -> bool:
    return seconds > 0 and abs(device_s - seconds) <= MAX_RATE_ERROR * seconds
