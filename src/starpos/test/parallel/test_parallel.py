# SPDX-License-Identifier: Apache-2.0
"""Calls on several processes: their order, their failures, processes that die, nothing left behind."""

import multiprocessing.spawn
import os
import signal
import warnings
from contextlib import suppress
from itertools import count, islice
from pathlib import Path

import pytest

from starpos.errors import CatalogueError, FrameError
from starpos.parallel.processes import AHEAD, ONE_THREAD, ProcessError, Processes, workers

# the work, which goes to other processes by name


def twice(of):
    return 2 * of


def process_id(of):
    return os.getpid()


def killed_once(of):
    """A path whose process is killed the first time."""
    if of is not None and not Path(of).exists():
        Path(of).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return of


def always_killed(of):
    if of == "bad":
        os.kill(os.getpid(), signal.SIGKILL)
    return of


def refused(of):
    raise (CatalogueError if of == "catalogue" else FrameError)(f"{of}: no")


def failing(of):
    return 1 / 0


def warning(of):
    warnings.warn("the cache is full", stacklevel=1)


def surroundings(of):
    import cv2

    blocked = signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return {name: os.environ[name] for name in ONE_THREAD}, cv2.getNumThreads(), blocked


def test_answers_come_in_order_and_no_more_is_asked_for_than_is_worked():
    numbers = count()
    with Processes(2) as workers:
        answers = workers.map((twice, k) for k in numbers)
        assert list(islice(answers, 50)) == list(range(0, 100, 2))
        assert next(numbers) <= 50 + 2 * AHEAD


def test_the_same_processes_serve_again():
    with Processes(2) as workers:
        first, second = (set(workers.map((process_id, k) for k in range(20))) for _ in range(2))
        assert len(first | second) <= 2
        assert list(workers.map([])) == []


@pytest.mark.parametrize("number", [1, 2])
def test_a_frames_failure_is_its_own_and_any_other_is_raised(number):
    with workers(number) as do_calls:
        bad, broken, good = do_calls([(refused, "a.fits"), (failing, "b.fits"), (twice, 2)])
        assert (type(bad), str(bad)) == (FrameError, "a.fits: no")
        assert str(broken).startswith("b.fits: this program failed on it (ZeroDivisionError")
        assert "test_parallel.py:" in str(broken)
        assert good == 4
        with pytest.raises(CatalogueError):
            list(do_calls([(refused, "catalogue")]))


def test_a_killed_process_costs_no_answer(tmp_path):
    given = [str(tmp_path / str(k)) if k % 4 == 1 else None for k in range(12)]
    with Processes(2) as workers:
        assert list(workers.map((killed_once, of) for of in given)) == given


def dead(pids):
    """Kill processes of ours, and wait until they are dead."""
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
        # its thread may have noticed already
        with suppress(ChildProcessError):
            os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)


def test_processes_killed_between_two_calls_cost_no_answer():
    with Processes(2) as workers:
        dead(set(workers.map((process_id, k) for k in range(8))))
        assert list(workers.map((twice, k) for k in range(8))) == list(range(0, 16, 2))


def test_processes_killed_before_they_begin_what_they_were_given_cost_no_answer():
    def calls(pids):
        yield twice, 0
        # the first call lies in the pipe of one that does not read it
        dead(pids)
        yield from ((twice, k) for k in range(1, 8))

    with Processes(2) as workers:
        pids = set(workers.map((process_id, k) for k in range(8)))
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        assert list(workers.map(calls(pids))) == list(range(0, 16, 2))


def test_a_frame_that_ends_every_process_is_given_up_and_the_others_are_not():
    with Processes(2) as workers:
        *good, bad, last = workers.map((always_killed, of) for of in ("a", "b", "c", "bad", "d"))
    assert [*good, last] == ["a", "b", "c", "d"]
    assert isinstance(bad, FrameError)
    assert str(bad).startswith("bad: given up: the process that worked it ended twice")


def test_processes_that_do_not_start_end_the_call(monkeypatch):
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", b"/bin/false")
    with Processes(2) as workers, pytest.raises(ProcessError, match=r"do not start \(exit status 1\)"):
        list(workers.map((twice, k) for k in range(8)))


def test_what_a_process_warns_of_is_heard():
    with Processes(1) as workers, pytest.warns(UserWarning, match="the cache is full"):
        assert list(workers.map([(warning, 0)])) == [None]


def test_a_process_takes_one_processor_and_leaves_ctrl_c_to_its_parent(monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    before = dict(os.environ), signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with Processes(1) as workers:
        assert list(workers.map([(surroundings, 0)])) == [(ONE_THREAD, 1, True)]
    assert (dict(os.environ), signal.pthread_sigmask(signal.SIG_BLOCK, ())) == before


def test_nothing_runs_after_leaving_in_the_middle():
    with Processes(2) as workers:
        pids = set(islice(workers.map((process_id, k) for k in count()), 20))
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
