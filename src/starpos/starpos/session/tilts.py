# SPDX-License-Identifier: Apache-2.0
"""The tilts of a session: which are kept, who publishes them, and their average over an exposure.

Any ROS node may publish on `tilt`, and mixed readings of two inclinometers make confident wrong fixes: while two are
heard, neither is used. A killed publisher stays in the graph for a while, so only received messages count. Publishers
are distinguished by the frame of their messages and by DDS's message numbers, which grow with each message of one
publisher.
"""

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from starpos.errors import TiltError, TiltRangeError
from starpos.instrument import tilt_log
from starpos.instrument.inclinometer import Tilt
from starpos.messages.stamp import stamp_to_unix
from starpos.messages.tilt import OUT_OF_RANGE, SATURATED, STUCK, UNUSABLE, message_to_tilt
from starpos.session import reports
from starpos.session.driver import Now, Sent, name_in
from starpos.session.settings import Settings

# Number of samples from which the noise is measured.
STEPS_KEPT = 2000


class TiltSteps:
    """Differences of neighbouring samples, in order of time: the newest STEPS_KEPT of them."""

    def __init__(self) -> None:
        self._number = self._axes = 0
        # time of the later sample, stated variance, difference of up to three axes; twice as long as what is kept
        self._rows = np.empty((2 * STEPS_KEPT, 5))

    def clear(self) -> None:
        self._number = 0

    def record(self, before: Tilt, sample: Tilt) -> None:
        """Take two successive samples, if they are neighbours in time."""
        apart_s = sample.utc_unix_s - before.utc_unix_s
        # a repeated sample adds nothing, and counting it would distort the noise
        if self._number and sample.utc_unix_s <= self._rows[self._number - 1, 0]:
            return
        if not 0 < apart_s < tilt_log.NEIGHBOURS_S or sample.axes != before.axes:
            return
        # of another number of axes they are of another sensor
        if sample.axes != self._axes:
            self._axes, self._number = sample.axes, 0
        if self._number == len(self._rows):
            self._rows[:STEPS_KEPT] = self._rows[STEPS_KEPT:]
            self._number = STEPS_KEPT
        row = self._rows[self._number]
        row[0], row[1] = sample.utc_unix_s, np.diag(sample.covariance).mean()
        row[2 : 2 + self._axes] = sample.theta - before.theta
        self._number += 1

    def forget_after(self, unix_s: float) -> None:
        """Drop the steps to samples of later times."""
        self._number = int(np.searchsorted(self._rows[: self._number, 0], unix_s, side="right"))

    def excess(self, end_unix_s: float) -> float:
        """Measured noise over the stated one, 1 or more, by samples up to a time."""
        rows = self._until(end_unix_s)
        if not len(rows):
            return 1.0
        steps = tilt_log.without_copies(rows[:, 2 : 2 + self._axes])
        return tilt_log.noise_excess(steps, float(np.sqrt(rows[:, 1].mean())))

    def until(self, end_unix_s: float) -> np.ndarray:
        """The differences (N, 2) of X', Y' of samples up to a time, rad."""
        return self._until(end_unix_s)[:, 2:4]

    def _until(self, end_unix_s: float) -> np.ndarray:
        rows = self._rows[max(self._number - STEPS_KEPT, 0) : self._number]
        return rows[: np.searchsorted(rows[:, 0], end_unix_s, side="right")]


# time after which a single publisher is used again: a minimum, periods of the other if it sent seldom, a maximum
ALONE_S, ALONE_PERIODS, MAX_ALONE_S = 1.0, 2.5, 10.0
# highest rate of an inclinometer; it bounds how many messages between two received ones can be lost
MAX_HZ = 500.0


@dataclass
class _Voice:
    """One publisher as known from its messages: their frame, the last one's number, arrival and interval."""

    frame_id: str
    number: int | None
    heard_s: float
    period_s: float = 0.0

    def speaks(self, now_s: float) -> bool:
        """Whether it may be going on."""
        silence_s = min(max(ALONE_S, ALONE_PERIODS * self.period_s), MAX_ALONE_S)
        return abs(now_s - self.heard_s) <= silence_s


class TiltPublishers:
    """Notes every message and says whether its publisher is the only one."""

    def __init__(self) -> None:
        self._voices: list[_Voice] = []
        self._speaking: list[_Voice] = []

    def note(self, frame_id: str, number: int | None, now_s: float) -> None:
        """Note a message; number: its number among its publisher's messages, None where the middleware gives none."""
        mine = self._voice_of(frame_id, number, now_s) or _Voice(frame_id, number, now_s)
        mine.number, mine.heard_s, mine.period_s = number, now_s, abs(now_s - mine.heard_s)
        # one that sends seldom is remembered, to learn how seldom
        others = [v for v in self._voices if v is not mine and abs(now_s - v.heard_s) <= MAX_ALONE_S]
        self._voices = [*others, mine]
        self._speaking = [v for v in self._voices if v.speaks(now_s)]

    def _voice_of(self, frame_id: str, number: int | None, now_s: float) -> _Voice | None:
        """The publisher that this message continues: among equal candidates one still speaking rather than an old one.

        A number that is ahead by more than messages can have been lost is another publisher's.
        """
        of_frame = [v for v in self._voices if v.frame_id == frame_id]
        if number is None:
            return of_frame[0] if of_frame else None
        before = [
            v
            for v in of_frame
            if v.number is not None and v.number < number <= v.number + 1 + abs(now_s - v.heard_s) * MAX_HZ
        ]
        return max(before, key=lambda v: (v.number, v.speaks(now_s), v.heard_s), default=None)

    @property
    def several(self) -> str:
        """A sentence that names the publishers heard at the same time; '' if there is only one."""
        if len(self._speaking) < 2:
            return ""
        frames = sorted({v.frame_id for v in self._speaking})
        named = " and ".join(map(repr, frames)) if len(frames) > 1 else f"both with the frame {frames[0]!r}"
        return (
            f"{len(self._speaking)} inclinometers publish on tilt ({named}): stop all but one, or give each instrument a "
            "namespace of its own"
        )


# Ten minutes at 10 Hz.
CAPACITY = 6000
# Number of samples from which delay and period are taken; a sample that arrives later than LATEST_S is of another clock.
USUAL, LATEST_S = 10, 2.0
# Time that a frame waits for its tilts, or multiple of the tilts' usual delay.
PATIENCE_S, DELAYS = 0.5, 1.5
# Between two samples of one exposure at most this number of others arrives.
TOGETHER = 20
# Samples this near to an exposure may bracket it; a flagged one explains why there is no good one.
NEAR_S = tilt_log.BRACKET_S
# Tolerated disorder of one inclinometer's samples; a sample that arrives after others with later times shows that those
# were stamped by a clock ahead.
ORDER_S = 1.0
# Assumed time between samples if there are too few, and the share of it by which the next may come early.
USUAL_PERIOD_S, JITTER = 0.1, 0.9
# Tilts that wait for a clock.
MAX_EARLY = 1000


class TiltBuffer:
    """Keeps the latest samples, in any order; keeps unusable ones only to explain a missing tilt.

    An exposure of 0 is not known: samples of tilt_window count in its place.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # of the last message; '' before the first one
        self.frame_id = ""
        self.clear()

    def __len__(self) -> int:
        return len(self._good)

    def clear(self) -> None:
        """Forget all samples, and who has published them."""
        # Each with the number of its arrival.
        self._good: deque[tuple[int, Tilt]] = deque(maxlen=CAPACITY)
        self._came, self._latest_unix_s = 0, -np.inf
        self._flagged: deque[tuple[float, int]] = deque(maxlen=CAPACITY)
        self._steps = TiltSteps()
        # how late each of the newest came, and the time between it and the one before
        self._late_s: deque[float] = deque(maxlen=USUAL)
        self._apart_s: deque[float] = deque(maxlen=USUAL)
        # those ahead of a clock that may have been heard only after them
        self._early: deque[Any] = deque(maxlen=MAX_EARLY)
        self.forget_publishers()

    def forget_publishers(self) -> None:
        """Forget who has published, but no samples: whoever publishes next is alone at first."""
        self._publishers = TiltPublishers()

    @property
    def waits(self) -> bool:
        """Whether a tilt waits for its time."""
        return bool(self._early)

    def receive(self, message: Any, sent: Sent, now: Now) -> None:
        """Keep a Tilt, or have one of recorded data that is ahead of a clock heard late wait for `pop_early`.

        TiltError if it is broken or of the future, and while two publish: it is unknown which samples are the
        instrument's own, so none is kept.
        """
        if sent.unix_s is not None and not now.played:
            # A process that stood still may read it only when its time has come.
            now = replace(now, unix_s=sent.unix_s if now.unix_s is None else min(sent.unix_s, now.unix_s))
        self._publishers.note(message.header.frame_id, sent.number, now.waiting_s)
        if several := self._publishers.several:
            self._good.clear()
            self._steps.clear()
            raise TiltError(several)
        if now.played and now.ahead_s(stamp_to_unix(message.header.stamp)) > reports.AHEAD_S:
            self._early.append(message)
        else:
            self.keep_in_time(message, now)

    def pop_early(self) -> list[Any]:
        """The messages that waited for their time; none waits any more."""
        early = list(self._early)
        self._early.clear()
        return early

    def keep_in_time(self, message: Any, now: Now) -> None:
        """Keep a Tilt, unless it is of the future: the instrument may lean otherwise when its time comes."""
        if (ahead_s := now.ahead_s(stamp_to_unix(message.header.stamp))) > reports.AHEAD_S:
            raise TiltError(f"a tilt is stamped {ahead_s:.3g} s in the future: {reports.ONE_CLOCK}")
        self.keep(message)
        self._late_s.append(max(-ahead_s, 0.0))
        self.frame_id = name_in(message)

    def keep(self, message: Any) -> None:
        """Keep a sample; TiltError if the message is broken."""
        if message.flags & UNUSABLE:
            self._flagged.append((stamp_to_unix(message.header.stamp) or 0.0, message.flags))
            return
        sample = message_to_tilt(message, self._settings.tilt_stddev_rad)
        if self._good:
            before = self._good[-1][1]
            self._steps.record(before, sample)
            self._apart_s.append(abs(sample.utc_unix_s - before.utc_unix_s))
        self.forget_after(sample.utc_unix_s + ORDER_S)
        self._came += 1
        self._good.append((self._came, sample))
        self._latest_unix_s = max(self._latest_unix_s, sample.utc_unix_s)

    def forget_after(self, unix_s: float) -> None:
        """Drop later samples: their clock was ahead, and the instrument may lean otherwise by then."""
        if self._latest_unix_s > unix_s:
            self._latest_unix_s = unix_s
            self._good = deque((s for s in self._good if s[1].utc_unix_s <= unix_s), maxlen=CAPACITY)
            # A night that is played again comes from here on: its steps count once, as when it was played first.
            self._steps.forget_after(unix_s - ORDER_S)

    @property
    def delay_s(self) -> float:
        """Longest usual time until the sample after a moment arrives; 0 while unknown."""
        if not self._late_s or not self._apart_s:
            return 0.0
        late_s, apart_s = max(self._late_s), float(np.median(self._apart_s))
        return late_s + apart_s if late_s < LATEST_S and apart_s < tilt_log.BRACKET_S else 0.0

    @property
    def patience_s(self) -> float:
        """How long a frame waits for its tilts, s: as tilt_timeout says, or by the tilts' own delay."""
        stated_s: float = self._settings.values["tilt_timeout"]
        return max(PATIENCE_S, DELAYS * self.delay_s) if math.isnan(stated_s) else stated_s

    def complete(self, mid_unix_s: float, exposure_s: float) -> bool:
        """Whether all samples that an exposure needs have arrived: none that may still come lies in it or bounds it."""
        span_s = exposure_s or self._settings.values["tilt_window"]
        times = [s.utc_unix_s for s in self._near(mid_unix_s, span_s)]
        end = mid_unix_s + span_s / 2
        if not times or times[-1] >= end:
            return bool(times)
        period = float(np.median(np.diff(times))) if len(times) > 2 else USUAL_PERIOD_S
        # a sample after the exposure is needed if the last one inside leaves much of it uncovered
        return times[-1] >= max(end - JITTER * period, end - tilt_log.OPEN_END * span_s)

    def _near(self, mid_unix_s: float, span_s: float) -> list[Tilt]:
        """The samples near an exposure in order of time, however they came; none counts twice.

        Only samples that arrived together count. After a clock was set back there may be old samples of the same time,
        from when the instrument perhaps leaned otherwise.
        """
        near: dict[float, Tilt] = {}
        reach, last = span_s / 2 + NEAR_S, 0
        for came, sample in reversed(self._good):
            # those before it are hardly later
            if sample.utc_unix_s < mid_unix_s - reach - ORDER_S:
                break
            if abs(sample.utc_unix_s - mid_unix_s) <= reach:
                if near and came < last - TOGETHER:
                    break
                near.setdefault(sample.utc_unix_s, sample)
                last = came
        return [near[t] for t in sorted(near)]

    def average(self, mid_unix_s: float, exposure_s: float, spread_s: float = 0.0) -> Tilt:
        """Average over an exposure; TiltRangeError or TiltError with the reason if it is impossible."""
        span_s = exposure_s or self._settings.values["tilt_window"]
        if several := self._publishers.several:
            raise TiltError(several)
        near = self._near(mid_unix_s, span_s)
        inside = [
            k for k, s in enumerate(near) if abs(s.utc_unix_s - mid_unix_s) <= span_s / 2 + tilt_log.TOUCH_S
        ]
        if not inside:
            self._explain(mid_unix_s, span_s, bool(near))
        else:
            # Later samples must not count, because their number depends on chance; one may be waited for.
            open_end = mid_unix_s + span_s / 2 - near[inside[-1]].utc_unix_s > tilt_log.OPEN_END * span_s
            near = near[max(inside[0] - 1, 0) : inside[-1] + 1 + open_end]
        # by samples up to the exposure's end: the number since then depends on chance
        end = mid_unix_s + span_s / 2
        earlier = {
            "earlier_excess": self._steps.excess(end),
            "earlier_copies": tilt_log.copies(self._steps.until(end)),
        }
        tilt = tilt_log.TiltLog.of_readings(near, **earlier).average(mid_unix_s, span_s)
        return replace(tilt, step_rad=self._coarse_step(near))

    def _coarse_step(self, used: list[Tilt]) -> float:
        """`coarse_step` of the samples used, by these and those before."""
        end = used[-1].utc_unix_s
        moves = self._steps.until(end)
        most = tilt_log.STUCK_READINGS * tilt_log.copies(moves)
        until = (s for _, s in reversed(self._good) if s.utc_unix_s <= end)
        before = np.array([s.theta[:2] for s in itertools.islice(until, most)])
        repeats = np.ptp(before, axis=0) == 0 if len(before) == most else np.zeros(2, bool)
        # The source of an inclinometer flags one that is stuck, and other people's may publish a mean that repeats. The
        # messages of an accelerometer, which has three axes, have no such flag. Zeros, and noise before, are of no mean.
        if used[-1].axes == 2 and not moves.any() and before.any():
            repeats[:] = False
        noise = math.sqrt(np.mean([np.diag(s.covariance) for s in used]))
        theta = np.array([s.theta[:2] for s in used])
        return tilt_log.coarse_step(theta, tilt_log.without_copies(moves), repeats, noise)

    def _explain(self, mid_unix_s: float, span_s: float, others_near: bool) -> None:
        """Raise the reason why no sample lies in an exposure; return if others that are near it may bracket it."""
        flags = 0
        for moment, flag in self._flagged:
            if abs(moment - mid_unix_s) <= span_s / 2 + NEAR_S:
                flags |= flag
        if flags & (OUT_OF_RANGE | SATURATED):
            raise TiltRangeError(
                "tilt: the inclinometer is beyond its range: set the instrument more upright"
            )
        if flags & STUCK:
            raise TiltError("tilt: the inclinometer repeats the same value: check its converter's wiring")
        if flags and not others_near:
            raise TiltError(
                "tilt: when the inclinometer's readings were taken is not known: its process or its link stood still"
            )
        if others_near:
            return
        nearest = min((abs(s.utc_unix_s - mid_unix_s) for _, s in self._good), default=None)
        known = "none has arrived at all" if nearest is None else f"the nearest is {nearest:.1f} s off"
        raise TiltError(f"tilt: no sample near the exposure ({known}): check the inclinometer and the clocks")
