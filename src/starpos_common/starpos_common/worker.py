# SPDX-License-Identifier: Apache-2.0
"""Threads for the long work of a node, so that its executor stays free for signals and services."""

import threading
import traceback
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from starpos.errors import StarposError
from starpos.session.driver import Jobs, Outcome, outcome_of


def failure_of_frame(error: Exception) -> str:
    """Say what the failure of a frame's job means; a defect loses only that frame, and the node goes on."""
    if isinstance(error, StarposError):
        return str(error)
    return f"a frame was given up ({type(error).__name__}: {error}); keep it and report this."


class Worker:
    """Does one job at a time; a newer job replaces one that still waits.

    work: called in the thread with a job, returns its result; an exception is a result too.
    done: called in the thread whenever a result can be fetched (a guard condition's trigger).
    """

    def __init__(self, work: Callable[[Any], Any], done: Callable[[], object], name: str) -> None:
        self._work = work
        self._done = done
        self._changed = threading.Condition()
        self._waiting: Any = None
        self._running = False
        self._stopping = False
        self._results: deque[Any] = deque()
        self._thread = threading.Thread(target=self._run, name=name)

    def start(self) -> None:
        self._thread.start()

    def retire(self) -> None:
        """Drop the waiting job and begin no other."""
        with self._changed:
            self._stopping = True
            self._waiting = None
            self._changed.notify()

    def stop(self) -> None:
        """Finish the running job, drop the waiting one, end the thread. May be called twice, or before `start`."""
        self.retire()
        if self._thread.is_alive():
            self._thread.join()

    def offer(self, job: Any) -> bool:
        """Have `job` (not None) done next; return True if this dropped a waiting job."""
        with self._changed:
            dropped = self._waiting is not None
            self._waiting = job
            self._changed.notify()
        return dropped

    @property
    def idle(self) -> bool:
        """True if nothing waits, nothing runs, and all results are fetched."""
        with self._changed:
            return self._waiting is None and not self._running and not self._results

    def fetch(self) -> list:
        """Return the results since the last call, oldest first."""
        with self._changed:
            results = list(self._results)
            self._results.clear()
        return results

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopping or self._waiting is not None)
                if self._stopping:
                    return
                job, self._waiting = self._waiting, None
                self._running = True
            try:
                result = self._work(job)
            except Exception as error:
                result = error
            # The memory of a frame should not be kept until the next job.
            del job
            with self._changed:
                self._results.append(result)
                del result
                self._running = False
                if self._stopping:
                    return
            self._done()


class JobRunner(Jobs):
    """Runs jobs in a thread; their outcomes come in the node's executor.

    then: called when an outcome has been delivered.
    """

    def __init__(self, node: Node, then: Callable[[], object] = lambda: None) -> None:
        super().__init__()
        self._node, self._done = node, then
        self._ended = node.create_guard_condition(self._on_ended)
        self._outcome = Outcome()

    def _begin(self, job: Callable[[], Any]) -> None:
        threading.Thread(target=self._work, args=(job,), daemon=True).start()

    def _work(self, job: Callable[[], Any]) -> None:
        self._outcome = outcome_of(job, self._node.get_logger().error)
        # The node may have ended meanwhile.
        with suppress(InvalidHandle):
            self._ended.trigger()

    def _on_ended(self) -> None:
        # a defect in what takes the outcome must not end the node
        try:
            self._end(self._outcome)
        except Exception:
            self._node.get_logger().error(traceback.format_exc())
        self._done()
