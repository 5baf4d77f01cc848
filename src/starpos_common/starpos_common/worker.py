# SPDX-License-Identifier: Apache-2.0
"""A thread for the long work of a node, so that its executor stays free for signals and services."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any


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
