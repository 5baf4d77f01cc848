# SPDX-License-Identifier: Apache-2.0
"""The installed executables as processes, and a node that feeds and hears them; it waits for events, never sleeps."""

import signal
import subprocess
import time
from pathlib import Path

import rclpy
from ament_index_python.packages import get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, Imu, NavSatFix

from starpos_interfaces.msg import Capture, Solution, StarArray, Tilt
from starpos_testing.nodes import take_all
from starpos_testing.patience import WAIT_S
from starpos_testing.prepared import Child, interpreted

# Until another photograph is sent: nodes that have not met lose it.
AGAIN_S = 2.0


def executable(package: str, name: str) -> str:
    return str(Path(get_package_prefix(package)) / "lib" / package / name)


class Executable:
    """An executable of this workspace as a process; its output goes to a file, as a pipe without a reader blocks."""

    def __init__(self, log: Path, package: str, name: str, arguments=(), parameters=(), start=interpreted):
        options = [word for p in parameters for word in ("-p", p)]
        command = [executable(package, name), *arguments, *(["--ros-args", *options] if options else [])]
        self.name, self.log = name, log
        with log.open("w") as out:
            self.process: Child = start(command, package, out)

    @property
    def output(self) -> str:
        return self.log.read_text()

    def signal(self, *numbers):
        for number in numbers:
            self.process.send_signal(number)

    def wait(self) -> int:
        return self.process.wait(WAIT_S)

    def end(self):
        """End the process in any state, by a signal that it handles, so that the other nodes notice."""
        if self.process.poll() is None:
            self.signal(signal.SIGINT)
        try:
            self.process.wait(WAIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def stamp_of(message) -> tuple[int, int]:
    return message.header.stamp.sec, message.header.stamp.nanosec


class Graph:
    """A node that publishes all inputs of the graph and keeps all its outputs by stamp.

    start: how it starts executables that are not started otherwise, `interpreted` or `forked`.
    """

    def __init__(self, start=interpreted):
        self._start = start
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("test", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.processes: list[Executable] = []
        self.info = self._publisher(CameraInfo, "camera/camera_info")
        self.capture = self._publisher(Capture, "camera/capture")
        # a participant of its own, as a camera has: images fill its shared memory, and lost messages come a second later
        self._camera_context = rclpy.Context()
        rclpy.init(context=self._camera_context)
        self._camera = rclpy.create_node("test_camera", context=self._camera_context)
        self.image = self._camera.create_publisher(Image, "camera/image_raw", QoSProfile(depth=2))
        self.stars = self._publisher(StarArray, "stars")
        self.tilt = self._publisher(Tilt, "tilt", 1000)
        # whether there is a new solver that may not know us yet
        self._solver_is_new = False
        self.solutions, self.fixes, self.imus = {}, {}, {}
        # by name: (seconds, status)
        self.diagnostics: dict[str, list] = {}
        self._ears = [
            self._keep(Solution, "solver/solution", self.solutions),
            self._keep(NavSatFix, "fix", self.fixes),
            self._keep(Imu, "heading/imu", self.imus),
        ]
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)

    def close(self):
        for p in self.processes:
            p.end()
        self._executor.shutdown()
        self.node.destroy_node()
        self._camera.destroy_node()
        rclpy.shutdown(context=self._context)
        rclpy.shutdown(context=self._camera_context)

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
        heard: list = []
        self.node.create_subscription(kind, topic, heard.append, qos)
        return heard

    def start(self, log: Path, package: str, name: str, *parameters, arguments=(), start=None) -> Executable:
        made = Executable(log, package, name, arguments, parameters, start or self._start)
        self.processes.append(made)
        return self.processes[-1]

    def comes(self, condition, seconds: float) -> bool:
        """Whether a condition becomes true within a time in s."""
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                return False
            self._executor.spin_once(timeout_sec=0.2)
        return True

    def spin_once(self, seconds: float) -> None:
        """Take a message, if one comes within a time in s."""
        self._executor.spin_once(timeout_sec=seconds)

    def wait(self, condition, why="", seconds=WAIT_S) -> None:
        if not self.comes(condition, seconds):
            tails = "\n".join(f"{p.name}: {p.output[-2000:]}" for p in self.processes)
            raise AssertionError(f"waited in vain {why}\n{tails}")

    def wait_for_solver(self):
        """Wait until the solver hears our publishers and we hear its; call it before a detector is there."""

        def counts():
            ears = [e.get_publisher_count() for e in self._ears]
            # a node subscribes to camera_info several times, to hear it however it is published
            heard = self.info.get_subscription_count() > 0
            return [int(heard), *(p.get_subscription_count() for p in (self.stars, self.tilt)), *ears]

        if not self.comes(lambda: counts() == [1] * 6, WAIT_S):
            raise AssertionError(f"the solver is not there, or there are two: {counts()}")
        self._solver_is_new = True

    def wait_for_detector(self, photograph):
        """Wait until an image comes back as a solution, which is the only proof that detector and solver have met."""
        self.wait(lambda: self.image.get_subscription_count() and self.capture.get_subscription_count())
        self.photograph_until(lambda stamps: any(s in self.solutions for s in stamps), photograph)

    def photograph_until(self, condition, photograph):
        """Send photographs until a condition of all their stamps is true, and wait until no more answers to them come."""
        stamps: list[tuple[int, int]] = []

        def come():
            shot, image, capture = photograph()
            stamps.append(shot.stamp)
            self.send(shot, image, capture)
            return self.comes(lambda: condition(stamps), AGAIN_S)

        self.wait(come, "for what becomes of photographs")
        # frames are answered in their order and the newest is never dropped: after it no other answer comes
        self.result(stamps[-1])
        for stamp in stamps:
            if stamp in self.solutions:
                self.result(stamp)

    def send(self, shot, image=None, capture=None):
        """Publish a shot's intrinsics, its tilts, then its stars or the image that they are in."""
        self.info.publish(shot.info)
        if self._solver_is_new:
            # our publisher knows the solver before the solver knows it: the stars would overtake the intrinsics
            heard = self.info.wait_for_all_acked(Duration(seconds=WAIT_S))
            assert heard, "the solver has not acknowledged its intrinsics"
            self._solver_is_new = False
        for tilt in shot.tilts:
            self.tilt.publish(tilt)
        if image is None:
            self.stars.publish(shot.stars)
        else:
            self.capture.publish(capture)
            self.image.publish(image)

    def answer(self, shot):
        """Send a shot; returns the Solution and the NavSatFix of its stamp, and the Imu if the solution is a fix."""
        self.send(shot)
        return self.result(shot.stamp)

    def result(self, stamp):
        self.wait(lambda: stamp in self.solutions and stamp in self.fixes, f"for the solution of {stamp}")
        solution = self.solutions[stamp][-1]
        if solution.status != Solution.OK:
            return solution, self.fixes[stamp][-1], None
        self.wait(lambda: stamp in self.imus, "for heading/imu")
        return solution, self.fixes[stamp][-1], self.imus[stamp][-1]

    def state(self, name: str, text: str) -> object:
        """Wait for the next diagnostic of a name with this text in its sentence."""
        take_all(self._executor)
        self.diagnostics.pop(name, None)

        def found():
            return [s for _, s in self.diagnostics.get(name, ()) if text in s.message]

        if not self.comes(found, WAIT_S):
            said = [s.message for _, s in self.diagnostics.get(name, ())][-1:]
            self.wait(found, f"for {name} to say {text!r}; it said {said}", 0.0)
        return found()[-1]

    def call(self, kind, name, request):
        client = self.node.create_client(kind, name)
        self.wait(client.service_is_ready, f"for the service {name}")
        future = client.call_async(request)
        self.wait(future.done, f"for the answer of {name}")
        self.node.destroy_client(client)
        return future.result()

    def set(self, node: str, **values):
        """Set parameters, with dots written as __; returns (successful, reason)."""
        parameters = [
            Parameter(name.replace("__", "."), value=value).to_parameter_msg()
            for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        result = self.call(SetParametersAtomically, f"/{node}/set_parameters_atomically", request).result
        return result.successful, result.reason
