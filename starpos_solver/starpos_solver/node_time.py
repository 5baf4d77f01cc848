# SPDX-License-Identifier: Apache-2.0
"""How far a stamp is ahead of the node's clock, which may be played on /clock, and tilts that came before their time."""

from collections import deque
from collections.abc import Callable

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

from starpos_common.clock_report import time_is_simulated

# Times that differ by more are not of the same evening.
ANOTHER_TIME_S = 3600.0
# A clock that goes back by so much was set.
STEP_NS = 50_000_000
TICK = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=None)


class NodeTime:
    """The node's clock, as its messages are judged by it.

    A clock that is played is heard on a topic: on a busy machine the messages that it dates may be read before it. What
    is ahead of such a clock waits for the next that is heard of it, which is that of the messages or a later one.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # This node's clock when the last message came.
        self._was_ns = 0
        self._early: deque[Callable[[], None]] = deque(maxlen=1000)
        self._tick = node.get_clock().create_jump_callback(TICK, post_callback=lambda _: self._judge_early())

    @property
    def played(self) -> bool:
        """Whether the time is that of /clock."""
        return time_is_simulated(self._node)

    def ahead_s(self, unix_s: float | None) -> float:
        """How far a time is ahead of this node's clock (s); 0 if one of them is not known (no /clock yet).

        It is also 0 if the two are not of the same evening: a night is played without /clock, or the robot does not
        know the date.
        """
        now_ns = self._node.get_clock().now().nanoseconds
        if unix_s is None or not now_ns:
            return 0.0
        ahead_s = unix_s - now_ns * 1e-9
        return 0.0 if ahead_s > ANOTHER_TIME_S and not self.played else ahead_s

    def at_next_tick(self, judge: Callable[[], None]) -> None:
        """Call `judge` once when /clock was heard again."""
        self._early.append(judge)

    def _judge_early(self) -> None:
        early, self._early = self._early, deque(maxlen=self._early.maxlen)
        for judge in early:
            judge()

    def set_back_to(self) -> float | None:
        """The node's time (Unix s) if its clock was set back since the last call; None if it was not."""
        now_ns = self._node.get_clock().now().nanoseconds
        back, self._was_ns = now_ns < self._was_ns - STEP_NS, now_ns
        return now_ns * 1e-9 if back else None
