# SPDX-License-Identifier: Apache-2.0
"""Middle of an exposure from the time that a GenICam camera tells of it, on its own clock."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from starpos_camera.sources.timing import Stamp, middle_of_commanded, middle_of_started
from starpos_interfaces.msg import Capture

# Between a camera's time and the moment of the light, where the clocks are related.
TIMESTAMP_STDDEV_S = 1e-3
# By so much a stamp may contradict the times of trigger and arrival.
TOLERANCE_S = 5e-3


@dataclass(frozen=True)
class ClockRelation:
    """Host's clock minus camera's clock (s), and its standard deviation."""

    offset_s: float
    stddev_s: float


@dataclass(frozen=True)
class FrameTimes:
    """What is known of the time of one frame; all but camera_s in Unix seconds of the node's clock.

    commanded_s  time just before the software trigger; None: a line has triggered
    received_s   arrival of the frame's first or last data
    camera_s     the frame's time on the camera's clock; None: it tells none
    relation     None: the camera does not let its clock be read
    """

    exposure_s: float
    commanded_s: float | None
    received_s: float
    camera_s: float | None
    relation: ClockRelation | None


def stamp_of_camera(times: FrameTimes, moment: str, values: Mapping) -> Stamp:
    """Choose the better stamp: from the camera's time, or from command or arrival alone.

    moment: start, end or unknown: the moment of the exposure that the camera's times are of.
    """
    otherwise = _by_host(times, values)
    if times.camera_s is None:
        return otherwise
    at_s, stddev_s = _on_host_clock(times)
    if math.isnan(at_s):
        return otherwise
    earliest_s = -math.inf if times.commanded_s is None else times.commanded_s - TOLERANCE_S
    half_s = times.exposure_s / 2
    middles_s = {"start": at_s + half_s, "end": at_s - half_s}
    possible = [
        name
        for name, mid_s in middles_s.items()
        if mid_s - half_s >= earliest_s and mid_s + half_s <= times.received_s + TOLERANCE_S
    ]
    wanted = [name for name in possible if moment in (name, "unknown")]
    if not wanted:
        told = "its times of frames contradict those of trigger and arrival, and are not used"
        return replace(otherwise, remark=told)
    middle_s = sum(middles_s[name] for name in wanted) / len(wanted)
    if len(wanted) > 1:
        stddev_s = math.hypot(stddev_s, half_s)
    if stddev_s > otherwise.stddev_s:
        return otherwise
    return Stamp(middle_s, stddev_s, Capture.HARDWARE)


def _by_host(times: FrameTimes, values: Mapping) -> Stamp:
    """Stamp from the command, or from the arrival of a frame that a line has triggered."""
    if times.commanded_s is not None:
        return Stamp(*middle_of_commanded(times.commanded_s, times.exposure_s, values), Capture.COMMAND)
    start_s = times.received_s - times.exposure_s
    return Stamp(*middle_of_started(start_s, 0.0, times.exposure_s, values), Capture.DRIVER)


def _on_host_clock(times: FrameTimes) -> tuple[float, float]:
    """The camera's time of a frame on the host's clock, and its standard deviation (s); NaN: the clocks are not related.

    A camera whose clock cannot be read may keep UTC (PTP), but nobody states how well. Exposure and stamp then lie
    anywhere between trigger and arrival: the error is the one of a stamp at either edge.
    """
    assert times.camera_s is not None
    if times.relation is not None:
        stddev_s = math.hypot(times.relation.stddev_s, TIMESTAMP_STDDEV_S)
        return times.camera_s + times.relation.offset_s, stddev_s
    if times.commanded_s is None or not times.commanded_s <= times.camera_s <= times.received_s + TOLERANCE_S:
        return math.nan, math.nan
    slack_s = max(0.0, times.received_s - times.commanded_s - times.exposure_s)
    return times.camera_s, math.hypot(slack_s / math.sqrt(3), TIMESTAMP_STDDEV_S)
