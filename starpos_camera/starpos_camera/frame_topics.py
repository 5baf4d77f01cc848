# SPDX-License-Identifier: Apache-2.0
"""The topics that frames come on: `camera/image_raw`, or compressed pictures where a driver sends nothing else."""

import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image

from starpos.messages.exposures import key_of
from starpos_common.matched import MatchedSubscription
from starpos_common.topics import Take

RAW, COMPRESSED = "camera/image_raw", "camera/image_raw/compressed"
# Only the newest frame is kept; each more would take another 42 MB.
IMAGE_DEPTH = 1
# how often publishers are compared with the subscriptions
LOOK_S = 0.5
# A driver that sends MJPEG may offer the raw topic, too, and never send on it.
RAW_PATIENCE_S = 5.0


class FrameTopics:
    """Subscribes to the raw topic, and to the compressed one where no raw frame comes; each frame is taken once.

    take: takes an Image or a CompressedImage.
    """

    def __init__(self, node: Node, take: Take) -> None:
        self._node, self._take = node, take
        # with the raw topic the compressed one moves, unless it is remapped itself
        self.compressed_topic = node.resolve_topic_name(COMPRESSED)
        if self.compressed_topic == node.resolve_topic_name(COMPRESSED, only_expand=True):
            self.compressed_topic = f"{node.resolve_topic_name(RAW)}/compressed"
        self._raw: MatchedSubscription | None = None
        self._compressed: MatchedSubscription | None = None
        self._both = self._raw_sends = False
        # since when a raw publisher is there, monotonic
        self._offered_s: float | None = None
        # stamp of the last frame of each topic
        self._stamps: dict[type, tuple[int, int]] = {}

    @property
    def takes(self) -> dict[str, Take]:
        """What takes the messages of each topic."""
        return {RAW: self._take_raw, self.compressed_topic: self._take_compressed}

    def listen(self, taker: Callable[[str], Take], both: bool) -> None:
        """Subscribe; taker gives the callback of a topic, which calls the one in `takes` when a message has its turn.

        both: hear both topics from the start, as in a replay, where which of them sends shows only message by message.
        """
        self._taker, self._both = taker, both
        self._raw = MatchedSubscription(self._node, Image, RAW, taker(RAW), IMAGE_DEPTH)
        self._look()
        self._timer = self._node.create_timer(
            LOOK_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    @property
    def where(self) -> str:
        """Where frames are expected, for sentences; '' where nothing is subscribed."""
        return f" on {self._raw.topic}" if self._raw else ""

    def unheard(self) -> str:
        """Sentence on publishers that cannot be heard, and why; '' without any."""
        heard = [s for s in (self._raw, self._compressed) if s is not None]
        return next(filter(None, (s.unheard() for s in heard)), "")

    def missing(self) -> str:
        """The rest of a sentence on why no frame comes; '' where a publisher is heard."""
        if self._raw is None or self._raw.publishers or self._compressed is not None:
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
        assert self._raw is not None
        self._raw.look()
        now_s = time.monotonic()
        if not self._raw.publishers:
            self._raw_sends, self._offered_s = False, None
        elif self._offered_s is None:
            self._offered_s = now_s
        silent_s = None if self._offered_s is None else now_s - self._offered_s
        offered = self._node.count_publishers(self.compressed_topic) > 0
        wanted = self._both or (offered and not self._raw_sends and wants_compressed(silent_s))
        if wanted and self._compressed is None:
            topic = self.compressed_topic
            self._compressed = MatchedSubscription(
                self._node, CompressedImage, topic, self._taker(topic), IMAGE_DEPTH
            )
        elif not wanted and self._compressed is not None:
            self._compressed.destroy()
            self._compressed = None
        if self._compressed is not None:
            self._compressed.look()

    def _take_raw(self, message: Image, info: Mapping[str, Any]) -> None:
        self._raw_sends = True
        self._take_once(message, info, CompressedImage)

    def _take_compressed(self, message: CompressedImage, info: Mapping[str, Any]) -> None:
        if not self._raw_sends:
            self._take_once(message, info, Image)

    def _take_once(self, message: Any, info: Mapping[str, Any], other: type) -> None:
        """Take a message, unless its frame has come on the other topic."""
        self._stamps[type(message)] = key_of(message.header)
        if self._stamps.get(other) != key_of(message.header):
            self._take(message, info)


def wants_compressed(silent_s: float | None) -> bool:
    """Whether compressed frames are wanted, by the time for which raw ones are offered and none has come, None: not."""
    return silent_s is None or silent_s > RAW_PATIENCE_S
