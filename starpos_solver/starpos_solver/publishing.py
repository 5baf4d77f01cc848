# SPDX-License-Identifier: Apache-2.0
"""The solver's topics: `fix`, `heading/imu` and `solver/solution` for each frame, `fix_averaged` for the average."""

from builtin_interfaces.msg import Time
from rclpy.node import Node
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from starpos.averaging.average import Average
from starpos.earth.vertical import Geodetic
from starpos.fix.solver import Solution
from starpos_common.topics import publisher
from starpos_interfaces import msg
from starpos_solver import outputs
from starpos_solver.settings import SolverSettings


class SolutionPublishers:
    """Publishes solutions with the present parameters of the node."""

    def __init__(self, node: Node, settings: SolverSettings) -> None:
        self._settings, self._values = settings, settings.values
        self._fix = publisher(node, NavSatFix, "fix", 10)
        self._fix_averaged = publisher(node, NavSatFix, "fix_averaged", 10)
        self._imu = publisher(node, Imu, "heading/imu", 10)
        self._solution = publisher(node, msg.Solution, "solver/solution", 10)

    def publish(self, stamp: Time, answer: Solution, no_camera: bool) -> None:
        """Publish the solution of a frame; no_camera: no camera calibration has arrived."""
        header, ground = self._header(stamp), outputs.on_ground(answer, self._settings.vertical)
        self._fix.publish(self._nav_sat_fix(header, ground))
        if answer.fix is not None and ground is not None:
            self._imu.publish(outputs.imu(header, answer.fix, ground))
        self._solution.publish(_solution(header, answer, ground, no_camera))

    def solution(self, stamp: Time, answer: Solution, no_camera: bool) -> msg.Solution:
        """Make the message of a solution, for a service."""
        ground = outputs.on_ground(answer, self._settings.vertical)
        return _solution(self._header(stamp), answer, ground, no_camera)

    def average(self, stamp: Time, place: Average) -> NavSatFix:
        """Make the message of an average."""
        return self._nav_sat_fix(
            self._header(stamp), outputs.average_on_ground(place, self._settings.vertical)
        )

    def publish_average(self, message: NavSatFix) -> None:
        """Publish a message that `average` made."""
        self._fix_averaged.publish(message)

    def _header(self, stamp: Time) -> Header:
        return Header(stamp=stamp, frame_id=self._values["frame_id"])

    def _nav_sat_fix(self, header: Header, ground: Geodetic | None) -> NavSatFix:
        return outputs.nav_sat_fix(header, ground, self._values["altitude"], self._values["altitude_stddev"])


def _solution(header: Header, answer: Solution, ground: Geodetic | None, no_camera: bool) -> msg.Solution:
    message = outputs.solution(header, answer, ground)
    if no_camera:
        message.status = msg.Solution.NO_CAMERA
    return message
