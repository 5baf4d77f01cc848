# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 by `rosbags`, with the message types of this workspace: read, brought up to date, and written."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ament_index_python.packages import get_package_share_directory

from starpos.errors import BagError
from starpos.recording.bag import PACKAGE, BagReader, installed_types
from starpos.recording.topics import IMU_DATA, NO_REMAPS, RAW, Remaps, driver_topics

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos
    from rosbags.typesys.store import Typestore

Appended = dict[str, dict[str, Any]]

SHUTTER = {"shutter_known": False, "readout": 0.0, "readout_stddev": 0.0}
# Fields added at the end of types, each with its value for unknown: newest first, last the fields that the first release
# lacked.
VERSIONS: tuple[Appended, ...] = (
    {f"{PACKAGE}/msg/Solution": {"warnings": []}},
    {
        f"{PACKAGE}/msg/Tilt": {"z": math.nan, "z_variance": math.nan},
        f"{PACKAGE}/msg/Capture": SHUTTER,
        f"{PACKAGE}/msg/StarArray": SHUTTER,
    },
)
APPENDED: Appended = {name: fields for version in VERSIONS for name, fields in version.items()}


class OlderTypes:
    """The types of APPENDED as earlier versions had them."""

    def store_of(self, type_name: str, digest: str) -> "Typestore | None":
        """The types among which one has this hash; None if it is not one of them."""
        if type_name not in APPENDED:
            return None
        return next((s for s in self._then if s.hash_rihs01(type_name) == digest), None)

    def upgraded(self, data: bytes, type_name: str, store: "Typestore") -> bytes:
        """The bytes of a message of older types as the type of today has them; as they are if they are broken."""
        try:
            message = self._completed(store.deserialize_cdr(data, type_name), type_name)
            return bytes(self._now.serialize_cdr(message, type_name))
        except Exception:
            # hostile bytes may cause any error of a conversion; the player reports that they are broken
            return data

    def _completed(self, message: Any, type_name: str) -> Any:
        given = vars(message)
        for name, (_, about) in self._now.fielddefs[type_name][1]:
            if about in APPENDED:
                given[name] = self._completed(given[name], about)
        return self._now.types[type_name](**APPENDED[type_name] | given)

    @cached_property
    def _now(self) -> "Typestore":
        return installed_types()

    @cached_property
    def _then(self) -> "list[Typestore]":
        """The types before each of VERSIONS."""
        stores = []
        for k in range(len(VERSIONS)):
            store = installed_types()
            for version in VERSIONS[: k + 1]:
                for type_name, appended in version.items():
                    constants, fields = store.fielddefs.pop(type_name)
                    store.register({type_name: (constants, [f for f in fields if f[0] not in appended])})
            stores.append(store)
        return stores


TYPE_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")


@dataclass(frozen=True)
class Topic:
    """One topic of a bag: message class and name of its type; latched: late subscribers get the last message too.

    older: the types of an earlier version whose messages it has, which are upgraded; None for the type of today.
    """

    name: str
    kind: type
    type_name: str
    latched: bool
    older: "Typestore | None"


class Bag(BagReader):
    """A bag to play; everything in it is checked before it is used."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._older = OlderTypes()

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
        found = driver_topics(self, remaps) if needed == RAW else {}
        if not found:
            raise self._without(needed)
        return sorted(found.values())

    def _without(self, name: str) -> BagError:
        known = ", ".join(sorted({repr(c.topic) for c in self.connections}))
        return BagError(f"{self.path}: no topic {name} in it; it has {known}")

    def topics(self, wanted: list[str] | None, left_out: Callable[[str], None]) -> dict[int, Topic]:
        """Find the topics that can be played, by connection; `left_out` gets a sentence for each other topic.

        Raises BagError if one of the `wanted` (None: all) is not in the bag, or if nothing remains.
        """
        names = {c.topic for c in self.connections}
        for name in wanted or ():
            if name not in names:
                raise self._without(name)
        topics = {}
        for c in self.connections:
            if c.topic == "/clock" or (wanted and c.topic not in wanted):
                continue
            try:
                topics[c.id] = _topic(c, self._older)
            except BagError as error:
                left_out(f"{self.path}: {c.topic!r} is left out: {error}")
        if not topics:
            raise BagError(f"{self.path}: there is nothing in it to play")
        return topics

    def played(self, topics: dict[int, Topic]) -> Iterator[tuple[Topic, int, bytes]]:
        """Read (topic, log time in ns, bytes) in the bag's order; raises BagError if the file breaks off."""
        for connection, log_ns, data in self.messages([c for c in self.connections if c.id in topics]):
            topic = topics[connection.id]
            if topic.older is not None:
                data = self._older.upgraded(data, topic.type_name, topic.older)
            yield topic, log_ns, data


def _topic(connection: "Connection", older: OlderTypes) -> Topic:
    """Make the topic of a connection; raises BagError if its type is not installed here, or differs."""
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.validate_full_topic_name import validate_full_topic_name

    try:
        validate_full_topic_name(connection.topic)
    except (InvalidTopicNameException, ValueError, TypeError):
        raise BagError("it is no topic's name") from None
    kind = _message_class(connection.msgtype)
    known = _type_hash(connection.msgtype)
    differs = connection.digest.startswith("RIHS01_") and bool(known) and connection.digest != known
    then = older.store_of(connection.msgtype, connection.digest) if differs else None
    if differs and then is None:
        raise BagError(
            f"its {connection.msgtype} differs from the one installed here: use the version it was recorded with"
        )
    durabilities = [q.durability.name for q in getattr(connection.ext, "offered_qos_profiles", ())]
    latched = bool(durabilities) and all(name == "TRANSIENT_LOCAL" for name in durabilities)
    return Topic(connection.topic, kind, connection.msgtype, latched, then)


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
