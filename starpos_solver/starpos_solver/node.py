# SPDX-License-Identifier: Apache-2.0
"""The node `solver`: stars and tilts in, `fix`, `heading/imu` and `solver/solution` out."""

import math
import traceback
from collections import deque
from dataclasses import dataclass, replace

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Imu, NavSatFix
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from starpos.averaging.average import Average
from starpos.earth.orientation import earth_state
from starpos.earth.vertical import Geodetic
from starpos.errors import InstrumentError, StarposError, TiltError, TimeError
from starpos.fix.solver import Solution, Solver, Status
from starpos.frames.stars import Stars
from starpos.identification.hint import Hint
from starpos.instrument.camera import Camera
from starpos.recording.messages import message_to_camera, message_to_stars, stamp_to_unix
from starpos.sky import catalogue
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.job import JobRunner, Outcome
from starpos_common.paths import path_of
from starpos_common.topics import publisher, subscription
from starpos_interfaces import msg
from starpos_interfaces.srv import SaveCalibration, Solve
from starpos_solver import outputs, reports, saving
from starpos_solver.calibrating import Calibrating
from starpos_solver.clock_doubt import ClockDoubt
from starpos_solver.inputs import Inputs
from starpos_solver.memory import Seen
from starpos_solver.settings import SolverSettings
from starpos_solver.tilts import TiltBuffer

WAITING = 4  # frames that wait for their tilts or for the triangles; older ones are dropped
POLL_S = 0.02
ANOTHER_TIME_S = 3600.0  # clocks that differ by more are not those of one evening
J2000_UNIX_S = 946_728_000.0
CLOCK_STEP_NS = 50_000_000  # a clock that goes back by so much was set
CLOCK_SIGMAS = 6.0  # beyond the stated error, and AHEAD_S, a stamp in the future is wrong


@dataclass(frozen=True)
class Waiting:
    """A frame's stars, as they came and as they are.

    `since` in ns of the steady clock; by how much the middle of the exposure lay ahead of this node's clock when it came;
    whether its stars speak against its time.
    """

    message: msg.StarArray
    stars: Stars
    since_ns: int
    ahead_s: float
    doubted: bool = False


class SolverNode(Node):
    """See README.md."""

    def __init__(self):
        super().__init__("solver")
        self._camera: Camera | None = None
        self._settings = SolverSettings(self, lambda: self._camera, self._apply)
        self._values = self._settings.values
        self._catalogue = catalogue.load_catalogue()
        # reads the tables of the Earth's rotation, so that the first frame is not slow
        earth_state(J2000_UNIX_S)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._was_ns = 0  # this node's clock, when something came last
        self._tilts = TiltBuffer()
        self._waiting: deque[Waiting] = deque()
        self._solver: Solver | None = None
        self._preparing = JobRunner(self)
        self._trouble = ""  # why there is no solver
        self._latest: Waiting | None = None
        self._answer: Solution | None = None
        self._hint: Hint | None = None  # of the last fix
        self._doubt = ClockDoubt()
        self._counts = {"frames": 0, "fixes": 0, "dropped frames": 0}
        self._inputs = Inputs(self)
        self._logged: object = None
        self._connect()

    def _connect(self):
        self._fix = publisher(self, NavSatFix, "fix", 10)
        self._fix_averaged = publisher(self, NavSatFix, "fix_averaged", 10)
        self._imu = publisher(self, Imu, "heading/imu", 10)
        self._solution = publisher(self, msg.Solution, "solver/solution", 10)
        subscription(self, CameraInfo, "camera/camera_info", self._on_camera, 10)
        subscription(self, msg.Tilt, "tilt", self._on_tilt, 1000)
        subscription(self, msg.StarArray, "stars", self._on_stars, 10)
        self.create_service(Solve, "solver/solve", self._on_solve)
        self.create_service(Trigger, "solver/reset", self._on_reset)
        self.create_service(SaveCalibration, "solver/save_calibration", self._on_save_calibration)
        self._calibrating = Calibrating(self, self._values, self._solver_now, self._remake_solver)
        group = MutuallyExclusiveCallbackGroup()
        self._poll = self.create_timer(
            POLL_S, self._work, callback_group=group, clock=self._steady, autostart=False
        )
        tasks = {
            "Solution": self._report_solution,
            "Inputs": lambda: self._inputs.report(len(self._tilts)),
            "Clock": self._report_clock,
            "Calibration": self._calibrating.report,
            "Average": self._calibrating.average.report,
        }
        self._diagnostics = Diagnostics(self, tasks, self._values["frame_id"])

    # parameters ------------------------------------------------------------------------------------------------------

    def _apply(self, names: frozenset[str]):
        self._diagnostics.hardware_id = self._values["frame_id"]
        if "clock_stddev" in names:
            self._doubt.clear()
        self._calibrating.parameters_set(names)
        self._remake_solver()

    def _remake_solver(self):
        """With the parameters and the calibration of now."""
        if self._camera is None or self._preparing.busy:
            return
        if self._solver is None:
            self._prepare(self._camera)
        else:
            self._solver = self._make_solver(self._camera)

    def _make_solver(self, camera: Camera) -> Solver:
        return self._settings.solver(camera, self._calibrating.found, self._catalogue)

    # inputs ----------------------------------------------------------------------------------------------------------

    def _on_camera(self, message: CameraInfo):
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

    def _prepare(self, camera: Camera):
        """Have the triangles of this field ready; they may have to be built, which must not hold up the node."""

        def work() -> Solver:
            solver = self._make_solver(camera)
            solver.prepare(camera.width, camera.height)
            return solver

        self._preparing.run(work).add_done_callback(lambda f: self._on_prepared(camera, f.result()))

    def _on_prepared(self, camera: Camera, made: Outcome):
        if camera != self._camera:  # another one has come meanwhile
            self._prepare(self._camera)
            return
        self._solver, self._trouble = made.value, made.trouble
        if self._trouble:
            self._log_change(self._trouble, good=False)
        else:
            self._remake_solver()  # with the parameters of now
        self._work()

    def _on_tilt(self, message: msg.Tilt):
        self._watch_clock()
        try:
            ahead_s = self._ahead_s(stamp_to_unix(message.header.stamp))
            # when its time has come the instrument may lean otherwise
            if ahead_s > reports.AHEAD_S:
                raise TiltError(f"a tilt is stamped {ahead_s:.3g} s before its time: {reports.ONE_CLOCK}")
            self._tilts.add(message, self._settings.tilt_stddev_rad)
            self._inputs.came("tilt")
        except StarposError as e:
            self._inputs.refuse("tilt", str(e))
        if self._waiting:
            self._work()

    def _on_stars(self, message: msg.StarArray):
        self._inputs.came("stars")
        self._watch_clock()
        try:
            stars = message_to_stars(message)
            # who sets it knows better than the camera's host
            if not math.isnan(self._values["clock_stddev"]):
                stars = replace(stars, clock_stddev_s=0.0)
        except StarposError as e:
            self._publish(
                message.header,
                Solution(
                    Status.BAD_INPUT,
                    str(e),
                    source="stars",
                    utc_unix_s=None,
                    stars_detected=len(message.stars),
                ),
            )
            return
        ahead_s = self._ahead_s(stars.mid_unix_s)
        self._waiting.append(Waiting(message, stars, self._steady.now().nanoseconds, ahead_s))
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self._counts["dropped frames"] += 1
        self._work()

    def _watch_clock(self):
        """Where this node's clock has gone back it was ahead, and so were the tilts that came by it."""
        now_ns = self.get_clock().now().nanoseconds
        if now_ns < self._was_ns - CLOCK_STEP_NS:
            self._tilts.forget_after(now_ns * 1e-9)
        self._was_ns = now_ns

    def _ahead_s(self, unix_s: float | None) -> float:
        """By how much a time is ahead of this node's clock; 0 where one of them is not known (no /clock yet).

        0 too where it is of another time altogether: a night that is played without /clock, or a robot that does not know
        the date.
        """
        now_ns = self.get_clock().now().nanoseconds
        if unix_s is None or not now_ns:
            return 0.0
        ahead_s = unix_s - now_ns * 1e-9
        return 0.0 if ahead_s > ANOTHER_TIME_S and not self.get_clock().ros_time_is_active else ahead_s

    # work ------------------------------------------------------------------------------------------------------------

    def _work(self):
        """Solve what has all it needs; poll only while something waits."""
        while self._waiting and self._ready(self._waiting[0]):
            self._solve(self._waiting.popleft())
        if self._waiting and self._poll.is_canceled():
            self._poll.reset()
        elif not self._waiting and not self._poll.is_canceled():
            self._poll.cancel()

    def _ready(self, frame: Waiting) -> bool:
        waited_s = (self._steady.now().nanoseconds - frame.since_ns) * 1e-9
        if self._preparing.busy:
            return False
        if self._solver is None or frame.stars.mid_unix_s is None:
            return (
                waited_s > self._values["tilt_timeout"]
                or frame.stars.mid_unix_s is None
                or bool(self._trouble)
            )
        return waited_s > self._values["tilt_timeout"] or self._tilts.complete(
            frame.stars.mid_unix_s, self._span(frame.stars)
        )

    def _span(self, stars: Stars) -> float:
        return stars.exposure_s or self._values["tilt_window"]

    def _solve(self, frame: Waiting):
        answer = self._answer_to(frame, self._hint)
        if answer.ok:
            frame, answer = self._with_doubt(frame, answer)
        self._latest = frame
        self._publish(frame.message.header, answer)
        if self._solver is not None:
            self._learn(frame, answer)

    def _with_doubt(self, frame: Waiting, answer: Solution) -> tuple[Waiting, Solution]:
        """The frame, and its answer, with the error of its time that the stars of earlier frames tell."""
        stated_s = math.hypot(self._solver.clock_stddev_s(frame.stars), frame.stars.stamp_stddev_s)
        self._doubt.add(answer.fix, stated_s)
        if self._doubt.seconds <= stated_s:
            return frame, answer
        frame = replace(frame, stars=replace(frame.stars, clock_stddev_s=self._doubt.seconds), doubted=True)
        if self._doubt.leans_otherwise:
            return frame, Solution.failed(frame.stars, Status.NO_TILT, reports.OTHER_TILTS)
        return frame, self._answer_to(frame, answer.hint)

    def _solver_now(self) -> Solver:
        """InstrumentError with the reason while there is none."""
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
            answer = solver.solve(stars, lambda mid, _: self._tilts.average(mid, self._span(stars)), hint)
            if answer.ok and frame.ahead_s > reports.AHEAD_S + CLOCK_SIGMAS * solver.clock_stddev_s(stars):
                raise TimeError(
                    f"the frame is stamped {frame.ahead_s:.3g} s before its time: {reports.ONE_CLOCK}"
                )
            return answer
        except (InstrumentError, TimeError) as e:
            return Solution.failed(stars, Status.BAD_INPUT, str(e))
        except Exception as e:  # a defect costs this frame, not the night
            self.get_logger().error(traceback.format_exc(), throttle_duration_sec=60.0)
            return Solution.failed(
                stars, Status.BAD_INPUT, f"the solver failed on this frame ({type(e).__name__}: {e})"
            )

    def _learn(self, frame: Waiting, answer: Solution):
        """What a calibration and the average take from a frame, also from one that a stale calibration refuses.

        One whose time is in doubt teaches nothing.  fix_averaged comes with the frames that are of it.
        """
        stars = frame.stars
        if frame.doubted or (answer.status is Status.BAD_INPUT and frame.ahead_s > reports.AHEAD_S):
            return
        try:
            tilt = answer.tilt or self._tilts.average(stars.mid_unix_s or math.nan, self._span(stars))
        except StarposError:
            return
        try:
            used = self._calibrating.learn(Seen(stars, tilt), answer.fix)
            message = self._averaged(frame.message.header, self._calibrating.average.place) if used else None
        except Exception:  # fix and heading go on without
            self.get_logger().error(traceback.format_exc(), throttle_duration_sec=60.0)
            self._calibrating.forget()  # what cannot be worked with must not stay
            return
        if message is not None:
            self._fix_averaged.publish(message)

    # outputs ---------------------------------------------------------------------------------------------------------

    def _publish(self, about: Header, answer: Solution):
        self._answer = answer
        self._counts["frames"] += 1
        self._counts["fixes"] += answer.ok
        self._hint = answer.hint or self._hint
        header = Header(stamp=about.stamp, frame_id=self._values["frame_id"])
        message, fix, imu = self._messages(header, answer)
        self._fix.publish(fix)
        if imu is not None:
            self._imu.publish(imu)
        self._solution.publish(message)
        self._log_change("fixes are coming" if answer.ok else answer.message, answer.ok, answer.status)

    def _messages(self, header: Header, answer: Solution):
        ground = outputs.on_ground(answer, self._settings.vertical)
        message = outputs.solution(header, answer, ground)
        if self._solver is None and self._camera is None:
            message.status = msg.Solution.NO_CAMERA
        return (
            message,
            self._nav_sat_fix(header, ground),
            outputs.imu(header, answer, ground) if ground else None,
        )

    def _averaged(self, about: Header, place: Average) -> NavSatFix:
        header = Header(stamp=about.stamp, frame_id=self._values["frame_id"])
        vertical = self._settings.vertical
        return self._nav_sat_fix(header, outputs.average_on_ground(place, vertical))

    def _nav_sat_fix(self, header: Header, ground: Geodetic | None) -> NavSatFix:
        return outputs.nav_sat_fix(header, ground, self._values["altitude"], self._values["altitude_stddev"])

    def _log_change(self, sentence: str, good: bool, state: object = None):
        state = state or sentence
        if state == self._logged:
            return
        self._logged = state
        # rclpy ties a severity to the line it is called from, so each has its own
        if good:
            self.get_logger().info(sentence)
        else:
            self.get_logger().warning(sentence)

    def _on_solve(self, request, response):
        if self._latest is None:
            response.message = "no frame has arrived yet: start the camera and the detector"
            response.solution = msg.Solution(status=msg.Solution.BAD_INPUT, status_text=response.message)
            return response
        answer = self._answer_to(self._latest, None)  # from scratch: what was before has no say
        header = Header(stamp=self._latest.message.header.stamp, frame_id=self._values["frame_id"])
        response.solution = self._messages(header, answer)[0]
        response.success, response.message = answer.ok, answer.message
        return response

    def _on_reset(self, request, response):
        self._tilts.clear()
        self._waiting.clear()
        self._latest = self._answer = self._hint = None
        self._doubt.clear()
        self._calibrating.forget()
        response.success = True
        response.message = "tilts, frames and the place are forgotten; a calibration that was found is not"
        return response

    def _on_save_calibration(self, request, response):
        url = self._values["calibration_url"]
        try:
            instrument = self._solver_now().instrument
            if self._calibrating.unknown:
                raise InstrumentError("the calibration in use is not known: calibrate first")
            written = saving.save(request.path, url, instrument)
        except StarposError as e:
            response.message = str(e)
            return response
        if written == path_of(url):  # what a restart would read
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
