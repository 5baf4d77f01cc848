# SPDX-License-Identifier: Apache-2.0
"""The node `solver`: takes stars and tilts, publishes `fix`, `heading/imu` and `solver/solution`."""

from collections.abc import Iterator, Mapping
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, JumpThreshold
from rclpy.clock_type import ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Imu, NavSatFix
from std_srvs.srv import Trigger

from starpos.recording.topics import ALL_INPUTS
from starpos.session import reports
from starpos.session.driver import Output, Sent
from starpos.session.gnss import GNSS_TOPIC, ComparedPlaces
from starpos.session.gyro import IMU_TOPIC
from starpos.session.session import CAMERA_TOPIC, SolverSession
from starpos.session.settings import Settings
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level, time_is_simulated
from starpos_common.topics import Dropped, Receiver, other_publishers, subscription, subscription_from_any
from starpos_common.worker import JobRunner
from starpos_interfaces import msg
from starpos_interfaces.srv import Solve
from starpos_solver.calibration_services import CalibrationServices
from starpos_solver.driver import IMU_QUEUE, NodeDriver, declared, now_of
from starpos_solver.publishing import SolutionPublishers, StaticTransforms

POLL_S = 0.02
# messages that may wait for the executor
QUEUES = {"tilt": 1000, "stars": 100}
PLAY_SLOWER = (
    "play it slower, or by `ros2 run starpos_bringup replay`; frames without them have other fixes, or none"
)
TICK = JumpThreshold(min_forward=Duration(nanoseconds=1), min_backward=Duration(nanoseconds=-1))


class SolverNode(Node):
    """Publishes the place and the attitude of the instrument; see README.md.  Decisions are in starpos.session."""

    def __init__(self) -> None:
        super().__init__("solver")
        self._settings = Settings({})
        declared(self, "solver", self._settings, self._apply)
        self._values = self._settings.values
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        gyro = (IMU_TOPIC,) * self._values["gyro"]
        orbits = self._settings.orbits is not None
        trails, gnss = ("trails",) * orbits, (GNSS_TOPIC,) * (self._values["gnss.use"] and not orbits)
        # at a known place a heading needs no tilt
        tilt = ("tilt",) * (self._settings.site is None and not gnss)
        self._driver = NodeDriver(self, ("camera_info", "stars", *trails, *tilt, *gyro, *gnss))
        self._dropped = Dropped(self, PLAY_SLOWER)
        self._session = SolverSession(
            self._settings,
            lambda: JobRunner(self, self._go_on),
            self._driver,
            arrived=self._arrived,
            topic=self.resolve_topic_name(CAMERA_TOPIC),
        )
        self._connect()

    def _connect(self) -> None:
        self._outputs = SolutionPublishers(self, self._settings)
        self._transforms = StaticTransforms(self)
        session = self._session
        subscription_from_any(self, CameraInfo, CAMERA_TOPIC, self._receiver(CAMERA_TOPIC), 10)
        self._ears = {
            name: subscription(self, kind, name, self._receiver(name), QUEUES[name])
            for name, kind in (("tilt", msg.Tilt), ("stars", msg.StarArray))
        }
        if session.satellites is not None:
            subscription(self, msg.TrailArray, "trails", self._receiver("trails"), 10)
        self._again = self.create_guard_condition(self._go_on)
        if self._values["gyro"]:
            best_effort = ReliabilityPolicy.BEST_EFFORT
            subscription(self, Imu, IMU_TOPIC, self._on_imu, IMU_QUEUE, best_effort)
        self._gnss = ComparedPlaces()
        hear = self._compare_gnss if session.gnss is None else self._receiver(GNSS_TOPIC)
        # receivers' drivers publish in either way
        subscription(self, NavSatFix, GNSS_TOPIC, hear, 10, ReliabilityPolicy.BEST_EFFORT)
        self.create_service(Solve, "~/solve", self._on_solve)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(Trigger, "~/deflection", self._on_deflection)
        self._calibration_services = CalibrationServices(self, self._session, self._settings)
        group = MutuallyExclusiveCallbackGroup()
        self._poll = self.create_timer(
            POLL_S, self._go_on, callback_group=group, clock=self._steady, autostart=False
        )
        self._tick = self.get_clock().create_jump_callback(TICK, post_callback=lambda _: self._go_on())
        tasks = {
            "Solution": self._report_solution,
            "Inputs": lambda: self._driver.report({"tilts kept": len(session.tilts)}, self._dropped.counts),
            "Outputs": self._report_outputs,
            "Clock": self._report_clock,
            "Conditions": self._report_conditions,
            "Calibration": session.calibrating.report,
            "Average": session.calibrating.average.report,
        }
        if session.gnss is not None:
            tasks["GNSS"] = session.gnss.report
        if session.satellites is not None:
            tasks["Satellites"] = session.satellites.report
        if session.deflection.measures:
            tasks["Deflection"] = session.deflection.report
        self._diagnostics = Diagnostics(self, tasks, self._values["frame_id"])
        self._update_transforms()

    def close(self) -> None:
        """Keep what GNSS taught."""
        if self._session.gnss is not None:
            self._session.gnss.close()

    def _apply(self, names: frozenset[str]) -> None:
        self._diagnostics.hardware_id = self._values["frame_id"]
        self._session.parameters_set(names)
        self._update_transforms()

    # inputs ----------------------------------------------------------------------------------------------------------

    def _receiver(self, name: str) -> Receiver:
        """What takes the messages of a topic: the session receives them, and its outputs are published."""

        def receive(message: Any, info: Mapping[str, Any]) -> None:
            self._note_dropped(name, info)
            self._publish(self._session.receive(ALL_INPUTS[name], message, now_of(self), _sent(info)))

        return receive

    def _compare_gnss(self, message: NavSatFix) -> None:
        self._gnss.receive(message, now_of(self))

    def _on_imu(self, message: Imu) -> None:
        self._session.gyro.receive(message, now_of(self))

    def _note_dropped(self, name: str, info: Mapping[str, Any]) -> None:
        if time_is_simulated(self):
            self._dropped.came(name, info)

    def _arrived(self, name: str) -> Iterator[tuple[Any, Sent]]:
        """Read what has arrived of a topic, by its relative name, but waits for the executor."""
        ear = self._ears[name]
        with ear.handle:
            for _ in range(QUEUES[name]):
                taken = ear.handle.take_message(ear.msg_type, False)
                if taken is None:
                    return
                self._note_dropped(name, taken[1])
                yield taken[0], _sent(taken[1])

    def _go_on(self) -> None:
        """Go on with the frames that wait, because time has passed or a job is done."""
        self._publish(self._session.at(now_of(self)))
        self._update_transforms()

    def _update_transforms(self) -> None:
        solver = self._session.instrument.solver
        self._transforms.update(
            self._values["publish_tf"],
            self._values["frame_id"],
            self._session.instrument.frame_id,
            self._session.tilts.frame_id,
            solver.instrument if solver else None,
        )

    def _publish(self, outputs: list[Output]) -> None:
        for output in outputs:
            self._outputs.publish(output)
        if outputs:
            self._update_transforms()
        if self._session.more:
            self._again.trigger()
        # poll only while a frame waits; where the clock is played, its ticks do
        waits = self._session.waits and not time_is_simulated(self)
        if waits and self._poll.is_canceled():
            self._poll.reset()
        elif not waits and not self._poll.is_canceled():
            self._poll.cancel()

    # services --------------------------------------------------------------------------------------------------------

    def _on_solve(self, request: Solve.Request, response: Solve.Response) -> Solve.Response:
        answered = self._session.solve_again()
        if answered is None:
            response.message = "no frame has arrived yet: start the camera and the detector"
            response.solution = msg.Solution(status=msg.Solution.BAD_INPUT, status_text=response.message)
            return response
        response.solution = self._outputs.solution(answered)
        response.success, response.message = answered.solution.ok, answered.solution.message
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._session.reset()
        response.success = True
        response.message = "tilts, frames and the place are forgotten; a calibration that was found is not"
        return response

    def _on_deflection(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._session.deflection.measures:
            response.message = (
                "no deflection is measured: start the solver with deflection.wanted, a site and altitude"
            )
            return response
        told = self._session.deflection.report()
        response.success, response.message = told.level == Level.OK, told.message
        return response

    # diagnostics -----------------------------------------------------------------------------------------------------

    def _report_solution(self) -> Diagnosis:
        session = self._session
        if session.answer is None:
            waiting = (
                "building the triangles of this field" if session.instrument.preparing else "no frame yet"
            )
            return Diagnosis(Level.WARN, session.instrument.trouble or waiting, session.pace.counts)
        remarks = session.pace.complaint, self._gnss.remark(session.answer, self._settings.vertical)
        known = {} if (site := self._settings.site) is None else reports.of_site(site)
        return reports.of_solution(
            session.answer, session.pace.counts | known, "; ".join(filter(None, remarks))
        )

    def _report_outputs(self) -> Diagnosis:
        if others := other_publishers(self, self._outputs.shared):
            return Diagnosis(Level.WARN, others)
        return Diagnosis(Level.OK, "no other node publishes on fix or heading/imu")

    def _report_clock(self) -> Diagnosis:
        latest, solver = self._session.latest, self._session.instrument.solver
        if latest is None:
            return Diagnosis(Level.WARN, "no frame yet")
        stars = latest.stars
        clock_s = solver.clock_stddev_s(stars) if solver else stars.clock_stddev_s
        doubt_s = self._session.doubt.seconds if latest.doubted else 0.0
        return reports.of_clock(clock_s, stars.stamp_stddev_s, latest.ahead_s, doubt_s)

    def _report_conditions(self) -> Diagnosis:
        instrument = self._settings.instrument(self._session.calibrating.found)
        tilt = self._session.answer.tilt if self._session.answer else None
        latest, solver = self._session.latest, self._session.instrument.solver
        shutter = solver.shutter(latest.stars) if latest and solver else None
        return reports.of_conditions(self._values, instrument, tilt, shutter)


def _sent(info: Mapping[str, Any]) -> Sent:
    """What the middleware reports of a message."""
    written_ns = info.get("source_timestamp")
    return Sent(info.get("publication_sequence_number"), written_ns * 1e-9 if written_ns else None)
