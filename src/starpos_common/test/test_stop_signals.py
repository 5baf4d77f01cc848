# SPDX-License-Identifier: Apache-2.0
"""Stop signals in their worst moments."""

import os
import signal
import subprocess
import sys

import pytest

from starpos_common import stop_signals

SENDER = """
import os, signal
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.SIG_IGN)
print("sending", flush=True)
while os.getppid() == {0}:
    os.kill({0}, signal.SIGINT)
"""
# About one in a hundred signals that are heard comes in a change that is made with `signal.signal` alone.
HEARD, CHANGES = 400, 200_000


@pytest.fixture
def sender():
    """A process that sends this one SIGINT as fast as it can."""
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in stop_signals.SIGNALS}
    command = [sys.executable, "-c", SENDER.format(os.getpid())]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "sending\n"
        yield
        process.kill()
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_a_signal_in_the_moment_it_is_ignored_is_no_error(sender, monkeypatch):
    said, heard = [], []
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    for _ in range(CHANGES):
        stop_signals.ignore(signal.SIGINT)
        signal.signal(signal.SIGINT, lambda signum, frame: heard.append(signum))
        if len(heard) > HEARD:
            break
    stop_signals.ignore(signal.SIGINT)
    assert heard
    assert not said, said[0].exc_value


def test_signals_are_counted_in_the_block_and_ignored_after_it():
    script = (
        "import os, signal\n"
        "from starpos_common.stop_signals import SIGNALS, stop_signals\n"
        "with stop_signals() as stopped:\n"
        "    for number in SIGNALS:\n"
        "        os.kill(os.getpid(), number)\n"
        "for number in SIGNALS:\n"
        "    os.kill(os.getpid(), number)\n"
        "print(*stopped)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{signal.SIGINT:d} {signal.SIGTERM:d}\n", "")
