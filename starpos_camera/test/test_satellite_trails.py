# SPDX-License-Identifier: Apache-2.0
"""The detector's trails of satellites: of which frames, and where their ends are."""

from dataclasses import replace

import numpy as np
import pytest
from test_detector import Feed

from starpos.messages.stars import message_to_trails
from starpos_interfaces.msg import Solution, TrailArray

ENDS = np.array([[200.0, 120.0], [320.0, 210.0]])


@pytest.fixture
def crossed(frame):
    """The frame with a satellite's trail over it."""
    y, x = np.mgrid[: frame.height, : frame.width]
    light = frame.pixels.astype(float)
    for px, py in np.linspace(*ENDS, 600):
        light += 60 * np.exp(-((x - px) ** 2 + (y - py) ** 2) / 2.2)
    return replace(frame, pixels=np.clip(light, 0, 65535).astype(np.uint16))


def solution_of(stars, identified=True):
    """The solver's answer to a frame: all of its stars are identified, or none."""
    rows = [k for k, s in enumerate(stars.stars) if identified and not s.flags]
    return Solution(header=stars.header, ids=["TYC"] * len(rows), indices=rows, magnitudes=[8.0] * len(rows))


def test_trails_of_a_frame_that_the_solver_has_identified(listener, start, crossed):
    solver = listener.node.create_publisher(Solution, "solver/solution", 10)
    heard = listener.hear(TrailArray, "trails")
    feed = Feed(listener, start, "trails:=true")
    listener.wait(lambda: listener.node.count_publishers("trails"))
    shown = []

    def come(identified):
        # the first frames have no solution yet: the detector listens from the first one on
        stars = feed.show(crossed)
        listener.wait(solver.get_subscription_count)
        solver.publish(solution_of(stars, identified))
        shown.append(stars.header)
        return stars

    listener.wait(lambda: come(True) and heard)
    (trail,) = message_to_trails(heard[-1])
    assert heard[-1].header in shown
    assert trail.steady and not trail.cut.any()
    got = trail.ends[np.argsort(trail.ends[:, 0])]
    assert got == pytest.approx(ENDS, abs=0.5)
    # a frame without identified stars gives no message; the next one does
    lost = come(False).header
    count = len(heard)
    listener.wait(lambda: come(True) and len(heard) > count)
    assert lost not in [message.header for message in heard]
