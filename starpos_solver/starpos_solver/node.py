# SPDX-License-Identifier: Apache-2.0
"""The node `solver`: takes stars and tilts, publishes `fix`, `heading/imu` and `solver/solution`."""

import math
import traceback
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from builtin_interfaces.msg import Time
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from starpos.earth.orientation import earth_state
from starpos.errors import InstrumentError, StarposError, TiltError, TimeError
from starpos.fix.fix import Fix
from starpos.fix.solver import Solution, Solver, Status
from starpos.frames.stars import Stars
from starpos.identification.hint import Hint
from starpos.instrument.camera import Camera
from starpos.recording.messages import message_to_camera, message_to_stars, stamp_to_unix
from starpos.sky import catalogue
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.job import JobRunner, Outcome
from starpos_common.paths import path_of
from starpos_common.topics import subscription
from starpos_interfaces import msg
from starpos_interfaces.srv import SaveCalibration, Solve
from starpos_solver import reports, saving
from starpos_solver.calibrating import Calibrating
from starpos_solver.clock_doubt import ClockDoubt
from starpos_solver.inputs import Inputs
from starpos_solver.memory import Seen
from starpos_solver.node_time import NodeTime
from starpos_solver.publishing import SolutionPublishers
from starpos_solver.settings import SolverSettings
from starpos_solver.tilts import TiltBuffer

# Most frames that wait for their tilts or for the triangles; older ones are dropped.
WAITING = 4
POLL_S = 0.02
TILT_QUEUE = 1000
J2000_UNIX_S = 946_728_000.0
# A stamp in the future is wrong beyond AHEAD_S and so many stated errors.
CLOCK_SIGMAS = 6.0


@dataclass(frozen=True)
class Waiting:
    """A frame that waits: its message, and its stars with the error of their time.

    since_ns: when it came, on the steady clock.
    ahead_s: how far the middle of its exposure was ahead of this node's clock then.
    doubted: whether its stars contradict its time.
    """

    message: msg.StarArray
    stars: Stars
    since_ns: int
    ahead_s: float
    doubted: bool = False


class SolverNode(Node):
    """Publishes the place and the attitude of the instrument; see README.md."""

    def __init__(self) -> None:
        super().__init__("solver")
        self._camera: Camera | None = None
        self._settings = SolverSettings(self, lambda: self._camera, self._apply)
        self._values = self._settings.values
        self._catalogue = catalogue.load_catalogue()
        # This reads the tables of the Earth's rotation, so that the first frame is not slow.
        earth_state(J2000_UNIX_S)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._time = NodeTime(self)
        self._tilts = TiltBuffer()
        self._waiting: deque[Waiting] = deque()
        self._solver: Solver | None = None
        self._preparing = JobRunner(self)
        self._trouble = ""  # why there is no solver
        self._latest: Waiting | None = None
        self._answer: Solution | None = None
        self._hint: Hint | None = None  # from the last fix
        self._doubt = ClockDoubt()
        self._counts = {"frames": 0, "fixes": 0, "dropped frames": 0}
        self._inputs = Inputs(self)
        self._logged: object = None
        self._connect()

    def _connect(self) -> None:
        self._outputs = SolutionPublishers(self, self._settings)
        subscription(self, CameraInfo, "camera/camera_info", self._on_camera, 10)
        self._tilt_subscription = subscription(self, msg.Tilt, "tilt", self._on_tilt, TILT_QUEUE)
        subscription(self, msg.StarArray, "stars", self._on_stars, 10)
        self.create_service(Solve, "solver/solve", self._on_solve)
        self.create_service(Trigger, "solver/reset", self._on_reset)
        self.create_service(SaveCalibration, "solver/save_calibration", self._on_save_calibration)
        self._calibrating = Calibrating(self, self._settings, self._solver_now, self._remake_solver)
        group = MutuallyExclusiveCallbackGroup()
        self._poll = self.create_timer(
            POLL_S, self._work, callback_group=group, clock=self._steady, autostart=False
        )
        tasks = {
            "Solution": self._report_solution,
            "Inputs": lambda: self._inputs.report(len(self._tilts)),
            "Clock": self._report_clock,
            "Conditions": self._report_conditions,
            "Calibration": self._calibrating.report,
            "Average": self._calibrating.average.report,
        }
        self._diagnostics = Diagnostics(self, tasks, self._values["frame_id"])

    # parameters ------------------------------------------------------------------------------------------------------

    def _apply(self, names: frozenset[str]) -> None:
        self._diagnostics.hardware_id = self._values["frame_id"]
        if "clock_stddev" in names:
            self._doubt.clear()
        self._calibrating.parameters_set(names)
        self._remake_solver()

    def _remake_solver(self) -> None:
        """Make the solver again with the present parameters and calibration."""
        if self._camera is None or self._preparing.busy:
            return
        if self._solver is None:
            self._prepare(self._camera)
        else:
            self._solver = self._make_solver(self._camera)

    def _make_solver(self, camera: Camera) -> Solver:
        return self._settings.solver(camera, self._calibrating.found, self._catalogue)

    # inputs ----------------------------------------------------------------------------------------------------------

    def _on_camera(self, message: CameraInfo) -> None:
        try:
            camera = message_to_camera(message)
        except StarposError as e:
            if self._camera is None:
                self._trouble = str(e)
            self._inputs.refuse("camera_info", str(e))
            return
        self._inputs.came("camera_info")
        if camera == self._camera:
            return
        self._camera, self._solver, self._trouble, self._hint = camera, None, "", None
        self._calibrating.camera_changed()
        if not self._preparing.busy:
            self._prepare(camera)

    def _prepare(self, camera: Camera) -> None:
        """Prepare the triangles of this field in a thread, because building them takes seconds."""

        def work() -> Solver:
            solver = self._make_solver(camera)
            solver.prepare(camera.width, camera.height)
            return solver

        self._preparing.run(work).add_done_callback(lambda f: self._on_prepared(camera, f.result()))

    def _on_prepared(self, camera: Camera, made: Outcome) -> None:
        if self._camera is not None and camera != self._camera:
            # Another camera_info has come meanwhile.
            self._prepare(self._camera)
            return
        self._solver, self._trouble = made.value, made.trouble
        if self._trouble:
            self._log_change(self._trouble, good=False)
        else:
            # The parameters may have changed meanwhile.
            self._remake_solver()
        self._work()

    def _on_tilt(self, message: msg.Tilt, info: Mapping[str, Any]) -> None:
        self._take_tilt(message, info)
        if self._waiting:
            self._work()

    def _take_arrived_tilts(self) -> None:
        """Read the tilts that have arrived but wait for the executor: after a stall they are those of the frame."""
        handle = self._tilt_subscription.handle
        with handle:
            for _ in range(TILT_QUEUE):
                taken = handle.take_message(msg.Tilt, False)
                if taken is None:
                    return
                self._take_tilt(*taken)

    def _take_tilt(self, message: msg.Tilt, info: Mapping[str, Any]) -> None:
        self._watch_clock()
        try:
            now_s = self._steady.now().nanoseconds * 1e-9
            self._tilts.heard(message, info.get("publication_sequence_number"), now_s)
            if self._time.played and self._ahead_s(message) > reports.AHEAD_S:
                self._time.at_next_tick(lambda: self._add_tilt(message))
                return
        except StarposError as e:
            self._inputs.refuse("tilt", str(e))
            return
        self._add_tilt(message)

    def _ahead_s(self, message: msg.Tilt) -> float:
        return self._time.ahead_s(stamp_to_unix(message.header.stamp))

    def _add_tilt(self, message: msg.Tilt) -> None:
        """Keep a tilt, unless it is broken, or of the future: the instrument may lean otherwise when its time comes."""
        try:
            if (ahead_s := self._ahead_s(message)) > reports.AHEAD_S:
                raise TiltError(f"a tilt is stamped {ahead_s:.3g} s before its time: {reports.ONE_CLOCK}")
            self._tilts.add(message, self._settings.tilt_stddev_rad)
            self._inputs.came("tilt")
        except StarposError as e:
            self._inputs.refuse("tilt", str(e))

    def _on_stars(self, message: msg.StarArray) -> None:
        self._inputs.came("stars")
        self._watch_clock()
        try:
            stars = message_to_stars(message)
            # If the user sets clock_stddev, it replaces the error that the camera's host states.
            if not math.isnan(self._values["clock_stddev"]):
                stars = replace(stars, clock_stddev_s=0.0)
        except StarposError as e:
            self._publish(
                message.header.stamp,
                Solution(
                    Status.BAD_INPUT,
                    str(e),
                    source="stars",
                    utc_unix_s=None,
                    stars_detected=len(message.stars),
                ),
            )
            return
        ahead_s = self._time.ahead_s(stars.mid_unix_s)
        self._waiting.append(Waiting(message, stars, self._steady.now().nanoseconds, ahead_s))
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self._counts["dropped frames"] += 1
        self._work()

    def _watch_clock(self) -> None:
        """Drop the tilts from the future if this node's clock was set back."""
        now_s = self._time.set_back_to()
        if now_s is not None:
            self._tilts.forget_after(now_s)

    # work ------------------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Solve the frames that have everything they need; poll only while a frame waits."""
        while self._waiting and self._ready(self._waiting[0]):
            self._take_arrived_tilts()
            self._solve(self._dated(self._waiting.popleft()))
        if self._waiting and self._poll.is_canceled():
            self._poll.reset()
        elif not self._waiting and not self._poll.is_canceled():
            self._poll.cancel()

    def _dated(self, frame: Waiting) -> Waiting:
        """The frame with how far it is ahead of a clock that is played, which may have been heard only after it."""
        ahead_s = self._time.ahead_s(frame.stars.mid_unix_s)
        return replace(frame, ahead_s=min(ahead_s, frame.ahead_s)) if self._time.played else frame

    def _ready(self, frame: Waiting) -> bool:
        waited_s = (self._steady.now().nanoseconds - frame.since_ns) * 1e-9
        mid = frame.stars.mid_unix_s
        if self._preparing.busy:
            return False
        if mid is None or waited_s > self._values["tilt_timeout"]:
            return True
        if self._solver is None:
            return bool(self._trouble)
        return self._tilts.complete(mid, self._span(frame.stars))

    def _span(self, stars: Stars) -> float:
        return stars.exposure_s or self._values["tilt_window"]

    def _solve(self, frame: Waiting) -> None:
        answer = self._answer_to(frame, self._hint)
        if answer.ok and answer.fix is not None:
            frame, answer = self._with_doubt(frame, answer, answer.fix)
        self._latest = frame
        self._publish(frame.message.header.stamp, answer)
        if self._solver is not None:
            self._learn(frame, answer)

    def _with_doubt(self, frame: Waiting, answer: Solution, fix: Fix) -> tuple[Waiting, Solution]:
        """Add the error of its time that the stars of earlier frames show to a frame and its answer."""
        stated_s = math.hypot(self._solver_now().clock_stddev_s(frame.stars), frame.stars.stamp_stddev_s)
        self._doubt.add(fix, stated_s)
        if self._doubt.seconds <= stated_s:
            return frame, answer
        frame = replace(frame, stars=replace(frame.stars, clock_stddev_s=self._doubt.seconds), doubted=True)
        if self._doubt.leans_otherwise:
            return frame, Solution.failed(frame.stars, Status.NO_TILT, reports.OTHER_TILTS)
        return frame, self._answer_to(frame, answer.hint)

    def _solver_now(self) -> Solver:
        """Return the solver; InstrumentError with the reason while there is none."""
        if self._solver is not None:
            return self._solver
        topic = self.resolve_topic_name("camera/camera_info")
        waiting = f"{topic}: no camera calibration has arrived: start the camera"
        if self._preparing.busy:
            waiting = "the triangles of this field are being built"
        raise InstrumentError(self._trouble or waiting)

    def _answer_to(self, frame: Waiting, hint: Hint | None) -> Solution:
        stars = frame.stars
        try:
            solver = self._solver_now()
            if frame.ahead_s > reports.AHEAD_S + CLOCK_SIGMAS * solver.clock_stddev_s(stars):
                raise TimeError(
                    f"the frame is stamped {frame.ahead_s:.3g} s before its time: {reports.ONE_CLOCK}"
                )
            return solver.solve(stars, lambda mid, *_: self._tilts.average(mid, self._span(stars)), hint)
        except (InstrumentError, TimeError) as e:
            return Solution.failed(stars, Status.BAD_INPUT, str(e))
        except Exception as e:
            # A defect costs this frame only; the node goes on.
            self.get_logger().error(traceback.format_exc(), throttle_duration_sec=60.0)
            return Solution.failed(
                stars, Status.BAD_INPUT, f"the solver failed on this frame ({type(e).__name__}: {e})"
            )

    def _learn(self, frame: Waiting, answer: Solution) -> None:
        """Give a frame to the calibration and the average, even one that a stale calibration refuses.

        A frame whose time is in doubt is left out. fix_averaged is published with each frame that the average includes.
        """
        stars = frame.stars
        if stars.mid_unix_s is None or frame.doubted:
            return
        if answer.status is Status.BAD_INPUT and frame.ahead_s > reports.AHEAD_S:
            return
        try:
            tilt = answer.tilt or self._tilts.average(stars.mid_unix_s, self._span(stars))
        except StarposError:
            return
        try:
            used = self._calibrating.learn(Seen(stars, tilt), answer.fix)
            place = self._calibrating.average.place if used else None
            message = None if place is None else self._outputs.average(frame.message.header.stamp, place)
        except Exception:
            # Fix and heading go on without the average; data that cause a defect must not stay.
            self.get_logger().error(traceback.format_exc(), throttle_duration_sec=60.0)
            self._calibrating.forget()
            return
        if message is not None:
            self._outputs.publish_average(message)

    # outputs ---------------------------------------------------------------------------------------------------------

    def _publish(self, stamp: Time, answer: Solution) -> None:
        self._answer = answer
        self._counts["frames"] += 1
        self._counts["fixes"] += answer.ok
        self._hint = answer.hint or self._hint
        self._outputs.publish(stamp, answer, self._no_camera)
        self._log_change("fixes are coming" if answer.ok else answer.message, answer.ok, answer.status)

    @property
    def _no_camera(self) -> bool:
        return self._solver is None and self._camera is None

    def _log_change(self, sentence: str, good: bool, state: object = None) -> None:
        state = state or sentence
        if state == self._logged:
            return
        self._logged = state
        # rclpy ties a severity to the calling line, so each severity has its own line.
        if good:
            self.get_logger().info(sentence)
        else:
            self.get_logger().warning(sentence)

    def _on_solve(self, request: Solve.Request, response: Solve.Response) -> Solve.Response:
        if self._latest is None:
            response.message = "no frame has arrived yet: start the camera and the detector"
            response.solution = msg.Solution(status=msg.Solution.BAD_INPUT, status_text=response.message)
            return response
        # Without a hint the frame is identified anew, whatever was found before.
        answer = self._answer_to(self._latest, None)
        stamp = self._latest.message.header.stamp
        response.solution = self._outputs.solution(stamp, answer, self._no_camera)
        response.success, response.message = answer.ok, answer.message
        return response

    def _on_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._tilts.clear()
        self._waiting.clear()
        self._latest = self._answer = self._hint = None
        self._doubt.clear()
        self._calibrating.forget()
        response.success = True
        response.message = "tilts, frames and the place are forgotten; a calibration that was found is not"
        return response

    def _on_save_calibration(
        self, request: SaveCalibration.Request, response: SaveCalibration.Response
    ) -> SaveCalibration.Response:
        url = self._values["calibration_url"]
        try:
            instrument = self._solver_now().instrument
            if self._calibrating.unknown:
                raise InstrumentError("the calibration in use is not known: calibrate first")
            written = saving.save(request.path, url, instrument)
        except StarposError as e:
            response.message = str(e)
            return response
        # A restart would read this file.
        if written == path_of(url):
            self._settings.saved(instrument)
        response.success, response.message = True, f"{written}: the calibration in use is written"
        return response

    # diagnostics -----------------------------------------------------------------------------------------------------

    def _report_solution(self) -> Diagnosis:
        if self._answer is None:
            waiting = "building the triangles of this field" if self._preparing.busy else "no frame yet"
            return Diagnosis(Level.WARN, self._trouble or waiting, self._counts)
        return reports.of_solution(self._answer, self._counts)

    def _report_clock(self) -> Diagnosis:
        if self._latest is None:
            return Diagnosis(Level.WARN, "no frame yet")
        stars = self._latest.stars
        clock_s = self._solver.clock_stddev_s(stars) if self._solver else stars.clock_stddev_s
        doubt_s = self._doubt.seconds if self._latest.doubted else 0.0
        return reports.of_clock(clock_s, stars.stamp_stddev_s, self._latest.ahead_s, doubt_s)

    def _report_conditions(self) -> Diagnosis:
        calibration = self._settings.calibration(self._calibrating.found)
        tilt = self._answer.tilt if self._answer else None
        return reports.of_conditions(self._values, calibration, tilt)
