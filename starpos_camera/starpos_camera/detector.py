# SPDX-License-Identifier: Apache-2.0
"""The node `detector`: finds the stars of frames and publishes `stars`."""

import itertools
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from starpos.detection import Detection, DetectionSettings, detect
from starpos.detection.exposing import next_exposure_s
from starpos.errors import StarposError
from starpos.frames.frame import Disc, Frame
from starpos.messages.camera import (
    CAPTURES_KEPT,
    ExposureFacts,
    check_stamp,
    message_to_frame,
    message_to_picture,
)
from starpos.messages.stamp import stamp_to_ns, stamp_to_unix
from starpos.parameters.table import parameters_of
from starpos.session.driver import Changes
from starpos.session.pace import MAX_LATE_S, Pace
from starpos_camera.after_solution import Annotator, TrailFinder
from starpos_common.diagnostics import Diagnosis, Diagnostics, Level, Troubles, time_is_simulated
from starpos_common.messages import encoding_of, stars_to_message
from starpos_common.parameters import declare
from starpos_common.topics import LOOK_S, MatchedSubscription, Receiver, publisher, steady_timer, subscription
from starpos_common.worker import Worker, failure_of_frame
from starpos_interfaces.msg import Capture, StarArray
from starpos_interfaces.srv import SetCapture

RAW, COMPRESSED = "camera/image_raw", "camera/image_raw/compressed"
# Only the newest frame is kept; each more would take another 42 MB.
IMAGE_DEPTH = 1
# number of stamps of a topic by which a frame that the other one brings later is known
STAMPS_KEPT = 4


class FrameTopics:
    """Subscribes to the raw topic, and to the compressed one until a raw frame comes; each frame is taken once.

    A driver that sends MJPEG may offer the raw topic, too, and never send on it.
    take: takes an Image or a CompressedImage.
    both: hear both topics all the time, as in a replay, where which of them sends shows only message by message.
    """

    def __init__(self, node: Node, take: Receiver, both: bool) -> None:
        self._node, self._take, self._both = node, take, both
        # with the raw topic the compressed one moves, unless it is remapped itself
        self.compressed_topic = node.resolve_topic_name(COMPRESSED)
        if self.compressed_topic == node.resolve_topic_name(COMPRESSED, only_expand=True):
            self.compressed_topic = f"{node.resolve_topic_name(RAW)}/compressed"
        # stamps of the last frames of each topic
        self._stamps = {kind: deque[int](maxlen=STAMPS_KEPT) for kind in (Image, CompressedImage)}
        self._raw_sends = False
        self._compressed: MatchedSubscription | None = None
        self._raw = MatchedSubscription(node, Image, RAW, self._pass_raw, IMAGE_DEPTH)
        # Where frames are expected, for sentences.
        self.where = f" on {self._raw.topic}"
        self._look()
        self._timer = steady_timer(node, LOOK_S, self._look)

    def unheard(self) -> str:
        """Sentence on publishers that cannot be heard, and why; '' without any."""
        heard = [s for s in (self._raw, self._compressed) if s is not None]
        return next(filter(None, (s.unheard() for s in heard)), "")

    def missing(self) -> str:
        """The rest of a sentence on why no frame comes; '' where a publisher is heard."""
        if self._raw.publishers or self._compressed is not None:
            return ""
        elsewhere = self._raw.elsewhere()
        hint = (
            f", but images are on {elsewhere}: remap {RAW} to the camera's (-r {RAW}:=...)"
            if elsewhere
            else ""
        )
        return f": no node publishes it{hint}"

    def _look(self) -> None:
        """Adapt the subscriptions to what is published."""
        self._raw_sends &= bool(self._raw.publishers)
        offered = self._node.count_publishers(self.compressed_topic) > 0
        wanted = self._both or (offered and not self._raw_sends)
        if wanted and self._compressed is None:
            topic = self.compressed_topic
            self._compressed = MatchedSubscription(
                self._node, CompressedImage, topic, self._pass_compressed, IMAGE_DEPTH
            )
        elif not wanted and self._compressed is not None:
            self._compressed.destroy()
            self._compressed = None

    def _pass_raw(self, message: Image, info: Mapping[str, Any]) -> None:
        self._raw_sends = True
        self._pass_once(message, info, CompressedImage)

    def _pass_compressed(self, message: CompressedImage, info: Mapping[str, Any]) -> None:
        if not self._raw_sends:
            self._pass_once(message, info, Image)

    def _pass_once(self, message: Any, info: Mapping[str, Any], other: type) -> None:
        """Pass a message on, unless its frame has come on the other topic."""
        stamp = stamp_to_ns(message.header.stamp)
        self._stamps[type(message)].append(stamp)
        if stamp not in self._stamps[other]:
            # a bag that is played again has the same stamps
            self._stamps[other].clear()
            self._take(message, info)


# Time that an image waits for its Capture, which comes on another topic: if a busy machine lost it, the middleware
# repeats it when the next one is sent, or after 3 s.
CAPTURE_PATIENCE_S = 3.5
# The same time while no publisher of Captures is known yet: there may not be one.
DISCOVERY_S = 0.5
# Maximum number of waiting frames, of 42 MB each.
MAX_HELD = 3
HELD_LOOK_S = 0.1
# Share by which a camera's exposure may differ from the one asked for, and how many frames may be of the one before.
AS_ASKED, FRAMES_ON_THEIR_WAY = 0.1, 3
# Silence is reported after this time, and after three times the interval between the last two frames.
MIN_SILENCE_S = 5.0


@dataclass(frozen=True, eq=False)
class DetectedFrame:
    """Stars of a frame, ready to be published, and the time it took."""

    message: StarArray
    detection: Detection
    cpu_ms: float
    seconds: float


class DayExposure:
    """Asks a camera for the exposure that day or night takes, and for the night's own again."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._client = node.create_client(SetCapture, "camera/set_capture")
        # the exposure of the night, and the one that was asked for and has not come
        self._longest_s = 0.0
        self._asked_s: float | None = None
        self._patience = 0

    def judge(self, frame: Frame, disc: Disc | None) -> None:
        """Ask for another exposure if this frame needs one; a frame whose exposure somebody changed sets the night's."""
        now_s, asked_s = frame.exposure_s or 0.0, self._asked_s
        if asked_s is not None and not math.isclose(now_s, asked_s, rel_tol=AS_ASKED):
            # frames that were on their way, or a camera that does not follow
            self._patience -= 1
            if self._patience > 0:
                return
        if asked_s is None or now_s > self._longest_s:
            self._longest_s = now_s
        wanted_s = next_exposure_s(frame, disc, self._longest_s)
        if wanted_s is None or not self._client.service_is_ready():
            return
        self._asked_s, self._patience = wanted_s, FRAMES_ON_THEIR_WAY
        self._node.get_logger().info(f"the camera is asked for an exposure of {wanted_s:.3g} s.")
        coming = self._client.call_async(
            SetCapture.Request(exposure=wanted_s, gain=math.nan, cadence=math.nan)
        )
        coming.add_done_callback(self._answered)

    def _answered(self, coming: Any) -> None:
        answer = coming.result()
        if answer is not None and not answer.success:
            self._node.get_logger().warning(f"the camera refused another exposure: {answer.message}")


class DetectorNode(Node):
    """Publishes starpos_interfaces/StarArray on `stars`, and frames with marks on `~/image_annotated`; see README.md."""

    def __init__(self, listens: bool = True, **options: Any) -> None:
        """Make the node; options: as for rclpy's Node.

        listens: take the frames of `camera/image_raw`; otherwise a camera in the same process calls `submit`.
        """
        super().__init__("detector", **options)
        self._values = declare(self, parameters_of("detector"), apply=self._apply)
        self._settings = DetectionSettings.by_parameters(self._values)
        self._exposures = ExposureFacts(self._values)
        # images until their Captures come, oldest first, and how long they wait for them, monotonic s
        self._held: deque[tuple[Image | CompressedImage, float]] = deque()
        self._frames = self._bad = 0
        self._pace = Pace()
        self._troubles = Troubles(self)
        # What was wrong with a frame since the last report.
        self._complaint = ""
        self._last: DetectedFrame | None = None
        self._sizes = Changes(self.get_logger())
        # In monotonic time.
        self._last_frame_s: float | None = None
        self._interval_s: float | None = None
        self._publisher = publisher(self, StarArray, "stars", 10)
        # None: a camera in this process hands over its frames.
        self._topics: FrameTopics | None = None
        self._captures_come: Callable[[], int] = lambda: 0
        self._annotator = Annotator(self)
        self._day = DayExposure(self) if self._values["day_exposure"] else None
        self._trail_finder = TrailFinder(self) if self._values["trails"] else None
        self._wake = self.create_guard_condition(self._on_wake)
        self._worker = Worker(self._detect, self._wake.trigger, "detection")
        self._diagnostics = Diagnostics(self, {"Stars": self._report})
        self._worker.start()
        if listens:
            self._listen()

    def _listen(self) -> None:
        self._look = steady_timer(self, HELD_LOOK_S, self._go_on, autostart=False)
        captures = subscription(self, Capture, "camera/capture", self._on_capture, CAPTURES_KEPT)
        self._captures_come = captures.get_publisher_count
        self._topics = FrameTopics(self, self._on_image, both=time_is_simulated(self))

    def close(self) -> None:
        self._worker.stop()
        self._annotator.stop()
        if self._trail_finder is not None:
            self._trail_finder.stop()

    @property
    def wanted(self) -> bool:
        """Whether the stars have subscribers."""
        return self._publisher.get_subscription_count() > 0

    def submit(self, frame: Frame, header: Header) -> None:
        """Detect and publish the stars of a frame under `header`; it replaces a frame that still waits.

        A camera node in the same process calls this, and hands its pixels over without a copy.
        """
        self._arrived()
        self._offer(lambda: frame, header)

    def _offer(self, make: Callable[[], Frame], header: Header) -> None:
        """Have the worker find the stars of the frame that `make` decodes, which may take long."""
        self._pace.took(time.monotonic())
        if self._worker.offer((make, header)):
            self._pace.drop(time.monotonic())

    def _arrived(self) -> None:
        now = time.monotonic()
        if self._last_frame_s is not None:
            self._interval_s = now - self._last_frame_s
        self._last_frame_s = now

    def _apply(self, names: frozenset[str]) -> None:
        self._settings = DetectionSettings.by_parameters(self._values)

    def _on_capture(self, message: Capture) -> None:
        self._exposures.keep_capture(message)
        self._go_on()

    def _on_image(self, message: Image | CompressedImage, info: Mapping[str, Any]) -> None:
        self._pace.numbered(info["publication_sequence_number"], time.monotonic(), type(message))
        first = self._last_frame_s is None
        self._arrived()
        try:
            check_stamp(message.header)
        except StarposError as error:
            self._complain(str(error))
            return
        if not self._pace.wants(stamp_to_unix(message.header.stamp), self._values["max_rate"]):
            return
        patience_s = CAPTURE_PATIENCE_S if self._captures_come() else 0.0
        # At the first image the sender's Captures may not have been discovered yet.
        if first:
            patience_s = max(patience_s, DISCOVERY_S)
        self._held.append((message, time.monotonic() + patience_s))
        self._go_on()

    def _go_on(self) -> None:
        """Submit the oldest frame if its Capture has come, or will not come; of too many the oldest is dropped."""
        if not self._held:
            return
        while self._ready(0):
            if self._worker.idle:
                self._offer_image(self._held.popleft()[0])
            elif self._ready(1) and self._too_many:
                self._held.popleft()
                self._pace.drop(time.monotonic())
            else:
                break
        if not self._held:
            self._look.cancel()
        elif self._look.is_canceled():
            self._look.reset()

    @property
    def _too_many(self) -> bool:
        """Whether the held frames would be searched too late."""
        each_s = self._last.seconds if self._last else math.inf
        return len(self._held) > MAX_HELD or len(self._held) * each_s > MAX_LATE_S

    def _ready(self, k: int) -> bool:
        """Whether the k-th held frame need not wait for its Capture any more."""
        if k >= len(self._held):
            return False
        # a sender's Captures come in order: if a later frame's is here, its own is lost
        come = any(self._exposures.has(image.header) for image, _ in itertools.islice(self._held, k, None))
        return come or len(self._held) > MAX_HELD or time.monotonic() >= self._held[k][1]

    def _offer_image(self, message: Image | CompressedImage) -> None:
        """Submit an image, with the known facts of its exposure."""
        read = message_to_frame if isinstance(message, Image) else message_to_picture
        try:
            mid_ns, add = self._exposures.of(message.header)
            header = Header(frame_id=message.header.frame_id, stamp=Time(nanoseconds=mid_ns).to_msg())
            self._offer(lambda: add(read(message)), header)
        except StarposError as error:
            # The Capture has values that no exposure and no clock can have.
            self._complain(str(error))

    def _detect(self, job: tuple[Callable[[], Frame], Header]) -> tuple[Frame, DetectedFrame]:
        """Find the stars of a frame, in the worker's thread."""
        # The CPU time of this thread alone: others may draw or render meanwhile.
        begin, cpu = time.monotonic(), time.thread_time()
        make, header = job
        frame = make()
        detection = detect(frame, self._settings)
        message = stars_to_message(detection.stars, header.frame_id)
        # The stamp must be the frame's to the nanosecond, because others match messages by it.
        message.header = header
        cpu_ms = (time.thread_time() - cpu) * 1e3
        return frame, DetectedFrame(message, detection, cpu_ms, time.monotonic() - begin)

    def _on_wake(self) -> None:
        for result in self._worker.fetch():
            if isinstance(result, Exception):
                self._complain(failure_of_frame(result))
                continue
            frame, found = result
            message, stars = found.message, found.detection.stars
            self._last = found
            self._publisher.publish(message)
            self._frames += 1
            self._troubles.right("frames")
            self._sizes.say(f"frames of {frame.width} x {frame.height} px, {encoding_of(frame)}.", True)
            if self._day is not None:
                self._day.judge(frame, stars.disc)
            self._annotator.offer(frame, stars, message.header)
            if self._trail_finder is not None:
                self._trail_finder.offer(frame, stars, message.header)
        self._go_on()

    def _complain(self, sentence: str) -> None:
        self._bad += 1
        self._complaint = sentence
        self._troubles.wrong("frames", sentence)

    def _unsaid(self) -> str:
        """Sentence on the parameters to state of the camera; '' if there is nothing."""
        unsaid = self._exposures.missing_statement if self._topics and not self._captures_come() else ""
        if unsaid:
            self._troubles.wrong("stamps", unsaid)
        return unsaid

    def _report(self) -> Diagnosis:
        level, sentence = Level.OK, "no stars in the last frame."
        complaint, self._complaint = self._complaint, ""
        last = self._last
        if last and last.message.stars:
            sun = last.detection.stars.disc
            day = "" if sun is None else f"{'a disc' if sun.sharp else 'a glow'} as the Sun's, "
            sentence = f"{day}{len(last.detection.stars)} stars in {last.seconds:.2f} s."
        if last and last.detection.left_out:
            level = Level.WARN
            sentence += f" {last.detection.left_out} fainter peaks are left out: too many for stars, check the exposure."
        topics, where = self._topics, self._topics.where if self._topics else ""
        silence_s = time.monotonic() - self._last_frame_s if self._last_frame_s is not None else math.inf
        if self._last_frame_s is None:
            level, sentence = (
                Level.WARN,
                f"no frame has come yet{where}{topics.missing() if topics else ''}.",
            )
        elif complaint:
            level, sentence = Level.WARN, complaint
        elif silence_s > max(MIN_SILENCE_S, 3 * (self._interval_s or 0.0)):
            level = Level.WARN
            sentence = f"no frame for {silence_s:.0f} s{where}: is the camera running?"
        elif dropped := self._pace.complaint:
            level, sentence = Level.WARN, f"{sentence} {dropped}."
        elif unsaid := self._unsaid():
            level, sentence = Level.WARN, f"{sentence} {unsaid}"
        if topics and (unheard := topics.unheard()):
            self._troubles.wrong("unheard", unheard)
            level, sentence = Level.WARN, f"{unheard} {sentence}"
        values: dict[str, object] = {
            "frames": self._frames,
            "bad frames": self._bad,
            "dropped": self._pace.dropped,
            "left out by max_rate": self._pace.left_out,
        }
        if last:
            values |= {
                "stars": len(last.detection.stars),
                "disc": last.detection.stars.disc is not None,
                "left out": last.detection.left_out,
                "background (DN)": last.detection.background,
                "noise (DN)": last.detection.noise,
                "fwhm (px)": last.detection.fwhm_px,
                "chi2": last.detection.typical_chi2,
                "cpu_ms": last.cpu_ms,
                "seconds": last.seconds,
            }
        return Diagnosis(level, sentence, values)
