# SPDX-License-Identifier: Apache-2.0
"""A forked program is like one in an interpreter of its own, and ends when what it was forked from does."""

import os
import select
import signal
import subprocess
import sys

import pytest

from starpos_testing import prepared
from starpos_testing.graph.graph import executable
from starpos_testing.patience import WAIT_S, until
from starpos_testing.prepared import GONE, Server, forked, interpreted

PACKAGE = "starpos_inclinometer"
SAYS = (
    "import os, sys, threading; print(sys.argv, os.getcwd(), threading.active_count(), __name__); sys.exit(3)"
)
# a shell's background programs ignore SIGINT until they set it
WAITS = (
    "import signal, time; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "print('here', flush=True)\nwhile True: time.sleep(0.1)"
)
FAILS = "import sys; print('before'); sys.stderr.write('said '); raise KeyError('defect')"
# starts a program and says which
TESTS = f"""
import sys, tempfile
from starpos_testing.prepared import forked
out = tempfile.TemporaryFile()
program = forked([sys.executable, "-c", "import signal; signal.pause()"], "{PACKAGE}", out)
print(program.pid, flush=True)
program.wait()
"""


@pytest.fixture
def out(tmp_path):
    with (tmp_path / "out").open("w+") as file:
        yield file


def text(out) -> str:
    out.seek(0)
    return out.read()


def started(start, out, program, *arguments):
    return start([sys.executable, "-c", program, *arguments], PACKAGE, out)


def waiting(start, out):
    program = started(start, out, WAITS)
    until(lambda: "here" in text(out))
    return program


def has_ended(pidfd: int) -> bool:
    return bool(select.select([pidfd], [], [], WAIT_S)[0])


@pytest.mark.parametrize("start", [interpreted, forked])
def test_a_program_has_its_arguments_folder_output_and_status(start, out, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    program = started(start, out, SAYS, "a", "--b")
    assert program.wait(WAIT_S) == program.poll() == program.returncode == 3
    assert text(out) == f"['-c', 'a', '--b'] {tmp_path} 1 __main__\n"


@pytest.mark.parametrize("start", [interpreted, forked])
def test_what_ends_a_program_is_its_status(start, out):
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        program = waiting(start, out)
        assert program.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            program.wait(0)
        program.send_signal(number)
        assert program.wait(WAIT_S) == -number
        # which is no error any more
        program.kill()
        out.truncate(0)


@pytest.mark.parametrize("start", [interpreted, forked])
def test_a_defect_shows_its_traceback(start, out):
    assert started(start, out, FAILS).wait(WAIT_S) == 1
    assert "before" in text(out) and "KeyError: 'defect'" in text(out) and "said Traceback" in text(out)


def test_an_installed_script_says_the_same_in_both(tmp_path):
    said = set()
    for start in (interpreted, forked):
        with (tmp_path / "said").open("w+") as out:
            command = [executable("starpos_testing", "emulator"), "--help"]
            assert start(command, "starpos_testing", out).wait(WAIT_S) == 0
            said.add(text(out))
    assert len(said) == 1 and "emulator" in said.pop()


def test_the_imports_are_there_and_other_variables_take_an_interpreter(out, monkeypatch):
    program = "import os, sys; print(os.getppid(), 'rclpy' in sys.modules)"
    # as a benchmark's module sets it for itself
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    started(forked, out, program).wait(WAIT_S)
    monkeypatch.setenv("LD_BIND_NOW", "1")
    started(forked, out, program).wait(WAIT_S)
    assert text(out) == f"{prepared._server().process.pid} True\n{os.getpid()} False\n"


def test_when_the_process_that_is_forked_from_dies_so_do_the_programs_and_a_sentence_says_so(out):
    server = Server()
    program = waiting(server.start, out)
    server.process.kill()
    with pytest.raises(RuntimeError, match=GONE[:30]):
        program.wait(WAIT_S)
    assert program.poll() == -signal.SIGKILL
    with pytest.raises(RuntimeError, match=GONE[:30]):
        started(server.start, out, WAITS)
    server.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_nothing_stays_behind_where_the_tests_are_killed(number):
    with subprocess.Popen([sys.executable, "-c", TESTS], stdout=subprocess.PIPE, text=True) as tests:
        pid = int(tests.stdout.readline())
        ending = os.pidfd_open(pid)
        tests.send_signal(number)
        assert tests.wait(WAIT_S) == -number
    assert has_ended(ending)
    os.close(ending)
