# SPDX-License-Identifier: Apache-2.0
"""Do calls in this process, or in several processes of this machine.

The latter is a ProcessPoolExecutor with three things more: a call whose process dies is done again alone, with all of
the machine's memory; the processes end with their parent, however it ends; and a terminal's Ctrl-C is the parent's.
"""

import os
import pickle
import signal
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from threading import Thread
from typing import Any

from starpos.errors import FrameError, StarposError, one_line
from starpos.parallel import BLAS_THREADS

# Calls for each process whose answers may wait for an earlier one.
AHEAD = 4
# There is a process for each processor, so the libraries need no threads of their own. If the parent was killed, Python's
# tracker removes its semaphores, and need not say so.
INHERITED = dict.fromkeys((*BLAS_THREADS, "OPENCV_FOR_THREADS_NUM"), "1") | {
    "PYTHONWARNINGS": "ignore::UserWarning:multiprocessing.resource_tracker"
}

Files = str | tuple[str, ...]
# The work and its argument, which can be pickled: a file or files, or anything else.
Call = tuple[Callable[[Any], Any], Any]
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
    """A number of processes, started as calls come and ended on leaving.

    If a process dies, all are started anew, and each call that was under way is done again while no other is.  If its
    process dies twice then, it is given up.
    """

    def __init__(self, number: int) -> None:
        self._number = number

    def __enter__(self) -> "Processes":
        context = get_context("spawn")
        theirs, self._lifeline = context.Pipe(duplex=False)
        # Python's tracker of semaphores starts here
        with _for_one_that_starts():
            self._pool = ProcessPoolExecutor(self._number, context, _end_with, (theirs,))
        self._theirs = theirs
        return self

    def __exit__(self, *_: object) -> None:
        # ends them, whatever they do
        self._lifeline.close()
        self._theirs.close()
        self._pool.shutdown(cancel_futures=True)

    def _submit(self, work: Callable, *call: Any) -> Future:
        with _for_one_that_starts():
            try:
                return self._pool.submit(work, *call)
            # one that was idle has died
            except BrokenProcessPool:
                self.__exit__()
                self.__enter__()
                return self._pool.submit(work, *call)

    def map(self, calls: Iterable[Call]) -> Iterator:
        """Yield the answers as `Here.map` does."""
        coming = iter(calls)
        under_way: deque[tuple[Call, Future[_Said] | _Said | None]] = deque()
        while True:
            while len(under_way) < AHEAD * self._number and (call := next(coming, None)) is not None:
                under_way.append((call, self._submit(_heard, *call)))
            if not under_way:
                return
            if isinstance(future := under_way[0][1], Future) and _died(future):
                under_way = deque((c, self._alone(c) if _died(f) else f) for c, f in under_way)
            call, outcome = under_way.popleft()
            if outcome is None:
                how = "the process that worked it alone ended twice, perhaps for lack of memory"
                yield FrameError(f"{call[1]}: given up: {how}")
                continue
            said, answer = outcome.result() if isinstance(outcome, Future) else outcome
            for text in said:
                warnings.warn(text, stacklevel=2)
            yield answer_of(answer)

    def _alone(self, call: Call) -> _Said | None:
        """What comes of a call while no other is under way; None if its process dies twice."""
        for _ in range(2):
            try:
                self._submit(os.getpid).result()
            except BrokenProcessPool:
                raise ProcessError("the processes of --jobs do not start: use fewer, or --jobs 1") from None
            outcome: Future[_Said] = self._submit(_heard, *call)
            if not _died(outcome):
                return outcome.result()
        return None


def _died(outcome: Any) -> bool:
    """Whether a process died before a call was done, which is waited for."""
    return isinstance(outcome, Future) and isinstance(outcome.exception(), BrokenProcessPool)


# Where calls are done: a context manager that leaves nothing running.
Workers = Here | Processes


def workers(number: int) -> Workers:
    """Processes of that number, or this one alone."""
    return Here() if number <= 1 else Processes(number)


@contextmanager
def _for_one_that_starts() -> Iterator[None]:
    """Set what a new process inherits: one thread for each library, and SIGINT blocked.

    A terminal sends Ctrl-C to all processes; only the parent is to react.  Windows has no masks of signals.
    """
    before = dict(os.environ)
    os.environ.update({name: one for name, one in INHERITED.items() if name not in before})
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
        for name in INHERITED.keys() - before.keys():
            del os.environ[name]


def _end_with(parent: Connection) -> None:
    """End this process, whatever it does, when its parent closes the pipe or ends."""

    def wait() -> None:
        with suppress(EOFError, OSError):
            parent.recv_bytes()
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def _heard(work: Callable, files: Files) -> _Said:
    """Do the work in a process of its own."""
    with warnings.catch_warnings(record=True) as said:
        outcome = worked(work, files)
    return [str(w.message) for w in said], outcome
