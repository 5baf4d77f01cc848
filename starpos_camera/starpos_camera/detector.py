# SPDX-License-Identifier: Apache-2.0
"""The node `detector`: finds the stars of frames and publishes `stars`."""

import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import Header

from starpos.detection import Detection, DetectionSettings, detect
from starpos.errors import StarposError, TimeError
from starpos.frames.frame import Frame
from starpos.messages.camera import message_to_frame
from starpos.messages.stars import message_to_shutter
from starpos.session.trails import Trails
from starpos_camera.annotator import Annotator
from starpos_camera.detector_parameters import PARAMETERS
from starpos_common.clock_report import time_is_simulated
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level
from starpos_common.messages import encoding_of, stars_to_message
from starpos_common.parameters import declare
from starpos_common.replayed import Replayed
from starpos_common.topics import Take, publisher, subscription, subscription_from_any
from starpos_common.troubles import Troubles
from starpos_common.worker import Worker
from starpos_interfaces.msg import Capture, StarArray

# Only the newest frame is kept; each more would take another 42 MB.
IMAGE_DEPTH = 1
CAPTURES_KEPT = 16
# seconds of an IMU at 400 Hz
IMU_QUEUE = 4000
# An image waits so long for its Capture, which comes on another topic: where a busy machine lost it, the middleware
# repeats it when the next one is sent, or after 3 s.
CAPTURE_PATIENCE_S = 3.5
# So long where no publisher of Captures is known yet: there may be none.
DISCOVERY_S = 0.5
# Frames that wait at most, of 42 MB each.
MOST_HELD = 3
LOOK_S = 0.1
# Silence is reported after so long, and after three times the interval between the last two frames.
MIN_SILENCE_S = 5.0


@dataclass(frozen=True, eq=False)
class Job:
    """A frame with its message's header."""

    frame: Frame
    header: Header


@dataclass(frozen=True, eq=False)
class DetectedFrame:
    """Stars of a frame, ready to be published, and the time it took. The frame is dropped once they are published."""

    frame: Frame | None
    message: StarArray
    detection: Detection
    cpu_ms: float
    seconds: float


class DetectorNode(Node):
    """Publishes starpos_interfaces/StarArray on `stars`, and frames with marks on `~/image_annotated`; see README.md."""

    def __init__(self, **options: Any) -> None:
        """Make the node; options: those of rclpy's Node (context, namespace, parameter_overrides ...)."""
        super().__init__("detector", **options)
        self._values = declare(self, PARAMETERS, apply=self._apply)
        self._settings = self._detection_settings()
        # By stamp, the oldest first.
        self._captures: dict[tuple[int, int], Capture] = {}
        # what holds for a frame whose Capture is lost
        self._usual = Capture()
        # frames until their Captures come, oldest first, and how long they wait for them, s of the clock below
        self._held: deque[tuple[Job, float]] = deque()
        self._frames = self._bad = self._dropped = 0
        # Sequence number of the last image; None: the middleware gives none.
        self._sequence: int | None = None
        self._replayed: Replayed | None = None
        self._troubles = Troubles(self)
        # What was wrong with a frame since the last report.
        self._complaint = ""
        self._last: DetectedFrame | None = None
        # Size of the last frame, in words.
        self._size = ""
        # In monotonic time.
        self._last_frame_s: float | None = None
        self._interval_s: float | None = None
        self._publisher = publisher(self, StarArray, "stars", 10)
        # Where frames come from, for messages.
        self._where = ""
        self._annotator = Annotator(self)
        self._trails: Trails | None = None
        if self._values["gyro"]:
            self._trails = Trails(self._values["calibration_url"])
            best_effort = ReliabilityPolicy.BEST_EFFORT
            subscription(self, Imu, "imu/data", self._on_imu, IMU_QUEUE, best_effort)
            subscription_from_any(self, CameraInfo, "camera/camera_info", self._on_camera, 1)
        self._wake = self.create_guard_condition(self._on_wake)
        self._worker = Worker(self._detect, self._wake.trigger, "detection")
        self._diagnostics = Diagnostics(self, {"Stars": self._report})
        _warm_up()
        self._worker.start()

    def listen(self) -> None:
        """Take the frames of `camera/image_raw`. A camera in the same process calls `submit` instead."""
        takes: dict[str, Take] = {"camera/capture": self._on_capture, "camera/image_raw": self._on_image}
        self._patience_clock = Clock(clock_type=ClockType.STEADY_TIME)
        if time_is_simulated(self):
            self._patience_clock = self.get_clock()
            self._replayed = Replayed(self, takes, [self._publisher], busy=lambda: not self._worker.idle)
        self._look = self.create_timer(LOOK_S, self._go_on, clock=self._patience_clock, autostart=False)
        self._captures_come = self._subscribe(Capture, "camera/capture", takes, CAPTURES_KEPT)
        images = self._subscribe(Image, "camera/image_raw", takes, IMAGE_DEPTH)
        self._where = f" on {images.topic_name}"

    def _subscribe(self, kind: type, name: str, takes: Mapping[str, Take], depth: int) -> Subscription:
        def on_message(message: Any, info: Mapping[str, Any]) -> None:
            if self._replayed is None or not self._replayed.holds(name, message, info):
                takes[name](message, info)

        return subscription(self, kind, name, on_message, depth)

    def destroy_node(self) -> None:
        self._worker.stop()
        self._annotator.stop()
        super().destroy_node()

    @property
    def wanted(self) -> bool:
        """Whether somebody subscribes to the stars."""
        return self._publisher.get_subscription_count() > 0

    def submit(self, frame: Frame, header: Header) -> None:
        """Detect and publish the stars of a frame under `header`; it replaces a frame that still waits.

        The subscription calls this, and a camera node in the same process, which hands its pixels over without a copy.
        """
        self._arrived()
        size = f"{frame.width} x {frame.height} px, {encoding_of(frame)}"
        if size != self._size:
            self._size = size
            self.get_logger().info(f"frames of {size}.")
        if self._trails is not None:
            frame = self._trails.told(frame)
        if self._worker.offer(Job(frame, header)):
            self._dropped += 1

    def _on_imu(self, message: Imu) -> None:
        # in a replay the stars would depend on which readings came before a frame
        if not time_is_simulated(self):
            self._tell_trails("imu/data", lambda trails: trails.take_imu(message))

    def _on_camera(self, message: CameraInfo, info: Mapping[str, Any]) -> None:
        self._tell_trails("camera_info", lambda trails: trails.take_camera(message))

    def _tell_trails(self, name: str, tell: Callable[[Trails], None]) -> None:
        assert self._trails is not None
        try:
            tell(self._trails)
            self._troubles.right(name)
        except StarposError as error:
            self._troubles.wrong(name, str(error))

    def _arrived(self) -> None:
        now = time.monotonic()
        if self._last_frame_s is not None:
            self._interval_s = now - self._last_frame_s
        self._last_frame_s = now

    def _detection_settings(self) -> DetectionSettings:
        v = self._values
        saturation = None if math.isnan(v["saturation"]) else v["saturation"]
        return DetectionSettings(
            threshold=v["threshold"],
            min_snr=v["min_snr"],
            max_stars=v["max_stars"],
            threads=v["threads"],
            saturation_dn=saturation,
        )

    def _apply(self, names: frozenset[str]) -> None:
        self._settings = self._detection_settings()

    def _on_capture(self, message: Capture, info: Mapping[str, Any]) -> None:
        if len(self._captures) >= CAPTURES_KEPT:
            del self._captures[next(iter(self._captures))]
        self._captures[_key(message.header)] = message
        self._go_on()

    def _on_image(self, message: Image, info: Mapping[str, Any]) -> None:
        self._count_overwritten(info["publication_sequence_number"])
        try:
            _check_stamp(message.header)
            frame = message_to_frame(message)
        except StarposError as error:
            self._arrived()
            self._complain(str(error))
            return
        patience_s = CAPTURE_PATIENCE_S if self._captures_come.get_publisher_count() else 0.0
        # At the first image the sender's Captures may not have been discovered yet.
        if self._last_frame_s is None:
            patience_s = max(patience_s, DISCOVERY_S)
        if self._replayed is not None and self._replayed.playing:
            # It was played before its image, or is not in the bag.
            patience_s = 0.0
        self._held.append((Job(frame, message.header), self._now_s() + patience_s))
        self._go_on()

    def _now_s(self) -> float:
        return self._patience_clock.now().nanoseconds * 1e-9

    def _go_on(self) -> None:
        """Submit the oldest frame if its Capture has come, or will not come; a newer one that is ready replaces it."""
        if not self._held:
            return
        while self._ready(0):
            if self._worker.idle:
                self._submit_with_capture(self._held.popleft()[0])
            elif self._ready(1):
                self._held.popleft()
                self._dropped += 1
            else:
                break
        if not self._held:
            self._look.cancel()
        elif self._look.is_canceled():
            self._look.reset()

    def _ready(self, k: int) -> bool:
        """Whether the k-th frame that is held need not wait for its Capture any more."""
        if k >= len(self._held):
            return False
        # of one sender they come in order: if that of a later frame is here, its own is lost
        come = any(_key(job.header) in self._captures for job, _ in itertools.islice(self._held, k, None))
        return come or len(self._held) > MOST_HELD or self._now_s() >= self._held[k][1]

    def _submit_with_capture(self, job: Job) -> None:
        """Submit a frame, with its Capture if that has come."""
        try:
            frame = self._with_capture(job)
        except StarposError as error:
            # The Capture has values that no exposure and no clock can have.
            self._arrived()
            self._complain(str(error))
            return
        self.submit(frame, job.header)

    def _count_overwritten(self, sequence: int | None) -> None:
        """Count the frames that newer ones replaced in the middleware; a lower number comes from another publisher."""
        if sequence is not None and self._sequence is not None and sequence > self._sequence:
            self._dropped += sequence - self._sequence - 1
        self._sequence = sequence

    def _with_capture(self, job: Job) -> Frame:
        """Add exposure, errors and shutter of the Capture to its frame; of a lost one those of the last, no exposure."""
        capture = self._captures.pop(_key(job.header), None) or self._usual
        told = (capture.exposure, capture.stamp_stddev, capture.clock_stddev)
        exposure, stamp, clock = (v if math.isfinite(v) and v > 0 else 0.0 for v in told)
        exposure = exposure or self._values["exposure"] or None
        frame = replace(
            job.frame,
            exposure_s=exposure,
            stamp_stddev_s=stamp,
            clock_stddev_s=clock,
            shutter=message_to_shutter(capture),
        )
        # the errors of a camera's times and its shutter are those of its other frames; its exposure may not be
        self._usual = Capture(
            stamp_stddev=capture.stamp_stddev,
            clock_stddev=capture.clock_stddev,
            shutter_known=capture.shutter_known,
            readout=capture.readout,
            readout_stddev=capture.readout_stddev,
        )
        return frame

    def _detect(self, job: Job) -> DetectedFrame:
        """Find the stars of a frame, in the worker's thread."""
        # The CPU time of this thread alone: others may draw or render meanwhile.
        begin, cpu = time.monotonic(), time.thread_time()
        detection = detect(job.frame, self._settings)
        message = stars_to_message(detection.stars, job.header.frame_id)
        # The stamp must be the frame's to the nanosecond, because others match messages by it.
        message.header = job.header
        cpu_ms = (time.thread_time() - cpu) * 1e3
        return DetectedFrame(job.frame, message, detection, cpu_ms, time.monotonic() - begin)

    def _on_wake(self) -> None:
        for result in self._worker.fetch():
            if isinstance(result, DetectedFrame):
                self._publisher.publish(result.message)
                self._frames += 1
                if self._replayed is not None:
                    self._replayed.made += 1
                self._troubles.right("frames")
                if result.frame is not None:
                    self._annotator.take(result.frame, result.detection.stars, result.message.header)
                self._last = replace(result, frame=None)
            elif isinstance(result, StarposError):
                self._complain(str(result))
            else:
                # A defect costs this frame only; the node goes on.
                kind = type(result).__name__
                self._complain(f"a frame was given up ({kind}: {result}); keep it and report this.")
        self._go_on()
        if self._replayed is not None:
            self._replayed.go_on()

    def _complain(self, sentence: str) -> None:
        self._bad += 1
        self._complaint = sentence
        self._troubles.wrong("frames", sentence)

    def _report(self) -> Diagnosis:
        level, sentence = Level.OK, "no stars in the last frame."
        complaint, self._complaint = self._complaint, ""
        last = self._last
        if last and last.message.stars:
            sentence = f"{len(last.message.stars)} stars in {last.seconds:.2f} s."
        if last and last.detection.left_out:
            level = Level.WARN
            sentence += f" {last.detection.left_out} fainter peaks are left out: too many for stars, check the exposure."
        silence_s = time.monotonic() - self._last_frame_s if self._last_frame_s is not None else math.inf
        if self._last_frame_s is None:
            level, sentence = Level.WARN, f"no frame has come yet{self._where}."
        elif complaint:
            level, sentence = Level.WARN, complaint
        elif silence_s > max(MIN_SILENCE_S, 3 * (self._interval_s or 0.0)):
            level = Level.WARN
            sentence = f"no frame for {silence_s:.0f} s{self._where}: is the camera running?"
        values: dict[str, object] = {
            "frames": self._frames,
            "bad frames": self._bad,
            "dropped": self._dropped,
        }
        if last:
            values |= {
                "stars": len(last.message.stars),
                "left out": last.detection.left_out,
                "background (DN)": last.detection.background,
                "noise (DN)": last.detection.noise,
                "fwhm (px)": last.detection.fwhm_px,
                "chi2": last.detection.typical_chi2,
                "cpu_ms": last.cpu_ms,
                "seconds": last.seconds,
            }
        return Diagnosis(level, sentence, values)


def _key(header: Header) -> tuple[int, int]:
    return header.stamp.sec, header.stamp.nanosec


def _check_stamp(header: Header) -> None:
    """Raise TimeError if the stamp is not set, or is no time."""
    sec, nanosec = _key(header)
    if not sec and not nanosec:
        raise TimeError(
            "image_raw: the frame has no time stamp; set header.stamp to the middle of the exposure."
        )
    if sec < 0 or nanosec >= 1_000_000_000:
        raise TimeError(
            f"image_raw: the stamp {sec} s {nanosec} ns is no time after 1970; check the camera's clock."
        )


def _warm_up() -> None:
    """Run everything once on a small frame with a few stars, so that the first real frame is not slow."""
    y, x = np.mgrid[:128, :128]
    light = np.random.default_rng(0).normal(500.0, 10.0, x.shape)
    for cx, cy in ((30.2, 40.7), (80.5, 30.1), (60.9, 95.4), (100.3, 101.8)):
        light += 3000.0 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 2.0)
    detection = detect(
        Frame(light.astype(np.uint16), pattern="", mid_unix_s=0.0, exposure_s=1.0, source="warm-up")
    )
    stars_to_message(detection.stars, "")
