# SPDX-License-Identifier: Apache-2.0
"""The topics of one instrument in a bag, or of a robot's own camera and IMU."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from starpos.errors import FrameError
from starpos.recording.bag import PACKAGE, BagReader

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

IMAGE, PICTURE, IMU = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "Imu"))
IMAGES = (IMAGE, PICTURE)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TILT, CAPTURE = f"{PACKAGE}/msg/Tilt", f"{PACKAGE}/msg/Capture"
RAW, IMU_DATA = "camera/image_raw", "imu/data"
# what each input may be, the preferred type first
DRIVER_INPUTS = {
    RAW: IMAGES,
    "camera/camera_info": (CAMERA_INFO,),
    "camera/capture": (CAPTURE,),
    "tilt": (TILT,),
    IMU_DATA: (IMU,),
}
MADE_OF = {IMAGE: "stars", PICTURE: "stars", IMU: "tilts"}


# topics of a bag by the relative names of the inputs they serve as
Remaps = Mapping[str, str]
NO_REMAPS: Remaps = {}


def remaps_of(texts: Sequence[str]) -> Remaps:
    """Read texts NAME:=TOPIC; raises FrameError for another one, or if a name is not an input."""
    topics = {}
    for text in texts:
        name, sign, topic = text.partition(":=")
        if not (name and sign and topic):
            raise FrameError(f"--remap {text}: write NAME:=TOPIC, such as {RAW}:=/cam0/image_raw")
        if (name := name.strip("/")) not in DRIVER_INPUTS:
            raise FrameError(f"--remap {name}:=...: the inputs are {', '.join(DRIVER_INPUTS)}")
        topics[name] = "/" + topic.strip("/")
    return topics


def driver_topics(bag: BagReader, remaps: Remaps = NO_REMAPS, namespace: str | None = None) -> dict[str, str]:
    """Topics by the names of the DRIVER_INPUTS that they serve as; {} without images.

    The topic is the one that the user names, else the one with the input's own name, else the one next to the images (as
    image_transport places camera_info), else the only one of its type. Accelerations are used if there are no tilts, or
    if the user names them.
    namespace: only topics in it count, except for topics that the user names.
    Raises FrameError if several topics may be meant, or if a topic that the user names is missing or of another type.
    """
    if (images := _topic_of(bag, RAW, remaps, namespace)) is None:
        return {}
    beside = images.removesuffix("/compressed").rpartition("/")[0]
    found = {RAW: images}
    levels = (IMU_DATA,) if IMU_DATA in remaps else ("tilt", IMU_DATA)
    for name in ("camera/camera_info", "camera/capture", *levels):
        if name == IMU_DATA and "tilt" in found:
            continue
        if topic := _topic_of(bag, name, remaps, namespace, beside):
            found[name] = topic
    return found


def _topic_of(
    bag: BagReader, name: str, remaps: Remaps, namespace: str | None = None, beside: str = ""
) -> str | None:
    """The topic with messages that serves as an input, preferably next to others; None without one."""
    kinds = {c.topic: c.msgtype for c in bag.connections}
    if topic := remaps.get(name):
        if topic not in kinds:
            raise FrameError(f"{bag.path}: no topic {topic} in it; it has {', '.join(sorted(kinds))}")
        if kinds[topic] not in DRIVER_INPUTS[name]:
            raise FrameError(
                f"{bag.path}: {topic} has {kinds[topic]}; {name} takes {', '.join(DRIVER_INPUTS[name])}"
            )
        return topic
    below = f"/{(namespace or '').strip('/')}/".replace("//", "/")
    heard = sorted({c.topic for c in bag.connections if c.msgcount and c.topic.startswith(below)})
    for kind in DRIVER_INPUTS[name]:
        topics = [t for t in heard if kinds[t] == kind]
        own = [t for t in topics if t.removesuffix("/compressed").endswith(f"/{name}")]
        near = [t for t in topics if beside and t.rpartition("/")[0] == beside]
        for some in (own, near, topics):
            if len(some) == 1:
                return some[0]
        if topics:
            raise FrameError(
                f"{bag.path}: {', '.join(topics)} are all {kind}: choose one with --remap {name}:={topics[0]}"
            )
    return None


def sentence_on_use(found: Mapping[str, str], connections: "Sequence[Connection]") -> str:
    kinds = {c.topic: c.msgtype for c in connections}
    made = [f"{MADE_OF[kinds[t]]} from {t}" for t in found.values() if kinds[t] in MADE_OF]
    plain = [f"{name} is {t}" for name, t in found.items() if kinds[t] not in MADE_OF]
    return ", ".join(made + plain)


STARS, TRAILS, SOLUTION = (f"{PACKAGE}/msg/{name}" for name in ("StarArray", "TrailArray", "Solution"))
# of which each message is a frame
FRAMES = (STARS, *IMAGES)
# types by the relative names of the solver's inputs
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
INPUTS = {"stars": STARS, "tilt": TILT, "camera/camera_info": CAMERA_INFO}
# with gnss.use and with satellites.elements, too
ALL_INPUTS = {**INPUTS, "gnss/fix": NAV_SAT_FIX, "trails": TRAILS}


@dataclass(frozen=True)
class Chosen:
    """An instrument's namespace and connections; made: how a robot's own messages are used, '' if they are not."""

    namespace: str
    connections: "Sequence[Connection]"
    made: str = ""


def instrument_in(
    bag: BagReader, namespace: str | None, topics: Mapping[str, str], remaps: Remaps = NO_REMAPS
) -> Chosen:
    """Find namespace and connections of an instrument, or of a robot's own drivers without an instrument.

    topics: types by relative names.
    remaps: images that the user names take precedence over star lists, named accelerations over tilts. FrameError if
    there is no instrument, or if there are several and `namespace` is None.
    """
    found: dict[str, list[Connection]] = {}
    for c in bag.connections:
        for suffix, kind in topics.items():
            if c.msgtype == kind and c.topic.endswith(f"/{suffix}"):
                found.setdefault(c.topic.removesuffix(suffix).rstrip("/") or "/", []).append(c)
    able = sorted(n for n, cs in found.items() if any(c.msgtype == STARS and c.msgcount for c in cs))
    if not able or RAW in remaps:
        if drivers := driver_topics(bag, remaps, namespace):
            used = [c for c in bag.connections if c.topic in drivers.values()]
            return Chosen("/" + (namespace or "").strip("/"), used, sentence_on_use(drivers, used))
        raise FrameError(
            f"{bag.path}: no stars in it, and no images: record stars, tilt and camera/camera_info, or the images and "
            "the IMU of a robot"
        )
    wanted = "/" + namespace.strip("/") if namespace is not None else able[0]
    if able == ["/"] and wanted != "/":
        raise FrameError(
            f"{bag.path}: the instrument in it has no namespace, not {wanted}: leave --namespace out"
        )
    if wanted not in able or (namespace is None and len(able) > 1):
        raise FrameError(
            f"{bag.path}: the instruments in it are {', '.join(able)}: choose one with --namespace"
        )
    named = {name: topic for name in remaps if (topic := _topic_of(bag, name, remaps))}
    replaced = {INPUTS.get("tilt" if name == IMU_DATA else name) for name in named}
    own = [c for c in found[wanted] if c.msgtype not in replaced]
    others = [c for c in bag.connections if c.topic in named.values()]
    return Chosen(wanted, [*own, *others], sentence_on_use(named, others))
