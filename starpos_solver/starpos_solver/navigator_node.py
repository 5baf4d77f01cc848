# SPDX-License-Identifier: Apache-2.0
"""The node `navigator`: takes an IMU, attitudes and velocities, publishes place, heading and velocity under way."""

from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

from starpos.parameters.table import parameters_of
from starpos.session.driver import Now
from starpos.session.navigator import NavigatorSession
from starpos.session.navigator_parameters import NavigatorSettings
from starpos_common.diagnostics import Diagnostics, time_is_simulated
from starpos_common.parameters import declare
from starpos_common.topics import subscription
from starpos_common.worker import JobRunner
from starpos_interfaces.msg import Attitude
from starpos_solver.driver import IMU_QUEUE, Inputs, NodeLog
from starpos_solver.publishing import NavigatorPublishers


class NavigatorNode(Node):
    """Publishes the place of a vehicle under way; see README.md.  Decisions are in starpos.session."""

    def __init__(self) -> None:
        super().__init__("navigator")
        self._settings = NavigatorSettings({})
        self._settings.values = declare(
            self, parameters_of("navigator"), apply=self._adopted, check=self._settings.check
        )
        self._settings.adopt()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._played = time_is_simulated(self)
        self._inputs = Inputs(self, ("imu/data", "attitude"))
        self._session = NavigatorSession(
            self._settings, lambda: JobRunner(self), self._inputs, NodeLog(self.get_logger())
        )
        self._outputs = NavigatorPublishers(self, self._settings)
        session, best_effort = self._session, ReliabilityPolicy.BEST_EFFORT
        subscription(self, Imu, "imu/data", self._on_imu, IMU_QUEUE, best_effort)
        subscription(self, Attitude, "attitude", self._on_attitude, 100)
        for kind, name in ((Odometry, "odom"), (TwistWithCovarianceStamped, "twist")):
            subscription(
                self,
                kind,
                name,
                lambda m, n=name: session.take_velocity(m, self._now(), n),
                1000,
                best_effort,
            )
        subscription(
            self, NavSatFix, "gnss/fix", lambda m: session.take_gnss(m, self._now()), 10, best_effort
        )
        self.create_service(Trigger, "~/reset", self._on_reset)
        self._diagnostics = Diagnostics(
            self,
            {"Navigation": session.report, "Inputs": lambda: self._inputs.report({}, {})},
            self._settings.values["frame_id"],
        )

    def _adopted(self, names: frozenset[str]) -> None:
        self._settings.adopt()
        self._diagnostics.hardware_id = self._settings.values["frame_id"]
        self._outputs.parameters_set()
        self._session.parameters_set()

    def _now(self) -> Now:
        now_ns = self.get_clock().now().nanoseconds
        unix_s = now_ns * 1e-9 if now_ns else None
        return Now.in_data(unix_s) if self._played else Now(unix_s, self._steady.now().nanoseconds * 1e-9)

    def _on_imu(self, message: Imu) -> None:
        for output in self._session.take_imu(message, self._now()):
            self._outputs.publish(output)

    def _on_attitude(self, message: Attitude) -> None:
        for output in self._session.take_attitude(message, self._now()):
            self._outputs.publish(output)

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._session.reset()
        response.success, response.message = True, "the voyage is forgotten; a new one begins"
        return response
