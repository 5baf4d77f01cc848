# SPDX-License-Identifier: Apache-2.0
"""Exit statuses of a node's process, whatever signal comes whenever."""

import os
import signal
import subprocess
import sys

import pytest

from starpos_testing.nodes import take_domain
from starpos_testing.patience import WAIT_S

PROGRAM = """
import sys
from starpos_common.node_main import run

def make_nodes():
    print("making", flush=True)
    %s
    from rclpy.node import Node
    class Ready(Node):
        def __init__(self):
            super().__init__("ready")
            self.create_timer(0.01, self.first)
        def first(self):
            print("spinning", flush=True)
            self.timers.__next__().cancel()
            %s
    yield Ready()

sys.exit(run(make_nodes, help_text=lambda: "it is ready"))
"""


@pytest.fixture(scope="module", autouse=True)
def domain():
    take_domain()


@pytest.fixture
def start():
    processes = []

    def start(making="pass", spinning="pass", arguments=()):
        command = [sys.executable, "-c", PROGRAM % (making, spinning), *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.communicate()


def await_line(process, wanted):
    for line in process.stdout:
        if line.strip() == wanted:
            return
    pytest.fail(f"it ended before it was {wanted}: {process.stderr.read()}")


def end(process):
    """Its exit status and what it had to say on standard error."""
    _, err = process.communicate(timeout=WAIT_S)
    return process.returncode, err


@pytest.mark.parametrize("signals", [(signal.SIGINT,), (signal.SIGINT, signal.SIGINT), (signal.SIGTERM,)])
@pytest.mark.parametrize("moment", ["making", "spinning"])
def test_signals_end_it_cleanly(start, signals, moment):
    process = start()
    await_line(process, moment)
    for number in signals:
        process.send_signal(number)
    status, err = end(process)
    assert (status, err) == (0, "")


def test_second_signal_at_any_later_time_changes_nothing(start):
    process = start()
    await_line(process, "spinning")
    while process.poll() is None:
        process.send_signal(signal.SIGINT)
    status, err = end(process)
    assert (status, err) == (0, "")


@pytest.mark.parametrize(
    ("making", "sentence"),
    [
        (
            "from starpos.errors import FrameError; raise FrameError('no frames in /x;\\n give others')",
            "no frames in /x; give others",
        ),
        (
            "from starpos.parameters.table import ParameterError; raise ParameterError('a must be b')",
            "a must be b",
        ),
    ],
)
def test_refused_start_is_one_line_and_status_1(start, making, sentence):
    status, err = end(start(making))
    assert status == 1
    assert err == f"-c: {sentence}\n"


def test_bad_command_line_is_said(start):
    status, err = end(start(arguments=("--ros-args", "-p", "nonsense")))
    assert status == 1
    # rcl has logged a line of its own before.
    assert "nonsense" in err.splitlines()[-1] and "Traceback" not in err


def test_what_ros_does_not_know_is_named(start):
    status, err = end(start(arguments=("--ros-args", "--nonsense")))
    assert status == 1
    assert err.splitlines()[-1] == "-c: unknown arguments after --ros-args: ['--nonsense']"


def test_missing_parameter_file_is_said(start):
    status, err = end(start(arguments=("--ros-args", "--params-file", "/nowhere.yaml")))
    assert status == 1
    assert "/nowhere.yaml" in err and "Traceback" not in err


@pytest.mark.parametrize("word", ["--help", "-h"])
def test_help_is_printed_and_nothing_is_made(start, word):
    process = start(arguments=(word, "--ros-args", "-p", "nonsense"))
    out, err = process.communicate(timeout=WAIT_S)
    assert (process.returncode, out, err) == (0, "it is ready\n", "")


def test_help_that_nobody_reads_to_its_end_is_no_error():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-c", PROGRAM % ("pass", "pass"), "--help"]
    done = subprocess.run(
        command, stdout=writer, stderr=subprocess.PIPE, text=True, timeout=WAIT_S, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_defect_in_a_callback_shows_its_traceback(start):
    status, err = end(start(spinning="raise KeyError('defect')"))
    assert status == 1
    assert "Traceback" in err and "KeyError: 'defect'" in err


def test_a_thread_at_work_does_not_hold_up_the_end():
    """Nor is it torn down by the interpreter, in whatever it does."""
    script = (
        "import atexit, sys, threading, time\n"
        "from starpos_common.node_main import leave\n"
        "atexit.register(print, 'torn down')\n"
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        "print('said')\n"
        "sys.exit(leave(3))\n"
    )
    command = [sys.executable, "-c", script]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=WAIT_S)
    assert (ended.returncode, ended.stdout) == (3, "said\n")


STUCK = """
import ctypes, sys
from starpos_common import node_main
from starpos_common.node_main import run

node_main.MAX_END_S = 0.5

def make_nodes():
    from rclpy.node import Node
    class Stuck(Node):
        def __init__(self):
            super().__init__("stuck")
            self.create_timer(0.01, lambda: print("spinning", flush=True))
        def close(self):
            print("closed", flush=True)
        def destroy_node(self):
            # keeps Python's lock, as the middleware does
            ctypes.PyDLL(None).sleep(100000)
    yield Stuck()

sys.exit(run(make_nodes))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_middleware_that_never_ends_does_not_keep_the_process(number):
    process = subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE, text=True)
    try:
        await_line(process, "spinning")
        process.send_signal(number)
        said, _ = process.communicate(timeout=WAIT_S)
    finally:
        process.kill()
    assert process.returncode == 0 and "closed" in said
