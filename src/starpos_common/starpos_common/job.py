# SPDX-License-Identifier: Apache-2.0
"""Work that takes seconds, in a thread beside the node, which goes on meanwhile."""

import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.task import Future

from starpos.errors import StarposError


@dataclass(frozen=True)
class Outcome:
    """What a job returned, or the sentence that says why it has not."""

    value: Any = None
    trouble: str = ""


class JobRunner:
    """One job at a time; its end comes back into the node's executor."""

    def __init__(self, node: Node):
        self._node = node
        self._ended = node.create_guard_condition(self._on_ended)
        self._future: Future | None = None
        self._outcome: Outcome | None = None

    @property
    def busy(self) -> bool:
        return self._future is not None

    def run(self, job: Callable[[], Any]) -> Future:
        """Start a job; a Future of its Outcome, to await or to hang a callback on.  Not while it is busy."""
        assert self._future is None
        self._future = Future()
        threading.Thread(target=self._work, args=(job,), daemon=True).start()
        return self._future

    def _work(self, job):
        try:
            self._outcome = Outcome(job())
        except StarposError as e:
            self._outcome = Outcome(trouble=str(e))
        except Exception as e:  # a defect costs this job, not the node
            self._node.get_logger().error(traceback.format_exc())
            self._outcome = Outcome(trouble=f"it failed ({type(e).__name__}: {e})")
        with suppress(InvalidHandle):  # the node has ended meanwhile
            self._ended.trigger()

    def _on_ended(self):
        future, self._future = self._future, None
        future.set_result(self._outcome)
