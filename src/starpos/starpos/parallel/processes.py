# SPDX-License-Identifier: Apache-2.0
"""Do calls in this process, or in several processes of this machine.

No kept library does the latter. If a process dies, the pools of concurrent.futures and loky break and do not say at
which call; the processes of concurrent.futures go on after their parent was killed. Pebble names the call, but its pool
breaks if processes die between two calls. And none of them does a call again alone, with all of the machine's memory.
"""

import os
import pickle
import signal
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from starpos.errors import FrameError, StarposError, one_line
from starpos.parallel import BLAS_THREADS

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
# A call and its number.
Task = tuple[int, Call]


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


class Here:
    """Workers in this process: one call after the other."""

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def map(self, calls: Iterable[Call]) -> Iterator:
        """Yield the answers in the order of the calls, each as soon as all before it are there.

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
    """A number of processes, started on entering and ended on leaving.

    A process that dies is replaced. Its call is done again while no other is, so that it has all of the machine's memory;
    if its process dies again, it is given up.
    """

    def __init__(self, number: int) -> None:
        self._number, self._stillborn = number, 0
        self._workers: list[_Worker] = []

    def __enter__(self) -> "Processes":
        for _ in range(self._number):
            self._workers.append(_Worker())
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.end()

    def map(self, calls: Iterable[Call]) -> Iterator:
        """Yield the answers as `Here.map` does."""
        board = _Board(calls, AHEAD * self._number)
        while True:
            yield from board.pop_answers()
            for k, worker in enumerate(self._workers):
                if worker.task is None and (task := board.next_task()) is not None and not worker.send(task):
                    self._replace(k, board, task)
            busy = [(k, w, w.task) for k, w in enumerate(self._workers) if w.task is not None]
            if not busy:
                if board.finished:
                    return
                continue
            ready = wait([worker.pipe for _, worker, _ in busy])
            for k, worker, task in busy:
                if worker.pipe not in ready:
                    continue
                try:
                    outcome = worker.receive()
                except (EOFError, OSError):
                    self._replace(k, board, task)
                    continue
                self._stillborn = 0
                if outcome is not None:
                    board.finish(task, outcome)
                    worker.task = None

    def _replace(self, k: int, board: "_Board", task: Task) -> None:
        """Start a process in place of one that has died, and put its task back on the board.

        A task that it had not begun did not end it: something else did, between two calls.
        """
        dead = self._workers[k]
        why = dead.end(DYING_S)
        self._stillborn += not dead.ready
        if self._stillborn > MAX_STILLBORN:
            del self._workers[k]
            raise ProcessError(f"the processes of --jobs do not start ({why}): use fewer, or --jobs 1")
        self._workers[k] = _Worker()
        if dead.begun:
            board.fail(task, why)
        else:
            board.put_back(task)


# Where calls are done: a context manager that leaves nothing running.
Workers = Here | Processes


def workers(number: int) -> Workers:
    """Processes of that number, or this one alone."""
    return Here() if number <= 1 else Processes(number)


class _Board:
    """The calls that are still to do, and the answers in their order."""

    def __init__(self, calls: Iterable[Call], ahead: int) -> None:
        self._coming, self._ahead = enumerate(calls), ahead
        self._under_way: set[int] = set()
        self._again: deque[Task] = deque()
        # Calls that were given to a process which was dead already.
        self._untouched: deque[Task] = deque()
        # Calls that have ended a process.
        self._tried: set[int] = set()
        self._done: dict[int, bytes] = {}
        self._given = self._popped = 0

    def next_task(self) -> Task | None:
        """The next task; None if nothing is left, or if it must not run together with the tasks under way."""
        if self._under_way & self._tried or (self._again and self._under_way):
            return None
        task: Task | None = None
        if self._again:
            task = self._again.popleft()
        elif self._untouched:
            task = self._untouched.popleft()
        elif self._given - self._popped < self._ahead and (task := next(self._coming, None)) is not None:
            self._given += 1
        if task is not None:
            self._under_way.add(task[0])
        return task

    def finish(self, task: Task, outcome: bytes) -> None:
        self._under_way.discard(task[0])
        self._done[task[0]] = outcome

    def put_back(self, task: Task) -> None:
        self._under_way.discard(task[0])
        self._untouched.append(task)

    def fail(self, task: Task, why: str) -> None:
        number, (_, files) = task
        self._under_way.discard(number)
        if number not in self._tried:
            self._tried.add(number)
            self._again.append(task)
            return
        error = FrameError(
            f"{files}: given up: the process that worked it ended twice, the second time alone ({why})"
        )
        self._done[number] = pickle.dumps(error)

    def pop_answers(self) -> Iterator:
        while self._popped in self._done:
            outcome = self._done.pop(self._popped)
            self._popped += 1
            yield answer_of(outcome)

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do; asked while no call is under way."""
        return not self._again and self._popped == self._given


class _Worker:
    """A process.

    task   given and not answered yet
    begun  whether it has begun that one
    ready  whether it has started to work at all
    """

    def __init__(self) -> None:
        self.pipe, theirs = get_context("spawn").Pipe()
        self.task: Task | None = None
        self.begun = self.ready = False
        self._process = get_context("spawn").Process(target=_serve, args=(theirs,), daemon=True)
        with theirs, _for_one_that_starts():
            self._process.start()

    def send(self, task: Task) -> bool:
        """Send a task; False if the process has died."""
        self.task, self.begun = task, False
        try:
            self.pipe.send_bytes(pickle.dumps(task[1]))
        except OSError:
            return False
        return True

    def receive(self) -> bytes | None:
        """Receive an answer; None for word that it runs, the first, or has begun. EOFError or OSError if it has died."""
        said, outcome = pickle.loads(self.pipe.recv_bytes())
        for text in said:
            warnings.warn(text, stacklevel=2)
        self.begun, self.ready = self.ready, True
        return outcome

    def end(self, within_s: float = 0.0) -> str:
        """End the process, killing it after within_s, and return in words how it ended."""
        self.pipe.close()
        self._process.join(within_s)
        self._process.kill()
        self._process.join()
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


def _serve(pipe: Connection) -> None:
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
