# SPDX-License-Identifier: Apache-2.0
"""Nodes as processes of their own, someone who listens to them, and frames for them."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter

from starpos.catalogue import load as load_catalogue
from starpos.night import write_fits
from starpos.simulate import expose, render, scene_of

WAIT_S = 30.0
SIZE = (640, 480)
FOCAL_PX = 7812.5  # 50 mm on 6.4 um
START_S = 1793642400.0  # 2026-11-02T18:00:00Z
EXPOSURE_S = 0.5


@pytest.fixture(scope="session", autouse=True)
def domain():
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


class Listener:
    """A node that keeps what it hears and waits for what it wants."""

    def __init__(self, context):
        self.node = rclpy.create_node("listener", context=context)
        self.states = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnostics, 10)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=context)
        self._executor.add_node(self.node)

    def _diagnostics(self, message):
        self.states |= {status.name: status for status in message.status}

    def hear(self, kind, topic) -> list:
        heard = []
        self.node.create_subscription(kind, topic, heard.append, 10)
        return heard

    def wait(self, condition):
        end = time.monotonic() + WAIT_S
        while not condition():
            assert time.monotonic() < end, self.states
            self._executor.spin_once(timeout_sec=0.5)

    def wait_for_state(self, name, level, text):
        """The state of that name, once it has the level and its sentence holds the text."""
        self.states.pop(name, None)
        self.wait(
            lambda: (
                name in self.states
                and self.states[name].level == bytes([level])
                and text in self.states[name].message
            )
        )
        return {v.key: v.value for v in self.states[name].values}

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def set(self, node, **values):
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        request = SetParametersAtomically.Request(parameters=parameters)
        return self.call(SetParametersAtomically, f"/{node}/set_parameters_atomically", request).result


@pytest.fixture
def listener():
    context = rclpy.Context()
    rclpy.init(context=context)
    listener = Listener(context)
    yield listener
    listener.node.destroy_node()
    rclpy.shutdown(context=context)


class Process:
    def __init__(self, executable, parameters):
        program = f"import sys; from starpos_camera.main import {executable}; sys.exit({executable}())"
        options = [word for p in parameters for word in ("-p", p)]
        self.process = subprocess.Popen(
            [sys.executable, "-c", program, "--ros-args", *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def end(self, *signals):
        """Send the signals; the exit status and all output."""
        for number in signals:
            self.process.send_signal(number)
        out, _ = self.process.communicate(timeout=WAIT_S)
        return self.process.returncode, out


@pytest.fixture
def start():
    processes = []

    def start(executable, *parameters):
        processes.append(Process(executable, parameters))
        return processes[-1]

    yield start
    for p in processes:
        if p.process.poll() is None:
            p.process.kill()
            p.process.communicate()


@pytest.fixture(scope="session")
def scene():
    return scene_of(SIZE, FOCAL_PX)


@pytest.fixture(scope="session")
def frame(scene):
    """A frame with some tens of stars."""
    rng = np.random.default_rng(3)
    return render(scene, expose(scene, load_catalogue(), START_S, EXPOSURE_S, rng), START_S, EXPOSURE_S, rng)


@pytest.fixture
def folder(tmp_path, frame):
    """Three frames, 5 s apart, the middle one truncated; the others are 0.fits and 2.fits."""
    for k in range(3):
        write_fits(tmp_path / f"{k}.fits", frame, f"2026-11-02T18:00:{5 * k:02d}")
    middle = tmp_path / "1.fits"
    middle.write_bytes(middle.read_bytes()[:100_000])
    return tmp_path
