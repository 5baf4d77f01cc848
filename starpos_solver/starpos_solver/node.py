# SPDX-License-Identifier: Apache-2.0
"""The node `solver`: stars and tilts in, `fix`, `heading/imu` and `solver/solution` out."""

import math
import threading
import traceback
from collections import deque
from dataclasses import dataclass, replace

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo, Imu, NavSatFix
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from starpos import catalogue
from starpos.camera import Camera
from starpos.errors import StarposError
from starpos.geoid import Geoid
from starpos.inclinometer import SCA100T_NOISE_RAD
from starpos.instrument import Instrument
from starpos.solve import Solution as Answer
from starpos.solve import Solver, Status
from starpos.standing import Standing
from starpos.stars import Stars
from starpos_common.diagnostics import Diagnostics, Level
from starpos_common.diagnostics import Status as Report
from starpos_common.messages import message_to_camera, message_to_stars
from starpos_common.parameters import declare
from starpos_interfaces.msg import Solution, StarArray, Tilt
from starpos_interfaces.srv import Solve
from starpos_solver import outputs, parameters
from starpos_solver.tilts import TiltBuffer

WAITING = 4  # frames that wait for their tilts or for the triangles; older ones are dropped
POLL_S = 0.02
STALE_S = 5.0


@dataclass(frozen=True)
class Waiting:
    """A frame's stars, as they came and as they are; `since` in ns of the steady clock."""

    message: StarArray
    stars: Stars
    since_ns: int


@dataclass(frozen=True)
class Made:
    """What the thread made of a camera: a solver, or why there is none."""

    camera: Camera
    solver: Solver | None
    trouble: str


class SolverNode(Node):
    """See README.md."""

    def __init__(self):
        super().__init__("solver")
        self._known: Instrument | None = None
        self._known_url = ""
        self._geoid: Geoid | None = None
        self._geoid_name = ""
        self._values = declare(self, parameters.PARAMETERS, apply=self._apply, check=self._check)
        self._read_instrument()
        self._read_geoid()
        self._catalogue = catalogue.load()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._tilts = TiltBuffer()
        self._waiting: deque[Waiting] = deque()
        self._camera: Camera | None = None
        self._solver: Solver | None = None
        self._preparing: threading.Thread | None = None
        self._made: Made | None = None
        self._trouble = ""  # why there is no solver
        self._latest: Waiting | None = None
        self._answer: Answer | None = None
        self._standing: Standing | None = None  # of the last fix
        self._counts = {"frames": 0, "fixes": 0, "dropped frames": 0, "broken messages": 0}
        self._last_seen_ns: dict[str, int] = {}
        self._logged: object = None
        self._connect()

    def _connect(self):
        qos = QoSProfile(depth=10)
        override = {"qos_overriding_options": QoSOverridingOptions.with_default_policies()}
        self._fix = self.create_publisher(NavSatFix, "fix", qos, **override)
        self._imu = self.create_publisher(Imu, "heading/imu", qos, **override)
        self._solution = self.create_publisher(Solution, "solver/solution", qos, **override)
        self.create_subscription(CameraInfo, "camera/camera_info", self._on_camera, qos, **override)
        self.create_subscription(Tilt, "tilt", self._on_tilt, QoSProfile(depth=1000), **override)
        self.create_subscription(StarArray, "stars", self._on_stars, qos, **override)
        self.create_service(Solve, "solver/solve", self._on_solve)
        self.create_service(Trigger, "solver/reset", self._on_reset)
        self._prepared = self.create_guard_condition(self._on_prepared)
        group = MutuallyExclusiveCallbackGroup()
        self._poll = self.create_timer(
            POLL_S, self._work, callback_group=group, clock=self._steady, autostart=False
        )
        self._diagnostics = Diagnostics(
            self, {"Solution": self._report_solution, "Inputs": self._report_inputs}, self._values["frame_id"]
        )

    # parameters ------------------------------------------------------------------------------------------------------

    def _check(self, values) -> str | None:
        """Values that are each allowed but make no instrument together, such as a broken calibration file."""
        try:
            known = self._known
            if values["calibration_url"] != self._known_url:
                known = parameters.known_instrument(values["calibration_url"])
            parameters.instrument_of(values, Camera.from_focal(100, 100, 1000.0), known)
            parameters.atmosphere_of(values)
            grid = self._geoid
            if values["deflection.geoid"] != self._geoid_name:
                grid = parameters.geoid_file(values["deflection.geoid"])
            parameters.vertical_of(values, grid)
        except StarposError as e:
            return str(e)
        return None

    def _apply(self, names: frozenset[str]):
        if "calibration_url" in names:
            self._read_instrument()
        if "deflection.geoid" in names:
            self._read_geoid()
        if self._solver is not None and self._camera is not None:
            self._solver = self._make_solver(self._camera)

    def _read_instrument(self):
        """Read once for each value of calibration_url: a file that goes away later is no matter."""
        self._known_url = self._values["calibration_url"]
        self._known = parameters.known_instrument(self._known_url)

    def _read_geoid(self):
        self._geoid_name = self._values["deflection.geoid"]
        self._geoid = parameters.geoid_file(self._geoid_name)

    def _make_solver(self, camera: Camera) -> Solver:
        return Solver(
            parameters.instrument_of(self._values, camera, self._known),
            self._catalogue,
            parameters.atmosphere_of(self._values),
            self._values["min_stars"],
        )

    # inputs ----------------------------------------------------------------------------------------------------------

    def _seen(self, what: str):
        self._last_seen_ns[what] = self._steady.now().nanoseconds

    def _on_camera(self, message: CameraInfo):
        self._seen("camera_info")
        try:
            camera = message_to_camera(message)
        except StarposError as e:
            if self._camera is None:
                self._trouble = str(e)
            self._reject(str(e))
            return
        if camera == self._camera:
            return
        self._camera, self._solver, self._trouble, self._standing = camera, None, "", None
        if self._preparing is None:
            self._prepare(camera)

    def _prepare(self, camera: Camera):
        """Have the triangles of this field ready; they may have to be built, which must not hold up the node."""

        def work():
            try:
                solver = self._make_solver(camera)
                solver.prepare(camera.width, camera.height)
                self._made = Made(camera, solver, "")
            except StarposError as e:
                self._made = Made(camera, None, str(e))
            except Exception as e:  # or the node would wait for the triangles for ever
                self._made = Made(
                    camera, None, f"the triangles of this field cannot be made ({type(e).__name__}: {e})"
                )
            self._prepared.trigger()

        self._preparing = threading.Thread(target=work, daemon=True)
        self._preparing.start()

    def _on_prepared(self):
        made, self._preparing = self._made, None
        if made.camera != self._camera:  # another one has come meanwhile
            self._prepare(self._camera)
            return
        self._solver, self._trouble = made.solver, made.trouble
        if self._trouble:
            self._log_change(self._trouble, good=False)
        else:
            self._apply(frozenset())  # with the parameters of now
        self._work()

    def _on_tilt(self, message: Tilt):
        self._seen("tilt")
        try:
            self._tilts.add(message, self._tilt_stddev())
        except StarposError as e:
            self._reject(str(e))
        if self._waiting:
            self._work()

    def _tilt_stddev(self) -> float:
        """Of a sample that states none, rad."""
        stated = math.radians(self._values["tilt_stddev"])
        if not math.isnan(stated):
            return stated
        return self._known.inclinometer.noise_rad if self._known else SCA100T_NOISE_RAD

    def _on_stars(self, message: StarArray):
        self._seen("stars")
        try:
            stars = message_to_stars(message)
        except StarposError as e:
            self._publish(message.header, Answer(Status.BAD_INPUT, str(e), "stars", None, len(message.stars)))
            return
        self._waiting.append(Waiting(message, stars, self._steady.now().nanoseconds))
        while len(self._waiting) > WAITING:
            self._waiting.popleft()
            self._counts["dropped frames"] += 1
        self._work()

    def _reject(self, sentence: str):
        self._counts["broken messages"] += 1
        self.get_logger().warning(sentence, throttle_duration_sec=10.0)

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
        if self._preparing is not None:
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
        self._latest = frame
        self._publish(frame.message.header, self._answer_to(frame, self._standing))

    def _answer_to(self, frame: Waiting, standing: Standing | None) -> Answer:
        stars = frame.stars
        if self._solver is None:
            topic = self.resolve_topic_name("camera/camera_info")
            waiting = f"{topic}: no camera calibration has arrived: start the camera"
            if self._preparing:
                waiting = "the triangles of this field are being built"
            reason = self._trouble or waiting
            return Answer.failed(stars, Status.BAD_INPUT, reason)
        solver = self._solver
        stamp_stddev = frame.message.stamp_stddev
        if not 0 <= stamp_stddev < math.inf:
            reason = f"stars: stamp_stddev is {stamp_stddev} s: it must be 0 (unknown) or more"
            return Answer.failed(stars, Status.BAD_INPUT, reason)
        if stamp_stddev > 0:
            clock = math.hypot(solver.instrument.clock_stddev_s, stamp_stddev)
            solver = replace(solver, instrument=replace(solver.instrument, clock_stddev_s=clock))
        try:
            return solver.solve(stars, lambda mid, _: self._tilts.average(mid, self._span(stars)), standing)
        except Exception as e:  # a defect costs this frame, not the night
            self.get_logger().error(traceback.format_exc(), throttle_duration_sec=60.0)
            return Answer.failed(
                stars, Status.BAD_INPUT, f"the solver failed on this frame ({type(e).__name__}: {e})"
            )

    # outputs ---------------------------------------------------------------------------------------------------------

    def _publish(self, about: Header, answer: Answer):
        self._answer = answer
        self._counts["frames"] += 1
        self._counts["fixes"] += answer.ok
        self._standing = answer.standing or self._standing
        header = Header(stamp=about.stamp, frame_id=self._values["frame_id"])
        message, fix, imu = self._messages(header, answer)
        self._fix.publish(fix)
        if imu is not None:
            self._imu.publish(imu)
        self._solution.publish(message)
        self._log_change("fixes are coming" if answer.ok else answer.message, answer.ok, answer.status)

    def _messages(self, header: Header, answer: Answer):
        ground = outputs.on_ground(answer, parameters.vertical_of(self._values, self._geoid))
        message = outputs.solution(header, answer, ground)
        if self._solver is None and self._camera is None:
            message.status = Solution.NO_CAMERA
        fix = outputs.nav_sat_fix(header, ground, self._values["altitude"], self._values["altitude_stddev"])
        return message, fix, outputs.imu(header, answer, ground) if ground else None

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
            response.solution = Solution(status=Solution.BAD_INPUT, status_text=response.message)
            return response
        answer = self._answer_to(self._latest, None)  # from scratch: what was before has no say
        header = Header(stamp=self._latest.message.header.stamp, frame_id=self._values["frame_id"])
        response.solution = self._messages(header, answer)[0]
        response.success, response.message = answer.ok, answer.message
        return response

    def _on_reset(self, request, response):
        self._tilts.clear()
        self._waiting.clear()
        self._latest = self._answer = self._standing = None
        response.success, response.message = True, "tilts, frames that wait and the last fix are forgotten"
        return response

    # diagnostics -----------------------------------------------------------------------------------------------------

    def _report_solution(self) -> Report:
        a = self._answer
        if a is None:
            waiting = "building the triangles of this field" if self._preparing else "no frame yet"
            return Report(Level.WARN, self._trouble or waiting, self._counts)
        values = self._counts | {"status": a.status.value, "stars detected": a.stars_detected}
        values |= {"stars matched": len(a.names), "identify (s)": a.identify_s, "fit (s)": a.fix_s}
        if a.fix:
            east, north, _ = a.fix.covariance.diagonal() ** 0.5
            values |= {
                "sigma east (m)": float(east),
                "sigma north (m)": float(north),
                "residual (arcsec)": a.fix.residual_arcsec,
            }
        if a.extrapolated_days > 0:
            old = f"UT1 is extrapolated by {a.extrapolated_days:.0f} days: upgrade astropy-iers-data"
            return Report(Level.WARN, old if a.ok else a.message, values)
        return Report(Level.OK if a.ok else Level.WARN, a.message, values)

    def _report_inputs(self) -> Report:
        now = self._steady.now().nanoseconds
        ages = {name: (now - seen) * 1e-9 for name, seen in self._last_seen_ns.items()}
        missing = [name for name in ("camera_info", "stars", "tilt") if ages.get(name, 1e9) > STALE_S]
        values = {f"{name} age (s)": age for name, age in ages.items()} | {"tilts kept": len(self._tilts)}
        if missing:
            return Report(Level.WARN, f"nothing on {', '.join(missing)} for {STALE_S:g} s", values)
        return Report(Level.OK, "all inputs arrive", values)
