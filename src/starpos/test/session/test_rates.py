# SPDX-License-Identifier: Apache-2.0
"""A session on one core at a camera's rates, by a clock of the test, while tilts are few and late.

The core takes a given time for an answer; meanwhile messages wait as in the middleware. Answers themselves are not
worked out: what counts is which frames get one, and when.
"""

import math
from copy import copy
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rosbags")

from test_session import CAMERA_INFO, STARS, TILT, Told, first, messages  # noqa: F401

from starpos.fix.solution import Solution, Status
from starpos.messages.stamp import stamp_to_unix
from starpos.recording.topics import INPUTS
from starpos.session.driver import Answered, Now, Sent

EXPOSURE_S, SECONDS, STEP_S = 0.03, 6.0, 0.004


def stamped(message, unix_s):
    made = copy(message)
    whole, part = divmod(round(unix_s * 1e6), 1_000_000)
    stamp = SimpleNamespace(sec=whole, nanosec=part * 1000)
    made.header = SimpleNamespace(stamp=stamp, frame_id=message.header.frame_id)
    return made


class Core:
    """One processor with a session, whose answers take cost_s each."""

    def __init__(self, messages, cost_s, *parameters):  # noqa: F811
        self.told, self.cost_s = Told("tilt_stddev:=0.0035", *parameters), cost_s
        self.session = self.told.session
        self.session._arrived = lambda name: self.come(INPUTS[name])
        self.session._answer = lambda frame, _: self.answer(frame)
        info, self.begin_s = first(messages, CAMERA_INFO)
        self.stars, self.tilt = first(messages, STARS)[0], first(messages, TILT)[0]
        self.stars.exposure = EXPOSURE_S
        self.told.tell(CAMERA_INFO, info, self.begin_s, played=False)
        for jobs in self.told.jobs:
            jobs.work()
        self.queues, self.answers = {STARS: [], TILT: []}, {}

    def answer(self, frame):
        try:
            self.session.tilts.average(frame.stars.mid_unix_s, EXPOSURE_S)
        except Exception as e:
            return Solution.failed(frame.stars, Status.NO_TILT, str(e))
        return Solution.failed(frame.stars, Status.NOT_IDENTIFIED, "not looked for")

    def come(self, kind):
        queue = self.queues[kind]
        while queue and queue[0][0] <= self.now_s:
            _, message, number = queue.pop(0)
            yield message, Sent(number)

    def run(self, frames_hz, tilts_hz, late_s):
        """Send frames and tilts; returns the share that is answered with its tilts, and how long (s) each took."""
        begin_s = self.begin_s + 10.0
        for kind, rate, late, message, before in (
            (STARS, frames_hz, 0.05, self.stars, 0.0),
            (TILT, tilts_hz, late_s, self.tilt, 1.0),
        ):
            times = begin_s + np.arange(int((SECONDS + 2 * before) * rate)) / rate - before
            self.queues[kind] = [(t + late, stamped(message, t), k) for k, t in enumerate(times)]
        self.now_s = begin_s - 1.0
        sent = len(self.queues[STARS])
        while self.now_s < begin_s + SECONDS + 2.0:
            made = []
            for kind in (TILT, STARS):
                # one message per topic has its turn, as with rclpy's executor
                message, told = next(self.come(kind), (None, None))
                if message is not None:
                    made += self.told.tell(kind, message, self.now_s, played=False, sent=told)
                    self.spend(made)
            if not made:
                made = self.session.at(Now(self.now_s, self.now_s))
                self.spend(made)
            if not made:
                self.now_s += STEP_S
        good = {t: took for t, (took, status) in self.answers.items() if status is Status.NOT_IDENTIFIED}
        return len(good) / sent, good

    def spend(self, made):
        for answered in made:
            if isinstance(answered, Answered) and (t := stamp_to_unix(answered.stamp)) not in self.answers:
                self.now_s += self.cost_s
                self.answers[t] = self.now_s - t, answered.solution.status


@pytest.mark.parametrize(
    ("frames_hz", "tilts_hz", "late_s"),
    [(10, 2, 0.3), (10, 10, 0.3), (30, 2, 0.3), (30, 10, 0.3), (30, 100, 0.005)],
)
def test_every_frame_is_answered_where_the_processor_can(messages, frames_hz, tilts_hz, late_s):  # noqa: F811
    share, took_s = Core(messages, 0.02).run(frames_hz, tilts_hz, late_s)
    # the last ones may have no tilt after them
    assert share > 0.97
    assert max(took_s.values()) < late_s + 1 / tilts_hz + 0.5


@pytest.mark.parametrize(
    ("frames_hz", "tilts_hz", "late_s", "cost_s"),
    [
        (30, 2, 0.3, 0.05),
        (30, 10, 0.3, 0.05),
        (60, 100, 0.005, 0.04),
        (10, 2, 0.3, 0.15),
        (100, 2, 0.3, 0.02),
    ],
)
def test_of_too_many_frames_an_even_share_is_answered_as_many_as_the_processor_can_and_soon(
    messages,  # noqa: F811
    frames_hz,
    tilts_hz,
    late_s,
    cost_s,
):
    core = Core(messages, cost_s)
    share, took_s = core.run(frames_hz, tilts_hz, late_s)
    can = 1 / (cost_s * frames_hz)
    assert 0.9 * can < share < 1.1 * can
    # once the session knows how long its answers take
    settled = [t for t in sorted(took_s) if t > core.begin_s + 13.0]
    assert max(np.diff(settled)) * frames_hz <= 2 * math.ceil(1 / can)
    # as late as tilts make it, and the answers before it
    assert max(took_s[t] for t in settled) < late_s + 1 / tilts_hz + 0.2 + 3 * cost_s
    assert core.session.pace.dropped + len(core.answers) == pytest.approx(SECONDS * frames_hz, abs=1)
    assert bool(core.session.pace.complaint) == (share < 0.5)


def test_frames_go_on_to_be_taken_while_no_tilts_come(messages):  # noqa: F811
    core = Core(messages, 0.02)
    core.run(30, 0.01, 0.0)
    assert len(core.answers) > 0.95 * SECONDS * 30


def test_a_rate_is_kept_and_no_complaint_is_made(messages):  # noqa: F811
    core = Core(messages, 0.02, "max_rate:=5.0")
    share, _ = core.run(30, 10, 0.02)
    assert share == pytest.approx(5 / 30, rel=0.05)
    assert core.session.pace.complaint == "" and core.session.pace.counts["left out by max_rate"] > 100


def test_a_wait_that_is_stated_is_kept(messages):  # noqa: F811
    share, took_s = Core(messages, 0.001, "tilt_timeout:=0.3").run(10, 2, 0.3)
    assert share < 0.5 and max(took_s.values()) < 0.5
