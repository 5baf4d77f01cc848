# SPDX-License-Identifier: Apache-2.0
"""The topics of a robot's own camera and IMU in a bag: by name, by the user's choice, or the only one of its type."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from starpos.errors import FrameError
from starpos.recording.bag import PACKAGE

IMAGE, PICTURE, IMU = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "Imu"))
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TILT, CAPTURE = f"{PACKAGE}/msg/Tilt", f"{PACKAGE}/msg/Capture"
RAW, IMU_DATA = "camera/image_raw", "imu/data"
# what each input may be, the preferred type first
DRIVER_INPUTS = {
    RAW: (IMAGE, PICTURE),
    "camera/camera_info": (CAMERA_INFO,),
    "camera/capture": (CAPTURE,),
    "tilt": (TILT,),
    IMU_DATA: (IMU,),
}
MADE_OF = {IMAGE: "stars", PICTURE: "stars", IMU: "tilts"}


class Connected(Protocol):
    """A topic of a bag: rosbags' Connection."""

    @property
    def topic(self) -> str: ...

    @property
    def msgtype(self) -> str: ...

    @property
    def msgcount(self) -> int: ...


C = TypeVar("C", bound=Connected)


@dataclass(frozen=True)
class Remaps:
    """Topics of a bag by the relative names of the inputs they serve as; FrameError if a name is not an input."""

    topics: Mapping[str, str]

    def __post_init__(self) -> None:
        for name in self.topics:
            if name not in DRIVER_INPUTS:
                raise FrameError(f"--remap {name}:=...: the inputs are {', '.join(DRIVER_INPUTS)}")

    @classmethod
    def of(cls, texts: Sequence[str]) -> "Remaps":
        """Read texts NAME:=TOPIC; raises FrameError."""
        topics = {}
        for text in texts:
            name, sign, topic = text.partition(":=")
            if not (name and sign and topic):
                raise FrameError(f"--remap {text}: write NAME:=TOPIC, such as {RAW}:=/cam0/image_raw")
            topics[name.strip("/")] = "/" + topic.strip("/")
        return cls(topics)


NO_REMAPS = Remaps({})


def driver_topics(
    connections: Sequence[C],
    remaps: Remaps = NO_REMAPS,
    namespace: str | None = None,
    place: Path | str = "the bag",
) -> dict[str, str]:
    """Topics by the names of the DRIVER_INPUTS that they serve as; {} without images.

    The topic is the one that the user names, else the one with the input's own name, else the one next to the images (as
    image_transport places camera_info), else the only one of its type. Accelerations are used if there are no tilts, or
    if the user names them.
    namespace: only topics in it count, except for topics that the user names.
    Raises FrameError if several topics may be meant, or if a topic that the user names is missing or of another type.
    """
    bag = _Topics(connections, remaps, namespace, f"{place}")
    images = bag.of(RAW, "")
    if images is None:
        return {}
    beside = images.removesuffix("/compressed").rpartition("/")[0]
    found = {RAW: images}
    levels = (IMU_DATA,) if IMU_DATA in remaps.topics else ("tilt", IMU_DATA)
    for name in ("camera/camera_info", "camera/capture", *levels):
        if not (name == IMU_DATA and "tilt" in found) and (topic := bag.of(name, beside)):
            found[name] = topic
    return found


def named_topics(connections: Sequence[Connected], remaps: Remaps, place: Path | str) -> dict[str, str]:
    """The topics that the user names, by the inputs they serve as; raises FrameError as `driver_topics` does."""
    bag = _Topics(connections, remaps, None, f"{place}")
    return {name: topic for name in remaps.topics if (topic := bag.of(name, ""))}


def told(found: Mapping[str, str], connections: Sequence[Connected]) -> str:
    """Sentence on the use of the topics that were found."""
    kinds = {c.topic: c.msgtype for c in connections}
    made = [f"{MADE_OF[kinds[t]]} from {t}" for t in found.values() if kinds[t] in MADE_OF]
    plain = [f"{name} is {t}" for name, t in found.items() if kinds[t] not in MADE_OF]
    return ", ".join(made + plain)


@dataclass(frozen=True)
class _Topics:
    """The topics of a bag that have messages."""

    connections: Sequence[Connected]
    remaps: Remaps
    namespace: str | None
    place: str

    def of(self, name: str, beside: str) -> str | None:
        """The topic of an input, preferably next to `others`; None without one."""
        if name in self.remaps.topics:
            return self._named(name, self.remaps.topics[name])
        for kind in DRIVER_INPUTS[name]:
            topics = self._of_type(kind)
            own = [t for t in topics if t.removesuffix("/compressed").endswith(f"/{name}")]
            near = [t for t in topics if beside and t.rpartition("/")[0] == beside]
            for some in (own, near, topics):
                if len(some) == 1:
                    return some[0]
            if topics:
                raise FrameError(
                    f"{self.place}: {', '.join(topics)} are all {kind}: choose one with --remap {name}:={topics[0]}"
                )
        return None

    def _of_type(self, kind: str) -> list[str]:
        below = "/" + (self.namespace or "").strip("/")
        return sorted(
            {
                c.topic
                for c in self.connections
                if c.msgtype == kind and c.msgcount and (below == "/" or c.topic.startswith(f"{below}/"))
            }
        )

    def _named(self, name: str, topic: str) -> str:
        kinds = {c.topic: c.msgtype for c in self.connections}
        if topic not in kinds:
            raise FrameError(f"{self.place}: no topic {topic} in it; it has {', '.join(sorted(kinds))}")
        if kinds[topic] not in DRIVER_INPUTS[name]:
            raise FrameError(
                f"{self.place}: {topic} has {kinds[topic]}; {name} takes {', '.join(DRIVER_INPUTS[name])}"
            )
        return topic
