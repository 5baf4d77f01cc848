# SPDX-License-Identifier: Apache-2.0
"""Which pulse of a shutter belongs to which frame, and the lag of the camera that the pulses show.

A pulse is paired with a frame only if it is unambiguous. It is the only one between the command and the frame's arrival,
and no edge near it was lost. Its lag after the command and its length are as in earlier frames of the camera. Until
enough frames agree, none is paired. So a pulse that is missed, doubled, from a flash fired by hand or from a spark costs
a frame its hardware time, and never gives it a wrong one.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median, stdev

from starpos.units import SIGMA_PER_MAD

# Frames that must agree before a pulse is believed.
LEARNED = 5
# Number of the last frames that determine the camera's lag.
KEPT = 30
# Lags within this of the usual one are the camera's own; a camera whose lag scatters more is not paired.
MIN_LAG_SPREAD_S, MAX_LAG_SPREAD_S = 0.005, 0.05
# The same of lengths. A spark just before the contact closes makes a pulse begin early, and longer by the same time.
MIN_LENGTH_SPREAD_S, MAX_LENGTH_SPREAD_S = 0.0001, 0.002
# The camera's own scatter is within this many robust standard deviations.
SIGMAS = 4.0
# Time by which a driver may report the begin of an exposure too late.
EARLY_S = 0.1
# Number of edges that are remembered: 2000 frames.
EDGES = 4000


@dataclass(frozen=True, slots=True, kw_only=True)
class Edge:
    """An edge of the shutter: when it came (Unix s) and how far that may be off; `sequence` counts the edges.

    rising: of a contact that closes to ground, that it opened.  disciplined: the time is a GNSS receiver's.
    """

    time_s: float
    stddev_s: float
    rising: bool
    sequence: int
    disciplined: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class ShutterPulse:
    """One closing and opening of the contact: begin (Unix s), length (s)."""

    begin_s: float
    length_s: float
    stddev_s: float
    disciplined: bool


@dataclass(frozen=True, slots=True)
class Lag:
    """Lag of the camera from the command, or a driver's begin: median and standard deviation of `frames`."""

    median_s: float
    stddev_s: float
    frames: int


class ShutterPulses:
    """Pairs the pulses of one camera's shutter with its frames."""

    def __init__(self) -> None:
        self._edges: deque[Edge] = deque(maxlen=EDGES)
        self._exposure_s = -1.0
        # (lag, length) of frames that had one pulse only.
        self._seen: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def record(self, edge: Edge) -> None:
        """Record an edge, in the order of their sequence."""
        self._edges.append(edge)

    def pair(self, told_s: float, exposure_s: float, since_s: float, until_s: float) -> ShutterPulse | str:
        """Find the pulse of a frame, or say in a sentence why it has none.

        told_s: its begin by the command, or as a driver reported it.  since_s, until_s: when it was commanded and had
        arrived: no other frame of this camera was exposed between them. All in Unix s.
        """
        if exposure_s != self._exposure_s:
            # Another length, and perhaps another mode of the shutter.
            self._seen.clear()
            self._exposure_s = exposure_s
        begin_s = max(since_s, told_s - EARLY_S)
        near = self._around(begin_s, until_s)
        if any(b.sequence != a.sequence + 1 or a.rising == b.rising for a, b in pairwise(near)):
            return "edges of the shutter were lost near it"
        pulses = [(a, b) for a, b in pairwise(near) if b.rising and begin_s <= a.time_s <= until_s]
        if not pulses:
            return "no pulse of the shutter came between the command and the frame"
        if len(pulses) > 1:
            return f"{len(pulses)} pulses of the shutter came between the command and the frame"
        ((closed, opened),) = pulses
        if closed.time_s > until_s - exposure_s:
            return "the pulse of the shutter came too late for the exposure to end in time"
        pulse = ShutterPulse(
            begin_s=closed.time_s,
            length_s=opened.time_s - closed.time_s,
            stddev_s=max(closed.stddev_s, opened.stddev_s),
            # a length across two clocks is not valid
            disciplined=closed.disciplined and opened.disciplined,
        )
        lag_s = pulse.begin_s - told_s
        usual = self._agreeing()
        self._seen.append((lag_s, pulse.length_s))
        if not usual:
            return f"fewer than {LEARNED} frames agree on the camera's lag yet"
        return _doubt(lag_s, pulse.length_s, usual) or pulse

    @property
    def lag(self) -> Lag | None:
        """The camera's lag, from the frames with one pulse each that agree; None while too few do."""
        agreeing = self._agreeing()
        if not agreeing:
            return None
        lags = [lag for lag, _ in agreeing]
        return Lag(median(lags), stdev(lags), len(lags))

    def _agreeing(self) -> list[tuple[float, float]]:
        """Lags and lengths of the frames that agree; empty while they are few, or not the most."""
        if not self._seen:
            return []
        lag_s, length_s = (median(values) for values in zip(*self._seen, strict=True))
        agreeing = [
            (lag, length)
            for lag, length in self._seen
            if abs(lag - lag_s) <= MAX_LAG_SPREAD_S and abs(length - length_s) <= MAX_LENGTH_SPREAD_S
        ]
        return agreeing if len(agreeing) >= LEARNED and 2 * len(agreeing) > len(self._seen) else []

    def _around(self, begin_s: float, until_s: float) -> deque[Edge]:
        """The edges between two times, the last one before, and the first one after."""
        near: deque[Edge] = deque()
        for edge in reversed(self._edges):
            if edge.time_s > until_s:
                near.clear()
            near.appendleft(edge)
            if edge.time_s < begin_s:
                break
        return near


def _doubt(lag_s: float, length_s: float, usual: list[tuple[float, float]]) -> str:
    """Say why a pulse is not the camera's own, by its lag and length compared with the usual ones; '' if it may be."""
    lags, lengths = zip(*usual, strict=True)
    lag, length = median(lags), median(lengths)
    if abs(lag_s - lag) > _spread(lags, lag, MIN_LAG_SPREAD_S, MAX_LAG_SPREAD_S):
        return f"its pulse came {lag_s:.3f} s after the command where others come after {lag:.3f} s"
    if abs(length_s - length) > _spread(lengths, length, MIN_LENGTH_SPREAD_S, MAX_LENGTH_SPREAD_S):
        return f"its pulse lasted {length_s:.4f} s where others last {length:.4f} s"
    return ""


def _spread(values: Sequence[float], middle: float, least: float, most: float) -> float:
    """How far a value may be from the median; robust, because a wrong one must not open the door to others."""
    return min(max(SIGMAS * SIGMA_PER_MAD * median([abs(v - middle) for v in values]), least), most)
