# SPDX-License-Identifier: Apache-2.0
"""Stop signals in their worst moments."""

import os
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from starpos_common import node_main

SENDER = """
import os, signal
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
print("sending", flush=True)
while os.getppid() == {0}:
    os.kill({0}, signal.SIGINT)
"""
# About one in a hundred signals that are heard comes in the change; of 500 none does in one run of 150.
HEARD = 500


@pytest.fixture
def sender():
    """A process that sends this one SIGINT as fast as it can."""
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in node_main.SIGNALS}
    command = [sys.executable, "-c", SENDER.format(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "sending\n"
        yield
        process.kill()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_a_signal_in_the_moment_it_is_ignored_is_no_error(sender, monkeypatch):
    said, heard = [], 0
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    while heard < HEARD:
        with node_main.stop_signals() as stopped:
            while not stopped:
                pass
        heard += len(stopped)
    assert not said, said[0].exc_value


def test_other_errors_that_nobody_catches_are_told(monkeypatch):
    said = []
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    handlers = [signal.getsignal(number) for number in node_main.SIGNALS]
    with node_main.stop_signals():
        pass
    for number, handler in zip(node_main.SIGNALS, handlers, strict=True):
        signal.signal(number, handler)
    for error in (OSError("broken"), ValueError("Signal 2 ignored due to race condition")):
        sys.unraisablehook(SimpleNamespace(exc_value=error))
    assert len(said) == 2


def test_signals_are_counted_in_the_block_and_ignored_after_it():
    script = (
        "import os, signal\n"
        "from starpos_common.node_main import SIGNALS, stop_signals\n"
        "with stop_signals() as stopped:\n"
        "    for number in SIGNALS:\n"
        "        os.kill(os.getpid(), number)\n"
        "for number in SIGNALS:\n"
        "    os.kill(os.getpid(), number)\n"
        "print(*stopped)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{signal.SIGINT:d} {signal.SIGTERM:d}\n", "")
