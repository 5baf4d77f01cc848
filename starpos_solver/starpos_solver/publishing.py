# SPDX-License-Identifier: Apache-2.0
"""The solver's topics: `fix`, `heading/imu`, `attitude`, `solver/solution` of frames, `fix_averaged` of the average.

With gnss.use `gnss/check` too.
"""

from builtin_interfaces.msg import Time
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import Imu, NavSatFix
from std_msgs.msg import Header

from starpos.earth.vertical import Geodetic
from starpos.session.frames import Answered, Averaged, Output
from starpos_common.messages import attitude_to_message
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
        self._attitude = publisher(node, msg.Attitude, "attitude", 10)
        self._solution = publisher(node, msg.Solution, "solver/solution", 10)
        self._check = publisher(node, msg.GnssCheck, "gnss/check", 10) if self._values["gnss.use"] else None

    @property
    def publishers(self) -> tuple[Publisher, ...]:
        """The publishers of all topics, the solution's first."""
        check = () if self._check is None else (self._check,)
        return self._solution, self._fix, self._fix_averaged, self._imu, self._attitude, *check

    @property
    def shared(self) -> tuple[Publisher, ...]:
        """The publishers of topics whose names other drivers have, too."""
        return self._fix, self._imu

    def publish(self, output: Output) -> None:
        """Publish a session's results."""
        header = self._header(output.stamp)
        if isinstance(output, Averaged):
            self._fix_averaged.publish(self._nav_sat_fix(header, output.ground))
            return
        self._fix.publish(self._nav_sat_fix(header, output.ground))
        fix, at_place, beside = output.solution.fix, output.solution.at_place, output.beside
        if at_place is not None:
            self._imu.publish(outputs.imu_at_place(header, at_place.true_north))
        elif fix is not None and output.ground is not None:
            self._imu.publish(outputs.imu(header, fix, output.ground))
        if self._check is not None and beside is not None and beside.compared is not None:
            self._check.publish(outputs.gnss_check(header, beside.compared))
        if output.attitude is not None:
            self._attitude.publish(attitude_to_message(output.attitude))
        self._solution.publish(self.solution(output))

    def solution(self, answered: Answered) -> msg.Solution:
        """Make the message of a solution."""
        message = outputs.solution(self._header(answered.stamp), answered.solution, answered.ground)
        if answered.no_camera:
            message.status = msg.Solution.NO_CAMERA
        return message

    def _header(self, stamp: Time) -> Header:
        return Header(stamp=stamp, frame_id=self._values["frame_id"])

    def _nav_sat_fix(self, header: Header, ground: Geodetic | None) -> NavSatFix:
        return outputs.nav_sat_fix(header, ground, self._values["altitude"], self._values["altitude_stddev"])
