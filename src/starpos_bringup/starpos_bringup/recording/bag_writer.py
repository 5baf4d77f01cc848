# SPDX-License-Identifier: Apache-2.0
"""Writing of a rosbag2 (mcap, zstd) through `rosbags`, with the message types that are installed here."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

from ament_index_python.packages import get_package_share_directory

if TYPE_CHECKING:
    from rosbags.interfaces import Connection, Qos


class BagWriteError(Exception):
    """A bag cannot be written; the text is one sentence."""


class BagWriter:
    """Writes messages unchanged, compressed; the folder is a bag once it is closed.

    Raises BagWriteError if rosbags is not installed, or if the folder exists already or cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        try:
            from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer, WriterError
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise BagWriteError("rosbags, which writes bags, is not installed: pip install rosbags") from None
        self.folder, self.count = folder, 0
        self.store = get_typestore(Stores.ROS2_JAZZY)
        self._known: set[str] = set()
        self._connections: dict[str, Connection] = {}
        try:
            self._writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        except WriterError:
            raise BagWriteError(f"{folder}: there is something of that name: give another one") from None
        except OSError as error:
            raise BagWriteError(f"{folder}: no bag can be made there ({error.strerror})") from None

    def add_topic(self, topic: str, type_name: str, latched: bool = False) -> None:
        """Declare a topic before its first message; type_name as 'sensor_msgs/msg/Imu'."""
        if topic not in self._connections:
            self._learn(type_name)
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=self.store, offered_qos_profiles=[offered_qos(latched)]
            )

    def write(self, topic: str, log_ns: int, data: bytes) -> None:
        """Write a message's bytes; BagWriteError if the disk does not take it."""
        try:
            self._writer.write(self._connections[topic], log_ns, data)
        except OSError as error:
            raise BagWriteError(
                f"{self.folder}: it cannot be written ({error.strerror}): the recording ends"
            ) from None
        self.count += 1

    def close(self) -> None:
        """Finish the bag; BagWriteError if that fails."""
        try:
            self._writer.close()
        except OSError as error:
            raise BagWriteError(
                f"{self.folder}: its end cannot be written ({error.strerror}): `mcap recover` gets back what is in it"
            ) from None

    def _learn(self, type_name: str) -> None:
        """Register the installed definition of a type, and of the types in it."""
        from rosbags.typesys import get_types_from_msg

        if type_name in self.store.fielddefs or type_name in self._known:
            return
        self._known.add(type_name)
        package, message = type_name.split("/msg/")
        text = (Path(get_package_share_directory(package)) / "msg" / f"{message}.msg").read_text()
        for part in re.findall(r"^([A-Za-z]\w*(?:/\w+)?)(?:\[[^]]*\])?\s+\w+", text, re.MULTILINE):
            if part[0].isupper() or "/" in part:
                self._learn(f"{package}/msg/{part}" if "/" not in part else part.replace("/", "/msg/"))
        self.store.register(get_types_from_msg(text, type_name))


def offered_qos(latched: bool = False) -> "Qos":
    """Make the QoS of a reliable publisher, as a bag describes it."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    endless = QosTime(9223372036, 854775807)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, durability, endless, endless,
               QosLiveliness.AUTOMATIC, endless, False)  # fmt: skip
