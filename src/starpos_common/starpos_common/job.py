# SPDX-License-Identifier: Apache-2.0
"""Jobs of several seconds, done in a thread while the node goes on."""

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.task import Future

from starpos.session.job import Outcome, outcome_of


class JobRunner:
    """Runs one job at a time and gives its outcome back in the node's executor.

    then: called when the outcome has been delivered.
    """

    def __init__(self, node: Node, then: Callable[[], object] = lambda: None) -> None:
        self._node, self._then = node, then
        self._ended = node.create_guard_condition(self._on_ended)
        self._future: Future | None = None
        self._outcome: Outcome | None = None

    @property
    def busy(self) -> bool:
        return self._future is not None

    def run(self, job: Callable[[], Any]) -> Future:
        """Start a job and return the Future of its Outcome. Must not be called while a job runs."""
        assert self._future is None
        self._future = Future()
        threading.Thread(target=self._work, args=(job,), daemon=True).start()
        return self._future

    def _work(self, job: Callable[[], Any]) -> None:
        self._outcome = outcome_of(job, self._node.get_logger().error)
        # The node may have ended meanwhile.
        with suppress(InvalidHandle):
            self._ended.trigger()

    def _on_ended(self) -> None:
        future, self._future = self._future, None
        assert future is not None
        future.set_result(self._outcome)
        self._then()
