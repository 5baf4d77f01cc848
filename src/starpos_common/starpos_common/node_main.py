# SPDX-License-Identifier: Apache-2.0
"""The main function of every node: start, spin, and end cleanly whatever signal comes, whenever it comes.

Nothing heavy is imported before the signal handlers are in place, so that a signal during start-up also gives a clean
exit. The module of an executable therefore imports its nodes inside `make_nodes`, or names the one that it has.
"""

import contextlib
import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rclpy.node import Node

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Give a list that every such signal is added to; after the block they are ignored, for good.

    launch sends a second SIGINT: Python's own handler must not get it while the interpreter ends.
    """
    stopped: list[int] = []
    for number in SIGNALS:
        signal.signal(number, lambda signum, frame: stopped.append(signum))
    try:
        yield stopped
    finally:
        if not isinstance(sys.unraisablehook, _UnlessLate):
            sys.unraisablehook = _UnlessLate(sys.unraisablehook)
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


class _UnlessLate:
    """A hook for uncaught errors, except from signals that came while they were being ignored.

    Another thread may take a signal before the change and note it after; Python then prints "ignored due to race
    condition". No order of calls prevents it.
    """

    def __init__(self, told: Callable[[Any], Any]) -> None:
        self._told = told

    def __call__(self, unraisable: Any) -> None:
        error = unraisable.exc_value
        if not (isinstance(error, OSError) and "ignored due to race condition" in str(error)):
            self._told(unraisable)


# The middleware ends a node in milliseconds. Once in some hundred ends it never does (rclpy 7.1, Fast DDS): it then holds
# Python's lock, so that neither a thread nor a signal handler of Python could help.
MAX_END_S = 5.0
SIGEV_THREAD, CLOCK_MONOTONIC = 2, 1


class _SigEvent(ctypes.Structure):
    """struct sigevent of Linux: what happens when a timer is over."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_char * 32),
    )


@contextlib.contextmanager
def end_within(seconds: float, status: int) -> Iterator[None]:
    """End the process with a status if the block takes longer; without Python's lock, by a timer of the C library."""
    libc, timer = ctypes.CDLL(None), ctypes.c_void_p()
    event = _SigEvent(value=status, notify=SIGEV_THREAD, function=ctypes.cast(libc._exit, ctypes.c_void_p))
    # struct itimerspec: interval, then time until the end
    when = (ctypes.c_long * 4)(0, 0, int(seconds), int(seconds % 1 * 1e9))
    # an older C library has timers elsewhere; there the end stays without a bound
    bound = (
        hasattr(libc, "timer_create")
        and libc.timer_create(CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0
    )
    if bound:
        libc.timer_settime(timer, 0, when, None)
    yield
    if bound:
        libc.timer_delete(timer)


# rclpy's signal handler wakes the executor at once, but rarely misses it when two signals come together (rclpy 7.1).
# So the main loop looks itself that often.
NOTICE_S = 0.5


def run(make_nodes: Callable[[], "Iterator[Node]"], help_text: Callable[[], str] | None = None) -> int:
    """Run the nodes that `make_nodes()` yields until a signal stops them; return the process's exit status.

    make_nodes: a generator, started after rclpy.init; it may raise StarposError or one of rclpy's parameter errors to
    refuse to start.
    help_text: makes the text for `--help` or `-h`; None: they have no meaning here.

    At the end, when no callback runs any more, each node that has a `close` is closed, however long that takes; then the
    middleware has MAX_END_S to end, or the process leaves.

    The status is 0 after SIGINT (once or twice) or SIGTERM, and 1 with one line on standard error when the start is
    refused. Any other exception of a callback is a defect: it ends the process with its traceback.
    """
    with stop_signals() as stopped:
        if help_text is not None and not {"--help", "-h"}.isdisjoint(own_arguments(sys.argv[1:])[0]):
            _show(help_text())
            return 0
        return _run(make_nodes, stopped)


def run_executable(
    package: str,
    executable: str,
    about: str,
    make_nodes: Callable[[], "Iterator[Node]"] | str,
    nodes: tuple[str, ...] = (),
) -> int:
    """Run the nodes of an executable as `run` does; `--help` says what it is and explains the nodes' parameters.

    make_nodes: as of `run`, or MODULE:CLASS of its only node, in its package.
    nodes: names in the table of parameters, if not the executable's own.
    """

    def only_node() -> "Iterator[Node]":
        module, _, name = str(make_nodes).partition(":")
        yield getattr(import_module(f"{package}.{module}"), name)()

    def help_text() -> str:
        from starpos_common.parameters import node_help

        return node_help(package, executable, about, *(nodes or (executable,)))

    return run(only_node if isinstance(make_nodes, str) else make_nodes, help_text=help_text)


def own_arguments(args: list[str]) -> tuple[list[str], list[str]]:
    """Split a command line into the program's arguments and ROS's, which begin with `--ros-args`."""
    k = args.index("--ros-args") if "--ros-args" in args else len(args)
    return args[:k], args[k:]


def _show(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # The reader has seen enough (`--help | head`); nor must Python's exit fail when it flushes what is left.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def leave(status: int) -> int:
    """Return the status; if a thread of the node still works, end the process with that status at once.

    At a normal exit the interpreter stops such a thread in the middle of compiled code, which may abort the process.
    """
    if len(threading.enumerate()) > 1:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _run(make_nodes: Callable[[], "Iterator[Node]"], stopped: list[int]) -> int:
    import rclpy
    from rclpy._rclpy_pybind11 import RCLError, UnknownROSArgsError
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions, install_signal_handlers

    from starpos.errors import StarposError
    from starpos_common.parameters import warn_of_unknown

    if stopped:
        return 0
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except UnknownROSArgsError as error:
        # Its text is the list of them alone.
        return 0 if stopped else _refuse(f"unknown arguments after --ros-args: {error}")
    except Exception as error:
        # The command line or a parameter file is wrong; rcl has an error class for each.
        return 0 if stopped else _refuse(error)
    nodes: list[Node] = []
    made = False
    try:
        for node in make_nodes():
            nodes.append(node)
        made = True
        warn_of_unknown(nodes)
        # rclpy's handlers shut the context down, which fails while a node is half made: they come only now.
        # Our own handlers still run.
        install_signal_handlers(SignalHandlerOptions.ALL)
        executor = SingleThreadedExecutor()
        for node in nodes:
            executor.add_node(node)
        while not stopped and rclpy.ok():
            executor.spin_once(timeout_sec=NOTICE_S)
    except ExternalShutdownException:
        pass
    except (StarposError, ParameterException, RCLError) as error:
        if not made and not stopped:
            return _refuse(error)
        if not stopped and rclpy.ok():
            raise
    except Exception:
        # Without the context a callback that still runs fails: that is part of stopping.
        if not stopped and rclpy.ok():
            raise
    finally:
        for node in reversed(nodes):
            if hasattr(node, "close"):
                node.close()
        with end_within(MAX_END_S, int(sys.exc_info()[0] is not None)):
            for node in reversed(nodes):
                node.destroy_node()
            rclpy.try_shutdown()
    return 0


def _refuse(error: Exception | str) -> int:
    sentence = " ".join(str(error).split()) or type(error).__name__
    print(f"{Path(sys.argv[0]).name}: {sentence}", file=sys.stderr, flush=True)
    return 1
