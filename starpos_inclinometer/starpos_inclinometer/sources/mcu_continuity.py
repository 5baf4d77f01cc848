# SPDX-License-Identifier: Apache-2.0
"""Which samples belong together: the ones that fit no others are dropped, the lost ones counted.

A 16-bit checksum lets one corrupted line in 65,536 pass, a line without checksum far more. What passes does not
fit the samples around it: its number, its time or its tilt is off.
"""

from collections.abc import Callable
from dataclasses import replace

from starpos_inclinometer.sources.mcu_protocol import Sample, SampleStatus
from starpos_inclinometer.sources.reading import Arrival

TOLERANCE_OF_CHANGE = 8.0  # times the usual change from sample to sample is still near
CHANGE_SHARE = 1 / 8  # of a sample in the usual change
WITNESSES = 3  # samples in a row that are believed though no two are near each other: the instrument moves

PERIOD_TOLERANCE_MS = 2  # both ends are floored to ms
SHORTEST_MS, LONGEST_MS = 20, 1000  # periods of the rates there are
TEMPERATURE_TOLERANCE = 3  # counts: 2.8 deg C from one sample to the next
FAULTS = SampleStatus.ADC_TIMEOUT | SampleStatus.NO_REFERENCE
HOST_TOLERANCE_S, HOST_TOLERANCE_SHARE = 3.0, 0.05  # a stalled host, an MCU's RC oscillator


class Gate:
    """Lets samples pass that fit the last one; others wait until the ones after them bear them out, or are dropped.

    follows: whether the second arrival may come after the first, by all but `x` and `y`.  tolerance: how far these may
    go from one sample to the next without suspicion; what the instrument does lately is none either.
    """

    def __init__(self, follows: Callable[[Arrival, Arrival], bool], tolerance: float):
        self.rejected = self.duplicates = 0
        self._follows = follows
        self._tolerance = tolerance
        self._change = 0.0
        self._last: Arrival | None = None
        self._waiting: list[Arrival] = []

    def reset(self):
        """Trust nothing from before: the connection was opened anew."""
        self._last = None
        self._waiting = []

    def admit(self, arrival: Arrival) -> list[Arrival]:
        """The arrivals that are believed now that this one is there, in order."""
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
        return _change(a, b) <= max(self._tolerance, TOLERANCE_OF_CHANGE * self._change)

    def _believe(self, arrivals: list[Arrival]) -> list[Arrival]:
        for arrival in arrivals:
            if self._last is not None:
                # One leap is no habit: it counts as four times what is near.
                limit = 4 * max(self._tolerance, TOLERANCE_OF_CHANGE * self._change)
                self._change += CHANGE_SHARE * (min(_change(self._last, arrival), limit) - self._change)
            self._last = arrival
        self._waiting = []
        return arrivals


def _change(a: Arrival, b: Arrival) -> float:
    return max(abs(b.sample.x - a.sample.x), abs(b.sample.y - a.sample.y))


def mcu_follows(a: Arrival, b: Arrival, period_ms: float | None) -> bool:
    """Whether a Sample may come after another of the same run of the MCU, at its rate (None: not known).

    By number, MCU's time, host's time, temperature and status.
    """
    ahead = (b.sample.sequence - a.sample.sequence) & 0xFFFF
    elapsed = (b.sample.milliseconds - a.sample.milliseconds) & 0xFFFFFFFF
    if not ahead or b.sample.status & SampleStatus.FIRST:
        return False
    if _temperature_leaps(a.sample, b.sample) or a.sample.status & FAULTS & ~b.sample.status:
        return False  # that a fault is over has to be said twice
    low, high = (SHORTEST_MS, LONGEST_MS) if period_ms is None else (period_ms, period_ms)
    if not low * ahead - PERIOD_TOLERANCE_MS <= elapsed <= high * ahead + PERIOD_TOLERANCE_MS:
        return False
    apart_s = b.moment.monotonic_s - a.moment.monotonic_s
    return abs(elapsed * 1e-3 - apart_s) <= HOST_TOLERANCE_S + HOST_TOLERANCE_SHARE * apart_s


def _temperature_leaps(a: Sample, b: Sample) -> bool:
    known = not (a.status | b.status) & SampleStatus.NO_TEMPERATURE
    return known and abs(b.temperature - a.temperature) > TEMPERATURE_TOLERANCE


class Continuity:
    """Sequence numbers that count on over wraps and resets of the MCU, and what was lost on the way."""

    def __init__(self):
        self.lost = self.restarts = 0
        self._last: Sample | None = None
        self._last_raw_sequence = 0
        self._resumed = False

    def resume(self):
        """The connection was opened anew: what comes next claims no continuity."""
        self._resumed = self._last is not None

    def follow(self, sample: Sample) -> Sample:
        """The sample with its continued sequence, `lost`, `restarted`, `resumed`."""
        last = self._last
        lost, restarted, step = 0, False, 1
        if last is not None:
            elapsed = (sample.milliseconds - last.milliseconds) & 0xFFFFFFFF
            ahead = (sample.sequence - self._last_raw_sequence) & 0xFFFF
            # A serial line does not reorder: a clock that went back, or a first sample, is a reset.
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
