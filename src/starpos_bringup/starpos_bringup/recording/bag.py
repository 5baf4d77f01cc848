# SPDX-License-Identifier: Apache-2.0
"""What a rosbag2 holds, read by `rosbags`: its topics with the message types of this workspace, and its messages."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from starpos.recording import bounds

TYPE_NAME = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
LAST_NS = (2**31 - 1) * 10**9  # what a Clock message holds


class ReplayError(Exception):
    """One sentence: what, where, what to do."""


@dataclass(frozen=True)
class Topic:
    """One topic of a bag: message class and name of its type; latched: late subscribers get the last message too."""

    name: str
    kind: type
    type_name: str
    latched: bool


class Bag:
    """A rosbag2 as read by `rosbags`; everything in it is checked before it is used."""

    def __init__(self, path: Path):
        self.path = path
        self._reader = None

    def __enter__(self):
        try:
            from rosbags.rosbag2 import Reader
        except ImportError:
            raise ReplayError("rosbags, which reads bags, is not installed: pip install rosbags") from None
        if not self.path.exists():
            raise ReplayError(f"{self.path}: there is no such bag")
        try:
            bounds.check_folder(self.path)
        except (bounds.BagError, OSError) as error:
            raise self._broken(error) from None
        if self.path.is_dir() and not (self.path / "metadata.yaml").is_file():
            raise ReplayError(
                f"{self.path}: a folder without metadata.yaml is no bag: name its .mcap or .db3 file"
            )
        try:
            bounds.bound_rosbags()
            self._reader = Reader(self.path)
            self._reader.open()
            bounds.check_chunks(self._reader)
        except Exception as error:  # rosbags, ruamel.yaml, zstd and sqlite have their own for a broken file
            raise self._broken(error) from None
        return self

    def __exit__(self, *exception):
        self._reader.close()

    def _broken(self, error: Exception) -> ReplayError:
        if isinstance(error, bounds.BagError):
            return ReplayError(f"{self.path}: {error}")
        return ReplayError(f"{self.path}: not a readable bag ({type(error).__name__}: {str(error)[:200]})")

    def inputs(self, needed: str, others: tuple[str, ...]) -> list[str]:
        """The topics of these relative names, in whatever namespace; ReplayError where the needed one is not there."""
        names = sorted({c.topic for c in self._reader.connections})
        if not any(name.endswith("/" + needed) for name in names):
            raise ReplayError(f"{self.path}: no topic {needed} in it; it has {', '.join(map(repr, names))}")
        return [
            name for name in names if name.endswith(tuple("/" + relative for relative in (needed, *others)))
        ]

    def topics(self, wanted: list[str] | None, left_out: Callable[[str], None]) -> dict[int, Topic]:
        """What can be played, by connection; `left_out` is called with a sentence for each topic that cannot.

        ReplayError where one of the `wanted` (None: all) is not in the bag, or nothing remains.
        """
        names = {c.topic for c in self._reader.connections}
        for name in wanted or ():
            if name not in names:
                raise ReplayError(
                    f"{self.path}: no topic {name} in it; it has {', '.join(sorted(map(repr, names)))}"
                )
        topics = {}
        for c in self._reader.connections:
            if c.topic == "/clock" or (wanted and c.topic not in wanted):
                continue
            try:
                topics[c.id] = _topic(c)
            except ReplayError as error:
                left_out(f"{self.path}: {c.topic!r} is left out: {error}")
        if not topics:
            raise ReplayError(f"{self.path}: there is nothing in it to play")
        return topics

    def messages(self, topics: dict[int, Topic]) -> Iterator[tuple[Topic, int, bytes]]:
        """(topic, log time in ns, bytes) in the bag's order; ReplayError where the file breaks off."""
        connections = [c for c in self._reader.connections if c.id in topics]
        messages = self._reader.messages(connections)
        while True:
            try:
                connection, log_ns, data = next(messages)
            except StopIteration:
                return
            except Exception as error:
                raise self._broken(error) from None
            if not 0 <= log_ns <= LAST_NS:
                raise ReplayError(
                    f"{self.path}: a message of {connection.topic} was logged at {log_ns} ns, no time until 2038"
                )
            yield topics[connection.id], log_ns, bytes(data)


def _topic(connection) -> Topic:
    """A connection with the type of this workspace; ReplayError where there is none, or another of the same name."""
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.validate_full_topic_name import validate_full_topic_name

    try:
        validate_full_topic_name(connection.topic)
    except (InvalidTopicNameException, ValueError, TypeError):
        raise ReplayError("it is no topic's name") from None
    kind = _message_class(connection.msgtype)
    known = _type_hash(connection.msgtype)
    if connection.digest.startswith("RIHS01_") and known and connection.digest != known:
        raise ReplayError(
            f"its {connection.msgtype} differs from the one installed here: use the version it was recorded with"
        )
    durabilities = [q.durability.name for q in connection.ext.offered_qos_profiles]
    latched = bool(durabilities) and all(name == "TRANSIENT_LOCAL" for name in durabilities)
    return Topic(connection.topic, kind, connection.msgtype, latched)


def _message_class(name: str) -> type:
    """The class of an installed message type; nothing is imported that is not one."""
    from importlib import import_module

    from ament_index_python.resources import get_resource

    match = TYPE_NAME.fullmatch(name)
    try:
        package, message = match.groups()
        if f"msg/{message}.msg" not in get_resource("rosidl_interfaces", package)[0].split():
            raise LookupError
        return getattr(import_module(f"{package}.msg"), message)
    except (AttributeError, LookupError, ImportError):
        raise ReplayError(f"the message type {name!r} is not installed here") from None


def _type_hash(name: str) -> str:
    """The hash of an installed type's description; '' where it was installed without."""
    import json

    from ament_index_python.packages import get_package_share_directory

    package, message = TYPE_NAME.fullmatch(name).groups()
    try:
        path = Path(get_package_share_directory(package)) / "msg" / f"{message}.json"
        hashes = json.loads(path.read_text())["type_hashes"]
        return next(h["hash_string"] for h in hashes if h["type_name"] == name)
    except (LookupError, OSError, ValueError, StopIteration):
        return ""
