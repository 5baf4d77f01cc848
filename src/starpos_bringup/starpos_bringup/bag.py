# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 by `rosbags`, with the message types of this workspace: read and written."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ament_index_python.packages import get_package_share_directory

from starpos.errors import BagError
from starpos.recording.bag import BagReader, installed_types
from starpos.recording.topics import IMU_DATA, NO_REMAPS, RAW, Remaps, driver_topics

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos

TYPE_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")


@dataclass(frozen=True)
class Topic:
    """One topic of a bag: message class and name of its type; latched: late subscribers get the last message too."""

    name: str
    kind: type
    type_name: str
    latched: bool


class Bag(BagReader):
    """A bag to play; everything in it is checked before it is used."""

    def inputs(self, needed: str, others: tuple[str, ...], remaps: Remaps = NO_REMAPS) -> list[str]:
        """Find the topics of these relative names in any namespace, or the topics of a robot's own camera and IMU.

        Accelerations are used without tilts. Raises BagError if the needed one is missing, FrameError if several topics
        may be a robot's, or a remap is impossible.
        """
        names = sorted({c.topic for c in self.connections})
        if not remaps and any(name.endswith("/" + needed) for name in names):
            of_tilt = () if any(name.endswith("/tilt") for name in names) else (IMU_DATA,)
            ends = tuple("/" + relative for relative in (needed, *others, *of_tilt))
            return [name for name in names if name.endswith(ends)]
        found = driver_topics(self.connections, remaps, place=self.path) if needed == RAW else {}
        if not found:
            raise BagError(f"{self.path}: no topic {needed} in it; it has {', '.join(map(repr, names))}")
        return sorted(found.values())

    def topics(self, wanted: list[str] | None, left_out: Callable[[str], None]) -> dict[int, Topic]:
        """Find the topics that can be played, by connection; `left_out` gets a sentence for each other topic.

        Raises BagError if one of the `wanted` (None: all) is not in the bag, or if nothing remains.
        """
        names = {c.topic for c in self.connections}
        for name in wanted or ():
            if name not in names:
                raise BagError(
                    f"{self.path}: no topic {name} in it; it has {', '.join(sorted(map(repr, names)))}"
                )
        topics = {}
        for c in self.connections:
            if c.topic == "/clock" or (wanted and c.topic not in wanted):
                continue
            try:
                topics[c.id] = _topic(c)
            except BagError as error:
                left_out(f"{self.path}: {c.topic!r} is left out: {error}")
        if not topics:
            raise BagError(f"{self.path}: there is nothing in it to play")
        return topics

    def played(self, topics: dict[int, Topic]) -> Iterator[tuple[Topic, int, bytes]]:
        """Read (topic, log time in ns, bytes) in the bag's order; raises BagError if the file breaks off."""
        for connection, log_ns, data in self.messages([c for c in self.connections if c.id in topics]):
            yield topics[connection.id], log_ns, data


def _topic(connection: "Connection") -> Topic:
    """Make the topic of a connection; raises BagError if its type is not installed here, or differs."""
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.validate_full_topic_name import validate_full_topic_name

    try:
        validate_full_topic_name(connection.topic)
    except (InvalidTopicNameException, ValueError, TypeError):
        raise BagError("it is no topic's name") from None
    kind = _message_class(connection.msgtype)
    known = _type_hash(connection.msgtype)
    if connection.digest.startswith("RIHS01_") and known and connection.digest != known:
        raise BagError(
            f"its {connection.msgtype} differs from the one installed here: use the version it was recorded with"
        )
    durabilities = [q.durability.name for q in getattr(connection.ext, "offered_qos_profiles", ())]
    latched = bool(durabilities) and all(name == "TRANSIENT_LOCAL" for name in durabilities)
    return Topic(connection.topic, kind, connection.msgtype, latched)


def _message_class(name: str) -> type:
    """Find the class of an installed message type; imports nothing else."""
    from importlib import import_module

    from ament_index_python.resources import get_resource

    match = TYPE_NAME.fullmatch(name)
    try:
        if match is None:
            raise LookupError
        package, message = match.groups()
        if f"msg/{message}.msg" not in get_resource("rosidl_interfaces", package)[0].split():
            raise LookupError
        return getattr(import_module(f"{package}.msg"), message)
    except (AttributeError, LookupError, ImportError):
        raise BagError(f"the message type {name!r} is not installed here") from None


def _type_hash(name: str) -> str:
    """Read the hash of an installed type's description; '' if it was installed without one."""
    import json

    package, _, message = name.split("/")
    try:
        path = Path(get_package_share_directory(package)) / "msg" / f"{message}.json"
        hashes = json.loads(path.read_text())["type_hashes"]
        return next(h["hash_string"] for h in hashes if h["type_name"] == name)
    except (LookupError, OSError, ValueError, StopIteration):
        return ""


class BagWriter:
    """Writes messages unchanged, compressed; the folder is a bag once it is closed.

    Raises BagError if rosbags is not installed, or if the folder exists already or cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
        except ImportError:
            raise BagError("rosbags, which writes bags, is not installed: pip install rosbags") from None
        self.folder, self.count = folder, 0
        self.store = installed_types()
        self._connections: dict[str, Connection] = {}
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError:
            raise BagError(f"{folder}: there is something of that name: give another one") from None
        except OSError as error:
            raise BagError(f"{folder}: no bag can be made there ({error.strerror})") from None

    def add_topic(self, topic: str, type_name: str, latched: bool = False) -> None:
        """Declare a topic before its first message; type_name as 'sensor_msgs/msg/Imu'."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self.store, offered_qos_profiles=[offered_qos(latched)]
            )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Write a message's bytes; BagError if the disk does not take it."""
        try:
            self._writer.write(self._connections[topic], log_ns, data)
        except OSError as error:
            raise BagError(
                f"{self.folder}: it cannot be written ({error.strerror}): the recording ends"
            ) from None
        self.count += 1

    def close(self) -> None:
        """Finish the bag; BagError if that fails."""
        try:
            self._writer.close()
        except OSError as error:
            raise BagError(
                f"{self.folder}: its end cannot be written ({error.strerror}): `mcap recover` gets back what is in it"
            ) from None


def offered_qos(latched: bool = False) -> "Qos":
    """Make the QoS of a reliable publisher, as a bag describes it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    endless = QosTime(9223372036, 854775807)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, durability, endless, endless,
               QosLiveliness.AUTOMATIC, endless, False)  # fmt: skip
