# SPDX-License-Identifier: Apache-2.0
"""A thread for the long work of a node, so that its executor stays free for signals and services."""

import threading
from collections import deque
from collections.abc import Callable


class Worker:
    """Does one job at a time; a newer job takes the place of one that still waits.

    work: called in the thread with a job, returns its result; an exception is a result too.
    done: called in the thread after each result is there to be fetched (a guard condition's trigger).
    """

    def __init__(self, work: Callable, done: Callable[[], object], name: str):
        self._work = work
        self._done = done
        self._changed = threading.Condition()
        self._waiting = None
        self._running = False
        self._stopping = False
        self._results = deque()
        self._thread = threading.Thread(target=self._run, name=name)

    def start(self):
        self._thread.start()

    def retire(self):
        """Begin no further job."""
        with self._changed:
            self._stopping = True
            self._waiting = None
            self._changed.notify()

    def stop(self):
        """Finish the running job, forget the waiting one, end the thread. May be called twice, or unstarted."""
        self.retire()
        if self._thread.is_alive():
            self._thread.join()

    def offer(self, job) -> bool:
        """Have `job` (not None) done next; True where another was waiting, which is dropped."""
        with self._changed:
            dropped = self._waiting is not None
            self._waiting = job
            self._changed.notify()
        return dropped

    @property
    def idle(self) -> bool:
        """Nothing waits, nothing runs, and all results are fetched."""
        with self._changed:
            return self._waiting is None and not self._running and not self._results

    def fetch(self) -> list:
        """The results since the last call, oldest first."""
        with self._changed:
            results = list(self._results)
            self._results.clear()
        return results

    def _run(self):
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
            del job  # a frame's memory is not to be kept until the next
            with self._changed:
                self._results.append(result)
                del result
                self._running = False
                if self._stopping:
                    return
            self._done()
