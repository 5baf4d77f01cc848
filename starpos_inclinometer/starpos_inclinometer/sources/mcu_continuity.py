# SPDX-License-Identifier: Apache-2.0
"""Check that samples fit one another: those that do not are dropped, and lost ones are counted.

A 16-bit checksum lets one corrupted line in 65,536 pass, and a line without a checksum passes far more often. Such a
sample does not fit the samples around it: its number, its time or its tilt is wrong.
"""

from collections.abc import Callable
from dataclasses import replace

from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.reading import Arrival

# Multiple of the usual change from sample to sample that still counts as near.
TOLERANCE_OF_CHANGE = 8.0
# Weight of a new sample in the usual change.
CHANGE_SHARE = 1 / 8
# Number of samples in a row that are used even if no two are near each other: the instrument moves.
WITNESSES = 3

# Both ends of a period are rounded down to ms.
PERIOD_TOLERANCE_MS = 2
# Periods of the highest and the lowest rate.
SHORTEST_MS, LONGEST_MS = 20, 1000
# Counts; 2.8 deg C from one sample to the next.
TEMPERATURE_TOLERANCE = 3
FAULTS = SampleStatus.NO_ANSWER | SampleStatus.MEANINGLESS
# The host may stall for a time; the MCU's RC oscillator may be wrong by a share.
HOST_TOLERANCE_S, HOST_TOLERANCE_SHARE = 3.0, 0.05


class Gate:
    """Lets samples pass that fit the last one; others wait until later samples confirm them, or are dropped.

    follows: whether the second arrival may come after the first, judged by everything except `x` and `y`.
    tolerance: change of `x` and `y` between two samples that is always accepted; changes like the recent ones are
    accepted too.
    """

    def __init__(self, follows: Callable[[Arrival, Arrival], bool], tolerance: float) -> None:
        self.rejected = self.duplicates = 0
        self._follows = follows
        self.tolerance = tolerance
        self._change = 0.0
        self._last: Arrival | None = None
        self._waiting: list[Arrival] = []

    def reset(self) -> None:
        """Forget the samples so far, because the connection was opened again."""
        self._last = None
        self._waiting = []

    def admit(self, arrival: Arrival) -> list[Arrival]:
        """Take an arrival; return those that are believed now, in order."""
        last, waiting = self._last, self._waiting
        newest = waiting[-1] if waiting else last
        if newest is not None and newest.sample == arrival.sample:
            self.duplicates += 1
            return []
        if last is not None and self._follows(last, arrival) and self._near(last, arrival):
            self.rejected += len(waiting)
            return self._believe([arrival])
        if waiting and self._follows(waiting[-1], arrival):
            settled = self._near(waiting[-1], arrival)
            waiting.append(arrival)
            return self._believe(waiting) if settled or len(waiting) == WITNESSES else []
        self.rejected += len(waiting)
        self._waiting = [arrival]
        return []

    def _near(self, a: Arrival, b: Arrival) -> bool:
        return _change(a, b) <= max(self.tolerance, TOLERANCE_OF_CHANGE * self._change)

    def _believe(self, arrivals: list[Arrival]) -> list[Arrival]:
        for arrival in arrivals:
            if self._last is not None:
                # A single leap must not make leaps usual, so its size is limited.
                limit = 4 * max(self.tolerance, TOLERANCE_OF_CHANGE * self._change)
                self._change += CHANGE_SHARE * (min(_change(self._last, arrival), limit) - self._change)
            self._last = arrival
        self._waiting = []
        return arrivals


def _change(a: Arrival, b: Arrival) -> float:
    return max(abs(b.sample.x - a.sample.x), abs(b.sample.y - a.sample.y))


def mcu_follows(a: Arrival, b: Arrival, period_ms: float | None) -> bool:
    """Whether one sample may follow another in the same run of the MCU (period None: its rate is not known).

    Judged by number, the MCU's time, the host's time, temperature and status.
    """
    ahead = (b.sample.sequence - a.sample.sequence) & 0xFFFF
    elapsed = (b.sample.milliseconds - a.sample.milliseconds) & 0xFFFFFFFF
    if not ahead or b.sample.status & SampleStatus.FIRST:
        return False
    # The end of a fault must be confirmed by a second sample.
    if _temperature_leaps(a.sample, b.sample) or a.sample.status & FAULTS & ~b.sample.status:
        return False
    low, high = (SHORTEST_MS, LONGEST_MS) if period_ms is None else (period_ms, period_ms)
    if not low * ahead - PERIOD_TOLERANCE_MS <= elapsed <= high * ahead + PERIOD_TOLERANCE_MS:
        return False
    apart_s = b.moment.monotonic_s - a.moment.monotonic_s
    return abs(elapsed * 1e-3 - apart_s) <= HOST_TOLERANCE_S + HOST_TOLERANCE_SHARE * apart_s


def _temperature_leaps(a: Sample, b: Sample) -> bool:
    known = not (a.status | b.status) & SampleStatus.NO_TEMPERATURE
    return known and abs(b.temperature - a.temperature) > TEMPERATURE_TOLERANCE


class Continuity:
    """Continues the sequence numbers over wraps and resets of the MCU, and counts the lost samples."""

    def __init__(self) -> None:
        self.lost = self.restarts = 0
        self._last: Sample | None = None
        self._last_raw_sequence = 0
        self._resumed = False

    def resume(self) -> None:
        """Note that the connection was opened again: the next sample does not continue the last one."""
        self._resumed = self._last is not None

    def follow(self, sample: Sample) -> Sample:
        """Return the sample with its continued sequence, and `lost`, `restarted` and `resumed` filled in."""
        last = self._last
        lost, restarted, step = 0, False, 1
        if last is not None:
            elapsed = (sample.milliseconds - last.milliseconds) & 0xFFFFFFFF
            ahead = (sample.sequence - self._last_raw_sequence) & 0xFFFF
            # A serial line keeps the order: a clock that goes back, or a first sample, means a reset.
            restarted = bool(sample.status & SampleStatus.FIRST) or elapsed >= 1 << 31
            if restarted:
                self.restarts += 1
            else:
                step = ahead or (1 if self._resumed else 1 << 16)
                lost = step - 1
                self.lost += lost
        sequence = sample.sequence if last is None else (last.sequence + step) & 0xFFFFFFFF
        self._last_raw_sequence = sample.sequence
        self._last = replace(sample, sequence=sequence, lost=lost, restarted=restarted, resumed=self._resumed)
        self._resumed = False
        return self._last
