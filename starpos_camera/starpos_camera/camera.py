# SPDX-License-Identifier: Apache-2.0
"""The node `camera`: publishes the frames of a source on `~/image_raw`, with intrinsics and how each was taken."""

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rclpy.parameter
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from sensor_msgs.srv import SetCameraInfo
from std_msgs.msg import Header

from starpos import system_clock
from starpos.errors import InstrumentError
from starpos.files import path_of
from starpos.frames.exposure import Shutter
from starpos.frames.frame import Frame
from starpos.instrument import instrument_file
from starpos.instrument.camera import Camera
from starpos.instrument.instrument import focal_px_of
from starpos.messages.camera import message_to_camera
from starpos.parameters.table import parameters_of
from starpos.session.driver import Changes
from starpos_camera.sources.registry import SOURCES
from starpos_camera.sources.source import CapturedFrame, CaptureSettings, FrameSource, NothingYet, SourceEnded
from starpos_camera.sources.timing import OF_SYSTEM_CLOCK, ShutterTimes, check_one_time
from starpos_common.diagnostics import ClockReport, Diagnosis, Diagnostics, Level, time_is_simulated
from starpos_common.messages import camera_to_message, frame_to_message, shutter_fields, unix_to_stamp
from starpos_common.parameters import declare
from starpos_common.topics import publisher, steady_timer, subscription
from starpos_common.worker import Worker, failure_of_frame
from starpos_interfaces.msg import Capture, Pulse
from starpos_interfaces.srv import SetCapture

if TYPE_CHECKING:
    from starpos_camera.detector import DetectorNode

# Time for which a trouble is shown; diagnostics come once a second.
SHOWN_S = 5.0
# Frames (of 42 MB) that the middleware keeps for slow readers.
IMAGE_DEPTH = 2
STAMP_SOURCES = ("unknown", "file", "driver", "command", "hardware", "simulated", "exif")


class CameraNode(Node):
    """Publishes sensor_msgs/Image, CameraInfo and starpos_interfaces/Capture; see README.md."""

    def __init__(self, detector: "DetectorNode | None" = None, **options: Any) -> None:
        """Make the node; options: as for rclpy's Node.

        detector: gets each frame in this process too, without a copy, in the executor's thread.
        """
        super().__init__("camera", **options)
        self._values = declare(
            self,
            parameters_of("camera"),
            apply=self._apply,
            check=lambda values, _: SOURCES[values["source"]].refusal(values, _settings(values)),
        )
        self._calibration_path: Path | None = None
        self._calibration: Camera | None = None
        if self._values["calibration_url"]:
            self._calibration_path = path_of(self._values["calibration_url"])
            # Path.exists would raise if a name is too long.
            if os.path.exists(self._calibration_path):
                self._calibration = instrument_file.read_camera(self._calibration_path)
            else:
                self.get_logger().warning(
                    f"{self._calibration_path}: there is no calibration yet; the camera is ideal, of focal_mm "
                    "and pixel_um, until ~/set_camera_info is called."
                )
        self._shutter: ShutterTimes | None = None
        if self._values["pulses"]:
            self._shutter = ShutterTimes(self._values)
            subscription(self, Pulse, "pulses", self._shutter.hear, 100)
        self._source: FrameSource = SOURCES[self._values["source"]](self._values, self._now_s)

        self._frames = self._failed = self._skipped = 0
        # How many were skipped at the last report.
        self._skipped_before = 0
        # What was said of the last frame.
        self._last: Capture | None = None
        self._last_took_s = 0.0
        # Columns and rows of the frames.
        self._size: tuple[int, int] | None = None
        self._detector = detector
        self._ended = False
        self._state = (Level.WARN, "no frame has been taken yet.")
        self._said_s = -math.inf
        self._log = Changes(self.get_logger())
        self._images = publisher(self, Image, "~/image_raw", IMAGE_DEPTH)
        self._infos = publisher(self, CameraInfo, "~/camera_info", 10, latched=True)
        self._captures = publisher(self, Capture, "~/capture", 10)
        self.create_service(SetCameraInfo, "~/set_camera_info", self._on_set_camera_info)
        self.create_service(SetCapture, "~/set_capture", self._on_set_capture)
        self._wake = self.create_guard_condition(self._on_wake)
        self._worker = Worker(self._prepare, self._wake.trigger, "capture")
        self._clock_report = ClockReport(self, self._stamped_by_system)
        tasks: dict[str, Callable[[], Diagnosis]] = {"Capture": self._report, "Clock": self._clock_report}
        self._diagnostics = Diagnostics(self, tasks, self._source.hardware_id)
        # Simulated time sets the pace of a replay. The system's clock may be stepped, and a timer on it would wait.
        timer = self.create_timer if time_is_simulated(self) else partial(steady_timer, self)
        self._timer = timer(self._values["cadence"], self._tick)
        self._worker.start()
        if lack := self._source.lacking():
            self._say(Level.WARN, lack)

    def close(self) -> None:
        self._worker.retire()
        # An exposure may last another hour.
        self._source.close()
        self._worker.stop()

    def _now_s(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _stamped_by_system(self) -> bool:
        return self._last is None or self._last.stamp_source in OF_SYSTEM_CLOCK

    def _apply(self, names: frozenset[str]) -> None:
        if "cadence" in names:
            self._timer.timer_period_ns = round(1e9 * self._values["cadence"])
            self._timer.reset()

    def _tick(self) -> None:
        if self._ended:
            return
        if not self._worker.idle:
            self._skipped += 1
        elif self._source.waits_for_listener and not self._frames and not self._heard():
            # Missing parts are reported first, because a subscriber would not help.
            lack = self._source.lacking()
            stars = " or of the stars" if self._detector else ""
            waiting = f"waiting for a subscriber of {self._images.topic_name}{stars}."
            self._say(Level.WARN if lack else Level.OK, lack or waiting)
        else:
            self._worker.offer(_settings(self._values))

    def _heard(self) -> bool:
        wanted = self._detector is not None and self._detector.wanted
        return wanted or self._images.get_subscription_count() > 0

    def _prepare(self, settings: CaptureSettings) -> tuple[CapturedFrame, Capture, Image | None, float]:
        """Take a frame and make it ready for `_publish`, in the worker's thread."""
        begin = time.monotonic()
        if time_is_simulated(self):
            exposure, clock = self._source.capture(settings), None
        else:
            exposure = self._capture(settings)
            # If the source states an error, the clock is another machine's.
            ours = exposure.stamp_source in OF_SYSTEM_CLOCK and not exposure.frame.clock_stddev_s
            clock = system_clock.read() if ours else None
        frame = replace(exposure.frame, clock_stddev_s=clock.stddev_s) if clock else exposure.frame
        if not math.isnan(self._values["readout"]):
            frame = replace(frame, shutter=Shutter(self._values["readout"], self._values["readout_stddev"]))
        header = Header(stamp=unix_to_stamp(frame.mid_unix_s), frame_id=self._values["frame_id"])
        capture = Capture(
            header=header,
            exposure=float(frame.exposure_s or 0.0),
            stamp_stddev=frame.stamp_stddev_s,
            clock_stddev=frame.clock_stddev_s,
            stamp_source=exposure.stamp_source,
            **shutter_fields(frame.shutter),
        )
        # A message is a copy of the frame, so it is made only for subscribers.
        heard = self._images.get_subscription_count()
        image = frame_to_message(frame, header.frame_id) if heard else None
        exposure = replace(exposure, frame=frame)
        return exposure, capture, image, time.monotonic() - begin

    def _capture(self, settings: CaptureSettings) -> CapturedFrame:
        # Diagnostics ask the watch every second, also during the capture.
        since_s, watch = self._now_s(), self._clock_report.watch
        set_s = watch.set_s()
        exposure = self._source.capture(settings)
        check_one_time(exposure, watch.set_s() - set_s)
        return self._shutter.date_frame(exposure, since_s, self._now_s()) if self._shutter else exposure

    def _on_wake(self) -> None:
        for result in self._worker.fetch():
            if isinstance(result, SourceEnded):
                self._ended = True
                self._say(Level.OK, str(result))
            elif isinstance(result, NothingYet):
                # Waiting between two frames is normal; a trouble is shown for a while before it.
                if self._state[0] is not Level.OK and time.monotonic() > self._said_s + SHOWN_S:
                    self._say(Level.OK, str(result))
            elif isinstance(result, Exception):
                self._failed += 1
                self._say(Level.ERROR, failure_of_frame(result))
            else:
                self._publish(*result)

    def _publish(
        self, exposure: CapturedFrame, capture: Capture, image: Image | None, seconds: float
    ) -> None:
        """Publish a frame and its messages (image: None without subscribers); seconds: how long it took."""
        frame, camera = exposure.frame, self._intrinsics(exposure.frame)
        info = camera_to_message(camera, capture.header.frame_id)
        info.header = capture.header
        self._captures.publish(capture)
        self._infos.publish(info)
        if image is not None:
            self._images.publish(image)
        if self._detector is not None:
            self._detector.submit(frame, capture.header)
        self._frames += 1
        self._last, self._last_took_s = capture, seconds
        self._size = frame.width, frame.height
        if (camera.width, camera.height) != self._size:
            self._say(
                Level.ERROR,
                f"the calibration is of {camera.width} x {camera.height} px but the frames have {frame.width} x "
                f"{frame.height} px: calibrate the camera as it is used.",
            )
        elif exposure.remark:
            self._say(Level.WARN, exposure.remark)
        else:
            self._say(Level.OK, f"taking frames of {frame.width} x {frame.height} px.")

    def _intrinsics(self, frame: Frame) -> Camera:
        focal_px = focal_px_of(self._values["focal_mm"], self._values["pixel_um"])
        return self._calibration or Camera.from_focal(frame.width, frame.height, focal_px)

    def _say(self, level: Level, sentence: str) -> None:
        """Set the state; log it if it differs from the last logged one."""
        self._state, self._said_s = (level, sentence), time.monotonic()
        self._log.say(sentence, level is Level.OK)

    def _on_set_camera_info(
        self, request: SetCameraInfo.Request, response: SetCameraInfo.Response
    ) -> SetCameraInfo.Response:
        try:
            camera = message_to_camera(request.camera_info, "set_camera_info")
            if self._size is not None and self._size != (camera.width, camera.height):
                raise InstrumentError(
                    f"set_camera_info: the calibration is of {camera.width} x {camera.height} px but the frames "
                    f"have {self._size[0]} x {self._size[1]} px: calibrate with whole frames."
                )
            # A calibration that cannot be written still holds for this session, and the answer says so.
            self._calibration = camera
            if self._calibration_path is not None:
                self._keep(self._calibration_path, camera)
                response.status_message = f"written to {self._calibration_path}."
            else:
                response.status_message = "holds for this session; set calibration_url to keep it."
            response.success = True
        except InstrumentError as error:
            response.success = False
            response.status_message = str(error)
        if response.success:
            self.get_logger().info(f"set_camera_info: {response.status_message}")
        else:
            self.get_logger().warning(response.status_message)
        return response

    def _keep(self, path: Path, camera: Camera) -> None:
        try:
            instrument_file.write_camera(path, camera, self.get_name())
        except InstrumentError as error:
            raise InstrumentError(f"{error}; the calibration holds for this session only.") from None

    def _on_set_capture(
        self, request: SetCapture.Request, response: SetCapture.Response
    ) -> SetCapture.Response:
        wanted = {"gain": request.gain, "exposure": request.exposure, "cadence": request.cadence}
        # 0 means unset for an exposure and a cadence, and for a gain if none is set now.
        zero_is_set = [] if math.isnan(self._values["gain"]) else ["gain"]
        changes = [
            rclpy.parameter.Parameter(name, value=value)
            for name, value in wanted.items()
            if not math.isnan(value) and (value != 0 or name in zero_is_set)
        ]
        refusal = ""
        # rclpy refuses an empty list of changes.
        if changes:
            result = self.set_parameters_atomically(changes)
            refusal = "" if result.successful else result.reason or "the parameters were refused."
        response.success = not refusal
        now = "exposure {exposure:g} s, gain {gain:g}, cadence {cadence:g} s.".format(**self._values)
        response.message = refusal or now
        return response

    def _report(self) -> Diagnosis:
        level, sentence = self._state
        skipped, self._skipped_before = self._skipped - self._skipped_before, self._skipped
        cadence, last = self._values["cadence"], self._last
        if level is Level.OK and skipped:
            level = Level.WARN
            sentence = (
                f"a frame takes longer than the cadence of {cadence:g} s: {skipped} skipped; lengthen it."
            )
        if time_is_simulated(self) and not self.get_clock().now().nanoseconds:
            level, sentence = Level.WARN, "use_sim_time is set but no /clock has come yet."
        values: dict[str, object] = {
            "source": self._values["source"],
            "frames": self._frames,
            "failed": self._failed,
            "skipped": self._skipped,
            "cadence (s)": cadence,
            "calibrated": self._calibration is not None,
            **(self._shutter.values() if self._shutter is not None else {}),
        }
        if last is not None and self._size is not None:
            width, height = self._size
            values |= {
                "size (px)": f"{width} x {height}",
                "exposure (s)": last.exposure,
                "stamp from": STAMP_SOURCES[last.stamp_source],
                "stamp error (s)": last.stamp_stddev,
                "shutter": _shutter(last),
                "taking one frame (s)": self._last_took_s,
            }
        return Diagnosis(level, sentence, values)


def _shutter(capture: Capture) -> str:
    if not capture.shutter_known:
        return "not known"
    if capture.readout == capture.readout_stddev == 0:
        return "global"
    return f"rolling, {capture.readout:.3g} +- {capture.readout_stddev:.3g} s from the first row to the last"


def _settings(values: Mapping[str, Any]) -> CaptureSettings:
    exposure_s, gain = (None if math.isnan(values[name]) else values[name] for name in ("exposure", "gain"))
    return CaptureSettings(exposure_s, gain, values["cadence"])
