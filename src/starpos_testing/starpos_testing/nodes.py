# SPDX-License-Identifier: Apache-2.0
"""Helpers for the tests of a node: the node as a process, and a listener that waits for events and never sleeps."""

import atexit
import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache
from pathlib import Path

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy._rclpy_pybind11 import RCLError
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from starpos.errors import StarposError
from starpos_testing.domain import own_domain
from starpos_testing.patience import WAIT_S
from starpos_testing.prepared import forked


@cache
def take_domain() -> None:
    """A ROS domain of this process alone, until it ends; what starts in it is found at once."""
    held = ExitStack()
    held.enter_context(own_domain())
    atexit.register(held.close)
    # the profile of the launch files; where their package is not built, nodes find each other some seconds later
    with suppress(PackageNotFoundError):
        profile = Path(get_package_share_directory("starpos_bringup"), "config", "quick_start.xml")
        os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)


def refusal(make: Callable[[], Node], *parameters: str) -> str:
    """The sentence with which a node refuses parameters NAME:=VALUE; in this process, as another one takes a second."""
    given = [word for p in parameters for word in ("-p", p)]
    rclpy.init(args=["--ros-args", *given], signal_handler_options=SignalHandlerOptions.NO)
    try:
        make().destroy_node()
    except (StarposError, ParameterException, RCLError) as error:
        return str(error)
    finally:
        rclpy.try_shutdown()
    raise AssertionError(f"taken: {parameters}")


def take_all(executor: SingleThreadedExecutor) -> None:
    """Take every message that has come: one that comes later was sent after what has been heard so far."""
    taken = True
    while taken:
        taken = False
        # it ends a round, in which each subscription gives one message
        with suppress(TimeoutException):
            while True:
                handler, *_ = executor.wait_for_ready_callbacks(timeout_sec=0)
                taken = True
                handler()
                # raises what a callback has raised
                handler.result()


class Listener:
    """A node that keeps the messages it hears and waits for conditions; states: the newest diagnostics by name."""

    def __init__(self):
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("listener", context=self._context)
        self.states = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnostics, 10)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _diagnostics(self, message):
        self.states |= {status.name: status for status in message.status}

    def hear(self, kind, topic: str, depth: int = 10) -> list:
        """Subscribe to a topic; returns the list that its messages are appended to."""
        heard: list = []
        self.node.create_subscription(kind, topic, heard.append, depth)
        return heard

    def wait(self, condition):
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, self.states
            self._executor.spin_once(timeout_sec=0.1)

    def wait_for_state(self, name: str, level: int, text: str = "") -> dict[str, str]:
        """Wait for the next diagnostic of a name with this level and this text in its sentence; returns its values."""
        take_all(self._executor)
        self.states.pop(name, None)

        def come():
            state = self.states.get(name)
            return state and state.level == bytes([level]) and text in state.message

        self.wait(come)
        return {v.key: v.value for v in self.states[name].values}

    def values_of(self, name: str, condition) -> dict[str, str]:
        """Wait until the values of a name's diagnostic, whatever its level, fulfil a condition; returns them."""

        def values():
            state = self.states.get(name)
            return {v.key: v.value for v in state.values} if state else {}

        self.wait(lambda: values() and condition(values()))
        return values()

    def call(self, kind, name: str, request):
        """Call a service; returns its answer."""
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def set(self, node: str, **values):
        """Set a node's parameters, all or none; returns the SetParametersResult."""
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call(SetParametersAtomically, f"/{node}/set_parameters_atomically", request).result


class Process:
    """The function `executable` of a module, run as a program; its output goes to a file."""

    def __init__(self, module: str, executable: str, parameters, namespace: str = "/"):
        program = f"import sys; from {module} import {executable}; sys.exit({executable}())"
        options = [word for p in parameters for word in ("-p", p)]
        command = [sys.executable, "-c", program, "--ros-args", "-r", f"__ns:={namespace}", *options]
        self._open = ExitStack()
        self._out = self._open.enter_context(tempfile.TemporaryFile("w+"))  # noqa: SIM115
        self._process = forked(command, module.split(".")[0], self._out)

    def end(self, *signals) -> tuple[int, str]:
        """Send the signals; returns the exit status and all output."""
        for number in signals:
            self._process.send_signal(number)
        status = self._process.wait(WAIT_S)
        self._out.seek(0)
        with self._open:
            return status, self._out.read()

    def kill(self):
        """Kill the program if a test has left it running."""
        self._process.kill()
        self._process.wait()
        self._open.close()
