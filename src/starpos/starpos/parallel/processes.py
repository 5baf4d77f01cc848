# SPDX-License-Identifier: Apache-2.0
"""Do calls in this process, or in several processes of this machine.

No kept library does the latter. If a process dies, the pools of concurrent.futures and loky break and do not say at
which call. The processes of concurrent.futures go on after their parent was killed, and where one dies while others
start, its pool may raise an OSError. Pebble names the call, but its pool breaks if processes die between two calls. And
none of them does a call again alone, with all of the machine's memory.
"""

import os
import pickle
import signal
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from threading import Lock
from typing import TYPE_CHECKING, Any

from starpos.errors import FrameError, StarposError, one_line
from starpos.parallel import BLAS_THREADS

# work in this process must not wait for these to load
if TYPE_CHECKING:
    from concurrent.futures import Future
    from multiprocessing.connection import Connection

# Calls for each process whose answers may wait for an earlier one.
AHEAD = 4
# Maximum number of processes in a row that end before they are ready.
MAX_STILLBORN = 3
# Time for a process that no longer answers to end.
DYING_S = 1.0
# Exit status of a process that SIGKILL ended; Windows has no signals.
KILLED_STATUS = -getattr(signal, "SIGKILL", 1 << 16)
# There is a process for each processor, so the libraries need no threads of their own.
ONE_THREAD = dict.fromkeys((*BLAS_THREADS, "OPENCV_FOR_THREADS_NUM"), "1")

Files = str | tuple[str, ...]
# The work and its argument, which can be pickled: a file or files, or anything else.
Call = tuple[Callable[[Any], Any], Any]
# Does calls, and yields their answers in the same order.
DoCalls = Callable[[Iterable[Call]], Iterator]
# The warnings that the work gave, and its pickled answer.
_Said = tuple[Sequence[str], bytes]


def worked(work: Callable, files: Files) -> bytes:
    """Do the work and return its answer, or its StarposError, pickled.

    Work in this process uses it too: the sum of an array that is a view may differ in the last digit from the sum of its
    pickled copy, and the answers must be the same everywhere.
    """
    try:
        answer = work(files)
    except StarposError as error:
        answer = error
    # a failure on one frame must not lose the others
    except Exception as error:
        at = traceback.extract_tb(error.__traceback__)[-1]
        answer = FrameError(
            f"{files}: this program failed on it ({type(error).__name__}: {one_line(error)}; {at.filename}:{at.lineno}): "
            "please report it with the frame"
        )
    return pickle.dumps(answer)


def answer_of(outcome: bytes) -> Any:
    """Unpickle what `worked` returned; a StarposError that is not a FrameError is raised."""
    # from this program's own processes
    answer = pickle.loads(outcome)
    if isinstance(answer, StarposError) and not isinstance(answer, FrameError):
        raise answer
    return answer


def in_turn(calls: Iterable[Call]) -> Iterator:
    """Do calls in this process, one after the other; yield the answers, each as soon as all before it are there.

    A FrameError is an answer; any other StarposError of the work is raised.
    """
    return (answer_of(worked(*call)) for call in calls)


class ProcessError(StarposError):
    """The processes do not start."""


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_bytes() -> int:
    """Memory of this machine; where the system does not say it, enough for a process each."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    # Windows has no sysconf
    except (AttributeError, ValueError, OSError):
        return sys.maxsize


class Processes:
    """A number of processes, started on entering and ended on leaving; a thread for each waits for its answers.

    A process that dies is replaced. Its call is done again while no other is, so that it has all of the machine's memory;
    if its process dies again, it is given up.
    """

    def __init__(self, number: int) -> None:
        self._number, self._stillborn = number, 0
        self._ended, self._how_ended = False, ""
        # None: there will be no more
        self._idle: SimpleQueue[_Worker | None] = SimpleQueue()
        self._workers: list[_Worker] = []
        self._starting = Lock()

    def __enter__(self) -> "Processes":
        from concurrent.futures import ThreadPoolExecutor

        for _ in range(self._number):
            self._start()
        self._threads = ThreadPoolExecutor(self._number)
        return self

    def __exit__(self, *_: object) -> None:
        self._ended = True
        self._idle.put(None)
        with self._starting:
            for worker in self._workers:
                worker.kill()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.end()

    def _start(self) -> None:
        with self._starting:
            worker = _Worker()
            self._workers.append(worker)
        self._idle.put(worker)

    def map(self, calls: Iterable[Call]) -> Iterator:
        """Yield the answers as `in_turn` does."""
        from concurrent.futures import wait

        coming = iter(calls)
        under_way: deque[tuple[Call, Future[_Said | str]]] = deque()
        while True:
            while len(under_way) < AHEAD * self._number and (call := next(coming, None)) is not None:
                under_way.append((call, self._threads.submit(self._done, call)))
            if not under_way:
                return
            call, future = under_way.popleft()
            outcome = future.result()
            if isinstance(outcome, str):
                wait(f for _, f in under_way)
                outcome = self._done(call)
            if isinstance(outcome, str):
                how = f"the process that worked it ended twice, the second time alone ({outcome})"
                yield FrameError(f"{call[1]}: given up: {how}")
                continue
            said, answer = outcome
            for text in said:
                warnings.warn(text, stacklevel=2)
            yield answer_of(answer)

    def _done(self, call: Call) -> "_Said | str":
        """What a process makes of a call, or in words how the one ended that had begun it.

        A process that ends before it has begun the call is replaced: something else ended it, between two calls.
        """
        while (worker := self._idle.get()) is not None:
            outcome = worker.work(call)
            if outcome is not None:
                self._stillborn = 0
                self._idle.put(worker)
                return outcome
            if self._ended:
                break
            with self._starting:
                self._workers.remove(worker)
                self._stillborn += not worker.ready
            how = worker.end(DYING_S)
            if self._stillborn > MAX_STILLBORN:
                self._how_ended = how
                break
            self._start()
            if worker.begun:
                return how
        # all other threads end, too
        self._idle.put(None)
        raise ProcessError(
            f"the processes of --jobs do not start ({self._how_ended}): use fewer, or --jobs 1"
        )


@contextmanager
def workers(number: int) -> Iterator[DoCalls]:
    """What does calls as `in_turn`: a number of processes, which end with the context, or this one alone."""
    if number <= 1:
        yield in_turn
    else:
        with Processes(number) as processes:
            yield processes.map


class _Worker:
    """A process.

    begun: whether it has begun the call that it was given last.  ready: whether it has started to work at all.
    """

    def __init__(self) -> None:
        from multiprocessing import get_context

        self.pipe, theirs = get_context("spawn").Pipe()
        self.begun = self.ready = False
        self._process = get_context("spawn").Process(target=_serve, args=(theirs,), daemon=True)
        with theirs, _for_one_that_starts():
            self._process.start()

    def work(self, call: Call) -> _Said | None:
        """What the process says of a call; None if it has died."""
        self.begun = False
        message = pickle.dumps(call)
        try:
            self.pipe.send_bytes(message)
            while True:
                said, outcome = pickle.loads(self.pipe.recv_bytes())
                if outcome is not None:
                    return said, outcome
                # its first word is that it runs, each other one that it has begun
                self.begun, self.ready = self.ready, True
        except (EOFError, OSError):
            return None

    def kill(self) -> None:
        """Kill the process, which wakes the thread that waits for it."""
        self._process.kill()

    def end(self, within_s: float = 0.0) -> str:
        """End the process, killing it after within_s, and return in words how it ended."""
        self._process.join(within_s)
        self._process.kill()
        self._process.join()
        self.pipe.close()
        code = self._process.exitcode
        self._process.close()
        if code == KILLED_STATUS:
            return "killed, perhaps for lack of memory: try fewer --jobs"
        if code is not None and code < 0:
            return signal.strsignal(-code) or f"signal {-code}"
        return f"exit status {code}"


@contextmanager
def _for_one_that_starts() -> Iterator[None]:
    """Set what a new process inherits: one thread for each library, and SIGINT blocked.

    A terminal sends Ctrl-C to all processes; only the parent is to react.  Windows has no masks of signals.
    """
    before = dict(os.environ)
    os.environ.update({name: one for name, one in ONE_THREAD.items() if name not in before})
    masks = hasattr(signal, "pthread_sigmask")
    if masks:
        from multiprocessing import resource_tracker

        # otherwise it starts with the first process, and unblocks SIGINT for it
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name in ONE_THREAD.keys() - before.keys():
            del os.environ[name]


def _serve(pipe: "Connection") -> None:
    """Do the calls that come through the pipe until its other end is closed."""
    word = pickle.dumps(((), None))
    with suppress(EOFError, OSError):
        pipe.send_bytes(word)
        while True:
            call = pipe.recv_bytes()
            # before any work on it, which may end this process
            pipe.send_bytes(word)
            work, files = pickle.loads(call)
            with warnings.catch_warnings(record=True) as said:
                outcome = worked(work, files)
            pipe.send_bytes(pickle.dumps(([str(w.message) for w in said], outcome)))
