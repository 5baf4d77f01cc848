# SPDX-License-Identifier: Apache-2.0
"""Captures of other people's nodes, which know a frame's exposure and not what its stamp is."""

from types import SimpleNamespace

import numpy as np
import pytest

from starpos.errors import TimeError
from starpos.frames.frame import Frame
from starpos.messages.camera import ExposureFacts
from starpos.messages.stamp import PlainHeader, PlainStamp

S = 10**9
UNKNOWN, SIMULATED = 0, 5
START = {"stamp": "start", "stamp_stddev": 0.002, "exposure": 0.0, "readout": 0.0}


def header(at_s):
    return PlainHeader(PlainStamp(at_s, 0), "camera")


def capture(at_s, exposure, source):
    return SimpleNamespace(
        header=header(at_s), exposure=exposure, stamp_stddev=0.0, clock_stddev=0.0, stamp_source=source,
        shutter_known=False,
    )  # fmt: skip


def seen(facts, at_s):
    """PlainStamp in ns, and frame, of an image."""
    mid_ns, add = facts.of(header(at_s))
    return mid_ns, add(Frame(np.zeros((4, 4), np.uint8), mid_unix_s=float(at_s)))


def test_an_exposure_that_changes_from_frame_to_frame_moves_the_middle_of_each():
    facts = ExposureFacts(START)
    for at_s, exposure in ((100, 0.2), (101, 0.5)):
        facts.keep_capture(capture(at_s, exposure, UNKNOWN))
        mid_ns, frame = seen(facts, at_s)
        assert mid_ns == at_s * S + exposure / 2 * S and frame.mid_unix_s == mid_ns / S
        assert (frame.exposure_s, frame.stamp_stddev_s) == (exposure, 0.002)
    assert facts.missing_statement == ""
    # if one is lost its exposure is not taken from another frame
    mid_ns, frame = seen(facts, 102)
    assert (mid_ns, frame.exposure_s, frame.stamp_stddev_s) == (102 * S, None, 0.3)


@pytest.mark.parametrize(("source", "stamp"), [(SIMULATED, "start"), (UNKNOWN, "")])
def test_a_capture_that_knows_its_stamp_or_a_user_who_says_nothing_leaves_the_stamp_the_middle(source, stamp):
    facts = ExposureFacts(START | {"stamp": stamp})
    facts.keep_capture(capture(100, 0.2, source))
    mid_ns, frame = seen(facts, 100)
    assert (mid_ns, frame.exposure_s) == (100 * S, 0.2)


def test_a_middle_before_1970_is_refused():
    with pytest.raises(TimeError, match="before 1970"):
        ExposureFacts(START | {"stamp": "end", "exposure": 4.0}).of(header(1))
