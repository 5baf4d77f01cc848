# SPDX-License-Identifier: Apache-2.0
"""The thread behind the nodes, without ROS."""

import threading
from types import SimpleNamespace

from starpos_common.worker import JobRunner, Worker
from starpos_testing.patience import WAIT_S


def test_newest_job_wins_and_results_come_in_order():
    running, go, fetched = threading.Event(), threading.Event(), threading.Semaphore(0)

    def work(job):
        running.set()
        assert go.wait(WAIT_S)
        return job * 10

    worker = Worker(work, fetched.release, "test")
    assert worker.idle
    worker.start()
    assert not worker.offer(1)
    assert running.wait(WAIT_S)
    assert not worker.offer(2)
    assert worker.offer(3)
    assert not worker.idle
    go.set()
    assert fetched.acquire(timeout=WAIT_S) and fetched.acquire(timeout=WAIT_S)
    assert not worker.idle
    assert worker.fetch() == [10, 30]
    assert worker.idle
    worker.stop()


def test_an_exception_is_a_result_and_the_next_job_is_done():
    fetched = threading.Semaphore(0)
    worker = Worker(lambda job: 1 / job, fetched.release, "test")
    worker.start()
    worker.offer(0)
    assert fetched.acquire(timeout=WAIT_S)
    worker.offer(4)
    assert fetched.acquire(timeout=WAIT_S)
    error, quarter = worker.fetch()
    assert isinstance(error, ZeroDivisionError) and quarter == 0.25
    worker.stop()


def test_stop_waits_for_the_running_job_only():
    running, go, done = threading.Event(), threading.Event(), []

    def work(job):
        running.set()
        assert go.wait(WAIT_S)
        done.append(job)

    worker = Worker(work, lambda: None, "test")
    worker.start()
    worker.offer(1)
    assert running.wait(WAIT_S)
    worker.offer(2)
    threading.Timer(0.05, go.set).start()
    worker.stop()
    assert done == [1]
    worker.stop()


def test_stop_before_start():
    Worker(lambda job: job, lambda: None, "test").stop()


def test_a_defect_in_what_takes_an_outcome_is_logged_and_the_node_goes_on():
    ended, said, delivered = threading.Event(), [], []
    node = SimpleNamespace(
        create_guard_condition=lambda _: SimpleNamespace(trigger=ended.set),
        get_logger=lambda: SimpleNamespace(error=said.append),
    )
    runner = JobRunner(node, lambda: delivered.append(True))

    def take(outcome):
        raise KeyError("defect")

    runner.run(lambda: 1, take)
    assert ended.wait(WAIT_S)
    runner._on_ended()
    assert "KeyError: 'defect'" in said[0] and delivered == [True] and not runner.busy
