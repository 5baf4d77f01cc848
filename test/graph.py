# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes, and a node that feeds and hears them; it waits for events, never sleeps."""

import subprocess
import time
from pathlib import Path

import rclpy
from ament_index_python.packages import get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Imu, NavSatFix

from starpos_interfaces.msg import Capture, Solution, StarArray, Tilt

WAIT_S = 40.0  # for anything; a fresh machine builds its star triangles meanwhile


def executable(package: str, name: str) -> str:
    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Process:
    """An executable of this workspace; its output goes to a file, which a pipe nobody reads would block."""

    def __init__(self, log: Path, package: str, name: str, arguments=(), parameters=()):
        options = [word for p in parameters for word in ("-p", p)]
        command = [executable(package, name), *arguments, *(["--ros-args", *options] if options else [])]
        self.name, self.log = name, log
        with log.open("w") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)

    @property
    def output(self) -> str:
        return self.log.read_text()

    def signal(self, *numbers):
        for number in numbers:
            self.process.send_signal(number)

    def wait(self) -> int:
        return self.process.wait(WAIT_S)

    def kill(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def stamp_of(message) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


class Graph:
    """A node with publishers for every input and an ear on every output, kept by stamp."""

    def __init__(self):
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("test", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.processes: list[Process] = []
        self.info = self._publisher(CameraInfo, "camera/camera_info")
        self.capture = self._publisher(Capture, "camera/capture")
        self.image = self._publisher(Image, "camera/image_raw", 2)
        self.stars = self._publisher(StarArray, "stars")
        self.tilt = self._publisher(Tilt, "tilt", 1000)
        self.solutions, self.fixes, self.imus = {}, {}, {}
        self.diagnostics: dict[str, list] = {}  # (seconds, status) by name
        self._ears = [
            self._keep(Solution, "solver/solution", self.solutions),
            self._keep(NavSatFix, "fix", self.fixes),
            self._keep(Imu, "heading/imu", self.imus),
        ]
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def close(self):
        for p in self.processes:
            p.kill()
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _publisher(self, kind, topic, depth=100):
        return self.node.create_publisher(kind, topic, QoSProfile(depth=depth))

    def _keep(self, kind, topic, kept: dict):
        def keep(message):
            kept.setdefault(stamp_of(message), []).append(message)

        return self.node.create_subscription(kind, topic, keep, 100)

    def _diagnose(self, message):
        for status in message.status:
            self.diagnostics.setdefault(status.name, []).append((time.monotonic(), status))

    def hear(self, kind, topic, qos=100) -> list:
        heard = []
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def start(self, log: Path, package: str, name: str, *parameters, arguments=()) -> Process:
        self.processes.append(Process(log, package, name, arguments, parameters))
        return self.processes[-1]

    def wait(self, condition, why="") -> None:
        end = time.monotonic() + WAIT_S
        while not condition():
            if time.monotonic() > end:
                tails = "\n".join(f"{p.name}: {p.output[-2000:]}" for p in self.processes)
                raise AssertionError(f"waited {WAIT_S:g} s in vain {why}\n{tails}")
            self._executor.spin_once(timeout_sec=0.2)

    def wait_for_solver(self):
        """Until it hears our publishers and we hear its."""
        self.wait(
            lambda: (
                all(p.get_subscription_count() == 1 for p in (self.info, self.stars, self.tilt))
                and all(e.get_publisher_count() == 1 for e in self._ears)
                and self.node.count_publishers("stars") >= 1
            ),
            "for the solver",
        )

    def wait_for_detector(self):
        self.wait(lambda: self.image.get_subscription_count() and self.capture.get_subscription_count())
        self.wait(lambda: self.node.count_publishers("stars") == 2, "for the detector")

    def stop(self, process: Process, *signals) -> int:
        """Signal it and wait until it is gone from the graph as well; its exit status."""
        process.signal(*signals)
        status = process.wait()
        self.processes.remove(process)
        self.wait(
            lambda: process.name not in self.node.get_node_names(), f"for {process.name} to leave the graph"
        )
        return status

    def forget(self):
        for kept in (self.solutions, self.fixes, self.imus):
            kept.clear()

    def answer(self, shot, tilts=None):
        """Send a shot; the Solution and the NavSatFix of its stamp, and the Imu where the solution is one."""
        self.info.publish(shot.info)
        for tilt in shot.tilts if tilts is None else tilts:
            self.tilt.publish(tilt)
        self.stars.publish(shot.stars)
        return self.result(shot.stamp)

    def result(self, stamp):
        self.wait(lambda: stamp in self.solutions and stamp in self.fixes, f"for the solution of {stamp}")
        solution = self.solutions[stamp][-1]
        if solution.status != Solution.OK:
            return solution, self.fixes[stamp][-1], None
        self.wait(lambda: stamp in self.imus, "for heading/imu")
        return solution, self.fixes[stamp][-1], self.imus[stamp][-1]

    def state(self, name: str, text: str) -> object:
        """The next diagnostic of that name whose sentence holds the text."""
        self.diagnostics.pop(name, None)

        def found():
            return [s for _, s in self.diagnostics.get(name, ()) if text in s.message]

        self.wait(found, f"for {name} to say {text!r}; it said {self.diagnostics.get(name, [])[-1:]}")
        return found()[-1]

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, f"for the service {name}")
        future = client.call_async(request)
        self.wait(future.done, f"for the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def set(self, node: str, **values):
        """Set parameters, dots written as __; (successful, reason)."""
        parameters = [
            Parameter(name.replace("__", "."), value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = self.call(SetParametersAtomically, f"/{node}/set_parameters_atomically", request).result
        return result.successful, result.reason
