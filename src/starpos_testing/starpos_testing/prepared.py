# SPDX-License-Identifier: Apache-2.0
"""Programs of Python, forked from a process that has imported what they import: most of a node's start is imports.

One such process belongs to each process of tests. It is made at the first start, and ends with the tests, however these
end. It has one thread and has never begun rclpy. A program that it forks gets the command line, output and working
directory that are asked for, and then runs as in an interpreter: the installed script, or the text after `-c`.

Variables like PYTHONPATH and LD_PRELOAD count when an interpreter begins. So where a variable is another one than when
the process was made, a program gets an interpreter of its own. Tests of how programs start use `interpreted` themselves.
"""

import atexit
import ctypes
import gc
import json
import os
import runpy
import select
import selectors
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import IO, Protocol

# What the programs of a package import.
IMPORTS = {
    "starpos_bringup": ("starpos_bringup.record", "starpos_bringup.replay"),
    "starpos_camera": ("starpos_camera.camera", "starpos_camera.detector"),
    "starpos_dashboard": ("starpos_dashboard.node",),
    "starpos_inclinometer": ("starpos_inclinometer.node",),
    "starpos_solver": ("starpos_solver.node", "starpos_solver.navigator_node"),
    "starpos_testing": ("starpos_testing.emulator",),
}
OF_ALL = ("rclpy", "rclpy.executors", "rclpy.signals", "starpos_common.parameters")
# pytest's own, another one in each test
IGNORED = "PYTEST_CURRENT_TEST"
# a process of several threads cannot be forked safely
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
GONE = (
    "the process that tests fork their nodes from (starpos_testing.prepared) has ended, and the nodes with it"
)
PR_SET_PDEATHSIG = 1
# of a request
MAX_BYTES = 2**17


class Child(Protocol):
    """A program that runs: as much of subprocess.Popen as tests use."""

    pid: int
    returncode: int | None

    def poll(self) -> int | None: ...
    def wait(self, timeout: float | None = None) -> int: ...
    def send_signal(self, sig: int) -> None: ...
    def kill(self) -> None: ...


def interpreted(command: list[str], package: str, out: IO) -> Child:
    """Start a program in an interpreter of its own; what it says goes to a file."""
    return subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)


def forked(command: list[str], package: str, out: IO) -> Child:
    """Start a program of a package as `interpreted` does, from the process that has its imports."""
    server = _server()
    start = server.start if server.variables == _variables() else interpreted
    return start(command, package, out)


def _variables() -> dict[str, str]:
    """The variables that have to be the same: not how many threads libraries have, which a tool sets for its process."""
    variables = {name: value for name, value in os.environ.items() if name != IGNORED}
    return {name: v for name, v in variables.items() if name not in ONE_THREAD and "_NUM_THREADS" not in name}


class Forked:
    """A program that was forked; `status` is a pipe into which its parent writes its exit status."""

    def __init__(self, command: list[str], pid: int, status: int) -> None:
        self.command, self.pid, self._status = command, pid, status
        self.returncode: int | None = None

    def _look(self, timeout_ms: float | None) -> int | None:
        if self.returncode is None:
            ended = select.poll()
            ended.register(self._status, select.POLLIN)
            if ended.poll(timeout_ms):
                said = os.read(self._status, 16)
                os.close(self._status)
                self.returncode = int(said or -signal.SIGKILL)
                if not said:
                    raise RuntimeError(GONE)
        return self.returncode

    def poll(self) -> int | None:
        return self._look(0)

    def wait(self, timeout: float | None = None) -> int:
        status = self._look(None if timeout is None else timeout * 1e3)
        if status is None:
            raise subprocess.TimeoutExpired(self.command, timeout or 0.0)
        return status

    def send_signal(self, sig: int) -> None:
        if self.poll() is None:
            # it may just have ended
            with suppress(ProcessLookupError):
                os.kill(self.pid, sig)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class Server:
    """The process that is forked from, as the tests' process sees it."""

    def __init__(self) -> None:
        self.variables = _variables()
        # of a kind that keeps the bounds of messages
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        program = f"from starpos_testing import prepared; prepared.run(prepared.serve({theirs.fileno()}, {os.getpid()}))"
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-c", program], pass_fds=[theirs.fileno()], env=os.environ | ONE_THREAD
            )

    def start(self, command: list[str], package: str, out: IO) -> Forked:
        request = {
            "command": command,
            "imports": (*OF_ALL, *IMPORTS[package]),
            "folder": os.getcwd(),
            "test": os.environ.get(IGNORED, ""),
        }
        status, theirs = os.pipe()
        try:
            socket.send_fds(self._socket, [json.dumps(request).encode()], [out.fileno(), theirs])
            answer = self._socket.recv(MAX_BYTES)
        except OSError:
            answer = b""
        os.close(theirs)
        if not answer:
            os.close(status)
            raise RuntimeError(GONE)
        return Forked(command, int(answer), status)

    def close(self) -> None:
        self._socket.close()
        self.process.wait()


@cache
def _server() -> Server:
    server = Server()
    atexit.register(server.close)
    return server


def _end_with(parent: int) -> None:
    """End when the parent does, in whatever state: as by kill -9."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def serve(number: int, parent: int) -> list[str]:
    """Fork as often as a socket, by its number, asks for it, until its other end is closed.

    Returns in the child alone: the command that it is to run.
    """
    _end_with(parent)
    # Ctrl-C is for tests and nodes
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    asked = socket.socket(fileno=number)
    # by the file that shows the end of a child: the child, and the pipe for its exit status
    children: dict[int, tuple[int, int]] = {}
    with selectors.DefaultSelector() as events:
        events.register(asked, selectors.EVENT_READ)
        while True:
            for key, _ in events.select():
                if key.fd in children:
                    events.unregister(key.fd)
                    pid, status = children.pop(key.fd)
                    ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                    os.close(key.fd)
                    # the tests may have ended
                    with suppress(BrokenPipeError):
                        os.write(status, str(ended).encode())
                    os.close(status)
                    continue
                said, files, _, _ = socket.recv_fds(asked, MAX_BYTES, 2)
                if not said:
                    sys.exit()
                request, (out, status) = json.loads(said), files
                prepare(request["imports"])
                server, pid = os.getpid(), os.fork()
                if not pid:
                    _end_with(server)
                    asked.close()
                    for file in (status, *children, *(pipe for _, pipe in children.values())):
                        os.close(file)
                    become(request, out)
                    return request["command"]
                ending = os.pidfd_open(pid)
                children[ending] = pid, status
                events.register(ending, selectors.EVENT_READ)
                os.close(out)
                asked.send(str(pid).encode())


def prepare(modules: list[str]) -> None:
    """Import modules, and the middleware that a program loads as it begins rclpy."""
    if modules[-1] in sys.modules:
        return
    for name in modules:
        # as without tornado; the program says it
        with suppress(ImportError):
            import_module(name)
    import_module("rclpy.utilities").get_rmw_implementation_identifier()
    # what is here is not looked through again and again in each child
    gc.collect()
    gc.freeze()


def become(request: dict, out: int) -> None:
    """Make this child what the program would find itself in."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.dup2(out, 1)
    os.dup2(out, 2)
    os.close(out)
    os.chdir(request["folder"])
    os.environ[IGNORED] = request["test"]


def run(command: list[str]) -> None:
    """Run a script with its arguments, or the text after `python -c`, in this process."""
    if command[1:2] == ["-c"]:
        sys.argv[:] = command[1:2] + command[3:]
        exec(compile(command[2], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv[:], sys.path[0] = command, os.path.dirname(command[0])
        runpy.run_path(command[0], run_name="__main__")
